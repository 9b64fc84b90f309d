"""Drake's own runs: its integrators with error control on the continuous plant, and the steps of its discrete one.

Constraints between bodies are in the discrete plant alone, whose SAP solver holds them (Castro, Permenter and Han 2023,
"An unconstrained convex formulation of compliant contact"). Its step is a semi-implicit Euler's, with the forces of
dampers and constraints at its end: the run tends to that of rigid loops with the step, in first order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import EventStatus

from mbkit import _interrupt, spatial
from mbkit._check import Array
from mbkit.engines.drake.engine import DrakeDynamics
from mbkit.engines.drake.model import DRAKE_RUNS, DRAKE_SAP, DrakeModel, build
from mbkit.errors import UnsupportedError


class _PlantState:
    """A state in a plant of a description, in the description's numbers."""

    def __init__(self, dyn: DrakeDynamics, maps: DrakeModel) -> None:
        self._dyn, self._layout, self._maps, self._plant = dyn, dyn.model.layout, maps, maps.plant
        self._context = maps.plant.CreateDefaultContext()
        self._force = maps.plant.get_applied_generalized_force_input_port()
        self.push(np.zeros(dyn.model.nv))

    def put(self, q: Array, v: Array) -> None:
        """Go on from a state."""
        self._dyn.put(self._plant, self._context, *self._dyn.to_drake(q, v)[:2])

    def push(self, tau: Array) -> None:
        """Hold a generalized force from now on; `UnsupportedError` for bodies that turn freely."""
        if tau.any() and self._maps.turning:
            raise UnsupportedError(
                "drake: a force on a free joint would be held in world axes; use a method that any engine has"
            )
        self._force.FixValue(self._context, self._layout.expand_v(tau)[self._maps.v_index])

    def state(self) -> tuple[Array, Array]:
        """Return q and v, with unit quaternions."""
        layout, maps = self._layout, self._maps
        x, u = self._plant.GetPositions(self._context), self._plant.GetVelocities(self._context)
        q, v = np.empty(layout.sizes[2]), np.empty(layout.sizes[3])
        q[maps.q_index] = x
        for joint, _, iv in maps.turning:
            quaternion = q[layout.full_q[joint.name]][-4:]
            quaternion /= np.linalg.norm(quaternion)
            R = spatial.matrix_from_quaternion(quaternion)
            u[iv : iv + 3], u[iv + 3 : iv + 6] = R.T @ u[iv : iv + 3], R.T @ u[iv + 3 : iv + 6]
        v[maps.v_index] = u
        return q, v


class DrakeRun(_PlantState):
    """A state that one of Drake's integrators carries on; `scheme` is of `pydrake.systems.analysis`.

    `accuracy` bounds the relative error of a step; `watch` gets the time, s, after each step and may raise.
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
        DRAKE_RUNS.admit(dyn.model)
        super().__init__(dyn, dyn.maps)
        self.put(q, v)
        simulator = Simulator(self._plant, self._context)
        config = SimulatorConfig(integration_scheme=scheme, accuracy=accuracy)
        ApplySimulatorConfig(config, simulator)
        # The configuration resets the time.
        self._context.SetTime(t)
        integrator = simulator.get_mutable_integrator()
        # Too small a step is an error, not carried on with an error that nobody knows.
        integrator.set_throw_on_minimum_step_size_violation(True)

        self._left = False

        def monitor(context: Any) -> Any:
            if self._left:
                return EventStatus.ReachedTermination(None, "interrupted")
            watch(context.get_time())
            return EventStatus.DidNothing()

        simulator.set_monitor(monitor)
        self._simulator, self._integrator = simulator, integrator

    def over(self, t: float) -> tuple[Array, Array]:
        """Go on to a time, s; return q and v there."""
        try:
            # Within a step Drake does not look for signals.
            _interrupt.beside(lambda: self._simulator.AdvanceTo(t))
        except BaseException:
            self._left = True
            raise
        return self.state()

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
        """Rejected steps."""
        of = self._integrator
        return int(of.get_num_step_shrinkages_from_error_control() + of.get_num_step_shrinkages_from_substep_failures())


class DiscreteRun(_PlantState):
    """Steps of the discrete plant of dt s, with the loops among its constraints."""

    def __init__(self, dyn: DrakeDynamics, dt: float) -> None:
        DRAKE_SAP.admit(dyn.model)
        super().__init__(dyn, build(dyn.model, step=dt))

    def step(self, q: Array, v: Array, tau: Array) -> tuple[Array, Array]:
        """Return q and v a step after a state, under a force."""
        self.put(q, v)
        # A force on a free joint turns with its body, from step to step.
        self._force.FixValue(self._context, self._dyn.to_drake(q, tau)[1])
        # As a simulator does at each period, without its clock.
        self._plant.ExecuteForcedEvents(self._context, publish=False)
        return self.state()
