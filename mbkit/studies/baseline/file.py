"""Baselines and their files: TOML, written as a whole and guarded by a checksum.

Why TOML: the standard library reads it, a name stands beside each number, it has comments and infinities, and no text
is read as a number. Below a section every line is the whole path to a number or row, so that a changed line says
what changed.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from mbkit import _process as _interrupt
from mbkit._check import Array
from mbkit._escape import json_text
from mbkit.errors import BaselineError, InputError, OutputError
from mbkit.studies.baseline.description import FLAT, SECTIONS, Description, moving_mass
from mbkit.studies.compare.terms import States
from mbkit.studies.results import Refusal, write_whole

#: The name of a rollout's end among the terms: q, then v, (nq + nv,).
ROLLOUT: Final = "rollout"
#: The name of named frames among the terms: of each X_WF's three rows and J v, (n, k, 18).
FRAMES: Final = "frames"
_OF_FRAME: Final = {"pose": slice(0, 12), "velocity": slice(12, 18)}
VECTORS: Final = ("q", "v", "a", "tau")
#: Number of the file's layout; another layout is not read.
FORMAT: Final = 1
#: Most steps of a rollout that a file may ask for; `record` writes far fewer.
_MAX_ROLLOUT_STEPS: Final = 10_000
_HEAD: Final = "# mbkit baseline: "
_NOTE: Final = (
    f"{_HEAD}what engines said of one robot. Written by mbkit and guarded by the checksum in its last line:\n"
    "# do not edit it, record it again. A line below [section] is the whole name of a number or row; a row has a\n"
    "# number for each of the states; a row of M is what stands before the diagonal, from its first that is not zero,\n"
    "# and the diagonal.\n"
)
_SUM: Final = "# sha256 "
_FORMAT: Final = re.compile(r"^format = (\d+)$", re.MULTILINE)
_MODEL: Final = re.compile(r"^model = (\".*\")$", re.MULTILINE)
_CONFLICT: Final = re.compile(r"^(<<<<<<<|>>>>>>>)", re.MULTILINE)
_REMEDY: Final = "restore it from version control, or record it again"


@dataclass(frozen=True)
class Rollout:
    """How far a rollout goes from the first state: `steps` of Runge-Kutta 4 of `dt` s, without forces."""

    dt: float
    steps: int


@dataclass(frozen=True, eq=False)
class Baseline:
    """The record of one model, as `record` returns and `read` reads it.

    `digest` is the model's fingerprint, `Model.digest`. `target` and `options` are what `mbkit baseline check` loads,
    and how; empty for a model without a source. `versions` are those of what computes, by package. `description` has
    the model's parameters, as `mbkit.studies.baseline.description` says. `terms` has for each term the values at the
    states by the oracle, rounded to double, as ``"rollout"`` the end of a rollout, and as ``"frames"`` the poses and
    velocities of `frames`, those that the file names. `errors` has for each engine
    and term the worst error against these, as `mbkit.studies.compare.errors` defines it; zero for one of less than
    8 eps, which any engine may have. `own` has the engine's own values where it differed by more than rounding.
    `left_out` is what an engine could not do when this was recorded.
    """

    model: str
    digest: str
    target: str
    options: dict[str, Any]
    seed: int
    processor: str
    versions: dict[str, str]
    description: Description
    coordinates: tuple[str, ...]
    velocities: tuple[str, ...]
    states: States
    rollout: Rollout
    terms: dict[str, Array]
    errors: dict[str, dict[str, float]]
    own: dict[str, dict[str, Array]] = field(default_factory=dict)
    left_out: tuple[Refusal, ...] = ()
    frames: tuple[str, ...] = ()

    @property
    def engines(self) -> tuple[str, ...]:
        """The engines that were recorded."""
        return tuple(self.errors)

    @property
    def disagreements(self) -> tuple[str, ...]:
        """Where an engine differed from the oracle by more than rounding when this was recorded."""
        return tuple(
            f"{engine}: {term} differs from the oracle by {self.errors[engine][term]:.1e}; recorded as it is"
            for engine, terms in self.own.items()
            for term in terms
        )

    def __repr__(self) -> str:
        content = f"{len(self.terms)} terms at {len(self.states.kinds)} states"
        return f"<Baseline of {self.model!r}: {', '.join(self.engines)}; {content}>"


def with_frames(b: Baseline, names: tuple[str, ...]) -> Baseline:
    """Return a baseline with the numbers of these frames alone, in this order."""
    which = [b.frames.index(name) for name in names]

    def chosen(terms: dict[str, Array]) -> dict[str, Array]:
        kept = {term: x[:, which] if term == FRAMES else x for term, x in terms.items()}
        return kept if which else {term: x for term, x in kept.items() if term != FRAMES}

    own = {engine: chosen(terms) for engine, terms in b.own.items()}
    return replace(b, frames=names, terms=chosen(b.terms), own=own)


# The content of a file as nested tables.


def _to_table(b: Baseline) -> dict[str, Any]:
    names = {"q": b.coordinates, "v": b.velocities, "a": b.velocities, "tau": b.velocities}
    refused: dict[str, dict[str, str]] = {}
    for r in b.left_out:
        refused.setdefault(r.engine, {})[r.term or "everything"] = r.reason
    plain = ("model", "digest", "target", "seed", "processor")
    return {
        "format": FORMAT,
        **{name: getattr(b, name) for name in plain},
        "engines": list(b.errors),
        "options": b.options,
        "versions": b.versions,
        **{s: b.description[s][""] if s in FLAT else b.description[s] for s in SECTIONS if s in b.description},
        "states": {"kinds": list(b.states.kinds)} | {x: _columns(names[x], getattr(b.states, x)) for x in VECTORS},
        "rollout": vars(b.rollout),
        "terms": {term: _values(b, term, x, half=True) for term, x in b.terms.items()},
        "errors": {e: {t: float(f"{x:.1e}") for t, x in terms.items() if x} for e, terms in b.errors.items()},
        "own": {e: {t: _values(b, t, x, half=False) for t, x in terms.items()} for e, terms in b.own.items()},
        "left_out": refused,
    }


def _columns(names: Sequence[str], x: Array) -> dict[str, list[float]]:
    """Return (N, n) numbers as n rows, each with a joint's numbers at all states; (n,) as n numbers."""
    return dict(zip(names, x.T.tolist(), strict=True))


