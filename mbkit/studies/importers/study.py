"""`compare_parsers`: does every engine's own importer read the same robot out of a file.

Loops and couplers that an importer reads out of a file, against those of the file, end by end.

Bodies have other frames, names and fused parts in every importer. Ends are therefore compared by the joint that carries
them, and by their poses in the world where all coordinates are zero.
"""

from __future__ import annotations

import math
import os
import threading
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np

from mbkit._check import DOUBLE_BITS, Array, count, real
from mbkit._child_process import WorkerDiedError, WorkerTimeoutError
from mbkit._process import fork_safe
from mbkit.engines.imported import IMPORTERS, Imported, Importer, check_installed, reader
from mbkit.engines.remote import dynamics as remote_importer
from mbkit.engines.remote.packages import EngineVersion, names_version
from mbkit.engines.remote.packages import engine as engine_of
from mbkit.errors import InputError, MbkitError, MbkitWarning, UnknownNameError, UnsupportedError
from mbkit.load import loader
from mbkit.load.mjcf import model_of_mjcf
from mbkit.load.sanitized_text import Stripped, strip
from mbkit.load.urdf_reader import urdf_links
from mbkit.load.xml_reader import Element
from mbkit.model import Coupler, Loop, Model
from mbkit.model.changes.jumps import JumpLaw
from mbkit.model.elements.forces import by_functions
from mbkit.model.elements.references import hung_on
from mbkit.model.model import unchecked
from mbkit.model.validation import listing
from mbkit.studies import results
from mbkit.studies.compare.terms import States
from mbkit.studies.explain.hypotheses import exchanged, follows, moved, paired
from mbkit.studies.explain.merged_model import Tolerances
from mbkit.studies.explain.result import Cause, Explanation
from mbkit.studies.explain.study import explain
from mbkit.studies.explain.terms import TERMS, Gap, Gaps, Values, effects, gaps, model_terms, states_of, worst
from mbkit.studies.importers.result import FILE, MISSING, Parsed, ParserComparison, Stage
from mbkit.studies.study_runs import free_of_mimic
from mbkit.studies.worker import Worker, describe

#: Attributes that switch equalities off, by element.
_SWITCHES: Final = {**dict.fromkeys(("equality", "connect", "weld"), ("active",)), "flag": ("equality", "constraint")}
#: Parts by which a file, or an importer, holds joints.
Held = Loop | Coupler
Kind = TypeVar("Kind", Loop, Coupler)
#: By how much a part differs, its name, and what differs in words.
Difference = tuple[float, str, str]


class Written(NamedTuple):
    """The loops and couplers that importers are compared with."""

    active: Sequence[Held] = ()
    #: With those that the file has switched off.
    every: Sequence[Held] = ()
    #: Why they are unknown; empty where they are known.
    faults: str = ""


def between_joints(model: Model, parts: Sequence[Held], names: Mapping[str, str] | None = None) -> list[Loop | Coupler]:
    """Return loops of a description on the joints that carry their ends, and couplers of these joints.

    The ends' poses are those in the world, which is the joint "", where all coordinates are zero; `names` has other
    names for joints. What no joint moves against each other is no loop.
    """
    at = {"world": ("", np.eye(3), np.zeros(3))}
    other = dict(names or {j.name: j.name for j in model.joints})
    for joint in model.tree:
        placed = hung_on(joint, at, [])
        carrier = other.get(joint.name, joint.name) if joint.type.nv else placed.parent
        at[joint.child] = carrier, placed.rotation, placed.translation
    placed_loops = [hung_on(x, at, []) for x in parts if isinstance(x, Loop)]
    loops = [exchanged(x) if x.body_a > x.body_b else x for x in placed_loops if x.body_a != x.body_b]
    couplers = [x for x in parts if isinstance(x, Coupler)]
    leaders = [tuple(other.get(n, "") for n in x.leaders) for x in couplers]
    own = (replace(x, joint=other.get(x.joint, ""), leader=some) for x, some in zip(couplers, leaders, strict=True))
    return [*loops, *map(_ordered, own)]


def loop_differences(written: Written, read: Sequence[Held], near: Tolerances) -> list[Difference]:
    """Return what differs between the loops of a file and those that were read."""

    def apart(a: Loop, b: Loop) -> float:
        return sum(moved(a, b)) if (a.kind, a.body_a, a.body_b) == (b.kind, b.body_a, b.body_b) else np.inf

    def says(a: Loop, b: Loop) -> str:
        far, turn = moved(a, b)
        texts = [f"moved by {far:.3g} m"] * (far > near.relative * near.length)
        return " and ".join(texts + [f"turned by {turn:.3g} rad"] * (turn > near.relative))

    return _differences(Loop, written, read, apart, says)


