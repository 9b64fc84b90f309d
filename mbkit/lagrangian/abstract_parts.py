"""Bodies and joints for a model of which nothing but its coordinates is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mbkit.model.parts import Body, Joint

__all__ = ["abstract_parts"]


def abstract_parts(names: Sequence[str]) -> tuple[tuple[Body, ...], tuple[Joint, ...]]:
    """Return what gives a model coordinates of these names, and nothing else."""
    # One coordinate a joint, each on the one before: the pattern of a full mass matrix.
    joints = tuple(_coordinate(name, before) for name, before in zip(names, ["world", *names], strict=False))
    return tuple(_massless(name) for name in names), joints


def _coordinate(name: str, before: str) -> Joint:
    zero, endless = np.zeros(1), np.full(1, np.inf)
    return Joint(
        name=name,
        kind="prismatic",
        parent=before,
        child=name,
        rotation=np.eye(3),
        translation=np.zeros(3),
        axes=np.array([[1.0, 0.0, 0.0]]),
        pitch=0.0,
        lower=-endless,
        upper=endless,
        velocity_limit=endless,
        effort_limit=endless,
        armature=zero,
        damping=zero,
        friction=zero,
        stiffness=zero,
        rest=zero,
    )


def _massless(name: str) -> Body:
    return Body(name=name, mass=0.0, com=np.zeros(3), inertia=np.zeros((3, 3)))