def _values(b: Baseline, term: str, x: Array, *, half: bool) -> Any:
    """Return a term's values: an array of zeros as one zero, and of a symmetric matrix the lower half."""
    if term == ROLLOUT:
        n = len(b.coordinates)
        return {"q": _columns(b.coordinates, x[:n]), "v": _columns(b.velocities, x[n:])}
    if term == FRAMES:
        return {
            name: {
                what: {str(k + 1): row.tolist() for k, row in enumerate(x[:, i, part])}
                for what, part in _OF_FRAME.items()
            }
            for i, name in enumerate(b.frames)
        }
    if not x.any():
        return 0.0
    if x.ndim == 1:
        return x.tolist()
    if x.ndim == 2:
        return _columns(b.velocities, x)
    rows = [_half(M) if half else M.tolist() for M in x]
    return {str(k + 1): dict(zip(b.velocities, row, strict=True)) for k, row in enumerate(rows)}


def _half(M: Array) -> list[list[float]]:
    """Return of each row the entries before the diagonal, from the first nonzero one, and the diagonal."""
    first = [int(np.flatnonzero(np.append(M[i, :i], 1.0))[0]) for i in range(len(M))]
    return [M[i, first[i] : i + 1].tolist() for i in range(len(M))]


def _from_table(t: Mapping[str, Any]) -> Baseline:
    """Return what was written; a missing part, or what no recording holds, raises some built-in error."""
    _expect(t["format"] == FORMAT, f"expected format {FORMAT}, got {t['format']!r}")
    states, kinds = t["states"], tuple(t["states"]["kinds"])
    coordinates, velocities = tuple(states["q"]), tuple(states["v"])
    n, nv = len(kinds), len(velocities)

    def array(name: str, x: Any, shape: tuple[int, ...]) -> Array:
        out = np.ascontiguousarray(np.array(x, dtype=np.float64))
        _expect(out.shape == shape, f"{name}: expected numbers of shape {shape}, got {out.shape}")
        _expect(bool(np.isfinite(out).all()), f"{name}: a number is not finite")
        return out

    def values(term: str, x: Any, half: bool) -> Array:
        if term == ROLLOUT:
            return array(term, [*x["q"].values(), *x["v"].values()], (len(coordinates) + nv,))
        if term == FRAMES:
            rows = [[list(frame[what].values()) for frame in x.values()] for what in _OF_FRAME]
            poses = np.concatenate([np.array(row, dtype=np.float64) for row in rows], axis=-1).swapaxes(0, 1)
            return array(term, poses, (n, len(x), 18))
        shape = (n,) if term.endswith("energy") else (n, nv, nv) if term == "M" else (n, nv)
        if isinstance(x, float):
            _expect(x == 0, f"{term}: expected rows of numbers or 0.0, got {x!r}")
            return np.zeros(shape)
        if isinstance(x, list):
            return array(term, x, shape)
        if term == "M":
            matrices = (list(rows.values()) for rows in x.values())
            return array(term, [_whole(rows) if half else rows for rows in matrices], shape)
        return array(term, np.array(list(x.values())).T, shape)

    refused, errors = t.get("left_out", {}), t.get("errors", {})
    computed = {e: [term for term in t["terms"] if term not in refused.get(e, {})] for e in t["engines"]}
    sizes = {"q": len(coordinates), "v": nv, "a": nv, "tau": nv}
    q, v, a, tau = (array(x, np.array(list(states[x].values())).T, (n, sizes[x])) for x in VECTORS)
    baseline = Baseline(
        **{name: t[name] for name in ("model", "digest", "target", "seed", "processor")},
        options=dict(t.get("options", {})),
        versions=dict(t["versions"]),
        description={s: {"": dict(t[s])} if s in FLAT else dict(t[s]) for s in SECTIONS if s in t},
        coordinates=coordinates,
        velocities=velocities,
        states=States(q, v, a, tau, kinds),
        rollout=Rollout(t["rollout"]["dt"], t["rollout"]["steps"]),
        terms={term: values(term, x, True) for term, x in t["terms"].items()},
        errors={e: {term: errors.get(e, {}).get(term, 0.0) for term in terms} for e, terms in computed.items()},
        frames=tuple(t["terms"].get(FRAMES, {})),
        own={e: {term: values(term, x, False) for term, x in terms.items()} for e, terms in t.get("own", {}).items()},
        left_out=tuple(
            Refusal(engine, "" if term == "everything" else term, reason)
            for engine, terms in refused.items()
            for term, reason in terms.items()
        ),
    )
    _check(baseline)
    return baseline


