"""Selects how a derived function runs: as machine code, or in CasADi's interpreter.

Run a CasADi function in CasADi's interpreter, one state or many.

It needs no compilation: for few evaluations, and without a compiler. `Compiled` has the same interface.
"""

from __future__ import annotations

import importlib.util
import os
import threading
import warnings
from collections import OrderedDict
from collections.abc import Callable, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

import casadi as ca
import numpy as np

from mbkit._check import Array, all_finite
from mbkit._process import fork_safe
from mbkit.codegen import disk_cache as disk
from mbkit.errors import NoCompilerWarning, UnsupportedError

if TYPE_CHECKING:
    from mbkit.codegen.compiled import Compiled


class Machine:
    """A function of vectors, evaluated in CasADi's interpreter.

    A C-ordered batch ``(N, n)`` is CasADi's column-major ``n`` by ``N``, so arrays are handed over as they are.
    """

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        self.inputs = tuple(function.size1_in(i) for i in range(function.n_in()))
        self.shapes = tuple((function.size1_out(i), function.size2_out(i)) for i in range(function.n_out()))
        self.operations = int(function.n_instructions())
        self._sizes: dict[int, tuple[Any, Any, list[Any], list[Any]]] = {}
        # CasADi's buffers belong to one call at a time.
        self._lock = fork_safe(threading.RLock())

    def _prepared(self, n: int) -> tuple[Any, Any, list[Any], list[Any]]:
        if n not in self._sizes:
            if len(self._sizes) > 8:
                self._sizes.clear()
            f = self.function if n == 1 else self.function.map(n)
            buffer: Any
            buffer, run = f.buffer()
            inputs: list[Any] = [np.zeros((n, size)) for size in self.inputs]
            outputs: list[Any] = [np.zeros((n, columns, rows)) for rows, columns in self.shapes]
            for arrays, hand_over in ((inputs, buffer.set_arg), (outputs, buffer.set_res)):
                for i, x in enumerate(arrays):
                    # An empty array has no memory to hand over, and CasADi reads none.
                    if x.size:
                        hand_over(i, memoryview(x))
            self._sizes[n] = (buffer, run, inputs, outputs)
        return self._sizes[n]

    def call_checked(self, *arguments: Array, threads: int | None = None) -> tuple[list[Array], bool]:
        """Return the results, and whether all that was read and written is finite."""
        results = self(*arguments, threads=threads)
        return results, all(all_finite(x) for x in (*arguments, *results))

    def bound(self, inputs: Sequence[Array], outputs: Sequence[Array]) -> tuple[Callable[[], None], Array]:
        """Return a call that reads and writes these very arrays, as `Compiled.bound` does."""
        watch = np.zeros(1)

        def call() -> None:
            results, finite = self.call_checked(*inputs)
            for out, result in zip(outputs, results, strict=True):
                out[:] = result.reshape(out.shape)
            if not finite:
                watch[:] = np.nan

        return call, watch

    def __call__(self, *arguments: Array, threads: int | None = None) -> list[Array]:  # noqa: ARG002  # one is all it has
        """Return each output with shape (rows, columns) or (N, rows, columns)."""
        single = arguments[0].ndim == 1
        n = 1 if single else arguments[0].shape[0]
        if n == 0:
            return [np.empty((0, *shape)) for shape in self.shapes]
        for i, (x, size) in enumerate(zip(arguments, self.inputs, strict=True)):
            if x.shape[-1] != size:
                raise ValueError(f"argument {i}: expected {size} entries, got shape {x.shape}")
        with self._lock:
            _, run, inputs, outputs = self._prepared(n)
            for own, argument in zip(inputs, arguments, strict=True):
                own[:] = argument
            run()
            return [x[0].T.copy() if single else x.swapaxes(1, 2).copy() for x in outputs]


#: One thread derives at a time; a fork waits for it. Python 3.11's cached properties hold locks meanwhile.
DERIVING: Final = fork_safe(threading.RLock())

