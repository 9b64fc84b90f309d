"""`work_precision`: which engine and method reaches which error in which time."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import EPS, TYPED, Array, count, finite_array, real
from mbkit.engines.registry import STANDARD, find_engine
from mbkit.errors import InputError, NumericalError
from mbkit.methods.registry import METHODS
from mbkit.model import Model
from mbkit.simulate.torque import TorqueFunction
from mbkit.studies import results
from mbkit.studies._targets import methods_by_engine, numbers_of, with_values
from mbkit.studies.measurement import Problem, Truth, farthest
from mbkit.studies.reference_motions import Reference
from mbkit.studies.reference_motions import reference as compute_reference
from mbkit.studies.study_runs import Checkpoint, Checkpointer, Progress, integrable, require_motion, start_state
from mbkit.studies.work_precision.result import WorkPrecision
from mbkit.studies.work_precision.sweep import INTERVALS, Sweep, TimeBudget, plans
from mbkit.studies.worker import check_executor

#: An exact motion: from a time to q and v.
Exact = Callable[[float], tuple[ArrayLike, ArrayLike]]

#: Evaluations of a run at the most.
_MAX_EVALUATIONS: Final = 200_000
_ALONE: Final = "interleaved in one process"
_TOGETHER: Final = "by workers that share the cores: errors are the same, run times are not those of a quiet machine"


def work_precision(
    model: Model,
    engines: Sequence[str] = STANDARD,
    methods: Sequence[str] | Mapping[str, Sequence[str]] | None = None,
    *,
    duration: float = 1.0,
    q0: ArrayLike | None = None,
    v0: ArrayLike | None = None,
    torque: ArrayLike | TorqueFunction | None = None,
    seed: int = 0,
    steps: Sequence[float] | None = None,
    tolerances: Sequence[float] | None = None,
    repeats: int = 5,
    seconds: float | None = None,
    work: int | None = None,
    executor: Executor | None = None,
    reference: Reference | Exact | None = None,
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
) -> WorkPrecision:
    """Measure error against run time for every engine and method on one motion.

    Parameters
    ----------
    model : Model
        Without forces that jump, as a note says. Its mimic joints are free where MuJoCo's own integrators are among
        the methods: MuJoCo would make them soft.
    engines : sequence of str
    methods : sequence of str, or mapping of str to sequence of str, optional
        Names of `mbkit.simulate.METHODS`, for all engines that have them or for each; by default every method on every
        engine that has it.
    duration : float
        Horizon, s; cut where the reference ends.
    q0, v0 : (nq,) and (nv,) array_like, optional
        Start; by default that of `reference`, or a slow motion near the middle of the joints' ranges, chosen by `seed`.
    torque : (nv,) array_like or callable, optional
        Generalized force, constant, or a function of (t, q, v).
    seed : int
    steps : sequence of float, optional
        Of fixed-step methods, s, each shortened so that a whole number of them is a tenth of the horizon. By default
        from 0.05 s downwards until the error no longer falls.
    tolerances : sequence of float, optional
        rtol = atol of adaptive methods; by default from 1e-3 downwards. Those below a method's least are left out.
    repeats : int
        Timings of each setting, in rounds over all of them; fewer of long runs where time is short.
    seconds : float, optional
        Limit of processor time, with the reference and all compilation, which is never broken off; a part is always
        left to the runs. By default `work` alone decides on the settings, and the study ends after five times the usual
        60 to 120 s.
    work : int, optional
        Limit of evaluations of the forward dynamics in a run with the study's own steps and tolerances; an evaluation
        called from Python counts eight. So the curves do not depend on the machine's speed. By default 200,000, and
        less beyond 8 velocities.
    executor : concurrent.futures.Executor, optional
        Measures one curve a call: a pool of processes, Dask's or MPI's. Errors do not depend on it; run times do,
        because workers share the cores.
    reference : Reference or callable, optional
        The motion: from `mbkit.studies.reference_motions`, whose times are then the saved ones, or an exact
        function from t to (q, v). By default it is computed.
    progress : callable, optional
        Called as ``progress(fraction, text)``. An exception of it ends the study, after `checkpoint` has the result.
    checkpoint : path or callable, optional
        Receives the result so far every few seconds and at the end: a JSON file, whole at any time, or a function.

    Raises
    ------
    InputError, UnknownNameError, UnsupportedError
        Unusable arguments, such as a start at which a loop is open. The limits of an engine or method are in
        `refusals`.
    NumericalError
        No two computations of this motion agree even at its beginning.
    InterruptedSweepError
        Upon Ctrl-C: a `KeyboardInterrupt` whose `result` is the finished part, as `checkpoint` has. While the reference
        is computed, a plain `KeyboardInterrupt`.

    Notes
    -----
    An error is the largest difference of q to the reference, on the manifold, over eleven times and all coordinates.
    Timed is `mbkit.simulate` on the same run, as a user would call it, saving these eleven states (SciPy's methods end
    a step on each, so they take ten at the least). First everything that belongs to the model is derived, compiled and
    built with empty caches, timed apart. Then all settings are run once, the cheapest next run of all curves first,
    until finer settings bring no smaller error or would take too much work. Then they are timed in rounds, each round
    in another order. For the observed order see `mbkit.studies.work_precision.sweep.observed_order`.

    A script that hands over a pool of processes needs ``if __name__ == "__main__":``, and the pool a context that does
    not fork, such as ``ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn"))``. With Dask, ``pip install
    mbkit[dask]``, it is ``distributed.Client().get_executor()``.

    Examples
    --------
    >>> import mbkit as mb
    >>> result = mb.work_precision(mb.catalog.pendulum(), ["pinocchio"], ["rk4"], steps=[0.02, 0.01, 0.005], repeats=1)
    >>> curve, = result.curves
    >>> round(curve.order), len(curve.points)
    (4, 3)
    """
    begun = time.perf_counter()
    require_motion(model, "integrate").require_values("a study of run time")
    # The usual seconds of a study: a base, and some for each velocity.
    usual = min(60.0 + 10.0 * model.nv, 120.0)
    limit = 5.0 * usual if seconds is None else real("seconds", seconds, positive=True)
    # With more velocities an evaluation takes longer.
    whole = _MAX_EVALUATIONS * min(1.0, 8 / model.nv)
    most = whole if work is None else count("work", work, least=1)
    # Studies with a small limit of work time their runs less often, the longest least.
    budget = TimeBudget(limit, min(usual * min(max(most / whole, 0.1), 1.0), limit), most)
    repeats, seed = count("repeats", repeats, least=1), count("seed", seed)
    check_executor(executor, torque=torque)
    checkpoints = Checkpointer(progress, checkpoint)
    methods_of = methods_by_engine(engines, methods)
    native = any(METHODS[m].kind == "native" for names in methods_of.values() for m in names)
    integrated, changed = integrable(with_values(model), native=native)
    asked = real("duration", duration, positive=True)
    steps = None if steps is None else numbers_of("steps", steps, positive=True)
    tolerances = None if tolerances is None else numbers_of("tolerances", tolerances, positive=True)
    force = _constant_torque(torque, integrated)
    checkpoints.report(0.0, "reference")
    known = _known_reference(reference, integrated, asked)
    start = _start(integrated, (q0, v0), seed, known)
    if known is None:
        known = _computed_reference(
            *(integrated, *start, asked, force, 0.25 * min(usual, limit)),
            lambda done: checkpoints.report(0.1 * done, "reference"),
        )
    truth = _truth(integrated, start[0], asked, known)
    duration = float(truth.times[-1])
    problem = Problem(integrated, *start, force, duration)
    if farthest(integrated, truth.q) == 0.0:
        raise InputError(
            "q0, v0: expected a start from which something moves, got one at rest in equilibrium, where every method "
            "is exact; choose another start"
        )
    settings = plans(methods_of, float(truth.times[1]), steps, tolerances)
    sweep = Sweep(problem, truth, settings, repeats, seed, budget, executor)
    facts = results.model_info(integrated)
    facts["notes"] = [*facts["notes"], *changed]
    soft = [name for name in methods_of if model.constrained and find_engine(name).load()._soft_constraints]
    if soft:
        which = " and ".join(soft)
        facts["notes"] = [*facts["notes"], f"{which}: holds loops by its own law; the curves end at that law's motion"]

    def result(*, complete: bool) -> WorkPrecision:
        outcomes = sweep.outcomes()
        return WorkPrecision(
            model=model.name,
            facts=facts,
            duration=duration,
            asked=asked,
            reference=known.how,
            floor=truth.floor,
            q0=tuple(problem.q.tolist()),
            v0=tuple(problem.v.tolist()),
            curves=tuple(curve for curve, _ in outcomes if curve is not None),
            refusals=tuple(refusal for _, refusal in outcomes if refusal is not None),
            complete=complete,
            **results.provenance(begun),
            settings={
                "changed": changed,
                "seed": seed,
                "repeats": repeats,
                "allowed": budget.seconds,
                "work": budget.work,
                "whole_work": whole,
                "steps": steps,
                "tolerances": tolerances,
                "torque": "function" if callable(force) else None if force is None else force.tolist(),
                "saved": truth.times.tolist(),
                "executor": None if executor is None else type(executor).__name__,
                "timing": _ALONE if executor is None else _TOGETHER,
            },
        )

    return checkpoints.run(((0.1 + 0.9 * fraction, text) for fraction, text in sweep.steps()), result)


def _known_reference(reference: object, model: Model, duration: float) -> Reference | None:
    """Return the caller's reference; an exact function at the times of measurement."""
    if reference is None or isinstance(reference, Reference):
        return reference
    if not callable(reference):
        raise InputError(
            f"reference: expected a Reference or a function from t to (q, v), got {type(reference).__name__}"
        )
    states = []
    times = np.linspace(0.0, duration, INTERVALS + 1)
    for t in times.tolist():
        try:
            state = reference(t)
        except Exception as error:
            raise InputError(
                f"reference: the function raised {type(error).__name__} at t = {t:g} s: {error}"
            ) from error
        if not isinstance(state, Sequence) or len(state) != 2:
            raise InputError(f"reference: expected the function to return (q, v), got {state!r} at t = {t:g} s")
        q = finite_array("reference's q", state[0], (model.nq,))
        states.append((q, finite_array("reference's v", state[1], (model.nv,))))
    q, v = (np.stack(x) for x in zip(*states, strict=True))
    floor, how = np.full(len(q), 8 * EPS * float(np.abs(q).max())), "an exact function, to rounding"
    return Reference(times, q, v, 0 * q, 0 * v, floor, -np.log10(8 * EPS), (1.0, 1.0), duration, how)


