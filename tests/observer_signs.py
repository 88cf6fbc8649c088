"""Turn every sign in the observer around, one at a time, and see that some test notices: make mutate.

Every +, -, unary minus, += and -= of the modules below is turned around in turn, in functions and in constants, and the fast tests
run uncompiled until the first of them fails. A mutant that outlives them all is listed, and the command ends with 1.

  NUMBA_DISABLE_JIT=1 python tests/observer_signs.py                       every mutant (about 10 minutes)
  NUMBA_DISABLE_JIT=1 python tests/observer_signs.py --every 40            a sample
  NUMBA_DISABLE_JIT=1 python tests/observer_signs.py --only lie.step_1     one function or one module
"""

import argparse
import ast
import importlib
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from _pytest.runner import runtestprotocol

ROOT = Path(__file__).resolve().parent.parent
MODULES = ("mavquad.quat", "mavquad.linalg", *(f"mavquad.estimate.{name}" for name in (
    "lie", "gsmo_relay", "gsmo_implicit", "gsmo_members", "gsmo_online", "gsmo_stream", "gsmo_core", "gsmo", "torque", "rate_filters",
)))  # fmt: skip
TESTS = ("test_gsmo_oracle.py", "test_gsmo_stream.py", "test_lie.py", "test_quat.py", "test_gsmo.py", "test_gsmo_online.py", "test_rate_filters.py")  # fmt: skip
NOT_OURS = ("linalg.symmetrize", "linalg.cholesky", "linalg.cholesky_solve")  # in a shared file, not used by the observer
SHORT_S = 3.0  # of CPU: a test that takes longer uncompiled is left to the compiled suite
GIVE_UP_S = 60.0  # of CPU: a mutant that runs longer than this hangs, which is noticed
TOO_LONG = "takes too long"

# Mutants that compute the same: (function, text, mutated text, why).
EQUIVALENT: dict[tuple[str, str, str], str] = {
    ("gsmo_core.pack_core", "k + 11", "k - 11"): "8 - 11 counted from the end is 8 + 11 of 22",
}
SWAP = {ast.Add: ast.Sub, ast.Sub: ast.Add}


class Mutant(NamedTuple):
    module: str
    where: str  # function, or "" for a constant of the module
    line: int
    text: str
    changed: str
    tree: ast.Module

    def name(self) -> str:
        short = self.module.rsplit(".", 1)[-1]
        return f"{short}.{self.where}" if self.where else short


def mutants(module: str) -> Iterator[Mutant]:
    """Every sign of a module, one at a time."""
    path = ROOT.joinpath(*module.split(".")).with_suffix(".py")
    source = path.read_text(encoding="utf-8")
    for at in range(len(list(_signs(ast.parse(source))))):
        tree = ast.parse(source)
        where, node = list(_signs(tree))[at]
        text = ast.unparse(node)
        if isinstance(node, ast.UnaryOp):
            node.op = ast.UAdd()
        else:
            node.op = SWAP[type(node.op)]()
        yield Mutant(module, where, node.lineno, text, ast.unparse(node), tree)


def _signs(tree: ast.Module) -> Iterator[tuple[str, ast.AST]]:
    for statement in tree.body:
        where = statement.name if isinstance(statement, ast.FunctionDef) else ""
        bodies = statement.body if isinstance(statement, ast.FunctionDef) else [statement]
        if not isinstance(statement, ast.FunctionDef | ast.Assign):
            continue
        for body in bodies:
            for node in ast.walk(body):
                swapped = isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in SWAP and not _is_text(node)
                if swapped or (isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub)):
                    yield where, node


def _is_text(node: ast.AST) -> bool:
    return any(
        isinstance(n, ast.JoinedStr) or (isinstance(n, ast.Constant) and isinstance(n.value, str)) for n in ast.walk(node)
    )


def apply(mutant: Mutant) -> None:
    """Into the running program: a function keeps its identity and gets new code, a constant is computed again."""
    module = importlib.import_module(mutant.module)
    code = compile(mutant.tree, mutant.module, "exec")
    if mutant.where:
        new = next(c for c in code.co_consts if getattr(c, "co_name", "") == mutant.where)
        vars(module)[mutant.where].__code__ = new
        return
    fresh = dict(vars(module))
    exec(code, fresh)
    for name, value in fresh.items():
        if name.isupper():
            setattr(module, name, value)


