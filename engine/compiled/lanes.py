"""`<LANES x float>` in Numba: lets a kernel test whether any pixel of a row needs a computation.

Two types live here: lanes (LANES float32 values) and masks (LANES truth values). Kernels read and write lanes from flat
float32 arrays with `load` and `store`, compute with + - * /, compare with `at_least`, and choose with `select`.
"""

from __future__ import annotations

import operator
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir
from numba import extending
from numba.core import cgutils, types
from numba.extending import models, overload, register_model

LANES = 16 if llvm.get_host_cpu_features().get("avx512f") else 8
"""Pixels that are computed together; also the width of a tile."""

_FLOAT = ir.VectorType(ir.FloatType(), LANES)
_BOOL = ir.VectorType(ir.IntType(1), LANES)
_INT = ir.VectorType(ir.IntType(32), LANES)
_FAST = ("fast",)

intrinsic: Any = extending.intrinsic
"""Numba's builder functions, whose callers pass no typing context, which a type checker cannot follow."""


class LanesType(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"lanes{LANES}")


class MaskType(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"mask{LANES}")


lanes = LanesType()
mask = MaskType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: Any) -> None:
        super().__init__(manager, numba_type, _FLOAT)


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: Any) -> None:
        super().__init__(manager, numba_type, _BOOL)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_FLOAT, [float(np.float32(value))] * LANES)


def _integers(value: int) -> ir.Constant:
    return ir.Constant(_INT, [value] * LANES)


def _splat(builder: ir.IRBuilder, scalar: ir.Value) -> ir.Value:
    first = builder.insert_element(ir.Constant(_FLOAT, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, ir.Constant(_FLOAT, ir.Undefined), _integers(0))


def _pointer(context: Any, builder: ir.IRBuilder, array_type: Any, array: Any, index_type: Any, index: Any) -> ir.Value:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [context.cast(builder, index, index_type, types.intp)])


@intrinsic
def load(typing_context, array, index):  # type: ignore[no-untyped-def]
    """LANES values of a flat float32 array from `index` on."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        pointer = _pointer(context, builder, signature.args[0], arguments[0], signature.args[1], arguments[1])
        value = builder.load(builder.bitcast(pointer, _FLOAT.as_pointer()))
        value.align = 4
        return value

    return lanes(array, index), codegen


@intrinsic
def store(typing_context, array, index, value):  # type: ignore[no-untyped-def]
    """Write LANES values to a flat float32 array from `index` on."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        pointer = _pointer(context, builder, signature.args[0], arguments[0], signature.args[1], arguments[1])
        written = builder.store(arguments[2], builder.bitcast(pointer, _FLOAT.as_pointer()))
        written.align = 4
        return context.get_dummy_value()

    return types.void(array, index, lanes), codegen


@intrinsic
def fill(typing_context, scalar):  # type: ignore[no-untyped-def]
    """The same float32 in every lane."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return _splat(builder, arguments[0])

    return lanes(types.float32), codegen


@intrinsic
def ramp(typing_context):  # type: ignore[no-untyped-def]
    """0, 1, … LANES - 1."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return ir.Constant(_FLOAT, [float(lane) for lane in range(LANES)])

    return lanes(), codegen


def _binary(instruction: str) -> Any:
    @intrinsic
    def compute(typing_context, left, right):  # type: ignore[no-untyped-def]
        def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            return getattr(builder, instruction)(arguments[0], arguments[1], flags=_FAST)

        return lanes(lanes, lanes), codegen

    return compute


def _overload_operator(symbol: Any, compute: Any) -> None:
    """Lanes with lanes, and lanes with a float32 on either side."""

    @overload(symbol, inline="never")
    def choose(left, right):  # type: ignore[no-untyped-def]
        if left == lanes and right == lanes:
            return lambda left, right: compute(left, right)
        if left == lanes and isinstance(right, types.Float):
            return lambda left, right: compute(left, fill(np.float32(right)))
        if isinstance(left, types.Float) and right == lanes:
            return lambda left, right: compute(fill(np.float32(left)), right)
        return None


for _symbol, _instruction in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _overload_operator(_symbol, _binary(_instruction))


@intrinsic
def at_least(typing_context, left, right):  # type: ignore[no-untyped-def]
    """Mask of the lanes where left ≥ right (a float32)."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.fcmp_ordered(">=", arguments[0], _splat(builder, arguments[1]))

    return mask(lanes, types.float32), codegen


@intrinsic
def both(typing_context, left, right):  # type: ignore[no-untyped-def]
    """Mask of the lanes where both masks hold."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.and_(arguments[0], arguments[1])

    return mask(mask, mask), codegen


@intrinsic
def anywhere(typing_context, condition):  # type: ignore[no-untyped-def]
    """Whether the mask holds in any lane."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        bits = builder.bitcast(arguments[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(mask), codegen


@intrinsic
def select(typing_context, condition, chosen, otherwise):  # type: ignore[no-untyped-def]
    """`chosen` where the mask holds, `otherwise` elsewhere."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.select(*arguments)

    return lanes(mask, lanes, lanes), codegen