def _whole(rows: Sequence[Sequence[float]]) -> Array:
    M = np.zeros((len(rows), len(rows)))
    for i, row in enumerate(rows):
        M[i, i + 1 - len(row) : i + 1] = M[i + 1 - len(row) : i + 1, i] = row
    return M


def _expect(holds: bool, message: str) -> None:
    if not holds:
        raise ValueError(message)


def _check(b: Baseline) -> None:
    """Raise `ValueError` for texts and numbers that no recording holds."""
    texts = [b.model, b.digest, b.target, b.processor, *b.states.kinds, *b.versions, *b.versions.values(), *b.errors]
    _expect(all(isinstance(x, str) for x in texts), "a name, a target or a version is no text")
    whole = type(b.seed) is int and type(b.rollout.steps) is int and 0 < b.rollout.steps <= _MAX_ROLLOUT_STEPS
    _expect(whole, f"expected a whole number as seed, and 1 to {_MAX_ROLLOUT_STEPS} steps of the rollout")
    _expect(bool(b.errors) and "M" in b.terms, "no terms, no mass matrix or no engines")
    for section, parts in b.description.items():
        for name, x in ((name, x) for part in parts.values() for name, x in part.items()):
            numbers = all(map(_is_number, x)) if isinstance(x, list) and name != "mass" else _is_number(x)
            text = isinstance(x, str) and name != "mass"
            _expect(numbers or text, f"{section}: {name}: expected numbers or text, got {x!r}")
    _expect(np.shape(moving_mass(b.description)[1]) == (3,), "gravity: expected three numbers")
    sizes = [b.rollout.dt, *(x for terms in b.errors.values() for x in terms.values())]
    sound = bool(np.isfinite(sizes).all()) and min(sizes) >= 0
    _expect(sound, "an error or the rollout's step is negative or not finite")


def _is_number(x: object) -> bool:
    return isinstance(x, float) or (type(x) is int and abs(x) < 2**53)


# Reading.


def path_of(path: object) -> Path:
    """Return a path that may be a baseline's."""
    if not isinstance(path, (str, os.PathLike)) or not os.fspath(path):
        raise InputError(f"path: expected a file such as 'baselines/panda.toml', got {path!r}")
    out = Path(os.fsdecode(path))
    if out.is_dir():
        raise InputError(f"path: {out} is a folder; name a file in it, such as {out / 'panda.toml'}")
    return out


def is_baseline(path: Path) -> bool:
    """Return whether a file says that it is a baseline, damaged or not."""
    try:
        with path.open("rb") as file:
            return file.read(len(_HEAD)) == _HEAD.encode()
    except OSError:
        return False


