"""The terms of bodies and of the whole that are compared: motion of a frame, momentum, loads, derivatives.

The frame is the body at the end of the longest branch. Linear and angular parts have scales of their own, in which no
number that happens to be small counts: what the velocities can do to a point, or to the bodies. With the columns J_j of
the frame's Jacobian, the linear part at least the angular one times the reach, W = Σ |J_ω,j v_j| and U = Σ |J_v,j v_j|
bound its velocity, and W U, W² the acceleration that comes from velocities. Forces are measured by all matter moving as
the frame does, or by the largest that there is, and moments by these with the longest branch for an arm. A_G's column j
is at most √(m M_jj) and √(tr I M_jj) (Cauchy and Schwarz), with the inertia about the world's origin.

The regressor's columns are taken for a body with the mass of the whole at the reach, and its rows over √M_jj, so that
all are of one unit. Derivatives of inverse dynamics are measured as forces are, by the norm of each matrix. Those of
forward dynamics follow from these and M⁻¹.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.engines.oracle import OracleDynamics
from mbkit.model import Model
from mbkit.model.base_parameters import STANDARD
from mbkit.studies.compare.errors import Errors, Scales, acceleration_errors, ratio
from mbkit.studies.compare.terms import JOINT_LOADS, LoadsUnderForce, States, Term

#: N and Nm on the frame, in its own axes.
WRENCH: Final = (3.0, -2.0, 5.0, 0.4, 0.7, -0.3)


@dataclass(frozen=True, kw_only=True)
class BodyScales(Scales):
    """Scales of the errors of bodies, per sample."""

    columns: Array  # (N, 2, nv), norms of J's linear and angular columns
    velocity: Array  # (N, 2), U and W of the frame
    acceleration: Array  # (N, 2), of the frame
    reach: Array  # (N,), length of the longest branch
    curved: Array  # (N,), force on all matter where velocities bend the frame's way
    force: Array  # (N,), and where it is accelerated, with its weight
    mass: float
    spread: Array  # (N,), trace of the inertia about the world's origin
    speeds: Array  # (N, nv), v

    @classmethod
    def around(cls, scales: Scales, oracle: OracleDynamics, at: States) -> BodyScales:
        """Return the scales of a model's bodies beside those of its equation of motion."""
        model, frame = oracle.model, farthest(oracle.model)
        J = oracle.jacobian(at.q, frame)
        linear, angular = np.linalg.norm(J[:, :3], axis=1), np.linalg.norm(J[:, 3:], axis=1)
        reach = _reach(oracle, at.q)
        # An engine may start from any point: a frame that a joint only turns stands still up to rounding.
        columns = np.stack([np.maximum(linear, angular * reach[:, None]), angular], axis=1)
        speed, push = (np.einsum("nij,nj->ni", columns, np.abs(x)) for x in (at.v, at.a))
        curved = speed * speed[:, 1:]
        center, I = oracle.center_of_mass(at.q), oracle.locked_inertia(at.q)
        return cls(
            **vars(scales),
            columns=columns,
            velocity=speed,
            acceleration=push + curved,
            reach=reach,
            curved=model.mass * curved[:, 0],
            force=model.mass * (push + curved)[:, 0] + model.mass * np.linalg.norm(model.gravity),
            mass=model.mass,
            # About the world's origin, where the sums begin: about G a point mass has none.
            spread=np.einsum("nii->n", I[:, 3:, 3:]) + 2 * model.mass * np.sum(center**2, axis=1),
            speeds=at.v,
        )


def farthest(model: Model) -> str:
    """Return the body at the end of the longest branch, counted in joints."""
    depth = {"world": 0}
    for joint in model.tree:
        depth[joint.child] = depth[joint.parent] + 1
    return max(depth, key=depth.__getitem__)


def _reach(oracle: OracleDynamics, q: Array) -> Array:
    """Return the longest way from the world to a body along its branch, at each pose."""
    model = oracle.model
    X = oracle.body_poses(q)
    places = {"world": np.zeros((len(q), 3))} | {b.name: X[:, k, :3, 3] for k, b in enumerate(model.bodies)}
    ways = {"world": np.zeros(len(q))}
    for joint in model.tree:
        step = np.linalg.norm(places[joint.child] - places[joint.parent], axis=1)
        ways[joint.child] = ways[joint.parent] + step
    com = {b.name: float(np.linalg.norm(b.com)) for b in model.bodies}
    return np.asarray(np.max([way + com.get(name, 0.0) for name, way in ways.items()], axis=0))


