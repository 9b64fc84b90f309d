"""The arithmetic of methods of integration on CasADi's symbols."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import casadi as ca

from mbkit.model import Model
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


def space_derivative(model: Model, name: str, sizes: Sequence[int]) -> ca.Function:
    """Return a method of the space as a function of columns, with its derivative by all of them side by side."""
    given = [ca.SX.sym(f"x{i}", n) for i, n in enumerate(sizes)]
    out = getattr(SymbolicSpace(model), name)(*given)
    results = [ca.densify(x) for x in (out, ca.jacobian(out, ca.vertcat(*given)))]
    return ca.Function(name, given, results)
