"""Motion of frames, momenta and loads by Drake. A part of `DrakeDynamics`.

Drake's spatial vectors are of a point, in world axes, with the angular part first in arrays. Its reaction forces are
those of its own forward dynamics: the forces of inverse dynamics are applied, so that the motion is the one asked for.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any

import numpy as np
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.multibody.tree import JacobianWrtVariable, MultibodyForces

from mbkit._check import Array
from mbkit.engines.drake.model import DrakeModel, build
from mbkit.engines.frames_and_momenta import ALIGNED, CLASSICAL, LOCAL, SPATIAL, WORLD, accelerated, seen_from
from mbkit.model import Frame, Model
from mbkit.model.validation import static_bodies
from mbkit.spatial import skew

_BY_V = JacobianWrtVariable.kV


def _linear_first(spatial: Any) -> Array:
    return np.concatenate([spatial.translational(), spatial.rotational()])


class DrakeBodies:
    """Drake's quantities of frames, of the whole system, and loads; `DrakeDynamics` inherits it."""

    model: Model
    maps: DrakeModel
    plant: Any
    _context: Any
    # Of the other parts.
    put: Callable[..., None]
    to_drake: Callable[..., tuple[Array, Array, Array]]
    _set: Callable[..., Array]
    _to_engine: Callable[[Array], Array]
    _columns: Callable[[Array], Array]
    _force: Callable[[Array], Array]
    _inverse_dynamics: Callable[..., Array]
    _forward_dynamics: Callable[..., Array]
    _mass_matrix: Callable[[Array], Array]

    # Frames

    def _placed(self, frame: Frame) -> tuple[Array, Array, Any]:
        """Return R_WF and p_WF at the state that is in, and the frame's body."""
        body = self.maps.bodies[frame.body]
        X_WB = self.plant.EvalBodyPoseInWorld(self._context, body)
        return X_WB.rotation().matrix() @ frame.rotation, X_WB.multiply(np.array(frame.translation)), body

    def _pose(self, q: Array, frames: tuple[Frame, ...]) -> Array:
        self._set(q)
        X = np.tile(np.eye(4), (len(frames), 1, 1))
        for k, frame in enumerate(frames):
            X[k, :3, :3], X[k, :3, 3], _ = self._placed(frame)
        return X

    def _at(self, frame: Frame, body: Any) -> tuple[Any, ...]:
        """Return the arguments of Drake's Jacobians and their rates for a frame's origin, in world axes."""
        world = self.plant.world_frame()
        return self._context, _BY_V, body.body_frame(), np.array(frame.translation), world, world

    def _jacobian(self, q: Array, frames: tuple[Frame, ...], axes: str) -> Array:
        self._set(q)
        out = []
        for frame in frames:
            R, p, body = self._placed(frame)
            angular, linear = np.split(self.plant.CalcJacobianSpatialVelocity(*self._at(frame, body)), 2)
            out.append(self._columns(seen_from(R, p, linear, angular, axes)))
        return np.array(out)

    def _twist(self, p: Array, body: Any) -> Array:
        """Return velocities, (6,), of a body's point in world axes, linear first."""
        arm = p - self.plant.EvalBodyPoseInWorld(self._context, body).translation()
        return _linear_first(self.plant.EvalBodySpatialVelocityInWorld(self._context, body).Shift(arm))

    def _velocity(self, q: Array, v: Array, frames: tuple[Frame, ...], axes: str) -> Array:
        self._set(q, v)
        out = []
        for frame in frames:
            R, p, body = self._placed(frame)
            twist = self._twist(p, body)
            out.append(seen_from(R, p, twist[:3], twist[3:], axes))
        return np.array(out)

    def _acceleration(self, q: Array, v: Array, a: Array, frames: tuple[Frame, ...], axes: str, kind: str) -> Array:
        b = self._set(q, v)
        # Of the points at the bodies' origins: what Drake calls spatial has the point's own acceleration.
        moving = self.plant.CalcSpatialAccelerationsFromVdot(self._context, self._to_engine(a) + b)
        out = []
        for frame in frames:
            R, p, body = self._placed(frame)
            twist = self._twist(p, body)
            arm = p - self.plant.EvalBodyPoseInWorld(self._context, body).translation()
            classical = _linear_first(moving[int(body.index())].Shift(arm, twist[3:]))
            out.append(accelerated(R, p, twist, classical, axes, kind))
        return np.array(out)

    def _jacobian_dot_v(self, q: Array, v: Array, frames: tuple[Frame, ...], axes: str) -> Array:
        b = self._set(q, v)
        out = []
        for frame in frames:
            R, p, body = self._placed(frame)
            # J = J_drake T, so J̇ v is J̇_drake v_drake + J_drake b.
            classical = _linear_first(self.plant.CalcBiasSpatialAcceleration(*self._at(frame, body)))
            if b.any():
                angular, linear = np.split(self.plant.CalcJacobianSpatialVelocity(*self._at(frame, body)) @ b, 2)
                classical += np.concatenate([linear, angular])
            kind = CLASSICAL if axes == ALIGNED else SPATIAL
            out.append(accelerated(R, p, self._twist(p, body), classical, axes, kind))
        return np.array(out)

    # The whole

    def _center_of_mass(self, q: Array) -> Array:
        self._set(q)
        return np.asarray(self.plant.CalcCenterOfMassPositionInWorld(self._context))

    def _center_of_mass_velocity(self, q: Array, v: Array) -> Array:
        self._set(q, v)
        return np.asarray(self.plant.CalcCenterOfMassTranslationalVelocityInWorld(self._context))

    def _center_of_mass_acceleration(self, q: Array, v: Array, a: Array) -> Array:
        b, world = self._set(q, v), self.plant.world_frame()
        J = self.plant.CalcJacobianCenterOfMassTranslationalVelocity(self._context, _BY_V, world, world)
        rate = self.plant.CalcBiasCenterOfMassTranslationalAcceleration(self._context, _BY_V, world, world)
        return np.asarray(J @ (self._to_engine(a) + b) + rate)

    def _center_of_mass_jacobian(self, q: Array) -> Array:
        self._set(q)
        world = self.plant.world_frame()
        return self._columns(
            self.plant.CalcJacobianCenterOfMassTranslationalVelocity(self._context, _BY_V, world, world)
        )

    def _momentum(self) -> Array:
        center = self.plant.CalcCenterOfMassPositionInWorld(self._context)
        return _linear_first(self.plant.CalcSpatialMomentumInWorldAboutPoint(self._context, center))

    def _centroidal_momentum(self, q: Array, v: Array) -> Array:
        self._set(q, v)
        return self._momentum()

    def _centroidal_momentum_matrix(self, q: Array) -> Array:
        self._set(q)
        out = np.zeros((6, self.plant.num_velocities()))
        # Drake has the momentum and not its matrix: that of each velocity.
        for k, unit in enumerate(np.eye(out.shape[1])):
            self.plant.SetVelocities(self._context, unit)
            out[:, k] = self._momentum()
        return self._columns(out)

    @cached_property
    def _unforced(self) -> tuple[Any, ...]:
        """A plant without gravity, springs and dampers, its context, and the joints that hang in the world."""
        model = self.model.without("springs", "damping", "gravity")
        maps = build(model)
        roots = [maps.joints[joint.name] for joint in model.joints if joint.parent == "world"]
        return maps.plant, maps.plant.CreateDefaultContext(), roots

    def _centroidal_momentum_bias(self, q: Array, v: Array) -> Array:
        # Drake has no function of the momentum's rate, which is all that the world exerts then.
        plant, context, roots = self._unforced
        x, u, b = self.to_drake(q, v)
        self.put(plant, context, x, u)
        reactions = self._reactions(plant, context, b, MultibodyForces(plant))
        center, out = plant.CalcCenterOfMassPositionInWorld(context), np.zeros(6)
        for joint in roots:
            X_WC = plant.EvalBodyPoseInWorld(context, joint.child_body())
            load, R = _on_child(joint, reactions), X_WC.rotation().matrix()
            out += np.concatenate([R @ load[:3], R @ load[3:] + skew(X_WC.translation() - center) @ R @ load[:3]])
        return out

    def _locked_inertia(self, q: Array) -> Array:
        self._set(q)
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

    def _mass_matrix_inverse(self, q: Array) -> Array:
        return np.asarray(np.linalg.inv(self._mass_matrix(q)))

    # Loads

    def _external(self, wrenches: Array, frames: tuple[Frame, ...], axes: str) -> Iterator[tuple[Any, Any]]:
        """Yield bodies and forces about their origins in world axes, of wrenches at the state that is in."""
        for frame, wrench in zip(frames, wrenches.reshape(-1, 6), strict=True):
            R, p, body = self._placed(frame)
            force, moment = wrench[:3], wrench[3:]
            if axes == LOCAL:
                force, moment = R @ force, R @ moment
            point = np.zeros(3) if axes == WORLD else p
            origin = self.plant.EvalBodyPoseInWorld(self._context, body).translation()
            yield body, SpatialForce(tau=moment, f=force).Shift(origin - point)

    def _add_external(self, forces: Any, *acting: Any) -> Any:
        for body, force in self._external(*acting):
            body.AddInForceInWorld(self._context, force, forces)
        return forces

    def _generalized_force(self, q: Array, wrenches: Array, frames: tuple[Frame, ...], axes: str) -> Array:
        self._set(q)
        forces = self._add_external(MultibodyForces(self.plant), wrenches, frames, axes)
        return self._force(self.plant.CalcGeneralizedForces(self._context, forces))

    def _inverse_dynamics_with_wrenches(
        self, q: Array, v: Array, a: Array, wrenches: Array, frames: tuple[Frame, ...], axes: str
    ) -> Array:
        return self._inverse_dynamics(q, v, a, wrenches, frames, axes)

    @contextlib.contextmanager
    def _pushed(self, wrenches: Array, frames: tuple[Frame, ...], axes: str) -> Iterator[None]:
        """Hold wrenches, at the state that is in, on Drake's port."""
        port = self.plant.get_applied_spatial_force_input_port()
        held = []
        for body, force in self._external(wrenches, frames, axes):
            one = ExternallyAppliedSpatialForce()
            one.body_index, one.p_BoBq_B, one.F_Bq_W = body.index(), np.zeros(3), force
            held.append(one)
        port.FixValue(self._context, held)
        try:
            yield
        finally:
            port.FixValue(self._context, [])

    def _forward_dynamics_with_wrenches(
        self, q: Array, v: Array, tau: Array, wrenches: Array, frames: tuple[Frame, ...], axes: str
    ) -> Array:
        if self.model.layout.reduced:
            return self._forward_dynamics(q, v, tau + self._generalized_force(q, wrenches, frames, axes))
        self._set(q)
        with self._pushed(wrenches, frames, axes):
            return self._forward_dynamics(q, v, tau)

    @staticmethod
    def _reactions(plant: Any, context: Any, a: Array, forces: Any) -> Any:
        """Return the joints' reactions, by Drake's number, of the motion with these accelerations under forces."""
        tau = plant.CalcInverseDynamics(context, a, forces)
        plant.get_applied_generalized_force_input_port().FixValue(context, tau)
        return plant.get_reaction_forces_output_port().Eval(context)

    def _joint_wrenches(self, q: Array, v: Array, a: Array, *given: Any) -> Array:
        *wrenches, joints, frames, axes = given
        acting = (wrenches[0] if wrenches else np.empty(0), frames, axes)
        b = self._set(q, v)
        moved = self._to_engine(a) + b
        forces = MultibodyForces(self.plant)
        self.plant.CalcForceElementsContribution(self._context, forces)
        with self._pushed(*acting):
            forces = self._add_external(forces, *acting)
            reactions = self._reactions(self.plant, self._context, moved, forces)
        return np.array([_on_child(self.maps.joints[joint.name], reactions) for joint in joints]).reshape(-1, 6)


def _on_child(joint: Any, reactions: Any) -> Array:
    """Return a joint's reaction about its child's origin, in the child's axes."""
    reaction, X_CJ = reactions[int(joint.index())], joint.frame_on_child().GetFixedPoseInBodyFrame()
    return _linear_first(reaction.Rotate(X_CJ.rotation()).Shift(-X_CJ.translation()))
