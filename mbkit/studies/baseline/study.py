"""`record`, `check` and `diff`: engines' numbers into a file, and what moved since.

Errors are those of `mbkit.studies.compare.errors`, on the recorded values' own scales, so nothing but the file and an
engine is needed. An engine's own error against 34 digits, measured at recording, says what its rounding is: 16 times
that is allowed, because the error is the worst of a handful of states and another processor rounds elsewhere; and of an
error below 8 eps (`FINE`) 16 times 8 eps, because a handful of states can by chance show almost none. What differed by
more than `ROUNDING` when it was recorded is no rounding; it is held against the engine's own values, to `OWN`.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from mbkit._check import EPS, Array, count
from mbkit.engines import Dynamics, dynamics
from mbkit.engines.oracle import OracleDynamics
from mbkit.engines.registry import ENGINES, REFERENCE, compared, find_engine
from mbkit.engines.remote.dynamics import VersionDynamics
from mbkit.errors import (
    BaselineError,
    KnownDefectWarning,
    MbkitError,
    NumericalError,
    UnknownNameError,
    UnsupportedError,
)
from mbkit.methods.registry import DEFAULT_METHOD
from mbkit.model import Model
from mbkit.model.validation import listing
from mbkit.studies import results
from mbkit.studies._targets import checked_target, engine_names, with_values
from mbkit.studies.baseline import description, file
from mbkit.studies.baseline.description import Change, changes, described, links_of, moving_mass, without_consequences
from mbkit.studies.baseline.file import FRAMES, ROLLOUT, Baseline, Rollout, path_of, read, with_frames
from mbkit.studies.baseline.result import BaselineResult, ChangedNumber, Status, VersionChange
from mbkit.studies.compare.errors import Errors, Scales
from mbkit.studies.compare.terms import TERMS, States, states
from mbkit.studies.explain.hypotheses import turn_of
from mbkit.studies.results import Refusal
from mbkit.studies.study_runs import Progress, quiet_simulate, require_motion, silent

FINE: Final = 8.0 * EPS
ROUNDING: Final = 1e-9
OWN: Final = 1e-12
_ERROR_MARGIN: Final = 16.0
#: An excerpt of a robot's motion, in which rounding does not grow.
_ROLLOUT: Final = Rollout(dt=2e-3, steps=25)
#: Decimals of a state in a file for people: every double of these is its own shortest text.
_STATE_DECIMALS: Final = 6
#: The description and the states come from these, whatever the engine.
_SHARED: Final = ("mbkit", "pin", "numpy")
_ABSENT: Final = "not installed"
#: Shift of a frame, m and rad, by another parser's rounding.
_FRAME_ROUNDING: Final = 1e-12
Versions = tuple[VersionChange, ...]
_OTHER_COORDINATES: Final = "q and v have other joints or another order than recorded, so no number can be compared"


def record(
    model: Model,
    path: str | os.PathLike[str],
    engines: Sequence[str] | None = None,
    *,
    samples: int = 2,
    seed: int = 0,
    target: str = "",
    options: Mapping[str, Any] | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Baseline:
    """Record what engines say of a model, for `check` to hold them against later.

    The file has the model's parameters, every term at a few seeded states, there the pose and the velocity of frames
    that the file names, and the end of a short rollout, by the oracle; how far each engine was from these; and
    versions. The same model, versions and processor give the same bytes.

    Parameters
    ----------
    model : Model
        Whose named parameters have values.
    path : path
        A TOML file; missing folders are created. The baseline of the same model is replaced.
    engines : sequence of str, optional
        By default all that are installed and hold the model.
    samples : int
        Random states, beside which stands one near singular.
    seed : int
    target, options : str and mapping, optional
        What `mbkit baseline check` loads, as `mbkit check` takes it, and how: keyword arguments of `mbkit.load`. A
        function, ``package.module:function``, is loaded only where ``--target`` names it. A file's path is relative to
        the baseline's folder, and begins with a dot. Of a URDF, links that are fixed to each other are recorded each
        by itself then, beside the body that they make.
    force : bool
        Whether to replace whatever file is there.
    progress : callable, optional
        Called as ``progress(fraction, text)``.

    Returns
    -------
    Baseline
        Of which `disagreements` tells where an engine was not right even now.

    Raises
    ------
    UnsupportedError
        An engine that was asked for is not installed, or none holds the model.
    OutputError
        The file cannot be written, or is not this model's to replace; it stays as it was.
    """
    model, where = _checked_model(model), path_of(path)
    names = compared() if engines is None else engine_names(engines)
    count("samples", samples, least=1)
    count("seed", seed)
    checked_target(target, options)
    if not force:
        file.check_replaceable(where, model.name)
    tell = progress or silent
    tell(0.0, "building")
    plain = with_values(model)
    built, refused, missing = _build_engines(plain, names)
    if engines is not None and missing:
        raise UnsupportedError("; ".join(f"{m.engine}: {m.reason}" for m in missing))
    if not built:
        why = "; ".join(f"{r.engine}: {r.reason}" for r in refused)
        raise UnsupportedError(f"no engine holds {model.name}, so there is nothing to record: {why}")
    at = _states(plain, samples, seed)
    tell(0.1, "34 digits")
    described_model = described(model)
    # One that stands where another does says no more.
    frames = tuple(name for name, part in described_model.get("frames", {}).items() if "same_as" not in part)
    terms, absent = evaluate(OracleDynamics(plain), at, _ROLLOUT, frames)
    recorded = Baseline(
        model=model.name,
        digest=model.digest,
        target=target,
        options=dict(options or {}),
        seed=seed,
        processor=results.processor(),
        versions=_versions_of(built),
        description=described_model | links_of(model, target, options or {}, where),
        coordinates=tuple(model.coordinate_names),
        velocities=tuple(model.velocity_names),
        states=at,
        rollout=_ROLLOUT,
        terms=terms,
        errors={name: {} for name in built},
        frames=frames,
    )
    comparator = Comparator(recorded)
    left_out = [*refused, *absent]
    for k, (name, dyn) in enumerate(built.items()):
        tell(0.6 + 0.4 * k / len(built), name)
        values, without = evaluate(dyn, at, _ROLLOUT, frames)
        left_out += [r for r in without if r.term in terms]
        for term in [t for t in values if t in terms]:
            error = comparator.error(term, values[term], terms[term])
            recorded.errors[name][term] = error if error > FINE else 0.0
            if error > ROUNDING:
                recorded.own.setdefault(name, {})[term] = values[term]
    tell(1.0, "done")
    recorded = replace(recorded, left_out=tuple(left_out))
    file.store(where, file.text_of(recorded), model.name, force=force)
    return recorded


def check(
    model: Model,
    path: str | os.PathLike[str],
    *,
    strict: bool = False,
    target: str | None = None,
    progress: Progress | None = None,
) -> BaselineResult:
    """Hold a model and the engines against what was recorded of them.

    First the description: a parameter that changed is named, with its old and new value, and what it does to the
    terms. Else the numbers of every recorded engine, to its own rounding (`mbkit.studies.baseline.study` says how much
    that is). Where these stand, the versions: new ones alone ask whether to record again.

    Parameters
    ----------
    model : Model
    path : path
        What `record` wrote.
    strict : bool
        Whether an engine that was recorded and is not installed or registered fails, instead of being skipped.
    target : str, optional
        What the model was loaded from, where that is not what was recorded.
    progress : callable, optional
        Called as ``progress(fraction, text)``.

    Returns
    -------
    BaselineResult
        With ``passed``, ``verdict``, ``changes``, ``moved``, ``versions`` and ``skipped``.

    Raises
    ------
    BaselineError
        The file is damaged or of another format, or the baseline is another robot's.

    Examples
    --------
    >>> import tempfile, mbkit as mb
    >>> folder = tempfile.TemporaryDirectory()
    >>> path = folder.name + "/pendulum.toml"
    >>> _ = mb.baseline.record(mb.catalog.pendulum(), path, engines=["lagrangian"])
    >>> mb.baseline.check(mb.catalog.pendulum(), path).passed
    True
    >>> print(mb.baseline.check(mb.catalog.pendulum(mass=1.1), path).changes[0].text)
    mass of body bob (with tip fixed to it): 1 → 1.1
    """
    model, where = _checked_model(model), path_of(path)
    checked_target("" if target is None else target)
    recorded = read(where)
    if recorded.model != model.name and not {*model.coordinate_names} & {*recorded.coordinates}:
        raise BaselineError(
            f"{where}: the baseline of another robot: {recorded.model!r} with {listing(recorded.coordinates, 4)}; "
            f"this is {model.name!r} with {listing(model.coordinate_names, 4)}"
        )
    tell = progress or silent
    moved = _version_changes(recorded.versions, _versions_of(recorded.engines))
    processor = results.processor()
    changed = description_changes(recorded, model, recorded.target if target is None else target, where)
    meant = tuple(c for c in changed if not c.rounding)
    if not meant and not moved and processor == recorded.processor:
        # Another parser or processor may round otherwise; neither is another, so somebody wrote another number.
        meant = changed
    result = BaselineResult(
        question="check",
        model=model.name,
        path=os.fspath(path),
        status="description",
        changes=meant,
        versions=moved,
        processors=(recorded.processor, processor),
        strict=strict,
    )
    plain = with_values(model)
    if meant:
        return replace(result, effect=_effect(recorded, plain, meant))
    notes = [f"only rounding: {c.text}" for c in changed]
    if not changed and model.digest != recorded.digest:
        notes = ["the description has another digest, by something that the baseline does not record"]
    tell(0.0, "building")
    built, refused, missing = _build_engines(plain, recorded.engines)
    rows = [_unavailable(recorded, r, moved) for r in refused]
    worst = 0.0
    for k, (name, dyn) in enumerate(built.items()):
        tell(0.1 + 0.9 * k / len(built), name)
        some, error = differences(recorded, name, *evaluated(dyn, recorded), moved)
        rows += some
        worst = max(worst, error)
    tell(1.0, "done")
    if len(built) > 1 and {r.engine for r in rows} == set(built):
        shared = "look at what they share, mbkit itself, before any engine"
        notes.append(f"every engine moved while the description stands: {shared}")
    return replace(
        result,
        status="numbers" if rows else "skipped" if not (built or refused) else "versions" if moved else "same",
        engines=tuple(built),
        moved=tuple(rows),
        skipped=tuple(missing),
        notes=tuple(notes),
        worst=worst,
    )


def diff(path_a: str | os.PathLike[str], path_b: str | os.PathLike[str]) -> BaselineResult:
    """Say what the second of two baselines has that the first has not.

    Nothing is computed: it reads what was recorded. Numbers are the oracle's, so they tell what became of the robot;
    engines' own are compared where they were recorded. The result has all that differs: parameters, numbers, versions.

    Raises
    ------
    BaselineError
        A file cannot be read, or the two are of different robots.
    """
    a, b = read(path_a), read(path_b)
    if a.model != b.model and not set(a.coordinates) & set(b.coordinates):
        raise BaselineError(
            f"{path_a} is a baseline of {a.model!r}, {path_b} of {b.model!r}; they have no joint in common"
        )
    notes: tuple[str, ...] = ()
    same_states = all(np.array_equal(getattr(a.states, x), getattr(b.states, x)) for x in file.VECTORS)
    if a.coordinates != b.coordinates or a.velocities != b.velocities:
        notes = (_OTHER_COORDINATES,)
    elif not same_states or a.rollout != b.rollout:
        states_text = f"seed {a.seed} and {b.seed}, {len(a.states.q)} and {len(b.states.q)} of them"
        notes = (f"the states are others ({states_text}), so no number can be compared",)
    moved = _version_changes(a.versions, b.versions)
    both = tuple(name for name in a.frames if name in b.frames)
    rows = () if notes else _moved_numbers(with_frames(a, both), with_frames(b, both), moved)
    changed = without_consequences(changes(a.description, b.description), a.description)
    status: Status = "description" if changed else "numbers" if rows or notes else "versions" if moved else "same"
    return BaselineResult(
        question="diff",
        model=a.model,
        path=os.fspath(path_a),
        against=os.fspath(path_b),
        status=status,
        engines=tuple(e for e in a.engines if e in b.engines),
        changes=changed,
        moved=rows,
        versions=moved,
        processors=(a.processor, b.processor),
        skipped=tuple(
            Refusal(e, "", f"in {path_a if e in a.engines else path_b} alone")
            for e in dict.fromkeys([*a.engines, *b.engines])
            if (e in a.engines) != (e in b.engines)
        ),
        notes=notes,
    )


def _moved_numbers(a: Baseline, b: Baseline, moved: Versions) -> tuple[ChangedNumber, ...]:
    comparator = Comparator(a)
    rows = [comparator.moved(REFERENCE, t, b.terms[t], x, FINE) for t, x in a.terms.items() if t in b.terms]
    for engine, terms in a.own.items():
        for term, x in terms.items():
            y = b.own.get(engine, {}).get(term)
            if y is None and term in b.errors.get(engine, {}):
                y = b.terms[term]
            if y is not None:
                rows.append(comparator.moved(engine, term, y, x, OWN, _cause(engine, a.versions, moved)))
    return tuple(row for row in rows if row is not None)


# The model, its states, and engines on them.


def _checked_model(model: object) -> Model:
    checked = require_motion(model, "record")
    checked.require_values("a baseline")
    return checked


def _states(model: Model, samples: int, seed: int) -> States:
    """Return `samples` random states, and one that is near singular, of few decimals."""
    drawn = states(model, samples, seed)
    # Limits act on no term, and at zero axes are aligned as they are near singular: a file is read by people.
    which = [*range(samples), *[k for k, kind in enumerate(drawn.kinds) if kind == "near singular"][:1]]
    q, v, a, tau = (x[which] for x in (drawn.q, drawn.v, drawn.a, drawn.tau))
    a, tau = (np.round(x, _STATE_DECIMALS // 2) + 0.0 for x in (a, tau))
    if not model.constrained:
        # Rounded, a state would be off the constraints, and a quaternion off its unit length.
        exact = np.zeros(model.nq, dtype=bool)
        for start, _ in model.quaternions:
            exact[start : start + 4] = True
        q = np.where(exact, q, np.round(q, _STATE_DECIMALS)) + 0.0
        v = np.round(v, _STATE_DECIMALS // 2) + 0.0
    return States(q, v, a, tau, tuple(drawn.kinds[k] for k in which))


def _build_engines(model: Model, names: Iterable[str]) -> tuple[dict[str, Dynamics], list[Refusal], list[Refusal]]:
    """Return the engines that hold a model, those that refuse it, and those that are not there."""
    engines: dict[str, Dynamics] = {}
    refused: list[Refusal] = []
    missing: list[Refusal] = []
    for name in names:
        try:
            engines[name] = dynamics(model, name, **find_engine(name).brief)
        except UnknownNameError:
            missing.append(Refusal(name, "", "not registered; import the module that registers it"))
        except MbkitError as error:
            if isinstance(error.__cause__, ModuleNotFoundError):
                missing.append(Refusal(name, "", f"not installed; pip install {find_engine(name).package}"))
            else:
                refused.append(Refusal.of(name, error))
    return engines, refused, missing


def evaluate(
    dyn: Dynamics, at: States, rollout: Rollout, frames: Sequence[str] = ()
) -> tuple[dict[str, Array], list[Refusal]]:
    """Return every term that an engine gives, and why it does not give the others."""
    values: dict[str, Array] = {}
    refusals = []
    calls: dict[str, Any] = {term.name: partial(term.call, dyn, at) for term in TERMS}
    calls[ROLLOUT] = partial(_rollout_end, dyn, at, rollout)
    if frames:
        calls[FRAMES] = partial(_frames_at, dyn, at, list(frames))
    with warnings.catch_warnings(action="ignore", category=KnownDefectWarning):
        # A defect that was there before is recorded, and no news.
        for name, call in calls.items():
            try:
                values[name] = call()
            except MbkitError as error:
                refusals.append(Refusal.of(dyn.engine, error, name))
    return values, refusals


def evaluated(dyn: Dynamics, recorded: Baseline) -> tuple[dict[str, Array], list[Refusal]]:
    """Return what `evaluate` does at a baseline's states."""
    return evaluate(dyn, recorded.states, recorded.rollout, recorded.frames)


