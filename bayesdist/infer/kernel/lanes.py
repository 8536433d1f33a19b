"""SIMD vectors as a number type for numba, to process several stars at a time.

`Lanes` hold the doubles of one SIMD vector, or of four, and support arithmetic like a single
number.  Loops over them are vectorised as written and do not rely on the compiler's analysis of
arrays.  There is no remainder loop, since scratch arrays are padded to whole vectors
(`blocks.scratch`).  Four vectors are needed to hide the latency of a chain of multiply-adds.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba import config, types
from numba.core import cgutils, typing
from numba.core.codegen import get_host_cpu_features
from numba.core.errors import TypingError
from numba.core.typing.templates import AbstractTemplate, infer_global
from numba.extending import intrinsic, lower_builtin, models, register_model

# allows fused multiply-adds; excludes flags that would change NaN or infinity
FAST = {"contract", "nsz", "arcp"}
FLAGS = tuple(sorted(FAST))
# options of functions that are called from compiled functions only
INNER: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}

_FEATURES = get_host_cpu_features() if config.CPU_FEATURES is None else config.CPU_FEATURES
HAS_512 = "+avx512f" in _FEATURES.split(",") and config.CPU_NAME is None
WIDTH = 8 if HAS_512 else 4
WIDE = 4 * WIDTH
ROWS = 3  # rows of a tile of sums
AT_MOST = 6 if HAS_512 else 4  # maximum number of columns of a tile, so that it fits in registers

Build = Callable[[Any, Any, Any, Any], Any]  # (context, builder, signature, arguments)


class Lanes(types.Type):
    """Numba type of `width` numbers in SIMD vectors."""

    def __init__(self, width: int, element: Any = types.float64) -> None:
        self.width, self.element = width, element
        super().__init__(name=f"Lanes({width}, {element})")


def _vector(width: int, element: Any = types.float64) -> Any:
    scalar = ir.DoubleType() if element == types.float64 else ir.IntType(64)
    return ir.VectorType(scalar, width)


@register_model(Lanes)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, lanes: Lanes) -> None:
        super().__init__(manager, lanes, _vector(lanes.width, lanes.element))


def _order(numbers: Sequence[int]) -> Any:
    """Constant index operand of a shuffle."""
    return ir.Constant(ir.VectorType(ir.IntType(32), len(numbers)), list(numbers))


def _all_alike(builder: Any, value: Any, width: int) -> Any:
    vector = ir.Constant(ir.VectorType(value.type, width), ir.Undefined)
    inserted = builder.insert_element(vector, value, cgutils.int32_t(0))
    return builder.shuffle_vector(inserted, inserted, _order([0] * width))


def _as_lanes(builder: Any, signature: Any, values: Any) -> list[Any]:
    """Operands as vectors; scalars are copied to all lanes."""
    width = signature.return_type.width
    return [
        value if isinstance(kind, Lanes) else _all_alike(builder, value, width)
        for value, kind in zip(values, signature.args, strict=True)
    ]


# -- operators between lanes, or between lanes and a scalar ----------------------------------------


def _define(operation: Callable[..., Any], on_doubles: str, on_integers: str) -> None:
    @infer_global(operation)
    class _Typing(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            lanes = [a for a in args if isinstance(a, Lanes)]
            if not lanes:
                return None
            return typing.signature(
                lanes[0], *(a if isinstance(a, Lanes) else lanes[0].element for a in args)
            )

    def lower(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        a, b = _as_lanes(builder, signature, values)
        if signature.return_type.element == types.float64:
            return getattr(builder, on_doubles)(a, b, flags=FLAGS)
        return getattr(builder, on_integers)(a, b)

    for kinds in ((Lanes, Lanes), (Lanes, types.Number), (types.Number, Lanes)):
        lower_builtin(operation, *kinds)(lower)


_define(operator.add, "fadd", "add")
_define(operator.iadd, "fadd", "add")
_define(operator.sub, "fsub", "sub")
_define(operator.mul, "fmul", "mul")
_define(operator.truediv, "fdiv", "sdiv")
for _operation, _name in (
    (operator.and_, "and_"),
    (operator.or_, "or_"),
    (operator.lshift, "shl"),
    (operator.rshift, "ashr"),
):
    _define(_operation, _name, _name)


# -- loads and stores ------------------------------------------------------------------------------


# Arrays are accessed without views of their rows, since these would dominate the compilation time.


def _start(context: Any, builder: Any, kind: Any, array: Any) -> Any:
    return context.make_array(kind)(context, builder, array).data


def _element(context: Any, builder: Any, kind: Any, array: Any, k: Any, index: Any) -> Any:
    """Pointer to an element of row k of an array (rows, n)."""
    parts = context.make_array(kind)(context, builder, array)
    row = builder.mul(k, builder.extract_value(parts.shape, 1))
    return builder.gep(parts.data, [builder.add(row, index)])


def _lanes_at(builder: Any, start: Any, index: Any, width: int) -> Any:
    """Pointer to `width` doubles starting at an index."""
    return builder.bitcast(builder.gep(start, [index]), _vector(width).as_pointer())


def _loading(width: int) -> Any:
    @intrinsic
    def loading(typingctx: Any, array: Any, k: Any, index: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            element = _element(context, builder, signature.args[0], *values)
            return builder.load(builder.bitcast(element, _vector(width).as_pointer()), align=8)

        return Lanes(width)(_rows(array), types.intp, types.intp), build

    return loading


def _rows(array: Any, ndim: int = 2) -> Any:
    """Return the type of a C-contiguous float64 array; raise TypingError for any other type."""
    if not (array.layout == "C" and array.dtype == types.float64 and array.ndim == ndim):
        raise TypingError(f"{array} is not a C array of float64 with {ndim} dimensions")
    return array


# load lanes from row k of an array (rows, n), starting at an index
load, load_wide = _loading(WIDTH), _loading(WIDE)


@intrinsic
def put(typingctx: Any, array: Any, k: Any, index: Any, lanes: Any) -> Any:
    """Store lanes in row k of an array (rows, n), starting at an index."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        element = _element(context, builder, signature.args[0], *values[:3])
        vector = context.get_value_type(signature.args[3]).as_pointer()
        builder.store(values[3], builder.bitcast(element, vector), align=8)
        return context.get_dummy_value()

    return types.none(_rows(array), types.intp, types.intp, lanes), build


