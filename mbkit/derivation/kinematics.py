"""Kinematics of a model as CasADi expressions: nothing but placements and twists.

Vectors are lists of three `Scalar`s or floats, so that every zero and one of the
description vanishes while the graph is built.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from typing import Any

import casadi as ca

from mbkit.derivation import model_values
from mbkit.derivation.model_values import Constants, Values, is_zero, scalar
from mbkit.model import GravityCompensation, Joint, JointCoupling, Model
from mbkit.model.changes.jumps import jump_rates
from mbkit.model.joint_types import cross3, dot3
from mbkit.model.parts import PointSpring

Vector = list[Any]


def add(a: Vector, b: Vector) -> Vector:
    """Return a + b."""
    return [x + y for x, y in zip(a, b, strict=True)]


def column(entries: Iterable[Any]) -> Any:
    """Return scalars as one column, which may be empty."""
    return ca.vertcat(ca.SX(0, 1), *(ca.SX(x) for x in entries))


def constant_times(A: list[Vector], x: Vector) -> Vector:
    """Return A x for a matrix of the model's numbers, leaving out its zeros."""
    return [sum((A[i][k] * x[k] for k in range(3) if not is_zero(A[i][k])), 0.0) for i in range(3)]


def constant_transposed_times(A: list[Vector], x: Vector) -> Vector:
    """Return Aᵀ x for a matrix of the model's numbers, leaving out its zeros."""
    return [sum((A[k][i] * x[k] for k in range(3) if not is_zero(A[k][i])), 0.0) for i in range(3)]


def follower(coupler: Any, leading: Vector) -> Any:
    """Return the coordinate that a coupler's numbers give a joint where its leaders' are `leading`."""
    (first, *others), (ratio, *ratios) = leading, coupler.ratios
    constant = sum((r * x for r, x in zip(ratios, others, strict=True)), coupler.offset)
    coefficients = [constant, ratio, *coupler.curve]
    while len(coefficients) > 2 and is_zero(coefficients[-1]):
        coefficients.pop()
    out = coefficients.pop()
    while coefficients:
        out = out * first + coefficients.pop()
    return out


