"""A function that Python calls with the arrays of one state, and that checks and evaluates them in machine code.

Through views, copies and ctypes a call costs two microseconds more than the small kernels themselves. The function here
is a built-in one, as of an extension module (METH_FASTCALL of Python's C API). It reads the addresses of arrays from
NumPy's objects, as every extension does, runs compiled functions on them one after another, and makes the arrays of the
results by NumPy's C API. It keeps nothing between calls: each takes its work space from Python's allocator, so that
threads, forks and calls within calls need no lock. It holds the interpreter's lock, because a thread that lets go of it
for a microsecond may get it back only after milliseconds.

Each vector of numbers has a place in the work space, every entry in all lanes of a register, as the compiled functions
take it without copies of their own. The plan of the function is an array of 64-bit numbers, its own object::

    addresses of types and functions, numbers of inputs and of results, bytes of work space, place of the table in it,
    numbers of quaternions and of compiled functions; then for each
      input: its entries, or -1 for a Python float, or -2 for a positive one, and its place
      result: its entries, its place, its axes, and the lengths of up to four axes
      quaternion: the place of its first entry
      compiled function: address of its loop, inputs, outputs, share of the work space, places and rows of all of them

Places count doubles from the start of the work space.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from math import prod
from typing import Any, Final, NamedTuple

import numpy as np
from llvmlite import ir

from mbkit.codegen import jit
from mbkit.codegen.batch_loop import MAX_ARRAYS, RUN, Builder
from mbkit.model.manifold import NEAR_UNIT


class Kernel(NamedTuple):
    """Machine code, the doubles of work space that its body needs, and rows and columns of each result."""

    loaded: jit.Loaded
    share: int
    shapes: tuple[tuple[int, int], ...]


#: A compiled function, as `Kernel` or as an object with these attributes, and the vectors that it reads and writes.
Step = tuple[Any, Sequence[str], Sequence[str]]

#: Words of Python's own part of an object; the last one is its type.
_HEAD: Final = object.__basicsize__ // 8
# Words of NumPy's array object (PyArrayObject_fields, the same since NumPy 1.0), and of its descriptor.
_DATA, _RANK, _SHAPE, _STRIDES, _DTYPE = _HEAD, _HEAD + 1, _HEAD + 2, _HEAD + 3, _HEAD + 5
#: Letters, byte order, flags and number of a type, in eight bytes.
_KIND: Final = _HEAD + 1
_TABLE: Final = 3 + 4 * 2 * MAX_ARRAYS
# Places in the array of numbers: those of every function in this process, then a function's own.
(_ARRAY, _FLOAT, _DOUBLE_KIND, _TAKE, _GIVE, _NONE, _KEEP, _DROP, _NEW_ARRAY, _NEW_FLOAT, _NEW_TUPLE, _SET) = range(12)
(_INPUTS, _RESULTS, _BYTES, _TABLE_AT, _QUATERNIONS, _CALLS, _LISTS) = range(12, 19)
_MAX_AXES: Final = 4
#: Entries of a Python float, and of one that must be positive.
FLOAT, POSITIVE = -1, -2
_METH_FASTCALL: Final = 0x80
_I32, _I64, _F64, _PTR = ir.IntType(32), ir.IntType(64), ir.DoubleType(), ir.PointerType()


class _Definition(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_char_p),
        ("function", ctypes.c_void_p),
        ("flags", ctypes.c_int),
        ("doc", ctypes.c_char_p),
    )


class _Numbers(np.ndarray):
    """The plan of a function, with the code that it runs."""

    kept: Any


def python_call(
    steps: Sequence[Step],
    inputs: Mapping[str, int],
    results: Mapping[str, Sequence[int]],
    quaternions: Sequence[int] = (),
) -> Callable[..., Any]:
    """Return a function of the inputs that returns arrays of the results.

    Parameters
    ----------
    steps : sequence
        Functions to run in this order, each with the names of the vectors that it reads and writes.
    inputs : dict
        Entries of each input, in the order of the arguments; `FLOAT` is a Python float, `POSITIVE` one above zero.
    results : dict
        Vectors that the caller gets -> their shapes, of up to four axes; one without axes is a float.
    quaternions : sequence of int
        Where quaternions begin in the first input.

    Returns
    -------
    callable
        Of one result it returns this, of several a tuple. It returns None where an input is not a float64 array of this
        very shape, with words aligned, or a quaternion is not of unit length, or a number read or written on the way is
        not finite.
    """
    if not _layout_is_known():
        return lambda *_: None
    rows = {name: abs(n) if n > FLOAT else 1 for name, n in inputs.items()}
    for code, _, writes in steps:
        rows |= {name: r * c for name, (r, c) in zip(writes, code.shapes, strict=True)}
    width, place, places = jit.host().width, max(code.share for code, _, _ in steps), {}
    for name, n in rows.items():
        places[name] = place
        place += n * width
    calls = []
    for code, reads, writes in steps:
        loop = ctypes.cast(code.loaded.run, ctypes.c_void_p).value
        calls += [loop, len(reads), len(writes), code.share]
        calls += [x for name in (*reads, *writes) for x in (places[name], rows[name])]
    # The work space begins at a cache line.
    size = 8 * (place + _TABLE) + 64
    counts = [len(inputs), len(results), size, place, len(quaternions), len(steps)]
    sizes = [x for name, n in inputs.items() for x in (n, places[name])]
    result_places = []
    for name, shape in results.items():
        if prod(shape) != rows[name] or len(shape) > _MAX_AXES:
            raise ValueError(f"{name}: {rows[name]} numbers have no shape {tuple(shape)}")
        result_places += [rows[name], places[name], len(shape), *shape, *[1] * (_MAX_AXES - len(shape))]
    turns = [places[next(iter(inputs))] + start * width for start in quaternions]
    lists = [*sizes, *result_places, *turns, *calls]
    numbers = np.array([*_process(), *counts, *lists], dtype=np.int64).view(_Numbers)
    # Threads that are the first together have a definition each, and the cache keeps one.
    definition = _definition()
    numbers.kept = [*(code for code, _, _ in steps), definition]
    new = ctypes.pythonapi.PyCFunction_NewEx
    new.restype, new.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.py_object, ctypes.c_void_p]
    call: Callable[..., Any] = new(ctypes.addressof(definition[0]), numbers, None)
    return call


@cache
def _definition() -> tuple[_Definition, Any]:
    """Return what Python knows of the function, and its code."""
    loaded = jit.load(jit.shared_object(f"python call {_HEAD}", lambda: jit.object_code(_code(), optimize=True)))
    address = ctypes.cast(loaded.run, ctypes.c_void_p).value
    return _Definition(b"evaluate", address, _METH_FASTCALL, None), loaded


@cache
def _process() -> tuple[int, ...]:
    """Return addresses of Python's and NumPy's objects and functions, in the order of `_ARRAY` to `_SET`."""
    heads = id(np.ndarray), id(float), _word(id(np.dtype(np.float64)), _KIND)
    python = ("PyFloat_FromDouble", "PyTuple_New", "PyTuple_SetItem")
    memory = (_address(name) for name in ("PyMem_RawMalloc", "PyMem_RawFree"))
    counts = (_address(name) for name in ("Py_IncRef", "Py_DecRef"))
    return *heads, *memory, id(None), *counts, _api(93), *map(_address, python)


def _address(name: str) -> int:
    return ctypes.cast(getattr(ctypes.pythonapi, name), ctypes.c_void_p).value or 0


def _api(place: int) -> int:
    """Return an entry of the table that NumPy hands to every extension module."""
    get = ctypes.pythonapi.PyCapsule_GetPointer
    get.restype, get.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    table: int = get(np._core._multiarray_umath._ARRAY_API, None)  # type: ignore[attr-defined]  # no public name
    return _word(table, place)


def _word(address: int, place: int) -> int:
    return ctypes.c_int64.from_address(address + 8 * place).value


@cache
def _layout_is_known() -> bool:
    """Return whether NumPy's objects are as this file reads them."""
    x = np.arange(6.0)[::2]
    try:
        # PyArray_Type in the table of NumPy's C API, the same since NumPy 1.0, as PyArray_New is.
        array_type = _api(2)
    except (AttributeError, ValueError):
        return False
    words = [_word(id(x), i) for i in range(_DTYPE + 1)]
    return (
        words[_HEAD - 1] == id(np.ndarray)
        and words[_DATA] == x.ctypes.data
        and words[_RANK] & 0xFFFFFFFF == 1
        and _word(words[_SHAPE], 0) == 3
        and _word(words[_STRIDES], 0) == 16
        and words[_DTYPE] == id(x.dtype)
        and _word(words[_DTYPE], _KIND) >> 32 == x.dtype.num
        and _word(id(1.0), _HEAD) == int(np.float64(1.0).view(np.int64))
        and array_type == id(np.ndarray)
    )


