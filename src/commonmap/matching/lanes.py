"""Eight numbers as one, that go through the same arithmetic.

`Lanes` is a type of numba: `load` takes eight neighbours of an array, the operators below act on
all of them, also with one number on the other side, `store` writes them back. The compiler turns
each into vector instructions of whatever width the machine has. Of a plain loop over the eight it
would have to prove first that none of the arrays overlap, which it cannot for the sixteen streams
of a butterfly.

Of floating point there is `+ - * /`, of words of 64 bits `+ & | << >>` and `count_ones`.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.datamodel import models
from numba.extending import intrinsic, lower_builtin, register_model, type_callable

WIDTH = 8
"""Lanes of a value."""


class Lanes(types.Type):  # type: ignore[misc]
    """`WIDTH` numbers of one type."""

    def __init__(self, dtype: types.Type) -> None:
        self.dtype = dtype
        super().__init__(name=f"Lanes({dtype})")


@register_model(Lanes)  # type: ignore[misc]
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, lanes: Lanes) -> None:
        one = manager.lookup(lanes.dtype).get_value_type()
        super().__init__(manager, lanes, ir.VectorType(one, WIDTH))  # type: ignore[no-untyped-call]


def _compiled(build: Any) -> Any:
    """Return what numba compiles by `build`, of no type that a checker knows."""
    return intrinsic(build)


def _place(context: Any, builder: Any, signature: Any, args: Any, vector: Any) -> Any:
    """Return the pointer to a vector of the array args[0] that begins at the index args[1]."""
    data = context.make_array(signature.args[0])(context, builder, args[0]).data
    return builder.bitcast(builder.gep(data, [args[1]]), vector.as_pointer())


def _align(signature: Any) -> int:
    """Return by how many bytes a vector of that array is aligned at least: by those of a number."""
    return int(signature.args[0].dtype.bitwidth // 8)


@_compiled
def load(typing: Any, array: Any, index: Any) -> Any:
    """Return the lanes array[index : index + WIDTH] of a flat array; bounds are not checked."""

    def write(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vector = context.get_value_type(signature.return_type)
        found = builder.load(_place(context, builder, signature, args, vector))
        found.align = _align(signature)
        return found

    return Lanes(array.dtype)(array, types.intp), write


@_compiled
def store(typing: Any, array: Any, index: Any, lanes: Any) -> Any:
    """Set array[index : index + WIDTH] of a flat array to the lanes; bounds are not checked."""

    def write(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vector = context.get_value_type(signature.args[2])
        there = _place(context, builder, signature, args, vector)
        builder.store(args[2], there).align = _align(signature)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), write


@_compiled
def load_pairs(typing: Any, array: Any, index: Any) -> Any:
    """Return what `array[index : index + 2 WIDTH]` holds at even and at odd places, as lanes."""
    lanes = Lanes(array.dtype)

    def write(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        wide = ir.VectorType(context.get_value_type(lanes).element, 2 * WIDTH)
        found = builder.load(_place(context, builder, signature, args, wide))
        found.align = _align(signature)
        halves = [_shuffle(builder, found, found, range(first, 2 * WIDTH, 2)) for first in (0, 1)]
        return context.make_tuple(builder, signature.return_type, halves)

    return types.UniTuple(lanes, 2)(array, types.intp), write  # type: ignore[no-untyped-call]


@_compiled
def store_pairs(typing: Any, array: Any, index: Any, even: Any, odd: Any) -> Any:
    """Set `array[index : index + 2 WIDTH]` at even and at odd places to the lanes."""

    def write(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        wide = ir.VectorType(context.get_value_type(signature.args[2]).element, 2 * WIDTH)
        there = _place(context, builder, signature, args, wide)
        order = [k // 2 + k % 2 * WIDTH for k in range(2 * WIDTH)]
        both = _shuffle(builder, args[2], args[3], order)
        builder.store(both, there).align = _align(signature)
        return context.get_dummy_value()

    return types.void(array, types.intp, even, odd), write


def _shuffle(builder: Any, a: Any, b: Any, order: Iterable[int]) -> Any:
    """Return the values of two vectors, counted on from the first to the second, in an order."""
    places = list(order)
    kind = ir.VectorType(ir.IntType(32), len(places))
    return builder.shuffle_vector(a, b, ir.Constant(kind, places))


@_compiled
def clip_below_zero(typing: Any, lanes: Any) -> Any:
    """Return the lanes, zero where they are negative."""

    def write(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        zero = ir.Constant(context.get_value_type(signature.return_type), None)
        return builder.select(builder.fcmp_ordered(">", args[0], zero), args[0], zero)

    return lanes(lanes), write


@_compiled
def spread(typing: Any, number: Any) -> Any:
    """Return lanes that all hold the number."""

    def write(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _spread(context, builder, signature.return_type, args[0])

    return Lanes(number)(number), write


def _spread(context: Any, builder: Any, lanes: Any, number: Any) -> Any:
    vector = context.get_value_type(lanes)
    nothing, first = ir.Constant(vector, ir.Undefined), ir.Constant(ir.IntType(32), 0)
    one = builder.insert_element(nothing, number, first)
    return _shuffle(builder, one, nothing, [0] * WIDTH)


@_compiled
def count_ones(typing: Any, words: Any) -> Any:
    """Return the number of bits set, of one word of 64 or of lanes of them."""

    def write(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        if not isinstance(signature.return_type, Lanes):
            return builder.ctpop(args[0])
        kind = ir.FunctionType(args[0].type, [args[0].type])
        name = f"llvm.ctpop.v{WIDTH}i64"
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), args)  # type: ignore[no-untyped-call]

    return words(words), write


def _define(symbol: Any, of_floats: str | None, of_words: str | None) -> None:
    """Let the operator compile to vector instructions, of lanes and of lanes and a number."""

    def choose(lanes: Any) -> str | None:
        return of_floats if isinstance(lanes.dtype, types.Float) else of_words

    def typer(context: Any) -> Any:
        def find(a: Any, b: Any) -> Any:
            lanes, other = (a, b) if isinstance(a, Lanes) else (b, a)
            fits = isinstance(lanes, Lanes) and other in (lanes, lanes.dtype)
            return lanes if fits and choose(lanes) else None

        return find

    def write(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        lanes = signature.return_type
        sides = (
            value if isinstance(kind, Lanes) else _spread(context, builder, lanes, value)
            for kind, value in zip(signature.args, args, strict=True)
        )
        return getattr(builder, choose(lanes) or "")(*sides)

    type_callable(symbol)(typer)
    for kinds in ((Lanes, Lanes), (types.Number, Lanes), (Lanes, types.Number)):
        lower_builtin(symbol, *kinds)(write)  # type: ignore[no-untyped-call]


for _operator in (
    (operator.add, "fadd", "add"),
    (operator.sub, "fsub", None),
    (operator.mul, "fmul", None),
    (operator.truediv, "fdiv", None),
    (operator.and_, None, "and_"),
    (operator.or_, None, "or_"),
    (operator.lshift, None, "shl"),
    (operator.rshift, None, "lshr"),
):
    _define(*_operator)
