"""Named tuples by address, as compiled functions read them.

A `Problem` or `Workspace` holds some three hundred numbers, most of them addresses and sizes of arrays. Passed by
value, every call would copy them all, and compiling the copies would take as long as compiling the physics.
A `Pointer` is the address of a named tuple laid out in words of eight bytes: a number takes one word (a value of
lanes takes eight), an array the words of its data address and shape, a nested tuple the words of its fields. Reading a
field loads its words. They never change while compiled code runs, and the compiler knows this.

Extents of arrays that the tuple's type declares as numbers (`rigidfleet.kernel.problem.Extents`) are not loaded.
"""

import hashlib
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    infer_getattr,
    intrinsic,
    lower_getattr_generic,
    models,
    register_model,
)

from rigidfleet.kernel.compiler.simd import WIDTH, lanes
from rigidfleet.kernel.problem import extents_of

_WORD = ir.IntType(64)
_ADDRESS = _WORD.as_pointer()
#: Part of a named tuple that may be read in advance [bytes]; there are no registers for more.
_AHEAD = 256


class Pointer(types.Type):
    """The type of the address of a named tuple of type ``to``."""

    def __init__(self, to: types.BaseNamedTuple) -> None:
        self.to = to
        # Names of types become part of the functions' names; full names would be most of the code.
        digest = hashlib.sha256(str(to).encode()).hexdigest()[:12]
        super().__init__(name=f"{to.instance_class.__name__}At{digest}")


@register_model(Pointer)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _ADDRESS)
        self._size = 8 * _count_words(kind.to)

    def from_argument(self, _builder: Any, value: Any) -> Any:
        """Declare that an argument is valid memory, so that reads can be moved forward."""
        value.attributes.dereferenceable = min(self._size, _AHEAD)
        value.attributes.align = 8
        return value


def _count_words(kind: types.Type) -> int:
    """Number of words of a value."""
    if isinstance(kind, types.BaseNamedTuple):
        return sum(map(_count_words, kind.types))
    if isinstance(kind, types.Array):
        return 1 + kind.ndim
    return WIDTH if kind == lanes else 1


def _field_type_and_word(kind: types.BaseNamedTuple, name: str) -> tuple[types.Type, int]:
    """Type and first word of a field."""
    k = kind.fields.index(name)
    return kind.types[k], sum(map(_count_words, kind.types[:k]))


@infer_getattr
class _Attribute(AttributeTemplate):
    key = Pointer

    def generic_resolve(self, kind: Any, name: str) -> types.Type:
        field, _ = _field_type_and_word(kind.to, name)
        return Pointer(field) if isinstance(field, types.BaseNamedTuple) else field


@lower_getattr_generic(Pointer)
def _read_field(context: Any, builder: Any, kind: Any, address: Any, name: str) -> Any:
    field, first = _field_type_and_word(kind.to, name)
    if isinstance(field, types.BaseNamedTuple):
        return _word_address(builder, address, first)
    if isinstance(field, types.Array):
        array = context.make_array(field)(context, builder)
        array.data = _load(builder, address, first, array.data.type)
        extents = extents_of(kind.to.instance_class).get(name, (None,) * field.ndim)
        shape = [
            ir.Constant(_WORD, x) if isinstance(x, int) else _load(builder, address, first + 1 + k)
            for k, x in enumerate(extents)
        ]
        return _array_at(context, builder, field, array, shape)
    if field == types.boolean:
        return builder.trunc(_load(builder, address, first), ir.IntType(1))
    return _load(builder, address, first, context.get_value_type(field))


def _word_address(builder: Any, address: Any, word: int) -> Any:
    return builder.gep(address, [ir.Constant(_WORD, word)], inbounds=True)


def _load(builder: Any, address: Any, word: int, kind: ir.Type = _WORD) -> Any:
    place = builder.bitcast(_word_address(builder, address, word), kind.as_pointer())
    loaded = builder.load(place, align=8)
    loaded.set_metadata("invariant.load", builder.module.add_metadata([]))
    return loaded


def _array_at(context: Any, builder: Any, kind: types.Array, array: Any, shape: list[Any]) -> Any:
    """A C-contiguous array without owner, from its address and shape."""
    size = ir.Constant(_WORD, context.get_abi_sizeof(context.get_data_type(kind.dtype)))
    strides, count, step = [], ir.Constant(_WORD, 1), size
    for n in reversed(shape):
        strides.insert(0, step)
        step, count = builder.mul(step, n), builder.mul(count, n)
    array.itemsize, array.nitems = size, count
    array.shape = cgutils.pack_array(builder, shape)
    array.strides = cgutils.pack_array(builder, strides)
    return array._getvalue()


def pointer_cast(to: types.BaseNamedTuple) -> Any:
    """Return the compiled function that converts an int64 to the address of a named tuple."""

    @intrinsic
    def take(_context, address):
        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return builder.inttoptr(args[0], _ADDRESS)

        return Pointer(to)(address), generate

    return take


@intrinsic
def address_of(_context, x):
    """The address of a named tuple; one passed by value is copied to the caller's stack first."""
    if not isinstance(x, types.BaseNamedTuple):
        return x(x), lambda _context, _builder, _sig, args: args[0]

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        memory = cgutils.alloca_once(builder, _WORD, size=_count_words(x))
        _store(context, builder, x, args[0], memory, 0)
        # The address passes through an empty piece of assembly, so that nothing is read through it before all has
        # been stored.
        kind = ir.FunctionType(_ADDRESS, [_ADDRESS])
        empty = ir.InlineAsm(kind, "", "=r,0,~{memory}", side_effect=True)
        return builder.call(empty, [memory])

    return Pointer(x)(x), generate


def _store(context: Any, builder: Any, kind: Any, value: Any, memory: Any, word: int) -> None:
    """Store a value, beginning at a word."""
    if isinstance(kind, types.BaseNamedTuple):
        for k, part in enumerate(kind.types):
            _store(context, builder, part, builder.extract_value(value, k), memory, word)
            word += _count_words(part)
        return
    parts = [value]
    if isinstance(kind, types.Array):
        array = context.make_array(kind)(context, builder, value)
        shape = cgutils.unpack_tuple(builder, array.shape)
        parts = [builder.ptrtoint(array.data, _WORD), *shape]
    elif kind == types.boolean:
        parts = [builder.zext(value, _WORD)]
    for k, part in enumerate(parts):
        place = builder.bitcast(_word_address(builder, memory, word + k), part.type.as_pointer())
        builder.store(part, place, align=8)
