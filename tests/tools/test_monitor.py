"""`mavquad monitor`: its pages by snapshots at two sizes, its keys by Textual's pilot, its plain forms by exit code and text."""

import asyncio
import json
import math
import time
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from mavquad import wire
from tests.oracles import flown
from tests.oracles.golden import check, screen
from tools.__main__ import main
from tools.monitor_app import Monitor
from tools.monitor_pages import PAGES, Size, band, grid, histogram, quantile, spark
from tools.watch import Watch
from tools.watch_feed import Live, Playback

GOLDEN = Path(__file__).parent / "golden"
SIZES = [(80, 24), (120, 40)]


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("flown") / "flown.tlog"
    path.write_bytes(flown.log_bytes())
    return path


def with_app(
    feed: Any, act: Callable[[Monitor, Any], Coroutine[Any, Any, None]], size: tuple[int, int] = (80, 24), page: str = "flight"
) -> None:
    async def run() -> None:
        app = Monitor(feed, page)
        async with app.run_test(size=size) as pilot:
            await pilot.pause()
            await act(app, pilot)

    asyncio.run(run())


def at_end(path: Path) -> Playback:
    feed = Playback(path)
    feed.seek(feed.end_us)
    feed.paused = True
    return feed


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
@pytest.mark.parametrize("page", PAGES)
def test_each_page_looks_as_it_did(page, size, log):
    async def act(app: Monitor, pilot: Any) -> None:
        app.draw()
        await pilot.pause()
        text = screen(app.export_screenshot())
        assert max(map(len, text.splitlines())) <= size[0]
        check(GOLDEN / f"monitor-{page}-{size[0]}x{size[1]}.txt", text)

    with_app(at_end(log), act, size, page)


def test_the_keys_do_what_the_foot_of_the_screen_says(log):
    async def act(app: Monitor, pilot: Any) -> None:
        feed = app.feed
        assert isinstance(feed, Playback)
        for key, page in zip("12345", PAGES, strict=True):
            await pilot.press(key)
            await pilot.pause()
            assert app.page == page
        assert feed.paused
        await pilot.press("left_square_bracket")
        assert feed.now_us == feed.end_us - 10_000_000
        frames = feed.watch.frames
        await pilot.press("full_stop")
        assert feed.watch.frames == frames + 1
        await pilot.press("plus", "plus")
        assert feed.speed == 5.0
        await pilot.press("minus")
        assert feed.speed == 2.0
        await pilot.press("space")
        await pilot.pause(0.5)
        assert feed.watch.frames > frames + 20
        await pilot.press("right_square_bracket")
        await pilot.press("d")
        assert app.theme == "textual-light"
        await pilot.press("q")

    with_app(at_end(log), act)


def test_a_long_page_scrolls(log):
    async def act(app: Monitor, pilot: Any) -> None:
        app.draw()
        await pilot.pause()
        assert "TIMESYNC" not in screen(app.export_screenshot())
        await pilot.press("end")
        await pilot.pause(0.5)
        assert "TIMESYNC" in screen(app.export_screenshot())

    with_app(at_end(log), act, (80, 16), "link")


def test_the_vehicle_is_chosen_where_there_are_two(tmp_path):
    raws = [wire.encode("HEARTBEAT", (2, 3, 81, 4 if s == 1 else 5, 4, 3), seq=0, system=s, component=1) for s in (1, 2)]
    (tmp_path / "two.tlog").write_bytes(b"".join((10**15 + i).to_bytes(8, "big") + raw for i, raw in enumerate(raws)))

    async def act(app: Monitor, pilot: Any) -> None:
        assert "vehicle 1: GUIDED" in app.headline()
        await pilot.press("v")
        assert "vehicle 2: LOITER" in app.headline()

    with_app(at_end(tmp_path / "two.tlog"), act)


def test_a_live_link_has_no_keys_of_a_log():
    feed = Live("udpin:127.0.0.1:0")

    async def act(app: Monitor, pilot: Any) -> None:
        app.draw()
        await pilot.pause()
        text = screen(app.export_screenshot())
        assert "live udpin:127.0.0.1:0" in text
        assert "No HEARTBEAT of an autopilot yet; heard: nobody" in text
        assert "quit" in text
        assert "pause" not in text

    try:
        with_app(feed, act)
    finally:
        feed.close()


