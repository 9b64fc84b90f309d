"""Regressors: torques, momentum and energies as linear functions of the inertial parameters of the bodies.

A body with mass m, first moment h = m c and inertia I about the origin of its frame takes a wrench that is linear in
these ten parameters. With the acceleration a of the origin less gravity and the angular velocity ω, in the body's axes
(Khalil and Dombre 2002, Modeling, Identification and Control of Robots, ch. 12.3)::

    force   m a + ω̇ × h + ω × (ω × h)
    moment  h × a + I ω̇ + ω × I ω

By d'Alembert's principle in Lagrange's form τ = Σ Jᵀ A π, with the Jacobian J of the velocity of the body's frame and
the matrix A (6, 10) of this wrench. The kinetic energy ½ m v² + h · (v × ω) + ½ ω · I ω gives the momentum by its
derivative, and the potential energy of gravity is -g · (m p + R h). J, v and ω are those of the kinematics, and
accelerations one directional derivative along (D v, v̇).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import casadi as ca

from mbkit.derivation.kinematics import Kinematics, Vector, add
from mbkit.derivation.model_values import is_zero, scalar
from mbkit.model.base_parameters import PAIRS, STANDARD, RegressorColumns
from mbkit.model.joint_types import cross3, dot3

_SIZE: Final = len(STANDARD)
_UNITS: Final[list[Vector]] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


@dataclass
class _Motion:
    """Velocity of a body's frame, its rate without gravity, and its Jacobian's columns, in the body's axes."""

    velocity: Vector
    spin: Vector
    acceleration: Vector
    spin_rate: Vector
    #: Index of a velocity, with the linear and the angular part of its column.
    columns: list[tuple[int, Vector, Vector]]

    def wrenches(self) -> list[tuple[Vector, Vector]]:
        """Return force and moment of a unit of each parameter: the columns of A."""
        a, w, rate = self.acceleration, self.spin, self.spin_rate
        inertias = [([0.0] * 3, add(_times(pair, rate), cross3(w, _times(pair, w)))) for pair in PAIRS]
        moments = [(add(cross3(rate, e), cross3(w, cross3(w, e))), cross3(e, a)) for e in _UNITS]
        return [*inertias, *moments, (a, [0.0] * 3)]

    def momenta(self) -> list[tuple[Vector, Vector]]:
        """Return linear and angular momentum of a unit of each parameter, about the body's origin."""
        v, w = self.velocity, self.spin
        inertias = [([0.0] * 3, _times(pair, w)) for pair in PAIRS]
        return [*inertias, *((cross3(w, e), cross3(e, v)) for e in _UNITS), (v, [0.0] * 3)]

    def kinetic_energies(self) -> Vector:
        """Return the kinetic energy of a unit of each parameter."""
        v, w = self.velocity, self.spin
        return [*(0.5 * dot3(w, _times(pair, w)) for pair in PAIRS), *cross3(v, w), 0.5 * dot3(v, v)]


def torque_regressor(kin: Kinematics, a: ca.SX, columns: RegressorColumns) -> Any:
    """Return the matrix Y(q, v, a), nv rows, of the forces τ = Y π; a are the rates of v."""
    inertial = _by_velocity(kin, _motions(kin, columns.bodies, a), _Motion.wrenches, columns.bodies)
    own = columns.of_rates(loss=kin.v, jump=ca.sign(kin.v), T=a)
    return ca.horzcat(inertial, *(_columns_of(*x) for x in own))


def momentum_regressor(kin: Kinematics, columns: RegressorColumns) -> Any:
    """Return the matrix Y(q, v), nv rows, of the generalized momentum ∂T/∂v = Y π."""
    inertial = _by_velocity(kin, _motions(kin, columns.bodies), _Motion.momenta, columns.bodies)
    return ca.horzcat(inertial, *(_columns_of(*x) for x in columns.of_rates(T=kin.v)))