@intrinsic
def at_most(typing_context, value, limit):  # type: ignore[no-untyped-def]
    """The smaller of each lane and `limit` (a float32)."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        limits = _splat(builder, arguments[1])
        return builder.select(builder.fcmp_ordered("<", arguments[0], limits), arguments[0], limits)

    return lanes(lanes, types.float32), codegen


@intrinsic
def total(typing_context, value):  # type: ignore[no-untyped-def]
    """Sum of all lanes, always added in the same order: halves to halves."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        value, width = arguments[0], LANES
        while width > 1:
            width //= 2
            narrow = ir.VectorType(ir.IntType(32), width)
            low = builder.shuffle_vector(value, value, ir.Constant(narrow, list(range(width))))
            high = builder.shuffle_vector(value, value, ir.Constant(narrow, list(range(width, 2 * width))))
            value = builder.fadd(low, high)
        return builder.extract_element(value, ir.Constant(ir.IntType(32), 0))

    return types.float32(lanes), codegen


def _halves(width: int, high: bool) -> ir.Constant:
    """Which lanes of two vectors, each of segments of `width`, are the lower or upper halves of their segments."""
    half = width // 2
    lanes_ = [
        segment * width + (half if high else 0) + lane for segment in range(2 * LANES // width) for lane in range(half)
    ]
    return ir.Constant(ir.VectorType(ir.IntType(32), LANES), lanes_)


def _all_totals(builder: ir.IRBuilder, vectors: list[ir.Value]) -> ir.Value:
    """LANES vectors → one of their sums. Two are reduced to one at a time, halves to halves as in `total`."""
    width = LANES
    while width > 1:
        low, high = _halves(width, False), _halves(width, True)
        vectors = [
            builder.fadd(builder.shuffle_vector(left, right, low), builder.shuffle_vector(left, right, high))
            for left, right in zip(vectors[::2], vectors[1::2], strict=True)
        ]
        width //= 2
    return vectors[0]


@intrinsic
def store_totals(typing_context, array, index, a, b, c, d, e, f, g, h, i, j, k, l):  # type: ignore[no-untyped-def]  # noqa: E741
    """Write the sums of twelve vectors, and four zeros, to a flat float32 array from `index` on."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        pointer = _pointer(context, builder, signature.args[0], arguments[0], signature.args[1], arguments[1])
        vectors = [*arguments[2:], *[_constant(0.0)] * 4]
        for start in range(0, len(vectors), LANES):
            sums = _all_totals(builder, vectors[start : start + LANES])
            place = builder.gep(pointer, [ir.Constant(ir.IntType(64), start)])
            written = builder.store(sums, builder.bitcast(place, _FLOAT.as_pointer()))
            written.align = 4
        return context.get_dummy_value()

    return types.void(array, index, *[lanes] * 12), codegen


def _exp2_coefficients() -> list[float]:
    """Polynomial of degree 6 for 2^x on [-1/2, 1/2], highest power first (relative error below 1e-7)."""
    nodes = 0.5 * np.cos(np.pi * (np.arange(64) + 0.5) / 64)
    return [float(c) for c in np.polyfit(nodes, np.exp2(nodes), 6)]


@intrinsic
def exp2(typing_context, value):  # type: ignore[no-untyped-def]
    """2^value for values in [-100, 100]; lower ones count as -100."""
    coefficients = _exp2_coefficients()

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        floor = _constant(-100.0)
        value = builder.select(builder.fcmp_ordered(">", arguments[0], floor), arguments[0], floor)
        rint = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(_FLOAT, [_FLOAT]), f"llvm.rint.v{LANES}f32"
        )
        whole = builder.call(rint, [value])
        part = builder.fsub(value, whole)
        result = _constant(coefficients[0])
        for coefficient in coefficients[1:]:
            result = builder.fadd(builder.fmul(result, part, flags=_FAST), _constant(coefficient), flags=_FAST)
        exponent = builder.add(builder.fptosi(whole, _INT), _integers(127))
        power = builder.bitcast(builder.shl(exponent, _integers(23)), _FLOAT)
        return builder.fmul(result, power, flags=_FAST)

    return lanes(lanes), codegen


@intrinsic
def prefetch(typing_context, array, index):  # type: ignore[no-untyped-def]
    """Prefetch the cache line at `index` of a flat array."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        pointer = _pointer(context, builder, signature.args[0], arguments[0], signature.args[1], arguments[1])
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(ir.VoidType(), [byte, number, number, number]), "llvm.prefetch.p0"
        )
        hints = [ir.Constant(number, value) for value in (0, 3, 1)]  # read, keep, data
        builder.call(function, [builder.bitcast(pointer, byte), *hints])
        return context.get_dummy_value()

    return types.void(array, index), codegen


@intrinsic
def take(typing_context, counter):  # type: ignore[no-untyped-def]
    """Give out 0, 1, 2, … from an int64 array of one element, each number to one thread only."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        return builder.atomic_rmw("add", data, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(counter), codegen
