"""The monitor on a terminal: five pages over one watch, keys always on screen. Sends nothing; draws four times a second."""

from functools import lru_cache
from typing import Any, ClassVar

from rich.segment import Segment
from rich.style import Style
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.geometry import Region
from textual.geometry import Size as Area
from textual.scroll_view import ScrollView
from textual.strip import Strip
from textual.widgets import Footer, Static, Tab, Tabs

from tools.monitor_pages import PAGES, Line, Size
from tools.watch import Vehicle
from tools.watch_feed import Feed, Playback

DRAW_S, TAKE_S = 0.25, 0.1
SEEK_US = 10_000_000
SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)


@lru_cache(maxsize=64)
def _style(name: str) -> Style:
    return Style.parse(name)


class Page(ScrollView, can_focus=True):
    """Lines that scroll; only those that changed are drawn again."""

    def __init__(self) -> None:
        super().__init__(id="body")
        self._lines: list[Line] = []

    def show(self, lines: list[Line]) -> None:
        before, self._lines = self._lines, lines
        if len(before) != len(lines):
            self.virtual_size = Area(self.size.width, len(lines))
            self.refresh()
            return
        top = self.scroll_offset.y
        changed = (y - top for y, (old, new) in enumerate(zip(before, lines, strict=True)) if old != new)
        regions = [Region(0, y, self.size.width, 1) for y in changed if 0 <= y < self.size.height]
        if regions:
            self.refresh(*regions)

    def render_line(self, y: int) -> Strip:
        row, style = y + self.scroll_offset.y, self.rich_style
        if row >= len(self._lines):
            return Strip.blank(self.size.width, style)
        strip = Strip([Segment(words, style + _style(name)) for words, name in self._lines[row]])
        return strip.adjust_cell_length(self.size.width, style)


class Monitor(App[int]):
    """Pages 1-5; a log also takes space, ., [, ], + and -."""

    CSS = """
    #status { height: 1; background: $primary; color: $foreground; text-style: bold; }
    #body { height: 1fr; padding: 0 1; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("1", "page('link')", "page", key_display="1-5"),
        *(Binding(str(i), f"page('{name}')", name, show=False) for i, name in enumerate(PAGES, start=1) if i > 1),
        Binding("v", "vehicle", "vehicle"),
        Binding("d", "shade", "dark/light"),
        Binding("space", "pause", "pause"),
        Binding("full_stop", "step", "step", key_display="."),
        Binding("left_square_bracket", "seek(-1)", "10 s", key_display="[ ]"),
        Binding("right_square_bracket", "seek(1)", "+10 s", show=False),
        Binding("plus,equals_sign", "faster(1)", "speed", key_display="+ -"),
        Binding("minus", "faster(-1)", "slower", show=False),
        Binding("q", "quit", "quit"),
    ]

    def __init__(self, feed: Feed, page: str = "flight", light: bool = False) -> None:
        super().__init__()
        self.feed = feed
        self.page = page
        self.system: int | None = None
        self._light = light
        self._head, self._body, self._headline = Static(id="status", markup=False), Page(), ""

    def compose(self) -> ComposeResult:
        yield self._head
        yield Tabs(*(Tab(f"{i} {name}", id=name) for i, name in enumerate(PAGES, start=1)), active=self.page)
        yield self._body
        yield Footer(show_command_palette=False)

    def on_mount(self) -> None:
        self.theme = "textual-light" if self._light else "textual-dark"
        self.query_one(Tabs).can_focus = False
        self._body.focus()
        self.set_interval(TAKE_S, self.take)
        self.set_interval(DRAW_S, self.draw)
        self.call_after_refresh(self.draw)

    def take(self) -> None:
        self.feed.advance(TAKE_S)

    def draw(self) -> None:
        """The page that is seen, and nothing else."""
        if self._headline != (headline := self.headline()):
            self._headline = headline
            self._head.update(headline, layout=False)
        size = Size(self._body.size.width, self._body.size.height)
        self._body.show(PAGES[self.page](self.feed.watch, self.vehicle(), size))

    def headline(self) -> str:
        watch, vehicle = self.feed.watch, self.vehicle()
        who = f"vehicle {vehicle.system}: {vehicle.mode}{' armed' if vehicle.armed else ''}" if vehicle else "no vehicle"
        lost = " LINK LOST" if vehicle and vehicle.lost else ""
        return f" mavquad  {self.feed.status()}  {who}{lost}  loss {100 * watch.loss():.2f} %"

    def vehicle(self) -> Vehicle | None:
        vehicles = self.feed.watch.vehicles
        return vehicles.get(self.system) if self.system is not None else next(iter(vehicles.values()), None)

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """The keys of a log are not there on a live link, nor that of the vehicle with one vehicle."""
        if action == "vehicle":
            return len(self.feed.watch.vehicles) > 1
        return isinstance(self.feed, Playback) or action not in ("pause", "step", "seek", "faster")

    def on_tabs_tab_activated(self, event: Any) -> None:
        self.page = event.tab.id
        self._body.scroll_home(animate=False)
        self.draw()

    def action_page(self, name: str) -> None:
        if name:
            self.query_one(Tabs).active = name

    def action_vehicle(self) -> None:
        systems = sorted(self.feed.watch.vehicles)
        if systems:
            here = self.vehicle()
            self.system = systems[(systems.index(here.system) + 1) % len(systems)] if here else systems[0]
            self.draw()

    def action_shade(self) -> None:
        self.theme = "textual-dark" if self.theme == "textual-light" else "textual-light"

    def action_pause(self) -> None:
        if isinstance(self.feed, Playback):
            self.feed.paused = not self.feed.paused
            self.draw()

    def action_step(self) -> None:
        if isinstance(self.feed, Playback):
            self.feed.step()
            self.draw()

    def action_seek(self, way: int) -> None:
        if isinstance(self.feed, Playback):
            self.feed.seek(self.feed.now_us + way * SEEK_US)
            self.draw()

    def action_faster(self, way: int) -> None:
        if isinstance(self.feed, Playback):
            nearest = min(range(len(SPEEDS)), key=lambda i: abs(SPEEDS[i] - self.feed.speed))  # type: ignore[union-attr]
            self.feed.speed = SPEEDS[max(0, min(len(SPEEDS) - 1, nearest + way))]
            self.draw()
