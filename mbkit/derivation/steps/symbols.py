"""The arithmetic of methods of integration on CasADi's symbols."""

from __future__ import annotations

from typing import Any, Final

import casadi as ca

from mbkit.model.integration_space import Space
from mbkit.model.quaternions import Arithmetic


def choose(condition: ca.SX, yes: Any, no: Any) -> Any:
    """Return `yes` where the condition is 1, `no` where it is 0, whatever the other one is."""
    # casadi.if_else would negate the condition by an operation of its own.
    chosen = ca.SX.binary(ca.OP_IF_ELSE_ZERO, condition, ca.SX(yes))
    return chosen + ca.SX.binary(ca.OP_IF_ELSE_ZERO, 1 - condition, ca.SX(no))


#: Arithmetic of expressions.
SYMBOLS: Final = Arithmetic(ca.sqrt, ca.sin, ca.cos, choose)


class SymbolicSpace(Space):
    """The integrators' space on casadi.SX columns."""

    arithmetic = staticmethod(lambda x: SYMBOLS)  # noqa: ARG005  # of symbols there is one kind
    part = staticmethod(lambda x, part: x[part])
    components = staticmethod(lambda x, part: ca.vertsplit(x[part]))
    copied = staticmethod(lambda x: ca.SX(x))

    @staticmethod
    def put(x: Any, part: slice, components: Any) -> None:
        """Write scalars or a column into a part of a column."""
        x[part] = ca.vertcat(*components) if isinstance(components, list) else components
