"""What comes before a run is timed: deriving, compiling and building, told apart."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any, Final

from mbkit._fork import fork_safe
from mbkit.catalog import pendulum
from mbkit.derivation.cache import anew
from mbkit.engines import Dynamics, dynamics
from mbkit.errors import MbkitError
from mbkit.model import Model
from mbkit.studies.rollouts import quiet_simulate

__all__ = ["made_ready"]

#: heyoka has one switch for all threads: what it was when each of those came that are in the block.
_BEFORE: Final[list[bool]] = []
_SWITCHING: Final = fork_safe(threading.RLock())


def made_ready(model: Model, engine: str, method: str, first: Callable[[Dynamics], Any]) -> tuple[Dynamics, float]:
    """Return an engine that has run a method once, and how many seconds that took beyond the run itself.

    Everything that belongs to this model is derived, compiled and built anew, whatever
    is kept in this process or on disk. Modules to import, and what is the same for every
    model, are there before the clock starts.

    Parameters
    ----------
    model : Model
    engine, method : str
    first : callable
        Runs the method shortly on the engine.
    """
    _imported(engine, method)
    with _nothing_kept():
        begun = time.perf_counter()
        dyn = dynamics(model, engine)
        first(dyn)
        cold = time.perf_counter() - begun
    begun = time.perf_counter()
    first(dyn)
    return dyn, max(0.0, cold - (time.perf_counter() - begun))


@cache
def _imported(engine: str, method: str) -> None:
    """Have everything imported that a method needs."""
    with contextlib.suppress(MbkitError):
        quiet_simulate(dynamics(pendulum(), engine), [0.1], [0.0], 1e-3, method, save=[1e-3])


@contextlib.contextmanager
def _nothing_kept() -> Iterator[None]:
    """Have mbkit and heyoka compile anew within the block."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(anew())
        # Whoever has not imported it has nothing compiled by it.
        if "heyoka" in sys.modules:
            stack.enter_context(_heyoka_anew())
        yield


@contextlib.contextmanager
def _heyoka_anew() -> Iterator[None]:
    from heyoka import llvm_state

    # Older ones have no cache on disk.
    if not hasattr(llvm_state, "set_diskcache_enabled"):
        llvm_state.clear_memcache()
        yield
        return
    with _SWITCHING:
        _BEFORE.append(llvm_state.get_diskcache_enabled())
        llvm_state.set_diskcache_enabled(False)
    llvm_state.clear_memcache()
    try:
        yield
    finally:
        with _SWITCHING:
            before = _BEFORE.pop()
            # The last one left, so that of the first that came: what it was before all of them.
            if not _BEFORE:
                llvm_state.set_diskcache_enabled(before)
