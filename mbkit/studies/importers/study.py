"""`compare_parsers`: does every engine's own importer read the same robot out of a file."""

from __future__ import annotations

import math
import os
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Final

import numpy as np

from mbkit._check import Array, count, real
from mbkit.engines.imported import IMPORTERS, Imported, check_installed
from mbkit.engines.registry import MUJOCO
from mbkit.errors import InputError, MbkitError, MbkitWarning, UnknownNameError, UnsupportedError
from mbkit.load import loader
from mbkit.load.mjcf import model_of_mjcf
from mbkit.load.sanitized_text import Stripped, strip
from mbkit.load.urdf_links import urdf_links
from mbkit.model import Joint, Model
from mbkit.studies import results
from mbkit.studies.explain.hypotheses import angle_of, number_text
from mbkit.studies.explain.joint_matching import Matching, align_frames, reconcile_joint_sets, rename_joints
from mbkit.studies.explain.merged_model import MergedModel, Tolerances
from mbkit.studies.explain.result import Cause, Explanation
from mbkit.studies.explain.study import explain
from mbkit.studies.explain.terms import Gap, Gaps, States, Values, gaps, model_terms, states_of, velocity_joints
from mbkit.studies.importers.process import ImporterError, Reading, one_at_a_time
from mbkit.studies.importers.result import MISSING, TERMS, Parsed, ParserComparison, Stage
from mbkit.studies.study_runs import free_of_mimic

_LIMITS: Final = ("lower", "upper", "velocity_limit", "effort_limit")


@dataclass(frozen=True)
class _Difference:
    where: str
    size: float
    says: str


def stages(
    reference: Model | Imported, imported: Imported, samples: int, seed: int, tolerance: float
) -> tuple[Stage, ...]:
    """Compare an importer's model with the reference, from the tree to the terms, which its own engine computes."""
    described = reference.model if isinstance(reference, Imported) else reference
    # Importers leave mimic joints free.
    free = free_of_mimic(described)
    near = Tolerances.of(free, tolerance)
    one, other, matching, structural = reconcile_joint_sets(free, imported.model, near)
    there, _ = align_frames(rename_joints(other, one.model, matching), one.model, near)
    pairs = [(a, b) for a, b in zip(one.model.joints, there.model.joints, strict=False) if a.name == b.name]
    alone = [h.subject for h in structural]
    out = [
        Stage(
            "joints",
            not alone,
            float(len(alone)),
            alone[0] if alone else "",
            f"{len(alone)} without a counterpart: {', '.join(alone)}" if alone else "",
        ),
        *_tree(pairs, near),
        _mimics(described, imported.model, matching),
        *_matter(one, there, near),
        *_numbers(pairs, near),
    ]
    if structural:
        return (*out, *_uncompared())
    at = states_of(one.model, samples, seed)
    ours = model_terms(one.model, at)
    if isinstance(reference, Imported):
        ours = _own_terms_of(one.model, reference, {j.name: j.name for j in one.model.joints}, at)
    theirs = _own_terms_of(one.model, imported, matching.to_b, at)
    return (*out, *_terms(one.model, ours, theirs, at, tolerance))


def _stage(name: str, some: list[_Difference]) -> Stage:
    if not some:
        return Stage(name, True, 0.0, "", "")
    worst = max(some, key=lambda d: d.size)
    more = f" (and {len(some) - 1} more)" if len(some) > 1 else ""
    return Stage(name, False, worst.size, worst.where, f"{worst.where}: {worst.says}{more}")


