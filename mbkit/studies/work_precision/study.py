"""`work_precision`: which engine and method reaches which error in which time."""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, count, finite_array, real
from mbkit.errors import InputError, NumericalError
from mbkit.methods.registry import METHODS
from mbkit.model import Model
from mbkit.model.builder import expect_model
from mbkit.simulate.torque import TorqueFunction
from mbkit.studies import results
from mbkit.studies._checkpoint import Checkpoint, Keeper, Progress
from mbkit.studies.compare.rollouts import free_of_mimic, start_state
from mbkit.studies.results import model_info
from mbkit.studies.work_precision.curve import Allowance, Alone, Scene, Shared, Sweeping
from mbkit.studies.work_precision.reference import Reference
from mbkit.studies.work_precision.reference import reference as known_motion
from mbkit.studies.work_precision.result import InterruptedSweepError, WorkPrecision
from mbkit.studies.work_precision.settings import INTERVALS, pairs, plans, save_grid

__all__ = ["Exact", "scene_of", "work_precision"]


# The motion that a study of run time is about, and what its errors are measured by.

#: From a time to q and v there.
Exact = Callable[[float], tuple[ArrayLike, ArrayLike]]

#: A reference that starts farther than this from q0 and v0 is of another motion.
_SAME_START: Final = 1e-9
_EPS: Final = float(np.finfo(float).eps)


def scene_of(
    model: Model,
    duration: float,
    start: tuple[ArrayLike | None, ArrayLike | None],
    torque: Any,
    seed: int,
    reference: Reference | Exact | None,
    tell: Callable[[float], object],
    seconds: float,
) -> tuple[Scene, str]:
    """Return what is integrated with its reference, and how the reference was made.

    Parameters
    ----------
    model : Model
    duration : float
        Asked for, s.
    start : (q0, v0)
        None for the reference's own start, or one by `seed`.
    torque : (nv,) array, callable or None
    seed : int
    reference : Reference, callable or None
        None to search for one.
    tell : callable
        Gets the fraction of the search that is done.
    seconds : float
        What the search may take.

    Raises
    ------
    InputError
        A start or a reference of another model or motion.
    NumericalError
        No reference holds for even a hundredth of the duration.
    """
    tell(0.0)
    q0, v0 = _start(model, start, seed, reference)
    if reference is None:
        made = _searched(model, q0, v0, duration, torque, seconds, tell)
        times, q, floor, how = made.t, made.q, float(made.floor.max()), made.how
    elif isinstance(reference, Reference):
        made = reference
        keep = made.t <= duration * (1 + 1e-12)
        times, q, how = _multiples(made.t[keep]), made.q[keep], made.how
        floor = float(made.floor[keep].max())
    else:
        times = save_grid(duration)
        q = np.stack([_state(model, reference, t)[0] for t in times])
        floor, how = 8 * _EPS * float(np.abs(q).max()), "an exact function, to rounding"
    if q.shape != (len(times), model.nq):
        raise InputError(f"reference: expected states of {model.nq} coordinates, got {q.shape}; it is of another model")
    if float(np.abs(model.difference(q0, q[0])).max()) > _SAME_START:
        raise InputError(
            "reference: does not start at q0 (and v0); leave them out, or take the reference of this start"
        )
    return Scene(model, q0, v0, torque, times, q, floor), how


def _start(
    model: Model, start: tuple[ArrayLike | None, ArrayLike | None], seed: int, reference: Reference | Exact | None
) -> tuple[Array, Array]:
    own = start_state(model, seed)
    known: tuple[Array, Array] | None = None
    if isinstance(reference, Reference):
        known = np.asarray(reference.q[0]), np.asarray(reference.v[0])
    elif callable(reference):
        known = _state(model, reference, 0.0)
    elif reference is not None:
        raise InputError(
            f"reference: expected a Reference or a function from t to (q, v), got {type(reference).__name__}"
        )
    own = own if known is None else known
    q, v = (mine if given is None else given for given, mine in zip(start, own, strict=True))
    q0, v0 = model.check_q(q, "q0"), model.check_v(v, "v0")
    if q0.ndim != 1 or v0.ndim != 1:
        raise InputError(f"q0, v0: expected one state, got shapes {q0.shape} and {v0.shape}")
    if known is not None and float(np.abs(v0 - known[1]).max()) > _SAME_START:
        raise InputError("reference: does not start with v0; leave it out, or take the reference of this start")
    return q0, v0


