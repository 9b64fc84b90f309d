"""Impacts: velocities that jump under impulses, at a pose that stays.

Lagrange's equation integrated over a time that goes to zero leaves ::

    M (v⁺ - v⁻) = Ŝ + Gᵀ P + Jᵀ Λ        G v⁺ = -e G v⁻        J v⁺ + c = 0

with given impulses Ŝ, rows G of contacts that rebound (e of Newton's restitution) or that are imposed at once (e = 0),
and J, c of the model's own constraints (Pars 1965, A Treatise on Analytical Dynamics, ch. XIV; Greenwood 2003, Advanced
Dynamics, ch. 6). Forces that stay finite have no part in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, batch_of, real, real_array, require_finite, with_shapes
from mbkit._reproducible import independent_rows, under_rows
from mbkit.engines.base import Dynamics, no_dynamics
from mbkit.engines.elements.stop_impacts import after_impacts
from mbkit.errors import InputError, NumericalError, UnsupportedError


@with_shapes
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
        e from 0, where G v⁺ = 0, to 1, where contacts lose no energy unless constraints move.

    Raises
    ------
    InputError
        For unusable arguments, or where there is neither an impulse nor a row.
    NumericalError
        Rows of G depend on each other or on the constraints at this pose, or M is singular.
    UnsupportedError
        A joint at a stop would go through it.

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
    R, k = np.concatenate([G, J], axis=-2), G.shape[-2]
    wanted = np.concatenate([-(1 + e) * (G @ v[..., None])[..., 0], -rate], axis=-1)
    change, P = np.zeros(v.shape), np.zeros(wanted.shape)
    for i in np.ndindex(lead):
        change[i], P[i] = _solved(model.name, i, M[i], R[i], given[i], wanted[i], k)
    if model.needs.stops:
        ends = q.reshape(-1, model.nq), (v + change).reshape(-1, model.nv)
        if (hit := after_impacts(dyn._jumps, dyn, *ends).hit.any(axis=0)).any():
            name = model.velocity_names[int(np.argmax(hit))]
            raise UnsupportedError(f"impact: {model.name}: {name} would go through its stop; give jacobian its row too")
    energy = 0.5 * np.einsum("...i,...ij,...j->...", change, M, 2 * v + change)
    return Impact(v + change, P[..., :k], P[..., k:], float(energy) if not lead else energy)


def _rows(nv: int, jacobian: ArrayLike) -> Array:
    G = real_array("jacobian", jacobian)
    if G.ndim == 1:
        # One row.
        G = G[None]
    if G.ndim not in (2, 3) or G.shape[-1] != nv:
        raise InputError(f"jacobian: expected shape (k, {nv}) or (N, k, {nv}), got {G.shape}")
    require_finite("jacobian", G)
    return G


def _solved(
    name: str, sample: tuple[int, ...], M: Array, R: Array, force: Array, wanted: Array, k: int
) -> tuple[Array, Array]:
    """Return x and P of M x - Rᵀ P = force, R x = wanted, of which the first k rows are a contact's."""
    try:
        x, P, rank = under_rows(M, R, force, wanted)
        determined = rank == k + len(independent_rows(R[k:])[0])
    except NumericalError:
        determined = False
    if not determined:
        where = f" of sample {sample[0]}" if sample else ""
        raise NumericalError(
            f"impact: rows of jacobian depend on each other or on the constraints of {name} at this pose{where}, or "
            "no mass moves with them; impulses are then undetermined: leave such a row out, or give every body a mass"
        )
    return x, P
