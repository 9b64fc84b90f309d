"""`Formula`: a function of named numbers as plain data, a list of scalar operations that any arithmetic can run.

A description holds no expression of CasADi or SymPy: it pickles, has a digest, and loads neither. `mbkit.lagrangian`
reads their expressions into formulas, and the derivation, SymPy and NumPy each have a table of the operations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

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


@dataclass(frozen=True)
class Arithmetic:
    """What stands for a number of a formula, and the operations by name."""

    number: Callable[[float], Any]
    operations: Mapping[str, Callable[..., Any]]


def _fmin(a: Any, b: Any) -> Any:
    return np.where(np.isnan(a) | (a < b), a, b)


def _fmax(a: Any, b: Any) -> Any:
    return np.where(np.isnan(a) | (a > b), a, b)


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
        "fmin": _fmin,
        "fmax": _fmax,
        "lt": lambda a, b: 1.0 * (a < b),
        "le": lambda a, b: 1.0 * (a <= b),
        "eq": lambda a, b: 1.0 * (a == b),
        "ne": lambda a, b: 1.0 * (a != b),
        "and": lambda a, b: 1.0 * np.logical_and(a, b),
        "or": lambda a, b: 1.0 * np.logical_or(a, b),
        "if_else_zero": lambda a, b: np.where(a, b, 0.0),
    },
)