def _state(model: Model, exact: Exact, t: float) -> tuple[Array, Array]:
    try:
        told = exact(float(t))
    except Exception as error:
        raise InputError(f"reference: the function raised {type(error).__name__} at t = {t:g} s: {error}") from error
    if not isinstance(told, Sequence) or len(told) != 2:
        raise InputError(f"reference: expected the function to return (q, v), got {told!r} at t = {t:g} s")
    q = finite_array("reference's q", told[0], (model.nq,))
    return q, finite_array("reference's v", told[1], (model.nv,))


def _searched(
    model: Model, q0: Array, v0: Array, duration: float, torque: Any, seconds: float, tell: Callable[[float], object]
) -> Reference:
    """Return a reference up to where it holds, or of a tenth of the time where it does not hold for that."""
    for part in (duration, duration / INTERVALS):
        made = known_motion(model, q0, v0, part, save_grid(part), torque, seconds=seconds, progress=tell)
        if len(made.t) > 1:
            return made
    raise NumericalError(f"{model.name}: no reference holds for even {part / INTERVALS:g} s; {made.how}")


def _multiples(times: Array) -> Array:
    """Return a reference's times, if steps of equal length can end on all of them."""
    if len(times) < 2 or np.abs(times / times[1] - np.rint(times / times[1])).max() > 1e-9:
        raise InputError(
            "reference: expected times that are 0 and multiples of the first after it, within the duration"
        )
    return times


#: Seconds that a study usually takes, and what each velocity adds, up to the most.
_USUAL: Final = 60.0
_EACH: Final = 10.0
_MOST: Final = 120.0
#: Times as long, a study that was given no time ends all the same.
_AT_THE_LATEST: Final = 5.0
#: Counted work of a run, for so many velocities; of more it is less, as each evaluation takes longer.
_WORK: Final = 200_000
_VELOCITIES: Final = 8
#: The part of it that a reference may take.
_FOR_REFERENCE: Final = 0.25
_ALONE: Final = "interleaved in one process"
_TOGETHER: Final = "by workers that share the cores: errors are the same, run times are not those of a quiet machine"


