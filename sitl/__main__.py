"""mavquad sitl: the simulated autopilot alone, to be met over MAVLink.

Example: python -m sitl --personality px4 --endpoint udpin:127.0.0.1:14550 --seed 1 --set wind.mean_m_s=5
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from mavquad.errors import ConfigError, MavquadError

DEFAULT_ENDPOINT = "udpin:127.0.0.1:14550"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `mavquad sitl`."""
    parser.add_argument("--config", type=Path, metavar="FILE", help="a sitl.toml; every key can also be given by --set")
    parser.add_argument("--airframe", help="name or .toml file of the vehicle (x500)")
    parser.add_argument("--personality", choices=("px4", "ardupilot"), help="whose behaviour it has (px4)")
    parser.add_argument("--seed", type=int, help="of every random thing (1)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="e.g. wind.mean_m_s=5, link.loss=0.01")
    parser.add_argument(
        "--endpoint",
        action="append",
        default=[],
        metavar="E",
        help=f"udpin:HOST:PORT or udpout:HOST:PORT, again for more ({DEFAULT_ENDPOINT})",
    )
    parser.add_argument("--socket-fd", type=int, metavar="N", help="a bound UDP socket handed down, in place of --endpoint")
    parser.add_argument(
        "--forward", action="append", default=[], metavar="E", help="udpout:HOST:PORT: a copy of both directions"
    )
    parser.add_argument("--signing-key", metavar="FILE", help="sign everything, take only what is signed with the key in FILE")
    parser.add_argument(
        "--signing-state", type=Path, metavar="FILE", help="where timestamps are kept (default: beside the log, or the key)"
    )
    parser.add_argument("--log", type=Path, metavar="FILE", help="tlog of every frame, with the truth")
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument("--lockstep", action="store_true", help="vehicle time waits for a companion's answers")
    pace.add_argument("--speed", type=float, default=1.0, metavar="F", help="vehicle time over wall time (1)")
    parser.add_argument("--exit-when-landed", type=float, metavar="S", help="end S seconds of vehicle time after a flight")
    parser.add_argument("--max-time", type=float, metavar="S", help="end at this vehicle time")


def run(args: argparse.Namespace) -> int:
    """Fly until told to stop. Raises MavquadError."""
    from mavquad.link import signing
    from sitl import config, shell  # numpy and the kernels: not for --help

    if not args.speed > 0.0:
        raise ConfigError(f"--speed {args.speed}: expected more than 0 (1 is real time)")
    changes = [f"{k}={v}" for k in ("airframe", "personality", "seed") if (v := getattr(args, k)) is not None]
    sitl = config.load(args.config, [*changes, *args.set])
    key, signer = args.signing_key or sitl.signing_key, None
    if key:
        beside = args.log.with_suffix(".signing") if args.log else Path(f"{key}.sitl-{sitl.system}-{sitl.component}")
        signer = signing.open_signer(key, args.signing_state or beside)
    flight = shell.Run(sitl, args.lockstep, args.log, args.exit_when_landed, args.max_time, signer)
    if args.socket_fd is not None:
        flight.ports.adopt(args.socket_fd)
    for endpoint in args.endpoint or ([DEFAULT_ENDPOINT] if args.socket_fd is None else []):
        flight.ports.open(endpoint)
    for endpoint in args.forward:
        flight.ports.copy_to(endpoint)
    where = ", ".join(args.endpoint) or (DEFAULT_ENDPOINT if args.socket_fd is None else f"socket {args.socket_fd}")
    pace = "in lockstep, waiting for a companion" if args.lockstep else f"at {args.speed:g} times real time"
    print(f"sitl: {sitl.personality} {sitl.airframe} at {where}, {pace}", file=sys.stderr, flush=True)
    shell.fly(flight, args.speed, sys.stdout)
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """The program. Returns 0 done, 1 failed (one line on stderr), 2 wrong usage."""
    parser = argparse.ArgumentParser(
        prog="mavquad sitl", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    add_arguments(parser)
    try:
        return run(parser.parse_args(argv))
    except MavquadError as error:
        print(f"sitl: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    raise SystemExit(main())
