"""Whether a body can exist, and whether every joint moves some inertia."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from mbkit._check import Array
from mbkit.model.parts import Body, Joint, Loop
from mbkit.spatial import skew

if TYPE_CHECKING:
    from mbkit.model.model import Model

__all__ = ["body_fault", "body_faults", "idle_joints", "sample_mass_matrix", "static_bodies", "suspects"]

# Descriptions carry rounded decimals; a thin plate written with six digits may
# miss A + B >= C by its last digit.
_TRIANGLE = 1e-6


def body_fault(body: Body, *, point_masses: bool) -> str | None:
    """Return why no matter can have this mass and inertia, or None.

    A body of zero mass and zero inertia is no fault: it is a frame, and
    `idle_joints` finds the joints that would then move nothing.

    Parameters
    ----------
    body : Body
    point_masses : bool
        Whether a positive mass with zero inertia is meant that way.
    """
    eigenvalues = np.asarray(np.linalg.eigvalsh(body.inertia), dtype=np.float64)
    largest = float(np.max(np.abs(eigenvalues)))
    if body.mass < 0:
        return f"mass {body.mass:g} is negative"
    if body.mass == 0:
        return f"no mass but inertia up to {largest:.3g} kg m²" if largest else None
    if largest == 0:
        return None if point_masses else "mass without inertia: give the inertia, however small"
    if eigenvalues[0] < -1e-12 * largest:
        return f"inertia is not positive: principal moments {_told(eigenvalues)} kg m²"
    if eigenvalues[0] <= 1e-12 * largest and not point_masses:
        return f"inertia is not positive: principal moments {_told(eigenvalues)} kg m²"
    if eigenvalues[0] + eigenvalues[1] < eigenvalues[2] * (1 - _TRIANGLE):
        return f"inertia violates A + B >= C: principal moments {_told(eigenvalues)} kg m²"
    return None


def static_bodies(joints: Iterable[Joint]) -> set[str]:
    """Return the bodies that are fixed to the world, whose inertia cannot act."""
    below: dict[str, list[str]] = {}
    for joint in joints:
        if joint.kind == "fixed":
            below.setdefault(joint.parent, []).append(joint.child)
    found: set[str] = set()
    waiting = ["world"]
    while waiting:
        new = [child for child in below.get(waiting.pop(), ()) if child not in found]
        found.update(new)
        waiting += new
    return found


def _told(values: Array) -> str:
    return ", ".join(f"{x:.4g}" for x in values)


def body_faults(bodies: Iterable[Body], *, point_masses: bool) -> tuple[tuple[str, str], ...]:
    """Return the bodies that cannot exist, each with the reason.

    A body that waits for a parameter's value is not judged yet.
    """
    return tuple(
        (b.name, why)
        for b in bodies
        if np.isfinite([b.mass, *b.inertia.flat]).all() and (why := body_fault(b, point_masses=point_masses))
    )


def suspects(model: Model, *, point_masses: bool) -> tuple[tuple[str, str], ...]:
    """Return the bodies that cannot exist or that leave a joint idle, each with the reason.

    What waits for a parameter's value is not judged yet.
    """
    found = dict(body_faults(model.bodies, point_masses=point_masses))
    # A negative mass makes M indefinite, and joints look idle that are not.
    if all(x is not None for x in model.parameters.values()) and not any(b.mass < 0 for b in model.bodies):
        idle, alone = idle_joints(model)
        for name in idle:
            others = ", ".join(repr(n) for n in idle if n != name)
            why = f"no mass moves with joint {name!r}" if alone else f"joints {name!r} and {others} move the same mass"
            if not alone and not others:
                why = f"two velocities of joint {name!r} move the same mass"
            found.setdefault(model.joint(name).child, f"{why}, so M is singular: give mass, inertia or armature")
    return tuple(found.items())


def idle_joints(model: Model) -> tuple[list[str], bool]:
    """Return the joints whose motion costs no kinetic energy, so that M is singular, and whether each alone costs none.

    M is formed at one random state from the definition, Σ Jᵀ I J, and scaled to
    a unit diagonal; a null vector names its joints. Motions that loops do not allow count as if they moved mass.
    """
    if not model.nv:
        return [], True
    M, jacobians, turned = _sample(model)
    rows = [_held(loop, jacobians, turned) @ model.layout.G for loop in model.loops]
    if rows and (size := float(np.trace(M))):
        held = np.concatenate(rows)
        # M need have an inverse only on what loops allow.
        M = M + size / len(M) * held.T @ held
    diagonal, alone = np.diag(M), True
    # What is left of a mass on its own axis is the square of a rounded length.
    zero = diagonal <= 1e-28 * float(diagonal.max())
    if not zero.any():
        # One root after the other: the product of two would leave the range of doubles.
        root = np.sqrt(diagonal)
        scaled = M / root[:, None] / root
        values, vectors = np.linalg.eigh(scaled)
        if values[0] > 4 * model.nv * np.finfo(float).eps:
            return [], True
        alone = False
        zero = np.abs(vectors[:, 0]) > 0.3 * np.abs(vectors[:, 0]).max()
    return [j.name for j in model.independent_joints if zero[model.layout.v[j.name]].any()], alone


def sample_mass_matrix(model: Model, q: Array | None = None) -> Array:
    """Return M at a pose, or at one fixed random state, by its definition; slow, for checks and for loading."""
    return _sample(model, q)[0]


def _sample(model: Model, q: Array | None = None) -> tuple[Array, dict[str, Array], dict[str, Array]]:
    """Return M there, and each body's Jacobian in its own axes and rotation to world axes."""
    if q is None:
        q, _ = model.random_state(np.random.default_rng(0))
    q_full = model.layout.expand_q(q)
    n = model.layout.sizes[3]
    jacobians = {"world": np.zeros((6, n))}
    turned = {"world": np.eye(3)}
    M = np.zeros((n, n))
    bodies = {b.name: b for b in model.bodies}
    for joint in model.tree:
        part = model.layout.full_q[joint.name], model.layout.full_v[joint.name]
        R_JC, p_JC = (np.array(x, dtype=float) for x in joint.type.placement(np, joint, list(q_full[part[0]])))
        R, p = joint.rotation @ R_JC, joint.translation + joint.rotation @ p_JC
        parent = jacobians[joint.parent]
        J = np.vstack([R.T @ (parent[:3] - skew(p) @ parent[3:]), R.T @ parent[3:]])
        for k in range(joint.type.nv):
            unit = [float(i == k) for i in range(joint.type.nv)]
            linear, angular = joint.type.twist(np, joint, list(q_full[part[0]]), unit)
            J[:, part[1].start + k] += np.array([*linear, *angular], dtype=float)
        jacobians[joint.child], turned[joint.child] = J, turned[joint.parent] @ R
        body = bodies[joint.child]
        at_com = J[:3] - skew(body.com) @ J[3:]
        M += body.mass * at_com.T @ at_com + J[3:].T @ body.inertia @ J[3:]
        M[part[1], part[1]] += np.diag(joint.armature)
    for coupling in model.couplings:
        row = model.layout.coupling_row(coupling)
        M += coupling.armature * np.outer(row, row)
    return np.asarray(model.layout.G.T @ M @ model.layout.G), jacobians, turned


def _held(loop: Loop, jacobians: dict[str, Array], turned: dict[str, Array]) -> Array:
    """Return the rows of what a loop holds at rest, in world axes."""
    ends = []
    for body, point in ((loop.body_a, loop.translation_a), (loop.body_b, loop.translation_b)):
        J = jacobians[body]
        moved = [turned[body] @ (J[:3] - skew(np.asarray(point)) @ J[3:]), turned[body] @ J[3:]]
        ends.append(np.concatenate(moved if loop.kind == "frame" else moved[:1]))
    return np.asarray(ends[0] - ends[1])
