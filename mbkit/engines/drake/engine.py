"""Drake behind the protocol: terms from its `MultibodyPlant`.

Tedrake and the Drake Development Team 2019, "Drake: Model-based design and verification for
robotics". The only place that knows Drake's conventions: its bias term has no gravity, its gravity forces
stand on the right, a free joint is quaternion (w, x, y, z) then position, and velocities of ball and free
joints are angular then linear, in the axes of the joint's fixed frame F: v_drake = T v with R = R_FM
in T's blocks, so M = Tᵀ M_drake T, and a_drake = T a + b with b = R (ω × v) in the linear rows.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cached_property
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RollPitchYaw, RotationMatrix
from pydrake.multibody.tree import JacobianWrtVariable, MultibodyForces
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import EventStatus

from mbkit import spatial
from mbkit._check import Array
from mbkit._fork import fork_safe
from mbkit.engines.base import Dynamics, by_sample, per_sample
from mbkit.engines.drake.model import DrakeModel, build
from mbkit.errors import NumericalError, UnsupportedError
from mbkit.model import Model


class DrakeDynamics(Dynamics):
    """Drake on a description.

    Attributes
    ----------
    plant : pydrake.multibody.plant.MultibodyPlant
        The plant that was built; free to read.
    maps : DrakeModel
        The plant with the maps between its coordinates and the description's.
    """

    engine = "drake"
    refuses: ClassVar[dict[str, str]] = {
        "coriolis_matrix": "Drake forms C v without the matrix; nle(q, v) - gravity(q) is C v",
        "function": "it has no CasADi form; mbkit.dynamics(model, 'lagrangian') has",
    }

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self._hold(build(model))
        self._applied = self.plant.get_applied_generalized_force_input_port()
        self._acceleration = self.plant.get_generalized_acceleration_output_port()

    def _hold(self, maps: DrakeModel) -> None:
        self.maps, self.plant = maps, maps.plant
        self._context = self.plant.CreateDefaultContext()
        self._lock = fork_safe(threading.RLock())
        self._rotations: list[tuple[Array, int, int | None]] = []

    def _evaluate(self, quantity: str, method: Any, **arguments: ArrayLike) -> Array:
        # One context: two threads in here would mix their states.
        with self._lock:
            try:
                return super()._evaluate(quantity, method, **arguments)
            except (RuntimeError, SystemExit) as error:
                # Drake's failed demands come as either.
                if isinstance(error, NotImplementedError):
                    raise
                reason = str(error).strip().splitlines()[0]
                raise NumericalError(f"drake: {quantity} of {self.model.name}: {reason}{self._blame()}") from None

    # Between the description's numbers and Drake's.

    def to_drake(self, q: Array, v: Array | None = None) -> tuple[Array, Array, Array]:
        """Return Drake's positions and velocities, and b of a_drake = T a + b."""
        maps, layout = self.maps, self.model.layout
        full_q = layout.expand_q(q)
        full_v = np.zeros(layout.sizes[3]) if v is None else layout.expand_v(v)
        x, u = full_q[maps.q_index], full_v[maps.v_index]
        b = np.zeros(len(u))
        self._rotations = []
        for joint, iq, iv in maps.turning:
            own_q, own_v = full_q[layout.full_q[joint.name]], full_v[layout.full_v[joint.name]]
            # The shape of an empty batch's answer is asked for with zeros, which no rotation is.
            unit = own_q[-4:] if own_q[-4:].any() else np.array([0.0, 0.0, 0.0, 1.0])
            R = spatial.matrix_from_quaternion(unit)
            if joint.kind == "ball":
                x[iq : iq + 3] = RollPitchYaw(RotationMatrix(R)).vector()
                self._rotations.append((R, iv, None))
                u[iv : iv + 3] = R @ own_v
                continue
            x[iq : iq + 7] = [unit[3], *unit[:3], *own_q[:3]]
            self._rotations.append((R, iv, iv + 3))
            u[iv : iv + 3], u[iv + 3 : iv + 6] = R @ own_v[3:], R @ own_v[:3]
            b[iv + 3 : iv + 6] = R @ np.cross(own_v[3:], own_v[:3])
        return x, u, b

    def _set(self, q: Array, v: Array | None = None) -> Array:
        """Put a state into Drake; return b of a_drake = T a + b."""
        x, u, b = self.to_drake(q, v)
        self.plant.SetPositions(self._context, x)
        self.plant.SetVelocities(self._context, u)
        return b

    def _vector_to_drake(self, x: Array) -> Array:
        """Return T x for full velocities, accelerations or, since T is orthogonal, forces, after `_set`."""
        layout = self.model.layout
        full = layout.expand_v(x)
        out = full[self.maps.v_index]
        for (joint, _, _), (R, angular, linear) in zip(self.maps.turning, self._rotations, strict=True):
            own = full[layout.full_v[joint.name]]
            out[angular : angular + 3] = R @ own[-3:]
            if linear is not None:
                out[linear : linear + 3] = R @ own[:3]
        return np.asarray(out)

    def _columns(self, J: Array) -> Array:
        """Return J T, in the description's order and reduced."""
        layout = self.model.layout
        full = np.zeros((len(J), layout.sizes[3]))
        plain = self.maps.v_index >= 0
        full[:, self.maps.v_index[plain]] = J[:, plain]
        for (joint, _, _), (R, angular, linear) in zip(self.maps.turning, self._rotations, strict=True):
            own = layout.full_v[joint.name]
            full[:, own.stop - 3 : own.stop] = J[:, angular : angular + 3] @ R
            if linear is not None:
                full[:, own.start : own.start + 3] = J[:, linear : linear + 3] @ R
        return np.asarray(full @ layout.G) if layout.reduced else full

    def _force(self, f: Array) -> Array:
        return np.asarray(self._columns(f[None, :])[0])

    @cached_property
    def _weightless(self) -> tuple[Any, Any, Any]:
        """A plant without gravity, whose forces Drake adds to those of springs and dampers; context and forces."""
        plant = build(self.model, gravity=False).plant
        return plant, plant.CreateDefaultContext(), MultibodyForces(plant)

    # The protocol.

    @by_sample
    def _mass_matrix(self, q: Array) -> Array:
        self._set(q)
        return self._columns(self._columns(self.plant.CalcMassMatrix(self._context)).T)

    @by_sample
    def _gravity(self, q: Array) -> Array:
        self._set(q)
        return self._force(-self.plant.CalcGravityGeneralizedForces(self._context))

    @by_sample
    def _coriolis_force(self, q: Array, v: Array) -> Array:
        return self._force(self._bias(self._set(q, v)))

    def _bias(self, b: Array) -> Array:
        """Return C v, and M b of the change of velocities."""
        out = self.plant.CalcBiasTerm(self._context)
        return np.asarray(out + self.plant.CalcMassMatrix(self._context) @ b if b.any() else out)

    @by_sample
    def _nle(self, q: Array, v: Array) -> Array:
        bias = self._bias(self._set(q, v))
        return self._force(bias - self.plant.CalcGravityGeneralizedForces(self._context))

    @by_sample
    def _passive(self, q: Array, v: Array) -> Array:
        plant, context, forces = self._weightless
        self._set(q, v)
        plant.SetPositions(context, self.plant.GetPositions(self._context))
        plant.SetVelocities(context, self.plant.GetVelocities(self._context))
        plant.CalcForceElementsContribution(context, forces)
        return self._force(plant.CalcGeneralizedForces(context, forces))

    @by_sample
    def _inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array:
        b = self._set(q, v)
        forces = MultibodyForces(self.plant)
        self.plant.CalcForceElementsContribution(self._context, forces)
        return self._force(self.plant.CalcInverseDynamics(self._context, self._vector_to_drake(a) + b, forces))

    @by_sample
    def _forward_dynamics(self, q: Array, v: Array, tau: Array) -> Array:
        if self.model.layout.reduced:
            zero = np.zeros(self.model.nv)
            return np.asarray(np.linalg.solve(self._mass_matrix(q), tau - self._inverse_dynamics(q, v, zero)))
        b = self._set(q, v)
        self._applied.FixValue(self._context, self._vector_to_drake(tau))
        return self._force(self._acceleration.Eval(self._context) - b)

    @by_sample
    def _kinetic_energy(self, q: Array, v: Array) -> Any:
        self._set(q, v)
        return float(self.plant.CalcKineticEnergy(self._context))

    @by_sample
    def _potential_energy(self, q: Array) -> Any:
        self._set(q)
        total = 0.0
        for stiffness, A, p_AP, B, p_BQ in self.maps.bushings:
            P, Q = (self.plant.EvalBodyPoseInWorld(self._context, x).multiply(p) for x, p in ((A, p_AP), (B, p_BQ)))
            total += 0.5 * stiffness * float((Q - P) @ (Q - P))
        return total + float(self._energy())

    def _energy(self) -> float:
        """Return Drake's own potential energy; of a plant without bushings where Drake cannot tell theirs."""
        if not self.maps.bushings:
            return float(self.plant.CalcPotentialEnergy(self._context))
        plant, context = self._without_bushings
        plant.SetPositions(context, self.plant.GetPositions(self._context))
        return float(plant.CalcPotentialEnergy(context))

    @cached_property
    def _without_bushings(self) -> tuple[Any, Any]:
        plant = build(self.model, bushings=False).plant
        return plant, plant.CreateDefaultContext()

    def _pose(self, q: Array, frame: str) -> Array:
        f = self.model.frame(frame)

        def one(q: Array) -> Array:
            self._set(q)
            X_WB = self.plant.EvalBodyPoseInWorld(self._context, self.maps.bodies[f.body])
            X = np.eye(4)
            X[:3, :3] = X_WB.rotation().matrix() @ f.rotation
            X[:3, 3] = X_WB.multiply(np.array(f.translation))
            return X

        return per_sample(one, q)

    def _jacobian(self, q: Array, frame: str, axes: str) -> Array:
        f = self.model.frame(frame)
        body, world = self.maps.bodies[f.body], self.plant.world_frame()

        def one(q: Array) -> Array:
            self._set(q)
            arguments = self._context, JacobianWrtVariable.kV, body.body_frame(), np.array(f.translation)
            J = self._columns(self.plant.CalcJacobianSpatialVelocity(*arguments, world, world))
            angular, linear = J[:3], J[3:]
            if axes == "body":
                R = self.plant.EvalBodyPoseInWorld(self._context, body).rotation().matrix() @ f.rotation
                linear, angular = R.T @ linear, R.T @ angular
            return np.vstack([linear, angular])

        return per_sample(one, q)


