"""Runs under constraints: from consistent states, along consistent states.

The equation itself holds f̈ = 0 only, so that f and ḟ drift off as any other error of a
method does. One-step methods go on from each state's foot on the constraints, by
Newton's iteration with the mass matrix as the weight; it moves a state by what the step's
own error is, so that their order stays. Multistep methods (BDF, LSODA, CVODES) have a
history that a move would spoil: of them the states that are kept are brought back.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.clock import at_times
from mbkit.errors import UnsupportedError
from mbkit.simulate.outcome import Outcome

__all__ = ["along_constraints", "from_consistent", "refuse_constraints", "settled"]


def from_consistent(dyn: Dynamics, q: Array, v: Array, t: float) -> tuple[Array, Array]:
    """Return initial states, at a time, freed of rounding.

    Raises
    ------
    InputError
        One is inconsistent, with the residuals; or the constraints themselves are no
        independent set.
    """
    if not dyn.model.constrained:
        return q, v
    # This and what follows loads CasADi.
    from mbkit.lagrangian.constraints import manifold_of
    from mbkit.lagrangian.redundancy import require_independent

    require_independent(dyn)
    manifold = manifold_of(dyn).at(t)
    manifold.check(q, v)
    return manifold.pulled(q, v)


def settled(dyn: Dynamics, t: float, q: Array, v: Array) -> tuple[Array, Array]:
    """Return the consistent states beside those that a step has led to."""
    from mbkit.lagrangian.constraints import manifold_of

    return manifold_of(dyn).at(t).pulled(q, v)


def along_constraints(dyn: Dynamics, outcome: Outcome) -> Outcome:
    """Return what was kept of a run, with consistent states."""
    if not dyn.model.constrained or not outcome.q.size:
        return outcome
    from mbkit.lagrangian.constraints import manifold_of

    q, v = outcome.q.copy(), outcome.v.copy()
    shape = q.shape
    flat_q, flat_v = q.reshape(-1, shape[-1]), v.reshape(-1, shape[-1])
    good = np.flatnonzero(np.isfinite(flat_q).all(axis=1) & np.isfinite(flat_v).all(axis=1))
    own = manifold_of(dyn).dyn
    trajectories = shape[0] if q.ndim == 3 else None
    if own.model.clock is not None:
        own = at_times(own, outcome.t, trajectories)
    elif trajectories is not None:
        own = own.of_samples(np.repeat(np.arange(trajectories), shape[1]))
    flat_q[good], flat_v[good] = manifold_of(own.of_samples(good)).pulled(flat_q[good], flat_v[good])
    return replace(outcome, q=q, v=v)


def refuse_constraints(dyn: Dynamics, method: str, why: str) -> None:
    """Say that a method does not run under constraints."""
    if dyn.model.constrained:
        raise UnsupportedError(
            f"{method}: {dyn.model.name} has constraints, {why}; 'gauss4' and 'gauss6' are the implicit methods "
            "for it, 'rk853' and 'taylor' the accurate ones"
        )
