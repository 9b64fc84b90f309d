"""Selects how a derived function runs: as machine code, or in CasADi's interpreter."""

from __future__ import annotations

import importlib.util
import os
import threading
import warnings
from collections import OrderedDict
from collections.abc import Callable, Sequence
from functools import cache
from typing import TYPE_CHECKING, Final, Generic, TypeVar

import casadi as ca

from mbkit._fork import fork_safe
from mbkit.codegen import disk_cache as disk
from mbkit.codegen.interpreter import Machine
from mbkit.errors import NoCompilerWarning, UnsupportedError

if TYPE_CHECKING:
    from mbkit.codegen.compiled import Compiled

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