def coupler_differences(written: Written, file: Model, read: Sequence[Held], tolerance: float) -> list[Difference]:
    """Return the same of couplers: an importer may hold the file's mimic joints by them, or leave these free."""

    def apart(a: Coupler, b: Coupler) -> float:
        numbers = zip(a._values()[3:], b._values()[3:], strict=True)
        same = (a.joint, a.leaders) == (b.joint, b.leaders)
        return sum(float(np.abs(x - y).sum()) for x, y in numbers) if same else np.inf

    def says(a: Coupler, b: Coupler) -> str:
        size = max(1.0, float(np.abs(a.ratio).sum()) + abs(a.offset))
        return f"{follows(b)}, not {follows(a)}" if apart(a, b) > tolerance * size else ""

    return _differences(Coupler, written, read, apart, says, lambda x: _is_mimicked(x, file, tolerance))


def _differences(
    of: type[Kind],
    written: Written,
    read: Sequence[Held],
    apart: Callable[[Kind, Kind], float],
    says: Callable[[Kind, Kind], str],
    implied: Callable[[Kind], bool] = lambda _: False,
) -> list[Difference]:
    active, inactive, left = ([x for x in some if isinstance(x, of)] for some in (*written[:2], read))
    pairs, lost = paired(active, left, apart)
    left = [x for x in left if not implied(x)]
    paired(active, inactive, apart)
    wrong, _ = paired(inactive, left, apart)
    out = [(apart(a, b), _called(a), text) for a, b in pairs if (text := says(a, b))]
    out += [(1.0, _called(a), "missing") for a in lost]
    out += [(1.0, _called(a), "inactive, read as active") for a, _ in wrong]
    return out + [(1.0, _called(b), "not in the file") for b in left]


def _is_mimicked(x: Coupler, file: Model, tolerance: float) -> bool:
    """Return whether a coupler says what mimic joints of the file do."""
    mimics = {j.name: j.mimic for j in file.joints if j.mimic}
    total, offset = dict[str, float](), -x.offset
    for name, factor in zip((x.joint, *x.leaders), (1.0, *-x.ratios), strict=True):
        while mimic := mimics.get(name):
            offset += factor * mimic.offset
            name, factor = mimic.joint, factor * mimic.ratio
        total[name] = total.get(name, 0.0) + factor
    far = [offset, *total.values(), *x.curve]
    return bool(np.abs(far).max() <= tolerance * (1.0 + abs(x.offset) + np.abs(x.ratios).sum()))


def _ordered(x: Coupler) -> Coupler:
    """Return a coupler with its joints in the order of their names, which its equation has either way without curve."""
    if x.curve.any() or not x.ratios.all():
        return x
    (joint, c), *others = sorted(zip((x.joint, *x.leaders), (1.0, *-x.ratios), strict=True))
    ratios = np.array([-d / c for _, d in others])
    return replace(x, joint=joint, leader=tuple(name for name, _ in others), ratio=ratios, offset=x.offset / c)


def _called(x: Held) -> str:
    """Return a part's name, or its kind where an importer gives none, and its joints."""
    if isinstance(x, Loop):
        joints = " and ".join(repr(name) if name else "the world" for name in (x.body_a, x.body_b))
        return f"{x.name or f'a loop of {x.kind}s'} (between {joints})"
    *first, last = map(repr, (x.joint, *x.leaders))
    return f"{repr(x.name) if x.name else 'a coupler'} (of {', '.join(first)} and {last})"


def activated(root: Element) -> Element:
    """Return an MJCF with all its equalities active."""
    attributes = {k: x for k, x in root.attributes.items() if k not in _SWITCHES.get(root.tag, ())}
    return replace(root, attributes=attributes, children=[activated(x) for x in root.children])


#: The least tolerance of an importer that holds single precision. Of robots that Newton reads rightly, M of tiago_pro
#: is off by most: 9e-6, 150 times its unit roundoff.
_SINGLE_TOLERANCE: Final = 2.0**-16
_OWN_TERMS: Final = "own terms"

# Importers run in worker processes, so that none of them can end, hang or fill the user's process. The processes are
# kept from one comparison to the next: libraries take longer to load than files.

