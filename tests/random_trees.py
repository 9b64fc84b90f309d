"""Random trees of every joint kind, the same for the same seed."""

from __future__ import annotations

import numpy as np

import mbkit as mb
from mbkit.model import Model, kind_of
from mbkit.spatial import matrix_from_quaternion, normalized

ALL = (
    "revolute",
    "continuous",
    "prismatic",
    "helical",
    "universal",
    "spherical_zyx",
    "ball",
    "planar",
    "free",
    "fixed",
)
#: What MuJoCo can hold.
IN_MUJOCO = tuple(k for k in ALL if k != "helical")
#: What Pinocchio has no known defect for.
SOUND = tuple(k for k in ALL if k not in ("universal", "spherical_zyx"))


def rotation(rng: np.random.Generator) -> np.ndarray:
    return matrix_from_quaternion(normalized(rng.standard_normal(4)))


def random_tree(
    seed: int,
    n: int = 10,
    kinds: tuple[str, ...] = ALL,
    *,
    springs: bool = True,
    damping: bool = True,
    armature: bool = True,
    mimic: bool = False,
    gravity: bool = True,
    nearest: int | None = None,
) -> Model:
    """Return a tree of n joints: the first ones of each kind in turn, the rest at random.

    Parents are drawn from all bodies, which makes a shallow tree, or from the
    `nearest` last ones, which makes one as deep as it is large.
    """
    rng = np.random.default_rng(seed)
    b = mb.ModelBuilder(f"tree{seed}", gravity=5 * rng.standard_normal(3) if gravity else np.zeros(3))
    bodies, leaders = ["world"], []
    order = list(rng.permutation(kinds))
    for i in range(n):
        kind = str(order[i]) if i < len(order) else str(rng.choice(kinds))
        R, d = rotation(rng), rng.uniform(0.1, 1, 3)
        inertia = R @ np.diag([d[0] + d[1], d[1] + d[2], d[2] + d[0]]) @ R.T
        b.add_body(f"b{i}", mass=rng.uniform(0.5, 2), com=0.3 * rng.standard_normal(3), inertia=inertia)
        joint: dict[str, object] = {}
        one = kind in ("revolute", "continuous", "prismatic", "helical")
        if one:
            joint["axis"] = np.eye(3)[rng.integers(3)] if rng.random() < 0.4 else rng.standard_normal(3)
            joint["armature"] = rng.uniform(0, 1) if armature else 0.0
        if kind == "universal":
            joint["axis"], joint["axis2"] = rng.standard_normal((2, 3))
        if kind == "helical":
            joint["pitch"] = 0.2
        if damping and kind != "fixed":
            joint["damping"] = rng.uniform(0, 1)
        if springs and kind_of(kind).coordinate_velocities and kind != "fixed":
            joint["stiffness"], joint["rest"] = rng.uniform(0, 5), 0.3
        if mimic and one and leaders and rng.random() < 0.6:
            joint["mimic"] = (leaders[-1], float(rng.uniform(-2, 2)), 0.3)
        elif one:
            leaders.append(f"j{i}")
        parent = "world" if i == 0 else str(rng.choice(bodies if nearest is None else bodies[-nearest:]))
        place = {"rotation": rotation(rng), "translation": 0.5 * rng.standard_normal(3)}
        b.add_joint(f"j{i}", kind, parent=parent, child=f"b{i}", **place, **joint)
        bodies.append(f"b{i}")
    b.add_frame("tip", body=bodies[-1], translation=(0.1, 0.2, 0.3), rotation=rotation(rng))
    if (springs or damping) and n > 2:
        c = 3.0 if damping else 0.0
        k = 30.0 if springs else 0.0
        b.add_spring(
            "to_ground", body_a="world", body_b=bodies[-1], point_a=(1, 2, 3), stiffness=k, rest_length=0.5, damping=c
        )
        if springs:
            b.add_spring("between", body_a="b0", body_b="b1", point_a=(0.1, 2, 3), point_b=(0.3, 0, 0), stiffness=k)
    return b.build()


def coupled(tree: Model, seed: int, n: int = 2) -> Model:
    """Return the tree with n couplers, each of a random joint of one velocity and one to three leaders of it."""
    rng = np.random.default_rng([seed, 98])
    free = [j.name for j in tree.joints if j.type.nv == 1 and not j.mimic]
    b = mb.ModelBuilder.of(tree)
    for k in range(n):
        joint, *leaders = map(str, rng.permutation(free)[: rng.integers(2, 5)])
        ratio = rng.choice([-1.0, 1.0], len(leaders)) * rng.uniform(0.3, 2, len(leaders))
        b.add_coupler(f"coupler{k}", joint, leaders, ratio=ratio, offset=rng.uniform(-1, 1))
    return b.build()


def states(model: Model, n: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Return q, v, a, tau, each (n, ·)."""
    rng = np.random.default_rng([seed, 99])
    q, v = model.random_state(rng, n)
    a, tau = rng.standard_normal((2, n, model.nv))
    return q, v, a, tau


def off(x: np.ndarray, y: np.ndarray) -> float:
    """Return the normwise relative difference, of a batch that of its worst sample."""
    x, y = np.asarray(x), np.asarray(y)
    if y.ndim > 1:
        return max((off(a, b) for a, b in zip(x, y, strict=True)), default=0.0) if y.shape[0] else 0.0
    return float(np.linalg.norm(x - y) / max(np.linalg.norm(y), 1.0))
