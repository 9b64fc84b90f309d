"""Compiled functions called one after another without going back to Python in between."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cache
from typing import Final, NamedTuple

import numpy as np

from mbkit._check import Array
from mbkit.derivation import jit
from mbkit.derivation.batch_code import RUN
from mbkit.derivation.compiled import Compiled, aligned, shared_object

__all__ = ["Call", "CallSequence"]

# With the signature of a compiled function's own loop, so that it is loaded like one:
# the list holds, for each call, the addresses of loop, table and work space, and the
# number of states.
_CODE: Final = f"""
define void @{RUN}(ptr %list, ptr %unused, i64 %first, i64 %last) nounwind {{
entry:
  %any = icmp slt i64 %first, %last
  br i1 %any, label %one, label %done
one:
  %i = phi i64 [ %first, %entry ], [ %next, %one ]
  %start = mul i64 %i, 4
  %at = getelementptr ptr, ptr %list, i64 %start
  %run = load ptr, ptr %at
  %at1 = getelementptr ptr, ptr %at, i64 1
  %table = load ptr, ptr %at1
  %at2 = getelementptr ptr, ptr %at, i64 2
  %work = load ptr, ptr %at2
  %at3 = getelementptr ptr, ptr %at, i64 3
  %states = load i64, ptr %at3
  call void %run(ptr %table, ptr %work, i64 0, i64 %states)
  %next = add i64 %i, 1
  %more = icmp slt i64 %next, %last
  br i1 %more, label %one, label %done
done:
  ret void
}}
"""


class Call(NamedTuple):
    """A function and the (N, n) arrays that it reads and writes, as in `Compiled.run`."""

    code: Compiled
    inputs: Sequence[Array]
    outputs: Sequence[Array]


class CallSequence:
    """Calls on fixed arrays, made in order; one thread may run it at a time.

    Parameters
    ----------
    calls : sequence of Call
        Their arrays are kept alive, and may be changed between runs.
    times : int
        How often they stand in the sequence, one round after another.
    """

    def __init__(self, calls: Sequence[Call], times: int = 1) -> None:
        self._calls = tuple(calls)
        self._work = aligned(max((call.code.work_size for call in calls), default=0))
        # The sum in which a compiled function tells that something is not finite.
        self._work[:] = 0.0
        self._tables = [call.code.table(call.inputs, call.outputs) for call in calls]
        entries = [
            (_address(call.code), table.ctypes.data, self._work.ctypes.data, len(call.inputs[0]))
            for call, table in zip(calls, self._tables, strict=True)
        ]
        self._list = np.array(entries * times, dtype=np.int64)
        self._runner = _runner()

    def run(self, first: int, last: int) -> None:
        """Make the calls from `first` to before `last`; other Python threads run meanwhile."""
        self._runner.run(self._list.ctypes.data, None, first, last)


def _address(code: Compiled) -> int:
    return ctypes.cast(code.loaded.run, ctypes.c_void_p).value or 0


@cache
def _runner() -> jit.Loaded:
    return jit.load(shared_object("sequence", lambda: jit.object_code(_CODE)))
