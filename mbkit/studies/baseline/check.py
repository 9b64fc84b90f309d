"""`check`: is everything still as it was recorded; and if not, what moved."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.registry import REFERENCE
from mbkit.errors import BaselineError
from mbkit.model import Model
from mbkit.studies import results
from mbkit.studies._checkpoint import Progress, silent
from mbkit.studies._targets import checked_target, with_values
from mbkit.studies.baseline import tolerance
from mbkit.studies.baseline.description import LINK_SECTIONS, Change, changes, described, links_of, without_consequences
from mbkit.studies.baseline.file import Baseline, path_of, read
from mbkit.studies.baseline.record import build_engines, checked_model, evaluate
from mbkit.studies.baseline.result import BaselineResult, Status
from mbkit.studies.baseline.tolerance import FINE, OWN, ROUNDING, Comparator, Moved, VersionChange, allowed
from mbkit.studies.results import Refusal

_NAN = float("nan")


def check(
    model: Model,
    path: str | os.PathLike[str],
    *,
    strict: bool = False,
    target: str | None = None,
    progress: Progress | None = None,
) -> BaselineResult:
    """Hold a model and the engines against what was recorded of them.

    First the description: a parameter that changed is named, with its old and new value,
    and what it does to the terms. Where there is none, the numbers of every recorded engine, to
    its own rounding (`mbkit.studies.baseline.tolerance` says how much that is). Where these stand,
    the versions: new ones alone ask whether to record again.

    Parameters
    ----------
    model : Model
    path : path
        What `record` wrote.
    strict : bool
        Whether an engine that was recorded and is not installed fails, instead of being skipped.
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
    InputError
        For unusable arguments.

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
    model = checked_model(model)
    checked_target("" if target is None else target)
    recorded = read(path)
    _require_same_robot(recorded, model, os.fspath(path_of(path)))
    tell = progress or silent
    now = tolerance.relevant(recorded.engines)
    moved_versions = tolerance.moved(recorded.versions, now)
    processor = results.processor()
    result = BaselineResult(
        question="check",
        model=model.name,
        path=os.fspath(path),
        status="same",
        engines=recorded.engines,
        versions=moved_versions,
        processors=(recorded.processor, processor),
        strict=strict,
    )
    changed = _changes(recorded, model, recorded.target if target is None else target, path_of(path))
    meant = tuple(c for c in changed if not c.rounding)
    if not meant and not moved_versions and processor == recorded.processor:
        # Another parser or processor may round otherwise; neither is another, so somebody wrote another number.
        meant = changed
    notes = tuple(f"only rounding: {c.text}" for c in changed if c not in meant)
    if not changed and model.digest != recorded.digest:
        notes = ("the digest is another, though no parameter is",)
    plain = with_values(model)
    if meant:
        return replace(result, status="description", changes=meant, effect=_effect(recorded, plain, meant), engines=())
    tell(0.0, "building")
    built, refused, missing = build_engines(plain, recorded.engines)
    rows = [_engine_unavailable(recorded, r, moved_versions) for r in refused]
    worst = 0.0
    comparator = Comparator.of(recorded)
    for k, (name, dyn) in enumerate(built.items()):
        tell(0.1 + 0.9 * k / len(built), name)
        some, error = _differences(recorded, comparator, name, dyn, moved_versions)
        rows += some
        worst = max(worst, error)
    tell(1.0, "done")
    return replace(
        result,
        status="numbers" if rows else "skipped" if not (built or refused) else "versions" if moved_versions else "same",
        engines=tuple(built),
        moved=tuple(rows),
        skipped=tuple(missing),
        notes=(*notes, *_shared(rows, built)),
        worst=worst,
    )


def _changes(recorded: Baseline, model: Model, target: str, path: Path) -> tuple[Change, ...]:
    """Return what differs in the descriptions, by the links' own names where a file tells them."""
    old, new = recorded.description, described(model)
    changed = changes({k: x for k, x in old.items() if k not in LINK_SECTIONS}, new)
    if not changed or "links" not in old:
        return changed
    links = links_of(model, target, recorded.options, path)
    return without_consequences(changes(old, new | links), old) if links else changed


def _require_same_robot(recorded: Baseline, model: Model, path: str) -> None:
    ours, theirs = set(model.coordinate_names), set(recorded.coordinates)
    if recorded.model == model.name or ours & theirs:
        return
    raise BaselineError(
        f"{path}: the baseline of another robot: {recorded.model!r} with {_joints(recorded.coordinates)}; "
        f"this is {model.name!r} with {_joints(model.coordinate_names)}"
    )


def _joints(names: Iterable[str]) -> str:
    names = list(names)
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def _differences(
    recorded: Baseline, comparator: Comparator, name: str, dyn: Dynamics, moved: tuple[VersionChange, ...]
) -> tuple[list[Moved], float]:
    """Return what is not as recorded of one engine, and the worst error of what is."""
    values, refusals = evaluate(dyn, recorded.states, recorded.rollout)
    cause = tolerance.of_engine(name, recorded.versions, moved)
    rows = [_engine_unavailable(recorded, r, moved) for r in refusals if r.term in recorded.errors[name]]
    worst = 0.0
    for term, value in values.items():
        if term not in recorded.errors[name]:
            continue
        own = recorded.own.get(name, {}).get(term)
        reference = recorded.terms[term] if own is None else own
        row = comparator.moved(name, term, value, reference, allowed(recorded, name, term))
        if row is None:
            worst = max(worst, float(comparator.errors(term, value, reference).relative.max()))
        else:
            rows.append(replace(row, cause=cause, reason=_explain_fixed(recorded, comparator, name, term, value)))
    return rows, worst


