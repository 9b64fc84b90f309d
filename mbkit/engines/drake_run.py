"""Drake's own integrators on the plant that was built."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import EventStatus

from mbkit import spatial
from mbkit._check import Array
from mbkit.engines.drake import DrakeDynamics
from mbkit.errors import UnsupportedError

__all__ = ["DrakeRun"]

# Drake's default of 0.1 s would hold a slow motion's steps down for no reason.
_LONGEST: Final = 1e9


class DrakeRun:
    """A state on its way by one of Drake's integrators.

    Parameters
    ----------
    dyn : DrakeDynamics
    scheme : str
        Of `pydrake.systems.analysis.GetIntegrationSchemes`.
    accuracy : float
        What Drake holds the relative error of a step below.
    t : float
        Time of the first state, s.
    q, v : (nq,), (nv,) arrays
    watch : callable
        Gets the time after each step; what it raises ends the run.

    Raises
    ------
    UnsupportedError
        Mimic joints, which Drake does not reduce, or ball joints, whose angles Drake cannot carry through
        their pole.
    """

    def __init__(
        self,
        dyn: DrakeDynamics,
        scheme: str,
        accuracy: float,
        t: float,
        q: Array,
        v: Array,
        watch: Callable[[float], object],
    ) -> None:
        if dyn.model.layout.reduced:
            raise UnsupportedError("drake: its integrators know no mimic joints; load with mimic='free'")
        for joint in dyn.model.joints:
            if joint.kind == "ball":
                raise UnsupportedError(
                    f"drake: ball joint {joint.name!r} has roll, pitch and yaw there, which end at a pole; "
                    "use a method that any engine has, such as rk853"
                )
        self._dyn, self._made = dyn, dyn.made
        plant = self._made.plant
        self._plant, self._context = plant, plant.CreateDefaultContext()
        self._force = plant.get_applied_generalized_force_input_port()
        self.push(np.zeros(dyn.model.nv))
        x, u, _ = dyn.to_drake(q, v)
        plant.SetPositions(self._context, x)
        plant.SetVelocities(self._context, u)
        simulator = Simulator(plant, self._context)
        config = SimulatorConfig(integration_scheme=scheme, accuracy=accuracy, max_step_size=_LONGEST)
        ApplySimulatorConfig(config, simulator)
        # The configuration resets the time.
        self._context.SetTime(t)
        integrator = simulator.get_mutable_integrator()
        # Too small a step is told, not taken on with an error that nobody knows.
        integrator.set_throw_on_minimum_step_size_violation(True)

        def monitor(context: Any) -> Any:
            watch(context.get_time())
            return EventStatus.DidNothing()

        simulator.set_monitor(monitor)
        self._simulator, self._integrator = simulator, integrator

    def push(self, tau: Array) -> None:
        """Hold a generalized force from now on; not for bodies that turn freely."""
        if tau.any() and self._made.turning:
            raise UnsupportedError(
                "drake: a force on a free joint would be held in world axes; use a method that any engine has"
            )
        layout = self._dyn.model.layout
        self._force.FixValue(self._context, layout.expand_v(tau)[self._made.v_index])

    def over(self, t: float) -> tuple[Array, Array]:
        """Go on to a time, s; return q and v there."""
        self._simulator.AdvanceTo(t)
        return self.state()

    def state(self) -> tuple[Array, Array]:
        """Return q and v, with unit quaternions."""
        layout, made = self._dyn.model.layout, self._made
        x, u = self._plant.GetPositions(self._context), self._plant.GetVelocities(self._context)
        q, v = np.zeros(layout.sizes[2]), np.zeros(layout.sizes[3])
        plain_q, plain_v = made.q_index >= 0, made.v_index >= 0
        q[made.q_index[plain_q]], v[made.v_index[plain_v]] = x[plain_q], u[plain_v]
        for joint, iq, iv in made.turning:
            own_q, own_v = layout.full_q[joint.name], layout.full_v[joint.name]
            quaternion = x[[iq + 1, iq + 2, iq + 3, iq]]
            quaternion = quaternion / np.linalg.norm(quaternion)
            R = spatial.matrix_from_quaternion(quaternion)
            q[own_q] = [*x[iq + 4 : iq + 7], *quaternion]
            v[own_v] = [*(R.T @ u[iv + 3 : iv + 6]), *(R.T @ u[iv : iv + 3])]
        return q, v

    @property
    def steps(self) -> int:
        """Accepted steps."""
        return int(self._integrator.get_num_steps_taken())

    @property
    def evaluations(self) -> int:
        """Evaluations of the dynamics."""
        return int(self._integrator.get_num_derivative_evaluations())

    @property
    def rejected(self) -> int:
        """Steps that were tried in vain."""
        return int(
            self._integrator.get_num_step_shrinkages_from_error_control()
            + self._integrator.get_num_step_shrinkages_from_substep_failures()
        )
