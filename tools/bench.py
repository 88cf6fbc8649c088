"""mavquad bench: speed beside the peers, in one run on this machine.

Each PART is a module of tools/benches. Times are CPU time, medians where a task is short. Examples:

  mavquad bench                    every part
  mavquad bench reading --json     one part, as JSON
"""

import argparse
import importlib
import json
import math
import os
import platform
import sys
from pathlib import Path

from mavquad.errors import ConfigError
from tools.benches import Row

FOLDER = Path(__file__).resolve().parent / "benches"


def parts() -> dict[str, str]:
    """Every part by name, with the first line of its docstring."""
    paths = sorted(path for path in FOLDER.glob("*.py") if path.stem != "__init__")
    return {path.stem.replace("_", "-"): path.read_text(encoding="utf-8").splitlines()[0].strip('"') for path in paths}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    known = "; ".join(f"{name}: {line}" for name, line in parts().items())
    parser.add_argument("part", nargs="*", help=f"which (default: all). {known}")
    parser.add_argument(
        "--seconds", type=float, default=10.0, help="roughly, for each part; less gives coarser figures (default 10)"
    )
    parser.add_argument("--json", action="store_true", help="rows as JSON on stdout")


def run(args: argparse.Namespace) -> int:
    known = parts()
    for name in args.part:
        if name not in known:
            raise ConfigError(f"no part is called {name!r}; known: {', '.join(known)}")
    found: list[tuple[str, Row]] = []
    for name in args.part or known:
        print(f"measuring {name} ...", file=sys.stderr, flush=True)
        module = importlib.import_module(f"tools.benches.{name.replace('-', '_')}")
        found += [(name, row) for row in module.measure(args.seconds)]
    machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    if args.json:
        rows = [
            {"part": part, **row._asdict(), "value": row.value if math.isfinite(row.value) else None} for part, row in found
        ]
        print(json.dumps({"machine": machine, "rows": rows}))
    else:
        print(table(found))
        print(machine)
    return 0


def table(found: list[tuple[str, Row]]) -> str:
    """The rows as aligned text."""
    cells = [
        (part, row.what, row.who, "-" if math.isnan(row.value) else f"{row.value:.4g}", row.unit, row.note)
        for part, row in found
    ]
    widths = [max((len(cell[i]) for cell in cells), default=0) for i in range(6)]
    sides = ("<", "<", "<", ">", "<", "<")
    return "\n".join(
        "  ".join(f"{word:{side}{width}}" for word, side, width in zip(cell, sides, widths, strict=True)).rstrip()
        for cell in cells
    )
