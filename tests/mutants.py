"""Mutation testing: each comparison, sign, operator, constant and condition of a module changed alone; do its tests notice?

  NUMBA_DISABLE_JIT=1 python -m tests.mutants mavquad.setpoint.limits tests/unit/test_setpoint.py tests/unit/test_limits_exactly.py

Every mutant runs the tests in a forked child, as plain Python. Prints the survivors, and on stderr how far it is; exit 1 where
there are any.
"""

import ast
import copy
import importlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest  # before the forks

COMPARE = {ast.Lt: ast.GtE, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.GtE: ast.Lt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq}
BINARY = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.BitOr: ast.BitAnd}
BOOLEAN = {ast.And: ast.Or, ast.Or: ast.And}


def mutants(tree: ast.Module) -> Iterator[tuple[int, str, ast.Module]]:
    """(line, what was changed, the changed tree), one change each."""
    for at, node in enumerate(ast.walk(tree)):
        for what, change in _changes(node):
            other = copy.deepcopy(tree)
            target = next(n for i, n in enumerate(ast.walk(other)) if i == at)
            change(target)
            yield getattr(node, "lineno", 0), what, ast.fix_missing_locations(other)


def _changes(node):
    if isinstance(node, ast.Compare):
        for i, op in enumerate(node.ops):
            if type(op) in COMPARE:
                new = COMPARE[type(op)]
                yield f"{type(op).__name__} -> {new.__name__}", lambda n, i=i, new=new: n.ops.__setitem__(i, new())
    elif isinstance(node, ast.BinOp) and type(node.op) in BINARY:
        new = BINARY[type(node.op)]
        yield f"{type(node.op).__name__} -> {new.__name__}", lambda n: setattr(n, "op", new())
    elif isinstance(node, ast.AugAssign) and type(node.op) in BINARY:
        new = BINARY[type(node.op)]
        yield f"{type(node.op).__name__}= -> {new.__name__}=", lambda n: setattr(n, "op", new())
    elif isinstance(node, ast.BoolOp):
        new = BOOLEAN[type(node.op)]
        yield f"{type(node.op).__name__} -> {new.__name__}", lambda n: setattr(n, "op", new())
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
        plus = isinstance(node.op, ast.USub)
        yield ("- dropped" if plus else "not dropped"), lambda n: setattr(n, "op", ast.UAdd() if plus else _Twice())
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
        for value in (node.value + 1, node.value * 0.9) if isinstance(node.value, float) and node.value else (node.value + 1,):
            yield f"{node.value} -> {value:g}", lambda n, value=value: setattr(n, "value", value)


class _Twice(ast.Invert):
    """A mark: `not x` becomes `x` when unparsed."""


def source(tree: ast.Module) -> str:
    """The code of a mutant."""

    class Drop(ast.NodeTransformer):
        def visit_UnaryOp(self, node):
            self.generic_visit(node)
            return node.operand if isinstance(node.op, _Twice) else node

    return ast.unparse(ast.fix_missing_locations(Drop().visit(tree)))


def survives(name: str, code: str, tests: list[str]) -> bool:
    """Whether the tests pass with the module's code replaced, in a child of their own."""
    child = os.fork()
    if child:
        return os.waitpid(child, 0)[1] == 0
    status = 1
    try:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
        module = importlib.import_module(name)
        exec(compile(code, str(module.__file__), "exec"), module.__dict__)
        status = int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", "-p", "no:randomly", *tests]))
    except BaseException:
        status = 1
    finally:
        os._exit(status)


def main(argv: list[str]) -> int:
    """Every mutant of a module against its tests."""
    if os.environ.get("NUMBA_DISABLE_JIT") != "1":
        print("set NUMBA_DISABLE_JIT=1: a mutant must not meet compiled code", file=sys.stderr)
        return 2
    name, tests = argv[0], argv[1:]
    module = importlib.import_module(name)
    text = Path(str(module.__file__)).read_text(encoding="utf-8")
    lines, file = text.splitlines(), Path(str(module.__file__)).name
    if not survives(name, text, tests):
        print("the tests fail without a change", file=sys.stderr)
        return 2
    changed = list(mutants(ast.parse(text)))
    total, alive = len(changed), 0
    for at, (line, what, tree) in enumerate(changed, 1):
        print(f"{at} of {total}, {alive} survived", end="\r", file=sys.stderr, flush=True)
        if survives(name, source(tree), tests):
            alive += 1
            print(f"{file}:{line}: {what}: {lines[line - 1].strip()}", flush=True)
    print(f"{total} mutants, {total - alive} found, {alive} survived")
    return 1 if alive or not total else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
