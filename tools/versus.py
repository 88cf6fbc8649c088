"""mavquad versus: the same flight twice, same wind and seed, by a plain controller and by the best there is; one page beside the other.

Example:
  mavquad versus                                   # gusty: pid, then the best
  mavquad versus spiral --left autopilot --right eskf-mpc --seed 3
"""

import argparse
import html as escape
import json
import os
import time
from pathlib import Path
from typing import Any

from mavquad.errors import FlightError, LogError

BEST = "eskf-mpc"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of a pair of flights."""
    parser.add_argument("scenario", nargs="?", default="gusty", help="as of `mavquad fly` (default: %(default)s)")
    parser.add_argument("--left", default="pid", metavar="CONTROLLER[+COMPENSATOR]", help="the rival (default: %(default)s)")
    parser.add_argument("--right", default=BEST, metavar="CONTROLLER[+COMPENSATOR]", help="(default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of wind, noise and faults (default: %(default)s)")
    parser.add_argument("--personality", choices=("px4", "ardupilot"), default="px4", help="(default: %(default)s)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change anything, for both")
    parser.add_argument("--run", type=Path, metavar="DIR", help="folder (default: runs/<time>-<scenario>-<seed>-versus)")
    parser.add_argument("--json", action="store_true", help="print both summaries")


def run(args: argparse.Namespace) -> int:
    """Two flights and their page. 0 where both went well, 1 where not."""
    from tools import fly, summary

    sides = {"left": _options(args, args.left), "right": _options(args, args.right)}
    if args.right != BEST or args.set:  # what is wrong with it is known before the other flies
        from mavquad import plan

        plan.build(fly.resolve(sides["right"]).companion)
    name = Path(args.scenario).stem
    folder = args.run or Path("runs") / f"{time.strftime('%Y%m%d-%H%M%S')}-{name}-{args.seed}-versus"
    results = [fly.one(options, folder / side) for side, options in sides.items()]
    page = draw(folder, args)
    if args.json:
        print(json.dumps({"left": results[0], "right": results[1]}, allow_nan=False))
    else:
        for side, result in zip(("left", "right"), results, strict=True):
            summary.show(result, folder / side)
            print()
        print(f"{verdict(results, args)}\nboth beside each other  {page}")
    failures = [f"{r['command']}: {'; '.join(r['failures'])}" for r in results if not r["ok"]]
    if failures:
        raise FlightError(f"not as it should be: {' | '.join(failures)}; logs are in {folder}")
    return 0


def _options(args: argparse.Namespace, who: str) -> argparse.Namespace:
    """What `mavquad fly` is to be asked for one side."""
    from tools import fly

    controller, _, compensator = who.partition("+")
    words = [args.scenario, "--seed", str(args.seed), "--personality", args.personality, "--controller", controller]
    words += ["--compensator", compensator or "none"]
    for change in args.set:
        words += ["--set", change]
    parser = argparse.ArgumentParser()
    fly.add_arguments(parser)
    options = parser.parse_args(words)
    options.json = args.json  # it is progress that is quiet then
    return options


def verdict(results: list[dict[str, Any]], args: argparse.Namespace) -> str:
    """The difference in a sentence."""
    left, right = ((r.get("rmse_m") or {}).get("position") for r in results)
    if not left or not right:
        return "One of the two never flew the path."
    times = (
        f"{left / right:.1f} times nearer to the path" if right < left else f"{right / left:.1f} times further from the path"
    )
    return f"{args.right}: {right:.3f} m rmse, {args.left}: {left:.3f} m, same wind and seed: {times}"


def draw(folder: Path, args: argparse.Namespace) -> Path:
    """`versus.html` in the folder that holds `left` and `right`. Raises LogError where a flight left no trace."""
    import numpy as np

    from mavquad.link.columns import Log
    from tools import page as html
    from tools import score
    from tools.trace import Trace, read_trace

    names, results, flights = (args.left, args.right), [], []
    for side in ("left", "right"):
        run = folder / side
        results.append(json.loads((run / "summary.json").read_text(encoding="utf-8")))
        trace = read_trace(run / "flight.trace")
        rows = trace.rows[np.isfinite(trace.column("ref_p_n"))]
        flights.append((Trace(trace.names, rows), score.truth(Log(run / "sitl.tlog"))))
    errors, plan_view, space = [], [], []
    for i, (name, (part, truth)) in enumerate(zip(names, flights, strict=True)):
        if not len(part.rows):
            raise LogError(f"{folder}: {name} never flew the path; its log is in {folder / ('left', 'right')[i]}")
        error = np.linalg.norm(score.position_error(part, truth), axis=1)
        t_s = 1e-6 * part.column("t_us")
        errors.append(html.line(name, t_s, error, i))
        flown = truth.p_ned_m[(truth.t_us >= part.column("t_us")[0]) & (truth.t_us <= part.column("t_us")[-1])]
        plan_view.append(html.line(name, flown[:, 1], flown[:, 0], i))
        space.append((name, flown, i))
    wanted = flights[0][0].vector("ref_p")
    plan_view.append(html.line("wanted", wanted[:, 1], wanted[:, 0], 3, dash="dot"))
    space.append(("wanted", wanted, 3))
    part, truth = flights[1]
    during = (truth.t_us >= part.column("t_us")[0]) & (truth.t_us <= part.column("t_us")[-1])
    t_s = 1e-6 * truth.t_us[during]
    wind = [html.line(k, t_s, truth.extra[f"wind_{k[0]}"][during], i) for i, k in enumerate(("north", "east", "down"))]
    heads = ["flown by", "rmse, m", "largest error, m", "periods missed", "report"]
    table = [
        [n, (r["rmse_m"] or {})["position"], r["max_error_m"], r["setpoint_misses"], f"{s}/report.html"]
        for n, r, s in zip(names, results, ("left", "right"), strict=True)
    ]
    links = "".join(
        f'<p><a href="{s}/report.html">{escape.escape(n)}: everything about this flight</a></p>'
        for n, s in zip(names, ("left", "right"), strict=True)
    )
    better = results[1]["ok"] and results[0]["ok"]
    lead = (
        html.text(verdict(results, args), f"verdict {'good' if better else 'bad'}")
        + html.table(heads, table)
        + html.text("Errors are the simulated vehicle's true state against the path, which the companion never sees.", "quiet")
        + links
    )
    sections = [
        (
            "Distance from the path",
            [
                html.figure("True position less wanted position", errors, x="vehicle time, s", y="m", linked="time"),
                html.figure("The wind upon both", wind, x="vehicle time, s", y="m/s", linked="time"),
            ],
        ),
        (
            "Paths",
            [
                html.figure(
                    "From above",
                    plan_view,
                    x="east, m",
                    y="north, m",
                    height=520,
                    hovermode="closest",
                    yaxis={"scaleanchor": "x", "title": {"text": "north, m"}},
                ),
                html.path3d("In space", space),
            ],
        ),
        ("To repeat", [html.code("\n".join(r["command"] for r in results))]),
    ]
    title = f"{results[0]['scenario']}, seed {args.seed}, {args.personality}: {args.left} and {args.right}"
    path = folder / "versus.html"
    path.write_text(html.page(title, sections, lead), encoding="utf-8")
    return Path(os.path.relpath(path))
