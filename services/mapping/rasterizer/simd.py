"""Explicit SIMD for Numba: a vector of 8 float32 lanes, lowered to LLVM's `<8 x float>`.

LLVM legalises it to what the host has (AVX-512VL, AVX2, two SSE or NEON registers). Arithmetic
works lane by lane and takes a number in place of either vector; comparisons give a mask for
`select`.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite.ir as ir
from numba import njit
from numba.core import cgutils, extending, types
from numba.core.extending import models, register_model
from numba.core.imputils import lower_builtin
from numba.core.typing import templates
from numba.core.typing.templates import AbstractTemplate, signature

LANES = 8

# Decorators that replace a function by another kind of object, which Numba's stubs do not say.
intrinsic: Any = extending.intrinsic
infer_global: Any = templates.infer_global

# No "nnan" and "ninf": lanes outside an ellipse may overflow, and a select drops them.
FAST_MATH = ("contract", "reassoc", "nsz", "arcp")
_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "fastmath": set(FAST_MATH),
    "error_model": "numpy",
    "boundscheck": False,
}

_FLOAT = ir.FloatType()
_INT32 = ir.IntType(32)
float8_ir = ir.VectorType(_FLOAT, LANES)
_INTS = ir.VectorType(_INT32, LANES)
_BITS = ir.VectorType(ir.IntType(1), LANES)


def kernel(function: Callable) -> Any:
    """Compile a function that Python calls; it runs without the interpreter lock.

    The compiled code is cached on disk. Numba would renew it only when the function's own file
    changes, and not when what it inlines does: the stamp covers this whole folder.
    """
    dispatcher: Any = njit(cache=True, **_OPTIONS)(function)
    cache_file = dispatcher._cache._cache_file
    cache_file._source_stamp = (cache_file._source_stamp, _newest_source_ns())
    return dispatcher


@cache
def _newest_source_ns() -> int:
    return max(path.stat().st_mtime_ns for path in Path(__file__).parent.glob("*.py"))


def inlined(function: Callable) -> Any:
    """Compile a function that only kernels call; it vanishes into its caller."""
    return njit(forceinline=True, **_OPTIONS)(function)


class Float8Type(types.Type):
    """The Numba type of 8 float32 lanes."""

    def __init__(self) -> None:
        super().__init__("float8")


class Mask8Type(types.Type):
    """The Numba type of 8 truth values."""

    def __init__(self) -> None:
        super().__init__("mask8")


float8 = Float8Type()
mask8 = Mask8Type()


@register_model(Float8Type)
class _Float8Model(models.PrimitiveModel):
    def __init__(self, manager, numba_type) -> None:
        super().__init__(manager, numba_type, float8_ir)


@register_model(Mask8Type)
class _Mask8Model(models.PrimitiveModel):
    def __init__(self, manager, numba_type) -> None:
        super().__init__(manager, numba_type, _BITS)


def _constant(numba_type: ir.Type, values: Any) -> ir.Constant:
    return ir.Constant(numba_type, values)


def shuffle(builder, x, y, order: list[int]):
    return builder.shuffle_vector(x, y, _constant(_INTS, order))


def _as_float8(context, builder, numba_type, value):
    """The value itself when it is a vector, else the number in every lane."""
    if isinstance(numba_type, Float8Type):
        return value
    undefined = _constant(float8_ir, ir.Undefined)
    number = context.cast(builder, value, numba_type, types.float32)
    return shuffle(
        builder, builder.insert_element(undefined, number, _INT32(0)), undefined, [0] * LANES
    )


def _pair(context, builder, sig, args):
    """Both operands of a binary operation as vectors."""
    return tuple(_as_float8(context, builder, t, a) for t, a in zip(sig.args, args, strict=True))


def _is_binary(args) -> bool:
    return (
        len(args) == 2
        and any(isinstance(a, Float8Type) for a in args)
        and all(isinstance(a, Float8Type | types.Number) for a in args)
    )


def _define_binary(operation: Callable, result: types.Type, emit: Callable) -> None:
    """Teach Numba `operation` on vectors, and on a vector and a number."""

    @infer_global(operation)
    class _Typing(AbstractTemplate):
        def generic(self, args, kws):
            return signature(result, *args) if _is_binary(args) else None

    def lower(context, builder, sig, args):
        return emit(builder, *_pair(context, builder, sig, args))

    for left, right in (
        (Float8Type, Float8Type),
        (Float8Type, types.Number),
        (types.Number, Float8Type),
    ):
        lower_builtin(operation, left, right)(lower)


def _arithmetic(name: str) -> Callable:
    return lambda builder, x, y: getattr(builder, name)(x, y, flags=FAST_MATH)


def _comparison(sign: str) -> Callable:
    return lambda builder, x, y: builder.fcmp_ordered(sign, x, y)


_define_binary(operator.add, float8, _arithmetic("fadd"))
_define_binary(operator.sub, float8, _arithmetic("fsub"))
_define_binary(operator.mul, float8, _arithmetic("fmul"))
_define_binary(operator.truediv, float8, _arithmetic("fdiv"))
_define_binary(operator.ge, mask8, _comparison(">="))
_define_binary(operator.gt, mask8, _comparison(">"))
_define_binary(operator.lt, mask8, _comparison("<"))
_define_binary(operator.le, mask8, _comparison("<="))


@infer_global(operator.and_)
class _MaskAnd(AbstractTemplate):
    def generic(self, args, kws):
        masks = len(args) == 2 and all(isinstance(a, Mask8Type) for a in args)
        return signature(mask8, *args) if masks else None


lower_builtin(operator.and_, Mask8Type, Mask8Type)(
    lambda context, builder, sig, args: builder.and_(*args)
)


@intrinsic
def splat(typing_context, number):
    """The number in every lane."""

    def generate(context, builder, sig, args):
        return _as_float8(context, builder, sig.args[0], args[0])

    return float8(number), generate


@intrinsic
def ramp(typing_context):
    """The lanes 0, 1, ... 7."""
    return float8(), lambda context, builder, sig, args: _constant(
        float8_ir, [float(i) for i in range(LANES)]
    )


@intrinsic
def select(typing_context, mask, chosen, otherwise):
    """`chosen` in the lanes where the mask holds, `otherwise` in the others."""

    def generate(context, builder, sig, args):
        x = _as_float8(context, builder, sig.args[1], args[1])
        y = _as_float8(context, builder, sig.args[2], args[2])
        return builder.select(args[0], x, y)

    return float8(mask, chosen, otherwise), generate


@intrinsic
def minimum(typing_context, x, y):
    """The lesser of both, lane by lane; `y` where one of them is NaN."""

    def generate(context, builder, sig, args):
        left, right = _pair(context, builder, sig, args)
        return builder.select(builder.fcmp_ordered("<", left, right), left, right)

    return float8(x, y), generate


@intrinsic
def maximum(typing_context, x, y):
    """The greater of both, lane by lane; `y` where one of them is NaN."""

    def generate(context, builder, sig, args):
        left, right = _pair(context, builder, sig, args)
        return builder.select(builder.fcmp_ordered(">", left, right), left, right)

    return float8(x, y), generate


@intrinsic
def negative_magnitude(typing_context, x):
    """`-abs(x)`: sets the sign bit."""

    def generate(context, builder, sig, args):
        signs = _constant(_INTS, [0x80000000] * LANES)
        return builder.bitcast(builder.or_(builder.bitcast(args[0], _INTS), signs), float8_ir)

    return float8(x), generate


@intrinsic
def square_root(typing_context, x):
    """The square root of every lane."""

    def generate(context, builder, sig, args):
        kind = ir.FunctionType(float8_ir, [float8_ir])
        return builder.call(
            cgutils.get_or_insert_function(builder.module, kind, "llvm.sqrt.v8f32"), args
        )

    return float8(x), generate