def _frames_at(dyn: Dynamics, at: States, frames: Sequence[str]) -> Array:
    """Return of each frame the three rows of X_WF, and J v in the world's axes, (n, k, 18)."""
    X = dyn.pose(at.q, frames)[..., :3, :]
    return np.concatenate([X.reshape(*X.shape[:-2], 12), dyn.velocity(at.q, at.v, frames)], axis=-1)


def _rollout_end(dyn: Dynamics, at: States, rollout: Rollout) -> Array:
    """Return q and v at the end of a rollout from the first state, one after the other."""
    # MuJoCo's own steps make a mimic joint a soft equality, which is another system.
    # The same formula everywhere, by an engine's own steps where it has them.
    if isinstance(dyn, VersionDynamics):
        if dyn.runs and not dyn.model.layout.reduced:
            q, v = dyn.rollout(at.q[0], at.v[0], rollout.dt, rollout.steps)
            return np.concatenate([q[-1], v[-1]])
        method = DEFAULT_METHOD
    else:
        method = DEFAULT_METHOD if dyn.model.layout.reduced else find_engine(dyn.engine).rk4
    run = quiet_simulate(dyn, at.q[0], at.v[0], rollout.dt * rollout.steps, method, rollout.dt)
    if run.stats.ended != "finished":
        raise NumericalError(f"{dyn.engine}: {method}: {run.stats.message}")
    return np.concatenate([run.q[-1], run.v[-1]])