def _start(
    model: Model, start: tuple[ArrayLike | None, ArrayLike | None], seed: int, known: Reference | None
) -> tuple[Array, Array]:
    default = start_state(model, seed) if known is None else (known.q[0], known.v[0])
    q, v = (usual if own is None else own for own, usual in zip(start, default, strict=True))
    q0, v0 = model.check_q(q, "q0"), model.check_v(v, "v0")
    if q0.ndim != 1 or v0.ndim != 1:
        raise InputError(f"q0, v0: expected one state, got shapes {q0.shape} and {v0.shape}")
    if known is not None and float(np.abs(v0 - known.v[0]).max()) > TYPED:
        raise InputError("reference: does not start with v0; leave v0 out, or use the reference of this start")
    return q0, v0


def _computed_reference(
    model: Model, q0: Array, v0: Array, duration: float, torque: Any, seconds: float, progress: Callable[[float], None]
) -> Reference:
    """Return a reference as far as it holds; search again over a tenth of the time if it holds nowhere."""
    for part in (duration, duration / INTERVALS):
        save = np.linspace(0.0, part, INTERVALS + 1)
        out = compute_reference(model, q0, v0, part, save, torque, seconds=seconds, progress=progress)
        if len(out.t) > 1:
            return out
    raise NumericalError(f"{model.name}: no reference holds for even {part / INTERVALS:g} s; {out.how}")


