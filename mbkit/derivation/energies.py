"""Kinetic and potential energy and the damping forces, from kinematics alone."""

from __future__ import annotations

from typing import Any

import casadi as ca

from mbkit.derivation.kinematics import Kinematics, add, constant_times, dot3
from mbkit.derivation.values import is_zero
from mbkit.model.kinds import cross3

__all__ = ["damping_forces", "gravity_energy", "kinetic_energy", "spring_energy"]


def kinetic_energy(kin: Kinematics) -> Any:
    """Return T = Σ ½ m |v_com|² + ½ ωᵀ I ω (König's theorem) + ½ Σ armature v² + ½ Σ armature (dl/dt)²."""
    total: Any = ca.SX(0)
    for body in kin.model.bodies:
        linear, angular = kin.twists[body.name]
        values = kin.values.bodies[body.name]
        at_com = add(linear, cross3(angular, values.com))
        if not is_zero(values.mass):
            total += 0.5 * values.mass * dot3(at_com, at_com)
        total += 0.5 * dot3(angular, constant_times(values.inertia, angular))
    for joint in kin.model.joints:
        for rotor, rate in zip(kin.values.joints[joint.name].armature, kin.velocities(joint), strict=True):
            total += 0.5 * rotor * rate * rate
    for coupling in kin.model.couplings:
        _, rate = kin.coupled(coupling)
        total += 0.5 * kin.values.couplings[coupling.name].armature * rate * rate
    return total


def gravity_energy(kin: Kinematics) -> Any:
    """Return V = -Σ m g · p_com, zero with every centre of mass at the world's origin.

    The first moments of the bodies are gathered from the leaves to the root, so
    that each joint costs one rotation of a vector.
    """
    model = kin.model
    moments: dict[str, list[Any]] = {"world": [0.0] * 3}
    masses: dict[str, Any] = {"world": 0.0}
    for body in model.bodies:
        values = kin.values.bodies[body.name]
        moments[body.name] = [values.mass * c for c in values.com]
        masses[body.name] = values.mass
    for joint in reversed(model.tree):
        moments[joint.parent] = add(
            moments[joint.parent], kin.to_parent(joint, moments[joint.child], masses[joint.child])
        )
        masses[joint.parent] += masses[joint.child]
    return ca.SX(0) - dot3(kin.values.gravity, moments["world"])


def spring_energy(kin: Kinematics) -> Any:
    """Return the energy stored in the springs of joints, of couplings and between points."""
    total: Any = ca.SX(0)
    for joint in kin.model.joints:
        values = kin.values.joints[joint.name]
        for k, stiffness in enumerate(values.stiffness):
            if not is_zero(stiffness):
                stretch = kin.coordinates(joint)[k] - values.rest[k]
                total += 0.5 * stiffness * stretch * stretch
    for coupling in kin.model.couplings:
        values = kin.values.couplings[coupling.name]
        if not is_zero(values.stiffness):
            stretch = kin.coupled(coupling)[0] - values.rest_length
            total += 0.5 * values.stiffness * stretch * stretch
    for spring, gap in _gaps(kin):
        if is_zero(spring.stiffness):
            continue
        if is_zero(spring.rest_length):
            total += 0.5 * spring.stiffness * dot3(gap, gap)
        else:
            stretch = _length(gap) - spring.rest_length
            total += 0.5 * spring.stiffness * stretch * stretch
    return total


def damping_forces(kin: Kinematics) -> Any:
    """Return -∂R/∂v for Rayleigh's R = ½ Σ d v² + ½ Σ c (dl/dt)²."""
    dissipation: Any = ca.SX(0)
    for joint in kin.model.joints:
        for damping, rate in zip(kin.values.joints[joint.name].damping, kin.velocities(joint), strict=True):
            dissipation += 0.5 * damping * rate * rate
    for coupling in kin.model.couplings:
        _, rate = kin.coupled(coupling)
        dissipation += 0.5 * kin.values.couplings[coupling.name].damping * rate * rate
    for spring, gap in _gaps(kin):
        if not is_zero(spring.damping):
            rate = ca.jtimes(_length(gap), kin.q, kin.qdot)
            dissipation += 0.5 * spring.damping * rate * rate
    return -ca.gradient(dissipation, kin.v)


def _length(gap: list[Any]) -> Any:
    # CasADi makes |x| of the root of x², with the derivative 0 at x = 0, where a length has none.
    # The factor, which rounds nothing, prevents that: the derivative is NaN there.
    return 0.5 * ca.sqrt(4.0 * dot3(gap, gap))


def _gaps(kin: Kinematics) -> list[tuple[Any, list[Any]]]:
    """Return each point spring's numbers, and the vector between its ends in the world."""
    out = []
    for spring in kin.model.springs:
        values = kin.values.springs[spring.name]
        a = kin.to_world(spring.body_a, values.point_a)
        b = kin.to_world(spring.body_b, values.point_b)
        out.append((values, [y - x for x, y in zip(a, b, strict=True)]))
    return out
