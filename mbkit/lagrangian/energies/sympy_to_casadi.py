"""SymPy's expressions as CasADi's, in which everything else is derived, compiled and measured."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import casadi as ca
import numpy as np
import sympy as sp
from sympy.core.function import AppliedUndef

from mbkit._check import Array
from mbkit.codegen.interpreter import Machine
from mbkit.errors import UnsupportedError
from mbkit.lagrangian.energies.symbols import name_of

_SAME_NAME: Final = "sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh exp log sign"
_UNARY: Final[dict[Any, Callable[[Any], Any]]] = {
    **{getattr(sp, name): getattr(ca, name) for name in _SAME_NAME.split()},
    sp.Abs: ca.fabs,
    sp.sec: lambda x: 1 / ca.cos(x),
    sp.csc: lambda x: 1 / ca.sin(x),
    sp.cot: lambda x: ca.cos(x) / ca.sin(x),
}
_COMPARED: Final[dict[Any, Callable[[Any, Any], Any]]] = {
    sp.StrictLessThan: lambda a, b: a < b,
    sp.LessThan: lambda a, b: a <= b,
    sp.StrictGreaterThan: lambda a, b: b < a,
    sp.GreaterThan: lambda a, b: b <= a,
}


class Conversion:
    """Translates SymPy to CasADi, each subexpression once; `number` returns the number or symbol for a float."""

    def __init__(self, symbols: Mapping[sp.Symbol, Any], number: Callable[[float], Any]) -> None:
        self._done: dict[Any, Any] = dict(symbols)
        self._number = number

    def __call__(self, x: Any) -> Any:
        """Return an expression."""
        if x not in self._done:
            self._done[x] = self._converted(x)
        return self._done[x]

    def matrix(self, x: Any) -> Any:
        """Return a column of expressions."""
        return ca.vertcat(ca.SX(0, 1), *(ca.SX(self(e)) for e in x))

    def _converted(self, x: Any) -> Any:
        if x.is_Rational:
            # Two whole numbers are exact where one quotient is rounded.
            top = self._whole(int(x.p))
            return top if x.q == 1 else top / self._whole(int(x.q))
        if x.is_number:
            return self._number(float(x))
        if x.is_Add:
            return sum((self(e) for e in x.args[1:]), self(x.args[0]))
        if x.is_Mul:
            return self._product(x)
        if x.is_Pow:
            return self._power(x.base, x.exp)
        if x.func in _UNARY:
            return _UNARY[x.func](self(x.args[0]))
        if x.func is sp.atan2:
            return ca.atan2(self(x.args[0]), self(x.args[1]))
        if x.func in (sp.Min, sp.Max):
            pick, out = (ca.fmin if x.func is sp.Min else ca.fmax), self(x.args[0])
            for e in x.args[1:]:
                out = pick(out, self(e))
            return out
        if x.func is sp.Piecewise:
            return self._pieces(x)
        if isinstance(x, (AppliedUndef, sp.Derivative, sp.Subs)):
            function = min(x.atoms(AppliedUndef), key=str)
            shown = function if isinstance(x, AppliedUndef) else f"a derivative of {name_of(function)}"
            raise UnsupportedError(
                f"{shown}: an undefined function has no value; give it one with "
                f"substituted({{{name_of(function)}(x): ...}})"
            )
        raise UnsupportedError(
            f"{x.func}: no engine computes this function; there are powers, sin, cos, tan, their inverses, "
            "sinh, cosh, tanh and theirs, exp, log, Abs, sign, Min, Max and Piecewise"
        )

    def _pieces(self, x: Any) -> Any:
        out: Any = ca.SX(np.nan)
        for value, condition in reversed(x.args):
            out = self(value) if condition is sp.true else ca.if_else(self._holds(condition), self(value), out)
        return out

    def _holds(self, condition: Any) -> Any:
        """Return a comparison, or several joined, as 1 or 0."""
        if condition.func in _COMPARED:
            return _COMPARED[condition.func](ca.SX(self(condition.lhs)), ca.SX(self(condition.rhs)))
        if condition.func in (sp.And, sp.Or):
            join, out = (ca.logic_and if condition.func is sp.And else ca.logic_or), self._holds(condition.args[0])
            for e in condition.args[1:]:
                out = join(out, self._holds(e))
            return out
        raise UnsupportedError(f"Piecewise: {condition} is no comparison of numbers, nor several joined by & or |")

    def _whole(self, n: int) -> Any:
        # Small powers of two change no digit, so they need no symbol.
        return float(n) if abs(n) in (0, 1, 2, 4) else self._number(float(n))

    def _product(self, x: Any) -> Any:
        above, below = [], []
        for e in x.args:
            if e.is_Pow and e.exp.is_Rational and e.exp.is_negative:
                below.append(self._power(e.base, -e.exp))
            else:
                above.append(self(e))
        out: Any = 1.0
        for e in above:
            out = out * e
        for e in below:
            out = out / e
        return out

    def _power(self, base: Any, exponent: Any) -> Any:
        if exponent.is_Rational and exponent.is_negative:
            return 1.0 / self._power(base, -exponent)
        if exponent.is_Integer and int(exponent) <= 64:
            return _repeated(self(base), int(exponent))
        if exponent.is_Rational and exponent.q == 2 and int(exponent.p) <= 64:
            return ca.sqrt(_repeated(self(base), int(exponent.p)))
        if base is sp.E:
            return ca.exp(self(exponent))
        return ca.power(self(base), self(exponent))


def _repeated(x: Any, n: int) -> Any:
    """Return xⁿ by squaring: products are exact to rounding in any precision."""
    out = None
    while n:
        if n & 1:
            out = x if out is None else out * x
        n >>= 1
        if n:
            x = x * x
    return 1.0 if out is None else out


# Expressions as functions of arrays, in CasADi's machine.


class Numeric:
    """A matrix of SymPy expressions as a function of arrays, one argument per sequence of symbols."""

    def __init__(self, expressions: Any, *arguments: Sequence[sp.Symbol]) -> None:
        inputs = [ca.SX.sym(f"x{k}", len(symbols)) for k, symbols in enumerate(arguments)]
        self._shape = expressions.shape
        names = {s: x[i] for symbols, x in zip(arguments, inputs, strict=True) for i, s in enumerate(symbols)}
        column = Conversion(names, float).matrix(list(expressions))
        self._machine = Machine(ca.Function("expressions", inputs, [ca.densify(column)], {"cse": True}))

    def __call__(self, *arguments: Array) -> Array:
        """Return the matrix at one state, (m, n), or at each of a batch, (N, m, n)."""
        lead = np.broadcast_shapes(*(x.shape[:-1] for x in arguments))
        rows = [np.ascontiguousarray(np.broadcast_to(x, (*lead, x.shape[-1])), dtype=np.float64) for x in arguments]
        return self._machine(*rows)[0].reshape(*lead, *self._shape)