# Drake's own integrators on the plant that was built.

# Drake's default of 0.1 s would hold a slow motion's steps down for no reason.
_MAX_STEP: Final = 1e9


class DrakeRun:
    """A state that one of Drake's integrators carries on; `scheme` is of `pydrake.systems.analysis`.

    `accuracy` bounds the relative error of a step; `watch` gets the time, s, after each step and may raise.
    Raises `UnsupportedError` for mimic joints, which Drake does not reduce, and for ball joints, whose angles
    have a pole in Drake.
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
        self._dyn, self._maps = dyn, dyn.maps
        plant = self._maps.plant
        self._plant, self._context = plant, plant.CreateDefaultContext()
        self._force = plant.get_applied_generalized_force_input_port()
        self.push(np.zeros(dyn.model.nv))
        x, u, _ = dyn.to_drake(q, v)
        plant.SetPositions(self._context, x)
        plant.SetVelocities(self._context, u)
        simulator = Simulator(plant, self._context)
        config = SimulatorConfig(integration_scheme=scheme, accuracy=accuracy, max_step_size=_MAX_STEP)
        ApplySimulatorConfig(config, simulator)
        # The configuration resets the time.
        self._context.SetTime(t)
        integrator = simulator.get_mutable_integrator()
        # Too small a step is an error, not carried on with an error that nobody knows.
        integrator.set_throw_on_minimum_step_size_violation(True)

        def monitor(context: Any) -> Any:
            watch(context.get_time())
            return EventStatus.DidNothing()

        simulator.set_monitor(monitor)
        self._simulator, self._integrator = simulator, integrator

    def push(self, tau: Array) -> None:
        """Hold a generalized force from now on; `UnsupportedError` for bodies that turn freely."""
        if tau.any() and self._maps.turning:
            raise UnsupportedError(
                "drake: a force on a free joint would be held in world axes; use a method that any engine has"
            )
        layout = self._dyn.model.layout
        self._force.FixValue(self._context, layout.expand_v(tau)[self._maps.v_index])

    def over(self, t: float) -> tuple[Array, Array]:
        """Go on to a time, s; return q and v there."""
        self._simulator.AdvanceTo(t)
        return self.state()

    def state(self) -> tuple[Array, Array]:
        """Return q and v, with unit quaternions."""
        layout, maps = self._dyn.model.layout, self._maps
        x, u = self._plant.GetPositions(self._context), self._plant.GetVelocities(self._context)
        q, v = np.zeros(layout.sizes[2]), np.zeros(layout.sizes[3])
        plain_q, plain_v = maps.q_index >= 0, maps.v_index >= 0
        q[maps.q_index[plain_q]], v[maps.v_index[plain_v]] = x[plain_q], u[plain_v]
        for joint, iq, iv in maps.turning:
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
