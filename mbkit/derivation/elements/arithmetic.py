"""The operations of formulas on CasADi's scalars."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import casadi as ca

from mbkit.derivation.model_values import scalar
from mbkit.model.elements.formula import Arithmetic

#: Operations of one number, and of two; CasADi calls them so too.
UNARY: Final = (
    *("neg", "sq", "twice", "inv", "fabs", "sign", "not", "sqrt", "sin", "cos", "tan", "asin", "acos", "atan"),
    *("exp", "expm1", "log", "log1p", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
)
BINARY: Final = (
    *("add", "sub", "mul", "div", "pow", "hypot", "atan2", "fmin", "fmax"),
    *("lt", "le", "eq", "ne", "and", "or", "if_else_zero"),
)


def _unary(code: int) -> Callable[[Any], Any]:
    return lambda x: scalar(ca.SX.unary(code, ca.SX(x)))


def _binary(code: int) -> Callable[[Any, Any], Any]:
    return lambda a, b: scalar(ca.SX.binary(code, ca.SX(a), ca.SX(b)))


_OPERATIONS: Final[dict[str, Callable[..., Any]]] = {
    **{name: _unary(getattr(ca, f"OP_{name.upper()}")) for name in UNARY},
    **{name: _binary(getattr(ca, f"OP_{name.upper()}")) for name in BINARY},
}


def casadi_arithmetic(number: Callable[[float], Any] = float) -> Arithmetic:
    """Return the arithmetic in which `number` stands for the numbers that a formula holds."""
    return Arithmetic(number, _OPERATIONS)
