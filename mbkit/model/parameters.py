"""Named parameters: numbers of a description that stay free until it is evaluated."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from mbkit._check import real, shown
from mbkit.errors import InputError
from mbkit.model.parts import Joint


def _exp(x: Any) -> Any:
    """Return e to a number of any kind: a float, an expression, or a scalar of CasADi or SymPy."""
    return math.exp(x) if isinstance(x, float) else x.exp() if hasattr(x, "exp") else math.e**x


#: Operation and sign by name.
_OPERATIONS: Final[dict[str, tuple[Callable[..., Any], str]]] = {
    "add": (operator.add, "+"),
    "sub": (operator.sub, "-"),
    "mul": (operator.mul, "*"),
    "div": (operator.truediv, "/"),
    "neg": (operator.neg, "-"),
    "exp": (_exp, "exp"),
}
_Operator = Callable[["Expression", Any], "Expression"]


def _operators(name: str) -> tuple[_Operator, _Operator]:
    """Return an operator and its reflection."""
    return lambda self, other: _combined(name, self, other), lambda self, other: _combined(name, other, self)


class Expression:
    """A number that depends on named parameters.

    Sums, differences, products, quotients, powers and `exp` of expressions and numbers are expressions; so a catalog's
    formulas take them like floats. The exponent of a power is a whole number or one half.
    """

    def evaluate(self, parameter: Callable[[Parameter], Any], number: Callable[[float], Any]) -> Any:
        """Return the value with scalars of any kind: those that two functions return for a parameter and a number."""
        raise NotImplementedError

    def parameters(self) -> Iterator[Parameter]:
        """Iterate over the parameters in the order in which they stand, repeated where they are."""
        raise NotImplementedError

    __add__, __radd__ = _operators("add")
    __sub__, __rsub__ = _operators("sub")
    __mul__, __rmul__ = _operators("mul")
    __truediv__, __rtruediv__ = _operators("div")

    def __neg__(self) -> Expression:
        return _Operation("neg", (self,))

    def __pos__(self) -> Expression:
        return self

    def exp(self) -> Expression:
        """Return e to this number, which `numpy.exp` calls too."""
        return _Operation("exp", (self,))

    def __pow__(self, exponent: float) -> Expression:
        if not _is_number(exponent) or abs(exponent) > 100 or not (float(exponent).is_integer() or exponent == 0.5):
            raise InputError(
                f"power of {self}: expected a whole number from -100 to 100 or 0.5 as exponent, got {shown(exponent)}"
            )
        return _Power(self, float(exponent))


#: Type of a physical number in the builder and the catalog.
Number = float | Expression


@dataclass(frozen=True)
class Parameter(Expression):
    """A named number of a description, such as a mass that a study varies.

    It may stand for any number of a part that acts, for a point or a length, and for gravity; not for orientations,
    axes, limits and Stribeck's curve. The error for those says why.

    Parameters
    ----------
    name : str
        One name is one parameter throughout a model.
    value : float, optional
        Its nominal value. Without one the model can be built, and evaluated once `Dynamics.at` or
        `Model.with_parameters` gives it.

    Examples
    --------
    >>> import mbkit as mb
    >>> model = mb.catalog.double_pendulum(mass1=mb.Parameter("m1", 2.0))
    >>> dict(model.parameters)
    {'m1': 2.0}
    >>> model.with_parameters(m1=3.0) == mb.catalog.double_pendulum(mass1=3.0)
    True
    """

    name: str
    value: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name or any("\ud800" <= c <= "\udfff" for c in self.name):
            raise InputError(f"Parameter: expected a name, got {shown(self.name)}")
        if self.value is not None:
            # + 0.0 makes one of the two zeros.
            object.__setattr__(self, "value", real(f"Parameter {self.name!r}", self.value) + 0.0)

    def evaluate(self, parameter: Callable[[Parameter], Any], number: Callable[[float], Any]) -> Any:  # noqa: ARG002
        """Return what stands for this parameter."""
        return parameter(self)

    def parameters(self) -> Iterator[Parameter]:
        """Iterate over this one."""
        yield self

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True)
class _Operation(Expression):
    """An operation on one or two operands, of which at least one is an expression."""

    name: str
    operands: tuple[Number, ...]

    def evaluate(self, parameter: Callable[[Parameter], Any], number: Callable[[float], Any]) -> Any:
        values = [x.evaluate(parameter, number) if isinstance(x, Expression) else number(x) for x in self.operands]
        return _OPERATIONS[self.name][0](*values)

    def parameters(self) -> Iterator[Parameter]:
        for x in self.operands:
            if isinstance(x, Expression):
                yield from x.parameters()

    def __str__(self) -> str:
        texts = [str(x) if isinstance(x, Expression) else f"{x:g}" for x in self.operands]
        sign = _OPERATIONS[self.name][1]
        if self.name == "exp":
            return f"exp({texts[0]})"
        return f"({sign}{texts[0]})" if self.name == "neg" else f"({texts[0]} {sign} {texts[1]})"


@dataclass(frozen=True)
class _Power(Expression):
    """A power; no symbol replaces its exponent."""

    base: Expression
    exponent: float

    def evaluate(self, parameter: Callable[[Parameter], Any], number: Callable[[float], Any]) -> Any:
        base = self.base.evaluate(parameter, number)
        return base ** (int(self.exponent) if self.exponent.is_integer() else self.exponent)

    def parameters(self) -> Iterator[Parameter]:
        return self.base.parameters()

    def __str__(self) -> str:
        return f"{self.base}**{self.exponent:g}"


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


def _combined(name: str, *operands: Any) -> Expression:
    if not all(isinstance(x, Expression) or _is_number(x) for x in operands):
        # Python then asks the other operand: a NumPy array goes entry by entry.
        return NotImplemented  # type: ignore[no-any-return]
    numbers = (x if isinstance(x, Expression) else real("number in an expression", x) for x in operands)
    return _Operation(name, tuple(numbers))


def known(value: Number) -> bool:
    """Return whether a number has a value: each of its parameters has one."""
    return not isinstance(value, Expression) or all(p.value is not None for p in value.parameters())


def nominal(value: Number) -> float:
    """Return a number at its parameters' values; NaN where one has none.

    Raises
    ------
    InputError
        The value does not exist or is not finite, such as a quotient by zero.
    """
    if not isinstance(value, Expression):
        return value
    if not known(value):
        return float("nan")
    at = ", ".join(f"{p.name} = {p.value:g}" for p in dict.fromkeys(value.parameters()))
    try:
        number = value.evaluate(lambda p: p.value, float)
    except (ZeroDivisionError, OverflowError) as error:
        raise InputError(f"{value} at {at}: {error}") from None
    return real(f"{value} at {at}", number)


@dataclass(frozen=True)
class Binding:
    """One number of a part that is an expression of parameters."""

    where: str  # the description's attribute: "bodies", "joints", ... or "gravity"
    part: str  # its name, of a motion its joint's; empty for gravity
    field: str  # its attribute; of a mimic joint also "ratio" and "offset"
    index: tuple[int, ...]  # of an entry of an array
    expression: Expression


def split(where: str, part: str, fields: dict[str, Any]) -> tuple[dict[str, Any], tuple[Binding, ...]]:
    """Return a part's fields with nominal numbers, and the bindings of those that were expressions."""
    numbers, bindings = dict(fields), []
    for field, value in fields.items():
        if isinstance(value, Expression):
            numbers[field] = nominal(value)
            bindings.append(Binding(where, part, field, (), value))
        elif isinstance(value, np.ndarray) and value.dtype == object:
            numbers[field] = np.array([nominal(x) for x in value.flat], dtype=np.float64).reshape(value.shape)
            bindings += [
                Binding(where, part, field, index, x) for index, x in np.ndenumerate(value) if isinstance(x, Expression)
            ]
    return numbers, tuple(bindings)


def with_numbers(part: Any, numbers: Iterable[tuple[str, tuple[int, ...], Number]]) -> Any:
    """Return a part with numbers of some fields replaced by nominal ones."""
    changes: dict[str, Any] = {}
    for field, index, value in numbers:
        if isinstance(part, Joint) and field in ("ratio", "offset"):
            if part.mimic:
                changes["mimic"] = replace(changes.get("mimic", part.mimic), **{field: nominal(value)})
        elif index:
            array = changes.setdefault(field, np.array(getattr(part, field)))
            array[index] = nominal(value)
        else:
            changes[field] = nominal(value)
    return replace(part, **changes) if changes else part