class Kinematics:
    """Symbols q and v, the model's reduced coordinates and velocities, and what moves with them.

    `formulas` has the sine and cosine of this arithmetic: `mbkit.lagrangian` has others.
    """

    formulas: Any = model_values
    zero: Any = ca.SX(0)
    half: Any = 0.5

    def __init__(self, model: Model, constants: Constants = "literal") -> None:
        self.model = model
        self.values = Values(model, constants)
        self.q = ca.SX.sym("q", model.nq)
        self.v = ca.SX.sym("v", model.nv)
        layout = model.layout
        self._q_of: dict[str, Vector] = {}
        self._v_of: dict[str, Vector] = {}
        for joint in model.joints:
            own, values = joint.mimic.joint if joint.mimic else joint.name, self.values.of(joint)
            q, v = (
                [scalar(self.q[i]) for i in _range(layout.q[own])],
                [scalar(self.v[i]) for i in _range(layout.v[own])],
            )
            self._q_of[joint.name] = [values.ratio * x + values.offset for x in q] if joint.mimic else q
            self._v_of[joint.name] = [values.ratio * x for x in v] if joint.mimic else v
        self._carrier = {j.child: j for j in model.joints}

    def coordinates(self, joint: Joint) -> Vector:
        """Return the joint's coordinates, those of its leader if it mimics."""
        return self._q_of[joint.name]

    def velocities(self, joint: Joint) -> Vector:
        """Return the joint's velocities."""
        return self._v_of[joint.name]

    def coupled_length(self, coupling: JointCoupling) -> Any:
        """Return the sum of a coupling's factors times coordinates."""
        return self._coupled(coupling, self._q_of)

    def coupled_rate(self, coupling: JointCoupling) -> Any:
        """Return the rate of a coupling's length."""
        return self._coupled(coupling, self._v_of)

    def _coupled(self, coupling: JointCoupling, of: dict[str, Vector]) -> Any:
        factors = self.values.of(coupling).factors
        return sum((c * of[joint][0] for c, joint in zip(factors, coupling.joints, strict=True)), 0.0)

    @cached_property
    def placements(self) -> dict[str, tuple[Any, Vector]]:
        """(R_JC, p_JC_J) of every joint."""
        return {j.name: j.type.placement(self.formulas, self.values.of(j), self._q_of[j.name]) for j in self.model.tree}

    @cached_property
    def twists(self) -> dict[str, tuple[Vector, Vector]]:
        """Linear and angular velocity of every body's origin in the world, in its own axes."""
        out: dict[str, tuple[Vector, Vector]] = {"world": ([0.0] * 3, [0.0] * 3)}
        for joint in self.model.tree:
            linear, angular = out[joint.parent]
            values = self.values.of(joint)
            at_joint = add(linear, cross3(angular, values.translation))
            R, p = self.placements[joint.name]
            angular_J = constant_transposed_times(values.rotation, angular)
            linear_J = add(constant_transposed_times(values.rotation, at_joint), cross3(angular_J, p))
            own = joint.type.twist(self.formulas, values, self._q_of[joint.name], self._v_of[joint.name])
            out[joint.child] = (
                add(_transposed_times(R, linear_J), own[0]),
                add(_transposed_times(R, angular_J), own[1]),
            )
        return out

    def carrier(self, body: str) -> Joint:
        """Return the joint that carries a body."""
        return self._carrier[body]

    def to_parent(self, joint: Joint, x: Vector, weight: Any = 1.0) -> Vector:
        """Return R_PC x + weight · p_PC: a point (weight 1), vector (0) or first moment (mass)."""
        R, p = self.placements[joint.name]
        in_J = add(_times(R, x), [weight * c for c in p])
        values = self.values.of(joint)
        in_P = constant_times(values.rotation, in_J)
        return add(in_P, [weight * c for c in values.translation])

    def from_parent(self, joint: Joint, x: Vector) -> Vector:
        """Return R_PCᵀ x of a vector."""
        R, _ = self.placements[joint.name]
        return _transposed_times(R, constant_transposed_times(self.values.of(joint).rotation, x))

    def to_world(self, body: str, x: Vector, weight: float = 1.0) -> Vector:
        """Return a point (weight 1) or vector (weight 0) of a body in world axes."""
        return self.carried_to(body, "world", x, weight)

    def carried_to(self, body: str, to: str, x: Vector, weight: float) -> Vector:
        """Return a point (weight 1) or vector (weight 0) of a body in the axes of one that carries it."""
        while body != to:
            joint = self._carrier[body]
            x, body = self.to_parent(joint, x, weight), joint.parent
        return x

    def ends(self, part: Any) -> list[tuple[Vector, list[Vector]]]:
        """Return places and axes of the frames of a loop or bushing, in the axes of the body that carries both ends."""
        values, both, out = self.values.of(part), self.model.carrier(part), list[tuple[Vector, list[Vector]]]()
        for side in "ab":
            body, R = getattr(part, f"body_{side}"), getattr(values, f"rotation_{side}")
            place = self.carried_to(body, both, list(getattr(values, f"translation_{side}")), 1.0)
            axes = [self.carried_to(body, both, [row[k] for row in R], 0.0) for k in range(3)]
            out.append((place, axes))
        return out

    def velocity_at(self, body: str, to: str, at: Vector) -> Vector:
        """Return the velocity of the point of a body at a place, seen from the body `to` that carries it, in its axes.

        Joint by joint from there: a wheel's turn about its own axis then stands in no sine.
        """
        out: Vector = [0.0] * 3
        while body != to:
            joint = self._carrier[body]
            values = self.values.of(joint)
            twist = joint.type.twist(self.formulas, values, self.coordinates(joint), self.velocities(joint))
            linear, angular = (self.carried_to(body, to, list(x), 0.0) for x in twist)
            origin = self.carried_to(body, to, [0.0] * 3, 1.0)
            out = add(out, add(linear, cross3(angular, [x - y for x, y in zip(at, origin, strict=True)])))
            body = joint.parent
        return out

    def squared_length(self, spring: PointSpring) -> Any:
        """Return |p_AB|² of the points that a spring joins."""
        values = self.values.of(spring)
        a = self.to_world(spring.body_a, values.point_a)
        b = self.to_world(spring.body_b, values.point_b)
        gap = [y - x for x, y in zip(a, b, strict=True)]
        return dot3(gap, gap)

    def length(self, square: Any) -> Any:
        """Return the root of a squared length."""
        # CasADi makes |x| of the root of x², with the derivative 0 at x = 0, where a length has none.
        # The factor, which rounds nothing, prevents that: the derivative is NaN there.
        return 0.5 * ca.sqrt(4.0 * square)

    def length_rate(self, square: Any) -> Any:
        """Return the rate of a length from its square."""
        return ca.jtimes(self.length(square), self.q, self.qdot)

    @cached_property
    def qdot(self) -> ca.SX:
        """D(q) v."""
        parts = [x for j in self.model.independent_joints for x in j.type.qdot(self._q_of[j.name], self._v_of[j.name])]
        return ca.vertcat(ca.SX(0, 1), *parts)

    def pullback(self, gradient: ca.SX) -> ca.SX:
        """Return D(q)ᵀ g for a gradient with respect to q."""
        parts: Vector = []
        for j in self.model.independent_joints:
            g = [scalar(gradient[i]) for i in _range(self.model.layout.q[j.name])]
            parts += j.type.pullback(self._q_of[j.name], g)
        return ca.vertcat(ca.SX(0, 1), *parts)


def _range(part: slice) -> range:
    return range(part.start, part.stop)


def _times(R: Any, x: Vector) -> Vector:
    return [R[i][0] * x[0] + R[i][1] * x[1] + R[i][2] * x[2] for i in range(3)]


def _transposed_times(R: Any, x: Vector) -> Vector:
    return [R[0][i] * x[0] + R[1][i] * x[1] + R[2][i] * x[2] for i in range(3)]