def _tree(pairs: list[tuple[Joint, Joint]], near: Tolerances) -> list[Stage]:
    found: dict[str, list[_Difference]] = {name: [] for name in ("kinds", "parents", "places", "axes")}
    for a, b in pairs:
        if a.type.motion != b.type.motion:
            found["kinds"].append(_Difference(a.name, 1.0, f"{b.kind} for {a.kind}"))
        if a.parent != b.parent:
            found["parents"].append(_Difference(a.name, 1.0, f"on {b.parent} for {a.parent}"))
        if not (near.vector(a.rotation, b.rotation) and near.point(a.translation, b.translation)):
            far = float(np.linalg.norm(a.translation - b.translation))
            turn = angle_of(a.rotation.T @ b.rotation)
            found["places"].append(_Difference(a.name, max(far, turn), f"{far:.3g} m and {turn:.3g} rad off"))
        if a.axes.shape == b.axes.shape and not near.vector(a.axes, b.axes):
            size, says = float(np.abs(a.axes - b.axes).max()), f"{number_text(b.axes)} for {number_text(a.axes)}"
            found["axes"].append(_Difference(a.name, size, says))
    return [_stage(name, some) for name, some in found.items()]


def _mimics(reference: Model, imported: Model, matching: Matching) -> Stage:
    theirs = {j.name: j.mimic for j in imported.joints}
    lost = [
        j.name for j in reference.joints if j.mimic is not None and theirs.get(matching.to_b.get(j.name, "")) is None
    ]
    says = f"{len(lost)} left free: {', '.join(lost)}" if lost else ""
    return Stage("mimic", not lost, float(len(lost)), lost[0] if lost else "", says)


def _matter(one: MergedModel, other: MergedModel, near: Tolerances) -> list[Stage]:
    total = [sum(b.mass for b in x.model.bodies) + x.ground.mass for x in (one, other)]
    whole = []
    if not near.number(*total):
        base = " (the base's)" if near.number(total[0] - total[1], one.ground.mass - other.ground.mass) else ""
        whole = [
            _Difference(
                "all", abs(total[1] / total[0] - 1), f"{number_text(total[1])} kg for {number_text(total[0])} kg{base}"
            )
        ]
    masses, coms, inertias = [], [], []
    theirs = {b.name: b for b in other.model.bodies}
    for a in one.model.bodies:
        if a.name not in theirs:
            continue
        b = theirs[a.name]
        if not near.number(a.mass, b.mass):
            size = abs(b.mass - a.mass) / max(a.mass, b.mass)
            masses.append(_Difference(a.name, size, f"{number_text(b.mass)} kg for {number_text(a.mass)} kg"))
        if not near.point(a.com, b.com):
            size = float(np.linalg.norm(a.com - b.com))
            coms.append(_Difference(a.name, size, f"{number_text(b.com)} for {number_text(a.com)} m"))
        if not near.inertia(a.inertia, b.inertia, a.mass):
            size = float(np.abs(b.inertia - a.inertia).max() / max(np.abs(a.inertia).max(), np.abs(b.inertia).max()))
            inertias.append(_Difference(a.name, size, f"{number_text(b.inertia)} for {number_text(a.inertia)} kg m²"))
    return [
        _stage("total mass", whole),
        _stage("masses", masses),
        _stage("centres of mass", coms),
        _stage("inertias", inertias),
    ]


def _numbers(pairs: list[tuple[Joint, Joint]], near: Tolerances) -> list[Stage]:
    out = []
    for name in ("armature", "damping", "friction", "limits"):
        found = []
        for a, b in pairs:
            for field in _LIMITS if name == "limits" else (name,):
                x, y = getattr(a, field), getattr(b, field)
                if x.shape == y.shape and not near.numbers(x, y):
                    size = float(np.max(np.where(np.isfinite(x) & np.isfinite(y), np.abs(y - x), np.inf)))
                    label = f"{field.replace('_', ' ')} " if name == "limits" else ""
                    found.append(_Difference(a.name, size, f"{label}{number_text(y)} for {number_text(x)}"))
        out.append(_stage(name, found))
    return out


def _uncompared() -> list[Stage]:
    return [Stage(n, None, np.nan, "", "other coordinates") for n in TERMS]


def _terms(reference: Model, ours: Values, theirs: Values, at: States, tolerance: float) -> list[Stage]:
    found = gaps(ours, theirs, at.v, velocity_joints(reference))
    if not found.comparable:
        return _uncompared()
    measured = {g.term: g for g in found.terms}
    return [
        Stage(n, g.relative <= tolerance, g.relative, g.joint, f"{g.relative:.1e} at {g.joint}")
        if (g := measured.get(n)) is not None
        else Stage(n, None, np.nan, "", "not computed")
        for n in TERMS
    ]