def _truth(model: Model, q0: Array, duration: float, reference: Reference) -> Truth:
    """Return the motion as far as its reference holds."""
    keep = reference.t <= duration * (1 + 1e-12)
    times, q, floor = reference.t[keep], reference.q[keep], float(reference.floor[keep].max())
    if len(times) < 2 or np.abs(times / times[1] - np.rint(times / times[1])).max() > 1e-9:
        raise InputError(
            "reference: expected times that are 0 and multiples of the first after it, within the duration"
        )
    if q.shape != (len(times), model.nq):
        raise InputError(f"reference: expected states of {model.nq} coordinates, got {q.shape}; it is of another model")
    if float(np.abs(model.difference(q0, q[0])).max()) > TYPED:
        raise InputError("reference: does not start at q0 (and v0); leave them out, or use the reference of this start")
    return Truth(times, q, floor, reference.how)


def _constant_torque(torque: ArrayLike | TorqueFunction | None, model: Model) -> Any:
    if torque is None or callable(torque):
        return torque
    try:
        got = f"shape {np.shape(torque)}"
    except ValueError:
        got = "rows of different lengths"
    if got != f"shape ({model.nv},)":
        raise InputError(
            f"torque: expected shape ({model.nv},), held all the time, or a function of (t, q, v), "
            f"got {got}; rows would be held for other times with every other step"
        )
    return finite_array("torque", torque, (model.nv,))
