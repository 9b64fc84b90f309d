"""Drake behind the protocol: terms from its `MultibodyPlant`.

Tedrake and the Drake Development Team 2019, "Drake: Model-based design and verification for robotics". The only place
that knows Drake's conventions: its bias term has no gravity, its gravity forces stand on the right, a free joint is
quaternion (w, x, y, z) then position, and velocities of ball and free joints are angular then linear, in the axes of
the joint's fixed frame F: v_drake = T v with R = R_FM in T's blocks, so M = Tᵀ M_drake T, and a_drake = T a + b with
b = R (ω × v) in the linear rows.

Motion of frames, momenta and loads by Drake. A part of `DrakeDynamics`.

Drake's spatial vectors are of a point, in world axes, with the angular part first in arrays. Its reaction forces are
those of its own forward dynamics: the forces of inverse dynamics are applied, so that the motion is the one asked for.

Drake's own runs: its integrators with error control on the continuous plant, and the steps of its discrete one.

Constraints between bodies are in the discrete plant alone, whose SAP solver holds them (Castro, Permenter and Han 2023,
"An unconstrained convex formulation of compliant contact"). Its step is a semi-implicit Euler's, with the forces of
dampers and constraints at its end: the run tends to that of rigid loops with the step, in first order.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from functools import cached_property, partial
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.math import RollPitchYaw, RotationMatrix
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.multibody.tree import JacobianWrtVariable, MultibodyForces, MultibodyForces_
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import EventStatus

from mbkit import _process as _interrupt
from mbkit import spatial
from mbkit._check import Array
from mbkit.engines.base import MappedDynamics
from mbkit.engines.constrained import softly_limited
from mbkit.engines.drake.model import DRAKE, DRAKE_RUNS, DRAKE_SAP, NO_CONSTRAINTS, SAP, DrakeModel, build
from mbkit.engines.frames_and_momenta import Composed, MovingFrames
from mbkit.errors import NumericalError, UnsupportedError
from mbkit.model import Frame, Model
from mbkit.model.quantities import of_groups
from mbkit.model.validation import static_bodies

_BY_V = JacobianWrtVariable.kV


def _linear_first(spatial: Any) -> Array:
    return np.concatenate([spatial.translational(), spatial.rotational()])


class DrakeBodies(MovingFrames, Composed):
    """Drake's quantities of frames, of the whole system, and loads; `DrakeDynamics` inherits it."""

    model: Model
    maps: DrakeModel
    plant: Any
    _context: Any
    # These stand in the other parts.
    _to_engine: Callable[[Array], Array]
    _columns: Callable[[Array], Array]
    _force: Callable[[Array], Array]
    _applied: Any

    # Frames

    def _placed(self, frame: Frame) -> tuple[Array, Array, Any]:
        """Return R_WF and p_WF at the state that is in, and the frame's body with the place of its origin there."""
        body, place = self.maps.bodies[frame.body], np.array(frame.translation)
        X_WB = self.plant.EvalBodyPoseInWorld(self._context, body)
        return X_WB.rotation().matrix() @ frame.rotation, X_WB.multiply(place), (body, place)

    def _in_world(self, at: Any) -> tuple[Any, ...]:
        """Return the arguments of Drake's Jacobians and their rates for a point, in world axes."""
        (body, place), world = at, self.plant.world_frame()
        return self._context, _BY_V, body.body_frame(), place, world, world

    def _point_jacobian(self, p: Array, at: Any) -> tuple[Array, Array]:  # noqa: ARG002  # Drake takes the body's point
        angular, linear = np.split(self.plant.CalcJacobianSpatialVelocity(*self._in_world(at)), 2)
        return linear, angular

    def _arm(self, p: Array, at: Any) -> Array:
        return np.asarray(p - self.plant.EvalBodyPoseInWorld(self._context, at[0]).translation())

    def _twist(self, p: Array, at: Any) -> Array:
        return _linear_first(self.plant.EvalBodySpatialVelocityInWorld(self._context, at[0]).Shift(self._arm(p, at)))

    def _move(self, q: Array, v: Array, a: Array) -> None:
        b = self._place(q, v)
        # They are those of the points at the bodies' origins: Drake's spatial ones have the point's own acceleration.
        self._moving = self.plant.CalcSpatialAccelerationsFromVdot(self._context, self._to_engine(a) + b)

    def _point_acceleration(self, p: Array, at: Any, w: Array) -> Array:
        return _linear_first(self._moving[int(at[0].index())].Shift(self._arm(p, at), w))

    def _point_rate(self, p: Array, at: Any) -> Array:  # noqa: ARG002  # Drake takes the body's point
        return _linear_first(self.plant.CalcBiasSpatialAcceleration(*self._in_world(at)))

    # The whole

    def _center_of_mass(self, q: Array) -> Array:
        self._place(q)
        return np.asarray(self.plant.CalcCenterOfMassPositionInWorld(self._context))

    def _center_of_mass_velocity(self, q: Array, v: Array) -> Array:
        self._place(q, v)
        return np.asarray(self.plant.CalcCenterOfMassTranslationalVelocityInWorld(self._context))

    def _center_of_mass_acceleration(self, q: Array, v: Array, a: Array) -> Array:
        b, world = self._place(q, v), self.plant.world_frame()
        J = self.plant.CalcJacobianCenterOfMassTranslationalVelocity(self._context, _BY_V, world, world)
        rate = self.plant.CalcBiasCenterOfMassTranslationalAcceleration(self._context, _BY_V, world, world)
        return np.asarray(J @ (self._to_engine(a) + b) + rate)

    def _center_of_mass_jacobian(self, q: Array) -> Array:
        self._place(q)
        world = self.plant.world_frame()
        return self._columns(
            self.plant.CalcJacobianCenterOfMassTranslationalVelocity(self._context, _BY_V, world, world)
        )

    def _centroidal_momentum(self, q: Array, v: Array) -> Array:
        self._place(q, v)
        center = self.plant.CalcCenterOfMassPositionInWorld(self._context)
        return _linear_first(self.plant.CalcSpatialMomentumInWorldAboutPoint(self._context, center))

    def _locked_inertia(self, q: Array) -> Array:
        self._place(q)
        plant, context = self.plant, self._context
        every = [body.index() for name, body in self.maps.bodies.items() if name != "world"]
        whole = plant.CalcSpatialInertia(context, plant.world_frame(), every)
        angular_first = whole.Shift(whole.get_com()).CopyToFullMatrix6()
        out = np.zeros((6, 6))
        out[:3, :3], out[3:, 3:] = angular_first[3:, 3:], angular_first[:3, :3]
        # The plant holds what never moves as points, because Drake refuses some of these inertias.
        static = static_bodies(self.model.joints)
        for body in self.model.bodies:
            if body.name in static:
                R = plant.EvalBodyPoseInWorld(context, self.maps.bodies[body.name]).rotation().matrix()
                out[3:, 3:] += R @ body.inertia @ R.T
        return out

    # Loads

    def _on_bodies(self, *acting: Any) -> Iterator[tuple[Any, Any]]:
        """Yield bodies and forces about their origins in world axes, of wrenches at the state that is in."""
        for force, moment, point, at in self._external(*acting):
            yield at[0], SpatialForce(tau=moment, f=force).Shift(-self._arm(point, at))

    def _add_external(self, forces: Any, *acting: Any) -> Any:
        for body, force in self._on_bodies(*acting):
            body.AddInForceInWorld(self._context, force, forces)
        return forces

    def _generalized_force(self, q: Array, wrenches: Array, frames: tuple[Frame, ...], axes: str) -> Array:
        self._place(q)
        forces = self._add_external(MultibodyForces(self.plant), wrenches, frames, axes)
        return self._force(self.plant.CalcGeneralizedForces(self._context, forces))

    @contextlib.contextmanager
    def _pushed(self, *acting: Any) -> Iterator[None]:
        """Hold wrenches, at the state that is in, on Drake's port."""
        port = self.plant.get_applied_spatial_force_input_port()
        held = []
        for body, force in self._on_bodies(*acting):
            one = ExternallyAppliedSpatialForce()
            one.body_index, one.p_BoBq_B, one.F_Bq_W = body.index(), np.zeros(3), force
            held.append(one)
        port.FixValue(self._context, held)
        try:
            yield
        finally:
            port.FixValue(self._context, [])

    def _joint_wrenches(self, q: Array, v: Array, a: Array, *given: Any) -> Array:
        *wrenches, joints, frames, axes = given
        acting = (wrenches[0] if wrenches else np.empty(0), frames, axes)
        b = self._place(q, v)
        moved = self._to_engine(a) + b
        forces = MultibodyForces(self.plant)
        self.plant.CalcForceElementsContribution(self._context, forces)
        with self._pushed(*acting):
            forces = self._add_external(forces, *acting)
            # For Drake's own forward dynamics: these forces make the motion the one asked for.
            self._applied.FixValue(self._context, self.plant.CalcInverseDynamics(self._context, moved, forces))
            reactions = self.plant.get_reaction_forces_output_port().Eval(self._context)
        return np.array([_on_child(self.maps.joints[joint.name], reactions) for joint in joints]).reshape(-1, 6)


