"""Rest beside constraint rows: what rests with what, and how joints share the forces that hold it.

The rows allow velocities v = N u. Joints rest in as many independent ways as their rows of N have; the
others that rest follow from these. Forces λ hold them where Nᵀ λ is the force that is needed along N, and with more
joints than ways λ is not unique. All stay at rest as long as some λ is within all bounds. The λ here is the one whose
largest part of a bound is least, so that this part passes 1 where they let go.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.optimize import linprog
from scipy.sparse.csgraph import connected_components

from mbkit._check import EPS, Array
from mbkit._reproducible import pivoted
from mbkit.engines.elements.jumps import Mask
from mbkit.errors import NumericalError
from mbkit.model.elements.kinds import EFFECTS
from mbkit.model.parts import POSE_ROUNDING

#: Part of a motion that is left where it stops, by the rounding of late times; at a dead centre all of it is.
_LEFT: Final = 1e-3
#: Acceleration, relative to speeds of 1 or more: a speed that fades as c s², s before its end, is zero by rounding from
#: where its rate is 2 √(c eps).
_FADED: Final = 8 * float(np.sqrt(EPS))


def slow(v: Array) -> Array:
    """Return the speed up to which a joint may be at rest by rounding, (1,) or (N, 1)."""
    return np.asarray(POSE_ROUNDING * np.maximum(1.0, np.abs(v).max(axis=-1, keepdims=True, initial=0.0)))


def fades(N: Array, v: Array, a: Array) -> Mask:
    """Return which joints without velocity the rows alone move, and do not but by rounding of their end, (..., nv)."""
    size = np.maximum(1.0, np.abs(v).max(axis=-1, keepdims=True, initial=0.0))
    return np.asarray((np.linalg.norm(N, axis=-1) < POSE_ROUNDING) & (np.abs(a) <= _FADED * size))


def independent(N: Array, still: Mask) -> Mask:
    """Return as many of the joints at rest, (nv,), as rest in independent ways by N, (nv, k)."""
    out, at = np.zeros(still.shape, dtype=bool), np.flatnonzero(still)
    if len(at):
        out[at[pivoted(N[at], POSE_ROUNDING)[0]]] = True
    return out


def stopped(N: Array, v: Array, rests: Mask, rubs: Mask) -> Array:
    """Return the velocity at which some joints have come to rest: so do those that can rest with them alone, (nv,)."""
    U, s, Vt = np.linalg.svd(N[rests], full_matrices=False)
    speeds = (U.T @ v[rests]) / np.where(s > POSE_ROUNDING, s, np.inf)
    # A joint at its dead centre turns there, while the others go on.
    known = (s > POSE_ROUNDING) & (np.abs(speeds) <= _LEFT * max(1.0, float(np.abs(v).max())))
    along = N @ Vt[known].T
    out: Array = v - along @ speeds[known]
    held = np.linalg.norm(N, axis=1) ** 2 - np.linalg.norm(along, axis=1) ** 2 < POSE_ROUNDING
    return np.where(rests | (held & rubs & (np.abs(out) <= slow(v))), 0.0, out)


def shares(N: Array, needed: Array, bound: Array, still: Mask, locked: Mask) -> Array:
    """Return the forces at joints that give the `needed` ones along N, zero where nothing rests, (m, nv).

    Parameters
    ----------
    N : (m, nv, k) array
    needed, bound : (m, nv) array
    still, locked : (nv,) array of bool
        What rests, and as many of it as rest in independent ways.
    """
    out, own = np.zeros(needed.shape), np.flatnonzero(still)
    ways = np.linalg.pinv(N[:, locked])
    # Velocities of what rests by those of what is locked, and the forces that would do there alone.
    R = N[:, own] @ ways
    alone = np.einsum("mkd,mnk,mn->md", ways, N, needed)
    R = np.where(np.abs(R) > POSE_ROUNDING, R, 0.0)
    linked = (R != 0).any(axis=0)
    size, label = connected_components(linked.T.astype(int) @ linked.astype(int))
    for part in range(size):
        columns = np.flatnonzero(label == part)
        rows = np.flatnonzero(linked[:, columns].any(axis=1))
        at, G = own[rows], R[:, rows][..., columns] * bound[:, own[rows], None]
        if len(columns) == 1:
            used = np.sign(G[..., 0]) * alone[:, columns] / np.abs(G[..., 0]).sum(axis=1, keepdims=True)
        else:
            used = np.array([_least(*one) for one in zip(G, alone[:, columns], strict=True)])
        out[:, at] = used * bound[:, at]
    return out


def _least(G: Array, needed: Array) -> Array:
    """Return the x with Gᵀ x = needed whose largest entry is least, (n,)."""
    n, d = G.shape
    size, largest = float(np.abs(needed).max()), float(np.abs(G).max())
    if size == 0:
        return np.zeros(n)
    box = np.block([[np.eye(n), -np.ones((n, 1))], [-np.eye(n), -np.ones((n, 1))]])
    exact = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    rows = np.column_stack([G.T / largest, np.zeros(d)])
    found = linprog(np.eye(n + 1)[n], box, np.zeros(2 * n), rows, needed / size, (None, None), options=exact)
    if found.x is None:
        raise NumericalError(f"{EFFECTS['jump']}: what holds {n} joints at rest is not known, as bounds differ much")
    # The dual is the motion in which they let go. It tells how each of them moves, however small its bound is.
    x, y = found.x[:n] * (size / largest), found.eqlin.marginals
    moves = G @ y
    turns = np.abs(moves) > POSE_ROUNDING * np.linalg.norm(G, axis=1) * np.linalg.norm(y)
    most = (needed @ y) / np.abs(moves).sum()
    x = np.where(turns, np.copysign(most, moves), x)
    return np.asarray(np.where(np.abs(x) < (1 - POSE_ROUNDING) * most, x, np.copysign(most, x)))
