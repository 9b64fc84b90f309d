"""Whether a body can exist, and whether every joint moves some inertia."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from mbkit._check import Array
from mbkit.model.parts import Body
from mbkit.spatial import skew

if TYPE_CHECKING:
    from mbkit.model.model import Model

__all__ = ["body_fault", "body_faults", "idle_joints", "sample_mass_matrix", "suspects"]

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
        for name in idle_joints(model):
            found.setdefault(
                model.joint(name).child,
                f"no mass moves with joint {name!r}, so M is singular: give mass, inertia or armature",
            )
    return tuple(found.items())


def idle_joints(model: Model) -> list[str]:
    """Return the joints whose motion costs no kinetic energy, so that M is singular.

    M is formed at one random state from the definition, Σ Jᵀ I J, and scaled to
    a unit diagonal; a null vector names its joints.
    """
    if not model.nv:
        return []
    M = sample_mass_matrix(model)
    diagonal = np.diag(M)
    # What is left of a mass on its own axis is the square of a rounded length.
    zero = diagonal <= 1e-28 * float(diagonal.max())
    if not zero.any():
        # One root after the other: the product of two would leave the range of doubles.
        root = np.sqrt(diagonal)
        scaled = M / root[:, None] / root
        values, vectors = np.linalg.eigh(scaled)
        if values[0] > 4 * model.nv * np.finfo(float).eps:
            return []
        zero = np.abs(vectors[:, 0]) > 0.3 * np.abs(vectors[:, 0]).max()
    return [j.name for j in model.independent_joints if zero[model.layout.v[j.name]].any()]


def sample_mass_matrix(model: Model, q: Array | None = None) -> Array:
    """Return M at a pose, or at one fixed random state, by its definition; slow, for checks and for loading."""
    if q is None:
        q, _ = model.random_state(np.random.default_rng(0))
    q_full = model.layout.expand_q(q)
    n = model.layout.sizes[3]
    jacobians = {"world": np.zeros((6, n))}
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
        jacobians[joint.child] = J
        body = bodies[joint.child]
        at_com = J[:3] - skew(body.com) @ J[3:]
        M += body.mass * at_com.T @ at_com + J[3:].T @ body.inertia @ J[3:]
        M[part[1], part[1]] += np.diag(joint.armature)
    for coupling in model.couplings:
        row = model.layout.coupling_row(coupling)
        M += coupling.armature * np.outer(row, row)
    return np.asarray(model.layout.G.T @ M @ model.layout.G)
