"""One version of an engine measured: its values at the states of each robot, and its time beside the last version's."""

from __future__ import annotations

import contextlib
import math
import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import EngineVersion, dynamics
from mbkit.engines.oracle import OracleDynamics
from mbkit.engines.registry import DERIVED, REFERENCE
from mbkit.engines.versions import environment, process
from mbkit.engines.versions.dynamics import VersionDynamics
from mbkit.engines.versions.importer import VersionImport
from mbkit.errors import KnownDefectWarning, MbkitError
from mbkit.load.sanitized_text import strip
from mbkit.methods.registry import ADAPTIVE_METHOD
from mbkit.model import Model
from mbkit.simulate import simulate
from mbkit.studies._targets import model_of, with_values
from mbkit.studies.compare.errors import Scales
from mbkit.studies.compare.terms import TERMS, States, Term, states
from mbkit.studies.study_runs import free_of_mimic, start_state
from mbkit.studies.worker import describe

#: Terms of a file that its parser and the engine's functions make together, and their quantities.
_OF_FILE: Final = {"M": "mass_matrix", "g": "gravity", "nle": "nle"}
#: Before the name of a term of the version's own parser.
FILE: Final = "file "
#: The state after a short run by the engine's own Runge-Kutta method, and that run's step, s, and steps.
RUN, _DT, _STEPS = "own RK4", 2e-2, 5
#: Of the truth of that run.
_RTOL: Final = 1e-13
#: Times that the two versions are timed in turn.
_ROUNDS: Final = 3


@dataclass(frozen=True)
class Case:
    """A robot at its states; `text` is its file, without references, where it has one."""

    name: str
    model: Model
    at: States
    text: str = ""
    format: str = ""

    @property
    def start(self) -> tuple[Array, Array]:
        """Where the short run begins."""
        return start_state(self.model, 0)


@dataclass
class Measured:
    """Values by robot and term, or the reason why a value is missing; times over the last version's by robot."""

    values: dict[tuple[str, str], Array] = field(default_factory=dict)
    reasons: dict[tuple[str, str], str] = field(default_factory=dict)
    ratios: dict[str, float] = field(default_factory=dict)


def case_of(target: str | Model, samples: int, seed: int) -> Case:
    """Return a target at its states, with the text of its file where that can be compared joint by joint."""
    given = target if isinstance(target, Model) else model_of(target)
    model, text, format_ = with_values(given, "versions"), "", ""
    if model.source and os.path.isfile(model.source) and all(j.type.nv <= 1 for j in model.joints):
        stripped = strip(Path(model.source))
        if not stripped.meshes:
            text, format_ = stripped.text, stripped.format
    name = target if isinstance(target, str) else model.name
    return Case(name, model, states(model, samples, seed), text, format_)


# In a process of any executor.


def measured(version: EngineVersion, last: EngineVersion, cases: tuple[Case, ...], remove: bool) -> Measured:
    """Return a version's values and reasons; raises where it has no environment or no process.

    The environment is removed afterwards where `remove` says so.
    """
    version.interpreter()
    out = Measured()
    try:
        for case in cases:
            for term, value in _values(version, case):
                key = case.name, term
                if isinstance(value, str):
                    out.reasons[key] = value
                else:
                    out.values[key] = value
            with contextlib.suppress(MbkitError):
                out.ratios[case.name] = _time_ratio(version, last, case)
    finally:
        process.end(version)
        if remove:
            environment.remove(version.package.distribution, version.version)
    return out


