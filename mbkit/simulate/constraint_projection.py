"""Runs under constraints: projection of their states onto f = 0 and ḟ = 0.

The equation of motion holds f̈ = 0 only, so that f and ḟ drift. One-step methods project each step's end, by Newton's
iteration with the mass matrix as the weight; it moves a state by the step's own error, so that the order stays. Near a
singular pose f̈ = 0 divides the errors of stages by J's smallest singular value: all methods leave the step across it
to Gauss's collocation, `mbkit.simulate.solvers.gauss.StepNearPose`. A projection would spoil the history of multistep
methods (BDF, LSODA): only their kept states have it. An engine with soft constraints projects nothing: how far its
states leave the constraints is part of its answer.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.base import at_times
from mbkit.errors import NumericalError
from mbkit.simulate.run_data import SolverResult
from mbkit.simulate.singular_poses import Passage, manifold_at


def from_consistent(dyn: Dynamics, q: Array, v: Array, t: float) -> tuple[Array, Array]:
    """Return initial states without rounding; an `InputError` where one or the constraints are inconsistent."""
    if not dyn.model.constrained:
        return q, v
    from mbkit.engines.constraint_manifold import require_independent

    manifold = manifold_at(dyn, t)
    manifold.check(q, v)
    if not dyn._projects:
        # Soft ones need no independence.
        return q, v
    poses, rates, why = np.atleast_2d(q), np.atleast_2d(v), ""
    require_independent(manifold.member(0).dyn, poses[0], everywhere=True)
    for k in np.flatnonzero(manifold.at_pose(poses)).tolist():
        if here := Passage(manifold.member(k), t, poses[k]).undetermined(rates[k]):
            why = f"q0: {dyn.model.name} is {here}; give another velocity, or start beside it"
    # One of a batch does not stop the others.
    if why and q.ndim == 1:
        raise NumericalError(why)
    return manifold.pulled(q, v)


def settled(dyn: Dynamics, t: float, q: Array, v: Array) -> tuple[Array, Array]:
    """Return the consistent states near the ends of a step."""
    return manifold_at(dyn, t).pulled(q, v)


def along_constraints(dyn: Dynamics, outcome: SolverResult) -> SolverResult:
    """Return a run with its kept states projected onto the constraints; an engine's soft ones keep their drift."""
    if not dyn._projects or not outcome.q.size:
        return outcome
    from mbkit.engines.constraint_manifold import manifold_of

    q, v = outcome.q.copy(), outcome.v.copy()
    shape = q.shape
    flat_q, flat_v = q.reshape(-1, shape[-1]), v.reshape(-1, v.shape[-1])
    good = np.flatnonzero(np.isfinite(flat_q).all(axis=1) & np.isfinite(flat_v).all(axis=1))
    own = manifold_of(dyn).dyn
    trajectories = shape[0] if q.ndim == 3 else None
    if own.model.time_parameter is not None:
        own = at_times(own, outcome.t, trajectories)
    elif trajectories is not None:
        own = own._of_samples(np.repeat(np.arange(trajectories), shape[1]))
    flat_q[good], flat_v[good] = manifold_of(own._of_samples(good)).pulled(flat_q[good], flat_v[good])
    return replace(outcome, q=q, v=v)