def work_precision(
    model: Model,
    engines: Sequence[str] = ("pinocchio", "lagrangian", "mujoco"),
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
        With mimic joints, and MuJoCo's own integrators among the methods, these joints
        are free: MuJoCo would make them soft.
    engines : sequence of str
    methods : sequence of str, or mapping of str to sequence of str, optional
        Names of `mbkit.simulate.METHODS`, for all engines that have them or for each; by
        default every method on every engine that has it.
    duration : float
        Horizon, s; cut where the reference stops holding, or the one given ends.
    q0 : (nq,) array_like, optional
    v0 : (nv,) array_like, optional
        Where the motion starts; by default near the middle of the joints' ranges,
        moving gently, by `seed`, or where `reference` does.
    torque : (nv,) array_like or callable, optional
        Generalized force, held all the time, or a function of (t, q, v).
    seed : int
    steps : sequence of float, optional
        Of fixed-step methods, s, each shortened so that a whole number of them is a tenth of
        the horizon. By default from 0.05 s downwards, as far as it pays.
    tolerances : sequence of float, optional
        rtol = atol of adaptive methods; by default from 1e-3 downwards. Those below a
        method's least are left out.
    repeats : int
        Timings of each setting, in rounds over all of them; fewer of long ones where
        time is short.
    seconds : float, optional
        What the study may take of the processor's time at the most, the reference and all compiling included.
        What is left out for that is told first, in the repr and the reports. Nothing that is being compiled is
        broken off, and a part is always left to the runs. When not given, `work` alone decides on the settings,
        and five times the usual 60 to 120 s end the study of a model that takes too long to derive.
    work : int, optional
        Evaluations of the forward dynamics that a run of the study's own steps and tolerances may take; one
        that is called from Python counts eight. So the curves do not depend on the machine's speed. By default
        200,000, and less beyond 8 velocities.
    executor : concurrent.futures.Executor, optional
        Who measures, a curve each: a pool of processes, Dask's or MPI's. Errors do not
        depend on it. Run times do: workers share the cores, and each has the time
        allowed for one curve, so leave it out for run times to rely on.
    reference : Reference or callable, optional
        The motion itself: of `mbkit.studies.work_precision.reference`, whose times are then the saved
        ones, or an exact function from t to (q, v). By default made here.
    progress : callable, optional
        Called as ``progress(fraction, text)``. What it raises ends the study, after
        `checkpoint` has got what was finished.
    checkpoint : path or callable, optional
        Where the result so far goes every few seconds and at the end: a JSON file, which is
        whole at any time, or a function.

    Returns
    -------
    WorkPrecision

    Raises
    ------
    InputError, UnknownNameError
        For unusable arguments. What an engine or method cannot do is in `refusals`.
    UnsupportedError
        A reference is searched, and the model has loops or prescribed motions, which engines do not take.
    NumericalError
        No two ways to compute this motion agree even at its beginning.
    InterruptedSweepError
        Upon Ctrl-C: a `KeyboardInterrupt` whose `result` is what was finished, which
        `checkpoint` has got before. It is a plain one while there is no reference yet.

    Notes
    -----
    An error is the largest difference of q to the reference, on the manifold, over
    eleven times and all coordinates. What is timed is `mbkit.simulate` on the same run,
    as a user would call it, saving these eleven states (SciPy's methods end a step on
    each, so they take ten at the least). Everything that belongs to the model is
    first derived, compiled and built from nothing, whatever the caches hold, and that
    is timed apart. Then all settings are run once, the cheapest next run of all curves
    first, until finer settings bring nothing or would take too much work, and then timed
    in rounds over all of them, each round in another order. The observed order is
    taken as `mbkit.studies.work_precision.curve` says.

    A script that hands over a pool of processes needs ``if __name__ == "__main__":``,
    and the pool a context that does not fork, such as
    ``ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn"))``. With
    Dask, ``pip install mbkit[dask]``, it is ``distributed.Client().get_executor()``.

    Examples
    --------
    >>> import mbkit as mb
    >>> result = mb.work_precision(mb.catalog.pendulum(), ["pinocchio"], ["rk4"], steps=[0.02, 0.01, 0.005], repeats=1)
    >>> curve, = result.curves
    >>> round(curve.order), len(curve.points)
    (4, 3)
    """
    begun = time.perf_counter()
    _check_model(model)
    usual = min(_USUAL + _EACH * model.nv, _MOST)
    limit = _AT_THE_LATEST * usual if seconds is None else real("seconds", seconds, positive=True)
    most = _WORK * min(1.0, _VELOCITIES / model.nv) if work is None else count("work", work, least=1)
    allowance = Allowance(limit, min(usual, limit), most)
    repeats, seed = count("repeats", repeats, least=1), count("seed", seed)
    _check_executor(executor, torque)
    keeper = Keeper(progress, checkpoint)
    wanted_pairs = pairs(engines, methods)
    moving = _moving(model, wanted_pairs)
    asked = real("duration", duration, positive=True)
    grids = _grid("steps", steps), _grid("tolerances", tolerances)
    scene, how = scene_of(
        moving,
        asked,
        (q0, v0),
        _torque(torque, moving),
        seed,
        reference,
        lambda done: keeper.tell(0.1 * done, "reference"),
        _FOR_REFERENCE * allowance.usual,
    )
    if scene.motion == 0.0:
        raise InputError(
            "q0, v0: expected a start from which something moves, got one at rest in equilibrium, where every method "
            "is exact; choose another start"
        )
    wanted = plans(wanted_pairs, float(scene.times[1]), *grids)
    sweeping: Sweeping
    if executor is None:
        sweeping = Alone(scene, wanted, repeats, seed, allowance)
    else:
        sweeping = Shared(executor, scene, wanted, repeats, seed, allowance)
    facts = model_info(moving)
    if moving is not model and model.layout.reduced:
        facts["notes"] = [*facts["notes"], "mimic joints free"]
    settings = {
        "seed": seed,
        "repeats": repeats,
        "allowed": allowance.seconds,
        "work": allowance.work,
        "steps": grids[0],
        "tolerances": grids[1],
        "torque": "function" if callable(scene.torque) else None if scene.torque is None else scene.torque.tolist(),
        "saved": scene.times.tolist(),
        "executor": None if executor is None else type(executor).__name__,
        "timing": _ALONE if executor is None else _TOGETHER,
    }

    def result(*, complete: bool) -> WorkPrecision:
        found = sweeping.found()
        return WorkPrecision(
            model=model.name,
            facts=facts,
            duration=scene.duration,
            asked=asked,
            reference=how,
            floor=scene.floor,
            q0=tuple(scene.q0.tolist()),
            v0=tuple(scene.v0.tolist()),
            curves=tuple(curve for curve, _ in found if curve is not None),
            refusals=tuple(refusal for _, refusal in found if refusal is not None),
            complete=complete,
            versions=results.versions(),
            processor=results.processor(),
            seconds=time.perf_counter() - begun,
            settings=settings,
        )

    try:
        for fraction, text in sweeping.steps():
            keeper.tell(0.1 + 0.9 * fraction, text)
            keeper.now_and_then(partial(result, complete=False))
        whole = result(complete=True)
    except KeyboardInterrupt:
        part = result(complete=False)
        keeper.keep(part)
        raise InterruptedSweepError(part) from None
    except Exception:
        # A progress function's, or a fault: what was finished is not lost with it.
        keeper.keep(result(complete=False))
        raise
    keeper.keep(whole)
    keeper.tell(1.0, "done")
    return whole


def _check_executor(executor: Executor | None, torque: object) -> None:
    if executor is None:
        return
    if not isinstance(executor, Executor):
        raise InputError(
            f"executor: expected a concurrent.futures.Executor, got {type(executor).__name__}; "
            "a ProcessPoolExecutor is one, and so is what Dask's client.get_executor() returns"
        )
    if isinstance(executor, ProcessPoolExecutor):
        try:
            pickle.dumps(torque)
        except Exception as error:  # pickle raises errors of several kinds
            raise InputError(
                f"torque: cannot be sent to the executor's processes ({error}); define the function in a module"
            ) from None


def _check_model(model: Model) -> None:
    expect_model(model)
    if not model.nv:
        raise InputError(f"model: nothing moves in {model.name} (nv = 0), nothing to integrate; add a joint")
    model.require_values("a study of run time")


def _moving(model: Model, pairs: Mapping[str, Sequence[str]]) -> Model:
    """Return the model that all integrate."""
    if model.parameters:
        model = model.with_parameters(**{k: x for k, x in model.parameters.items() if x is not None})
    native = any(METHODS[m].kind == "native" for ms in pairs.values() for m in ms)
    return free_of_mimic(model) if model.layout.reduced and native else model


def _torque(torque: ArrayLike | TorqueFunction | None, model: Model) -> Any:
    if torque is None or callable(torque):
        return torque
    try:
        shape: tuple[int, ...] | None = np.shape(torque)
    except ValueError:
        shape = None
    if shape != (model.nv,):
        got = "rows of different lengths" if shape is None else f"shape {shape}"
        raise InputError(
            f"torque: expected shape ({model.nv},), held all the time, or a function of (t, q, v), "
            f"got {got}; rows would be held for other times with every other step"
        )
    return finite_array("torque", torque, (model.nv,))


def _grid(name: str, values: Sequence[float] | None) -> tuple[float, ...] | None:
    if values is None:
        return None
    if isinstance(values, (str, bytes)) or not isinstance(values, Iterable):
        raise InputError(f"{name}: expected several numbers, got {values!r}")
    out = tuple(real(f"{name}[{i}]", x, positive=True) for i, x in enumerate(values))
    if not out:
        raise InputError(f"{name}: expected at least one number, got none; leave it out for the study's own")
    return out
