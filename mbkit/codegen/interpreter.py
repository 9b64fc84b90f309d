"""Run a CasADi function in CasADi's interpreter, one state or many.

It needs no compilation: for few evaluations, and without a compiler. `Compiled` has the same interface.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from mbkit._check import Array, all_finite
from mbkit._fork import fork_safe


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
