"""Constraint sets that say a thing twice, or two things that cannot both be."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final
from weakref import WeakKeyDictionary

import numpy as np

from mbkit._check import Array
from mbkit.engines.base import Dynamics
from mbkit.errors import InputError
from mbkit.lagrangian.constraints import Manifold, least_change, manifold_of
from mbkit.model import Model

__all__ = ["require_independent"]

#: Configurations looked at, and starts from which each is sought.
_POSES: Final = 3
_STARTS: Final = 12
#: Of a row's size at the start: what is left of a row that follows from the others.
_DEPENDENT: Final = 1e-7
#: Of it, what is left of a slope where a square is nearly zero.
_FLAT: Final = 1e-4
#: A slope that is rounding alone.
_ROUNDED: Final = 1e-14
_MOST: Final = 100
#: Characters of a constraint that is named: of a loop in space it has thousands.
_TOLD: Final = 100

_JUDGED: Final[WeakKeyDictionary[object, set[tuple[float, ...]]]] = WeakKeyDictionary()


def require_independent(dyn: Dynamics) -> None:
    """Refuse a set of constraints that is redundant everywhere, or that nothing satisfies.

    By the rank of J at random consistent configurations, with each row that is not
    needed found by QR with column pivoting of Jᵀ; by least squares where no such
    configuration is found. A set that is dependent in single poses only is not refused.

    Raises
    ------
    InputError
        With the rows by number and as they were written.
    """
    model = dyn.model
    values = tuple(float(x or 0.0) for x in model.parameters.values()) if dyn.samples is None else ()
    # Judged once for each set of values.
    known = _JUDGED.setdefault(model.system, set())  # type: ignore[attr-defined]  # of a written model
    if values in known:
        return
    if dyn.samples is not None:
        dyn = dyn.of_samples([0])
        dyn = dyn.at(**dict(zip(model.parameters, dyn.parameter_values[0].tolist(), strict=True)))  # type: ignore[attr-defined]
    _judge(manifold_of(dyn), [str(c) for c in model.system.constraints])  # type: ignore[attr-defined]
    known.add(values)


def _judge(manifold: Manifold, written: list[str]) -> None:
    model = manifold.dyn.model
    if len(written) > model.nv:
        raise InputError(
            f"constraints: {len(written)} of them for {model.nv} coordinates; at most {model.nv} can be independent"
        )
    rng = np.random.default_rng(0)
    found, best, rows = [], (np.inf, np.zeros(len(written))), np.zeros(len(written))
    for _ in range(_STARTS):
        start = rng.choice([1.0, 3.0]) * Model.random_state(model, rng)[0]
        sizes = np.linalg.norm(manifold.jacobian(start), axis=1)
        rows = np.maximum(rows, sizes)
        q, f = _nearest(manifold, start, np.where(sizes > _ROUNDED, sizes, 1.0))
        if np.linalg.norm(f) < 1e-10:
            found.append(q)
        elif np.linalg.norm(f) < best[0]:
            best = float(np.linalg.norm(f)), f
        if len(found) == _POSES:
            break
    if not found:
        against = np.flatnonzero(np.abs(best[1]) > 1e-6 * np.abs(best[1]).max())
        told = "contradict each other" if len(against) > 1 else "cannot hold"
        raise InputError(
            f"constraints: no configuration satisfies them all; {_named(against, written)} {told}: "
            f"the least that is left of them is {best[0]:.3g}"
        )
    scale = np.where(rows > _ROUNDED, rows, 1.0)
    slopes = [manifold.jacobian(q) / scale[:, None] for q in found]
    flat = np.flatnonzero((np.max([np.linalg.norm(J, axis=1) for J in slopes], axis=0) < _FLAT) & (rows > _ROUNDED))
    if len(flat):
        raise InputError(
            f"constraints: {_named(flat, written)} has no slope where it holds, so that no force can hold it; "
            "write it without the square, as f = 0 instead of f**2 = 0"
        )
    ranks = [_dependent(J) for J in slopes]
    if all(len(needless) for needless, _ in ranks):
        needless, others = min(ranks, key=lambda pair: len(pair[0]))
        why = f"follows from {_named(others, written)}" if len(others) else "holds by itself"
        raise InputError(
            f"constraints: the set is redundant; {_named(needless, written)} {why}; leave it out, as its multiplier "
            "is not determined"
        )


def _nearest(manifold: Manifold, q: Array, scale: Array) -> tuple[Array, Array]:
    """Return where damped Gauss-Newton ends, and the scaled f there."""
    f = manifold.value(q) / scale
    for _ in range(_MOST):
        J = manifold.jacobian(q) / scale[:, None]
        step = least_change(np.eye(len(q)), J, -f)
        length = 1.0
        while length > 1e-9:
            tried = manifold.value(q + length * step) / scale
            if np.linalg.norm(tried) < (1 - 1e-4 * length) * np.linalg.norm(f):
                break
            length *= 0.5
        else:
            break
        q, f = q + length * step, tried
        if np.linalg.norm(f) < 1e-13:
            break
    return q, f


def _dependent(J: Array) -> tuple[Array, Array]:
    """Return the rows that the others imply, and those others that are needed for it."""
    from scipy.linalg import qr

    _, R, order = qr(J.T, mode="economic", pivoting=True)
    rank = int(np.count_nonzero(np.abs(np.diag(R)) > _DEPENDENT))
    kept, needless = order[:rank], np.sort(order[rank:])
    if not len(needless) or not rank:
        return needless, np.empty(0, dtype=int)
    # As a combination of those that were kept.
    weights = np.linalg.lstsq(J[kept].T, J[needless].T, rcond=None)[0]
    return needless, np.sort(kept[np.abs(weights).max(axis=1) > 1e-6])


def _named(which: Iterable[int], written: list[str]) -> str:
    told = {k: written[k] if len(written[k]) <= _TOLD else f"{written[k][:_TOLD]} ..." for k in which}
    return ", ".join(f"constraints[{k}] ({text})" for k, text in told.items())
