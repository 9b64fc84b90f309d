"""Run a program on arrays of 113-bit numbers, a batch of states at once.

Nothing is compiled: each operation is one loop over the states. Temporaries are
dropped with their last use. What does not depend on the state is computed once: an
argument that is the same for all states is given as one row, and NumPy's
broadcasting does the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from mbkit.derivation.arithmetic import Arithmetic
from mbkit.derivation.program import Program

__all__ = ["Extended"]

# States per pass: enough to share the interpreter's work, few enough for memory.
_LANES: Final = 128


class Extended:
    """A program in extended precision.

    Parameters
    ----------
    program : Program
    arithmetic : Arithmetic
    """

    def __init__(self, program: Program, arithmetic: Arithmetic) -> None:
        self.program, self.arithmetic = program, arithmetic
        functions = _functions(arithmetic)
        last: dict[int, int] = {}
        for k, operation in enumerate(program.operations):
            if operation.name != "input":
                last.update(dict.fromkeys(operation.arguments, k))
        for out in program.outputs:
            last.update((int(k), -1) for k in out.flat)
        dying: list[list[int]] = [[] for _ in program.operations]
        for i, k in last.items():
            if k >= 0:
                dying[k].append(i)
        self._inputs: list[tuple[int, int, int]] = []
        self._constants: list[tuple[int, Any]] = []
        self._steps: list[tuple[int, Callable[..., Any], tuple[int, ...], list[int]]] = []
        for k, operation in enumerate(program.operations):
            if operation.name == "input":
                which, entry = operation.arguments
                self._inputs.append((k, which, entry))
            elif operation.name == "const":
                self._constants.append((k, arithmetic.array(np.full(1, operation.value))))
            else:
                self._steps.append((k, functions[operation.name], operation.arguments, dying[k]))

    def __call__(self, *arguments: Any) -> list[Any]:
        """Return each output, shape (N, rows, columns), as 113-bit numbers.

        Parameters
        ----------
        *arguments : (N, n) or (1, n) array
            float64 or 113-bit; a single row stands for all states.
        """
        n = max((len(x) for x in arguments), default=1) if all(len(x) for x in arguments) else 0
        own = self.arithmetic
        outputs = [np.empty((n, *shape), dtype=own.dtype) for shape in self.program.shapes]
        with np.errstate(all="ignore"):
            columns = [np.ascontiguousarray(own.array(x).T) for x in arguments]
            for start in range(0, n, _LANES):
                part = slice(start, start + _LANES)
                self._run([c if c.shape[1] == 1 else c[:, part] for c in columns], [out[part] for out in outputs])
        return outputs

    def _run(self, columns: list[Any], outputs: list[Any]) -> None:
        values: list[Any] = [None] * len(self.program.operations)
        for k, which, entry in self._inputs:
            values[k] = columns[which][entry]
        for k, constant in self._constants:
            values[k] = constant
        for k, function, used, dying in self._steps:
            values[k] = function(*[values[i] for i in used])
            for i in dying:
                values[i] = None
        for out, where in zip(outputs, self.program.outputs, strict=True):
            for index in np.ndindex(where.shape):
                out[(slice(None), *index)] = values[int(where[index])]


def _functions(own: Arithmetic) -> dict[str, Callable[..., Any]]:
    zero, one = own.array(np.zeros(1)), own.array(np.ones(1))

    def truth(holds: Any) -> Any:
        return np.where(holds, one, zero)

    return {
        **own.functions,
        "add": np.add,
        "sub": np.subtract,
        "mul": np.multiply,
        "div": own.divide,
        "neg": np.negative,
        "sq": lambda x: x * x,
        "twice": lambda x: x + x,
        "inv": lambda x: own.divide(one, x),
        "hypot": lambda a, b: own.sqrt(a * a + b * b),
        "fabs": lambda x: np.where(x < zero, -x, x),
        "sign": lambda x: np.where(x > zero, one, np.where(x < zero, -one, x)),
        "fmin": lambda a, b: np.where((a < b) | (a != a), a, b),
        "fmax": lambda a, b: np.where((a > b) | (a != a), a, b),
        "lt": lambda a, b: truth(a < b),
        "le": lambda a, b: truth(a <= b),
        "eq": lambda a, b: truth(a == b),
        "ne": lambda a, b: truth(a != b),
        "not": lambda a: truth(a == zero),
        "and": lambda a, b: truth((a != zero) & (b != zero)),
        "or": lambda a, b: truth((a != zero) | (b != zero)),
        "if_else_zero": lambda a, b: np.where(a != zero, b, zero),
    }