def _explain_fixed(recorded: Baseline, comparator: Comparator, name: str, term: str, value: Array) -> str:
    """Return what to say of a term that was wrong when recorded."""
    if term not in recorded.own.get(name, {}):
        return ""
    error = float(comparator.errors(term, value, recorded.terms[term]).relative.max())
    before = recorded.errors[name][term]
    if error <= ROUNDING:
        return f"right now: {error:.1e} from the oracle, which it differed from by {before:.1e} when recorded"
    return f"it differed from the oracle by {before:.1e} when recorded, and by {error:.1e} now"


def _engine_unavailable(recorded: Baseline, refusal: Refusal, moved: tuple[VersionChange, ...]) -> Moved:
    """Return the failure of an engine that gives no number any more."""
    cause = tolerance.of_engine(refusal.engine, recorded.versions, moved)
    term = refusal.term or "everything"
    return Moved(term, refusal.engine, "", "", _NAN, _NAN, np.inf, 0.0, cause, f"no longer: {refusal.reason}")


def _shared(rows: list[Moved], built: dict[str, Dynamics]) -> tuple[str, ...]:
    """Return what follows where all engines moved alike."""
    if len(built) < 2 or {r.engine for r in rows} != set(built):
        return ()
    return (
        "every engine moved while the description stands: look at what they share, mbkit itself, before any engine",
    )


def _effect(recorded: Baseline, model: Model, changed: tuple[Change, ...]) -> str:
    """Return what a changed description does to the terms, by the first engine at hand."""
    if tuple(model.coordinate_names) != recorded.coordinates or tuple(model.velocity_names) != recorded.velocities:
        return "the coordinates are others, so no number can be compared"
    if all(c.section == "expressions" for c in changed):
        return ""
    for name in recorded.engines:
        built, _, _ = build_engines(model, [name])
        if not built:
            continue
        rows, _ = _differences(recorded, Comparator.of(recorded), name, built[name], ())
        rows = [r for r in rows if np.isfinite(r.error)]
        if not rows:
            return f"no term moves ({name})"
        worst = max(rows, key=lambda r: r.error)
        at = f" at {worst.joint}" if worst.joint else ""
        most = f"{worst.term}{at} most, by {worst.error:.1e} ({name})"
        return f"moves {len(rows)} of {len(recorded.errors[name])} terms, {most}"
    return ""


# `diff`: what two baselines differ in.


def diff(path_a: str | os.PathLike[str], path_b: str | os.PathLike[str]) -> BaselineResult:
    """Say what the second of two baselines has that the first has not.

    Nothing is computed: it reads what was recorded. Numbers are the oracle's, so they tell what
    became of the robot; engines' own are compared where they were recorded.

    Parameters
    ----------
    path_a, path_b : path

    Returns
    -------
    BaselineResult
        With all that differs: parameters, numbers and versions.

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
    notes = _notes(a, b)
    rows = [] if notes else _rows(a, b)
    changed = without_consequences(changes(a.description, b.description), a.description)
    moved = tolerance.moved(a.versions, b.versions)
    status: Status = "description" if changed else "numbers" if rows or notes else "versions" if moved else "same"
    return BaselineResult(
        question="diff",
        model=a.model,
        path=os.fspath(path_a),
        against=os.fspath(path_b),
        status=status,
        engines=tuple(e for e in a.engines if e in b.engines),
        changes=changed,
        moved=tuple(rows),
        versions=moved,
        processors=(a.processor, b.processor),
        skipped=tuple(
            Refusal(e, "", f"in {path_a if e in a.engines else path_b} alone")
            for e in dict.fromkeys([*a.engines, *b.engines])
            if (e in a.engines) != (e in b.engines)
        ),
        notes=tuple(notes),
    )


def _notes(a: Baseline, b: Baseline) -> list[str]:
    """Return why numbers cannot be compared."""
    if a.coordinates != b.coordinates or a.velocities != b.velocities:
        return ["the coordinates are others, so no number can be compared"]
    same = all(np.array_equal(getattr(a.states, x), getattr(b.states, x)) for x in ("q", "v", "a", "tau"))
    if same and a.rollout == b.rollout:
        return []
    return [
        f"the states are others (seed {a.seed} and {b.seed}, {len(a.states.q)} and {len(b.states.q)} of them), "
        "so no number can be compared"
    ]


def _rows(a: Baseline, b: Baseline) -> list[Moved]:
    comparator = Comparator.of(a)
    moved = tolerance.moved(a.versions, b.versions)
    rows = []
    for term, x in a.terms.items():
        if term in b.terms and (row := comparator.moved(REFERENCE, term, b.terms[term], x, FINE)):
            rows.append(row)
    for engine, terms in a.own.items():
        for term, x in terms.items():
            y = b.own.get(engine, {}).get(term)
            if y is None and term in b.errors.get(engine, {}):
                y = b.terms[term]
            if y is not None and (row := comparator.moved(engine, term, y, x, OWN)):
                rows.append(replace(row, cause=tolerance.of_engine(engine, a.versions, moved)))
    return rows
