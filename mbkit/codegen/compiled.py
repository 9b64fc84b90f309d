"""A function of vectors as machine code: one state or a batch, one thread or all."""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, cached_property
from typing import Any, Final, NamedTuple
from weakref import WeakValueDictionary

import casadi as ca
import numpy as np
from llvmlite import ir

from mbkit._check import Array
from mbkit._child_process import cores
from mbkit._version import __version__
from mbkit.codegen import disk_cache as disk
from mbkit.codegen import jit
from mbkit.codegen.batch_loop import RUN, Builder
from mbkit.codegen.program import program
from mbkit.codegen.python_call import Kernel, python_call
from mbkit.derivation.fingerprint import SOURCES

#: Operations on which a second thread is worth its start: about 100 µs.
_MIN_THREAD_OPERATIONS: Final = 2_000_000
#: Coordinate-major arrays with more rows than this are read in blocks: so many places
#: of a large array at once are more than the processor's tables of pages hold.
_MAX_STREAMED_ROWS: Final = 48
#: Samples in such a block. No power of two: rows would meet in the same cache sets.
_BLOCK_SAMPLES: Final = 1032


def aligned(size: int) -> Array:
    """Return an array that starts at a cache line."""
    room = np.empty(size + 8)
    return room[-room.ctypes.data // 8 % 8 :][:size]


def _readable(x: Array) -> Array:
    """Return an array as machine code can read it: doubles at whole places."""
    good = x.dtype == np.float64 and x.dtype.isnative and not any(s % 8 for s in x.strides) and not x.ctypes.data % 8
    return x if good else np.array(x, dtype=np.float64)


def _cache_line_offset(arrays: Sequence[Array], first: int, last: int) -> int:
    """Return where vectors of coordinate-major arrays begin to lie on whole cache lines, each fetched once."""
    leads = (-(x.ctypes.data // 8 + first) % 8 for x in arrays if x.strides[0] == 8 and x.strides[1] % 64 == 0)
    return min(first + next(leads, 0), last)


class Compiled:
    """Machine code of a function whose arguments are vectors."""

    #: The GPU on which batches run, if any.
    device: Any = None

    def __init__(self, about: dict[str, Any], code: bytes) -> None:
        #: Entries of each argument, and rows and columns of each result.
        self.inputs = tuple(about["inputs"])
        self.shapes = tuple((r, c) for r, c in about["shapes"])
        self.operations = int(about["operations"])
        self.loaded = jit.load(_batch_object(), code)
        #: Doubles of work space of the body alone.
        self.share = int(about["work"])
        tiles = sum(self.inputs) + sum(rows * columns for rows, columns in self.shapes)
        #: Doubles of work space that a call needs.
        self.work_size = self.share + tiles * jit.host().width
        self._local = threading.local()

    def __call__(self, *arguments: Array, threads: int | None = None) -> list[Array]:
        """Return each result, (rows, columns) or (N, rows, columns), of arguments that are all vectors or all (N, n).

        Results are coordinate-major if all arguments of more than one entry are.
        """
        return self.call_checked(*arguments, threads=threads)[0]

    def call_checked(self, *arguments: Array, threads: int | None = None) -> tuple[list[Array], bool]:
        """Return the results, and whether all that was read and written is finite."""
        single = arguments[0].ndim == 1
        if single and (out := self._single(*arguments)) is not None:
            return [*out] if len(self.shapes) > 1 else [out], True
        args = [x[None] for x in arguments] if single else list(arguments)
        n = args[0].shape[0]
        for i, (x, size) in enumerate(zip(args, self.inputs, strict=True)):
            if x.shape != (n, size):
                raise ValueError(f"argument {i}: expected ({n}, {size}), got {x.shape}")
        args = [_readable(x) for x in args]
        major = n > 1 and all(x.strides[0] == 8 for x in args if x.shape[1] > 1)
        flat = [np.empty((r * c, n)).T if major else np.empty((n, r * c)) for r, c in self.shapes]
        finite = self.run(args, flat, threads)
        results = [
            (x.T.reshape(r, c, n).transpose(2, 0, 1) if major else x.reshape(n, r, c))
            for x, (r, c) in zip(flat, self.shapes, strict=True)
        ]
        return ([x[0] for x in results] if single else results), finite

    @cached_property
    def _single(self) -> Callable[..., Any]:
        # With `self` inside, only the collector would release it.
        kernel = Kernel(self.loaded, self.share, self.shapes)
        inputs = {f"argument {i}": n for i, n in enumerate(self.inputs)}
        results = {f"result {i}": shape for i, shape in enumerate(self.shapes)}
        return python_call([(kernel, [*inputs], [*results])], inputs, results)

    def run(self, inputs: Sequence[Array], outputs: Sequence[Array], threads: int | None = None) -> bool:
        """Fill (N, n) outputs of any strides, without checks; return whether all read and written is finite."""
        n = inputs[0].shape[0]
        if n == 0:
            return True
        width = jit.host().width
        parts = min(threads or cores(), max(1, n * self.operations // _MIN_THREAD_OPERATIONS))
        if parts == 1:
            return self._part(inputs, outputs, 0, n)
        # A few more parts than threads: one that is held up is helped out by the others.
        size = -(-n // (4 * parts * width)) * width
        starts = range(0, n, size)
        return all(list(_pool(parts).map(lambda s: self._part(inputs, outputs, s, min(s + size, n)), starts)))

    def _part(self, inputs: Sequence[Array], outputs: Sequence[Array], first: int, last: int) -> bool:
        many = [sum(x.shape[1] for x in xs if x.strides[0] == 8) > _MAX_STREAMED_ROWS for xs in (inputs, outputs)]
        if not any(many) or last - first <= _BLOCK_SAMPLES:
            return self._run_range(inputs, outputs, first, last)
        buffers = [[np.empty((x.shape[1], _BLOCK_SAMPLES)).T for x in xs] for xs in (inputs, outputs)]
        finite = True
        for start in range(first, last, _BLOCK_SAMPLES):
            n = min(_BLOCK_SAMPLES, last - start)
            for x, y in zip(inputs, buffers[0], strict=True):
                y[:n] = x[start : start + n]
            finite &= self._run_range(buffers[0], buffers[1], 0, n)
            for x, y in zip(outputs, buffers[1], strict=True):
                x[start : start + n] = y[:n]
        return finite

    def _run_range(self, inputs: Sequence[Array], outputs: Sequence[Array], first: int, last: int) -> bool:
        if not hasattr(self._local, "work"):
            # Each thread has a work space of its own.
            self._local.work = aligned(self.work_size)
        table, work = self.table(inputs, outputs), self._local.work
        watch = work[: jit.host().width]
        watch[:] = 0.0
        lead = _cache_line_offset((*inputs, *outputs), first, last)
        for start, end in ((first, lead), (lead, last)):
            self.loaded.run(table.ctypes.data, work.ctypes.data, start, end)
        return bool(np.dot(watch, watch) == 0.0)

    def table(self, inputs: Sequence[Array], outputs: Sequence[Array]) -> Array:
        """Return the table of these arrays that the code reads; they must outlive its use."""
        table = [len(inputs), len(outputs), self.share]
        for x in (*inputs, *outputs):
            table += [x.ctypes.data, x.shape[1], x.strides[1] >> 3, x.strides[0] >> 3]
        return np.array(table, dtype=np.int64)


@cache
def _batch_object() -> bytes:
    return jit.shared_object("batch", jit.batch_object)


_POOLS: dict[int, ThreadPoolExecutor] = {}
if hasattr(os, "register_at_fork"):
    # A child has none of its parent's threads.
    os.register_at_fork(after_in_child=_POOLS.clear)


def _pool(threads: int) -> ThreadPoolExecutor:
    if threads not in _POOLS:
        _POOLS[threads] = ThreadPoolExecutor(threads, thread_name_prefix="mbkit")
    return _POOLS[threads]


def compiled(name: Sequence[str], make: Callable[[], ca.Function]) -> Compiled:
    """Return machine code of a function: kept in this process, from disk, or derived by `make` and compiled now.

    `name` is all that the function depends on but the code of mbkit: the model's digest, the quantity.
    """
    key = disk.key_of(*name, __version__, ca.CasadiMeta.version(), SOURCES, *map(str, jit.host()))
    with jit.COMPILING:
        return disk.cached(key, _HELD, Compiled, lambda: _compile(make))


def _compile(make: Callable[[], ca.Function]) -> tuple[dict[str, Any], bytes]:
    derived = jit.host().lowered(program(make()))
    code, work = jit.program_object(derived)
    return {"inputs": derived.inputs, "shapes": derived.shapes, "operations": derived.arithmetic, "work": work}, code


#: Functions in use in this process.
_HELD: Final[WeakValueDictionary[str, Compiled]] = WeakValueDictionary()


# Compiled functions called one after another without going back to Python in between.

# The list holds the number of its calls, and for each the addresses of loop, table and work space, how many states and
# moves it has, and the address of these: where in the table an array's address stands, that address in round 0, and the
# bytes to the next round. The signature is that of a compiled function's own loop, so that it is loaded like one.
_ENTRY_WORDS: Final = 6
_I64, _POINTER = ir.IntType(64), ir.PointerType()


def _code() -> str:
    module = ir.Module("sequence")
    kind = ir.FunctionType(ir.VoidType(), [_POINTER, _POINTER, _I64, _I64])
    function = ir.Function(module, kind, RUN)
    b = Builder(function.append_basic_block("entry"))
    given, _, first, last = function.args
    calls, entries = b.get(given, _I64(0), _I64), b.at(given, _I64(1), _I64)
    # The call and the round that come next; divisions would cost as much as small kernels.
    state = b.room(_I64, 2)
    b.set(b.srem(first, calls), state, _I64(0), _I64)
    b.set(b.sdiv(first, calls), state, _I64(1), _I64)

    def one(_: Any) -> None:
        at, turn = (b.get(state, _I64(k), _I64) for k in range(2))
        entry = b.at(entries, b.mul(at, _I64(_ENTRY_WORDS)), _I64)
        run, table, work, states, moves, moved = (b.get(entry, _I64(k), _I64) for k in range(_ENTRY_WORDS))

        def move(j: Any) -> None:
            words = b.at(b.inttoptr(moved, _POINTER), b.mul(j, _I64(3)), _I64)
            place, start, by = (b.get(words, _I64(k), _I64) for k in range(3))
            b.store(b.add(start, b.mul(turn, by)), b.inttoptr(place, _POINTER), align=8)

        b.count(_I64(0), moves, 1, move)
        arguments = [*(b.inttoptr(x, _POINTER) for x in (table, work)), _I64(0), states]
        b.call(b.inttoptr(run, ir.PointerType(kind)), arguments)
        following = b.add(at, _I64(1))
        ends = b.icmp_signed("==", following, calls)
        b.set(b.select(ends, _I64(0), following), state, _I64(0), _I64)
        b.set(b.select(ends, b.add(turn, _I64(1)), turn), state, _I64(1), _I64)

    b.count(first, last, 1, one)
    b.ret_void()
    return str(module)


class Call(NamedTuple):
    """A function and the (N, n) arrays that it reads and writes in a first round, as in `Compiled.run`.

    From round to round each of them moves by so many bytes of `moves`, none by default.
    """

    code: Compiled
    inputs: Sequence[Array]
    outputs: Sequence[Array]
    moves: Sequence[int] = ()


class KernelSequence:
    """Calls on fixed arrays, kept alive, in order, round after round; one thread may run it at a time."""

    def __init__(self, calls: Sequence[Call]) -> None:
        # Threads that are the first together load it each for itself, and the cache keeps one.
        self._calls, self._runner = tuple(calls), _runner()
        self._work = aligned(max((call.code.work_size for call in calls), default=0))
        # The sum in which a compiled function marks numbers that are not finite.
        self._work[:] = 0.0
        entries, self._tables = [len(calls)], list[Array]()
        for call in calls:
            table = call.code.table(call.inputs, call.outputs)
            address, places = table.ctypes.data, range(3, len(table), 4)
            moves = [(address + 8 * i, table[i], by) for i, by in zip(places, call.moves, strict=False) if by]
            self._tables += table, np.array(moves, dtype=np.int64)
            loop = ctypes.cast(call.code.loaded.run, ctypes.c_void_p).value or 0
            entries += loop, address, self._work.ctypes.data, len(call.inputs[0])
            entries += len(moves), self._tables[-1].ctypes.data
        self._list = np.array(entries, dtype=np.int64)
        self._address = self._list.ctypes.data

    def run(self, first: int, last: int) -> None:
        """Make the calls from `first` to before `last`, counted over the rounds; other Python threads run meanwhile."""
        self._runner.run(self._address, None, first, last)

    def run_once(self, states: int) -> bool:
        """Make the calls of the first round on the first of their states; return whether all numbers are finite."""
        self._list[4::_ENTRY_WORDS] = states
        watch = self._work[: jit.host().width]
        watch[:] = 0.0
        self.run(0, len(self._calls))
        return bool(np.dot(watch, watch) == 0.0)


@cache
def _runner() -> jit.Loaded:
    return jit.load(jit.shared_object("sequence", lambda: jit.object_code(_code(), optimize=True)))
