"""Stars side by side in the vectors of the processor, as a number type of compiled loops.

`Lanes` are as many doubles as one vector holds, or those of four vectors, and arithmetic works on
them as on one number.  A loop over them is compiled as it is written: it does not depend on what
the compiler finds out about arrays, and no second loop takes the stars that are left over, since
scratch arrays have room for whole vectors (`blocks.scratch`).  Four vectors are what a chain of
multiply-adds needs to keep the processor busy.
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

# sums of products may be fused; nothing that would change NaN or infinity
FAST = {"contract", "nsz", "arcp"}
FLAGS = tuple(sorted(FAST))
# how a function is compiled that only compiled ones call, which keep it as a part of theirs
INNER: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}

_FEATURES = get_host_cpu_features() if config.CPU_FEATURES is None else config.CPU_FEATURES
HAS_512 = "+avx512f" in _FEATURES.split(",") and config.CPU_NAME is None
WIDTH = 8 if HAS_512 else 4
WIDE = 4 * WIDTH
ROWS = 3  # of a tile
AT_MOST = 6 if HAS_512 else 4  # columns of a tile, so that its sums stay in registers

Build = Callable[[Any, Any, Any, Any], Any]  # (context, builder, signature, arguments)


class Lanes(types.Type):
    """Type of numbers side by side."""

    def __init__(self, width: int, element: Any = types.float64) -> None:
        self.width, self.element = width, element
        super().__init__(name=f"Lanes({width}, {element})")


def _vector(width: int, element: Any = types.float64) -> Any:
    one = ir.DoubleType() if element == types.float64 else ir.IntType(64)
    return ir.VectorType(one, width)


@register_model(Lanes)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, lanes: Lanes) -> None:
        super().__init__(manager, lanes, _vector(lanes.width, lanes.element))


def _order(numbers: Sequence[int]) -> Any:
    """Operand of a shuffle."""
    return ir.Constant(ir.VectorType(ir.IntType(32), len(numbers)), list(numbers))


def _all_alike(builder: Any, value: Any, width: int) -> Any:
    vector = ir.Constant(ir.VectorType(value.type, width), ir.Undefined)
    one = builder.insert_element(vector, value, cgutils.int32_t(0))
    return builder.shuffle_vector(one, one, _order([0] * width))


def _as_lanes(builder: Any, signature: Any, values: Any) -> list[Any]:
    """Operands, scalars among them in all lanes."""
    width = signature.return_type.width
    return [
        value if isinstance(kind, Lanes) else _all_alike(builder, value, width)
        for value, kind in zip(values, signature.args, strict=True)
    ]


# -- operators: of lanes with lanes, and with a scalar on either side ------------------------------


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


# -- to memory and back ----------------------------------------------------------------------------


# Arrays are written to and read from without views of their rows, whose compilation takes longer
# than that of all the rest.


def _start(context: Any, builder: Any, kind: Any, array: Any) -> Any:
    return context.make_array(kind)(context, builder, array).data


def _element(context: Any, builder: Any, kind: Any, array: Any, k: Any, index: Any) -> Any:
    """Pointer to an element of row k of an array (rows, n)."""
    parts = context.make_array(kind)(context, builder, array)
    row = builder.mul(k, builder.extract_value(parts.shape, 1))
    return builder.gep(parts.data, [builder.add(row, index)])


def _lanes_at(builder: Any, start: Any, index: Any, width: int) -> Any:
    """Pointer to `width` doubles from an index on."""
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
    """The type of an array of doubles, whose rows follow each other; TypingError for others."""
    if not (array.layout == "C" and array.dtype == types.float64 and array.ndim == ndim):
        raise TypingError(f"{array} is not a C array of float64 with {ndim} dimensions")
    return array


# lanes of row k of an array (rows, n), from an index on
load, load_wide = _loading(WIDTH), _loading(WIDE)


@intrinsic
def put(typingctx: Any, array: Any, k: Any, index: Any, lanes: Any) -> Any:
    """Write lanes to row k of an array (rows, n), from an index on."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        element = _element(context, builder, signature.args[0], *values[:3])
        vector = context.get_value_type(signature.args[3]).as_pointer()
        builder.store(values[3], builder.bitcast(element, vector), align=8)
        return context.get_dummy_value()

    return types.none(_rows(array), types.intp, types.intp, lanes), build


