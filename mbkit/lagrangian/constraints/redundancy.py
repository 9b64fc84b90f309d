"""Whether constraints are independent at a configuration, and why they are not.

Independence belongs to a pose: a set may have full rank on one branch of a mechanism only (a row of equal four-bars).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final
from weakref import WeakKeyDictionary

import numpy as np

from mbkit._check import Array
from mbkit.engines.base import Dynamics
from mbkit.errors import InputError, NumericalError
from mbkit.lagrangian.constraints.manifold import Manifold, least_change, manifold_of
from mbkit.lagrangian.energies.energy_form import EnergyForm
from mbkit.model import Model

#: Random starts from which a consistent configuration is searched.
_STARTS: Final = 12
#: Configurations near a pose at which J is evaluated too, and how far they are away, rad or m.
_BESIDE: Final = 4
_ASIDE: Final = 0.05
#: Remainder of a row that follows from the others, relative to the row's size.
_DEPENDENT: Final = 1e-7
#: Of a row's size beside the pose: its slope where a square is nearly zero.
_FLAT: Final = 1e-4
#: A slope that is rounding alone.
_ROUNDED: Final = 1e-14
#: Residual of a consistent configuration, in terms of the rows' sizes.
_HOLDS: Final = 1e-10
_MOST: Final = 100
#: Characters of a constraint in a message: of a loop in space it has thousands.
_SHOWN: Final = 100

#: Values of the parameters with which a system was independent at some pose.
_JUDGED: Final[WeakKeyDictionary[EnergyForm, set[tuple[float, ...]]]] = WeakKeyDictionary()


def is_judged(form: EnergyForm, model: Model) -> bool:
    """Return whether the constraints were independent at some pose, with the model's values of the parameters."""
    return _values(model) in _JUDGED.get(form, ())


def require_few(form: EnergyForm) -> None:
    """Refuse more constraints than coordinates."""
    rows, n = len(form.constraints), len(form.coordinates)
    if rows > n:
        raise InputError(f"constraints: {rows} of them for {n} coordinates; at most {n} can be independent")


def _values(model: Model) -> tuple[float, ...]:
    return tuple(float(x or 0.0) for n, x in model.parameters.items() if n != model.time_parameter)


def require_independent(dyn: Dynamics, q: Array, *, everywhere: bool = False) -> None:
    """Refuse constraints whose Jacobian has dependent rows around q (InputError) or at q alone (NumericalError).

    With `everywhere` a singular pose is allowed: only a set that is redundant around q is refused.
    """
    model, manifold = dyn.model, manifold_of(dyn)
    form = manifold.equations.form
    known = _JUDGED.setdefault(form, set())
    written = [str(c) for c in form.constraints]
    require_few(form)
    rng = np.random.default_rng(0)
    beside = [q + _ASIDE * rng.standard_normal(q.shape) for _ in range(_BESIDE)]
    sizes = np.max([np.linalg.norm(manifold.jacobian(x), axis=1) for x in (q, *beside)], axis=0)
    scale = np.where(sizes > _ROUNDED, sizes, 1.0)
    J = manifold.jacobian(q) / scale[:, None]
    needless, others = _dependent(J)
    flat = bool((np.linalg.norm(J, axis=1) < _FLAT)[sizes > _ROUNDED].any())
    if not len(needless) and not flat:
        known.add(_values(model))
        return
    _explain(manifold, written, q, beside, scale, sizes)
    if everywhere or not len(needless):
        return
    why = f"follows from {_named(others, written)}" if len(others) else "has no slope"
    raise NumericalError(
        f"q: {model.name} is at a singular pose, where {_named(needless, written)} {why}: forces and accelerations are "
        "not determined there; take a pose beside it"
    )


def refuse_unreachable(dyn: Dynamics, q: Array | None = None) -> None:
    """Refuse constraints that no configuration satisfies, or that are redundant where one does (InputError).

    The search starts at q, then at random configurations.
    """
    manifold, model = manifold_of(dyn), dyn.model
    written = [str(c) for c in manifold.equations.form.constraints]
    rng = np.random.default_rng(0)
    best = (np.inf, np.zeros(len(written)))
    starts = [rng.choice([1.0, 3.0]) * Model.random_state(model, rng)[0] for _ in range(_STARTS)]
    starts[:0] = [] if q is None else [q]
    for start in starts:
        sizes = np.linalg.norm(manifold.jacobian(start), axis=1)
        end, f = _nearest(manifold, start, np.where(sizes > _ROUNDED, sizes, 1.0))
        if np.linalg.norm(f) < _HOLDS:
            require_independent(dyn, end, everywhere=True)
            return
        if np.linalg.norm(f) < best[0]:
            best = float(np.linalg.norm(f)), f
    against = np.flatnonzero(np.abs(best[1]) > 1e-6 * np.abs(best[1]).max())
    verdict = "contradict each other" if len(against) > 1 else "cannot hold"
    raise InputError(
        f"constraints: no configuration that satisfies them all was found from {len(starts)} starts; it seems that "
        f"{_named(against, written)} {verdict}: the least that is left of them is {best[0]:.3g}"
    )


def _explain(manifold: Manifold, written: list[str], q: Array, beside: list[Array], scale: Array, sizes: Array) -> None:
    """Raise why J has dependent rows at and around q; return where it has full rank nearby."""
    reached = [_nearest(manifold, start, scale) for start in (q, *beside)]
    consistent = [x for x, f in reached if np.linalg.norm(f) < _HOLDS]
    if not consistent:
        refuse_unreachable(manifold.dyn, q)
        return
    slopes = [manifold.jacobian(x) / scale[:, None] for x in consistent]
    flat = np.flatnonzero((np.max([np.linalg.norm(J, axis=1) for J in slopes], axis=0) < _FLAT) & (sizes > _ROUNDED))
    if len(flat):
        raise InputError(
            f"constraints: {_named(flat, written)} has no slope where it holds, here and at the poses found around, so "
            "that no force can hold it; write a square as f = 0 instead of f**2 = 0, or start from another pose"
        )
    ranks = [_dependent(J) for J in slopes]
    if all(len(needless) for needless, _ in ranks):
        needless, others = min(ranks, key=lambda pair: len(pair[0]))
        why = f"follows from {_named(others, written)}" if len(others) else "holds by itself"
        raise InputError(
            f"constraints: the set is redundant, here and at poses found around; {_named(needless, written)} {why}; "
            "leave it out, as its multiplier is not determined, or start from another pose"
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
    texts = {k: written[k] if len(written[k]) <= _SHOWN else f"{written[k][:_SHOWN]} ..." for k in which}
    return ", ".join(f"constraints[{k}] ({text})" for k, text in texts.items())