def _own_terms_of(reference: Model, imported: Imported, names: Mapping[str, str], at: States) -> Values:
    """Return the engine's own terms in the reference's coordinates; `names` has its joint for each of these."""
    theirs = imported.model.layout
    q_order, v_order = (
        np.concatenate([np.arange(r[names[j.name]].start, r[names[j.name]].stop) for j in reference.independent_joints])
        for r in (theirs.q, theirs.v)
    )
    q, v = np.empty((len(at.q), theirs.sizes[0])), np.empty((len(at.v), theirs.sizes[1]))
    if q.shape != at.q.shape or v.shape != at.v.shape:
        return {}
    q[:, q_order], v[:, v_order] = at.q, at.v
    return {k: _ordered(x, v_order) for k, x in imported.terms(q, v, ()).items()}


def _ordered(x: Array, order: np.ndarray) -> Array:
    return x[:, order][:, :, order] if x.ndim == 3 else x[:, order]


@dataclass(frozen=True)
class OwnTerms:
    """The content of an engine's own terms."""

    causes: tuple[Cause, ...]  # what acts beside bodies and joints
    idle: tuple[str, ...]  # what changes no term
    held: bool  # without these, the terms are those of bodies and joints

    @property
    def notes(self) -> tuple[str, ...]:
        """Return what is in the model and acts in no term."""
        return tuple(f"{says}; in no term while controls are zero" for says in self.idle)


def own_terms(engine: str, imported: Imported, samples: int, seed: int, tolerance: float) -> OwnTerms:
    """Measure what acts in an importer's model beside its bodies and joints."""
    at = states_of(imported.model, samples, seed)
    owners = velocity_joints(imported.model)
    whole, described = imported.terms(at.q, at.v, ()), model_terms(imported.model, at)
    bare = imported.terms(at.q, at.v, tuple(x.key for x in imported.beside)) if imported.beside else whole
    causes, idle = [], []
    for extra in imported.beside:
        without = imported.terms(at.q, at.v, (extra.key,))
        part = {} if extra.without is None else _less(described, model_terms(extra.without, at))
        bare = _with(bare, part)
        if gaps(whole, without, at.v, owners).worst <= tolerance:
            idle.append(extra.says)
            continue
        found = gaps(whole, _with(without, part), at.v, owners)
        if not found.worst <= tolerance:
            says = f"{engine}: {extra.says}{', and acts otherwise than described' if part else ''}"
            causes.append(Cause(extra.kind, extra.says, says, None, None, _effects(found), acts=True))
    found = gaps(bare, described, at.v, owners)
    held = found.worst <= tolerance
    if not held:
        says = f"{engine}: its own terms are not those of its bodies and joints, most at {found.joint or 'no joint'}"
        causes.append(Cause("own terms", engine, says, None, None, _effects(found), acts=True))
    return OwnTerms(tuple(causes), tuple(idle), held)


def _less(a: Values, b: Values) -> Values:
    return {name: x - b[name] for name, x in a.items() if name in b}


def _with(a: Values, b: Values) -> Values:
    return {name: x + b[name] if name in b else x for name, x in a.items()}


def _effects(found: Gaps) -> dict[str, float]:
    return {g.term: g.relative for g in found.terms} if found.comparable else {"M": math.inf}


def measured(found: Explanation, stages: tuple[Stage, ...], own: OwnTerms) -> Explanation:
    """Return an explanation of two descriptions, corrected by the terms that the engine itself computes."""
    terms = [s for s in stages if s.name in TERMS]
    gaps_ = tuple(Gap(s.name, s.worst, s.where) for s in terms)
    same = all(s.same is True for s in terms)
    if not own.causes:
        # The terms are those of the descriptions.
        return replace(found, gaps=gaps_) if found.agree and same else replace(found, agree=False)
    if same and not (found.only_a or found.only_b):
        silent = tuple(c for c in found.causes if not c.acts)
        return replace(found, agree=True, gaps=gaps_, causes=silent, explained=True, left=(), subtree=())
    known = all(math.isfinite(s.worst) for s in terms)
    return replace(
        found,
        agree=False,
        comparable=found.comparable and known,
        gaps=gaps_ if known else found.gaps,
        causes=(*found.causes, *own.causes),
        explained=found.explained and own.held,
    )


