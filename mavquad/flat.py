"""A NamedTuple of numbers as one numpy record, which a kernel takes as one argument.

A call from Python into a kernel costs about 30 ns for every float of a nested tuple on the way in and 60 on the way out, a record
half a microsecond whatever is in it. Inside of a kernel both are read alike: `gains.filter.e[i]`. A state that comes out of one kernel and
goes into the next travels as bytes, `state.view(RECORD)[0]`: for a record numba would compare every field of both dtypes, 5 us a call.
"""

from typing import Any

import numpy as np

from mavquad.jit import kernel

_LEFT_OUT = (str, type(None))


def of(values: Any) -> np.ndarray:
    """The record (1,) of a NamedTuple: fields of numbers, tuples of numbers, arrays and further NamedTuples, under their names."""
    out = np.zeros(1, layout(values))
    fill(out[0], values)
    return out


def layout(values: Any) -> np.dtype:
    """The dtype of its record: integers and arrays of flags as i8, floats as f8, a flag as ?; text and None are left out."""
    fields = [
        (name, *_kind(value)) for name, value in zip(values._fields, values, strict=True) if not isinstance(value, _LEFT_OUT)
    ]
    return record(fields)


def record(fields: list[Any]) -> np.dtype:
    """A dtype whose items are read by name, `item.name`, also where nothing is compiled."""
    return np.dtype((np.record, fields))


def fill(item: Any, values: Any) -> None:
    """Write a NamedTuple into a record of its layout."""
    for name, value in zip(values._fields, values, strict=True):
        if isinstance(value, _LEFT_OUT):
            continue
        if hasattr(value, "_fields"):
            fill(item[name], value)
        else:
            item[name] = value


def _kind(value: Any) -> tuple[Any, ...]:
    if hasattr(value, "_fields"):
        return (layout(value),)
    a = np.asarray(value)
    code = {"b": "i8" if a.shape else "?", "i": "i8", "f": "f8"}[
        a.dtype.kind
    ]  # numba knows no arrays of flags inside of records
    return (code, a.shape) if a.shape else (code,)


@kernel
def vec3(a):
    """Three numbers of a record's field as a tuple."""
    return (a[0], a[1], a[2])


@kernel
def put3(to, v):
    """A vector into a record's field."""
    to[0], to[1], to[2] = v[0], v[1], v[2]