def _halves(error: Array, linear: Array, angular: Array) -> Errors:
    """Measure (N, 6) or (N, k, 6), of which every six have linear and angular part."""
    e = np.abs(error).reshape(len(error), -1, 2, 3)
    size = np.linalg.norm(e, axis=3)
    relative = ratio(size, np.stack([linear, angular], axis=1)[:, None, :])
    return Errors(e.max(axis=(1, 2, 3), initial=0.0), relative.max(axis=(1, 2), initial=0.0), np.empty(0))


def _pose_errors(error: Array, reference: Array, scales: BodyScales) -> Errors:  # noqa: ARG001  # as the others
    turned = np.abs(error[:, :3, :3]).max(axis=(1, 2))
    moved = np.linalg.norm(error[:, :3, 3], axis=1)
    relative = np.maximum(turned, ratio(moved, scales.reach))
    return Errors(np.abs(error).max(axis=(1, 2)), relative, np.empty(0))


def _jacobian_errors(error: Array, reference: Array, scales: BodyScales) -> Errors:  # noqa: ARG001  # as the others
    e = np.stack([np.linalg.norm(error[:, :3], axis=1), np.linalg.norm(error[:, 3:], axis=1)], axis=1)
    each = ratio(e, scales.columns.max(axis=2, initial=0.0)[:, :, None])
    return Errors(
        np.abs(error).max(axis=(1, 2), initial=0.0), each.max(axis=(1, 2), initial=0.0), each.max(axis=(0, 1))
    )


def _acceleration_of_frame_errors(error: Array, reference: Array, scales: BodyScales) -> Errors:  # noqa: ARG001
    return _halves(error, *scales.acceleration.T)


def _center_errors(error: Array, reference: Array, scales: BodyScales) -> Errors:
    e = np.linalg.norm(error, axis=1)
    relative = ratio(e, np.maximum(scales.reach, np.linalg.norm(reference, axis=1)))
    return Errors(np.abs(error).max(axis=1), relative, np.empty(0))


def _momentum_matrix_errors(error: Array, reference: Array, scales: BodyScales) -> Errors:  # noqa: ARG001
    root = np.sqrt(np.abs(scales.diagonal))
    linear = ratio(np.linalg.norm(error[:, :3], axis=1), np.sqrt(scales.mass) * root)
    angular = ratio(np.linalg.norm(error[:, 3:], axis=1), np.sqrt(scales.spread)[:, None] * root)
    each = np.maximum(linear, angular)
    return Errors(np.abs(error).max(axis=(1, 2), initial=0.0), each.max(axis=1, initial=0.0), each.max(axis=0))


def _load_errors(error: Array, reference: Array, scales: BodyScales) -> Errors:
    return _forces(error, reference, scales.force, scales.reach)


def _mechanism_load_errors(error: Array, reference: Array, scales: BodyScales) -> Errors:
    """Measure loads that follow from the forces in loops, per condition of all equations as these are."""
    e = _load_errors(error, reference, scales)
    return Errors(e.absolute, e.relative / scales.of_accelerations, e.per_velocity)


def _forces(error: Array, reference: Array, force: Array, arm: Array, moment: Array | float = 0.0) -> Errors:
    force = np.maximum(force, np.abs(reference[..., :3]).max(axis=(1, 2), initial=0.0))
    angular = np.maximum(force * arm + moment, np.abs(reference[..., 3:]).max(axis=(1, 2), initial=0.0))
    return _halves(error, force, angular)


def _momentum_bias_errors(error: Array, reference: Array, scales: BodyScales) -> Errors:
    # The centre of mass moves along the momentum: m v × v is zero as far as rotations are orthogonal.
    carried = scales.mass * scales.velocity[:, 0] ** 2
    return _forces(error[:, None], reference[:, None], scales.curved, scales.reach, carried)


def _locked_inertia_errors(error: Array, reference: Array, scales: BodyScales) -> Errors:  # noqa: ARG001
    linear = np.abs(error[:, :3]).max(axis=(1, 2)) / (scales.mass or 1.0)
    angular = ratio(np.abs(error[:, 3:, 3:]).max(axis=(1, 2)), scales.spread)
    return Errors(np.abs(error).max(axis=(1, 2)), np.maximum(linear, angular), np.empty(0))


def _inverse_errors(error: Array, reference: Array, scales: BodyScales) -> Errors:  # noqa: ARG001  # as the others
    """Measure M⁻¹ scaled as M is, by its norm, per cond(M)."""
    root = np.sqrt(np.abs(scales.diagonal))
    e = np.abs(error) * root[:, :, None] * root[:, None, :]
    # The norm of the scaled inverse is its condition over the norm of what it is the inverse of.
    each = ratio(e, (scales.condition**2 / scales.size)[:, None, None])
    return Errors(
        np.abs(error).max(axis=(1, 2), initial=0.0), each.max(axis=(1, 2), initial=0.0), each.max(axis=(0, 1))
    )


