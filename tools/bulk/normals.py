"""Standard normals as `numpy.random.default_rng` draws them, to the same bits, from a state that lies in a record.

PCG64 and the ziggurat are compiled into the flight: a call into numpy's own generator costs twice as much, and here a number that
nobody reads is passed over for half of what it costs to make. The tables are those that numba draws with.

Source: O'Neill 2014 (PCG XSL-RR 128/64); Doornik 2005 (ziggurat), as in numpy's distributions.c.
"""

import math
from typing import Any

import numpy as np
from numba.np.random._constants import fi_double, ki_double, wi_double, ziggurat_nor_inv_r, ziggurat_nor_r

from mavquad.jit import COMPILED, kernel

_MULTIPLIER = 0x2360ED051FC65DA44385DF649FCCF645
_WORD = (1 << 64) - 1
_ONE, _SIGN, _BYTE, _MANTISSA = np.uint64(1), np.uint64(8), np.uint64(0xFF), np.uint64((1 << 52) - 1)
_TURN, _HALF, _WIDTH, _ROUND = np.uint64(58), np.uint64(11), np.uint64(64), np.uint64(63)
_SIZE = np.uint64(9)
_UNIT = 1.0 / 9007199254740992.0


def words(generator: np.random.Generator) -> tuple[int, int, int, int]:
    """What a record keeps of a PCG64 generator: state and increment, high word first."""
    state = generator.bit_generator.state["state"]
    return state["state"] >> 64, state["state"] & _WORD, state["inc"] >> 64, state["inc"] & _WORD


def _step_uncompiled(hi: np.uint64, lo: np.uint64, inc_hi: np.uint64, inc_lo: np.uint64) -> tuple[np.uint64, np.uint64]:
    state = (int(hi) << 64 | int(lo)) * _MULTIPLIER + (int(inc_hi) << 64 | int(inc_lo))
    return np.uint64(state >> 64 & _WORD), np.uint64(state & _WORD)


def _compiled_step() -> Any:
    """The same as one product of 128 bits, which no Python that compiles has a word for."""
    from llvmlite import ir
    from numba.core import cgutils, types
    from numba.extending import intrinsic

    long, word = ir.IntType(128), ir.IntType(64)

    @intrinsic
    def step(context, hi, lo, inc_hi, inc_lo):  # type: ignore[no-untyped-def]
        def build(context, builder, signature, args):  # type: ignore[no-untyped-def]
            high_low, width = [builder.zext(x, long) for x in args], ir.Constant(long, 64)
            state = builder.or_(builder.shl(high_low[0], width), high_low[1])
            increment = builder.or_(builder.shl(high_low[2], width), high_low[3])
            state = builder.add(builder.mul(state, ir.Constant(long, _MULTIPLIER)), increment)
            return cgutils.pack_array(
                builder, [builder.trunc(builder.lshr(state, width), word), builder.trunc(state, word)], ty=word
            )

        return types.UniTuple(types.uint64, 2)(*[types.uint64] * 4), build

    return step


_step = _compiled_step() if COMPILED else _step_uncompiled


@kernel
def _raw(g):
    """(64 random bits, the state after them)."""
    hi, lo = _step(g[0], g[1], g[2], g[3])
    x, turn = hi ^ lo, hi >> _TURN
    return (x >> turn) | (x << ((_WIDTH - turn) & _ROUND)), (hi, lo, g[2], g[3])


@kernel
def _uniform(g):
    """0 <= x < 1 of 53 bits."""
    r, g = _raw(g)
    return np.float64(np.int64(r >> _HALF)) * _UNIT, g


@kernel
def _at_the_edge(g, layer, size, x):
    """(taken, the normal, the state after it) of a draw that is not inside its layer: one in a hundred."""
    if layer > 0:
        a, g = _uniform(g)
        return (fi_double[layer - 1] - fi_double[layer]) * a + fi_double[layer] < math.exp(-0.5 * x * x), x, g
    while True:
        a, g = _uniform(g)
        b, g = _uniform(g)
        beyond = -ziggurat_nor_inv_r * math.log1p(-a)
        y = -math.log1p(-b)
        if y + y > beyond * beyond:
            tail = ziggurat_nor_r + beyond
            return True, -tail if (size >> _SIGN) & _ONE else tail, g


@kernel
def _normal(g):
    """(a normal, the state after it). Short, so that the compiler lays it into the loops below."""
    while True:
        r, g = _raw(g)
        layer, size = np.int64(r & _BYTE), (r >> _SIZE) & _MANTISSA
        x = np.float64(np.int64(size)) * wi_double[layer]
        if (r >> _SIGN) & _ONE:
            x = -x
        if size < ki_double[layer]:
            return x, g
        taken, x, g = _at_the_edge(g, layer, size, x)
        if taken:
            return x, g


@kernel
def draw(noise, k, first, count):
    """The next `count` normals of generator k into noise.normals[first:]."""
    w = noise.generators
    g = (w[k, 0], w[k, 1], w[k, 2], w[k, 3])
    for i in range(count):
        x, g = _normal(g)
        noise.normals[first + i] = x
    w[k, 0], w[k, 1] = g[0], g[1]


@kernel
def skip(noise, k, count):
    """As `draw`, for nobody."""
    w = noise.generators
    g = (w[k, 0], w[k, 1], w[k, 2], w[k, 3])
    for _ in range(count):
        _, g = _normal(g)
    w[k, 0], w[k, 1] = g[0], g[1]
