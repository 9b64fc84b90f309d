"""Runs of studies: start, time limit, warnings, progress, and checkpoints of the result so far."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.applications.random_states import states_of
from mbkit.engines.registry import find_engine
from mbkit.errors import InputError, MbkitError, MbkitWarning
from mbkit.model import Model
from mbkit.model.builder import expect_model
from mbkit.model.elements.kinds import EFFECTS
from mbkit.model.manifold import limits_box
from mbkit.simulate import Trajectory, simulate
from mbkit.studies.results import ResultTable, write_whole

R = TypeVar("R", bound=ResultTable)
#: progress(fraction, text)
Progress = Callable[[float, str], object]
Checkpoint = str | os.PathLike[str] | Callable[[Any], object]

_SECONDS_BETWEEN_RESULTS: Final = 5.0


class InterruptedSweepError(KeyboardInterrupt):
    """A study was interrupted by Ctrl-C; `result` holds the part that was finished, with ``complete=False``.

    A `KeyboardInterrupt`, so that a program that does not handle it ends as usual.
    """

    def __init__(self, result: Any) -> None:
        super().__init__("interrupted; what was finished is in .result")
        self.result = result

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.result,)


def silent(_fraction: float, _text: str) -> None:
    """Report no progress."""


class Checkpointer:
    """Reports progress, and saves results to a JSON file or by a function."""

    def __init__(self, progress: Progress | None, checkpoint: Checkpoint | None) -> None:
        if progress is not None and not callable(progress):
            raise InputError(f"progress: expected a function of (fraction, text), got {progress!r}")
        if checkpoint is not None and not callable(checkpoint):
            if not isinstance(checkpoint, (str, os.PathLike)):
                raise InputError(f"checkpoint: expected a path or a function, got {checkpoint!r}")
            folder = Path(checkpoint).parent
            if not folder.is_dir():
                raise InputError(f"checkpoint: there is no folder {folder}; choose one that exists")
        self._progress, self._checkpoint = progress or silent, checkpoint
        self._reported, self._saved = 0.0, time.perf_counter()

    def report(self, fraction: float, text: str) -> None:
        """Report progress, never less than before."""
        self._reported = max(self._reported, min(fraction, 1.0))
        self._progress(self._reported, text)

    def run(self, steps: Iterable[tuple[float, str]], result: Callable[..., R]) -> R:
        """Work through the steps of a study, and return its result; `result` takes ``complete``.

        The result is saved on the way, at the end, and when an interruption or an error ends the study.
        """
        try:
            for fraction, text in steps:
                self.report(fraction, text)
                if self._checkpoint is not None and time.perf_counter() - self._saved > _SECONDS_BETWEEN_RESULTS:
                    self.save(result(complete=False))
                    self._saved = time.perf_counter()
            whole = result(complete=True)
        except KeyboardInterrupt:
            part = result(complete=False)
            self.save(part)
            raise InterruptedSweepError(part) from None
        except Exception:
            # Such as one of the progress function: the finished part is not lost.
            self.save(result(complete=False))
            raise
        self.save(whole)
        try:
            self.report(1.0, "done")
        except KeyboardInterrupt:
            raise InterruptedSweepError(whole) from None
        return whole

    def save(self, result: ResultTable) -> None:
        """Save a result; where that fails, a warning says so and the study goes on."""
        message = ""
        if callable(self._checkpoint):
            try:
                self._checkpoint(result)
            except Exception as error:
                message = f"the function raised {type(error).__name__}: {error}"
        elif self._checkpoint is not None:
            try:
                write_whole(Path(self._checkpoint), f"{result.to_json()}\n".encode())
            except OSError as error:
                message = f"cannot write {self._checkpoint}: {error.strerror or error}"
        if message:
            warnings.warn(f"checkpoint: {message}; the study goes on", MbkitWarning, stacklevel=4)


#: Random states from which limits are looked for.
_RUNS_TO_LIMITS: Final = 16
#: The note of what was left out because no time was left.
OUT_OF_TIME: Final = "not run: the time allowed was used up"


def state_within_limits(model: Model, rng: np.random.Generator, share: float = 0.5) -> tuple[Array, Array]:
    """Return a random state in the middle `share` of the limits."""
    q, v = model.random_state(rng)
    if model.constrained:
        return q, v
    lower, upper = limits_box(model)
    bounded = np.isfinite(lower)
    middle = 0.5 * (lower[bounded] + upper[bounded])
    q[bounded] = middle + share * (q[bounded] - middle)
    return q, v


def require_motion(model: object, purpose: str) -> Model:
    """Return a model that has a velocity."""
    model = expect_model(model)
    if not model.nv:
        raise InputError(
            f"model: nothing moves in {model.name} (nv = 0), so there is nothing to {purpose}; add a joint"
        )
    return model


def integrable(model: Model, *, native: bool = True) -> tuple[Model, list[str]]:
    """Return a model that references by series and, where `native`, engines' own integrators hold, and what differs."""
    notes = []
    if "jump" in model.effects:
        # No reference of series crosses jumps, and no engine's own integrator holds them exactly.
        acting = {"jump": model.needs.friction, "stop": model.needs.stops}
        model, notes = model.smooth, [f"without {EFFECTS[x]}" for x, there in acting.items() if there]
    if native and model.layout.reduced:
        model, notes = free_of_mimic(model), [*notes, "mimic joints free"]
    return model, notes


