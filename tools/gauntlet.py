"""mavquad fly gauntlet: a table of flights, each with something that goes wrong, and what happened in each.

One circle in lockstep per row, faults in vehicle time and seeded. An independent listener on a socket judges every setpoint.
"""

import argparse
import copy
import json
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

from mavquad import wire
from mavquad.errors import FlightError
from mavquad.link import tlog

FINISHES, LETS_GO, FALLS = "finishes", "lets go", "falls"  # what a row must come to; falls: the rotors were stopped
RATIO = 2.0  # of the clean flight's rmse, where a row is held to it
BASE = ("flight.takeoff_m=3", "flight.max_time_s=90", "params.COM_OBL_ACT=0", "require.misses=1000000")  # lost setpoints: land
_AT_S = 15.0  # vehicle time of what happens once: on the circle
_ROUTINE = ("configuring", "observing", "streaming", "engaged", "path over", "released: landing by")


class Row(NamedTuple):
    """One flight: what is changed, what it must come to, and whether its error is held to RATIO of the clean one."""

    name: str
    sets: tuple[str, ...]
    must: str = FINISHES
    held: bool = False


def _fault(kind: str, **keys: Any) -> str:
    parts = [f'kind="{kind}"', f"t_s={_AT_S}", *(f"{key}={json.dumps(value)}" for key, value in keys.items())]
    return f"faults=[{{{', '.join(parts)}}}]"


def _delay(ms: float, spread_ms: float = 0.0) -> tuple[str, str]:
    """A mean delay each way, plus or minus."""
    return f"link.delay_ms={ms - spread_ms}", f"link.jitter_ms={2.0 * spread_ms}"


def _silence(seconds: float) -> str:
    return f"link.silences=[[{_AT_S}, {_AT_S + seconds}]]"


ROWS = (
    Row("clean", ()),
    Row("loss 5 %", ("link.loss=0.05",)),
    Row("loss 20 %", ("link.loss=0.2",)),
    Row("loss 50 %", ("link.loss=0.5",)),
    Row("delay 60 +- 20 ms", _delay(60.0, 20.0)),
    Row("loss 20 %, delay 60 +- 20 ms", ("link.loss=0.2", *_delay(60.0, 20.0)), held=True),
    Row("delay 150 ms", _delay(150.0)),
    Row("twice 20 %", ("link.duplicate=0.2",)),
    Row("out of order 20 %", ("link.reorder=0.2",)),
    Row("corrupt 10 %", ("link.corrupt=0.1",)),
    Row("silence 0.1 s", (_silence(0.1),)),
    Row("silence 0.5 s", (_silence(0.5),)),
    Row("silence 2 s", (_silence(2.0),), LETS_GO),
    Row("silence 5 s", (_silence(5.0),), LETS_GO),
    Row("restart of the autopilot", (_fault("restart"),), FALLS),
    Row("attitude NaN 0.2 s", (_fault("nan", sensor="attitude", duration_s=0.2),)),
    Row("attitude NaN for good", (_fault("nan", sensor="attitude"),), LETS_GO),
    Row("imu NaN 2 s", (_fault("nan", sensor="imu", duration_s=2.0),)),
    Row("position NaN 0.5 s", (_fault("nan", sensor="position", duration_s=0.5),)),
    Row("position frozen 0.5 s", (_fault("freeze", sensor="position", duration_s=0.5),)),
    Row("gyro bias 0.05 rad/s", (_fault("bias", sensor="gyro", value=[0.05, 0.0, 0.0]),)),
    Row("rotor 2 at 70 %", (_fault("motor", motor=2, effectiveness=0.7),)),
    Row("push 5 m/s2 0.3 s", (_fault("push", force_n=[10.0, 0.0, 0.0], duration_s=0.3),)),
    Row("position reset 3 m", (_fault("ekf_reset", value=[3.0, 0.0, 0.0]),)),
    Row(
        "all of it, mildly",
        (
            "link.loss=0.1",
            *_delay(40.0, 10.0),
            "link.duplicate=0.05",
            "link.reorder=0.05",
            "link.corrupt=0.02",
            "wind.mean_m_s=4",
            _fault("push", force_n=[10.0, 0.0, 0.0], duration_s=0.3)[:-1]
            + f', {{kind="ekf_reset", t_s={_AT_S + 2.0}, value=[0.0, 3.0, 0.0]}}]',
        ),
    ),
    Row("delay 300 ms, loss 50 %", ("link.loss=0.5", *_delay(300.0)), LETS_GO),
)