def energy_regressor(kin: Kinematics, columns: RegressorColumns) -> Any:
    """Return the matrix Y(q, v) of two rows, T = Y₀ π and gravity's V = Y₁ π."""
    motions, down = _motions(kin, columns.bodies), _gravity(kin)
    bodies = [joint.child for joint in kin.model.tree]
    kinetic, potential = [], []
    for index, kind in (divmod(k, _SIZE) for k in columns.bodies):
        kinetic.append(motions[index].kinetic_energies()[kind] if index in motions else 0.0)
        heights = [*([0.0] * len(PAIRS)), *(-x for x in down[bodies[index]])]
        if kind == len(heights):
            heights.append(-dot3(kin.values.gravity, kin.to_world(bodies[index], [0.0] * 3)))
        potential.append(heights[kind])
    rotors = [0.5 * v[k] ** 2 for v, which in columns.of_rates(T=kin.v) for k in which]
    kinetic, potential = kinetic + rotors, potential + [0.0] * len(rotors)
    return ca.vertcat(_row(kinetic), _row(potential))


def _columns_of(x: ca.SX, which: Sequence[int]) -> Any:
    """Return these columns of a diagonal matrix."""
    return ca.diag(x)[:, list(which)] if which else ca.SX(x.numel(), 0)


def _by_velocity(
    kin: Kinematics,
    motions: dict[int, _Motion],
    of: Callable[[_Motion], list[tuple[Vector, Vector]]],
    columns: Sequence[int],
) -> Any:
    """Return Jᵀ times what a unit of each parameter gives."""
    pairs = {index: of(motion) for index, motion in motions.items()}
    entries: list[Any] = []
    for index, kind in (divmod(k, _SIZE) for k in columns):
        column: list[Any] = [0.0] * kin.model.nv
        if index in motions:
            force, moment = pairs[index][kind]
            for k, linear, angular in motions[index].columns:
                column[k] = dot3(linear, force) + dot3(angular, moment)
        entries += column
    return ca.reshape(_row(entries), kin.model.nv, len(columns))


def _row(entries: list[Any]) -> Any:
    return ca.horzcat(ca.SX(1, 0), *entries)


def _motions(kin: Kinematics, columns: Sequence[int], a: ca.SX | None = None) -> dict[int, _Motion]:
    """Return the motions of the bodies that have these parameters, by their index; those at rest are left out."""
    bodies = [joint.child for joint in kin.model.tree]
    indices = sorted({k // _SIZE for k in columns})
    moving = [k for k in indices if not all(is_zero(x) for half in kin.twists[bodies[k]] for x in half)]
    twists = ca.vertcat(ca.SX(0, 1), *(ca.SX(x) for k in moving for half in kin.twists[bodies[k]] for x in half))
    J = ca.jacobian(twists, kin.v)
    rates = ca.SX(twists.numel(), 1)
    down = _gravity(kin)
    if a is not None:
        rates = ca.jtimes(twists, ca.vertcat(kin.q, kin.v), ca.vertcat(kin.qdot, a))
    columns_of: dict[int, dict[int, Vector]] = {}
    for i, k in zip(*J.sparsity().get_triplet(), strict=True):
        columns_of.setdefault(i // 6, {}).setdefault(k, [0.0] * 6)[i % 6] = scalar(J[i, k])
    out = {}
    for at, index in enumerate(moving):
        v, w = kin.twists[bodies[index]]
        rate = [_entry(rates[6 * at + i]) for i in range(6)]
        acceleration = [x - y for x, y in zip(add(rate[:3], cross3(w, v)), down[bodies[index]], strict=True)]
        own = [(k, x[:3], x[3:]) for k, x in sorted(columns_of.get(at, {}).items())]
        out[index] = _Motion(v, w, acceleration, rate[3:], own)
    return out


def _gravity(kin: Kinematics) -> dict[str, Vector]:
    """Return the acceleration of gravity in the axes of every body."""
    out: dict[str, Vector] = {"world": kin.values.gravity}
    for joint in kin.model.tree:
        out[joint.child] = kin.from_parent(joint, out[joint.parent])
    return out


def _times(pair: tuple[int, int], x: Vector) -> Vector:
    """Return I x of an inertia with a one at this place, and at that across the diagonal."""
    i, j = pair
    out: Vector = [0.0] * 3
    out[i], out[j] = x[j], x[i]
    return out


def _entry(x: Any) -> Any:
    return 0.0 if x.is_zero() else scalar(x)