# Numbers against recorded ones.


class Comparator:
    """Measures values of any term against others, on the scales of a baseline's values."""

    def __init__(self, b: Baseline) -> None:
        mass, gravity = moving_mass(b.description)
        acting = np.abs(b.states.tau) + sum(np.abs(b.terms[name]) for name in ("nle", "passive") if name in b.terms)
        weight = float(np.linalg.norm(gravity)) * float(np.sqrt(mass))
        self._scales = Scales.of(b.terms["M"], b.states.v, acting, weight)
        self._measures = {t.name: t.errors for t in TERMS}
        self._velocities, self._split = b.velocities, len(b.coordinates)
        self._ends = [f"q of {n}" for n in b.coordinates] + [f"v of {n}" for n in b.velocities]
        self._states = [f"{kind} state {k + 1}" for k, kind in enumerate(b.states.kinds)]
        self._frames = b.frames

    def errors(self, term: str, value: Array, reference: Array) -> Errors:
        """Measure a term's values; of a rollout's end q and v each relative to their size, rad, m and s or more.

        Of frames, rotations are as large as 1, and what else there is as the largest of its kind.
        """
        if term == FRAMES:
            size = np.ones(18)
            for kind in ([3, 7, 11], [12, 13, 14], [15, 16, 17]):
                size[kind] = np.abs(reference[..., kind]).max(initial=0.0) or 1.0
            e = np.abs(value - reference)
            return Errors(e.max(axis=(1, 2)), (e / size).max(axis=(1, 2)), (e / size).max(axis=(0, 2)))
        if term != ROLLOUT:
            return self._measures[term](value - reference, reference, self._scales)
        e, ends = np.abs(value - reference), np.split(reference, [self._split])
        size = np.concatenate([np.full(len(x), max(1.0, float(np.abs(x).max()))) for x in ends])
        return Errors(e.max(keepdims=True), (e / size).max(keepdims=True), e / size)

    def error(self, term: str, value: Array, reference: Array) -> float:
        """Return a term's largest error."""
        return float(np.max(self.errors(term, value, reference).relative))

    def moved(
        self, engine: str, term: str, value: Array, reference: Array, allowed: float, cause: str = "", reason: str = ""
    ) -> ChangedNumber | None:
        """Return where a term is off by more than allowed, or None."""
        errors = self.errors(term, value, reference)
        error = float(errors.relative[errors.worst])
        if error <= allowed:
            return None
        off, per = np.abs(value - reference), errors.per_velocity
        joint, state = "", self._states[errors.worst] if term != ROLLOUT else ""
        index: tuple[int, ...] = (errors.worst,)
        if per.size:
            j = int(np.argmax(per))
            names = {ROLLOUT: self._ends, FRAMES: self._frames}.get(term, self._velocities)
            joint, index = names[j], (j,)
            if off.ndim > 1:
                n, *more = (int(x) for x in np.unravel_index(np.argmax(off[:, j]), off[:, j].shape))
                state, index = self._states[n], (n, j, *more)
                if term != FRAMES:
                    joint += "".join(f", {self._velocities[i]}" for i in more if i != j)
        numbers = float(reference[index]), float(value[index])
        return ChangedNumber(term, engine, joint, state, *numbers, error, allowed, cause, reason)


