"""A problem whose truth is known, and the measurement of one run on it: what all sweeps have in common."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal

import numpy as np

from mbkit._check import DOUBLE_BITS, EPS, Array
from mbkit.engines import Dynamics
from mbkit.engines.oracle import OracleDynamics
from mbkit.errors import MbkitError
from mbkit.model import Model
from mbkit.simulate import Trajectory

#: How a run or an evaluation ended, before its error is judged.
End = Literal["finished", "diverged", "nan", "refused", "slow", "died", "not run"]
#: With its error: held; above the bar, yet within `GROSS`; grossly wrong with a warning or without one; finished, with
#: no truth to judge it by this bar; or how it ended.
Outcome = Literal[
    "held", "inaccurate", "warned", "silent", "unjudged", "diverged", "nan", "refused", "slow", "died", "not run"
]

#: The default bar: a relative error that plots cannot hide and papers accept.
BAR: Final = 1e-6
#: An answer with a larger error, relative to the motion or the term, is not inaccurate but wrong. A method of low order
#: misses the bar with every affordable step, and misleads nobody by that.
GROSS: Final = 1e-2
#: The largest error that a result holds.
MAX_ERROR: Final = 1e300
#: Rounding of a double energy, relative to it; beyond this part of the motion's energy it can hide an error.
_ENERGY_ROUNDING: Final = 16.0 * EPS
_MIN_HIDING_ROUNDING: Final = 1e-9


@dataclass(frozen=True)
class Truth:
    """The motion that a run is measured against.

    Attributes
    ----------
    times : (K,) array
        From 0, s.
    q : (K, nq) array
    floor : float
        Its error, rad or m.
    how : str
        The closed form with its source, or the runs that agree to the floor.
    """

    times: Array
    q: Array
    floor: float
    how: str


@dataclass(frozen=True)
class Problem:
    """A motion from a state, or the terms at states, of which the truth is known or can be computed.

    Attributes
    ----------
    model : Model
    q, v : (nq,) and (nv,) arrays, or (N, nq) and (N, nv) for terms
        The start of a run, or the states at which terms are measured.
    tau : (N, nv) or (nv,) array, callable or None
        Generalized force: of the terms' forward dynamics; along a run a constant one, or a function of (t, q, v).
    duration : float
        Of a run, s; 0 for terms.
    exact, floor, source : callable or None, float, and str
        The closed form of the motion, from times (K,) to q (K, nq), its error, rad or m, and where it is from.
    scale : float
        Size of the motion, by which an error of q is divided, rad or m; of terms the condition of the rows, by which
        one of accelerations is.
    dt : float or None
        Step of fixed-step methods, s, where the case prescribes it.
    facts : dict
        Further numbers for the report, with a unit behind a comma in their names: ``"fastest frequency, rad/s"``.
    """

    model: Model
    q: Array
    v: Array
    tau: Any = None
    duration: float = 0.0
    exact: Callable[[Array], Array] | None = None
    floor: float = 0.0
    source: str = ""
    scale: float = 1.0
    dt: float | None = None
    facts: Mapping[str, float] = field(default_factory=dict)

    def measured(self, value: float, truth: Truth | None, times: Array, dyn: Dynamics, run: Trajectory) -> Measurement:
        """Return how a run by a setting ended, its error and that of its energy, by `dyn`, at the times."""
        stats = run.stats
        note = "; ".join(x for x in (stats.message, stats.chosen) if x)
        cell = Measurement(value, steps=stats.steps, evaluations=stats.evaluations, note=note)
        if not stats.finished or len(run.t) != len(times):
            return replace(cell, end="diverged", note=stats.message or f"ended at t = {run.t[-1]:g} s")
        if not (np.isfinite(run.q).all() and np.isfinite(run.v).all()):
            return replace(cell, end="nan", note="states that are not finite, and nothing was said")
        # With applied forces the times are too few to know their work.
        cell = replace(cell, energy=math.nan if self.tau is not None else _energy_error(dyn, run))
        if truth is None:
            return cell
        apart = float(np.abs(self.model.difference(truth.q, run.q)).max()) / self.scale
        return replace(cell, error=min(apart, MAX_ERROR), floor=truth.floor / self.scale)


@dataclass(frozen=True)
class Measurement:
    """One engine and method at one value of what is swept: a parameter of the problem, a step, or a tolerance.

    `end` is ``"finished"``; ``"diverged"`` where the run said so itself; ``"nan"`` where numbers are not finite and
    nothing was said; ``"refused"``, an error of its own; ``"slow"``, stopped at the time allowed; ``"died"``, the
    process ended or took too much memory; ``"not run"``. `note` says why it ended, and what was chosen.

    `error` is the largest difference of q to the truth over the saved times, over the problem's scale (in a study of
    precision 1, so rad or m), that of a term, or of the energy where that is the measure; NaN where there is none, or
    no truth to measure it by; `floor` is the error of that truth. `energy` is the largest ``|E(t) - E(0)|`` at these
    times, relative to the larger of the largest kinetic energy and the change of potential energy; NaN with dampers,
    applied forces, or where nothing was integrated.

    `seconds` are of the run, or of one evaluation of a term, without compilation. `steps` and `evaluations` are of one
    run, 0 where the engine does not report them. Where a step (``"dt"``) or tolerance (``"rtol"``) is swept, `setting`
    says which, and `seconds` is the median of so many `repeats`, with half their interquartile range as `spread`, NaN
    for one run.
    """

    value: float
    end: End = "finished"
    error: float = math.nan
    energy: float = math.nan
    seconds: float = math.nan
    steps: int = 0
    warnings: tuple[str, ...] = ()
    note: str = ""
    floor: float = 0.0
    setting: Literal["", "dt", "rtol"] = ""
    evaluations: int = 0
    spread: float = 0.0
    repeats: int = 0

    @property
    def seen(self) -> float:
        """The error that counts, its own, or that of the energy where there is no truth.

        A wrong energy speaks against a run, but a right one does not speak for it.
        """
        return self.energy if math.isnan(self.error) else self.error

    def outcome(self, bar: float) -> Outcome:
        """Return the outcome by this bar on the error."""
        if self.end != "finished":
            return self.end
        seen = self.seen
        if math.isnan(seen) or abs(seen - bar) <= self.floor or (math.isnan(self.error) and seen <= bar):
            return "unjudged"
        if seen <= bar:
            return "held"
        if seen <= max(bar, GROSS):
            return "inaccurate"
        return "warned" if self.warnings else "silent"


def run_name(engine: str, method: str) -> str:
    """Return engine and method; an engine's own integrators have it in their names."""
    return method if method.startswith(f"{engine}_") else f"{engine} {method}"


