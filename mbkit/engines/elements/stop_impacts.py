"""Impacts on joint stops: velocities that jump, with Newton's restitution, as `mbkit.impact` has them for given rows.

The impulses P of the stops that coordinates are at solve ::

    v⁺ = v⁻ + A P        0 <= P  ⟂  v⁺ + e v⁻ >= 0   (inwards, where v⁻ < 0;  v⁺ >= 0 elsewhere)

with the responses A of velocities to impulses: a problem of forces at rest whose bounds are one-sided (Moreau 1988).
Friction of joints stays finite and has no part in it. A stop with e > 0 that rests, and that the impact sends outwards,
rebounds after it, as spheres in a row do; stops with e = 0 take their share at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from mbkit._check import Array
from mbkit.engines.elements.jumps import Jumps, Mask, jump_forces
from mbkit.methods.exchanges import FORCE_ROUNDING, restricted

#: Impacts in a row at one time after which no stop rebounds any more.
_MAX_IMPACTS: Final = 200
#: Velocity outwards, relative to the largest one at a stop, that waits for what the larger ones send on: far from what
#: matters, and far above rounding, so that rounding joins no impacts.
_FIRST: Final = 1e-6


class StopImpacts(NamedTuple):
    """Velocities after impacts, which stops were hit, and the energy that each took, J; (N, nv) each."""

    v: Array
    hit: Mask
    energy_change: Array


def after_impacts(jumps: Jumps, dyn: Any, q: Array, v: Array, *, rebound: bool = True) -> StopImpacts:
    """Return the velocities after all impacts on the stops that states, (N, ...), are at; without `rebound`, e = 0."""
    law, definite = jumps.law_of(dyn).stops, not dyn.model.constrained
    side, v = law.against(q), v.copy()
    e, hit, lost = law.restitution_at(side) * rebound, np.zeros(v.shape, dtype=bool), np.zeros(v.shape)
    A, least = np.broadcast_to(jumps.responses(dyn, q), (*v.shape, v.shape[-1])), np.full(v.shape, np.finfo(float).tiny)
    rounding = FORCE_ROUNDING * np.abs(v).max(axis=1, keepdims=True, initial=0.0) + np.zeros(v.shape)
    for count in range(2 * _MAX_IMPACTS):
        outwards = -side * v
        if not (rows := np.flatnonzero((outwards > rounding).any(axis=1))).size:
            break
        outwards = outwards >= np.maximum(rounding, _FIRST * outwards.max(axis=1, keepdims=True))
        own_e, own, now = e[rows] * (count < _MAX_IMPACTS), side[rows], outwards[rows]
        on, before, responses = (own != 0) & (now | (own_e == 0)), v[rows], A[rows]
        b = np.where(now, 1 + own_e, 1.0) * before
        given = responses, b, np.zeros(b.shape), least[rows], on, np.zeros(b.shape)
        P, holds = jump_forces(*given, definite=definite, stop=own * on)
        holds &= P != 0
        P = P - restricted(responses, b + (responses @ P[..., None])[..., 0], holds, definite=definite)
        after = before + (responses @ P[..., None])[..., 0]
        # What is known of the velocities holds to the last bit.
        after = np.where(holds, np.where(now, -own_e, 0.0) * before + 0.0, after)
        lost[rows] += 0.5 * P * (after + before)
        rounding[rows] += FORCE_ROUNDING * (np.abs(responses) @ np.abs(P)[..., None])[..., 0]
        v[rows], hit[rows] = after, hit[rows] | now
    return StopImpacts(np.where((side * v < 0) & (-side * v <= rounding), 0.0, v), hit, lost)


def over(jumps: Jumps, dyn: Any, q: Array, v: Array, which: Mask) -> StopImpacts:
    """Return the velocities, (N, nv), when the bounces of some have come to their end, as if at once.

    What rests on a stop goes on to rest: the pushes of bounces and of weights are those of the same time.
    """
    A = np.broadcast_to(jumps.responses(dyn, q), (*v.shape, v.shape[-1]))
    rests = which | ((v == 0) & (jumps.law_of(dyn).stops.against(q) != 0))
    P = -restricted(A, v, rests, definite=not dyn.model.constrained)
    return StopImpacts(np.where(rests, 0.0, v + (A @ P[..., None])[..., 0]), which, 0.5 * P * v)


def between_stops(
    jumps: Jumps, dyn: Any, q: Array, v: Array, project: Callable[..., Any] | None = None, hold: Sequence[str] = ()
) -> tuple[Array, Array]:
    """Return states, (N, nq) or of one with constraints, of which none is beyond a stop or leads there.

    `project` takes a state, and the names of what keeps its number, onto the constraints.
    """
    stops, names = jumps.law.stops, dyn.model.coordinate_names
    q, v = (q, v) if project is None else project(q, v, hold)
    while (beyond := stops.passed(q) != 0).any():
        q = stops.onto(q, beyond)
        if project is not None:
            hold = *hold, *(names[stops.places[i]] for i in np.flatnonzero(beyond))
            q, v = project(q, v, hold)
    lead = np.broadcast_shapes(q.shape[:-1], v.shape[:-1])
    states = (np.broadcast_to(x, (*(lead or (1,)), x.shape[-1])) for x in (q, v))
    return q, after_impacts(jumps, dyn, *states, rebound=False).v.reshape(*lead, -1)