class Mutating:
    """Instead of pytest's own loop: once as they are, to see which tests are short, then once per mutant in a child process."""

    def __init__(self, chosen: list[Mutant]) -> None:
        self.chosen = chosen
        self.noticed = 0
        self.survivors: list[Mutant] = []

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        from hypothesis import Phase, settings  # after pytest has looked at it

        phases = [Phase.explicit, Phase.generate]  # the first failure is enough
        settings.register_profile("mutate", deadline=None, derandomize=True, max_examples=20, phases=phases)
        settings.load_profile("mutate")
        times: list[tuple[float, pytest.Item]] = []
        for item in session.items:
            begin = _cpu_s()
            killer = run(None, [item], SHORT_S)
            if killer not in (None, TOO_LONG):
                raise SystemExit(f"{item.nodeid} fails without any mutant: nothing to learn")
            if killer is None:
                times.append((_cpu_s() - begin, item))
        short = [item for _, item in sorted(times, key=lambda t: t[0])]
        print(f"{len(self.chosen)} mutants, {len(short)} of {len(session.items)} tests are short", file=sys.stderr, flush=True)
        for at, mutant in enumerate(self.chosen):
            killer = run(mutant, short, GIVE_UP_S)
            if killer is None:
                self.survivors.append(mutant)
            else:
                self.noticed += 1
                short.sort(key=lambda item: item.name != killer)  # stable: what noticed the last ones is asked first
            said = "SURVIVED" if killer is None else killer
            print(f"{at + 1:4} {mutant.name()}:{mutant.line}  {mutant.text}  ->  {mutant.changed}  {said}", flush=True)
        return True


def _cpu_s() -> float:
    return os.times().children_user + os.times().children_system


def _passes(item: pytest.Item) -> bool:
    return all(report.passed or report.skipped for report in runtestprotocol(item, log=False, nextitem=None))


def run(mutant: Mutant | None, items: list[pytest.Item], limit_s: float) -> str | None:
    """In a child process: the name of the first test that fails, TOO_LONG, or None."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        signal.setitimer(signal.ITIMER_PROF, limit_s)  # its default action ends the child
        if mutant is not None:
            apply(mutant)
        failed = next((item.name for item in items if not _passes(item)), "")
        os.write(write, failed.encode())
        os._exit(0)
    os.close(write)
    with os.fdopen(read, "rb") as pipe:
        name = pipe.read().decode()
    _, status = os.waitpid(child, 0)
    return name or (None if status == 0 else TOO_LONG)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", metavar="NAME", help="a module, or module.function (may be repeated)")
    parser.add_argument(
        "--tests", action="append", metavar="FILE", help="of tests/unit (may be repeated; default: all of the observer)"
    )
    parser.add_argument("--every", type=int, default=1, metavar="N", help="every Nth mutant only")
    args = parser.parse_args(argv)
    if os.environ.get("NUMBA_DISABLE_JIT", "0") in ("", "0"):
        print("compiled code cannot be changed while it runs: set NUMBA_DISABLE_JIT=1", file=sys.stderr)
        return 2
    chosen = [m for module in MODULES for m in mutants(module) if not m.name().startswith(NOT_OURS)]
    if args.only:
        chosen = [m for m in chosen if any(m.name() == o or m.name().startswith(o + ".") for o in args.only)]
    argued = [m for m in chosen if (m.name(), m.text, m.changed) in EQUIVALENT]
    chosen = [m for m in chosen if m not in argued][:: args.every]
    loop = Mutating(chosen)
    tests = [str(ROOT / "tests" / "unit" / name) for name in args.tests or TESTS]
    status = pytest.main(["-m", "not slow", "-p", "no:cacheprovider", "-o", "timeout=0", "--no-header", f"--rootdir={ROOT}", *tests], [loop])  # fmt: skip
    print(f"{len(chosen)} mutants, {loop.noticed} noticed, {len(argued)} compute the same")
    for mutant in loop.survivors:
        print(f"SURVIVED {mutant.name()}:{mutant.line}  {mutant.text}  ->  {mutant.changed}")
    return 0 if status == 0 and loop.noticed == len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main())