def farthest(model: Model, q: Array) -> float:
    """Return the farthest that any coordinate of a motion, (K, nq), gets from its start, rad or m."""
    return float(np.abs(model.difference(np.broadcast_to(q[0], q.shape), q)).max())


def _energy_error(dyn: Dynamics, run: Trajectory) -> float:
    """Return the largest energy change over the larger of T and the change of V; NaN if unknown or only rounding.

    Unknown it is with dampers, forces without a potential or explicit time, whose work is not known.
    By the oracle, the change has 34 digits.
    """
    model, q, v = dyn.model, run.q, run.v
    if model.loses_energy or model.constraints_do_work or model.time_parameter is not None:
        return math.nan

    def energy(name: str, *state: Array) -> tuple[Array, Array]:
        if isinstance(dyn, OracleDynamics):
            return dyn.extended(name, *state)
        high = np.asarray(getattr(dyn, name)(*state))
        return high, np.zeros_like(high)

    try:
        V, T0 = energy("potential_energy", q), None
        if not model.has_bodies:
            # Jacobi's integral T2 - T0 + V, which is the energy where there is no T0.
            T0 = energy("kinetic_energy", q, 0 * v)
            V = V[0] - T0[0], V[1] - T0[1]
        if isinstance(dyn, OracleDynamics):
            T = energy("kinetic_energy", q, v)
            T = T if T0 is None else (T[0] - T0[0], T[1] - T0[1])
        else:
            # By the mass matrix, which no known defect of an engine touches.
            T = 0.5 * np.einsum("ni,nij,nj->n", v, dyn.mass_matrix(q), v), np.zeros(len(v))
    except MbkitError:
        return math.nan
    gained, change = ((high - high[0]) + (low - low[0]) for high, low in (T, V))
    drift, size = float(np.abs(gained + change).max()), max(float(T[0].max()), float(np.ptp(V[0])))
    rounding = 0.0 if dyn._significand_bits > DOUBLE_BITS else _ENERGY_ROUNDING * float(np.abs([T[0], V[0]]).max())
    hidden = rounding > _MIN_HIDING_ROUNDING * size and drift <= rounding
    return min(drift / size, MAX_ERROR) if size > 0 and not hidden else math.nan
