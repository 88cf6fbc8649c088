"""Eight floats side by side in one register, as a type that kernels calculate with: the step functions of one vehicle, called with
these, move eight. Each lane rounds as a float alone does, so each vehicle's bits are its own.

`load` and `store` take them from and to a row of an (n, WIDTH) array. What branches by value (sines, logarithms, limits that give
way to each other) is done lane after lane from such rows.
"""

import math
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.core.imputils import lower_builtin, lower_cast
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, models, register_model
from numba.np.arrayobj import make_array

WIDTH = 8
_VECTOR = ir.VectorType(ir.DoubleType(), WIDTH)


class Lanes(types.Type):
    """The type; there is no value of it outside a kernel."""

    def __init__(self) -> None:
        super().__init__(name=f"Lanes{WIDTH}")


LANES = Lanes()


@register_model(Lanes)
class _Model(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


@lower_cast(types.Float, Lanes)
def _same_in_all(context: Any, builder: Any, source: Any, target: Any, value: Any) -> Any:
    double = context.cast(builder, value, source, types.float64)
    found = ir.Constant(_VECTOR, ir.Undefined)
    for k in range(WIDTH):
        found = builder.insert_element(found, double, ir.Constant(ir.IntType(32), k))
    return found


def _define(function: Any, inputs: int, emit: Callable[..., Any]) -> None:
    """Teach numba a function or operator of this many lanes or floats."""

    class Typing(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: tuple[Any, ...], kws: dict[str, Any]) -> Any:
            if len(args) == inputs and LANES in args and all(a == LANES or isinstance(a, types.Float) for a in args):
                return signature(LANES, *[LANES] * inputs)
            return None

    infer_global(function)(Typing)

    @lower_builtin(function, *[LANES] * inputs)
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return emit(builder, *args)


def _root(builder: Any, a: Any) -> Any:
    kind = ir.FunctionType(_VECTOR, [_VECTOR])
    name = f"llvm.sqrt.v{WIDTH}f64"
    found = builder.module.globals.get(name)
    return builder.call(found or ir.Function(builder.module, kind, name), [a])


_define(operator.add, 2, lambda builder, a, b: builder.fadd(a, b))
_define(operator.sub, 2, lambda builder, a, b: builder.fsub(a, b))
_define(operator.mul, 2, lambda builder, a, b: builder.fmul(a, b))
_define(operator.truediv, 2, lambda builder, a, b: builder.fdiv(a, b))
_define(operator.neg, 1, lambda builder, a: builder.fneg(a))
_define(min, 2, lambda builder, a, b: builder.select(builder.fcmp_ordered("<", b, a), b, a))  # as numba's own of two floats
_define(max, 2, lambda builder, a, b: builder.select(builder.fcmp_ordered(">", b, a), b, a))
_define(math.sqrt, 1, _root)


def _row(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    data = make_array(sig.args[0])(context, builder, args[0]).data
    row = context.cast(builder, args[1], sig.args[1], types.intp)
    first = builder.gep(data, [builder.mul(row, ir.Constant(row.type, WIDTH))])
    return builder.bitcast(first, _VECTOR.as_pointer())


@intrinsic
def load(typing_context: Any, rows: Any, row: Any) -> Any:
    """Lanes of one row of an (n, WIDTH) array."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        found = builder.load(_row(context, builder, sig, args))
        found.align = 8
        return found

    return LANES(rows, row), emit


@intrinsic
def store(typing_context: Any, rows: Any, row: Any, lanes: Any) -> Any:
    """Lanes into one row."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _row(context, builder, sig, args)).align = 8
        return context.get_dummy_value()

    return types.void(rows, row, LANES), emit


@intrinsic
def any_above(typing_context: Any, a: Any, b: Any) -> Any:
    """Whether some lane of a is greater than b's."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(builder.fcmp_ordered(">", *args), ir.IntType(WIDTH))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return types.boolean(LANES, LANES), emit