def test_a_thousand_messages_a_second_cost_less_than_a_tenth_of_a_core(log):
    """Taking 1000 messages and drawing four times, by CPU time, best of five: at most 100 ms."""
    raws = [raw for _, raw in flown.frames(10.0)][:1000]

    async def act(app: Monitor, pilot: Any) -> None:
        await pilot.press("1")
        spent = []
        for turn in range(5):
            start = time.process_time()
            for i in range(0, len(raws), 250):
                for raw in raws[i : i + 250]:
                    app.feed.watch.take(flown.EPOCH_US + 10**8 + 10**6 * turn + 1000 * i, wire.split(raw)[0][0])
                app.draw()
                await pilot.pause(0)
            spent.append(time.process_time() - start)
        assert min(spent) < 0.1

    with_app(at_end(log), act, (120, 40))


# ---- without a screen ---------------------------------------------------------------------------------------------------
def test_a_line_a_second(log, capsys):
    assert main(["monitor", str(log), "--plain"]) == 0
    lines = capsys.readouterr().out.splitlines()
    seconds = [line for line in lines if "AUTO.LOITER  " in line or "OFFBOARD" in line or " att " in line]
    assert sum(" att " in line for line in seconds) == 12
    assert any(line.endswith("1/191: mavquad engaged: setpoints are flown") for line in lines)
    assert "engaged" in next(line for line in lines if line.startswith("     5.0 s"))


def test_json_lines_are_objects(log, capsys):
    assert main(["monitor", str(log), "--json"]) == 0
    objects = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [round(o["t_s"]) for o in objects] == list(range(1, 13))
    assert objects[4]["mode"] == "OFFBOARD"
    assert objects[4]["state"] == "engaged"


def test_one_verdict_as_exit_code(log, tmp_path, capsys):
    assert main(["monitor", str(log), "--once"]) == 0
    assert capsys.readouterr().out == "1/1: good\n"
    assert main(["monitor", "udpin:127.0.0.1:0", "--once", "--wait", "0.2", "--json"]) == 1
    said = json.loads(capsys.readouterr().out)
    assert said["ok"] is False
    assert said["faults"] == ["no HEARTBEAT of an autopilot; heard: nobody"]


def test_a_picture_of_a_log(log, tmp_path, capsys):
    out = tmp_path / "monitor.svg"
    assert main(["monitor", str(log), "--page", "estimates", "--screenshot", str(out), "--size", "80x24"]) == 0
    assert screen(out.read_text()) == (GOLDEN / "monitor-estimates-80x24.txt").read_text()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["nowhere.tlog", "--plain"], "nowhere.tlog: no such file"),
        (["nowhere.tlog", "--request-rates"], "is a log, nobody answers there"),
        (["udpin:127.0.0.1:x", "--plain"], "expected udpin:HOST:PORT"),
        (["nowhere.tlog", "--speed", "0"], "--speed 0: expected 0.01 to 1000"),
    ],
)
def test_what_cannot_be_watched_is_said_in_one_line(words, text, capsys):
    assert main(["monitor", *words]) == 1
    said = capsys.readouterr().err
    assert text in said
    assert said.count("\n") == 1


def test_a_screen_needs_a_terminal(log, capsys):
    assert main(["monitor", str(log)]) == 1
    assert "needs a terminal; use --plain or --json" in capsys.readouterr().err
    assert main(["monitor", str(log), "--screenshot", "x.svg", "--size", "big"]) == 1
    assert "expected COLUMNSxROWS" in capsys.readouterr().err


# ---- drawings -----------------------------------------------------------------------------------------------------------
def test_small_drawings():
    assert spark([0.0, 1.0, 2.0, math.nan, 4.0], 4) == "▁▃ █"
    assert spark([], 9) == spark([math.nan], 9) == ""
    assert "".join(words for words, _ in band(-0.5, 0.25, 0.5, 1.0, 9)) == "──[═┼●]──".replace("┼", "═")
    assert ("●", "bold red") in band(-0.5, 0.9, 0.5, 1.0, 21)
    assert histogram([1.0, 1.0, 1.0, 2.0], 4) == "█  ▃"
    assert math.isnan(quantile([], 0.5))
    assert quantile(range(100), 0.95) == 95
    assert grid([["a", "bb"], [("ccc", "red"), "d"]], "lr") == [
        [("a", ""), ("  ", ""), (" ", ""), ("", ""), ("bb", ""), (" ", "")],
        [("ccc", "red"), ("", ""), (" ", ""), (" ", ""), ("d", ""), (" ", "")],
    ]


def test_every_page_of_an_empty_watch_says_so():
    for page in PAGES.values():
        assert all(isinstance(words, str) for line in page(Watch(), None, Size(80, 24)) for words, _ in line)
