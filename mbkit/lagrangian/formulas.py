"""Expressions of CasADi and SymPy, and splines of SciPy, read as the plain data that a description holds.

`mbkit.model` loads none of the three; its builder is handed this module where it gets such an object.
"""

from __future__ import annotations

import sys
import traceback
import warnings
from collections.abc import Sequence
from typing import Any, Final, Literal

import casadi as ca
import numpy as np

from mbkit._check import Array, finite_array, real, shown
from mbkit.codegen.program import program
from mbkit.errors import InputError, MbkitError
from mbkit.model.elements.formula import Formula, Operation
from mbkit.model.parameters import Expression

#: Ways to interpolate a table.
Ends = Literal["natural", "clamped", "quintic"]
ENDS: Final[tuple[Ends, ...]] = ("natural", "clamped", "quintic")
_KNOWN: Final = "a number, a Parameter, a casadi.SX, a SymPy expression, or a function of symbols that returns such"

_INSTEAD: Final = (
    "write it with arithmetic and NumPy's functions, casadi.if_else for decisions and casadi.pw_lin for tables; "
    "a function that needs numbers is an argument of mbkit.simulate: torque= or wrenches="
)


def read_formula(
    parts: Sequence[tuple[Any, int | None]], signature: Sequence[str | Sequence[str]], things: list[Expression]
) -> Formula:
    """Return expressions, one behind the other, as a formula of their symbols.

    Parameters
    ----------
    parts : sequence of (object, int or None)
        Each with the count of its entries, or None for any. A number, a `Parameter` or an expression of some, a
        `casadi.SX`, a SymPy expression; a sequence, column or SymPy matrix of them; or a function, which is called
        once, with CasADi's symbols.
    given : sequence
        Names of the arguments of such a function: one of several names is a column.
    things : list
        What the arguments ``"#1"``, ``"#2"``, ... stand for: the model's parameters in the expressions go here.

    Raises
    ------
    InputError
        Something else, another count, or a function that raised.
    """
    entries: list[Any] = []
    for value, size in parts:
        own = [_scalar(x, things) for x in _entries(_called(value, signature))]
        if size is not None and len(own) != size:
            raise InputError(f"expected {size} {'number' if size == 1 else 'numbers'}, got {len(own)}")
        entries += own
    out = ca.vertcat(ca.SX(0, 1), *entries)
    symbols = ca.symvar(out)
    names = tuple(dict.fromkeys(s.name() for s in symbols))
    # Symbols of one name are one argument.
    column = ca.SX.sym("arguments", len(names))
    out = ca.substitute(out, ca.vertcat(ca.SX(0, 1), *symbols), column[[names.index(s.name()) for s in symbols]])
    code = program(ca.Function("formula", [column], [ca.densify(out)]))
    operations: list[Operation] = [
        (x.name, x.arguments[1:] if x.name == "input" else x.arguments, float(x.value)) for x in code.operations
    ]
    if not np.isfinite([value for name, _, value in operations if name == "const"]).all():
        raise InputError(
            "expected finite numbers, got an expression that holds one that is not: a case without a value, or a "
            f"function of Python's math, which cannot take a symbol; {_INSTEAD}"
        )
    return Formula(names, tuple(operations), tuple(int(i) for i in code.outputs[0].flat))


class _Symbol(ca.SX):
    """A symbol that is no number: CasADi's own becomes NaN, with which a search in a table goes wrong in silence."""

    def _refused(self, *_: Any, **__: Any) -> Any:
        raise TypeError("a symbol is no number")

    __float__ = __int__ = __array__ = _refused


def _symbol(name: str) -> Any:
    x = ca.SX.sym(name)
    x.__class__ = _Symbol
    return x


def _sympy() -> Any:
    """Return SymPy where somebody has loaded it; without, no object is its."""
    return sys.modules.get("sympy")


def _is_sympy(value: Any) -> bool:
    sp = _sympy()
    return sp is not None and isinstance(value, (sp.Basic, sp.MatrixBase))


def _called(value: Any, signature: Sequence[str | Sequence[str]]) -> Any:
    """Return what a function returns for symbols; other objects as they are."""
    if not callable(value) or isinstance(value, (Expression, ca.SX, ca.MX, ca.DM)) or _is_sympy(value):
        return value
    symbols = [_symbol(n) if isinstance(n, str) else ca.vertcat(*(ca.SX.sym(x) for x in n)) for n in signature]
    try:
        # CasADi warns of NumPy's functions on its symbols, which give the expression that is meant.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            return value(*symbols)
    except MbkitError:
        raise
    except Exception as error:
        raise InputError(f"the function {_failure(error)}; {_INSTEAD}") from error


