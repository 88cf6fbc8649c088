"""`mavquad COMMAND`: the parser, and the one place that prints errors.

A command is a module of this folder whose docstring begins `mavquad NAME: ...`, with `add_arguments(parser)` and
`run(args) -> int`. It is imported when it is called, so that `mavquad --help` costs nothing.
"""

import argparse
import difflib
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType

from mavquad import __version__
from mavquad.errors import MavquadError

FOLDER = Path(__file__).resolve().parent
PROGRAMS = {  # programs of their own: called with the rest of the command line
    "sitl": ("sitl.__main__", "the simulated autopilot alone, to be met over MAVLink"),
    "companion": ("mavquad.__main__", "the companion alone, pointed at any autopilot"),
}


def commands() -> dict[str, str]:
    """Every command there is, with its one line; nothing is imported for it."""
    found = {name: line for name, (_, line) in PROGRAMS.items()}
    for path in FOLDER.glob("*.py"):
        mark = f"mavquad {path.stem}: "
        line = _first_line(path)
        if line.startswith(mark):
            found[path.stem] = line.removeprefix(mark)
    found["paper"] = "a paper's experiment with its baselines"
    return dict(sorted(found.items()))


def papers() -> dict[str, str]:
    """Every paper's command, with its one line."""
    found = {}
    for path in sorted((FOLDER / "papers").glob("*.py")):
        if "\ndef run(args" in path.read_text(encoding="utf-8"):
            name = path.stem.replace("_", "-")
            found[name] = _first_line(path).removeprefix(f"mavquad paper {name}: ")
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command. Returns 0 done, 1 failed (one line on stderr), 2 wrong usage."""
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        return _dispatch(words)
    except MavquadError as error:
        print(f"mavquad: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("mavquad: stopped by Ctrl-C", file=sys.stderr)
        return 1
    except BrokenPipeError:  # the reader of our output has gone, e.g. `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except SystemExit as stop:  # argparse: 0 after --help, 2 after wrong usage
        return stop.code if isinstance(stop.code, int) else 1


def _dispatch(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        print(_overview("mavquad COMMAND [OPTIONS]", commands(), "mavquad fly circle --seed 7"))
        return 0 if words else 2
    if words[0] in ("-V", "--version"):
        print(__version__)
        return 0
    name, rest = words[0], words[1:]
    if name not in commands():
        return _unknown(name, commands(), "command", "mavquad --help")
    if name in PROGRAMS:
        program: Callable[[list[str]], int] = importlib.import_module(PROGRAMS[name][0]).main
        return program(rest)
    if name != "paper":
        return _run(importlib.import_module(f"tools.{name}"), f"mavquad {name}", rest)
    if not rest or rest[0] in ("-h", "--help"):
        print(_overview("mavquad paper NAME [OPTIONS]", papers(), "mavquad paper gsmo --seeds 1-5 --json"))
        return 0 if rest else 2
    if rest[0] not in papers():
        return _unknown(rest[0], papers(), "paper", "mavquad paper --help")
    module = importlib.import_module(f"tools.papers.{rest[0].replace('-', '_')}")
    return _run(module, f"mavquad paper {rest[0]}", rest[1:])


def _run(module: ModuleType, program: str, words: list[str]) -> int:
    parser = argparse.ArgumentParser(
        prog=program, description=module.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    module.add_arguments(parser)
    code: int = module.run(parser.parse_args(words))
    return code


def _overview(usage: str, entries: dict[str, str], example: str) -> str:
    width = max(len(name) for name in entries) if entries else 0
    lines = [f"  {name:{width}}  {line}" for name, line in entries.items()]
    return "\n".join([f"usage: {usage}", "", *lines, "", f"Each takes --help. Example: {example}"])


def _unknown(name: str, known: dict[str, str], what: str, help_command: str) -> int:
    near = difflib.get_close_matches(name, known, n=1)
    hint = f'did you mean "{near[0]}"?' if near else f"known: {', '.join(known)}"
    print(f"mavquad: no {what} is called {name!r}; {hint} ({help_command})", file=sys.stderr)
    return 2


def _first_line(path: Path) -> str:
    with path.open(encoding="utf-8") as stream:
        line = stream.readline().strip()
    return line.removeprefix('"""').removesuffix('"""').removesuffix(".") if line.startswith('"""') else ""


if __name__ == "__main__":
    raise SystemExit(main())
