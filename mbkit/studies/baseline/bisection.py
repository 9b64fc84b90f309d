"""`bisect`: the version of an engine, or the commit of the description, at which a failing baseline began to fail.

What fails now is looked for in each of a line of versions or commits, from where it is as recorded to the present.
Between two neighbours that differ in it the middle is examined next (`mbkit.studies.versions.study.middles`), so that
several changes are found, each at its own place.
"""

from __future__ import annotations

import math
import os
import sys
import warnings
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

import numpy as np

from mbkit.engines import EngineVersion, dynamics
from mbkit.engines import engine as named_version
from mbkit.engines.versions import process
from mbkit.engines.versions.engine_version import PACKAGES, made_of, order_of, versions_of
from mbkit.errors import MbkitError, MbkitWarning, UnsupportedError
from mbkit.load import load
from mbkit.model import Model
from mbkit.studies._checkpoint import Progress, silent
from mbkit.studies._targets import checked_target, resolved_options, with_values
from mbkit.studies.baseline.description import Change
from mbkit.studies.baseline.file import Baseline, path_of, read
from mbkit.studies.baseline.history import Commit, History
from mbkit.studies.baseline.result import BaselineResult, BisectResult, ChangedNumber, Examined, Onset
from mbkit.studies.baseline.study import Comparator, check, description_changes, differences, evaluated, package_of
from mbkit.studies.results import Refusal
from mbkit.studies.versions.study import digits_of, direction_of, middles
from mbkit.studies.worker import describe

_AS_RECORDED: Final = "as recorded"
_PRESENT: Final = "the files as they are"

Item = TypeVar("Item", EngineVersion, Commit | None)
#: What fails: a term, or a section, part and field of the description.
Failures = Mapping[Hashable, Any]