@intrinsic
def copy(typingctx: Any, column: Any, first: Any, n: Any, array: Any, k: Any) -> Any:
    """Copy n numbers of a column (N,), starting at index `first`, to row k of an array."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        column, first, n, array, k = values
        source = builder.gep(_start(context, builder, signature.args[0], column), [first])
        zero = context.get_constant(types.intp, 0)
        row = _element(context, builder, signature.args[3], array, k, zero)
        cgutils.raw_memcpy(builder, row, source, n, 8)
        return context.get_dummy_value()

    integer = types.intp
    return types.none(_rows(column, 1), integer, integer, _rows(array), integer), build


@intrinsic
def near_inverse_root(typingctx: Any, x: Any) -> Any:
    """1 / sqrt(x) of lanes by an AVX-512 instruction, with a relative error of up to 6e-5."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        vector, mask = _vector(WIDTH), ir.IntType(8)
        kind = ir.FunctionType(vector, [vector, vector, mask])
        root = builder.module.declare_intrinsic("llvm.x86.avx512.rsqrt14.pd.512", (), kind)
        return builder.call(root, [values[0], vector(ir.Undefined), mask(255)])

    return x(x), build


# -- selection, also for scalars -------------------------------------------------------------------


def _choosing(relation: str) -> Any:
    @intrinsic
    def one_of_two(typingctx: Any, a: Any, b: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            if isinstance(signature.return_type, Lanes):
                values = _as_lanes(builder, signature, values)
            return builder.select(builder.fcmp_ordered(relation, *values), *values)

        second = b if isinstance(b, Lanes) else types.float64
        return a(a, second), build

    return one_of_two


smaller, larger = _choosing("<"), _choosing(">")  # minimum and maximum of a and b in each lane


@intrinsic
def choose(typingctx: Any, a: Any, b: Any, x: Any, y: Any) -> Any:
    """Select x in lanes where a <= b, otherwise y."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        a, b, x, y = _as_lanes(builder, signature, values)
        return builder.select(builder.fcmp_ordered("<=", a, b), x, y)

    lanes = next(kind for kind in (a, b, x, y) if isinstance(kind, Lanes))
    operands = [kind if isinstance(kind, Lanes) else types.float64 for kind in (a, b, x, y)]
    return lanes(*operands), build


@intrinsic
def first_lanes(typingctx: Any, n: Any, x: Any, y: Any) -> Any:
    """Select x in the first n lanes and y in the others."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        n, x, y = _as_lanes(builder, signature, values)
        width = signature.return_type.width
        numbers = ir.Constant(_vector(width, types.int64), list(range(width)))
        return builder.select(builder.icmp_signed("<", numbers, n), x, y)

    second = y if isinstance(y, Lanes) else types.float64
    return x(types.int64, x, second), build


@intrinsic
def spread(typingctx: Any, value: Any, like: Any) -> Any:
    """Copy a number to all lanes; the number of lanes is that of `like`."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return _all_alike(builder, values[0], signature.return_type.width)

    element = types.int64 if isinstance(value, types.Integer) else types.float64
    return Lanes(like.width, element)(element, like), build


# -- reductions over lanes -------------------------------------------------------------------------


def _across(on_doubles: str, on_integers: str) -> Any:
    @intrinsic
    def across(typingctx: Any, lanes: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            (value,), width = values, signature.args[0].width
            name = on_doubles if signature.return_type == types.float64 else on_integers
            while width > 1:
                width //= 2
                low, high = (
                    builder.shuffle_vector(value, value, _order(range(k, k + width)))
                    for k in (0, width)
                )
                value = getattr(builder, name)(low, high)
            return builder.extract_element(value, cgutils.int32_t(0))

        return lanes.element(lanes), build

    return across


total, product = _across("fadd", "add"), _across("fmul", "mul")


def tile(columns: int, length: int) -> Any:
    """Make a function that adds sums over stars of weights times P_i Q_j to a tile.

    The function has the arguments (n, weights, g, P, i, Q, j, sums).  It sums over n stars for
    `ROWS` rows of weights, those of group g, and for `columns` values of j, starting at `j`.  Rows
    of the arrays have `length` numbers.  The sums, one per lane, are added to sums[g, i, j:] of
    shape (groups, T, T, ROWS, WIDTH); they stay in registers until all stars are processed.
    """

    @intrinsic
    def add(
        typingctx: Any, n: Any, weights: Any, g: Any, P: Any, i: Any, Q: Any, j: Any, sums: Any
    ) -> Any:
        def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            n, _, g, _, i, _, j, _ = values
            kinds = signature.args
            w_start, p_start, q_start, sums_start = (
                _start(context, builder, kinds[k], values[k]) for k in (1, 3, 5, 7)
            )

            def whole(k: int) -> Any:
                return context.get_constant(types.intp, k)

            def lanes(start: Any, row: Any, s: Any) -> Any:
                index = builder.add(builder.mul(row, whole(length)), s)
                return builder.load(_lanes_at(builder, start, index, WIDTH), align=8)

            first_weight = builder.mul(g, whole(ROWS))
            zero = ir.Constant(_vector(WIDTH), [0.0] * WIDTH)
            accumulators = [cgutils.alloca_once_value(builder, zero) for _ in range(columns * ROWS)]
            with cgutils.for_range_slice(builder, whole(0), n, whole(WIDTH)) as (s, _):
                p = lanes(p_start, i, s)
                rows = [builder.add(first_weight, whole(r)) for r in range(ROWS)]
                weighted = [builder.fmul(lanes(w_start, row, s), p) for row in rows]
                for c in range(columns):
                    q = lanes(q_start, builder.add(j, whole(c)), s)
                    for r in range(ROWS):
                        accumulator = accumulators[c * ROWS + r]
                        product = builder.fmul(weighted[r], q, flags=FLAGS)
                        builder.store(
                            builder.fadd(builder.load(accumulator), product, flags=FLAGS),
                            accumulator,
                        )
            wide = builder.extract_value(
                context.make_array(kinds[7])(context, builder, values[7]).shape, 1
            )
            first = builder.add(builder.mul(g, wide), i)
            first = builder.add(builder.mul(first, wide), j)
            first = builder.mul(first, whole(ROWS * WIDTH))
            for k, accumulator in enumerate(accumulators):
                index = builder.add(first, whole(k * WIDTH))
                target = _lanes_at(builder, sums_start, index, WIDTH)
                before = builder.load(target, align=8)
                builder.store(builder.fadd(before, builder.load(accumulator)), target, align=8)
            return context.get_dummy_value()

        whole = types.intp
        arrays = (_rows(weights), whole, _rows(P), whole, _rows(Q), whole, _rows(sums, 5))
        return types.none(whole, *arrays), build

    return add