_workers: Final[dict[Importer, Worker]] = {}
#: Held by a comparison: each importer's process holds one file.
_lock: Final = fork_safe(threading.RLock())
#: In a worker process: the file that it holds.
_held: Imported | None = None


class ImporterError(Exception):
    """An importer refuses a text, ended its process over it, or took too long; never leaves `mbkit.studies`."""


def _asked(engine: str, function: Callable[..., Any], *args: Any) -> Any:
    """Return what an importer gives; raises `ImporterError` for what it raises, which is errors of all kinds."""
    try:
        return function(*args)
    except WorkerTimeoutError as error:
        raise ImporterError(f"its importer was {error}, without an answer") from None
    except WorkerDiedError as error:
        how = f"ended the process with {error.signal}" + (f" ({error.last})" if error.last else "")
        raise ImporterError(f"its importer {how}" if error.signal else f"its importer: {error}") from None
    except Exception as error:
        raise ImporterError(describe(error).removeprefix(f"{engine}: ")) from None


def _readings(
    stripped: Stripped,
    engines: Sequence[str],
    elsewhere: Mapping[str, EngineVersion],
    floating_base: bool,
    seconds: float,
) -> tuple[dict[str, Imported], dict[str, str]]:
    """Return each importer's reading of a file, and why the others refuse it; all read at the same time.

    Each takes at most `seconds` of processor time, and so does each call of its terms; a version in an environment of
    its own has a time of its own.
    """
    file = (stripped.text, stripped.format, floating_base, stripped.meshes)
    read, refused, reading = dict[str, Imported](), dict[str, str](), dict[str, Worker]()
    try:
        for engine in (x for x in engines if x not in elsewhere):
            try:
                check_installed(engine)
                reading[engine] = _workers.setdefault(IMPORTERS[engine], Worker())
                reading[engine].begin(_read, IMPORTERS[engine].module, *file)
            except UnsupportedError as error:
                refused[engine] = str(error)
        for engine in (x for x in engines if x not in refused):
            ask = partial(_asked, engine)
            try:
                if engine in elsewhere:
                    found: Imported = ask(remote_importer.read, elsewhere[engine], *file)
                else:
                    found = ask(reading[engine].finish, seconds)
                    ask = partial(ask, partial(reading[engine].call, cpu_seconds=seconds))
                read[engine] = replace(found, terms=partial(ask, found.terms))
            except ImporterError as error:
                refused[engine] = str(error)
    finally:
        # Nobody waits any more for those that still read where this is interrupted.
        for engine, worker in reading.items():
            if engine not in read and engine not in refused:
                worker.end()
    return read, refused


def _read(module: str, *file: Any) -> Imported:
    """Return what an importer holds, with terms that are computed in the process that holds it."""
    global _held
    # The file before can be as large.
    _held = None
    _held = reader(module)(*file)
    return replace(_held, terms=_terms_of_held)


def _terms_of_held(q: Array, v: Array, without: tuple[str, ...]) -> Values:
    assert _held is not None
    return _held.terms(q, v, without)


# One importer.


def compared(engine: str, imported: Imported, file: Model, loops: Written, asked: Mapping[str, Any]) -> Parsed:
    """Return an importer's reading, compared with the file at the states and to the tolerance asked for."""
    unmatched, notes = by_functions(file), list[str]()
    tree = replace(file, forces=tuple(f for f in file.forces if f not in unmatched))
    why = explain(tree, imported.model, names=(FILE, engine), **asked)
    # Links that are fused may be matter that cannot be, as the file or the importer has it.
    with unchecked():
        apart = stages(file, loops, imported, why, **asked)
    own, idle = own_terms(engine, imported, **asked)
    if unmatched:
        notes = [f"compared by what they do to passive forces alone: {listing([*map(str, unmatched)])}"]
    terms = [s for s in apart if s.name in TERMS]
    found, same = tuple(Gap(s.name, s.worst, s.where) for s in terms), all(s.same is True for s in terms)
    known, notes = all(math.isfinite(s.worst) for s in terms), [*why.notes, *imported.notes, *idle, *notes]
    if own and same and not (why.only_a or why.only_b):
        silent = tuple(c for c in why.causes if not c.acts)
        why = replace(why, agree=True, gaps=found, causes=silent, explained=True, left=(), subtree=())
    else:
        why = replace(
            why,
            agree=(agree := why.agree and same and not own),
            comparable=why.comparable and (known or not own),
            gaps=found if known and (own or agree) else why.gaps,
            causes=(*why.causes, *own),
            # The engine may compute other terms than those of its bodies and joints.
            explained=why.explained and all(c.kind != _OWN_TERMS for c in own),
        )
    if way := imported.holds_mimics:
        # Their constraints are outside of all terms.
        free, tied = "leaves it free, which", f"holds it {way}, outside its terms; it"
        why = replace(why, causes=tuple(replace(c, says=c.says.replace(free, tied)) for c in why.causes))
    return Parsed(engine, _version(engine), "", apart, why, tuple(notes))