def _allowed(baseline: Baseline, engine: str, term: str) -> float:
    if term in baseline.own.get(engine, {}):
        return OWN
    recorded = baseline.errors[engine][term]
    if term == ROLLOUT:
        # Rounding grows along a motion, by what only the motion tells: the worst of all engines.
        recorded = max(e[term] for e in baseline.errors.values() if e.get(term, np.inf) <= ROUNDING)
    return _ERROR_MARGIN * max(recorded, FINE)


def differences(
    recorded: Baseline, name: str, values: Mapping[str, Array], refusals: Iterable[Refusal], moved: Versions = ()
) -> tuple[list[ChangedNumber], float]:
    """Return one engine's changed numbers, and the worst error of the unchanged ones."""
    comparator = Comparator(recorded)
    before, own = recorded.errors[name], recorded.own.get(name, {})
    rows = [_unavailable(recorded, r, moved) for r in refusals if r.term in before]
    worst = 0.0
    cause = _cause(name, recorded.versions, moved)
    for term in [t for t in values if t in before]:
        value, oracle = values[term], recorded.terms[term]
        reference = own.get(term, oracle)
        reason = ""
        if term in own:
            # It was wrong when recorded, and may be right now.
            error = comparator.error(term, value, oracle)
            reason = f"it differed from the oracle by {before[term]:.1e} when recorded, and by {error:.1e} now"
            if error <= ROUNDING:
                differed = f"which it differed from by {before[term]:.1e} when recorded"
                reason = f"right now: {error:.1e} from the oracle, {differed}"
        row = comparator.moved(name, term, value, reference, _allowed(recorded, name, term), cause, reason)
        if row is None:
            worst = max(worst, comparator.error(term, value, reference))
        else:
            rows.append(row)
    return rows, worst