@intrinsic
def copy(typingctx: Any, column: Any, first: Any, n: Any, array: Any, k: Any) -> Any:
    """Copy n numbers of a column (N,), from the first on, to row k of an array."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        column, first, n, array, k = values
        source = builder.gep(_start(context, builder, signature.args[0], column), [first])
        zero = context.get_constant(types.intp, 0)
        row = _element(context, builder, signature.args[3], array, k, zero)
        cgutils.raw_memcpy(builder, row, source, n, 8)
        return context.get_dummy_value()

    whole = types.intp
    return types.none(_rows(column, 1), whole, whole, _rows(array), whole), build


@intrinsic
def near_inverse_root(typingctx: Any, x: Any) -> Any:
    """1 / sqrt(x) of lanes by an instruction of AVX-512, right to 6e-5."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        vector, mask = _vector(WIDTH), ir.IntType(8)
        kind = ir.FunctionType(vector, [vector, vector, mask])
        root = builder.module.declare_intrinsic("llvm.x86.avx512.rsqrt14.pd.512", (), kind)
        return builder.call(root, [values[0], vector(ir.Undefined), mask(255)])

    return x(x), build


# -- choices, on scalars as well -------------------------------------------------------------------


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


smaller, larger = _choosing("<"), _choosing(">")  # of a and b, by lanes


@intrinsic
def choose(typingctx: Any, a: Any, b: Any, x: Any, y: Any) -> Any:
    """x in lanes where a <= b, else y."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        a, b, x, y = _as_lanes(builder, signature, values)
        return builder.select(builder.fcmp_ordered("<=", a, b), x, y)

    lanes = next(kind for kind in (a, b, x, y) if isinstance(kind, Lanes))
    both = [kind if isinstance(kind, Lanes) else types.float64 for kind in (a, b, x, y)]
    return lanes(*both), build


@intrinsic
def first_lanes(typingctx: Any, n: Any, x: Any, y: Any) -> Any:
    """x in the first n lanes, y in the others."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        n, x, y = _as_lanes(builder, signature, values)
        width = signature.return_type.width
        numbers = ir.Constant(_vector(width, types.int64), list(range(width)))
        return builder.select(builder.icmp_signed("<", numbers, n), x, y)

    second = y if isinstance(y, Lanes) else types.float64
    return x(types.int64, x, second), build


@intrinsic
def spread(typingctx: Any, value: Any, like: Any) -> Any:
    """One number in all lanes, of which there are as many as in `like`."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return _all_alike(builder, values[0], signature.return_type.width)

    element = types.int64 if isinstance(value, types.Integer) else types.float64
    return Lanes(like.width, element)(element, like), build


# -- over all lanes --------------------------------------------------------------------------------


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
    """Function that adds sums over n stars of weights times P_i Q_j, for so many j from one on.

    function(n, weights, g, P, i, Q, j, sums): rows of the arrays have `length` numbers, and the
    weights are the `ROWS` of group g.  Lanes of the sums are added to sums[g, i, j:], of shape
    (groups, T, T, ROWS, WIDTH), and stay in registers until all stars are added.
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
            found = [cgutils.alloca_once_value(builder, zero) for _ in range(columns * ROWS)]
            with cgutils.for_range_slice(builder, whole(0), n, whole(WIDTH)) as (s, _):
                p = lanes(p_start, i, s)
                rows = [builder.add(first_weight, whole(r)) for r in range(ROWS)]
                weighted = [builder.fmul(lanes(w_start, row, s), p) for row in rows]
                for c in range(columns):
                    q = lanes(q_start, builder.add(j, whole(c)), s)
                    for r in range(ROWS):
                        one = found[c * ROWS + r]
                        more = builder.fmul(weighted[r], q, flags=FLAGS)
                        builder.store(builder.fadd(builder.load(one), more, flags=FLAGS), one)
            wide = builder.extract_value(
                context.make_array(kinds[7])(context, builder, values[7]).shape, 1
            )
            first = builder.add(builder.mul(g, wide), i)
            first = builder.add(builder.mul(first, wide), j)
            first = builder.mul(first, whole(ROWS * WIDTH))
            for k, one in enumerate(found):
                index = builder.add(first, whole(k * WIDTH))
                where = _lanes_at(builder, sums_start, index, WIDTH)
                before = builder.load(where, align=8)
                builder.store(builder.fadd(before, builder.load(one)), where, align=8)
            return context.get_dummy_value()

        whole = types.intp
        arrays = (_rows(weights), whole, _rows(P), whole, _rows(Q), whole, _rows(sums, 5))
        return types.none(whole, *arrays), build

    return add