#: Operations, repeated ones included, above which LLVM's time, some 10 s per 100k, is not spent unasked: a Coriolis
#: matrix of a hundred joints has twice as many, and is interpreted in 0.5 ms.
_MAX_COMPILED_OPERATIONS: Final = 200_000
T = TypeVar("T")


class LastUsed(Generic[T]):
    """Derived things by the name of all that they depend on: the last used ones, up to a number of operations."""

    def __init__(self, most: int, operations: Callable[[T], int]) -> None:
        self._most, self._operations, self._sum = most, operations, 0
        self._kept: OrderedDict[str, T] = OrderedDict()

    def get(self, name: Sequence[str], make: Callable[[], T]) -> T:
        """Return what was made under this name before, or make it; within `force_recompile` once more."""
        key = disk.key_of(*name)
        with DERIVING:
            if key in self._kept and not disk.is_bypassed(key):
                self._kept.move_to_end(key)
                return self._kept[key]
            made = make()
            disk.mark_made(key)
            if key in self._kept:
                self._sum -= self._operations(self._kept.pop(key))
            # One that is larger would drive out all others.
            if (size := self._operations(made)) <= self._most:
                self._kept[key] = made
                self._sum += size
            while self._sum > self._most:
                self._sum -= self._operations(self._kept.popitem(last=False)[1])
        return made


#: Functions for the interpreter, which deriving takes a thousand times as long as evaluating once. An operation takes
#: some 100 bytes.
_DERIVED: Final[LastUsed[ca.Function]] = LastUsed(500_000, lambda f: int(f.n_instructions()))


def compile_by_default() -> bool:
    """Return whether functions are compiled by default: yes, unless ``MBKIT_COMPILE=0``."""
    return os.environ.get("MBKIT_COMPILE", "1") != "0"


def executable(
    name: Sequence[str],
    make: Callable[[], ca.Function],
    *,
    compile: bool,  # noqa: A002  # the word that users look for
    device: str | None = None,
    quaternions: Sequence[int] | None = None,
) -> Compiled | Machine:
    """Return a function ready to run; `name` is all that it depends on but mbkit's code, `make` derives it.

    Without a compiler a `NoCompilerWarning` says so once, and CasADi's interpreter runs it, as it does very large
    functions. Batches of a quantity run on a `device`; its `quaternions` begin at these places of the first argument.
    """
    if not compile or not has_compiler():
        return Machine(_DERIVED.get(name, make))
    # Loads LLVM, which interpreting never needs.
    from mbkit.codegen.compiled import compiled

    def checked() -> ca.Function:
        function = make()
        if function.n_instructions() > _MAX_COMPILED_OPERATIONS:
            raise _TooLargeError(function)
        return function

    if device is not None:
        from mbkit.codegen.cuda.driver import device_of
        from mbkit.codegen.cuda.runs import on_device

        def small() -> ca.Function:
            try:
                return checked()
            except _TooLargeError as error:
                raise UnsupportedError(
                    f"device: expected at most {_MAX_COMPILED_OPERATIONS:,} operations, {name[1]} of this model has "
                    f"{error.args[0].n_instructions():,}; use the CPU"
                ) from None

        return on_device(name, small, device_of(device), quaternions)
    try:
        return compiled(name, checked)
    except _TooLargeError as error:
        return Machine(error.args[0])


class _TooLargeError(Exception):
    """Its argument is the function."""


@cache
def has_compiler() -> bool:
    """Return whether functions can be compiled; where not, a `NoCompilerWarning` says so once."""
    if importlib.util.find_spec("llvmlite") is not None:
        return True
    warnings.warn(
        "llvmlite is not installed: mbkit's own derivation runs in CasADi's machine, some ten times slower; "
        "pip install llvmlite",
        NoCompilerWarning,
        stacklevel=2,
    )
    return False