def _on_child(joint: Any, reactions: Any) -> Array:
    """Return a joint's reaction about its child's origin, in the child's axes."""
    reaction, X_CJ = reactions[int(joint.index())], joint.frame_on_child().GetFixedPoseInBodyFrame()
    return _linear_first(reaction.Rotate(X_CJ.rotation()).Shift(-X_CJ.translation()))


_WITHOUT_LOOPS: Final = {
    **dict.fromkeys(
        (
            *("forward_dynamics", "forward_dynamics_derivatives"),
            *of_groups("row", "actuator", "load", "loop", "motion"),
        ),
        f"{{model}} has constraints ({{parts}}), and {NO_CONSTRAINTS}; mbkit.simulate(..., method={SAP!r}) runs its "
        "discrete one, and mbkit.dynamics(model, 'lagrangian') has the terms",
    )
}


class DrakeDynamics(DrakeBodies, MappedDynamics):
    """Drake on a description.

    Of a model with loops the terms are those of the tree, and its runs are Drake's discrete ones: loops are among the
    constraints of the discrete plant alone. So are joint limits, with ``limits="soft"``: nearly rigid, as stiff as the
    step allows. Rigid stops give way to them, so that `model` is here without; terms and other runs have no limits.

    Attributes
    ----------
    plant : pydrake.multibody.plant.MultibodyPlant
        The plant that was built; free to read.
    maps : DrakeModel
        The plant with the maps between its coordinates and the description's.
    """

    engine = "drake"
    _path = DRAKE
    _why_no_derivatives = ""
    _soft_constraints = True
    _takes_wrenches = ("inverse_dynamics", "forward_dynamics")
    _refuses: ClassVar[dict[str, str]] = {
        "coriolis_matrix": "Drake forms C v without the matrix; nle(q, v) - gravity(q) is C v",
    }

    def __init__(self, model: Model, *, limits: str | None = None) -> None:
        model, limited = softly_limited(self.engine, model, limits)
        super().__init__(model)
        if model.constrained:
            parts = {"model": model.name, "parts": model.constraint_parts}
            vars(self)["_refuses"] = self._refuses | {k: why.format(**parts) for k, why in _WITHOUT_LOOPS.items()}
        if limited:
            self._soft_limits = True
            why = f"limits='soft' of {model.name} act in Drake's discrete plant alone; method={SAP!r} runs it"
            vars(self)["_refuses"] = self._refuses | {"forward_dynamics": why}
        self._hold(build(model))

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(type(self), limits="soft" if self._soft_limits else None), (self.model,)

    def _hold(self, compiled: DrakeModel) -> None:
        self.maps, self.plant, self._v_index = compiled, compiled.plant, compiled.v_index
        self._applied = self.plant.get_applied_generalized_force_input_port()
        self._acceleration_port = self.plant.get_generalized_acceleration_output_port()
        self._context = self.plant.CreateDefaultContext()

    def _evaluate(self, quantity: str, *more: Any, **arguments: ArrayLike) -> Array:
        try:
            return super()._evaluate(quantity, *more, **arguments)
        except (RuntimeError, SystemExit) as error:
            # Drake's failed demands come as either.
            if isinstance(error, NotImplementedError):
                raise
            reason = str(error).strip().splitlines()[0]
            raise NumericalError(f"drake: {quantity} of {self.model.name}: {reason}{self._suspects()}") from None

    # Between the description's numbers and Drake's.

    def to_drake(self, q: Array, v: Array | None = None) -> tuple[Array, Array, Array]:
        """Return Drake's positions and velocities, and b of a_drake = T a + b."""
        maps, layout = self.maps, self.model.layout
        full_q = layout.expand_q(q)
        x, u, b = full_q[maps.q_index], np.zeros(len(maps.v_index)), np.zeros(len(maps.v_index))
        own = u if v is None else layout.expand_v(v)[maps.v_index]
        self._turned = []
        for joint, iq, iv in maps.turning:
            R = spatial.matrix_from_quaternion(full_q[layout.full_q[joint.name]][-4:])
            self._turned += [(R, slice(k, k + 3)) for k in range(iv, iv + joint.type.nv, 3)]
            if joint.kind == "ball":
                x[iq : iq + 3] = RollPitchYaw(RotationMatrix(R)).vector()
            else:
                b[iv + 3 : iv + 6] = R @ np.cross(own[iv : iv + 3], own[iv + 3 : iv + 6])
        return x, u if v is None else self._to_engine(v), b

    def _place(self, q: Array, v: Array | None = None) -> Array:
        """Put a state into Drake; return b of a_drake = T a + b."""
        x, u, b = self.to_drake(q, v)
        self.put(self.plant, self._context, x, u)
        return b

    @staticmethod
    def put(plant: Any, context: Any, x: Array, u: Array) -> None:
        """Set Drake's positions and velocities."""
        plant.SetPositions(context, x)
        plant.SetVelocities(context, u)

    @cached_property
    def _weightless(self) -> tuple[Any, Any]:
        """A plant without gravity, whose forces Drake adds to those of springs and dampers, and its context."""
        plant = build(self.model, gravity=False).plant
        return plant, plant.CreateDefaultContext()

    @cached_property
    def _without_bushings(self) -> tuple[Any, Any]:
        plant = build(self.model, bushings=False).plant
        return plant, plant.CreateDefaultContext()

    # The protocol.

    def _mass_matrix(self, q: Array) -> Array:
        self._place(q)
        return self._columns(self._columns(self.plant.CalcMassMatrix(self._context)).T)

    def _gravity(self, q: Array) -> Array:
        self._place(q)
        return self._force(-self.plant.CalcGravityGeneralizedForces(self._context))

    def _coriolis_force(self, q: Array, v: Array) -> Array:
        return self._force(self._bias(q, v))

    def _bias(self, q: Array, v: Array) -> Array:
        """Return C v, and M b of the change of velocities."""
        b = self._place(q, v)
        out = self.plant.CalcBiasTerm(self._context)
        return np.asarray(out + self.plant.CalcMassMatrix(self._context) @ b if b.any() else out)

    def _nle(self, q: Array, v: Array) -> Array:
        bias = self._bias(q, v)
        return self._force(bias - self.plant.CalcGravityGeneralizedForces(self._context))

    def _passive(self, q: Array, v: Array) -> Array:
        plant, context = self._weightless
        forces = MultibodyForces(plant)
        self.put(plant, context, *self.to_drake(q, v)[:2])
        plant.CalcForceElementsContribution(context, forces)
        return self._force(plant.CalcGeneralizedForces(context, forces))

    def _inverse_dynamics(self, q: Array, v: Array, a: Array, *acting: Any) -> Array:
        b = self._place(q, v)
        forces = MultibodyForces(self.plant)
        self.plant.CalcForceElementsContribution(self._context, forces)
        if acting:
            forces = self._add_external(forces, *acting)
        return self._force(self.plant.CalcInverseDynamics(self._context, self._to_engine(a) + b, forces))

    def _inverse_dynamics_derivatives(self, q: Array, v: Array, a: Array) -> Array:
        """Return the derivatives by Drake's automatic differentiation: exact, of numbers with 3 nv directions."""
        plant, context = self._on_duals
        x, u, b = self.to_drake(q, v)
        n, start = len(u), self._to_engine(a)
        by_q, by_v, by_a = np.split(np.eye(3 * n), 3)
        moved, pushed = np.array(by_v), np.array(by_a)
        # Directions are in Drake's axes, in which a turn θ of a body turns v and a of mbkit's axes too.
        blocks = [
            (slice(iv, iv + 3), slice(k, k + 3))
            for joint, _, iv in self.maps.turning
            for k in range(iv, iv + joint.type.nv, 3)
        ]
        for turn, part in blocks:
            moved[part] -= spatial.skew(u[part]) @ by_q[turn]
            pushed[part] -= spatial.skew(start[part] + b[part]) @ by_q[turn]
            if part != turn:
                # b = ω × v, of which so far only the turn is counted.
                pushed[part] += spatial.skew(u[turn]) @ by_v[part] - spatial.skew(u[part]) @ by_v[turn]
        self.put(self.plant, self._context, x, u)
        rates = [self.plant.MapVelocityToQDot(self._context, e) for e in np.eye(n)]
        places = np.array(rates).reshape(n, len(x)).T @ by_q
        plant.SetPositions(context, InitializeAutoDiff(x, places)[:, 0])
        plant.SetVelocities(context, InitializeAutoDiff(u, moved)[:, 0])
        forces = MultibodyForces_[AutoDiffXd](plant)
        plant.CalcForceElementsContribution(context, forces)
        f = plant.CalcInverseDynamics(context, InitializeAutoDiff(start + b, pushed)[:, 0], forces)
        value, slope = ExtractValue(f)[:, 0], ExtractGradient(f)
        for turn, part in blocks:
            # Forces in mbkit's axes are Tᵀ f.
            slope[part] += spatial.skew(value[part]) @ by_q[turn]
        return np.stack([self._columns(self._columns(X).T).T for X in np.split(slope, 3, axis=1)])

    @cached_property
    def _on_duals(self) -> tuple[Any, Any]:
        """The plant on numbers with derivatives, and its context."""
        plant = self.plant.ToAutoDiffXd()
        return plant, plant.CreateDefaultContext()

    def _forward_dynamics(self, q: Array, v: Array, tau: Array, *acting: Any) -> Array:
        if self.model.layout.reduced:
            return self._solved_motion(q, v, tau, *acting)
        b = self._place(q, v)
        self._applied.FixValue(self._context, self._to_engine(tau))
        with self._pushed(*acting) if acting else contextlib.nullcontext():
            return self._force(self._acceleration_port.Eval(self._context) - b)

    def _kinetic_energy(self, q: Array, v: Array) -> Any:
        self._place(q, v)
        return self.plant.CalcKineticEnergy(self._context)

    def _potential_energy(self, q: Array) -> Any:
        x, u, _ = self.to_drake(q)
        self.put(self.plant, self._context, x, u)
        if not self.maps.bushings:
            return self.plant.CalcPotentialEnergy(self._context)
        # Drake has no energy of bushings, and fails where it is asked for it.
        total = 0.0
        for stiffness, A, p_AP, B, p_BQ in self.maps.bushings:
            P, Q = (self.plant.EvalBodyPoseInWorld(self._context, X).multiply(p) for X, p in ((A, p_AP), (B, p_BQ)))
            total += 0.5 * stiffness * float((Q - P) @ (Q - P))
        plant, context = self._without_bushings
        self.put(plant, context, x, u)
        return total + plant.CalcPotentialEnergy(context)


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
        if dyn._soft_limits:
            raise UnsupportedError(f"drake: {dyn._refuses['forward_dynamics']}")
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
        super().__init__(dyn, build(dyn.model, step=dt, limits=dyn._soft_limits))

    def step(self, q: Array, v: Array, tau: Array) -> tuple[Array, Array]:
        """Return q and v a step after a state, under a force."""
        self.put(q, v)
        # A force on a free joint turns with its body, from step to step.
        self._force.FixValue(self._context, self._dyn.to_drake(q, tau)[1])
        # As a simulator does at each period, without its clock.
        self._plant.ExecuteForcedEvents(self._context, publish=False)
        return self.state()
