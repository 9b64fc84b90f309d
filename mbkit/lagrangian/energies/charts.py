"""Ball and free joints on paper: z-y-x angles in place of a quaternion, beside velocities in the child's axes.

R = Rz(ψ) Ry(θ) Rx(φ), yaw, pitch and roll. The entries of the quaternion are products of cosines and sines of half
angles, so that a joint type's own formulas hold. Its angles have the rates (Greenwood 2003, Advanced Dynamics, ch. 3)::

    ψ̇ = (ω₂ sin φ + ω₃ cos φ)/cos θ        θ̇ = ω₂ cos φ - ω₃ sin φ        φ̇ = ω₁ + ψ̇ sin θ

of ω in the child's axes. The chart ends at θ = ±π/2, where yaw and roll turn about one axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import sympy as sp

from mbkit.lagrangian.energies.symbols import free_name, velocity_of
from mbkit.model import Joint, Model
from mbkit.model.joint_types import cross3

_ANGLES: Final = ("psi", "theta", "phi")
_TURNS: Final = ("omega1", "omega2", "omega3")


def chart_names(model: Model) -> list[str]:
    """Return names of coordinates on paper: the model's, and a chart's in place of those of ball and free joints."""
    out: list[str] = []
    names = iter(model.coordinate_names)
    for joint in model.independent_joints:
        own, k = [next(names) for _ in range(joint.type.nq)], joint.type.quaternion
        if k is not None:
            used_names = {*out, *model.coordinate_names, *model.parameters}
            own = [free_name(x, used_names) for x in _indexed(model, joint, (*joint.type.suffixes[:k], *_ANGLES))]
        out += own
    return out


def chart_velocities(model: Model, coordinates: Sequence[sp.Symbol]) -> list[sp.Symbol]:
    """Return the velocities beside these coordinates: their rates; of ball and free joints v and ω by components."""
    used, out = {s.name for s in coordinates} | {*model.parameters}, list[sp.Symbol]()
    for joint in model.independent_joints:
        k, own = joint.type.quaternion, coordinates[model.layout.v[joint.name]]
        rates = [velocity_of(s) for s in own]
        if k is not None:
            names = _indexed(model, joint, (*(f"v{i + 1}" for i in range(k)), *_TURNS))
            rates = [sp.Symbol(free_name(x, used)) for x in names]
        used |= {s.name for s in rates}
        out += rates
    return out


def _indexed(model: Model, joint: Joint, names: Sequence[str]) -> list[str]:
    """Return names with the joint's own as an index where several joints have such: omega1 -> omega_base1."""
    if sum(j.type.quaternion is not None for j in model.independent_joints) == 1:
        return list(names)
    stems = [(x.rstrip("123"), x[len(x.rstrip("123")) :]) for x in names]
    return [f"{stem}_{joint.name}{digit}" for stem, digit in stems]


def quaternion(yaw: Any, pitch: Any, roll: Any) -> list[Any]:
    """Return the quaternion (x, y, z, w) of z-y-x angles from the cosine and sine of half of each."""
    (a, A), (b, B), (c, C) = yaw, pitch, roll
    return [a * b * C - A * B * c, a * B * c + A * b * C, A * b * c - a * B * C, a * b * c + A * B * C]


def turning(q: Sequence[Any], rate: Sequence[Any]) -> list[Any]:
    """Return ω in the child's axes of a quaternion and its rate: 2 q* ∘ q̇."""
    across = cross3(q[:3], rate[:3])
    return [2 * (q[3] * rate[i] - q[i] * rate[3] - across[i]) for i in range(3)]


def angle_rates(angles: Sequence[sp.Expr], w: Sequence[sp.Expr]) -> list[sp.Expr]:
    """Return the rates of z-y-x angles from ω in the child's axes."""
    _, theta, phi = angles
    yaw = (w[1] * sp.sin(phi) + w[2] * sp.cos(phi)) / sp.cos(theta)
    return [yaw, w[1] * sp.cos(phi) - w[2] * sp.sin(phi), w[0] + yaw * sp.sin(theta)]