def bisect(
    model: Model,
    path: str | os.PathLike[str],
    *,
    target: str | None = None,
    options: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> BisectResult:
    """Find where what fails of a baseline began: the version of an engine, or the commit of the description.

    Where `check` finds another description, the commits of its file in git are searched, from the one that has the
    baseline, or the latest that is as recorded. Else the versions of each engine whose numbers moved, from the
    recorded one to the installed one, each in an environment of its own as `mbkit.engine` makes them; what that takes
    is said on stderr before it begins.

    Parameters
    ----------
    model : Model
    path : path
        What `record` wrote.
    target, options : str and mapping, optional
        What the model was loaded from, and how, where that is not what was recorded.
    progress : callable, optional
        Called as ``progress(fraction, text)``.

    Returns
    -------
    BisectResult
        With ``onsets``: for each the first version or commit that fails, the last that does not, and what began there.
        ``notes`` say what could not be examined. A baseline that passes has no onsets.

    Raises
    ------
    BaselineError
        The file is damaged or of another format, or the baseline is another robot's.

    Notes
    -----
    A commit that came with a merge is looked for inside of it. A change that was undone and made again is found at its
    last beginning. Of engines' changes, those between states of the baseline are not seen.

    Examples
    --------
    >>> import tempfile, mbkit as mb
    >>> folder = tempfile.TemporaryDirectory()
    >>> path = folder.name + "/pendulum.toml"
    >>> _ = mb.baseline.record(mb.catalog.pendulum(), path, engines=["lagrangian"])
    >>> mb.baseline.bisect(mb.catalog.pendulum(mass=1.1), path).notes
    ('pendulum was made in Python, so it has no file whose commits could be examined',)
    """
    tell = progress or silent
    checked_target("" if target is None else target, options)
    outcome = check(model, path, target=target, progress=lambda share, text: tell(0.1 * share, text))
    result = BisectResult(outcome.model, outcome.path, outcome)
    if outcome.passed:
        return result
    recorded, where = read(path), path_of(path)
    given = recorded.options if target is None else (options or {})
    if outcome.status == "description":
        return _by_commits(result, model, recorded, where, resolved_options(given, where), tell)
    if outcome.status == "skipped":
        return replace(result, notes=tuple(f"{r.engine}: {r.reason}" for r in outcome.skipped))
    return _by_versions(result, with_values(model), recorded, tell)


class _Search(Generic[Item]):
    """A line of versions or commits, what fails at those that were examined, and why others could not be."""

    def __init__(
        self, items: Sequence[Item], examine: Callable[[Item], Failures], tell: Callable[[int, str], object]
    ) -> None:
        self.items: Sequence[Item] = items
        self._examine: Callable[[Item], Failures] = examine
        self._tell = tell
        self.failures: dict[int, Failures] = {}
        self.missing: dict[int, str] = {}

    def at(self, k: int) -> Failures | None:
        """Return what fails at an item; None where it cannot be examined."""
        if k not in self.failures and k not in self.missing:
            self._tell(len(self.failures) + len(self.missing), _name(self.items[k]))
            try:
                self.failures[k] = self._examine(self.items[k])
            except MbkitError as error:
                self.missing[k] = describe(error)
        return self.failures.get(k)

    def nearest(self, ks: Sequence[int]) -> int | None:
        """Return the first item of some that can be examined."""
        return next((k for k in ks if self.at(k) is not None), None)

    def latest_without_failure(self) -> int | None:
        """Return an item near the end at which nothing fails, by steps back that double."""
        step, k = 1, len(self.items) - 1
        while k > 0:
            k = max(0, k - step)
            step *= 2
            if self.at(k) == {}:
                return k
        return None

    def run(self) -> None:
        """Examine the middle between neighbours that differ, until none is left."""
        while some := middles(self.failures, self.missing, self._differ):
            for k in some:
                self.at(k)

    def _differ(self, i: int, j: int) -> bool:
        return self.failures[i].keys() != self.failures[j].keys()

    def began(self) -> dict[tuple[int, int], list[Hashable]]:
        """Return what fails at the last item, by the neighbours between which it last began to."""
        out: dict[tuple[int, int], list[Hashable]] = {}
        done = sorted(self.failures)
        for key in self.failures[done[-1]]:
            without = [n for n, k in enumerate(done) if key not in self.failures[k]]
            if without:
                n = without[-1]
                out.setdefault((done[n], done[n + 1]), []).append(key)
        return dict(sorted(out.items()))

    def skipped(self, i: int, j: int) -> tuple[str, ...]:
        """Return the names between two neighbours, none of which could be examined."""
        return tuple(_identity(self.items[k]) for k in range(i + 1, j))

    def examined(self, told: Callable[[Any], str]) -> list[Examined]:
        """Return what was examined, in order."""
        out = []
        for k in sorted([*self.failures, *self.missing]):
            failures = self.failures.get(k)
            if failures is None:
                out.append(Examined(_name(self.items[k]), None, self.missing[k]))
            else:
                text = "; ".join(map(told, failures.values())) or _AS_RECORDED
                out.append(Examined(_name(self.items[k]), bool(failures), text))
        return out


def _name(item: EngineVersion | Commit | None) -> str:
    return _PRESENT if item is None else str(item)


def _identity(item: EngineVersion | Commit | None) -> str:
    return "" if item is None else item.hash if isinstance(item, Commit) else item.version


# The description.


def _by_commits(
    result: BisectResult, model: Model, recorded: Baseline, where: Path, options: dict[str, Any], tell: Progress
) -> BisectResult:
    """Return the commits at which the description became another than the recorded one."""
    if not model.source:
        why = "was made in Python, so it has no file whose commits could be examined"
        return replace(result, notes=(f"{model.name} {why}",))
    source, loops = Path(model.source), options.get("loops")
    beside = [Path(loops)] if isinstance(loops, str) else []
    now = {_key(c): c for c in result.check.changes}

    def examine(commit: Commit | None) -> Failures:
        with history.files_at(commit) as folder:
            file = history.within(folder, source)
            own = options | ({"loops": str(history.within(folder, beside[0]))} if beside else {})
            try:
                with warnings.catch_warnings(action="ignore", category=MbkitWarning):
                    then = load(file, **own)
            except MbkitError as error:
                raise UnsupportedError(describe(error).replace(f"{folder}{os.sep}", "")) from None
            changes = description_changes(replace(recorded, options=own), then, str(file), where)
        # Rounding counts where it does now.
        return {k: c for c in changes if (k := _key(c)) in now and (now[k].rounding or not c.rounding)}

    def watch(done: int, name: str) -> None:
        tell(min(0.95, 0.1 + 0.06 * done), name)

    try:
        history = History(source, beside)
        known = history.last_of(where)
        search = _Search(_line(history, known), examine, watch)
        if search.at(len(search.items) - 1) is None:
            return replace(result, notes=(f"{source} cannot be read again: {search.missing.popitem()[1]}",))
        if not search.failures[len(search.items) - 1]:
            why = "is as recorded itself: the model was changed in Python after it was loaded"
            return replace(result, examined=tuple(search.examined(_text)), notes=(f"{source} {why}",))
        if known is None or search.at(0) != {}:
            whole = _Search(_line(history, None), examine, watch)
            if whole.latest_without_failure() is None:
                return replace(result, examined=tuple(whole.examined(_text)), notes=_nothing(history, whole, result))
            search = whole
            search.at(len(search.items) - 1)
        search.run()
        onsets, examined = _onsets(history, search, examine, watch)
    except UnsupportedError as error:
        return replace(result, notes=(str(error),))
    return replace(result, onsets=tuple(onsets), examined=tuple(examined))


def _line(history: History, since: Commit | None) -> list[Commit | None]:
    """Return the commits from one on, or all, and None for the files as they are."""
    return [*([since] if since else []), *history.commits(since), None]


def _onsets(
    history: History,
    search: _Search[Commit | None],
    examine: Callable[[Commit | None], Failures],
    watch: Callable[[int, str], object],
) -> tuple[list[Onset], list[Examined]]:
    """Return the commits at which changes began, inside of merges too, and what was examined."""
    onsets: list[Onset] = []
    examined = search.examined(_text)
    for (i, j), keys in search.began().items():
        good, bad = search.items[i], search.items[j]
        side = history.merged_by(bad) if bad and i + 1 == j else []
        if side:
            # The commit before the merge stands for where its branch began: it is as recorded too.
            inner = _Search([good, *side], examine, watch)
            inner.failures[0] = {}
            inner.at(len(side))
            inner.run()
            if set(keys) <= set(inner.at(len(side)) or {}):
                deeper, more = _onsets(history, inner, examine, watch)
                onsets += deeper
                examined += more[1:]
                continue
        changes = tuple(search.failures[j][key] for key in keys)
        commit = bad or Commit("", (), "", "")
        onsets.append(
            Onset(
                kind="commit",
                engine="",
                first_bad=commit.hash,
                last_good=_identity(good),
                skipped=search.skipped(i, j),
                date=commit.date,
                subject=commit.subject,
                changes=changes,
            )
        )
    return onsets, examined


def _nothing(history: History, search: _Search[Commit | None], result: BisectResult) -> tuple[str, ...]:
    """Return why no commit is as recorded, as far as it is known."""
    commits = len(search.items) - 1
    notes = [f"none of {len(search.failures) + len(search.missing)} examined commits of {commits} is as recorded"]
    if not commits:
        notes = ["no commit of this branch touched the description's files: are they committed?"]
    if history.shallow:
        notes.append("the clone is shallow: git fetch --unshallow brings the earlier commits")
    if moved := ", ".join(map(str, result.check.versions)):
        notes.append(f"other versions may read the same file otherwise: {moved}")
    return tuple(notes)


def _key(change: Change) -> tuple[str, str, str]:
    return change.section, change.part, change.field


def _text(change: Change) -> str:
    return change.text


# Engines.


@dataclass(frozen=True)
class _Row:
    """A number that is not as recorded, and its error by the oracle; NaN without a number."""

    number: ChangedNumber
    error: float


def _by_versions(result: BisectResult, model: Model, recorded: Baseline, tell: Progress) -> BisectResult:
    """Return the versions of each engine at which its numbers moved."""
    onsets: list[Onset] = []
    examined: list[Examined] = []
    notes: list[str] = []
    engines = list(dict.fromkeys(r.engine for r in result.check.moved))
    for n, engine in enumerate(engines):
        lines, more = _versions_between(engine, recorded, result.check)
        notes += more
        if not lines:
            continue
        study = _EngineStudy(engine, model, recorded, [r for r in result.check.moved if r.engine == engine])
        search = _Search(lines, study.examine, partial(_watch, tell, n, len(engines)))
        _announce(lines)
        first, last = search.nearest(range(len(lines))), search.nearest(range(len(lines) - 1, -1, -1))
        if first is None or last is None or first == last:
            why = "; ".join(f"{lines[k]}: {reason}" for k, reason in sorted(search.missing.items()))
            notes.append(f"{engine}: fewer than two versions could be examined; {why}")
        else:
            search.run()
            onsets += study.onsets(search)
            notes += study.unexplained(search)
        examined += search.examined(lambda row: str(row.number))
    return replace(result, onsets=tuple(onsets), examined=tuple(examined), notes=tuple(notes))


def _watch(tell: Progress, n: int, engines: int, done: int, name: str) -> None:
    tell(0.1 + 0.9 * (n + min(0.95, 0.15 * done)) / engines, name)


def _versions_between(engine: str, recorded: Baseline, now: BaselineResult) -> tuple[list[EngineVersion], list[str]]:
    """Return the versions from the recorded to the installed one, or why there are none to examine."""
    package = package_of(engine)
    if engine not in PACKAGES:
        return [], [f"{engine}: it is no engine of which other versions can be installed beside this one"]
    change = next((v for v in now.versions if v.package == package), None)
    if change is None:
        others = ", ".join(map(str, now.versions)) or "nor did another version that was recorded"
        why = f"{package} {recorded.versions.get(package, '?')} is as recorded, so its version did not do it"
        return [], [f"{engine}: {why}; {others}"]
    notes: list[str] = []
    try:
        known = versions_of(engine)
    except UnsupportedError as error:
        known = made_of(engine)
        notes = [f"{error}; of {engine} only the recorded and the installed version and those with an environment"]
    low, high = sorted((change.old, change.new), key=order_of)
    inside = {x for x in known if order_of(low) <= order_of(x) <= order_of(high)} | {low, high}
    ordered = sorted(inside, key=order_of, reverse=change.old == high)
    return [named_version(f"{engine}=={x}") for x in ordered], notes


def _announce(lines: Sequence[EngineVersion]) -> None:
    """Announce the largest effort of the search, before it begins."""
    package, steps = lines[0].package, 2 + math.ceil(math.log2(max(1, len(lines) - 1)))
    made = min(steps, sum(not x.installed for x in lines))
    print(
        f"mbkit: some {min(steps, len(lines))} of {len(lines)} versions from {lines[0]} to {lines[-1]}; up to {made} "
        f"environments are made, some {made * package.seconds:.0f} s and {made * package.megabytes:.0f} MB of disk",
        file=sys.stderr,
        flush=True,
    )


class _EngineStudy:
    """One engine of a baseline: what fails now, looked for in its versions."""

    def __init__(self, engine: str, model: Model, recorded: Baseline, now: Sequence[ChangedNumber]) -> None:
        self.engine, self._model, self._recorded = engine, model, recorded
        self._now = {r.term: r for r in now}
        #: Errors by the oracle: version -> term -> error.
        self._errors: dict[str, dict[str, float]] = {}

    def examine(self, version: EngineVersion) -> Failures:
        """Return what fails now and in a version; raise where it gives no number and there is one now."""
        version.interpreter()
        recorded = self._recorded
        try:
            values, refusals = evaluated(dynamics(self._model, version), recorded)
        except UnsupportedError as error:
            if "everything" not in self._now:
                raise
            return {"everything": self._row(Refusal(self.engine, "", str(error)))}
        finally:
            process.end(version)
        own = [replace(r, engine=self.engine) for r in refusals]
        for refusal in own:
            if refusal.term in self._now and np.isfinite(self._now[refusal.term].now):
                raise UnsupportedError(f"{version}: {refusal.term}: {refusal.reason}")
        comparator = Comparator(recorded)
        errors = {t: comparator.error(t, x, recorded.terms[t]) for t, x in values.items() if t in recorded.terms}
        self._errors[version.version] = errors
        rows, _ = differences(recorded, self.engine, values, own)
        return {r.term: _Row(replace(r, cause=""), errors.get(r.term, math.nan)) for r in rows if r.term in self._now}

    def _row(self, refusal: Refusal) -> _Row:
        number = replace(self._now["everything"], reason=f"no longer: {refusal.reason}", cause="")
        return _Row(number, math.nan)

    def onsets(self, search: _Search[EngineVersion]) -> list[Onset]:
        """Return the versions at which numbers moved."""
        out = []
        for (i, j), keys in search.began().items():
            rows = sorted((search.failures[j][key] for key in keys), key=lambda row: -row.number.error)
            term, after = rows[0].number.term, rows[0].error
            before = self._errors.get(search.items[i].version, {}).get(term, math.nan)
            out.append(
                Onset(
                    kind="version",
                    engine=self.engine,
                    first_bad=search.items[j].version,
                    last_good=search.items[i].version,
                    skipped=search.skipped(i, j),
                    moved=tuple(row.number for row in rows),
                    direction=direction_of(before, after),
                    digits_before=digits_of(before),
                    digits=digits_of(after),
                )
            )
        return out

    def unexplained(self, search: _Search[EngineVersion]) -> list[str]:
        """Return what no version of the engine explains: it fails in the recorded one too, or not in the installed."""
        first, last = min(search.failures), max(search.failures)
        began = {key for keys in search.began().values() for key in keys}
        out = []
        elsewhere = "so its version did not do that, but mbkit, another package or the processor"
        if early := ", ".join(str(k) for k in search.failures[last] if k not in began):
            out.append(f"{early}: not as recorded in {search.items[first]} either, {elsewhere}")
        if lost := ", ".join(str(k) for k in self._now if k not in search.failures[last]):
            out.append(f"{lost}: as recorded in {search.items[last]} in an environment of its own, {elsewhere}")
        return out
