"""`work_precision`: which engine and method reaches which error in which time."""

from __future__ import annotations

import pickle
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import count, finite_array, real
from mbkit.errors import InputError
from mbkit.model import Model
from mbkit.model.expected import expect_model
from mbkit.simulate.applied import TorqueFunction
from mbkit.simulate.methods import METHODS
from mbkit.studies import stamp
from mbkit.studies.facts import facts_of
from mbkit.studies.keeper import Checkpoint, Keeper, Progress
from mbkit.studies.pairs import pairs
from mbkit.studies.precision_result import InterruptedSweepError, WorkPrecision
from mbkit.studies.precision_scene import Exact, scene_of
from mbkit.studies.reference import Reference
from mbkit.studies.result import tupled
from mbkit.studies.rollouts import free_of_mimic
from mbkit.studies.sweep import plans
from mbkit.studies.sweeping import Allowance, Alone, Shared, Sweeping

__all__ = ["work_precision"]

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
        The motion itself: of `mbkit.studies.reference`, whose times are then the saved
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
    taken as `mbkit.studies.orders` says.

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
    facts = facts_of(moving)
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
            q0=tupled(scene.q0),
            v0=tupled(scene.v0),
            curves=tuple(curve for curve, _ in found if curve is not None),
            refusals=tuple(refusal for _, refusal in found if refusal is not None),
            complete=complete,
            versions=stamp.versions(),
            processor=stamp.processor(),
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
