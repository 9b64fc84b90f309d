"""What is recorded, evaluated: the states, every term at them, and where a short rollout ends."""

from __future__ import annotations

import warnings
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.errors import KnownDefectWarning, MbkitError, NumericalError
from mbkit.model import Model
from mbkit.studies.baseline.content import ROLLOUT, Rollout
from mbkit.studies.result import Refusal
from mbkit.studies.rollouts import quiet_simulate
from mbkit.studies.states import States, states
from mbkit.studies.terms import TERMS

__all__ = ["LONG", "evaluated", "states_of"]

# The same formula everywhere: MuJoCo by its own steps, the others by mbkit's.
_METHODS: Final = {"mujoco": "mujoco_rk4"}
_METHOD: Final = "rk4"
#: Of the motion of a robot an excerpt, in which rounding does not grow.
LONG: Final = Rollout(dt=2e-3, steps=25)
# States are written in a file for people: of these decimals every double is its own shortest text.
_DECIMALS: Final = 6


def states_of(model: Model, samples: int, seed: int) -> States:
    """Return `samples` random states, and one that is near singular."""
    drawn = states(model, samples, seed)
    # Limits act on no term, and at zero axes are aligned as they are near singular: a file is read by people.
    which = [*range(samples), *[k for k, kind in enumerate(drawn.kinds) if kind == "near singular"][:1]]
    v, a, tau = (np.round(x[which], _DECIMALS // 2) + 0.0 for x in (drawn.v, drawn.a, drawn.tau))
    if model.constrained:
        # Rounded, a state would be off the constraints.
        v = drawn.v[which]
    return States(_rounded(model, drawn.q[which]), v, a, tau, tuple(drawn.kinds[k] for k in which))


def _rounded(model: Model, q: Array) -> Array:
    if model.constrained:
        return q
    out = np.round(q, _DECIMALS)
    for start, _ in model.quaternions:
        # Unit length needs every digit.
        out[..., start : start + 4] = q[..., start : start + 4]
    return np.asarray(out + 0.0)


def evaluated(dyn: Dynamics, at: States, rollout: Rollout) -> tuple[dict[str, Array], list[Refusal]]:
    """Return every term that an engine gives, and why it does not give the others."""
    values: dict[str, Array] = {}
    refusals = []
    with warnings.catch_warnings():
        # A defect that was there before is recorded, and no news.
        warnings.simplefilter("ignore", KnownDefectWarning)
        for term in TERMS:
            try:
                values[term.name] = term.call(dyn, at)
            except MbkitError as error:
                refusals.append(_refusal(dyn, term.name, error))
        try:
            values[ROLLOUT] = _rolled(dyn, at, rollout)
        except MbkitError as error:
            refusals.append(_refusal(dyn, ROLLOUT, error))
    return values, refusals


def _refusal(dyn: Dynamics, term: str, error: MbkitError) -> Refusal:
    return Refusal(dyn.engine, term, str(error).removeprefix(f"{dyn.engine}: "))


def _rolled(dyn: Dynamics, at: States, rollout: Rollout) -> Array:
    """Return q and v at the end of a rollout from the first state, one after the other."""
    # MuJoCo's own steps make a mimic joint a soft equality, which is another system.
    method = _METHOD if dyn.model.layout.reduced else _METHODS.get(dyn.engine, _METHOD)
    run = quiet_simulate(dyn, at.q[0], at.v[0], rollout.dt * rollout.steps, method, rollout.dt)
    if run.stats.ended != "finished":
        raise NumericalError(f"{dyn.engine}: {method}: {run.stats.message}")
    return np.concatenate([run.q[-1], run.v[-1]])
