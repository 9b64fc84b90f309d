"""The numbers of a description as the equations read them: floats, or symbols.

Every number of the model enters expressions here. With literal constants it is a float, and CasADi folds it in double
while the graph is built. With symbols it is an argument, so that the graph can be evaluated in any precision.
"""

from __future__ import annotations

from functools import lru_cache, reduce
from types import SimpleNamespace
from typing import Any, Literal

import casadi as ca
import numpy as np

from mbkit._check import Array
from mbkit.errors import InputError
from mbkit.model import Coupler, Model, NoSlip
from mbkit.model.elements.references import KINDS_OF_PARTS
from mbkit.model.loops import tangents
from mbkit.model.parts import numbers

# CasADi's operators first search a conversion of their operands, some 15 µs each; `SX.binary` takes 2, and 4 with a
# float, which it converts each time. A tree's kinematics are tens of thousands of them. This module replaces CasADi in
# the formulas of the joint types.


class Scalar(ca.SX):
    """A `casadi.SX` whose operators take expressions and floats, and no other operand.

    Zeros and ones among the floats vanish, as they do in CasADi.
    """

    def __add__(self, other: Any) -> Any:
        return self if _is(other, 0.0) else _of(ca.OP_ADD, self, other)

    def __radd__(self, other: Any) -> Any:
        return self if _is(other, 0.0) else _of(ca.OP_ADD, other, self)

    def __sub__(self, other: Any) -> Any:
        return self if _is(other, 0.0) else _of(ca.OP_SUB, self, other)

    def __rsub__(self, other: Any) -> Any:
        return _of(ca.OP_SUB, other, self)

    def __mul__(self, other: Any) -> Any:
        if _is(other, 0.0):
            return 0.0
        return self if _is(other, 1.0) else _of(ca.OP_MUL, self, other)

    def __rmul__(self, other: Any) -> Any:
        if _is(other, 0.0):
            return 0.0
        return self if _is(other, 1.0) else _of(ca.OP_MUL, other, self)

    def __truediv__(self, other: Any) -> Any:
        return _of(ca.OP_DIV, self, other)

    def __rtruediv__(self, other: Any) -> Any:
        return _of(ca.OP_DIV, other, self)

    def __neg__(self) -> Any:
        return scalar(ca.SX.unary(ca.OP_NEG, self))


def _is(x: Any, number: float) -> bool:
    return not isinstance(x, ca.SX) and x == number


# Equal floats are one node of a graph anyway.
_constant = lru_cache(maxsize=4096)(ca.SX)


def _of(operation: int, a: Any, b: Any) -> Any:
    if not isinstance(b, ca.SX):
        b = _constant(b)
    elif not isinstance(a, ca.SX):
        a = _constant(a)
    return scalar(ca.SX.binary(operation, a, b))


def scalar(x: Any) -> Any:
    """Return an expression as a `Scalar`: the object itself, which is still CasADi's."""
    x.__class__ = Scalar
    return x


def sin(x: Any) -> Any:
    """Return sin x."""
    return scalar(ca.SX.unary(ca.OP_SIN, x))


def cos(x: Any) -> Any:
    """Return cos x."""
    return scalar(ca.SX.unary(ca.OP_COS, x))


Constants = Literal["literal", "symbols"]


def is_zero(value: Any) -> bool:
    """Return whether a number of the model is zero for good, and not a symbol."""
    return isinstance(value, float) and value == 0.0


def _sum(a: Any, b: Any) -> Any:
    return [x + y for x, y in zip(a, b, strict=True)] if isinstance(a, list) else a + b