def compare_parsers(
    source: str | os.PathLike[str],
    importers: Sequence[str] = tuple(IMPORTERS),
    *,
    floating_base: bool = False,
    samples: int = 3,
    seed: int = 0,
    tolerance: float = 1e-9,
    seconds: float = 60.0,
) -> ParserComparison:
    """Read a file with each engine's own importer, and compare what comes out with the file as written.

    The importers read the file without meshes and textures, so that nothing else is opened but what
    an MJCF includes and the meshes from which its bodies take their inertia; boxes, cylinders and spheres
    stay. Each runs in a process of its own, kept until this one ends: a crash or an endless loop there is
    reported like any other refusal.

    The readings are compared stage by stage: joints, kinds, parents, places, axes, mimic joints, masses,
    centres of mass, inertias, armature, damping, friction, limits, and M, g, nle and passive by joint name,
    by the engine itself on its own model, with all that it holds beside bodies and joints: flags, tendons,
    actuators at zero control, fluid, gravity compensation. Links that an importer fuses are fused on the
    other side too. Why one differs is in its ``explanation``.

    Where mbkit does not read the file, an MJCF is compared with MuJoCo's own reading, and any other file
    with nothing: the importers that read it are only listed.

    Parameters
    ----------
    source : str or path
        A URDF or MJCF file, or a robot of example-robot-data.
    importers : sequence of str
        Of pinocchio, mujoco and drake. One that is not installed is named as such.
    floating_base : bool
        Whether the base moves freely, in the file's reading and in every importer's.
    samples, seed : int
        Random states for the terms.
    tolerance : float
        Relative difference that counts.
    seconds : float
        That an importer may take over the file, of the processor's time.

    Returns
    -------
    ParserComparison

    Raises
    ------
    LoadError
        The file, or one that it includes, is missing or unreadable; or it is neither URDF nor MJCF.
    ModelError
        The base of an MJCF is to float, and no single body stands still in its world.
    """
    begun = time.perf_counter()
    for name in importers:
        if name not in IMPORTERS:
            raise UnknownNameError("importer", str(name), IMPORTERS)
    if isinstance(importers, str) or not importers:
        raise InputError(f"importers: expected some of {', '.join(IMPORTERS)}, got {importers!r}")
    count("samples", samples, least=1)
    count("seed", seed)
    real("tolerance", tolerance, positive=True)
    real("seconds", seconds, positive=True)
    stripped = strip(_path(source), floating_base=floating_base)
    engines = tuple(dict.fromkeys(importers))
    parsed: dict[str, Parsed] = {}
    with one_at_a_time():
        read, refused = _read(stripped, engines, floating_base, seconds)
        reference, label, faults = _reference(stripped, read, floating_base)
        for engine, imported in read.items():
            if reference is None or engine == label:
                notes = (*imported.notes, *(x.says for x in imported.beside))
                parsed[engine] = Parsed(engine, _version(engine), notes=notes)
                continue
            try:
                parsed[engine] = _compared(engine, imported, reference, label, samples, seed, tolerance)
            except ImporterError as error:
                refused[engine] = str(error)
    parsed |= {engine: Parsed(engine, _version(engine), why) for engine, why in refused.items()}
    return ParserComparison(
        source=os.fspath(source),
        format=stripped.format,
        floating_base=floating_base,
        reference=label,
        faults=faults,
        importers=tuple(parsed[engine] for engine in engines),
        notes=tuple(_notes(stripped)),
        samples=samples,
        seed=seed,
        tolerance=tolerance,
        versions=results.versions(),
        processor=results.processor(),
        seconds=time.perf_counter() - begun,
    )


