"""A quantity of the state, at every state of a run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.model import Model

__all__ = ["along", "moved"]

# States at a time: the matrices of a long run would fill the memory.
_MANY: Final = 4096


def along(dyn: Dynamics, shape: tuple[int, ...], evaluate: Callable[..., Array], *states: Array) -> Array:
    """Return evaluate(dyn, q, v, ...) at each state; NaN where one is none.

    Parameters
    ----------
    dyn : Dynamics
        Of a model in which time enters, with one sample for each state (`mbkit.engines.clock.at_times`).
    shape : tuple of int
        Of the quantity at one state.
    evaluate : callable
        Of the dynamics and (n, ·) arrays.
    *states : (K, ·) or (N, K, ·) arrays

    Returns
    -------
    (K, ...) or (N, K, ...) array
    """
    lead = states[0].shape[:-1]
    flat = [x.reshape(-1, x.shape[-1]) for x in states]
    good = np.flatnonzero(np.logical_and.reduce([np.isfinite(x).all(-1) for x in flat]))
    out = np.full((int(np.prod(lead)), *shape), np.nan)
    for start in range(0, len(good), _MANY):
        which = good[start : start + _MANY]
        if dyn.model.clock is not None:
            own = dyn.of_samples(which)
        else:
            own = dyn.of_samples(which // lead[1]) if len(lead) == 2 else dyn
        out[which] = evaluate(own, *(x[which] for x in flat))
    return out.reshape(*lead, *shape)


def moved(model: Model, q: Array, u: Array) -> Array:
    """Return `model.integrate(q, u)` on any number of leading axes; NaN where a state is none."""
    out = np.full(q.shape, np.nan)
    good = np.isfinite(q).all(-1) & np.isfinite(u).all(-1)
    out[good] = model.integrate(q[good], u[good])
    return out
