"""A function that Python calls with the arrays of one state, and that checks and evaluates them in machine code.

Through views, copies and ctypes a call costs two microseconds more than the small kernels themselves. The function here
is a built-in one, as of an extension module (METH_FASTCALL of Python's C API). It reads the addresses of arrays from
NumPy's objects, as every extension does, and runs compiled functions on them one after another. It keeps nothing
between calls: each takes its work space from Python's allocator, so that threads, forks and calls within calls need no
lock. It holds the interpreter's lock, because a thread that lets go of it for a microsecond may get it back only after
milliseconds.

Each vector of numbers has a place in the work space, every entry in all lanes of a register, as the compiled functions
take it without copies of their own. The plan of the function is an array of 64-bit numbers, its own object::

    addresses of types and functions, numbers of arguments and of inputs, bytes of work space, place of the table in it,
    numbers of quaternions and of compiled functions; then for each
      argument: its entries, or -1 for a Python float, and its place
      quaternion: the place of its first entry
      compiled function: address of its loop, inputs, outputs, share of the work space, places and rows of all of them

Places count doubles from the start of the work space.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, Final

import numpy as np
from llvmlite import ir

from mbkit.codegen import jit
from mbkit.codegen.batch_loop import MOST_ARRAYS, RUN, Builder
from mbkit.codegen.compiled import Compiled, shared_object
from mbkit.model.manifold import NEAR_UNIT

#: A compiled function, and the names of the vectors that it reads and writes.
Step = tuple[Compiled, Sequence[str], Sequence[str]]

#: Words of Python's own part of an object; the last one is its type.
_HEAD: Final = object.__basicsize__ // 8
# Words of NumPy's array object (PyArrayObject_fields, the same since NumPy 1.0), and of its descriptor.
_DATA, _RANK, _SHAPE, _STRIDES, _DTYPE = _HEAD, _HEAD + 1, _HEAD + 2, _HEAD + 3, _HEAD + 5
#: Letters, byte order, flags and number of a type, in eight bytes.
_KIND: Final = _HEAD + 1
_TABLE: Final = 3 + 4 * 2 * MOST_ARRAYS
# Places in the array of numbers: what holds of every function in this process, then what is its own.
(_ARRAY, _FLOAT, _DOUBLE_KIND, _TAKE, _GIVE, _BOOL) = range(6)
(_ARGUMENTS, _INPUTS, _BYTES, _TABLE_AT, _QUATERNIONS, _CALLS, _LISTS) = range(6, 13)
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
    steps: Sequence[Step], inputs: Mapping[str, int], results: Sequence[str], quaternions: Sequence[int] = ()
) -> Callable[..., bool]:
    """Return a function of the inputs and then of arrays for the results that fills these.

    Parameters
    ----------
    steps : sequence
        Functions to run in this order, each with the names of the vectors that it reads and writes.
    inputs : dict
        Entries of each input, in the order of the arguments; -1 is a Python float.
    results : sequence of str
        Vectors that the caller gets, each in a contiguous float64 array of as many entries. They are not checked.
    quaternions : sequence of int
        Where quaternions begin in the first input.

    Returns
    -------
    callable
        It returns False, and leaves the results as they are, where an input is not a float64 array of this very
        shape, with words aligned, or a quaternion is not of unit length, or a number read or written on the way is not
        finite.
    """
    if not _layout_is_known():
        return lambda *_: False
    rows = {name: abs(n) for name, n in inputs.items()}
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
    counts = [len(inputs) + len(results), len(inputs), size, place, len(quaternions), len(steps)]
    arguments = [x for name, n in (*inputs.items(), *((r, rows[r]) for r in results)) for x in (n, places[name])]
    turns = [places[next(iter(inputs))] + start * width for start in quaternions]
    lists = [*arguments, *turns, *calls]
    numbers = np.array([*_process(), *counts, *lists], dtype=np.int64).view(_Numbers)
    numbers.kept = [code for code, _, _ in steps]
    new = ctypes.pythonapi.PyCFunction_NewEx
    new.restype, new.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.py_object, ctypes.c_void_p]
    call: Callable[..., bool] = new(ctypes.addressof(_definition()[0]), numbers, None)
    return call


@cache
def _definition() -> tuple[_Definition, Any]:
    """Return what Python knows of the function, and its code; both live as long as the process."""
    loaded = jit.load(shared_object(f"python call {_HEAD}", lambda: jit.object_code(_code(), optimize=True)))
    address = ctypes.cast(loaded.run, ctypes.c_void_p).value
    return _Definition(b"evaluate", address, _METH_FASTCALL, None), loaded


@cache
def _process() -> tuple[int, ...]:
    """Return addresses of Python's and NumPy's types and functions, in the order of `_ARRAY` to `_BOOL`."""
    api = (getattr(ctypes.pythonapi, name) for name in ("PyMem_RawMalloc", "PyMem_RawFree", "PyBool_FromLong"))
    functions = (ctypes.cast(f, ctypes.c_void_p).value or 0 for f in api)
    return id(np.ndarray), id(float), _word(id(np.dtype(np.float64)), _KIND), *functions


def _word(address: int, place: int) -> int:
    return ctypes.c_int64.from_address(address + 8 * place).value


@cache
def _layout_is_known() -> bool:
    """Return whether NumPy's objects are as this file reads them."""
    x = np.arange(6.0)[::2]
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

    def call(address: Any, result: Any, *given: Any) -> Any:
        kind = ir.FunctionType(result, [x.type for x in given])
        return b.call(b.inttoptr(address, ir.PointerType(kind)), given)

    width = jit.host().width
    several = _I64(width)
    lanes = ir.VectorType(_F64, width)
    entries = b.at(numbers, _I64(_LISTS), _I64)
    starts = b.at(entries, b.mul(number(_ARGUMENTS), _I64(2)), _I64)
    calls = b.at(starts, number(_QUATERNIONS), _I64)
    refused, refused_late = (f.append_basic_block(n) for n in ("refused", "refused_late"))

    def require(condition: Any, otherwise: Any = refused_late) -> None:
        yes = f.append_basic_block("yes")
        b.cbranch(condition, yes, otherwise)
        b.position_at_end(yes)

    require(b.icmp_signed("==", count, number(_ARGUMENTS)), refused)
    block = call(number(_TAKE), _PTR, number(_BYTES))
    require(b.icmp_unsigned("!=", b.ptrtoint(block, _I64), _I64(0)), refused)
    work = b.inttoptr(b.and_(b.add(b.ptrtoint(block, _I64), _I64(63)), _I64(-64)), _PTR)
    table = b.at(work, number(_TABLE_AT))

    def described(i: Any) -> tuple[Any, Any, Any]:
        """Return argument i, its entries, and its place."""
        size, place = (b.get(entries, b.add(b.mul(i, _I64(2)), _I64(k)), _I64) for k in (0, 1))
        return b.get(arguments, i, _PTR), size, b.at(work, place)

    def spread(x: Any, place: Any) -> None:
        one = b.insert_element(ir.Constant(lanes, ir.Undefined), x, _I32(0))
        zeros = ir.Constant(ir.VectorType(_I32, width), [0] * width)
        b.store(b.shuffle_vector(one, one, zeros), place, align=8)

    def one_input(i: Any) -> None:
        given, size, place = described(i)
        kind = b.get(given, _I64(_HEAD - 1), _I64)
        with b.if_else(b.icmp_signed("==", size, _I64(-1))) as (is_float, is_array):
            with is_float:
                require(b.icmp_signed("==", kind, number(_FLOAT)))
                spread(b.get(given, _I64(_HEAD)), place)
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

    def one_result(i: Any) -> None:
        given, size, place = described(i)
        data = b.get(given, _I64(_DATA), _PTR)
        b.count(_I64(0), size, 1, lambda j: b.set(b.get(place, b.mul(j, several)), data, j))

    b.count(number(_INPUTS), number(_ARGUMENTS), 1, one_result)
    call(number(_GIVE), ir.VoidType(), block)
    b.ret(call(number(_BOOL), _PTR, _I64(1)))
    b.position_at_end(refused_late)
    call(number(_GIVE), ir.VoidType(), block)
    b.branch(refused)
    b.position_at_end(refused)
    b.ret(call(number(_BOOL), _PTR, _I64(0)))
    return str(module)