def _values(version: EngineVersion, case: Case) -> Iterator[tuple[str, Array | str]]:
    """Yield each term's values at all states, or why there are none."""
    try:
        dyn = dynamics(case.model, version)
    except MbkitError as error:
        yield from ((term.name, _why(version, error)) for term in TERMS)
    else:
        for term in TERMS:
            # What differs from the last version is told, wrong or not.
            with warnings.catch_warnings(action="ignore", category=KnownDefectWarning):
                try:
                    value: Array | str = term.call(dyn, case.at)
                except MbkitError as error:
                    value = _why(version, error)
            yield term.name, value
        assert isinstance(dyn, VersionDynamics)
        if dyn.runs:
            try:
                yield RUN, _end_of_run(dyn, case)
            except MbkitError as error:
                yield RUN, _why(version, error)
    if not case.text:
        return
    at, free = file_states(case)
    try:
        read = VersionImport(version, case.text, case.format, free)
        for name, quantity in _OF_FILE.items():
            yield FILE + name, read.term(quantity, at.q, at.v)
    except MbkitError as error:
        yield from ((FILE + name, _why(version, error)) for name in _OF_FILE)


def _why(version: EngineVersion, error: MbkitError) -> str:
    return describe(error).removeprefix(f"{version}: ")


def _end_of_run(dyn: VersionDynamics, case: Case) -> Array:
    """Return the state after the short run, as one row: q and v."""
    q, v = dyn.rollout(*case.start, dt=_DT, steps=_STEPS)
    return np.concatenate([q[-1], v[-1]])[None, :]


def _time_ratio(version: EngineVersion, last: EngineVersion, case: Case) -> float:
    """Return the time of a forward dynamics over that of the last version, each the shortest of rounds in turn."""
    if version == last:
        return 1.0
    best = [math.inf, math.inf]
    pair = [dynamics(case.model, x) for x in (version, last)]
    for _ in range(_ROUNDS):
        for k, dyn in enumerate(pair):
            assert isinstance(dyn, VersionDynamics)
            best[k] = min(best[k], dyn.seconds(case.at.q[0], case.at.v[0]))
    return best[0] / best[1]


# The truth, once for all versions.


def file_states(case: Case) -> tuple[States, Model]:
    """Return the states at which the file is compared, and the description with its mimic joints free."""
    if not case.model.layout.reduced:
        return case.at, case.model
    free = free_of_mimic(case.model)
    return states(free, len(case.at.q), 0), free


class Truth:
    """The oracle's values of a robot, and errors against them."""

    def __init__(self, case: Case) -> None:
        self._case = case
        self._end: Array | None = None
        self._parts: dict[str, tuple[Term, tuple[Array, Array], Scales]] = {}

    def error(self, name: str, value: Array, other: Array | None = None) -> float:
        """Return the largest relative error of a term's values, or how far they are from others."""
        if name == RUN:
            return self._run_error(value, other)
        if name not in self._parts:
            self._parts[name] = self._of_term(name)
        term, (high, low), scales = self._parts[name]
        e = (value - high) - low if other is None else value - other
        return float(np.max(term.errors(e, high, scales).relative, initial=0.0))

    def _of_term(self, name: str) -> tuple[Term, tuple[Array, Array], Scales]:
        case = self._case
        term = next(t for t in TERMS if t.name == name.removeprefix(FILE))
        at, model = file_states(case) if name.startswith(FILE) else (case.at, case.model)
        oracle = dynamics(model, REFERENCE)
        assert isinstance(oracle, OracleDynamics)
        acting = np.abs(at.tau) + np.abs(oracle.nle(at.q, at.v)) + np.abs(oracle.passive(at.q, at.v))
        heavy = float(np.linalg.norm(model.gravity)) * model.mass**0.5
        scales = Scales.of(oracle.mass_matrix(at.q), at.v, acting, heavy)
        return term, term.reference(oracle, at), scales

    def _run_error(self, value: Array, other: Array | None) -> float:
        model = self._case.model
        if self._end is None:
            run = simulate(
                dynamics(model, DERIVED), *self._case.start, _DT * _STEPS, method=ADAPTIVE_METHOD, rtol=_RTOL
            )
            self._end = np.concatenate([run.q[-1], run.v[-1]])[None, :]
        there = self._end if other is None else other
        n = model.nq
        apart = np.concatenate([model.difference(there[0, :n], value[0, :n]), (value - there)[0, n:]])
        return float(np.linalg.norm(apart) / max(1.0, float(np.linalg.norm(self._end))))