def free_of_mimic(model: Model) -> Model:
    """Return the model with its mimic joints independent: MuJoCo's own steps would make them soft."""
    return replace(model, joints=tuple(replace(j, mimic=None) for j in model.joints))


def start_state(model: Model, seed: int) -> tuple[Array, Array]:
    """Return a gentle start near the middle of the joints' ranges: a wild one measures chaos, not integrators."""
    q, v = state_within_limits(model, np.random.default_rng([seed, 1]), 0.1)
    if model.time_parameter is not None and model.constrained:
        # A motion in time has the velocity that it has.
        return states_of(model).manifold.project(q, 0.1 * v)
    return q, 0.1 * v


def runs_to_limits(dyn: Dynamics, duration: float, seed: int) -> tuple[Trajectory, list[tuple[float, int, int]]]:
    """Return free runs from random states within the limits; and time, run and coordinate of each one's first limit."""
    model = dyn.model
    q, v = model.random_state(np.random.default_rng([seed, 3]), size=_RUNS_TO_LIMITS)
    # Those of mechanisms may be beyond.
    within = ((q >= model.lower) & (q <= model.upper)).all(axis=1)
    if not within.any():
        raise InputError(f"q0: no random state of {model.name} is within its limits; give a start")
    run = quiet_simulate(dyn, q[within], v[within], duration, find_engine(dyn.engine).rk4, dt=1e-3)
    beyond = (run.q < model.lower) | (run.q > model.upper)
    first = {i: np.argwhere(rows)[0].tolist() for i, rows in enumerate(beyond) if rows.any()}
    return run, sorted((float(run.t[k]), i, coordinate) for i, (k, coordinate) in first.items())


def whole_steps(interval: float, step: float) -> int:
    """Return the least number of equal steps, none longer than `step` but by rounding, that fill an interval."""
    return max(1, int(np.ceil(interval / step * (1 - 1e-9))))


class TooLongError(MbkitError):
    """A run took longer than it is worth."""


class Deadline:
    """The time limit of a run or a search, by the wall's or another clock.

    `tell` gets the part of the time that is over; by default nobody does.
    """

    def __init__(
        self,
        seconds: float,
        tell: Callable[[float], object] = float,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._tell, self._clock = tell, clock
        #: Seconds that do not count, of all parts together.
        self._uncounted = [0.0]
        self._seconds, self._begun = seconds, self._now()
        self._end = self._begun + seconds

    def _now(self) -> float:
        return self._clock() - self._uncounted[0]

    @property
    def left(self) -> float:
        """Seconds."""
        return self._end - self._now()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Stop the clock of this and all parts, for derivation and compilation."""
        start = self._clock()
        yield
        self._uncounted[0] += self._clock() - start

    def part(self, seconds: float) -> Deadline:
        """Return the limit for a part of the way, which has less time."""
        part = copy(self)
        part._end = min(self._end, self._now() + seconds)
        return part

    def look(self, done: float) -> None:
        """Raise `TooLongError` when the time is up."""
        self._tell(min((self._now() - self._begun) / self._seconds, 1.0))
        if self.left < 0:
            raise TooLongError(f"stopped after {self._seconds:g} s, {done:.0%} done: stiff, or very fast motion")


def quiet_simulate(*args: object, **kwargs: object) -> Trajectory:
    """Simulate without the warning of a divergence, which the caller reads from the statistics."""
    with warnings.catch_warnings(action="ignore", category=MbkitWarning):
        return simulate(*args, **kwargs)  # type: ignore[arg-type]


@contextmanager
def heard_warnings() -> Iterator[list[str]]:
    """Collect the library's warnings, each once."""
    heard: list[str] = []
    with warnings.catch_warnings(record=True, action="always") as caught:
        yield heard
    heard += dict.fromkeys(" ".join(str(w.message).split()) for w in caught if issubclass(w.category, MbkitWarning))