def _unavailable(recorded: Baseline, refusal: Refusal, moved: Versions) -> ChangedNumber:
    """Return the failure of an engine that gives no number any more."""
    cause = _cause(refusal.engine, recorded.versions, moved)
    numbers = np.nan, np.nan, np.inf, 0.0
    return ChangedNumber(
        refusal.term or "everything", refusal.engine, "", "", *numbers, cause, f"no longer: {refusal.reason}"
    )


# The description and the versions against recorded ones.


def description_changes(recorded: Baseline, model: Model, target: str, path: Path) -> tuple[Change, ...]:
    """Return what differs in the descriptions, by the links' own names where a file tells them."""
    if model.digest == recorded.digest:
        # A file may be older than a section of descriptions.
        return ()
    old, new = recorded.description, described(model)
    changed = changes({k: x for k, x in old.items() if k not in description.LINK_SECTIONS}, new)
    if not changed or "links" not in old:
        return changed
    links = links_of(model, target, recorded.options, path)
    return without_consequences(changes(old, new | links), old) if links else changed


def _effect(recorded: Baseline, model: Model, changed: tuple[Change, ...]) -> str:
    """Return what a changed description does to the terms, by the first engine at hand."""
    if tuple(model.coordinate_names) != recorded.coordinates or tuple(model.velocity_names) != recorded.velocities:
        return _OTHER_COORDINATES
    if all(c.section == "expressions" for c in changed):
        return ""
    for name in recorded.engines:
        for dyn in _build_engines(model, [name])[0].values():
            rows = [r for r in differences(recorded, name, *evaluated(dyn, recorded))[0] if np.isfinite(r.error)]
            frames = _moved_frames(recorded, model)
            if all(r.term == FRAMES for r in rows) and (frames or not rows):
                return (
                    f"{frames}, with their Jacobians; no other term moves ({name})"
                    if frames
                    else f"no term moves ({name})"
                )
            worst = max(rows, key=lambda r: r.error)
            at = f" at {worst.joint}" if worst.joint else ""
            most = f"{worst.term}{at} most, by {worst.error:.1e} ({name})"
            more = f"; {frames}, with their Jacobians" if frames else ""
            return f"moves {len(rows)} of {len(recorded.errors[name])} terms, {most}{more}"
    return ""


