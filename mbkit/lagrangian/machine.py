"""Run a CasADi function on NumPy arrays without copies, one state or many."""

from __future__ import annotations

import threading
from typing import Any

import casadi as ca
import numpy as np

from mbkit._check import Array

__all__ = ["Machine"]


class Machine:
    """A function of vectors, evaluated in CasADi's own machine.

    A C-ordered batch ``(N, n)`` is CasADi's column-major ``n`` by ``N``, so arrays
    are handed over as they are.
    """

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        self._sizes: dict[int, tuple[Any, Any, list[Any], list[Any]]] = {}
        # CasADi's buffers belong to one call at a time.
        self._lock = threading.Lock()

    def _prepared(self, n: int) -> tuple[Any, Any, list[Any], list[Any]]:
        if n not in self._sizes:
            if len(self._sizes) > 8:
                self._sizes.clear()
            f = self.function if n == 1 else self.function.map(n)
            buffer: Any
            buffer, run = f.buffer()
            inputs: list[Any] = [np.zeros((n, self.function.size1_in(i))) for i in range(f.n_in())]
            outputs: list[Any] = [
                np.zeros((n, self.function.size2_out(i), self.function.size1_out(i))) for i in range(f.n_out())
            ]
            # An empty array has no memory to hand over, and CasADi reads none.
            for i, x in enumerate(inputs):
                if x.size:
                    buffer.set_arg(i, memoryview(x))
            for i, x in enumerate(outputs):
                if x.size:
                    buffer.set_res(i, memoryview(x))
            self._sizes[n] = (buffer, run, inputs, outputs)
        return self._sizes[n]

    def __call__(self, *arguments: Array) -> list[Array]:
        """Return each output with shape (rows, columns) or (N, rows, columns)."""
        single = arguments[0].ndim == 1
        n = 1 if single else arguments[0].shape[0]
        if n == 0:
            f = self.function
            return [np.empty((0, f.size1_out(i), f.size2_out(i))) for i in range(f.n_out())]
        for i, x in enumerate(arguments):
            if x.shape[-1] != self.function.size1_in(i):
                raise ValueError(f"argument {i}: expected {self.function.size1_in(i)} entries, got shape {x.shape}")
        with self._lock:
            _, run, inputs, outputs = self._prepared(n)
            for held, given in zip(inputs, arguments, strict=True):
                held[:] = given
            run()
            results = [np.array(np.swapaxes(x, 1, 2), order="C") for x in outputs]
        return [x[0] for x in results] if single else results