def _pushed_errors(error: Array, reference: Array, scales: BodyScales) -> Errors:  # noqa: ARG001  # as the others
    """Measure Jᵀ w by what the columns let it be."""
    most = np.tensordot(np.linalg.norm(np.reshape(WRENCH, (2, 3)), axis=1), scales.columns, (0, 1))
    e = np.abs(error)
    relative = ratio(np.linalg.norm(e, axis=1), np.linalg.norm(most, axis=1))
    return Errors(e.max(axis=1, initial=0.0), relative, ratio(e, most).max(axis=0))


def _regressor_errors(error: Array, reference: Array, scales: BodyScales) -> Errors:
    """Measure (N, nv, 10 k) of the standard parameters by the largest force of a body with the mass of the whole."""
    arm = scales.reach[:, None]
    of_body = [arm**2 if name.startswith("I") else arm if name.startswith("h") else arm**0 for name in STANDARD]
    weights = scales.mass * np.tile(np.hstack(of_body), error.shape[2] // len(STANDARD))[:, None, :]
    root = np.sqrt(np.where(scales.diagonal > 0, scales.diagonal, 1.0))[:, :, None]
    most = (np.abs(reference) * weights / root).max(axis=(1, 2), initial=0.0)
    each = ratio((np.abs(error) * weights / root).max(axis=2, initial=0.0), most[:, None])
    return Errors(np.abs(error).max(axis=(1, 2), initial=0.0), each.max(axis=1, initial=0.0), each.max(axis=0))


def _slope_errors(error: Array, reference: Array, scales: BodyScales) -> Errors:
    """Measure (N, 3, nv, nv), the derivatives by q, v and a, each by its norm; a joint's own figure as M's entries."""
    speed, size = np.linalg.norm(scales.speeds, axis=1), np.linalg.norm(scales.M, 2, axis=(1, 2))
    least = np.stack([scales.inertial, size * speed, size], axis=1)
    relative = ratio(_norms(error), np.maximum(_norms(reference), least)).max(axis=1)
    root = np.sqrt(np.where(scales.diagonal > 0, scales.diagonal, 1.0))
    e, x = (np.abs(y) / (root[:, :, None] * root[:, None, :])[:, None] for y in (error, reference))
    own = np.maximum(x.max(axis=(2, 3), initial=0.0), np.stack([speed**2, speed, np.ones_like(speed)], axis=1))
    each = ratio(e.max(axis=3, initial=0.0), own[:, :, None])
    return Errors(np.abs(error).max(axis=(1, 2, 3), initial=0.0), relative, each.max(axis=(0, 1)))


def _norms(x: Array) -> Array:
    return np.asarray(np.linalg.norm(x, axis=(2, 3)))


def _frame(model: Model) -> tuple[Any, ...]:
    return (farthest(model),)


def _wrench(model: Model) -> tuple[Any, ...]:
    return ({farthest(model): WRENCH},)


#: Compared after the terms of the equation of motion, where there are bodies with mass.
BODY_TERMS: Final = (
    Term("pose", "pose", _pose_errors, _frame),
    Term("Jacobian", "jacobian", _jacobian_errors, _frame),
    Term("velocity", "velocity", lambda e, _, scales: _halves(e, *scales.velocity.T), _frame),
    Term("acceleration", "acceleration", _acceleration_of_frame_errors, _frame),
    Term("J̇ v", "jacobian_dot_v", _acceleration_of_frame_errors, _frame),
    Term("centre of mass", "center_of_mass", _center_errors),
    Term("A_G", "centroidal_momentum_matrix", _momentum_matrix_errors),
    Term("Ȧ_G v", "centroidal_momentum_bias", _momentum_bias_errors),
    Term("locked inertia", "locked_inertia", _locked_inertia_errors),
    Term("M⁻¹", "mass_matrix_inverse", _inverse_errors),
    Term("joint loads", JOINT_LOADS, _load_errors),
    Term("Jᵀ wrench", "generalized_force", _pushed_errors, _wrench),
    Term("forward dynamics, wrench", "forward_dynamics", acceleration_errors, _wrench),
    Term("regressor", "regressor", _regressor_errors),
    Term("∂ID/∂(q, v, a)", "inverse_dynamics_derivatives", _slope_errors),
)
#: The same where a force τ decides the loads beside the motion.
MECHANISM_TERMS: Final = tuple(
    LoadsUnderForce(x.name, x.quantity, _mechanism_load_errors) if x.quantity == JOINT_LOADS else x for x in BODY_TERMS
)