def stages(
    file: Model, loops: Written, imported: Imported, why: Explanation, samples: int, seed: int, tolerance: float
) -> tuple[Stage, ...]:
    """Compare what no description shows: the terms that the importer's own engine computes, and what holds joints."""
    # Importers leave mimic joints free.
    free = free_of_mimic(file)
    back, there = ({x: y for m in why.matches for x, y in [(m.b, m.a)[::step]]} for step in (1, -1))
    theirs = {j.name: j.mimic for j in imported.model.joints}
    mimics = [j.name for j in file.joints if j.mimic and not theirs.get(there.get(j.name, ""))]
    lost = [*why.only_a, *why.only_b]
    held = f"held {imported.holds_mimics}" if imported.holds_mimics else "left free"
    read = between_joints(imported.model, imported.constraints, back)
    near, names = Tolerances.of(free, tolerance), loops.faults or imported.hidden
    out = [
        _missing("joints", lost, "without a counterpart"),
        _missing("mimic", mimics, held),
        _constraints("loops", names, () if names else loop_differences(loops, read, near)),
        _constraints("couplers", loops.faults, coupler_differences(loops, file, read, tolerance)),
    ]
    apart: Gaps = ()
    if not lost:
        at = states_of(free, samples, seed)
        own = model_terms(free.smooth, at)
        own["passive"] = own["passive"] + JumpLaw(free).force(at.v)
        apart = gaps(own, _own_terms_of(free, imported, there, at), at, free)
    found = {
        g.term: Stage(g.term, g.relative <= tolerance, g.relative, g.joint, f"{g.relative:.1e} at {g.joint}")
        for g in apart
    }
    unknown = None, math.nan, "", "not computed" if apart else "other coordinates"
    return (*out, *(found.get(name) or Stage(name, *unknown) for name in TERMS))


def _missing(name: str, missing: list[str], what: str) -> Stage:
    says = f"{len(missing)} {what}: {', '.join(missing)}" if missing else ""
    return Stage(name, not missing, float(len(missing)), missing[0] if missing else "", says)


def _constraints(name: str, faults: str, some: Sequence[tuple[float, str, str]]) -> Stage:
    size, where, _ = max(some, key=itemgetter(0), default=(0.0, "", ""))
    says = "; ".join(f"{part}: {text}" for _, part, text in some)
    return Stage(name, None, math.nan, "", faults) if faults else Stage(name, not some, size, where, says)


def _own_terms_of(file: Model, imported: Imported, names: Mapping[str, str], at: States) -> Values:
    """Return the engine's own terms in the file's coordinates; `names` has its joint for each of these."""
    theirs = imported.model.layout
    joints = [names[j.name] for j in file.independent_joints]
    q_order, v_order = (np.concatenate([np.r_[rows[n]] for n in joints]) for rows in (theirs.q, theirs.v))
    q, v = np.empty((len(at.q), theirs.sizes[0])), np.empty((len(at.v), theirs.sizes[1]))
    if q.shape != at.q.shape or v.shape != at.v.shape:
        return {}
    q[:, q_order], v[:, v_order] = at.q, at.v
    terms = _terms(imported, replace(at, q=q, v=v))
    return {k: x[:, v_order][:, :, v_order] if x.ndim == 3 else x[:, v_order] for k, x in terms.items()}


def _terms(imported: Imported, at: States, without: tuple[str, ...] = ()) -> Values:
    """Return an importer's own terms with the forces that jump, which engines hold outside of their terms."""
    terms = imported.terms(at.q, at.v, without)
    return _with(terms, {"passive": JumpLaw(imported.model).force(at.v)})