def read(path: str | os.PathLike[str]) -> Baseline:
    """Read a baseline.

    Raises
    ------
    BaselineError
        The file does not exist, is not a baseline, is cut short or edited, or has another format.

    Examples
    --------
    >>> import tempfile, mbkit as mb
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = mb.baseline.record(mb.catalog.pendulum(), folder + "/a.toml", engines=["lagrangian"])
    ...     mb.baseline.read(folder + "/a.toml")
    <Baseline of 'pendulum': lagrangian; 11 terms at 3 states>
    """
    where = path_of(path)
    try:
        # Version control may have changed the ends of lines.
        text = where.read_bytes().decode("utf-8").replace("\r\n", "\n")
    except FileNotFoundError:
        raise BaselineError(f"{where}: there is no baseline; record one, and keep it with the robot's files") from None
    except OSError as error:
        raise BaselineError(f"{where}: cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise BaselineError(f"{where}: no text from byte {error.start} on; {_REMEDY}") from None
    if not text.startswith(_HEAD):
        raise BaselineError(f"{where}: no baseline of mbkit's; its first line would begin with {_HEAD.strip()!r}")
    if _CONFLICT.search(text):
        raise BaselineError(f"{where}: a merge has left conflict marks in it; take either side, or record it again")
    number = _format(text)
    if number != FORMAT:
        by, advice = (
            ("a newer", "update mbkit, or record it again") if number > FORMAT else ("an older", "record it again")
        )
        reads = f"this one reads format {FORMAT}"
        raise BaselineError(f"{where}: of format {number}, by {by} mbkit; {reads}: {advice}")
    body, mark, checksum = text.rpartition(_SUM)
    if not mark or len(checksum.strip()) != 64 or not body.endswith("\n"):
        lines = text.count("\n")
        raise BaselineError(f"{where}: cut short after line {lines}: its last line, the checksum, is lost; {_REMEDY}")
    if checksum.strip() != _checksum(body):
        raise BaselineError(f"{where}: edited or damaged: its checksum belongs to other content; {_REMEDY}")
    try:
        return _from_table(tomllib.loads(body))
    except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError) as error:
        raise BaselineError(f"{where}: sound by its checksum, yet not readable ({error}); {_REMEDY}") from None


def _format(text: str) -> int:
    """Return the number of the format: of a longer one than any, nine digits; ours where the line is damaged."""
    line = _FORMAT.search(text)
    return int(line[1][:9]) if line else FORMAT


def _checksum(body: str) -> str:
    return hashlib.sha256(body.encode("utf-8")).hexdigest()


# Writing.


def text_of(baseline: Baseline) -> str:
    """Return a baseline as the text of its file; the same baseline is the same text."""
    body = f"{_NOTE}\n{_dumps(_to_table(baseline))}\n"
    return f"{body}{_SUM}{_checksum(body)}\n"


def check_replaceable(path: Path, model: str) -> None:
    """Raise `OutputError` unless a file is absent or a baseline of the same model, whole or damaged."""
    if not os.path.lexists(path):
        return
    if not is_baseline(path):
        raise OutputError(f"{path}: there is a file that is no baseline; name another, or replace it with force")
    text = path.read_bytes().decode("utf-8", "replace").replace("\r\n", "\n")
    number, named = _format(text), _MODEL.search(text)
    if number > FORMAT:
        raise OutputError(
            f"{path}: a newer mbkit's baseline, of format {number}; update mbkit, or replace it with force"
        )
    if named and named[1] != _value(model):
        raise OutputError(
            f"{path}: the baseline of {named[1]}, not of {model!r}; name another file, or replace it with force"
        )


def store(path: Path, text: str, model: str, *, force: bool) -> None:
    """Write a baseline as a whole or not at all; unless `force` is set, never over another robot's baseline."""
    # Where a link leads, so that it stays one.
    path = Path(os.path.realpath(path))

    def claim(temporary: str) -> None:
        """Claim a free name in one atomic step; else check that its file may be replaced."""
        try:
            os.link(temporary, path)
        except OSError:
            # There is such a file, or the file system has no links.
            check_replaceable(path, model)

    try:
        with _interrupt.uninterrupted:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, text.encode("utf-8"), None if force else claim)
    except UnicodeEncodeError as error:
        name = error.object[error.start : error.end]
        raise InputError(f"{model}: the name {name!r} is no text that a file holds") from None
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}; what was there is unchanged") from error


def _dumps(table: Mapping[str, Any]) -> str:
    """Return a table as TOML: first the entries that are not tables, then a section for each table."""
    sections = ["\n".join(f"{_key(k)} = {_value(x)}" for k, x in table.items() if not isinstance(x, Mapping))]
    for name, part in table.items():
        if isinstance(part, Mapping) and part:
            sections.append("\n".join([f"[{_key(name)}]", *_lines(part)]))
    return "\n\n".join(sections) + "\n"


def _lines(part: Mapping[str, Any], before: str = "") -> Iterator[str]:
    for name, x in part.items():
        path = before + _key(name)
        if isinstance(x, Mapping):
            yield from _lines(x, path + ".")
        else:
            yield f"{path} = {_value(x)}"


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _value(name)


def _value(x: Any) -> str:
    if isinstance(x, (list, tuple)):
        return f"[{', '.join(map(_value, x))}]"
    if isinstance(x, str):
        # TOML reads JSON's escapes, but writes characters of two units as one.
        return "".join(
            f"\\U{ord(c):08x}" if ord(c) > 0xFFFF and not c.isprintable() else json_text(c)
            for c in json.dumps(x, ensure_ascii=False)
        )
    return repr(x).lower() if isinstance(x, bool) else repr(x)