class Values:
    """Every number of a model that enters its equations.

    The parts have their own attribute names, with scalars that are floats or `casadi.SX`; vectors are lists of them,
    matrices lists of rows. A number that stands for an expression of parameters is that expression.

    Parameters
    ----------
    model : Model
    constants : {"literal", "symbols"}
        Whether the model's numbers are floats or symbols. Zeros are floats either way, and so are the ones of rotations
        and axes, so that they vanish.

    Attributes
    ----------
    gravity : list of 3 scalars
    named : dict of str to casadi.SX
        The parameters' symbols.
    parameters : (p, 1) casadi.SX
        In the order of `model.parameters`; empty where they are among the constants.
    constants : (k, 1) casadi.SX
        The symbols that stand for numbers: the parameters, then the others, of which equal ones share a symbol.
    constant_values : (k,) array
        Their values, of parameters the nominal ones.
    """

    def __init__(self, model: Model, constants: Constants = "literal") -> None:
        if constants not in ("literal", "symbols"):
            raise InputError(f"constants: expected 'literal' or 'symbols', got {constants!r}")
        self.model = model
        self._symbolic = constants == "symbols"
        self._pool: dict[float, Any] = {}
        named = self.named = {name: scalar(ca.SX.sym(name)) for name in model.parameters}
        if self._symbolic:
            model.require_values("constants='symbols'")
        self.parameters = ca.SX(0, 1) if self._symbolic else ca.vertcat(ca.SX(0, 1), *named.values())
        self._bound = {
            (b.where, b.part, b.field, b.index): b.expression.evaluate(lambda p: named[p.name], self._scalar)
            for b in model.bindings
        }
        self._of: dict[tuple[type, str], Any] = {}
        self.gravity = self._entries(("gravity", "", "gravity"), (), model.gravity)
        for part in (x for section in KINDS_OF_PARTS for x in getattr(model, section)):
            self.of(part)
            # Of what is evaluated later too: the constants are an argument that must not grow.
            for x in getattr(part, "constants", ()):
                self._scalar(x)

    @property
    def constants(self) -> Any:
        """The symbols that stand for numbers so far."""
        first = self.named.values() if self._symbolic else ()
        return ca.vertcat(ca.SX(0, 1), *first, *self._pool.values())

    @property
    def constant_values(self) -> Array:
        """The numbers that the symbols stand for."""
        first = self.named if self._symbolic else ()
        return np.array([*(self.model.parameters[n] for n in first), *self._pool], dtype=np.float64)

    def number(self, value: float) -> Any:
        """Return what stands for a number that is no part's."""
        return self._scalar(value)

    def of(self, part: Any) -> Any:
        """Return the numbers of a part by their names; a frame of a body itself has zeros and ones only.

        A joint that mimics has `ratio` and `offset` too; `rotors` is what adds to T along rates.
        """
        key = type(part), part.name
        if key not in self._of:
            given = [(name, rule.direction, x) for name, rule, x in numbers(part) if rule.acts]
            if isinstance(part, NoSlip):
                given.append(("tangents", True, tangents(part.axis_b)))
            place = part.section, part.name
            own = {name: self._entries((*place, name), (), x, fixed) for name, fixed, x in given}
            if isinstance(part, Coupler):
                own["ratios"] = own["ratio"] if isinstance(own["ratio"], list) else [own["ratio"]]
            if turning := [own[name] for name, rule, _ in numbers(part) if rule.does == "T"]:
                own["rotors"] = reduce(_sum, turning)
            self._of[key] = SimpleNamespace(**own)
        return self._of[key]

    def _entries(self, place: tuple[str, str, str], index: tuple[int, ...], value: Any, direction: bool = False) -> Any:
        if np.ndim(value):
            return [self._entries(place, (*index, i), x, direction) for i, x in enumerate(value)]
        if (*place, index) in self._bound:
            return self._bound[*place, index]
        # A one of a direction keeps a planar arm planar. Elsewhere a one is worth a symbol: a sum of literal masses
        # could be divided by, and its quotient be rounded to double.
        return self._scalar(float(value), direction)

    def _scalar(self, value: float, direction: bool = False) -> Any:
        if not self._symbolic or value == 0.0 or (direction and abs(value) == 1.0):
            return value
        size = abs(value)
        if size not in self._pool:
            self._pool[size] = scalar(ca.SX.sym(f"c{len(self._pool)}"))
        return self._pool[size] if value > 0 else -self._pool[size]