# Kinetic and potential energy and the damping forces, from kinematics alone.


def kinetic_energy(kin: Kinematics) -> Any:
    """Return T = Σ ½ m |v_com|² + ½ ωᵀ I ω (König's theorem) + ½ Σ ρ v² + ½ Σ ρ (dl/dt)², with the rotors ρ."""
    total = kin.zero
    for body in kin.model.bodies:
        linear, angular = kin.twists[body.name]
        values = kin.values.of(body)
        at_com = add(linear, cross3(angular, values.com))
        if not is_zero(values.mass):
            total += 0.5 * values.mass * dot3(at_com, at_com)
        total += 0.5 * dot3(angular, constant_times(values.inertia, angular))
    for rotor, rate in along_rates(kin, "T"):
        total += 0.5 * rotor * rate * rate
    return total


def along_rates(kin: Kinematics, effect: str) -> Iterator[tuple[Any, Any]]:
    """Yield the numbers of joints and couplings with an effect, each with the rate along which it acts."""
    parts: tuple[Joint | JointCoupling, ...] = (*kin.model.joints, *kin.model.couplings)
    for part in parts:
        rates = kin.velocities(part) if isinstance(part, Joint) else [kin.coupled_rate(part)]
        for numbers in (getattr(kin.values.of(part), name) for name in part.adding_to(effect)):
            yield from zip(numbers if isinstance(numbers, list) else [numbers], rates, strict=True)


def gravity_energy(kin: Kinematics, shares: Mapping[str, Any] | None = None) -> Any:
    """Return V = -Σ m g · p_com, zero with every centre of mass at the world's origin.

    First moments are gathered from the leaves to the root: each joint costs one rotation of a vector. With `shares`,
    numbers by which masses are multiplied, it is the energy of these bodies alone.
    """
    model = kin.model
    moments: dict[str, list[Any]] = {"world": [0.0] * 3}
    masses: dict[str, Any] = {"world": 0.0}
    for body in model.bodies:
        values = kin.values.of(body)
        mass = values.mass if shares is None else values.mass * shares.get(body.name, 0.0)
        moments[body.name] = [mass * c for c in values.com]
        masses[body.name] = mass
    for joint in reversed(model.tree):
        moments[joint.parent] = add(
            moments[joint.parent], kin.to_parent(joint, moments[joint.child], masses[joint.child])
        )
        masses[joint.parent] += masses[joint.child]
    return kin.zero - dot3(kin.values.gravity, moments["world"])


def compensation_energies(kin: Kinematics) -> dict[tuple[str, ...], Any]:
    """Return V = Σ fraction m g · p_com of what holds the weight of bodies, by the joints at which it does not act."""
    shares: dict[tuple[str, ...], dict[str, Any]] = {}
    for f in kin.model.forces:
        if isinstance(f, GravityCompensation):
            shares.setdefault(f.without, {})[f.body] = kin.values.of(f).fraction
    return {without: kin.zero - gravity_energy(kin, own) for without, own in shares.items()}


def spring_energy(kin: Kinematics) -> Any:
    """Return the energy stored in the springs of joints, of couplings and between points."""
    total = kin.zero
    for joint in kin.model.joints:
        values = kin.values.of(joint)
        for k, stiffness in enumerate(values.stiffness):
            if not is_zero(stiffness):
                stretch = kin.coordinates(joint)[k] - values.rest[k]
                total += kin.half * stiffness * stretch * stretch
    for coupling in kin.model.couplings:
        values = kin.values.of(coupling)
        if not is_zero(values.stiffness):
            stretch = kin.coupled_length(coupling) - values.rest_length
            total += kin.half * values.stiffness * stretch * stretch
    for spring in kin.model.springs:
        values = kin.values.of(spring)
        if is_zero(values.stiffness):
            continue
        square = kin.squared_length(spring)
        if is_zero(values.rest_length):
            total += kin.half * values.stiffness * square
        else:
            stretch = kin.length(square) - values.rest_length
            total += kin.half * values.stiffness * stretch * stretch
    return total


def dissipation(kin: Kinematics) -> Any:
    """Return Rayleigh's R = ½ Σ d v² + ½ Σ c (dl/dt)²."""
    total = kin.zero
    for damping, rate in along_rates(kin, "loss"):
        total += kin.half * damping * rate * rate
    for spring in kin.model.springs:
        damping = kin.values.of(spring).damping
        if not is_zero(damping):
            rate = kin.length_rate(kin.squared_length(spring))
            total += kin.half * damping * rate * rate
    return total


def damping_forces(kin: Kinematics) -> Any:
    """Return -∂R/∂v, and -f(|v|) sign(v) by the law of `mbkit.model.changes.jumps`, which is zero at rest."""
    smooth = -ca.gradient(dissipation(kin), kin.v)
    jumps = [ca.gradient(rate, kin.v) * (size * ca.sign(rate)) for rate, size in jump_rates(kin, ca.exp)]
    return smooth - sum(jumps[1:], jumps[0]) if jumps else smooth
