"""States at which engines are compared: random ones, and the hard ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mbkit._check import Array
from mbkit.model import Model
from mbkit.model.manifold import limits_box

__all__ = ["States", "inside", "states"]

# An angle this far from gimbal lock loses four digits in anything that divides
# by its cosine; none of the terms should.
_NEAR: float = 1e-4


@dataclass(frozen=True)
class States:
    """States with accelerations and torques, and the kind of each.

    Attributes
    ----------
    q, v, a, tau : (N, n) arrays
    kinds : tuple of str
    """

    q: Array
    v: Array
    a: Array
    tau: Array
    kinds: tuple[str, ...]


def states(model: Model, samples: int, seed: int) -> States:
    """Return `samples` random states, and beside them neutral, at-limit and near-singular ones.

    Near-singular states are at the closed and straight poses where axes align:
    every angle at a multiple of a right angle, pushed off by 1e-4, which puts
    spherical-ZYX joints next to gimbal lock and arms next to stretched. Of a model with
    constraints they are no states, and left out.
    """
    rng = np.random.default_rng(seed)
    q, v = model.random_state(rng, samples)
    parts, kinds = [q], ["random"] * samples
    few = max(2, samples // 16)
    special = (
        []
        if model.constrained
        else [
            ("neutral", np.tile(model.neutral(), (2, 1))),
            ("at limits", _at_limits(model, rng, few)),
            ("near singular", _near_singular(model, rng, few)),
        ]
    )
    for kind, made in special:
        parts.append(made)
        kinds += [kind] * len(made)
    q = np.concatenate(parts)
    v = np.concatenate([v, rng.standard_normal((len(q) - samples, model.nv))])
    a, tau = rng.standard_normal((2, len(q), model.nv))
    return States(q, v, a, tau, tuple(kinds))


def inside(model: Model, rng: np.random.Generator, share: float = 0.5) -> tuple[Array, Array]:
    """Return a random state in the middle `share` of the limits."""
    q, v = model.random_state(rng)
    if model.constrained:
        return q, v
    lower, upper = limits_box(model)
    bounded = np.isfinite(lower)
    middle = 0.5 * (lower[bounded] + upper[bounded])
    q[bounded] = middle + share * (q[bounded] - middle)
    return q, v


def _at_limits(model: Model, rng: np.random.Generator, n: int) -> Array:
    q, _ = model.random_state(rng, n)
    lower, upper = limits_box(model)
    for i in range(model.nq):
        if np.isfinite(lower[i]):
            q[:, i] = np.where(rng.random(n) < 0.5, lower[i], upper[i])
    return q


def _near_singular(model: Model, rng: np.random.Generator, n: int) -> Array:
    q, _ = model.random_state(rng, n)
    for joint in model.independent_joints:
        start = model.layout.q[joint.name].start
        for i in joint.type.angular:
            turns = rng.integers(-1, 3, n)
            if joint.kind == "spherical_zyx" and i == 1:
                turns = 2 * rng.integers(0, 2, n) - 1
            q[:, start + i] = turns * np.pi / 2 + rng.choice([-_NEAR, _NEAR], n)
    return q
