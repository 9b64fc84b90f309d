"""Impacts: velocities that jump under impulses, at a pose that stays.

Lagrange's equation integrated over a time that goes to zero leaves ::

    M (v⁺ - v⁻) = Ŝ + Gᵀ P + Jᵀ Λ        G v⁺ = -e G v⁻        J v⁺ + c = 0

with given impulses Ŝ, rows G of contacts that rebound (e of Newton's restitution) or that are imposed at once (e = 0),
and J, c of the model's own constraints (Pars 1965, A Treatise on Analytical Dynamics, ch. XIV; Greenwood 2003, Advanced
Dynamics, ch. 6). Forces that stay finite have no part in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, arrays_shown, batch_of, real, real_array, require_finite
from mbkit._reproducible import DEPENDENT
from mbkit.engines.base import Dynamics, no_dynamics
from mbkit.errors import InputError, NumericalError

_TINY: Final = 1e-150


@dataclass(frozen=True)
class Impact:
    """Velocities after an impact and the impulses that made them, at one state or at N.

    Attributes
    ----------
    v : (nv,) or (N, nv) array
        v⁺.
    impulses : (k,) or (N, k) array
        P of the rows G, in N s or N m s: that on the coordinates is Gᵀ P.
    reactions : (m,) or (N, m) array
        Λ of the model's own constraints, in the order of `constraint_names`; m is 0 without any. Where rows are
        redundant, it is the one with the least norm.
    energy_change : float or (N,) array
        T⁺ - T⁻, J. Without Ŝ, with e = 0 and constraints that do not move, it is -½ (v⁺ - v⁻)ᵀ M (v⁺ - v⁻), as
        Carnot's theorem has it.
    """

    v: Array
    impulses: Array
    reactions: Array
    energy_change: Any

    def __repr__(self) -> str:
        return arrays_shown(self)


def impact(
    dyn: Dynamics,
    q: ArrayLike,
    v: ArrayLike,
    impulse: ArrayLike | None = None,
    *,
    jacobian: ArrayLike | None = None,
    restitution: float = 0.0,
) -> Impact:
    """Return the velocities after impulses, a contact that rebounds, or a constraint that is imposed at once.

    Parameters
    ----------
    dyn : Dynamics
        Of any engine.
    q, v : (nq,), (nv,) or (N, nq), (N, nv) array_like
        The state before.
    impulse : (nv,) or (N, nv) array_like, optional
        Ŝ on the coordinates, N s or N m s: of an impulsive wrench w on a frame it is ``dyn.jacobian(q, frame).T @ w``.
    jacobian : (k, nv) or (N, k, nv) array_like, optional
        G: the velocities G v are those of the contact, such as rows of `Dynamics.jacobian`.
    restitution : float
        e from 0, where G v⁺ = 0, to 1, where frictionless contacts lose no energy unless constraints move.

    Raises
    ------
    InputError
        For unusable arguments, or where there is neither an impulse nor a row.
    NumericalError
        Rows of G depend on each other or on the constraints at this pose, or M is singular.

    Examples
    --------
    A rod that is struck at its centre of percussion, 2/3 of its length from the hinge, puts no load on the hinge:

    >>> import numpy as np
    >>> import mbkit as mb
    >>> b = mb.ModelBuilder("rod")
    >>> b.add_body("rod", mass=1.0, com=(0, 0, 0.5), inertia=(1 / 12, 1 / 12, 1e-3))
    >>> b.add_joint("free", "free", parent="world", child="rod")
    >>> b.add_frame("blow", body="rod", translation=(0, 0, 2 / 3))
    >>> dyn = mb.dynamics(b.build(), "lagrangian")
    >>> q, rest = dyn.model.neutral(), np.zeros(6)
    >>> blow = dyn.jacobian(q, "blow")[0]
    >>> hinge = dyn.jacobian(q, "rod")[:3]
    >>> hit = mb.impact(dyn, q, rest, 0.3 * blow, jacobian=hinge)
    >>> bool(abs(hit.impulses).max() < 1e-15)
    True
    """
    if not isinstance(dyn, Dynamics):
        raise no_dynamics(dyn)
    e, model = real("restitution", restitution), dyn.model
    if not 0 <= e <= 1:
        raise InputError(f"restitution: expected a number from 0 to 1, got {restitution!r}")
    if impulse is None and jacobian is None:
        raise InputError("impulse: expected an impulse, or a jacobian of rows that are imposed, got neither")
    q, v = model.check_q(q), model.check_v(v)
    given = np.zeros(model.nv) if impulse is None else model.check_v(impulse, "impulse")
    G = np.zeros((0, model.nv)) if jacobian is None else _rows(model.nv, jacobian)
    batches = {"q": q, "v": v, "impulse": given, "jacobian": G.sum(axis=-1)}
    size = batch_of(**batches)
    lead = () if size is None else (size,)
    q, v, given = (np.broadcast_to(x, (*lead, x.shape[-1])) for x in (q, v, given))
    G = np.broadcast_to(G, (*lead, *G.shape[-2:]))
    M = dyn.mass_matrix(q)
    J, rate = np.zeros((*lead, 0, model.nv)), np.zeros((*lead, 0))
    if model.constrained:
        J, rate = dyn.constraint_jacobian(q), dyn.constraint_rate(q, v)
    # Sums of the rows that are independent, and zeros for the others.
    mixed, sizes, across = np.linalg.svd(J, full_matrices=False)
    alone = sizes > DEPENDENT * sizes.max(axis=-1, keepdims=True, initial=0.0)
    if redundant := J.shape[-2] > alone.sum(axis=-1).min(initial=model.nv):
        J, rate = (alone * sizes)[..., None] * across, alone * (mixed.mT @ rate[..., None])[..., 0]
    R = np.concatenate([G, J], axis=-2)
    wanted = np.concatenate([-(1 + e) * (G @ v[..., None])[..., 0], -rate], axis=-1)
    change, P = _solved(model.name, M, R, given, wanted, np.concatenate([np.zeros(G.shape[:-1]), ~alone], axis=-1))
    energy = 0.5 * np.einsum("...i,...ij,...j->...", change, M, 2 * v + change)
    k = G.shape[-2]
    reactions = (mixed @ P[..., k:, None])[..., 0] if redundant else P[..., k:]
    return Impact(v + change, P[..., :k], reactions, float(energy) if not lead else energy)


def _rows(nv: int, jacobian: ArrayLike) -> Array:
    G = real_array("jacobian", jacobian)
    if G.ndim == 1:
        # One row.
        G = G[None]
    if G.ndim not in (2, 3) or G.shape[-1] != nv:
        raise InputError(f"jacobian: expected shape (k, {nv}) or (N, k, {nv}), got {G.shape}")
    require_finite("jacobian", G)
    return G


def _solved(name: str, M: Array, R: Array, force: Array, wanted: Array, empty: Array) -> tuple[Array, Array]:
    """Return x and P of M x - Rᵀ P = force, R x = wanted; P is zero of rows that are `empty`, (..., k)."""
    n, k = M.shape[-1], R.shape[-2]
    K = np.zeros((*M.shape[:-2], n + k, n + k))
    K[..., :n, :n], K[..., :n, n:], K[..., n:, :n] = M, R.swapaxes(-1, -2), R
    K[..., n:, n:] = empty[..., None] * np.eye(k)
    # Metres beside radians and grams beside tons: each unknown by its own size.
    masses = np.sqrt(np.abs(np.einsum("...ii->...i", M)))
    masses = np.where(masses > 0, masses, np.maximum(masses.max(axis=-1, keepdims=True, initial=0.0), _TINY))
    moved = np.linalg.norm(R / masses[..., None, :], axis=-1)
    scale = 1 / np.concatenate([masses, np.where(moved > 0, moved, 1.0)], axis=-1)
    scaled = scale[..., :, None] * K * scale[..., None, :]
    right = np.concatenate([force, wanted], axis=-1)
    sizes = np.linalg.svd(scaled, compute_uv=False)
    worst = sizes[..., -1] / sizes[..., 0] if n + k else np.ones(M.shape[:-2])
    if np.any(worst < DEPENDENT):
        where = "" if worst.ndim == 0 else f" of sample {int(np.argmin(worst))}"
        raise NumericalError(
            f"impact: rows of jacobian depend on each other or on the constraints of {name} at this pose{where}, or "
            "no mass moves with them; impulses are then undetermined: leave such a row out, or give every body a mass"
        )
    x = np.zeros_like(right)
    for _ in range(2):
        left = right - (K @ x[..., None])[..., 0]
        x = x + scale * np.linalg.solve(scaled, (scale * left)[..., None])[..., 0]
    # P stands with the other sign in K.
    return x[..., :n], -x[..., n:]
