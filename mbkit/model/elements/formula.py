"""`Formula`: a function of named numbers as plain data, a list of scalar operations that any arithmetic can run.

A description holds no expression of CasADi or SymPy: it pickles, has a digest, and loads neither. `mbkit.lagrangian`
reads their expressions into formulas, and the derivation, SymPy and NumPy each have a table of the operations.
"""

from __future__ import annotations

import operator
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


#: What an arithmetic compares and joins conditions by, unless it has its own.
_CONDITIONS: Final[dict[str, Callable[..., Any]]] = {
    **{name: getattr(operator, name) for name in ("lt", "le", "eq", "ne")},
    "and": operator.and_,
    "or": operator.or_,
}


def completed(
    own: Mapping[str, Callable[..., Any]],
    number: Callable[[float], Any] = float,
    select: Callable[[Any, Any, Any], Any] = np.where,
    conditions: Mapping[str, Callable[..., Any]] = _CONDITIONS,
    holds: Callable[[Any], Any] | None = None,
) -> dict[str, Callable[..., Any]]:
    """Return all operations: an arithmetic's own ones, and what the others mean by those.

    `select` chooses between two numbers by a condition, and `holds` is that of a decision of 1 or 0. fmin and fmax
    propagate NaN, which counts as true.
    """
    zero, one, of = number(0.0), number(1.0), conditions
    plain = {name: getattr(operator, name) for name in ("add", "sub", "mul", "neg")} | {"div": operator.truediv}
    plain |= {name: own[name] for name in plain.keys() & own.keys()}
    true = holds or (lambda x: of["ne"](x, zero))

    def decided(name: str, read: Callable[[Any], Any] = lambda x: x) -> Callable[..., Any]:
        return lambda a, b: select(of[name](read(a), read(b)), one, zero)

    return {
        **plain,
        "sq": lambda x: plain["mul"](x, x),
        "twice": lambda x: plain["add"](x, x),
        "inv": lambda x: plain["div"](one, x),
        "hypot": lambda a, b: own["sqrt"](a * a + b * b),
        "fabs": lambda x: select(of["lt"](x, zero), plain["neg"](x), x),
        "sign": lambda x: select(of["lt"](zero, x), one, select(of["lt"](x, zero), number(-1.0), x)),
        "fmin": lambda a, b: select(of["or"](of["lt"](a, b), of["ne"](a, a)), a, b),
        "fmax": lambda a, b: select(of["or"](of["lt"](b, a), of["ne"](a, a)), a, b),
        **{name: decided(name) for name in ("lt", "le", "eq", "ne")},
        "not": lambda x: select(true(x), zero, one),
        **{name: decided(name, true) for name in ("and", "or")},
        "if_else_zero": lambda a, b: select(true(a), b, zero),
        **own,
    }


_SAME: Final = ("sign", "sqrt", "sin", "cos", "tan", "exp", "expm1", "log", "log1p", "sinh", "cosh", "tanh", "hypot")
_INVERSE: Final = ("asin", "acos", "atan", "asinh", "acosh", "atanh", "atan2")
_FUNCTIONS: Final[dict[str, Callable[..., Any]]] = {
    **{name: getattr(np, name) for name in _SAME},
    **{name: getattr(np, name.replace("a", "arc", 1)) for name in _INVERSE},
    "fabs": np.abs,
    "pow": np.power,
    "fmin": np.minimum,
    "fmax": np.maximum,
}
#: On floats and NumPy arrays.
NUMPY: Final = Arithmetic(float, completed(_FUNCTIONS, select=lambda holds, yes, no: np.where(holds, yes, no)[()]))