def own_terms(
    engine: str, imported: Imported, samples: int, seed: int, tolerance: float
) -> tuple[list[Cause], list[str]]:
    """Return what acts in an importer's model beside bodies and joints, and what does not."""
    at = states_of(imported.model, samples, seed)
    whole, described = _terms(imported, at), model_terms(imported.model, at)
    bare = _terms(imported, at, tuple(x.key for x in imported.beside)) if imported.beside else whole
    causes, idle = [], []
    for extra in imported.beside:
        without = _terms(imported, at, (extra.key,))
        rest = {} if extra.without is None else model_terms(extra.without, at)
        part = {name: x - rest[name] for name, x in described.items() if name in rest}
        bare = _with(bare, part)
        if worst(gaps(whole, without, at, imported.model)) <= tolerance:
            idle.append(f"{extra.says}; in no term while controls are zero")
            continue
        apart = gaps(whole, _with(without, part), at, imported.model)
        if not worst(apart) <= tolerance:
            says = f"{engine}: {extra.says}{', and acts otherwise than described' if part else ''}"
            causes.append(Cause(extra.kind, extra.says, says, None, None, effects(apart), acts=True))
    apart = gaps(bare, described, at, imported.model)
    if not worst(apart) <= tolerance:
        joint = max(apart, key=lambda g: g.relative).joint if apart else ""
        says = f"{engine}: its own terms are not those of its bodies and joints, most at {joint or 'no joint'}"
        causes.append(Cause(_OWN_TERMS, engine, says, None, None, effects(apart), acts=True))
    return causes, idle


def _with(a: Values, b: Values) -> Values:
    return {name: x + b[name] if name in b else x for name, x in a.items()}


def compare_parsers(
    source: str | os.PathLike[str],
    importers: Sequence[str | EngineVersion] = tuple(IMPORTERS),
    *,
    floating_base: bool = False,
    samples: int = 3,
    seed: int = 0,
    tolerance: float = 1e-9,
    seconds: float = 60.0,
) -> ParserComparison:
    """Read a file with each engine's own importer, and compare what comes out with the file as written.

    The importers read the file without meshes and textures, so that nothing else is opened but what an MJCF includes
    and the meshes from which its bodies take their inertia. Each runs in a process of its own, kept until this one
    ends: a crash or an endless loop there is reported like any other refusal.

    An importer's ``explanation`` names each number that it reads otherwise than the file has it, as `explain` does of
    two descriptions. Its ``stages`` have what no description shows: M, g, nle and passive by joint name, by the engine
    itself on its own model, with all that it holds beside bodies and joints: flags, tendons, actuators at zero control,
    fluid, gravity compensation; here passive holds the forces that jump. And what is in no term: mimic joints, and the
    loops and couplers of an MJCF, which decide nothing, as limits; the verdict names those that differ. Links that an
    importer fuses are fused on the other side too. Where mbkit does not read the file, nothing is compared: the
    importers that read it are only listed.

    Parameters
    ----------
    source : str or path
        A URDF or MJCF file, or a robot of example-robot-data.
    importers : sequence of str
        Of pinocchio, mujoco and drake; one that is not installed is named as such. Or ``"newton"``, ``"mujoco-warp"``,
        ``"mjx"`` and ``"mjx-single"``, also with a version or as `mbkit.engine` gives them, in environments of their
        own: Newton's ``add_urdf`` and ``add_mjcf``, and what ``put_model`` holds of MuJoCo's model. Newton gives no
        passive force apart from its solvers; it is that of its numbers. Single precision counts above 1.5e-5 alone.
    floating_base : bool
        Whether the base moves freely, in the file's reading and in every importer's.
    samples, seed, tolerance : int, int, float
        Random states for the terms, and the relative difference that counts.
    seconds : float
        Processor time that an importer may take over the file; ``mbkit.engine(name, seconds=...)`` sets that of an
        importer in an environment of its own.

    Raises
    ------
    LoadError
        The file, or one that it includes, is missing or unreadable; or it is neither URDF nor MJCF.
    ModelError
        The base of an MJCF is to float, and no single body stands still in its world.
    """
    begun = time.perf_counter()
    if isinstance(importers, (str, EngineVersion)) or not importers:
        raise InputError(f"importers: expected some of {', '.join(_known())}, got {importers!r}")
    remote = _remote(importers)
    asked: dict[str, Any] = {"samples": count("samples", samples, least=1), "seed": count("seed", seed)}
    asked["tolerance"] = real("tolerance", tolerance, positive=True)
    real("seconds", seconds, positive=True)
    stripped = strip(_path(source), floating_base=floating_base)
    engines = tuple(dict.fromkeys(str(remote.get(x, x)) for x in importers))
    elsewhere = {version.name: version for version in remote.values()}
    parsed: dict[str, Parsed] = {}
    file, faults = None, ""
    with _lock:
        read, refused = _readings(stripped, engines, elsewhere, floating_base, seconds)
        try:
            file = _written(stripped, floating_base)
            loops = _written_loops(stripped, floating_base)
        except MbkitError as error:
            faults = f"mbkit does not read it: {error}"
        for engine, imported in read.items():
            if file is None:
                notes = (*imported.notes, *(x.says for x in imported.beside))
                parsed[engine] = Parsed(engine, _version(engine), notes=notes)
                continue
            single = engine in elsewhere and elsewhere[engine].package.bits < DOUBLE_BITS
            near = {"tolerance": max(asked["tolerance"], _SINGLE_TOLERANCE)} if single else {}
            try:
                parsed[engine] = compared(engine, imported, file, loops, asked | near)
            except ImporterError as error:
                refused[engine] = str(error)
    parsed |= {engine: Parsed(engine, _version(engine), why) for engine, why in refused.items()}
    return ParserComparison(
        source=os.fspath(source),
        format=stripped.format,
        floating_base=floating_base,
        reference="" if file is None else FILE,
        faults=faults,
        importers=tuple(parsed[engine] for engine in engines),
        notes=tuple(_notes(stripped)),
        **asked,
        **results.provenance(begun),
    )


