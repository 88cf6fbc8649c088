"""The one numba decorator, `@kernel`.

Kernels are scalar Python: short vectors as tuples of floats, arrays for matrices, NamedTuples for state. The same source
runs uncompiled with NUMBA_DISABLE_JIT=1, the only environment variable read below a shell.

numba's own cache misses an edit in an imported kernel and runs the old one; so the cache folder is keyed by a hash of every
source that holds a kernel.
"""

import hashlib
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

COMPILED = os.environ.get("NUMBA_DISABLE_JIT", "0") in ("", "0")

_F = TypeVar("_F", bound=Callable[..., Any])
_PACKAGES = ("mavquad", "sitl", "tools")


def source_hash() -> str:
    """A hash of all sources that hold a kernel."""
    root = Path(__file__).resolve().parent.parent
    digest = hashlib.sha256(numba.__version__.encode())
    for package in _PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            text = path.read_bytes()
            if b"@kernel" in text:
                digest.update(path.relative_to(root).as_posix().encode())
                digest.update(text)
    return digest.hexdigest()[:16]


def cache_folder() -> Path:
    """Where compiled kernels lie: in the environment itself, else in the user's cache, else in a temporary folder."""
    key = source_hash()
    for base in (Path(sys.prefix) / "share", Path.home() / ".cache", Path(tempfile.gettempdir())):
        folder = base / "mavquad" / "kernels" / key
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    raise OSError("no writable folder for compiled kernels: tried the environment, the home and the temporary folder")


if COMPILED:
    CACHE_FOLDER = cache_folder()
    numba.config.CACHE_DIR = str(CACHE_FOLDER)  # type: ignore[attr-defined]


def kernel(function: _F) -> _F:
    """Compile a scalar function: cached, numpy's error model (x/0 is inf, never an exception), no fastmath."""
    if not COMPILED:
        return function
    return cast(_F, numba.njit(cache=True, error_model="numpy")(function))
