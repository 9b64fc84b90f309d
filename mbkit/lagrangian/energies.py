"""Kinetic and potential energy and the damping forces, from kinematics alone."""

from __future__ import annotations

from typing import Any

import casadi as ca

from mbkit.lagrangian.kinematics import Kinematics, add, constant_times, dot3
from mbkit.model.kinds import cross3

__all__ = ["damping_forces", "gravity_energy", "kinetic_energy", "spring_energy"]


def kinetic_energy(kin: Kinematics) -> Any:
    """Return T = Σ ½ m |v_com|² + ½ ωᵀ I ω + ½ Σ armature v² (König's theorem)."""
    total: Any = ca.SX(0)
    for body in kin.model.bodies:
        linear, angular = kin.twists[body.name]
        at_com = add(linear, cross3(angular, [float(x) for x in body.com]))
        if body.mass:
            total += 0.5 * body.mass * dot3(at_com, at_com)
        total += 0.5 * dot3(angular, constant_times(body.inertia, angular))
    for joint in kin.model.joints:
        for rotor, rate in zip(joint.armature, kin.velocities(joint), strict=True):
            total += 0.5 * float(rotor) * rate * rate
    return total


def gravity_energy(kin: Kinematics) -> Any:
    """Return V = -Σ m g · p_com, zero with every centre of mass at the world's origin.

    The first moments of the bodies are gathered from the leaves to the root, so
    that each joint costs one rotation of a vector.
    """
    model = kin.model
    moments: dict[str, list[Any]] = {"world": [0.0] * 3}
    masses: dict[str, float] = {"world": 0.0}
    for body in model.bodies:
        moments[body.name] = [body.mass * float(c) for c in body.com]
        masses[body.name] = body.mass
    for joint in reversed(model.tree):
        moments[joint.parent] = add(
            moments[joint.parent], kin.to_parent(joint, moments[joint.child], masses[joint.child])
        )
        masses[joint.parent] += masses[joint.child]
    return ca.SX(0) - dot3([float(g) for g in model.gravity], moments["world"])


def spring_energy(kin: Kinematics) -> Any:
    """Return the energy stored in joint springs and point-to-point springs."""
    total: Any = ca.SX(0)
    for joint in kin.model.joints:
        for k, stiffness in enumerate(joint.stiffness):
            if stiffness:
                stretch = kin.coordinates(joint)[k] - float(joint.rest[k])
                total += 0.5 * float(stiffness) * stretch * stretch
    for spring, gap in _gaps(kin):
        if spring.stiffness and spring.rest_length:
            stretch = ca.sqrt(dot3(gap, gap)) - spring.rest_length
            total += 0.5 * spring.stiffness * stretch * stretch
        elif spring.stiffness:
            total += 0.5 * spring.stiffness * dot3(gap, gap)
    return total


def damping_forces(kin: Kinematics) -> Any:
    """Return -∂R/∂v for Rayleigh's R = ½ Σ d v² + ½ Σ c (dl/dt)²."""
    dissipation: Any = ca.SX(0)
    for joint in kin.model.joints:
        for damping, rate in zip(joint.damping, kin.velocities(joint), strict=True):
            dissipation += 0.5 * float(damping) * rate * rate
    for spring, gap in _gaps(kin):
        if spring.damping:
            length = ca.sqrt(dot3(gap, gap))
            rate = ca.jtimes(length, kin.q, kin.qdot)
            dissipation += 0.5 * spring.damping * rate * rate
    return -ca.gradient(dissipation, kin.v)


def _gaps(kin: Kinematics) -> list[tuple[Any, list[Any]]]:
    out = []
    for spring in kin.model.springs:
        a = kin.to_world(spring.body_a, [float(x) for x in spring.point_a])
        b = kin.to_world(spring.body_b, [float(x) for x in spring.point_b])
        out.append((spring, [y - x for x, y in zip(a, b, strict=True)]))
    return out
