"""A free joint's velocity in the axes that the integrators use.

mbkit's is linear then angular, both in body axes. Inside the integrators the
linear part is in the axes of the joint's fixed frame J (world axes for a
floating base), as in MuJoCo: ṗ is then the velocity itself, positions add up,
and a body that spins without forces keeps its linear velocity to the bit.

With R = R_JB and body-axes velocity (v, w)::

    v_J = R v                 a_J = R (a + w × v)

Quaternion, linear and angular parts are sequences of components, as in
`mbkit.model.rotation`.
"""

from __future__ import annotations

from typing import Any

from mbkit.model.rotation import Components, cross, rotate, rotate_back

__all__ = ["acceleration_in_parent", "velocity_in_body", "velocity_in_parent"]


def velocity_in_parent(quaternion: Components, linear: Components) -> list[Any]:
    """Return R v."""
    return rotate(quaternion, linear)


def velocity_in_body(quaternion: Components, linear: Components) -> list[Any]:
    """Return Rᵀ v_J."""
    return rotate_back(quaternion, linear)


def acceleration_in_parent(
    quaternion: Components, linear: Components, angular: Components, rate: Components
) -> list[Any]:
    """Return R (a + w × v), from the body-axes velocity and its rate a."""
    turn = cross(angular, linear)
    return rotate(quaternion, [rate[i] + turn[i] for i in range(3)])
