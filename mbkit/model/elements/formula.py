"""`Formula`: a function of named numbers as plain data, a list of scalar operations that any arithmetic can run.

A description holds no expression of CasADi or SymPy: it pickles, has a digest, and loads neither. `mbkit.lagrangian`
reads their expressions into formulas, and the derivation, SymPy and NumPy each have a table of the operations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partialmethod
from typing import Any, Final

import numpy as np

from mbkit.errors import InputError

#: Name of an operation, the earlier ones that it takes, and the value of a constant.
Operation = tuple[str, tuple[int, ...], float]


@dataclass(frozen=True)
class Formula:
    """A function of named numbers with one or several results.

    Attributes
    ----------
    arguments : tuple of str
        Names of its free symbols.
    operations : tuple of (str, tuple of int, float)
        In an order in which they can be run: ``("input", (k,), 0.0)`` is argument k, ``("const", (), x)`` a number, and
        every other one is named as in `mbkit.codegen.program`, with the places of its operands.
    outputs : tuple of int
        The operations that give the results.
    """

    arguments: tuple[str, ...]
    operations: tuple[Operation, ...]
    outputs: tuple[int, ...]

    @property
    def constants(self) -> tuple[float, ...]:
        """The numbers in it."""
        return tuple(value for name, _, value in self.operations if name == "const")

    def __call__(self, values: Mapping[str, Any], arithmetic: Arithmetic) -> list[Any]:
        """Return the results for values of the arguments, in an arithmetic."""
        at = [values[name] for name in self.arguments]
        done: list[Any] = []
        for name, operands, value in self.operations:
            if name == "input":
                done.append(at[operands[0]])
            elif name == "const":
                done.append(arithmetic.number(value))
            else:
                done.append(arithmetic.operations[name](*(done[i] for i in operands)))
        return [done[i] for i in self.outputs]


class _Recorded:
    """A number whose sums, products, quotients and whole powers are written down."""

    def __init__(self, operations: list[Operation], place: int) -> None:
        self._operations, self.place = operations, place

    def _new(self, name: str, *operands: int, value: float = 0.0) -> _Recorded:
        self._operations.append((name, operands, value))
        return _Recorded(self._operations, len(self._operations) - 1)

    def number(self, x: Any) -> _Recorded:
        """Return it, or a constant."""
        return x if isinstance(x, _Recorded) else self._new("const", value=float(x))

    def _with(self, x: Any, name: str, *, behind: bool = False) -> _Recorded:
        pair = (self.number(x).place, self.place) if behind else (self.place, self.number(x).place)
        return self._new(name, *pair)

    def __neg__(self) -> _Recorded:
        return self._new("neg", self.place)

    def exp(self) -> _Recorded:
        """Return e to this power."""
        return self._new("exp", self.place)

    def __pow__(self, n: int) -> _Recorded:
        if not (isinstance(n, int) and n > 0):
            raise InputError(f"power: expected a whole number above zero in a law that is written down, got {n!r}")
        return self if n == 1 else self * self ** (n - 1)

    __add__, __sub__ = partialmethod(_with, name="add"), partialmethod(_with, name="sub")
    __mul__, __truediv__ = partialmethod(_with, name="mul"), partialmethod(_with, name="div")
    __radd__, __rsub__ = partialmethod(_with, name="add", behind=True), partialmethod(_with, name="sub", behind=True)
    __rmul__ = partialmethod(_with, name="mul", behind=True)
    __rtruediv__ = partialmethod(_with, name="div", behind=True)


def written(law: Callable[..., Any], *arguments: str) -> Formula:
    """Return the formula of a law: a function of these numbers of sums, products, quotients and whole powers."""
    operations: list[Operation] = [("input", (k,), 0.0) for k in range(len(arguments))]
    own = [_Recorded(operations, k) for k in range(len(arguments))]
    results = law(*own)
    outputs = tuple(own[0].number(x).place for x in (results if isinstance(results, tuple) else (results,)))
    return Formula(arguments, tuple(operations), outputs)


@dataclass(frozen=True)
class Arithmetic:
    """What stands for a number of a formula, and the operations by name."""

    number: Callable[[float], Any]
    operations: Mapping[str, Callable[..., Any]]


#: On floats and NumPy arrays.
NUMPY: Final = Arithmetic(
    float,
    {
        "neg": lambda x: -x,
        "sq": lambda x: x * x,
        "twice": lambda x: x + x,
        "inv": lambda x: 1.0 / x,
        "fabs": np.abs,
        "not": lambda x: 1.0 * (x == 0),
        **{n: getattr(np, n) for n in ("sign", "sqrt", "sin", "cos", "tan", "exp", "expm1", "log", "log1p")},
        **{n: getattr(np, n) for n in ("sinh", "cosh", "tanh", "hypot")},
        **{n: getattr(np, n.replace("a", "arc", 1)) for n in ("asin", "acos", "atan", "asinh", "acosh", "atanh")},
        "add": lambda a, b: a + b,
        "sub": lambda a, b: a - b,
        "mul": lambda a, b: a * b,
        "div": lambda a, b: a / b,
        "pow": np.power,
        "atan2": np.arctan2,
        # These propagate NaN, as the compiled ones do.
        "fmin": np.minimum,
        "fmax": np.maximum,
        "lt": lambda a, b: 1.0 * (a < b),
        "le": lambda a, b: 1.0 * (a <= b),
        "eq": lambda a, b: 1.0 * (a == b),
        "ne": lambda a, b: 1.0 * (a != b),
        "and": lambda a, b: 1.0 * np.logical_and(a, b),
        "or": lambda a, b: 1.0 * np.logical_or(a, b),
        "if_else_zero": lambda a, b: np.where(a, b, 0.0),
    },
)
