"""Expressions whose arithmetic is quick to write down, entry by entry.

CasADi's operators first look for what their operands could be converted to, some
15 µs each; `SX.binary` is told, and takes 2. A tree's kinematics are tens of thousands
of them. The functions are those that a joint's kind asks for: this module stands for
CasADi there.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

__all__ = ["Scalar", "cos", "scalar", "sin"]


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


def _of(operation: int, a: Any, b: Any) -> Any:
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
