"""Motion of frames, momenta and loads by Drake. A part of `DrakeDynamics`.

Drake's spatial vectors are of a point, in world axes, with the angular part first in arrays. Its reaction forces are
those of its own forward dynamics: the forces of inverse dynamics are applied, so that the motion is the one asked for.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.multibody.tree import JacobianWrtVariable, MultibodyForces

from mbkit._check import Array
from mbkit.engines.drake.model import DrakeModel
from mbkit.engines.frames_and_momenta import Composed, MovingFrames
from mbkit.model import Frame, Model
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