def written(source: str | os.PathLike[str]) -> Model:
    """Return a file as it is written: nothing fused and no engine's parser between, a URDF link by link."""
    return _written(strip(_path(source)), floating_base=False)


def _path(source: str | os.PathLike[str]) -> Path:
    if isinstance(source, str) and not source.lower().endswith((".urdf", ".xml", ".mjcf")):
        robot = loader.find(source)
        if robot is not None:
            return robot.path
        if not os.path.exists(source) and os.sep not in source:
            return loader.described(source)
    if not isinstance(source, (str, os.PathLike)):
        raise InputError(f"source: expected a path or a robot's name, got {source!r}")
    return Path(os.fspath(source))


def _written(stripped: Stripped, floating_base: bool, *, loops: bool = False) -> Model:
    with warnings.catch_warnings(action="ignore", category=MbkitWarning):
        if stripped.format == "urdf":
            return urdf_links(stripped.root, str(stripped.path), floating_base=floating_base)
        return model_of_mjcf(
            stripped.root,
            stripped.path,
            floating_base=False,
            nonphysical="warn",
            gravity=None,
            meshes="auto",
            loops=loops,
            # As MuJoCo's own reading has them.
            actuators=True,
        )


def _written_loops(stripped: Stripped, floating_base: bool) -> Written:
    """Return the loops of a file; a URDF has none."""
    if stripped.format == "urdf":
        return Written()
    try:
        roots = (replace(stripped, root=root) for root in (stripped.root, activated(stripped.root)))
        active, every = (_written(x, floating_base, loops=True) for x in roots)
    except MbkitError as error:
        return Written(faults=f"mbkit does not read the loops: {error}")
    return Written(between_joints(active, active.constraints), between_joints(every, every.constraints))


def _notes(stripped: Stripped) -> list[str]:
    out = []
    if stripped.gone:
        removed = ", ".join(f"{n} {tag}" for tag, n in stripped.gone)
        out.append(f"removed before, because they name other files or do not affect the motion: {removed}")
    if stripped.meshes:
        out.append(f"opened, because bodies take their inertia from them: {', '.join(stripped.meshes)}")
    out += stripped.unread
    if stripped.renamed:
        out.append(f"the base link 'world' is called {stripped.renamed!r}: importers take that name for the ground")
    if stripped.shapeless:
        some = ", ".join(stripped.shapeless[:6]) + (", ..." if len(stripped.shapeless) > 6 else "")
        out.append(f"bodies without <inertial>, whose meshes would give them a mass in MuJoCo: {some}")
    return out


def _known() -> tuple[str, ...]:
    return (*IMPORTERS, *remote_importer.importers())


def _remote(importers: Sequence[str | EngineVersion]) -> dict[str | EngineVersion, EngineVersion]:
    """Return the importers in environments of their own among some; raises `UnknownNameError`."""
    out = {}
    for x in importers:
        if isinstance(x, EngineVersion) or names_version(x):
            out[x] = x if isinstance(x, EngineVersion) else engine_of(x)
        if (out[x].package.importer if x in out else x in IMPORTERS) in ("", False):
            raise UnknownNameError("importer", str(x), _known())
    return out


def _version(engine: str) -> str:
    return engine.partition("==")[2] or results.versions().get(IMPORTERS[engine].distribution, MISSING)
