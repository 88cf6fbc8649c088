"""The numba decorator, `@kernel` (for threads: `@kernel_for_threads`).

Kernels are scalar Python: short vectors as tuples of floats, arrays for matrices, NamedTuples for state. The same source
runs uncompiled with NUMBA_DISABLE_JIT=1, the only environment variable read below a shell.

numba's own cache misses an edit in an imported kernel and runs the old one; so the cache folder of a module's kernels is keyed by
a hash of its source and of all that it imports from this project, however indirectly.
"""

import functools
import hashlib
import importlib.metadata
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar, cast

COMPILED = os.environ.get("NUMBA_DISABLE_JIT", "0") in ("", "0")

_F = TypeVar("_F", bound=Callable[..., Any])
_ROOT = Path(__file__).resolve().parent.parent
_PACKAGES = ("mavquad", "sitl", "tools")
_IMPORT = re.compile(r"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)|import[ \t]+([\w.]+))", re.MULTILINE)


@functools.cache
def _source(module: str) -> bytes:
    """The source of a module of this project; b"" for a package without one, or where there is no such module."""
    base = _ROOT.joinpath(*module.split("."))
    for path in (base.with_suffix(".py"), base / "__init__.py"):
        if path.is_file():
            return path.read_bytes()
    return b""


@functools.cache
def _imports(module: str) -> frozenset[str]:
    """The modules of this project that a module names in its imports."""
    found = set()
    for source, names, plain in _IMPORT.findall(_source(module).decode()):
        if plain:
            found.add(plain)
            continue
        found.add(source)
        found.update(f"{source}.{name.split()[0]}" for name in names.strip("()").split(",") if name.split())
    return frozenset(name for name in found if name.split(".")[0] in _PACKAGES and _source(name))


def source_hash(modules: Iterable[str]) -> str:
    """A hash of the sources of these modules and of everything that they import from this project."""
    todo, seen = list(modules), set()
    while todo:
        module = todo.pop()
        if module not in seen:
            seen.add(module)
            todo.extend(_imports(module))
    digest = hashlib.sha256(importlib.metadata.version("numba").encode())
    for module in sorted(seen):
        digest.update(module.encode())
        digest.update(_source(module))
    return digest.hexdigest()[:16]


def kernel_modules() -> list[str]:
    """Every module of this project that holds a kernel."""
    paths = (
        path for package in _PACKAGES for path in sorted((_ROOT / package).rglob("*.py")) if b"@kernel" in path.read_bytes()
    )
    return [".".join(path.relative_to(_ROOT).with_suffix("").parts) for path in paths]


@functools.cache
def base_folder() -> Path:
    """Where compiled kernels lie: in the environment itself, else in the user's cache, else in a temporary folder."""
    for base in (Path(sys.prefix) / "share", Path.home() / ".cache", Path(tempfile.gettempdir())):
        folder = base / "mavquad" / "kernels"
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    raise OSError("no writable folder for compiled kernels: tried the environment, the home and the temporary folder")


@functools.cache
def _folder(module: str) -> str:
    return str(base_folder() / source_hash([module]))


def kernel(function: _F) -> _F:
    """Compile a scalar function: cached, numpy's error model (x/0 is inf, never an exception), no fastmath."""
    return _compiled(function, nogil=False)


def kernel_for_threads(function: _F) -> _F:
    """`kernel`, and other threads of Python run beside it: for work of milliseconds, which a thread does for a part of the data."""
    return _compiled(function, nogil=True)


def _compiled(function: _F, nogil: bool) -> _F:
    if not COMPILED:
        return function
    import numba  # half a second: only where a kernel is

    numba.config.CACHE_DIR = _folder(function.__module__)  # type: ignore[attr-defined]  # read by njit where it decorates
    return cast(_F, numba.njit(cache=True, error_model="numpy", nogil=nogil)(function))
