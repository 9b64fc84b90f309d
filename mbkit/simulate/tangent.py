"""∂v̇/∂q along the manifold and ∂v̇/∂v at a state, by differences, on any engine."""

from __future__ import annotations

from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics

__all__ = ["tangent"]

#: A cube root of eps: where truncation and rounding of a central difference are alike.
_STEP: Final = 2.0**-17


def tangent(dyn: Dynamics, q: Array, v: Array, tau: Array) -> tuple[Array, Array]:
    """Return A = ∂v̇/∂q along the manifold and B = ∂v̇/∂v, (nv, nv) each, good to some five digits.

    One batch of 4 nv evaluations. Steps are of the size of 1 rad or m, or of the velocity where that is larger:
    what is stiff has large derivatives, which any step shows.
    """
    nv = dyn.model.nv
    turn = _STEP * np.eye(nv)
    push = _STEP * np.eye(nv) * np.maximum(1.0, np.abs(v))
    qs = np.concatenate(
        [
            dyn.model.integrate(np.broadcast_to(q, (2 * nv, len(q))), np.vstack([turn, -turn])),
            np.broadcast_to(q, (2 * nv, len(q))),
        ]
    )
    vs = np.concatenate([np.broadcast_to(v, (2 * nv, nv)), v + push, v - push])
    a = dyn.forward_dynamics(qs, vs, np.broadcast_to(tau, (4 * nv, nv)))
    by_q, by_v = (x[:nv] - x[nv:] for x in (a[: 2 * nv], a[2 * nv :]))
    return by_q.T / (2 * _STEP), by_v.T / (2 * np.diag(push))
