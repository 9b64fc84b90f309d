"""Random consistent states, the same for a seed on every processor."""

from __future__ import annotations

from contextlib import suppress
from typing import Final

import numpy as np

from mbkit._check import ROUNDING, Array
from mbkit._reproducible import unit_rows
from mbkit.derivation.constraints import choose_rows
from mbkit.engines.constraint_manifold import Manifold, refuse_unreachable, require_independent
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import InputError, NumericalError
from mbkit.model import Model
from mbkit.model.manifold import least_change, random_state

#: Random states that are drawn, each of which may be too far from the constraints, and how many of them anywhere.
_DRAWS: Final = 50
_ANYWHERE: Final = 10
#: Steps of half of Newton's length, then whole ones, from a random state onto the constraints.
_HALF, _WHOLE = 12, 8
#: How far beside the start a second flow begins, and how much farther apart the two may come; so much larger the
#: velocity may become, too, which tells of joints that nearly lock.
_BESIDE_START: Final = 1e-7
_SLOPE: Final = 30.0
#: Least apartness of rows at a random configuration, relative to that at a closed one that is known.
_WELL: Final = 0.3


class ConsistentStates:
    """What a model asks of its constraints, by equations that are interpreted and derived once."""

    def __init__(self, model: Model) -> None:
        if model.has_bodies:
            # Copies at other times, at which drives may have parted, take it over.
            choose_rows(model)
        self.manifold = Manifold(LagrangianDynamics(model, compile=False))

    def at(self, model: Model) -> ConsistentStates:
        """Return the same for other values of the model's parameters."""
        out = object.__new__(type(self))
        out.manifold = Manifold(self.manifold.dyn._with(model, {}))
        return out

    def require_independent(self, q: Array) -> None:
        """Refuse constraints that depend on each other at q, (nq,) or the first of (N, nq)."""
        require_independent(self.manifold.dyn, np.atleast_2d(q)[0])

    def random(self, rng: np.random.Generator, size: int | None) -> tuple[Array, Array]:
        """Return random consistent states that are no singular poses."""
        drawn = [self._drawn(rng) for _ in range(1 if size is None else size)]
        model = self.manifold.dyn.model
        sizes = (model.nq, model.nv)
        q, v = (np.array([state[k] for state in drawn]).reshape(-1, n) for k, n in enumerate(sizes))
        return (q[0], v[0]) if size is None else (q, v)

    def _drawn(self, rng: np.random.Generator) -> tuple[Array, Array]:
        dyn, closed = self.manifold.dyn, self.manifold.equations.row_choice.closed
        well = _WELL * (1.0 if closed is None else self.manifold.apartness(closed))
        for k in range(_DRAWS):
            q, v = random_state(dyn.model, rng, None)
            if k >= _ANYWHERE:
                # Of many loops few configurations are near a closed one: nearer and nearer to one that is known.
                model, known = dyn.model, dyn.model.neutral() if closed is None else closed
                q = model.integrate(known, (_DRAWS - k) / (_DRAWS - _ANYWHERE) * model.difference(known, q))
            # On some branches constraints depend on each other, and where a disc lies flat M may have no inverse.
            with suppress(InputError, NumericalError):
                state = flowed(self.manifold, q, v, well)
                if state is not None:
                    require_independent(dyn, state[0])
                    return state
        refuse_unreachable(dyn)
        return self.manifold.project(*random_state(dyn.model, rng, None))


#: The name under which a model keeps its own.
_STATES: Final = "_consistent_states"


def states_of(model: Model) -> ConsistentStates:
    """Return the consistent states of a model under constraints, derived once for it."""
    kept = vars(model)
    if _STATES not in kept:
        kept[_STATES] = ConsistentStates(model)
    states: ConsistentStates = kept[_STATES]
    if states.manifold.dyn.model is not model:
        # The same constraints at other values of parameters, or at another time.
        states = kept[_STATES] = states.at(model)
    return states


def flowed(manifold: Manifold, q: Array, v: Array, well: float) -> tuple[Array, Array] | None:
    """Return a consistent state where Newton's flow q̇ = -J⁺ f ends; None where rounding would decide on the end.

    Whole steps of Newton's from afar jump between branches, and the last bits decide to which. Half steps follow
    the flow. A second flow from beside the start says how much the end depends on it, so that a seed has the same
    state on every processor, to rounding; at the end J is at least so `well` from a singular pose.
    """
    model = manifold.dyn.model
    aside = _BESIDE_START * np.random.default_rng(0).standard_normal(model.nv)
    both = np.array([q, model.integrate(q, aside)])
    held = range(manifold.equations.constraints.positions)
    f = np.zeros((2, 0))
    for k in range(_HALF + _WHOLE if held else 0):
        rows, J = manifold.call("constraint_rows", both)
        if not np.isfinite(J).all():
            return None
        size = np.linalg.norm(J[:, held], axis=-1)
        U, sizes, Vt = np.linalg.svd(unit_rows(J[:, held]), full_matrices=False)
        if not (sizes[:, -1] > well * sizes[:, 0]).all():
            return None
        f = rows[..., 0] / size
        along = (np.einsum("nij,ni->nj", U, f) / sizes)[:, None] @ Vt
        both = model.integrate(both, (-0.5 if k < _HALF else -1.0) * along[:, 0])
        if not np.linalg.norm(model.difference(*both)) <= _SLOPE * np.linalg.norm(aside):
            return None
    q, _ = both
    if not (np.abs(f) <= ROUNDING * (1 + np.abs(both).max())).all():
        return None
    if not manifold.apartness(q) > well:
        return None
    v1 = v
    # Once more for what rounding leaves, as a velocity may be small beside the one that was drawn.
    for _ in range(2):
        _, J, rate, M = manifold.terms(q, v1)
        v1 = v1 + least_change(M, J, -rate)
    good = np.linalg.norm(v1) <= _SLOPE * np.linalg.norm(v) and not manifold.still_open(q, v1)
    return (q, v1) if good else None
