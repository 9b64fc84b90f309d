"""The configuration manifold: exponential, logarithm, random states."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Final

import numpy as np

from mbkit import spatial
from mbkit._check import EPS, Array
from mbkit._reproducible import DEPENDENT, under_rows
from mbkit.errors import InputError
from mbkit.model.description import Description

#: Largest error of a caller's quaternion, in its norm or the square of that: rounding is accepted, a rotation that
#: engines would read differently is not.
NEAR_UNIT: Final = 1e-9
#: Part of a Gauss-Newton step below which a residual that does not fall is at its least, and steps of a search.
_LEAST_STEP_PART: Final = 1e-6
_MAX_SEARCH_STEPS: Final = 60


def check_quaternions(model: Description, q: Array, name: str = "q") -> None:
    """Raise `InputError` where a quaternion in q is not of unit length."""
    for start, joint in model.quaternions:
        if q.ndim == 1:
            x = q[start : start + 4]
            if abs(x.dot(x) - 1.0) <= NEAR_UNIT:
                continue
        norms = np.linalg.norm(q[..., start : start + 4], axis=-1)
        off = np.abs(norms - 1)
        if np.any(off > NEAR_UNIT):
            norm = float(np.ravel(norms)[np.argmax(off)])
            raise InputError(
                f"{name}: the quaternion of joint {joint!r} ({name}[{start}:{start + 4}], order x, y, z, w) "
                f"has norm {norm:.12g}; expected 1: divide it by its norm"
            )


def neutral(model: Description) -> Array:
    """Return zeros with identity quaternions, shape (nq,)."""
    q = np.zeros(model.nq)
    for start, _ in model.quaternions:
        q[start + 3] = 1.0
    return q


def limits_box(model: Description) -> tuple[Array, Array]:
    """Return lower and upper ends of the box that `random_state` draws from.

    The limits of a joint that mimics another bound the one that it follows, as long as that leaves a range.
    """
    lower, upper = np.array(model.lower), np.array(model.upper)
    for joint in model.layout.joints:
        if joint.mimic and joint.mimic.ratio:
            k = model.layout.q[joint.mimic.joint].start
            ends = sorted((x - joint.mimic.offset) / joint.mimic.ratio for x in (joint.lower[0], joint.upper[0]))
            low, high = max(lower[k], ends[0]), min(upper[k], ends[1])
            if low < high:
                lower[k], upper[k] = low, high
    for joint in model.independent_joints:
        for indices, reach in ((joint.type.angular, np.pi), (joint.type.lengths, 1.0)):
            for k in (model.layout.q[joint.name].start + i for i in indices):
                lower[k], upper[k] = _clipped(lower[k], upper[k], reach)
    return lower, upper


def _clipped(lower: float, upper: float, reach: float) -> tuple[float, float]:
    # A range beyond the clip keeps its near end, so that it is not empty.
    if lower > reach:
        return lower, min(upper, lower + 2 * reach)
    if upper < -reach:
        return max(lower, upper - 2 * reach), upper
    return max(lower, -reach), min(upper, reach)


def random_state(model: Description, rng: np.random.Generator, size: int | None = None) -> tuple[Array, Array]:
    """Draw q uniformly within the limits and v from the standard normal."""
    n = 1 if size is None else size
    lower, upper = limits_box(model)
    finite = np.isfinite(lower)
    q = np.tile(neutral(model), (n, 1))
    q[:, finite] = rng.uniform(lower[finite], upper[finite], size=(n, int(finite.sum())))
    for start, _ in model.quaternions:
        # A normal four-vector points uniformly over the sphere: a uniform rotation.
        q[:, start : start + 4] = spatial.normalized(rng.standard_normal((n, 4)))
    v = rng.standard_normal((n, model.nv))
    return (q[0], v[0]) if size is None else (q, v)


def integrate(model: Description, q: Array, dq: Array) -> Array:
    """Return q ⊕ dq."""
    if not model.quaternions:
        return np.asarray(q + dq)
    lead = np.broadcast_shapes(q.shape[:-1], dq.shape[:-1])
    q, dq = np.broadcast_to(q, (*lead, q.shape[-1])), np.broadcast_to(dq, (*lead, dq.shape[-1]))
    out = np.empty(q.shape)
    for joint in model.independent_joints:
        a, b = model.layout.q[joint.name], model.layout.v[joint.name]
        out[..., a] = joint.type.integrate(q[..., a], dq[..., b])
    return out


def difference(model: Description, q0: Array, q1: Array) -> Array:
    """Return the dq with integrate(q0, dq) = q1."""
    if not model.quaternions:
        return np.asarray(q1 - q0)
    q0, q1 = np.broadcast_arrays(q0, q1)
    out = np.empty((*q0.shape[:-1], model.nv))
    for joint in model.independent_joints:
        a, b = model.layout.q[joint.name], model.layout.v[joint.name]
        out[..., b] = joint.type.difference(q0[..., a], q1[..., a])
    return out


def tangent_maps(model: Description, q: Array) -> tuple[Array, Array]:
    """Return D of q̇ = D(q) v and its left inverse at unit quaternions, (..., nq, nv) and (..., nv, nq)."""
    lead = q.shape[:-1]
    if not model.quaternions:
        unit = np.broadcast_to(np.eye(model.nv), (*lead, model.nv, model.nv))
        return unit, unit
    D, inverse = np.zeros((*lead, model.nq, model.nv)), np.zeros((*lead, model.nv, model.nq))
    for joint in model.independent_joints:
        a, b, start = model.layout.q[joint.name], model.layout.v[joint.name], joint.type.quaternion
        if start is None:
            D[..., a, b] = inverse[..., b, a] = np.eye(joint.type.nv)
            continue
        x = q[a].tolist() if q.ndim == 1 else list(q[..., a].T)
        for k, e in enumerate(np.eye(joint.type.nv).tolist(), b.start):
            for i, rate in enumerate(joint.type.qdot(x, e), a.start):
                D[..., i, k] = rate
        inverse[..., b, a] = np.swapaxes(D[..., a, b], -1, -2)
        # Columns of a quaternion's rate have the length ½.
        inverse[..., b, a.start + start : a.stop] *= 4.0
    return D, inverse


def unit_quaternions(model: Description, q: Array) -> tuple[Array, Array]:
    """Return q, (..., nq), with unit quaternions, and the lengths that they had, (..., number of quaternions)."""
    lengths = np.empty((*q.shape[:-1], len(model.quaternions)))
    if not model.quaternions:
        return q, lengths
    q = q.copy()
    for i, (start, _) in enumerate(model.quaternions):
        x = q[..., start : start + 4]
        # Without an axis NumPy rounds otherwise.
        lengths[..., i] = np.linalg.norm(x) if q.ndim == 1 else np.linalg.norm(x, axis=-1)
        x /= lengths[..., i, None]
    return q, lengths


#: Size of common numbers of a state, rad, m, rad/s and m/s.
_COMMON_SIZE: Final = 10.0


def magnitude(*states: Array) -> float:
    """Return by what a tolerance relative to a state's largest number is too loose for the others.

    In whole decades, as Taylor series of each order are compiled once; below ten it is the slack that common motions
    have.

    Examples
    --------
    >>> magnitude(np.array([0.1, -3.0])), magnitude(np.array([0.1, 1.0]), np.array([-2e4]))
    (1.0, 100000.0)
    """
    largest = max(float(np.abs(y).max(initial=0.0)) for y in states)
    return float(10.0 ** np.ceil(np.log10(largest))) if largest > _COMMON_SIZE else 1.0


def least_change(W: Array, J: Array, change: Array, held: Collection[int] = (), rounding: float = DEPENDENT) -> Array:
    """Return the x with J x = change that is the least in xᵀ W x; the nearest to it where J has dependent rows.

    The entries `held` are zero.
    """
    free, out = [k for k in range(len(W)) if k not in held], np.zeros(len(W))
    out[free] = under_rows(W[np.ix_(free, free)], J[:, free], np.zeros(len(free)), change, rounding)[0]
    return out


def closest_configuration(
    model: Description, q: Array, W: Array, rows: Callable[[Array], tuple[Array, Array]], held: Collection[int] = ()
) -> tuple[Array, float, Array]:
    """Return where damped Gauss-Newton ends from q, with the size of what is left of rows, and the rows there.

    `rows` gives f and J. A change of q is the least one in the metric of W, and the velocities `held` move nothing. It
    is halved until the size falls, which is in units of what the rows at q change by with the coordinates. The search
    ends at rounding, after `_MAX_SEARCH_STEPS` steps, and where no step makes the size smaller.
    """
    f, J = rows(q)
    sizes = np.abs(J).sum(axis=1)
    scale = np.where(sizes > DEPENDENT * sizes.max(initial=0.0), sizes, 1.0)
    size = float(np.linalg.norm(f / scale))
    for _ in range(_MAX_SEARCH_STEPS):
        if size <= 4 * EPS * (1.0 + float(np.abs(q).max(initial=0.0))):
            break
        whole, length = least_change(W, J, -f, held), 1.0
        while length > _LEAST_STEP_PART:
            beyond = integrate(model, q, length * whole)
            there = rows(beyond)
            size_beyond = float(np.linalg.norm(there[0] / scale))
            if size_beyond < size:
                break
            length *= 0.5
        else:
            break
        q, size, (f, J) = beyond, size_beyond, there
    return q, size, f