def _read(
    stripped: Stripped, engines: Sequence[str], floating_base: bool, seconds: float
) -> tuple[dict[str, Imported], dict[str, str]]:
    """Return each importer's reading of a file, and why the others refuse it; all read at the same time."""
    begun: dict[str, Reading] = {}
    read: dict[str, Imported] = {}
    refused: dict[str, str] = {}
    for engine in engines:
        try:
            check_installed(engine)
            begun[engine] = Reading(engine, stripped.text, stripped.format, floating_base, stripped.meshes, seconds)
        except UnsupportedError as error:
            refused[engine] = str(error)
    for engine, reading in begun.items():
        try:
            reading.begin()
        except ImporterError as error:
            refused[engine] = str(error)
    for engine in [e for e in begun if e not in refused]:
        try:
            read[engine] = begun[engine].result()
        except ImporterError as error:
            refused[engine] = str(error)
    return read, refused


def _compared(
    engine: str, imported: Imported, reference: Model | Imported, label: str, samples: int, seed: int, tolerance: float
) -> Parsed:
    """Return an importer's reading, compared with the reference."""
    described = reference.model if isinstance(reference, Imported) else reference
    found = explain(described, imported.model, samples=samples, seed=seed, tolerance=tolerance, names=(label, engine))
    compared = stages(reference, imported, samples, seed, tolerance)
    own = own_terms(engine, imported, samples, seed, tolerance)
    if isinstance(reference, Imported):
        theirs = own_terms(label, reference, samples, seed, tolerance)
        own = OwnTerms((*theirs.causes, *own.causes), own.idle, own.held and theirs.held)
    notes = (*found.notes, *imported.notes, *own.notes)
    return Parsed(engine, _version(engine), "", compared, measured(found, compared, own), notes)


def written(source: str | os.PathLike[str]) -> Model:
    """Return a file as it is written: nothing fused and no engine's parser between, a URDF link by link."""
    return _written(strip(_path(source)), floating_base=False)


def _path(source: str | os.PathLike[str]) -> Path:
    if isinstance(source, str) and not source.lower().endswith((".urdf", ".xml", ".mjcf")):
        robot = loader.find(source)
        if robot is not None:
            return robot.path
        if not os.path.exists(source) and os.sep not in source:
            raise loader.unknown(source)
    if not isinstance(source, (str, os.PathLike)):
        raise InputError(f"source: expected a path or a robot's name, got {source!r}")
    return Path(os.fspath(source))


def _written(stripped: Stripped, floating_base: bool) -> Model:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MbkitWarning)
        if stripped.format == "urdf":
            return urdf_links(stripped.root, str(stripped.path), floating_base=floating_base)
        return model_of_mjcf(
            stripped.root, stripped.path, floating_base=False, nonphysical="warn", gravity=None, meshes="auto"
        )


def _reference(
    stripped: Stripped, read: dict[str, Imported], floating_base: bool
) -> tuple[Model | Imported | None, str, str]:
    """Return what importers are compared with, its name, and why it is not the file; MuJoCo's reading of an MJCF."""
    try:
        return _written(stripped, floating_base), "file", ""
    except MbkitError as error:
        faults = f"mbkit does not read it: {error}"
    if stripped.format == "mjcf" and MUJOCO in read:
        return read[MUJOCO], MUJOCO, faults
    return None, "", faults


def _notes(stripped: Stripped) -> list[str]:
    out = []
    if stripped.gone:
        removed = ", ".join(f"{n} {tag}" for tag, n in stripped.gone)
        out.append(f"taken out before, because they name other files or say nothing of the motion: {removed}")
    if stripped.meshes:
        out.append(f"opened, because bodies take their inertia from them: {', '.join(stripped.meshes)}")
    out += stripped.unread
    if stripped.renamed:
        out.append(f"the base link 'world' is called {stripped.renamed!r}: importers take that name for the ground")
    if stripped.shapeless:
        some = ", ".join(stripped.shapeless[:6]) + (", ..." if len(stripped.shapeless) > 6 else "")
        out.append(f"bodies without <inertial>, whose meshes MuJoCo would have given a mass: {some}")
    return out


def _version(engine: str) -> str:
    try:
        return metadata.version(IMPORTERS[engine].distribution)
    except metadata.PackageNotFoundError:
        return MISSING
