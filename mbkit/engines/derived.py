"""What engines of the own derivation have alike, in double and in more digits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import casadi as ca
from numpy.typing import ArrayLike

from mbkit._check import Array
from mbkit.derivation import FUNCTIONS, Equations
from mbkit.derivation.body_motion import BODY_QUANTITIES
from mbkit.derivation.constraints import CONSTRAINT_FUNCTIONS
from mbkit.engines.base import DERIVATION, Dynamics, scalar
from mbkit.engines.linearization import of_parameters, of_second_order
from mbkit.model import Joint

#: Quantity -> its arguments, of those that are written in symbols.
WRITTEN: Final = FUNCTIONS | CONSTRAINT_FUNCTIONS


def names_of(value: Any) -> Any:
    """Return the names of frames or joints, and anything else as it is."""
    return tuple(x.name for x in value) if isinstance(value, tuple) else value


def function_of(equations: Equations, name: str, *extra: Any) -> ca.Function:
    """Return what the derivation has by a name, and by what stands beside it, such as names of frames."""
    if name in BODY_QUANTITIES:
        return equations.body_quantity(name, *extra)
    return equations.function(name) if name in WRITTEN else getattr(equations, name)(*extra)


class Derived(Dynamics):
    """What engines of the own derivation have alike, in double and in more digits."""

    _has_force_elements = True
    _one_at_a_time = False
    _path = DERIVATION
    _why_no_derivatives = ""
    #: Name, states, and `extra` of `function_of` -> the function's first result.
    _first: Callable[..., Any]

    def energy_rate(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> Any:
        """Return dE/dt of kinetic and potential energy along (D v, a), exactly differentiated."""
        return scalar(self._evaluate("energy_rate", q=q, v=v, a=a))

    def _actuator_forces(self, q: Array, v: Array, a: Array, actuators: tuple[Joint, ...]) -> Any:
        which = self._moved_by(actuators)
        out = self._first("actuator_forces", q, v, a, extra=(which,))[..., 0]
        return self._judged(out, q, a, which)

    def _loads_of_motion(self, *given: Any) -> Any:
        return self._loads(False, *given)

    def _loads_under_force(self, *given: Any) -> Any:
        return self._loads(True, *given)

    def _loads(self, moved: bool, *given: Any) -> Any:
        *states, joints, frames, axes = given
        return self._first("loads", *states, extra=(names_of(joints), names_of(frames), axes, moved))

    def _inverse_dynamics_second_derivatives(self, *states: Array) -> Any:
        return of_second_order(self._first("inverse_dynamics_second_derivatives", *states))

    def _parameter_derivatives(self, quantity: str, *states: Array) -> Any:
        return of_parameters(self.model, quantity, self._first("parameter_derivatives", *states, extra=(quantity,)))