def run(args: argparse.Namespace) -> int:
    """Fly every row and print the table. Raises FlightError where one did not come to what it must."""
    rows = [row for row in ROWS if not args.rows or any(part in row.name for part in args.rows)]
    if not rows:
        raise FlightError(f"no row of the gauntlet has {' or '.join(args.rows)} in its name; known: {_names()}")
    folder = args.run or Path("runs") / f"{time.strftime('%Y%m%d-%H%M%S')}-gauntlet-{args.seed}"
    done: list[dict[str, Any]] = []
    for n, row in enumerate(rows, 1):
        print(f"{n} of {len(rows)}: {row.name}", file=sys.stderr, flush=True)
        done.append(fly(row, args, folder / f"{n:02d}"))
    judge(done)
    (folder / "gauntlet.json").write_text(json.dumps(done, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(done) if args.json else table(done))
    wrong = [f"{r['row']}: {'; '.join(r['wrong'])}" for r in done if r["wrong"]]
    if wrong:
        raise FlightError(f"{len(wrong)} of {len(done)} rows: {' | '.join(wrong)}; all in {folder}")
    return 0


def _names() -> str:
    return ", ".join(row.name for row in ROWS)


def fly(row: Row, args: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """One row: what happened."""
    from tools import fly as flights
    from tools.listener import Listener

    words = copy.copy(args)
    words.scenario, words.no_report, words.json = "circle", True, True
    words.set = [*BASE, *row.sets, *args.set]
    companion = flights.resolve(words).companion
    with Listener(companion.limits, companion.link.component) as ear:
        summary = flights.one(words, folder, ear.endpoint)
    texts = announced(folder / "flight.tlog", companion.link.component)
    return {
        "row": row.name,
        "must": row.must,
        "held": row.held,
        "rmse_m": (summary.get("rmse_m") or {}).get("position"),
        "max_error_m": summary.get("max_error_m"),
        "degraded_s": round(degraded_s(texts, summary.get("counts") or {}), 1),
        "state": summary["states"][-1]["state"] if summary["states"] else "nothing heard",
        "reason": summary["states"][-1]["reason"] if summary["states"] else "",
        "landed": summary["landed"],
        "crashed": summary["crashed"],
        "setpoints": summary["setpoints_sent"],
        "judged": ear.heard,
        "bad": ear.bad,
        "announced": [text for _, text in texts if not any(word in text for word in _ROUTINE)],
        "command": summary["command"],
        "problems": [f for f in summary["failures"] if f.startswith(("the companion ended", "the simulated autopilot ended"))],
    }


def announced(log: Path, component: int) -> list[tuple[float, str]]:
    """(seconds, text) of everything the companion said."""
    out = []
    with log.open("rb") as stream:
        for t_us, frame in tlog.read(stream):
            if frame.component == component and frame.msgid == wire.ID["STATUSTEXT"]:
                out.append((1e-6 * t_us, wire.decode(frame).text.removeprefix("mavquad: ").removeprefix("mavquad ")))
    return out


def degraded_s(texts: list[tuple[float, str]], counts: dict[str, int]) -> float:
    """Time held, levelled, flown slower or not followed."""
    total = 0.1 * (counts.get("held", 0) + counts.get("held level", 0))
    for begins, ends in (("flying slower", "in time again"), ("are not followed", "are followed again")):
        since = None
        for t_s, text in texts:
            if begins in text and since is None:
                since = t_s
            elif since is not None and (ends in text or text.startswith("released")):
                total, since = total + t_s - since, None
    return total


def judge(done: list[dict[str, Any]]) -> None:
    """What each row must come to, into its `wrong`."""
    clean = next((r["rmse_m"] for r in done if r["row"] == "clean"), None)
    for r in done:
        wrong = list(r["problems"])
        if r["bad"]:
            wrong.append(f"setpoints on the wire: {r['bad']}")
        if r["judged"] < r["setpoints"]:
            wrong.append(f"{r['judged']} of {r['setpoints']} setpoints judged")
        finished = r["reason"].startswith("landing by")
        if r["must"] == FINISHES and not (finished and r["landed"] and not r["crashed"]):
            wrong.append(f"did not finish: {r['state']} {r['reason']}, landed {r['landed']}, crashed {r['crashed']}")
        elif r["must"] == LETS_GO and (not _given_back(r) or not r["landed"] or r["crashed"]):
            wrong.append(f"not given back and landed: {r['state']} {r['reason']}, landed {r['landed']}, crashed {r['crashed']}")
        elif r["must"] == FALLS and not any("restarted" in text for text in r["announced"]):
            wrong.append("a restart that was not announced")
        r["clean_ratio"] = r["rmse_m"] / clean if clean and r["rmse_m"] is not None else None
        predicts = "eskf-mpc" in r["command"]
        if r["held"] and predicts and r["clean_ratio"] is not None and r["clean_ratio"] > RATIO:
            wrong.append(f"rmse {r['clean_ratio']:.2f} times the clean one, at most {RATIO:g}")
        r["wrong"] = wrong


def _given_back(r: dict[str, Any]) -> bool:
    """Released (or never engaged) with a reason that was said."""
    return r["state"] == "released" and bool(r["reason"])


def table(done: list[dict[str, Any]]) -> str:
    """For people."""
    lines = [f"{'':29} {'rmse':>6} {'x':>5} {'max':>6} {'degraded':>8}  {'setpoints':>9} {'bad':>3}  what happened"]
    for r in done:
        numbers = [f"{x:.3f}" if x is not None else "-" for x in (r["rmse_m"], r["max_error_m"])]
        ratio = f"{r['clean_ratio']:.1f}" if r["clean_ratio"] is not None else "-"
        end = "finished" if r["reason"].startswith("landing by") else f"{r['state']}: {r['reason']}"
        end += ", crashed" if r["crashed"] else "" if r["landed"] else ", not landed"
        said = "; ".join(dict.fromkeys(text for text in r["announced"] if not text.startswith("released")))
        lines.append(
            f"{r['row']:29} {numbers[0]:>6} {ratio:>5} {numbers[1]:>6} {r['degraded_s']:>6.1f} s  {r['judged']:>9}"
            f" {sum(r['bad'].values()):>3}  {end}{f' ({said})' if said else ''}{'  WRONG' if r['wrong'] else ''}"
        )
    return "\n".join(lines)