def _failure(error: Exception) -> str:
    """Return what a function did to CasADi's symbols."""
    if isinstance(error, RecursionError):
        # A function of NumPy that CasADi does not have goes from one to the other until the stack ends.
        for frame, _ in traceback.walk_tb(error.__traceback__):
            if frame.f_code.co_name == "__array_function__" and callable(func := frame.f_locals.get("func")):
                name = f"{func.__module__}.{func.__name__}"
                return f"calls {name}, which takes numbers alone, so that no expression comes of it"
    text = str(error).strip().splitlines()
    return f"raised {type(error).__name__} for CasADi's symbols: {text[0] if text else ''}"


def _entries(value: Any) -> list[Any]:
    if isinstance(value, (ca.SX, ca.DM)):
        return list(ca.vertsplit(ca.vec(ca.densify(ca.SX(value)))))
    if _is_sympy(value):
        return list(value) if isinstance(value, _sympy().MatrixBase) else [value]
    if isinstance(value, np.ndarray):
        return list(value.flat)
    return list(value) if isinstance(value, (list, tuple)) else [value]


def _scalar(x: Any, things: list[Expression]) -> Any:
    if isinstance(x, Expression):
        things.append(x)
        return ca.SX.sym(f"#{len(things)}")
    if isinstance(x, (ca.SX, ca.DM)) and ca.SX(x).numel() == 1:
        return ca.SX(x)
    if _is_sympy(x):
        # SymPy takes a third of a second to load, so the conversion is only loaded where it is.
        from mbkit.lagrangian.energies.sympy_to_casadi import Conversion

        return ca.SX(Conversion({s: ca.SX.sym(s.name) for s in x.free_symbols}, float)(x))
    if isinstance(x, (int, float, np.integer, np.floating)) and not isinstance(x, bool):
        # One that is not finite is found in the whole.
        return ca.SX(float(x) if isinstance(x, float) else real("a number", x))
    if isinstance(x, ca.MX):
        raise InputError(
            "expected a casadi.SX, got an MX; write it with SX, or casadi.Function(...).expand() makes one"
        )
    raise InputError(f"expected {_KNOWN}, got {shown(x)}")


# Splines


def read_spline(value: Any, ends: Ends) -> tuple[Array, Array] | None:
    """Return the knots and coefficients of a spline or a table (t, x); None for any other value.

    Parameters
    ----------
    value : object
        A `scipy.interpolate.PPoly` such as `CubicSpline`, a `BSpline`, or a pair of times and values.
    ends : {"natural", "clamped", "quintic"}
        Of a table: a cubic spline whose second derivative is zero at both ends, or whose first one is; or a quintic one
        that starts and ends at rest, without acceleration.
    """
    from scipy.interpolate import BSpline, CubicSpline, PPoly, make_interp_spline

    if isinstance(value, (list, tuple)) or (isinstance(value, np.ndarray) and value.ndim):
        if len(value) != 2 or not all(np.ndim(x) == 1 for x in value):
            return None
        t, x = (
            finite_array(name, column, (len(value[0]),)) for name, column in zip(("times", "table"), value, strict=True)
        )
        if len(t) < 2 or not (np.diff(t) > 0).all():
            raise InputError("times: expected at least two, increasing")
        if ends == "quintic":
            rest = [(1, 0.0), (2, 0.0)]
            value = make_interp_spline(t, x, k=5, bc_type=(rest, rest))
        else:
            value = CubicSpline(t, x, bc_type=ends)
    if isinstance(value, BSpline):
        first, last = value.t[value.k], value.t[len(value.t) - value.k - 1]
        pieces = PPoly.from_spline(value)
        inner = (np.diff(pieces.x) > 0) & (pieces.x[:-1] >= first) & (pieces.x[1:] <= last)
        value = PPoly(pieces.c[:, inner], np.append(pieces.x[:-1][inner], last))
    if not isinstance(value, PPoly):
        return None
    if value.c.ndim != 2 or np.iscomplexobj(value.c):
        raise InputError(
            f"expected a spline of real numbers, one at each time, got coefficients of shape {value.c.shape}"
        )
    if not (np.isfinite(value.c).all() and np.isfinite(value.x).all()):
        raise InputError("expected a spline with finite numbers")
    return np.array(value.x, dtype=np.float64), np.array(value.c, dtype=np.float64)
