"""python -m mavquad: the companion alone."""

import argparse
import json
import sys
from pathlib import Path

from mavquad.errors import ConfigError, MavquadError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The companion's options."""
    parser.add_argument(
        "--endpoint",
        default="udpin:0.0.0.0:14540",
        help="udpin:, udpout:, tcp:HOST:PORT or serial:DEVICE:BAUD (default: %(default)s)",
    )
    parser.add_argument("--config", type=Path, help="a companion.toml; without one: the defaults, hovering where it is")
    parser.add_argument(
        "--forward",
        action="append",
        default=[],
        metavar="ENDPOINT",
        help="a ground station or monitor on a link of its own, e.g. udpout:127.0.0.1:14550 (may be repeated)",
    )
    parser.add_argument("--run", type=Path, help="folder for the logs (default: runs/<time>-companion)")
    parser.add_argument("--engage", action="store_true", help="take off and fly the path as soon as the autopilot is ready")
    parser.add_argument(
        "--signing-key", metavar="FILE", help="sign everything, take only what is signed with the key in FILE (mode 0600)"
    )
    parser.add_argument(
        "--signing-state",
        type=Path,
        metavar="FILE",
        help="where timestamps are kept (default: beside the key; in lockstep the run folder)",
    )
    parser.add_argument(
        "--lockstep", action="store_true", help="vehicle time waits for us (the simulated autopilot must be started so too)"
    )
    parser.add_argument(
        "--speed",
        type=float,
        default=1.0,
        metavar="F",
        help="a simulated autopilot runs at F times real time (SIM_SPEEDUP of ArduPilot, --speed of ours): delays and time-outs are in its time",
    )
    parser.add_argument(
        "--realtime", action="store_true", help="run ahead of all ordinary processes (SCHED_FIFO of Linux; it must be allowed)"
    )


def run(args: argparse.Namespace) -> int:
    """Fly until Ctrl-C or SIGTERM; one line of JSON about it on stdout at the end."""
    from mavquad import realtime
    from mavquad.link import clock
    from mavquad.link.endpoint import open_endpoint

    if not 0.01 <= args.speed <= 1000.0:
        raise ConfigError(f"--speed {args.speed}: expected 0.01 to 1000 times real time")
    if args.speed != 1.0 and args.lockstep:
        raise ConfigError("--speed with --lockstep: a vehicle that waits for us has no speed; leave one of them away")
    if args.realtime:
        if args.lockstep:
            raise ConfigError("--realtime with --lockstep: a vehicle that waits for us needs no haste; leave one of them away")
        realtime.ask()
    endpoint = open_endpoint(args.endpoint)  # first: what is wrong with it is known before anything is compiled
    further = [(open_endpoint(name), name) for name in args.forward]
    from mavquad import config, pipeline, plan_file, settings, warm
    from mavquad.companion import Companion
    from mavquad.link import signing
    from mavquad.relay import Relay

    chosen = config.load(args.config, settings.Companion) if args.config else settings.Companion()
    plan = pipeline.build(chosen)
    folder = args.run or Path("runs") / f"{clock.stamp()}-companion"
    key = args.signing_key or chosen.link.signing_key
    signer = None
    if key:
        folder.mkdir(parents=True, exist_ok=True)
        beside = Path(f"{key}.companion-{chosen.link.system}-{chosen.link.component}")
        signer = signing.open_signer(key, args.signing_state or (folder / "companion.signing" if args.lockstep else beside))
    warm.run(plan)  # compile or load before anybody waits for an answer
    companion = Companion(
        plan,
        endpoint,
        folder,
        lockstep=args.lockstep,
        engage=args.engage,
        relays=tuple(Relay(*link) for link in further),
        signer=signer,
        speed=args.speed,
    )
    try:
        plan_file.write(plan_file.beside(companion.log.path), plan.settings, plan.airframe)
        companion.run()
    finally:
        print(json.dumps(companion.summary()), flush=True)
    return 0


def main(argv: list[str] | None = None) -> int:
    """Parse, run, and print an error as one line."""
    parser = argparse.ArgumentParser(
        prog="python -m mavquad",
        description="The companion: listens to an autopilot, estimates, and flies it on request.",
        epilog="example: python -m mavquad --endpoint udpin:0.0.0.0:14540 --config companion.toml",
    )
    add_arguments(parser)
    try:
        return run(parser.parse_args(argv))
    except MavquadError as error:
        print(f"mavquad: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:  # before `Companion.run` takes the signal
        print("mavquad: stopped by Ctrl-C", file=sys.stderr)
        return 1


if __name__ == "__main__":
    raise SystemExit(main())