def _moved_frames(recorded: Baseline, model: Model) -> str:
    """Return how far the poses of named frames moved on their bodies, renamed or not; empty where none did."""
    carried = {part["child"]: name for name, part in recorded.description.get("joints", {}).items()}
    bodies = {j.name: j.child for j in model.joints}
    far: dict[str, tuple[float, float]] = {}
    old, new = recorded.description.get("frames", {}), described(model).get("frames", {})
    for name in [n for n in old if n in new]:
        before, after = (_placed(side, name) for side in (old, new))
        if bodies.get(carried.get(before[0], ""), before[0]) != after[0]:
            far[name] = np.inf, np.inf
        turn = turn_of(before[2].T @ after[2])
        moved = float(np.linalg.norm(after[1] - before[1])), float(np.linalg.norm(turn))
        if max(moved) > _FRAME_ROUNDING:
            far.setdefault(name, moved)
    if not far:
        return ""
    most = max(far, key=far.__getitem__)
    by, about = far[most]
    how = "which is on another body" if np.isinf(by) else f"by {by:.3g} m and {about:.3g} rad"
    return f"moves the pose of {len(far)} frame{'s' * (len(far) > 1)}, {most} most, {how}"


def _placed(frames: Mapping[str, Mapping[str, Any]], name: str) -> tuple[str, Array, Array]:
    """Return body, translation and rotation of a recorded frame, also of one that stands where another does."""
    part = frames[frames[name].get("same_as", name)]
    translation = np.array(part.get("translation", np.zeros(3)), dtype=np.float64)
    return part["body"], translation, np.array(part.get("rotation", np.eye(3)), dtype=np.float64).reshape(3, 3)


def package_of(engine: str) -> str:
    """Return the package whose version can move an engine's numbers."""
    return (ENGINES[engine].distribution if engine in ENGINES else "") or "mbkit"


def _versions_of(engines: Iterable[str]) -> dict[str, str]:
    now = results.versions()
    return {p: now[p] for p in dict.fromkeys([*_SHARED, *map(package_of, engines)])}


def _version_changes(old: Mapping[str, str], new: Mapping[str, str]) -> Versions:
    """Return the packages whose versions differ; a missing package has no version."""
    return tuple(VersionChange(p, x, new[p]) for p, x in old.items() if new.get(p, _ABSENT) not in (x, _ABSENT))


def _cause(engine: str, old: Mapping[str, str], changed: Iterable[VersionChange]) -> str:
    """Return which version of an engine moved, or that none did, for a failure."""
    package = package_of(engine)
    own = [str(m) for m in changed if m.package == package]
    others = [str(m) for m in changed if m.package in _SHARED and m.package != package]
    return "; ".join([*(own or [f"{package} {old.get(package, '?')}, as recorded"]), *others])
