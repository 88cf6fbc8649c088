"""mavquad monitor: watch a link or play a log: streams, attitude, estimates, setpoints, texts.

WHAT is an endpoint (udpin:0.0.0.0:14550, udpout:HOST:PORT, tcp:HOST:PORT, serial:DEVICE:BAUD) or a tlog. Nothing is sent unless
--request-rates asks the autopilot for message rates, so it can watch a real vehicle. Examples:

  mavquad monitor udpin:0.0.0.0:14550             beside  mavquad sitl --forward udpout:127.0.0.1:14550
  mavquad monitor RUN/flight.tlog --speed 5       space pauses, [ and ] seek
  mavquad monitor udpin:0.0.0.0:14550 --plain     a line a second, for pipes and slow links
  mavquad monitor udpin:0.0.0.0:14550 --once      a verdict after three seconds as exit code: 0 good, 1 not
"""

import argparse
import json
import sys
import time
from pathlib import Path

from mavquad.errors import ConfigError, LogError
from tools import watch_text
from tools.watch_feed import Feed, Live, Playback

PAGE_NAMES = ("link", "flight", "estimates", "setpoints", "messages")
_SCHEMES = ("udpin:", "udpout:", "tcp:", "serial:")
_ONCE_S = 3.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("what", nargs="?", default="udpin:0.0.0.0:14550", help="endpoint or tlog (default %(default)s)")
    parser.add_argument("--plain", action="store_true", help="a line a second instead of a screen")
    parser.add_argument("--json", action="store_true", help="a JSON object a second instead of a screen")
    parser.add_argument("--once", action="store_true", help="one verdict, as exit code too; a log is judged at its end")
    parser.add_argument(
        "--wait", type=float, default=_ONCE_S, metavar="S", help="how long --once listens (default %(default)s s)"
    )
    parser.add_argument("--system", type=int, help="the vehicle to speak of (default: the first heard)")
    parser.add_argument("--request-rates", action="store_true", help="ask the autopilot for message rates (sends!)")
    parser.add_argument("--speed", type=float, default=1.0, help="of a log, times real time (default %(default)s)")
    parser.add_argument("--page", choices=PAGE_NAMES, default="flight", help="the page to begin with")
    parser.add_argument("--light", action="store_true", help="dark on light")
    parser.add_argument("--screenshot", type=Path, metavar="FILE", help="of a log: its end as an SVG picture, and leave")
    parser.add_argument("--size", default="100x30", help="of the screenshot (default %(default)s)")


def run(args: argparse.Namespace) -> int:
    if not 0.01 <= args.speed <= 1000.0:
        raise ConfigError(f"--speed {args.speed:g}: expected 0.01 to 1000")
    feed = open_feed(args.what, args.speed, args.request_rates)
    try:
        if args.once:
            return once(feed, args)
        if args.plain or args.json:
            return lines(feed, args)
        return screen(feed, args)
    finally:
        feed.close()


def open_feed(what: str, speed: float, request_rates: bool) -> Feed:
    """A live link or a playback. Raises LinkError, LogError, ConfigError."""
    if what.startswith(_SCHEMES):
        return Live(what, request_rates)
    if request_rates:
        raise ConfigError(
            f"--request-rates: {what} is a log, nobody answers there; give an endpoint such as udpin:0.0.0.0:14550"
        )
    return Playback(Path(what), speed)


def once(feed: Feed, args: argparse.Namespace) -> int:
    """Listen, judge, leave."""
    if isinstance(feed, Playback):
        feed.seek(feed.end_us)
    else:
        end = time.monotonic() + args.wait
        while time.monotonic() < end and not feed.error:
            time.sleep(0.05)
            feed.advance()
    faults = watch_text.faults(feed.watch, args.system)
    if args.json:
        print(json.dumps(watch_text.status(feed.watch, args.system) | {"ok": not faults, "faults": faults}))
    else:
        print(watch_text.verdict(feed.watch, args.system))
    return 1 if faults else 0


def lines(feed: Feed, args: argparse.Namespace) -> int:
    """A line a second: of wall time, or of log time as fast as it can be read when a log is not played slower."""
    said, silent = 0, False
    while True:
        if isinstance(feed, Playback):
            if feed.over:
                return 0
            feed.seek(feed.now_us + round(1e6))
        else:
            time.sleep(1.0)
            feed.advance()
            if feed.error:
                print(feed.error, file=sys.stderr)
                return 1
            if feed.silent and not silent:
                print(feed.status(), file=sys.stderr)
            silent = feed.silent
        if args.json:
            print(json.dumps(watch_text.status(feed.watch, args.system)), flush=True)
            continue
        fresh, said = feed.watch.said - said, feed.watch.said
        for text in list(feed.watch.texts)[-fresh:] if fresh else []:
            print(f"{1e-6 * (text.t_us - feed.watch.start_us):8.1f} s  {text.sender}: {text.words}")
        print(watch_text.line(feed.watch, args.system), flush=True)


def screen(feed: Feed, args: argparse.Namespace) -> int:
    """The pages, until q."""
    from tools.monitor_app import Monitor

    app = Monitor(feed, args.page, args.light)
    app.system = args.system
    if args.screenshot is None:
        if not sys.stdout.isatty():
            raise ConfigError("the monitor's screen needs a terminal; use --plain or --json")
        app.run()
        return 0
    if not isinstance(feed, Playback):
        raise LogError(f"--screenshot: expected a log, got {args.what}")
    width, _, height = args.size.partition("x")
    if not width.isdigit() or not height.isdigit():
        raise ConfigError(f"--size {args.size}: expected COLUMNSxROWS, e.g. 100x30")
    args.screenshot.write_text(picture(app, int(width), int(height)), encoding="utf-8")
    return 0


def picture(app: "object", width: int, height: int) -> str:
    """The app at the end of its log as SVG."""
    import asyncio

    from tools.monitor_app import Monitor

    assert isinstance(app, Monitor)

    async def take() -> str:
        feed = app.feed
        assert isinstance(feed, Playback)
        feed.seek(feed.end_us)
        feed.paused = True
        async with app.run_test(size=(width, height)) as pilot:
            await pilot.pause()
            app.draw()
            await pilot.pause()
            return app.export_screenshot(title="mavquad monitor")

    return asyncio.run(take())
