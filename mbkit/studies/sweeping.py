"""How a sweep is carried out: in this process, with interleaved timings, or by workers, a curve each."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final, Protocol

from mbkit.studies.precision_result import Curve
from mbkit.studies.result import Refusal
from mbkit.studies.sweep import Plan
from mbkit.studies.walk import OUT_OF_TIME, Scene, Walk, explore, repeat
from mbkit.studies.workers import run

__all__ = ["Allowance", "Alone", "Found", "Shared", "Sweeping"]

#: What is known of a curve: itself, and why there is no more of it.
Found = tuple[Curve | None, Refusal | None]

#: Of the time allowed, deriving and compiling may begin until this part is over, and by
#: the next every setting has been run once; the rest is for repetitions.
_READY: Final = 0.5
_EXPLORED: Final = 0.65
#: What each of these has at the least, however long the others took.
_AT_LEAST: Final = 0.2


@dataclass(frozen=True)
class Allowance:
    """What a sweep may take, in seconds of the processor: a machine that does other things too ends no sweep.

    Attributes
    ----------
    seconds : float
        After which nothing is begun, counted from when this is made.
    usual : float
        After which runs are not timed again.
    work : float
        Counted work of a run of our own grid; see `Plan.work`.
    """

    seconds: float
    usual: float
    work: float
    begun: float = field(default_factory=time.process_time)

    def until(self, part: float, least: float = 0.0) -> float:
        """Return when a part of the seconds is over, and not before there was a least part for what follows."""
        return max(self.begun + part * self.seconds, time.process_time() + least * self.seconds)

    def timed_until(self, least: float) -> float:
        """Return when to stop timing runs again, and not before there was a least part of the usual time for it."""
        return max(self.begun + self.usual, time.process_time() + least * self.usual)


class Sweeping(Protocol):
    """A sweep under way."""

    def steps(self) -> Iterator[tuple[float, str]]:
        """Carry it out; after each little step, yield the fraction done and what is done now."""
        ...

    def found(self) -> list[Found]:
        """Return what is known of each curve by now."""
        ...


class Alone:
    """All curves in this process, their timings interleaved.

    Parameters
    ----------
    scene : Scene
    wanted : sequence of Plan
    repeats, seed : int
    allowance : Allowance
    """

    def __init__(self, scene: Scene, wanted: Sequence[Plan], repeats: int, seed: int, allowance: Allowance) -> None:
        self._walks = [Walk(scene, plan) for plan in wanted]
        self._repeats, self._seed, self._allowance = repeats, seed, allowance

    def found(self) -> list[Found]:
        """Return what is known of each curve by now."""
        return [(walk.curve(), walk.refusal) for walk in self._walks]

    def steps(self) -> Iterator[tuple[float, str]]:
        """Make every engine ready, run every setting once, and time them in rounds."""
        until = self._allowance.until(_READY, _AT_LEAST)
        # What takes long to derive, Jacobians most of all, must not keep the others from having any time at all.
        for k, walk in enumerate(sorted(self._walks, key=_how_long_to_derive)):
            yield 0.2 * k / len(self._walks), f"compiling {walk.plan.method} on {walk.plan.engine}"
            if k and time.process_time() > until:
                walk.give_up(OUT_OF_TIME)
            elif not walk.over:
                walk.make_ready()
        begun, until = time.process_time(), self._allowance.until(_EXPLORED, _AT_LEAST)
        for walk in explore(self._walks, until, self._allowance.work):
            # Cheap settings are done in no time: the root of the time shows how far it is.
            done = ((time.process_time() - begun) / (_EXPLORED * self._allowance.usual)) ** 0.5
            yield 0.2 + 0.4 * min(done, 1.0), f"{walk.plan.method} on {walk.plan.engine}"
        yield 0.6, "timing"
        for k in repeat(self._walks, self._repeats, self._allowance.timed_until(_AT_LEAST), self._seed):
            yield 0.6 + 0.4 * (k + 1) / self._repeats, f"timing, round {k + 1} of {self._repeats}"


def _how_long_to_derive(walk: Walk) -> tuple[bool, bool]:
    # Implicit methods and series vary in their stages; the others derive a step at the most.
    return walk.plan.kind.stages == 0, walk.plan.engine == "lagrangian"


class Shared:
    """Each curve by a worker of an executor.

    Parameters
    ----------
    executor : concurrent.futures.Executor
    scene, wanted, repeats, seed, allowance
        As of `Alone`; each curve has its part of the time, whatever the workers do side by side.
    """

    def __init__(
        self,
        executor: Executor,
        scene: Scene,
        wanted: Sequence[Plan],
        repeats: int,
        seed: int,
        allowance: Allowance,
    ) -> None:
        self._executor, self._wanted = executor, wanted
        left = allowance.until(1.0, 2 * _AT_LEAST) - time.process_time()
        each = 1 / max(len(wanted), 1)
        part = replace(allowance, seconds=left * each, usual=min(allowance.usual, left) * each)
        self._calls = {str(i): partial(_one, scene, plan, repeats, seed, part) for i, plan in enumerate(wanted)}
        self._found: dict[int, Found] = {}

    def found(self) -> list[Found]:
        """Return what is known of each curve by now."""
        return [self._found.get(i, (None, None)) for i in range(len(self._wanted))]

    def steps(self) -> Iterator[tuple[float, str]]:
        """Collect the curves as they come; one whose worker died is refused with that reason."""
        yield 0.0, f"{len(self._wanted)} curves by {type(self._executor).__name__}"
        # Threads that leave out warnings side by side put back each other's filters in the end.
        with warnings.catch_warnings():
            for name, made in run(self._calls, executor=self._executor):
                plan = self._wanted[int(name)]
                if isinstance(made, Exception):
                    why = f"{type(made).__name__}: {made}"
                    self._found[int(name)] = None, Refusal(plan.engine, plan.method, why)
                else:
                    self._found[int(name)] = made
                yield len(self._found) / len(self._wanted), f"{plan.method} on {plan.engine}"


def _one(scene: Scene, plan: Plan, repeats: int, seed: int, allowance: Allowance) -> Found:
    """Measure one curve, wherever this is."""
    alone = Alone(scene, [plan], repeats, seed, replace(allowance, begun=time.process_time()))
    for _ in alone.steps():
        pass
    return alone.found()[0]
