"""Explicit SIMD for Numba: a vector of float32 lanes, lowered to LLVM's `<LANES x float>`.

It has 16 lanes where the kernels are compiled for AVX-512, else 8, which LLVM legalises to what
the host has (AVX2, two SSE or NEON registers). Arithmetic works lane by lane and takes a number
in place of either vector; comparisons give a mask for `select`.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite.binding
import llvmlite.ir as ir
import numba
from numba.core import cgutils, extending, types
from numba.core import config as numba_config
from numba.core.extending import models, register_model
from numba.core.imputils import lower_builtin
from numba.core.typing import templates
from numba.core.typing.templates import AbstractTemplate, signature

_config: Any = numba_config  # its attributes are made at import


def _has_avx512() -> bool:
    """Whether Numba compiles for AVX-512: its settings may name another processor than the host."""
    if _config.CPU_FEATURES is not None:
        return "+avx512f" in _config.CPU_FEATURES
    host = llvmlite.binding.get_host_cpu_features()
    return _config.CPU_NAME is None and host.get("avx512f", False)


LANES = 16 if _has_avx512() else 8
STRIP_COLUMNS = 8  # a vector covers this many columns of as many rows as it has lanes for
STRIP_ROWS = LANES // STRIP_COLUMNS

# Decorators that replace a function by another kind of object, which Numba's stubs do not say.
intrinsic: Any = extending.intrinsic
infer_global: Any = templates.infer_global
_njit: Any = numba.njit

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
floats_ir = ir.VectorType(_FLOAT, LANES)
_INTS = ir.VectorType(_INT32, LANES)
_BITS = ir.VectorType(ir.IntType(1), LANES)


def kernel(function: Callable) -> Any:
    """Compile a function that Python calls; it runs without the interpreter lock.

    The code is cached on disk, and renewed when any file of kernels changes: Numba's own stamp
    would not see a change in what the function inlines.
    """
    dispatcher: Any = _njit(cache=True, **_OPTIONS)(function)
    cache_file = dispatcher._cache._cache_file
    cache_file._source_stamp = (cache_file._source_stamp, _newest_source_ns())
    return dispatcher


@cache
def _newest_source_ns() -> int:
    patterns = "rasterizer/*.py", "*_kernels*.py", "lane_*.py"
    files = (file for each in patterns for file in Path(__file__).parents[1].glob(each))
    return max(file.stat().st_mtime_ns for file in files)


def inlined(function: Callable) -> Any:
    """Compile a function that only kernels call; it vanishes into its caller.

    It must not create or return arrays: it counts no references, which cost more than the loop.
    """
    return _njit(forceinline=True, _nrt=False, **_OPTIONS)(function)


def allocating(function: Callable) -> Any:
    """Like `inlined`, for functions that create or return arrays."""
    return _njit(forceinline=True, **_OPTIONS)(function)


def reproducible(function: Callable) -> Any:
    """Like `inlined`, but without fast mathematics: the same bits wherever it ends up."""
    return _njit(forceinline=True, _nrt=False, **{**_OPTIONS, "fastmath": False})(function)


class FloatsType(types.Type):
    """The Numba type of LANES float32 numbers."""

    def __init__(self) -> None:
        super().__init__(f"floats{LANES}")


class MaskType(types.Type):
    """The Numba type of LANES truth values."""

    def __init__(self) -> None:
        super().__init__(f"mask{LANES}")


floats = FloatsType()
mask = MaskType()


@register_model(FloatsType)
class _FloatsModel(models.PrimitiveModel):
    def __init__(self, manager, numba_type) -> None:
        super().__init__(manager, numba_type, floats_ir)


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager, numba_type) -> None:
        super().__init__(manager, numba_type, _BITS)


def _constant(numba_type: ir.Type, values: Any) -> ir.Constant:
    return ir.Constant(numba_type, values)


def shuffle(builder, x, y, order: list[int]):
    return builder.shuffle_vector(x, y, _constant(ir.VectorType(_INT32, len(order)), order))


def _as_floats(context, builder, numba_type, value):
    """The value itself when it is a vector, else the number in every lane."""
    if isinstance(numba_type, FloatsType):
        return value
    undefined = _constant(floats_ir, ir.Undefined)
    number = context.cast(builder, value, numba_type, types.float32)
    return shuffle(
        builder, builder.insert_element(undefined, number, _INT32(0)), undefined, [0] * LANES
    )


def _pair(context, builder, sig, args):
    """Both operands of a binary operation as vectors."""
    return tuple(_as_floats(context, builder, t, a) for t, a in zip(sig.args, args, strict=True))


def _is_binary(args) -> bool:
    return (
        len(args) == 2
        and any(isinstance(a, FloatsType) for a in args)
        and all(isinstance(a, FloatsType | types.Number) for a in args)
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
        (FloatsType, FloatsType),
        (FloatsType, types.Number),
        (types.Number, FloatsType),
    ):
        lower_builtin(operation, left, right)(lower)


def _arithmetic(name: str) -> Callable:
    return lambda builder, x, y: getattr(builder, name)(x, y, flags=FAST_MATH)


def _comparison(sign: str) -> Callable:
    return lambda builder, x, y: builder.fcmp_ordered(sign, x, y)


_define_binary(operator.add, floats, _arithmetic("fadd"))
_define_binary(operator.sub, floats, _arithmetic("fsub"))
_define_binary(operator.mul, floats, _arithmetic("fmul"))
_define_binary(operator.truediv, floats, _arithmetic("fdiv"))
_define_binary(operator.ge, mask, _comparison(">="))
_define_binary(operator.gt, mask, _comparison(">"))
_define_binary(operator.lt, mask, _comparison("<"))
_define_binary(operator.le, mask, _comparison("<="))


@infer_global(operator.and_)
class _MaskAnd(AbstractTemplate):
    def generic(self, args, kws):
        masks = len(args) == 2 and all(isinstance(a, MaskType) for a in args)
        return signature(mask, *args) if masks else None


lower_builtin(operator.and_, MaskType, MaskType)(
    lambda context, builder, sig, args: builder.and_(*args)
)


@intrinsic
def splat(typing_context, number):
    """The number in every lane."""

    def generate(context, builder, sig, args):
        return _as_floats(context, builder, sig.args[0], args[0])

    return floats(number), generate


def fixed(numbers):
    """Signature and code of a constant vector."""
    values = [float(number) for number in numbers]
    return floats(), lambda context, builder, sig, args: _constant(floats_ir, values)


@intrinsic
def select(typing_context, mask, chosen, otherwise):
    """`chosen` in the lanes where the mask holds, `otherwise` in the others."""

    def generate(context, builder, sig, args):
        x = _as_floats(context, builder, sig.args[1], args[1])
        y = _as_floats(context, builder, sig.args[2], args[2])
        return builder.select(args[0], x, y)

    return floats(mask, chosen, otherwise), generate


def _chosen(sign: str) -> Callable:
    """Code for the operand that stands in this relation to the other; the second for NaN."""

    def generate(context, builder, sig, args):
        left, right = _pair(context, builder, sig, args)
        return builder.select(builder.fcmp_ordered(sign, left, right), left, right)

    return generate


@intrinsic
def minimum(typing_context, x, y):
    """The lesser of both, lane by lane; `y` where one of them is NaN."""
    return floats(x, y), _chosen("<")


@intrinsic
def maximum(typing_context, x, y):
    """The greater of both, lane by lane; `y` where one of them is NaN."""
    return floats(x, y), _chosen(">")


@intrinsic
def negative_magnitude(typing_context, x):
    """`-abs(x)`: sets the sign bit."""

    def generate(context, builder, sig, args):
        signs = _constant(_INTS, [0x80000000] * LANES)
        return builder.bitcast(builder.or_(builder.bitcast(args[0], _INTS), signs), floats_ir)

    return floats(x), generate


@intrinsic
def magnitude(typing_context, x):
    """`abs(x)`: clears the sign bit."""

    def generate(context, builder, sig, args):
        others = _constant(_INTS, [0x7FFFFFFF] * LANES)
        return builder.bitcast(builder.and_(builder.bitcast(args[0], _INTS), others), floats_ir)

    return floats(x), generate


def by_llvm(name: str) -> Callable:
    """Code that applies an LLVM function to every lane."""

    def generate(context, builder, sig, args):
        kind = ir.FunctionType(floats_ir, [floats_ir])
        full = f"llvm.{name}.v{LANES}f32"
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, full), args)

    return generate


@intrinsic
def square_root(typing_context, x):
    """The square root of every lane."""
    return floats(x), by_llvm("sqrt")
