"""`versions`: terms, parsers and runs of an engine's versions against the oracle, and where each number moved."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any, Final

import numpy as np

from mbkit._check import count, real
from mbkit.engines import EngineVersion
from mbkit.engines import engine as named_version
from mbkit.engines.registry import MUJOCO
from mbkit.engines.versions import environment
from mbkit.engines.versions.engine_version import PACKAGES, order_of, versions_of
from mbkit.errors import InputError, MbkitError, UnknownNameError, require_known
from mbkit.model import Model
from mbkit.studies._checkpoint import Progress, silent
from mbkit.studies._targets import names_of
from mbkit.studies.results import processor
from mbkit.studies.results import versions as installed_versions
from mbkit.studies.versions.measure import Case, Measured, Truth, case_of, measured
from mbkit.studies.versions.result import ASIDE, AWAY, GIVEN, REFUSED, TOWARDS, Change, VersionRow, VersionsResult
from mbkit.studies.worker import describe, run

#: A number moved towards the truth where its error fell by more than this factor, and away where it grew by more: from
#: one build to the next rounding alone changes a worst error by less.
_CLEAR: Final = 2.0
#: Digits of a double.
_MOST_DIGITS: Final = -math.log10(np.finfo(float).eps)
#: By bits of a significand, what rounding alone moves no number by.
_MOVED: Final = {53: 1e-9, 24: 1e-4}
LATEST: Final = "latest"


def versions(
    targets: Sequence[str | Model] | str | Model,
    engine: str = MUJOCO,
    versions: Iterable[str] | None = None,
    *,
    first: str = "",
    last: str = LATEST,
    most: int = 12,
    samples: int = 4,
    seed: int = 0,
    tolerance: float | None = None,
    keep: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> VersionsResult:
    """Say which version of an engine changed which number, and whether towards the truth.

    Every term of every version is measured against the oracle, whose 34 digits do not move. Of a robot with a file
    whose joints have one coordinate each, the version's own parser is measured too (rows ``file M``, ``file g`` and
    ``file nle``), and MuJoCo's own Runge-Kutta run of 0.1 s. Environments are made as `mbkit.engine` makes them; what
    that takes is said on stderr before it begins.

    Parameters
    ----------
    targets : str, Model, or several
        Robots, catalog systems, files, ``package.module:function``, or models.
    engine : {"mujoco", "pinocchio", "drake", "newton", "mujoco-warp", "mjx"}
    versions : iterable of str, optional
        By default those that pip can install, from `first` to `last`.
    first, last : str
        Such as ``"3.3"``; all that begin so count. Without `first` the oldest, and ``"latest"`` is the newest.
    most : int
        Of more versions only so many are measured at first, evenly spread. Between two with different numbers the
        first version with the new one is found by bisection.
    samples, seed : int
        Random states, beside neutral, at-limit and near-singular ones.
    tolerance : float
        A number has changed where it moved by more, relative as errors are in `mbkit.compare`. By default 1e-9, and
        1e-4 for an engine in single precision.
    keep : int, optional
        Environments that this call made and leaves on the disk; by default all.
    executor : concurrent.futures.Executor, optional
        Measures versions at once, also on other machines.
    progress : callable, optional
        Gets a fraction and a text.

    Raises
    ------
    UnknownNameError
        An engine of which there are no other versions, or a version that does not exist.
    UnsupportedError
        pip does not tell which versions there are.

    Notes
    -----
    A version that does not install, whose process dies or that hangs is in ``missing`` or has rows with a reason.
    A change that a later one of the spread undid is found only where one of its versions is measured.
    """
    require_known("engine with versions", PACKAGES, engine)
    count("most", most, least=2)
    count("samples", samples, least=1)
    if tolerance is None:
        tolerance = _MOVED[PACKAGES[engine].bits]
    real("tolerance", tolerance, positive=True)
    if keep is not None:
        count("keep", keep)
    chosen = _chosen(engine, versions, first, last)
    cases = tuple(case_of(x, samples, seed) for x in _targets(targets))
    names = [case.name for case in cases]
    if len(set(names)) < len(names):
        raise InputError(f"targets: expected each once, got {', '.join(names)}")
    study = _Study(cases, chosen, tolerance, keep, executor, progress or silent)
    study.announce(min(most, len(chosen)))
    study.measure(_spread(len(chosen), most))
    while between := study.undecided():
        study.measure(between)
    settings = {
        "samples": samples,
        "seed": seed,
        "tolerance": tolerance,
        "known": len(chosen),
        "most": most,
        "keep": keep,
        "processor": processor(),
        "with": installed_versions(),
    }
    return study.result(engine, settings)


def _targets(targets: Any) -> list[str | Model]:
    some = [targets] if isinstance(targets, (str, Model)) else list(targets) if isinstance(targets, Iterable) else []
    if not some or not all(isinstance(x, (str, Model)) for x in some):
        raise InputError("targets: expected a robot, catalog system, file or Model, or several of them")
    return some


def _chosen(engine: str, versions: Iterable[str] | None, first: str, last: str) -> list[EngineVersion]:
    """Return the versions, oldest first."""
    if versions is not None:
        names = list(names_of("versions", versions))
        return sorted((named_version(f"{engine}=={x}") for x in names), key=lambda x: order_of(x.version))
    # 4.0 as the last one takes 4.0.1.
    low, high = order_of(first or "0", "first"), () if last in ("", LATEST) else order_of(last, "last").release
    known = versions_of(engine)
    out = [x for x in known if low <= order_of(x) and order_of(x).release[: len(high)] <= high]
    if not out:
        raise UnknownNameError(f"version of {engine}", f"{first or 'the first'} to {last}", known, every=True)
    return [named_version(f"{engine}=={x}") for x in out]


def _spread(n: int, most: int) -> list[int]:
    """Return at most so many numbers below n, with both ends, evenly spread."""
    return sorted({round(x) for x in np.linspace(0, n - 1, min(n, max(most, 2)))})


def middles(done: Iterable[int], missing: Container[int], differ: Callable[[int, int], bool]) -> list[int]:
    """Return the numbers in the middle between neighbours of `done` that differ: the next step of a bisection."""
    out = []
    for i, j in pairwise(sorted(done)):
        between = [k for k in range(i + 1, j) if k not in missing]
        if between and differ(i, j):
            out.append(between[len(between) // 2])
    return out


@dataclass(eq=False)
class _Study:
    """The measurements so far."""

    cases: tuple[Case, ...]
    versions: list[EngineVersion]
    tolerance: float
    keep: int | None
    executor: Executor | None
    progress: Progress

    def __post_init__(self) -> None:
        versions, keep = self.versions, self.keep
        self._start = time.perf_counter()
        self._done: dict[int, Measured] = {}
        self._missing: dict[int, str] = {}
        self._truths = {case.name: Truth(case) for case in self.cases}
        # The last one is timed beside all others, and goes at the end.
        made = [x for x in versions[:-1] if not x.installed]
        self._removed = set(made[max(0, (keep or 1) - 1) :]) if keep is not None else set()
        self._last_removed = keep == 0 and not versions[-1].installed
        self._new = [x for x in versions if not x.installed]

    def announce(self, first: int) -> None:
        """Announce the effort of the study, before it begins."""
        package = self.versions[0].package
        made = min(len(self._new), first)
        stay = made - len(self._removed) - self._last_removed
        print(
            f"mbkit: {first} of {len(self.versions)} versions of {self.versions[0].engine}, and more where numbers "
            f"moved; {made} environments are made, some {made * package.seconds:.0f} s and "
            f"{max(stay, min(made, 2)) * package.megabytes:.0f} MB of disk",
            file=sys.stderr,
            flush=True,
        )

    def measure(self, which: Sequence[int]) -> None:
        """Measure versions by number."""
        last = self.versions[-1]
        calls = {}
        for k in which:
            version = self.versions[k]
            calls[str(k)] = partial(measured, version, last, self.cases, version in self._removed)
        finished = run(calls, executor=self.executor) if self.executor else _one_by_one(calls)
        for n, (name, outcome) in enumerate(finished):
            version = self.versions[int(name)]
            self.progress((n + 1) / len(calls), version.name)
            if isinstance(outcome, UnknownNameError):
                raise outcome
            if isinstance(outcome, Exception):
                self._missing[int(name)] = describe(outcome).removeprefix(f"{version}: ")
            else:
                self._done[int(name)] = outcome

    def _keys(self) -> list[tuple[str, str]]:
        names = [case.name for case in self.cases]
        keys = dict.fromkeys(key for _, x in sorted(self._done.items()) for key in (*x.values, *x.reasons))
        return sorted(keys, key=lambda key: names.index(key[0]))

    def _moved(self, key: tuple[str, str], i: int, j: int) -> float:
        """Return how far a value of version j is from that of i: infinite where one has none, NaN where both."""
        old, new = (self._done[k].values.get(key) for k in (i, j))
        if old is None or new is None:
            return math.nan if old is None and new is None else math.inf
        return self._truths[key[0]].error(key[1], new, old)

    def undecided(self) -> list[int]:
        """Return versions in the middle between two that differ and are not neighbours."""

        def differ(i: int, j: int) -> bool:
            return any(self._moved(key, i, j) > self.tolerance for key in self._keys())

        return middles(self._done, self._missing, differ)

    def result(self, engine: str, settings: Mapping[str, Any]) -> VersionsResult:
        """Return rows and changes."""
        rows, changes, done = [], [], sorted(self._done)
        for key in self._keys():
            before: int | None = None
            errors: dict[int, float] = {}
            for k in done:
                value = self._done[k].values.get(key)
                errors[k] = math.nan if value is None else self._truths[key[0]].error(key[1], value)
                moved = math.nan if before is None else self._moved(key, before, k)
                direction = ""
                if before is not None and moved > self.tolerance:
                    direction = direction_of(errors[before], errors[k])
                    names = self.versions[before].version, self.versions[k].version
                    both = digits_of(errors[before]), digits_of(errors[k])
                    changes.append(Change(*key, *names, *both, direction, k == before + 1))
                ratio = self._done[k].ratios.get(key[0], math.nan)
                reason = self._done[k].reasons.get(key, "")
                apart = moved if math.isfinite(moved) else math.nan
                digits = digits_of(errors[k])
                version = self.versions[k].version
                rows.append(
                    VersionRow(key[0], version, key[1], digits, apart, bool(direction), direction, ratio, reason)
                )
                before = k
        if self._last_removed:
            environment.remove(self.versions[-1].package.distribution, self.versions[-1].version)
        return VersionsResult(
            engine,
            tuple(self.versions[k].version for k in done),
            tuple(rows),
            tuple(changes),
            tuple((self.versions[k].version, self._missing[k]) for k in sorted(self._missing)),
            dict(settings),
            installed_versions(),
            processor(),
            time.perf_counter() - self._start,
        )


def _one_by_one(calls: Mapping[str, Any]) -> Iterable[tuple[str, Measured | Exception]]:
    """Make the calls in this process: what can die or hang has processes of its own."""
    for name, call in calls.items():
        try:
            yield name, call()
        except MbkitError as error:
            yield name, error


def digits_of(error: float) -> float:
    """Return the digits that a relative error leaves right; NaN for NaN."""
    return math.nan if math.isnan(error) else min(_MOST_DIGITS, max(0.0, -math.log10(max(error, 1e-300))))


def direction_of(old: float, new: float) -> str:
    """Return where a number went, by its errors before and after; NaN is no number."""
    if math.isnan(old) or math.isnan(new):
        return REFUSED if math.isnan(new) else GIVEN
    return TOWARDS if new * _CLEAR < old else AWAY if old * _CLEAR < new else ASIDE