# The code


def _code() -> str:
    """Return LLVM code of the function, ``PyObject *f(PyObject *self, PyObject *const *args, Py_ssize_t nargs)``."""
    module = ir.Module("python_call")
    f = ir.Function(module, ir.FunctionType(_PTR, [_PTR, _PTR, _I64]), RUN)
    b = Builder(f.append_basic_block("entry"))
    this, arguments, count = f.args
    numbers = b.get(this, _I64(_DATA), _PTR)

    def number(place: int) -> Any:
        return b.get(numbers, _I64(place), _I64)

    def call(address: Any, result: Any, *arguments: Any) -> Any:
        kind = ir.FunctionType(result, [x.type for x in arguments])
        return b.call(b.inttoptr(address, ir.PointerType(kind)), arguments)

    width = jit.host().width
    several = _I64(width)
    lanes = ir.VectorType(_F64, width)
    entries = b.at(numbers, _I64(_LISTS), _I64)
    made = b.at(entries, b.mul(number(_INPUTS), _I64(2)), _I64)
    starts = b.at(made, b.mul(number(_RESULTS), _I64(3 + _MAX_AXES)), _I64)
    calls = b.at(starts, number(_QUATERNIONS), _I64)
    refused, refused_late, no_memory = (f.append_basic_block(n) for n in ("refused", "refused_late", "no_memory"))
    nothing = ir.Constant(_PTR, None)

    def is_there(pointer: Any) -> Any:
        return b.icmp_unsigned("!=", b.ptrtoint(pointer, _I64), _I64(0))

    def require(condition: Any, otherwise: Any = refused_late) -> None:
        yes = f.append_basic_block("yes")
        b.cbranch(condition, yes, otherwise)
        b.position_at_end(yes)

    require(b.icmp_signed("==", count, number(_INPUTS)), refused)
    block = call(number(_TAKE), _PTR, number(_BYTES))
    require(is_there(block), refused)
    work = b.inttoptr(b.and_(b.add(b.ptrtoint(block, _I64), _I64(63)), _I64(-64)), _PTR)
    table = b.at(work, number(_TABLE_AT))

    def spread(x: Any, place: Any) -> None:
        one = b.insert_element(ir.Constant(lanes, ir.Undefined), x, _I32(0))
        zeros = ir.Constant(ir.VectorType(_I32, width), [0] * width)
        b.store(b.shuffle_vector(one, one, zeros), place, align=8)

    def one_input(i: Any) -> None:
        size, at = (b.get(entries, b.add(b.mul(i, _I64(2)), _I64(k)), _I64) for k in (0, 1))
        given, place = b.get(arguments, i, _PTR), b.at(work, at)
        kind = b.get(given, _I64(_HEAD - 1), _I64)
        with b.if_else(b.icmp_signed("<", size, _I64(0))) as (is_float, is_array):
            with is_float:
                require(b.icmp_signed("==", kind, number(_FLOAT)))
                x = b.get(given, _I64(_HEAD))
                positive = b.fcmp_ordered(">", x, _F64(0.0))
                require(b.or_(b.icmp_signed("==", size, _I64(FLOAT)), positive))
                spread(x, place)
            with is_array:
                require(b.icmp_signed("==", kind, number(_ARRAY)))
                require(b.icmp_signed("==", b.load(b.at(given, _I64(_RANK)), typ=_I32, align=4), _I32(1)))
                require(b.icmp_signed("==", b.get(b.get(given, _I64(_SHAPE), _PTR), _I64(0), _I64), size))
                dtype = b.get(b.get(given, _I64(_DTYPE), _PTR), _I64(_KIND), _I64)
                require(b.icmp_signed("==", dtype, number(_DOUBLE_KIND)))
                address = b.get(given, _I64(_DATA), _I64)
                stride = b.get(b.get(given, _I64(_STRIDES), _PTR), _I64(0), _I64)
                whole = b.and_(b.or_(address, stride), _I64(7))
                require(b.icmp_signed("==", whole, _I64(0)))
                data, step = b.inttoptr(address, _PTR), b.ashr(stride, _I64(3))

                def one_entry(j: Any) -> None:
                    spread(b.get(data, b.mul(j, step)), b.at(place, b.mul(j, several)))

                b.count(_I64(0), size, 1, one_entry)

    def one_quaternion(i: Any) -> None:
        start = b.get(starts, i, _I64)
        error = _F64(-1.0)
        for k in range(4):
            x = b.get(work, b.add(start, _I64(k * width)))
            error = b.fadd(error, b.fmul(x, x))
        # Neither holds of NaN.
        low, high = b.fcmp_ordered(">", error, _F64(-NEAR_UNIT)), b.fcmp_ordered("<", error, _F64(NEAR_UNIT))
        require(b.and_(low, high))

    b.count(_I64(0), number(_INPUTS), 1, one_input)
    b.count(_I64(0), number(_QUATERNIONS), 1, one_quaternion)
    spread(_F64(0.0), work)
    at = b.room(_PTR, 1)
    b.store(calls, at)

    def one_call(_: Any) -> None:
        entry = b.load(at, typ=_PTR)
        loop, reads, writes, share = (b.get(entry, _I64(i), _I64) for i in range(4))
        for i, x in enumerate((reads, writes, share)):
            b.set(x, table, _I64(i), _I64)
        arrays, many = b.at(entry, _I64(4), _I64), b.add(reads, writes)

        def one_array(i: Any) -> None:
            place, rows = (b.get(arrays, b.add(b.mul(i, _I64(2)), _I64(k)), _I64) for k in (0, 1))
            row = b.add(b.mul(i, _I64(4)), _I64(3))
            for k, x in enumerate((b.ptrtoint(b.at(work, place), _I64), rows, several, _I64(1))):
                b.set(x, table, b.add(row, _I64(k)), _I64)

        b.count(_I64(0), many, 1, one_array)
        call(loop, ir.VoidType(), table, work, _I64(0), several)
        b.store(b.at(arrays, b.mul(many, _I64(2)), _I64), at)

    b.count(_I64(0), number(_CALLS), 1, one_call)
    require(b.fcmp_ordered("==", b.get(work, _I64(0)), _F64(0.0)))

    out, value, several_out = b.room(_PTR, 1), b.room(_PTR, 1), b.icmp_signed(">", number(_RESULTS), _I64(1))
    b.store(nothing, out)
    with b.if_then(several_out):
        b.store(call(number(_NEW_TUPLE), _PTR, number(_RESULTS)), out)
        require(is_there(b.load(out, typ=_PTR)), no_memory)

    def one_result(i: Any) -> None:
        result = b.at(made, b.mul(i, _I64(3 + _MAX_AXES)), _I64)
        size, place, axes = (b.get(result, _I64(k), _I64) for k in range(3))
        values = b.at(work, place)
        with b.if_else(b.icmp_signed("==", axes, _I64(0))) as (is_float, is_array):
            with is_float:
                b.store(call(number(_NEW_FLOAT), _PTR, b.get(values, _I64(0))), value)
                require(is_there(b.load(value, typ=_PTR)), no_memory)
            with is_array:
                kind, shape = b.inttoptr(number(_ARRAY), _PTR), b.at(result, _I64(3), _I64)
                arguments = (
                    b.trunc(axes, _I32),
                    shape,
                    _I32(np.dtype(np.float64).num),
                    nothing,
                    nothing,
                    _I32(0),
                    _I32(0),
                    nothing,
                )
                array = call(number(_NEW_ARRAY), _PTR, kind, *arguments)
                b.store(array, value)
                require(is_there(array), no_memory)
                data = b.get(array, _I64(_DATA), _PTR)
                b.count(_I64(0), size, 1, lambda j: b.set(b.get(values, b.mul(j, several)), data, j))
        with b.if_else(several_out) as (is_many, is_one):
            with is_many:
                call(number(_SET), _I32, b.load(out, typ=_PTR), i, b.load(value, typ=_PTR))
            with is_one:
                b.store(b.load(value, typ=_PTR), out)

    b.count(_I64(0), number(_RESULTS), 1, one_result)
    call(number(_GIVE), ir.VoidType(), block)
    b.ret(b.load(out, typ=_PTR))
    b.position_at_end(no_memory)
    # Python's error is set.
    call(number(_GIVE), ir.VoidType(), block)
    with b.if_then(is_there(b.load(out, typ=_PTR))):
        call(number(_DROP), ir.VoidType(), b.load(out, typ=_PTR))
    b.ret(nothing)
    b.position_at_end(refused_late)
    call(number(_GIVE), ir.VoidType(), block)
    b.branch(refused)
    b.position_at_end(refused)
    none = b.inttoptr(number(_NONE), _PTR)
    call(number(_KEEP), ir.VoidType(), none)
    b.ret(none)
    return str(module)
