"""A baseline as a table of plain data, and back: one row for each joint, so that a changed line names it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.studies.baseline.content import ROLLOUT, Baseline, Rollout
from mbkit.studies.baseline.description import FLAT, SECTIONS, Description, moving_mass
from mbkit.studies.result import Refusal
from mbkit.studies.states import States

__all__ = ["FORMAT", "from_table", "to_table"]

#: Of the file. Another number is another layout, which this one does not read.
FORMAT: Final = 1
#: Of a rollout that a file asks for; `record` writes far fewer.
_MOST_STEPS: Final = 10_000
_VECTORS: Final = ("q", "v", "a", "tau")


def to_table(b: Baseline) -> dict[str, Any]:
    """Return what is written."""
    names = {"q": b.coordinates, "v": b.velocities, "a": b.velocities, "tau": b.velocities}
    refused: dict[str, dict[str, str]] = {}
    for r in b.left_out:
        refused.setdefault(r.engine, {})[r.term or "everything"] = r.reason
    return {
        "format": FORMAT,
        "model": b.model,
        "digest": b.digest,
        "target": b.target,
        "seed": b.seed,
        "processor": b.processor,
        "engines": list(b.errors),
        "options": dict(b.options),
        "versions": dict(b.versions),
        **{s: b.description[s][""] if s in FLAT else b.description[s] for s in SECTIONS if s in b.description},
        "states": {"kinds": list(b.states.kinds)} | {x: _columns(names[x], getattr(b.states, x)) for x in _VECTORS},
        "rollout": {"dt": b.rollout.dt, "steps": b.rollout.steps},
        "terms": {term: _values(b, term, x, half=True) for term, x in b.terms.items()},
        "errors": {e: {t: float(f"{x:.1e}") for t, x in terms.items() if x} for e, terms in b.errors.items()},
        "own": {e: {t: _values(b, t, x, half=False) for t, x in terms.items()} for e, terms in b.own.items()},
        "left_out": refused,
    }


def from_table(t: Mapping[str, Any]) -> Baseline:
    """Return what was written.

    Raises
    ------
    ValueError, TypeError, LookupError, AttributeError, ArithmeticError
        It is not what `to_table` writes: a part is missing, or of another kind or size, or a number is not finite.
    """
    if t["format"] != FORMAT:
        raise ValueError(f"expected format {FORMAT}, got {t['format']!r}")
    states = t["states"]
    coordinates, velocities = tuple(states["q"]), tuple(states["v"])
    q, v, a, tau = (_unfolded(states[x]) for x in _VECTORS)
    at = States(q, v, a, tau, tuple(states["kinds"]))
    sizes = len(at.kinds), len(velocities)
    made = Baseline(
        model=t["model"],
        digest=t["digest"],
        target=t["target"],
        options=dict(t.get("options", {})),
        seed=t["seed"],
        processor=t["processor"],
        versions=dict(t["versions"]),
        description=_description(t),
        coordinates=coordinates,
        velocities=velocities,
        states=at,
        rollout=Rollout(t["rollout"]["dt"], t["rollout"]["steps"]),
        terms={term: _read(term, x, sizes, half=True) for term, x in t["terms"].items()},
        errors={e: _errors(t, e) for e in t["engines"]},
        own={
            e: {term: _read(term, x, sizes, half=False) for term, x in terms.items()}
            for e, terms in t.get("own", {}).items()
        },
        left_out=tuple(
            Refusal(engine, "" if term == "everything" else term, reason)
            for engine, terms in t.get("left_out", {}).items()
            for term, reason in terms.items()
        ),
    )
    _check(made)
    return made


def _check(b: Baseline) -> None:
    """Raise `ValueError` for what no recording holds."""
    texts = [b.model, b.digest, b.target, b.processor, *b.states.kinds, *b.versions, *b.versions.values(), *b.errors]
    if not all(isinstance(x, str) for x in texts):
        raise ValueError("a name, a target or a version is no text")
    if type(b.seed) is not int or type(b.rollout.steps) is not int or not 0 < b.rollout.steps <= _MOST_STEPS:
        raise ValueError(f"expected a whole number as seed, and 1 to {_MOST_STEPS} steps of the rollout")
    if not b.terms or not b.errors or "M" not in b.terms:
        raise ValueError("no terms, no mass matrix or no engines")
    n, nv = len(b.states.kinds), len(b.velocities)
    arrays: list[tuple[str, Array, tuple[int, ...]]] = [("q", b.states.q, (n, len(b.coordinates)))]
    arrays += [(x, getattr(b.states, x), (n, nv)) for x in ("v", "a", "tau")]
    for terms in (b.terms, *b.own.values()):
        arrays += [
            (term, x, (len(b.coordinates) + nv,) if term == ROLLOUT else _shape(term, (n, nv)))
            for term, x in terms.items()
        ]
    for name, x, shape in arrays:
        if x.shape != shape:
            raise ValueError(f"{name}: expected numbers of shape {shape}, got {x.shape}")
        if not np.isfinite(x).all():
            raise ValueError(f"{name}: a number is not finite")
    for section, parts in b.description.items():
        for part in parts.values():
            for field, x in part.items():
                if not (_is_number(x) if field == "mass" else isinstance(x, str) or _are_numbers(x)):
                    raise ValueError(f"{section}: {field}: expected numbers or text, got {x!r}")
    if np.shape(moving_mass(b.description)[1]) != (3,):
        raise ValueError("gravity: expected three numbers")
    errors = [x for terms in b.errors.values() for x in terms.values()]
    if not np.isfinite([*errors, b.rollout.dt]).all() or min([*errors, b.rollout.dt]) < 0:
        raise ValueError("an error or the rollout's step is negative or not finite")


def _are_numbers(x: object) -> bool:
    return all(map(_is_number, x)) if isinstance(x, list) else _is_number(x)


def _is_number(x: object) -> bool:
    return isinstance(x, float) or (type(x) is int and abs(x) < 2**53)


def _errors(t: Mapping[str, Any], engine: str) -> dict[str, float]:
    """Return the errors of every term that an engine gave."""
    told, without = t.get("errors", {}).get(engine, {}), t.get("left_out", {}).get(engine, {})
    return {term: told.get(term, 0.0) for term in t["terms"] if term not in without}


def _description(t: Mapping[str, Any]) -> Description:
    return {s: {"": dict(t[s])} if s in FLAT else dict(t[s]) for s in SECTIONS if s in t}


# Arrays as rows by name.


def _rows(names: Sequence[str], x: Array) -> dict[str, float]:
    return dict(zip(names, x.tolist(), strict=True))


def _columns(names: Sequence[str], x: Array) -> dict[str, list[float]]:
    """Return (N, n) numbers as n rows, each with a joint's numbers at all states."""
    return dict(zip(names, x.T.tolist(), strict=True))


def _vector(rows: Mapping[str, float]) -> Array:
    return np.array(list(rows.values()), dtype=np.float64)


def _unfolded(rows: Mapping[str, Sequence[float]]) -> Array:
    return np.ascontiguousarray(np.array(list(rows.values()), dtype=np.float64).T)


def _values(b: Baseline, term: str, x: Array, *, half: bool) -> Any:
    """Return a term's values: what is zero in every state as one zero, and of a symmetric matrix the lower half."""
    if term == ROLLOUT:
        n = len(b.coordinates)
        return {"q": _rows(b.coordinates, x[:n]), "v": _rows(b.velocities, x[n:])}
    if not x.any():
        return 0.0
    if x.ndim == 1:
        return x.tolist()
    if x.ndim == 2:
        return _columns(b.velocities, x)
    return {str(k + 1): _half(b.velocities, M) if half else _columns(b.velocities, M.T) for k, M in enumerate(x)}


def _half(names: Sequence[str], M: Array) -> dict[str, list[float]]:
    """Return of each row what is left of the diagonal, from its first entry that is not zero, and the diagonal."""
    first = [int(np.flatnonzero(np.append(M[i, :i], 1.0))[0]) for i in range(len(M))]
    return {name: M[i, first[i] : i + 1].tolist() for i, name in enumerate(names)}


def _read(term: str, value: Any, sizes: tuple[int, int], *, half: bool) -> Array:
    if term == ROLLOUT:
        return np.concatenate([_vector(value["q"]), _vector(value["v"])])
    if isinstance(value, list):
        return np.array(value, dtype=np.float64)
    if isinstance(value, float):
        if value:
            raise ValueError(f"{term}: expected rows of numbers or 0.0, got {value!r}")
        return np.zeros(_shape(term, sizes))
    if term == "M":
        return np.array([_matrix(list(rows.values()), half) for rows in value.values()])
    return _unfolded(value)


def _shape(term: str, sizes: tuple[int, int]) -> tuple[int, ...]:
    if term.endswith("energy"):
        return sizes[:1]
    return (*sizes, sizes[1]) if term == "M" else sizes


def _matrix(rows: Sequence[Sequence[float]], half: bool) -> Array:
    if not half:
        return np.array(rows, dtype=np.float64)
    M = np.zeros((len(rows), len(rows)))
    for i, row in enumerate(rows):
        M[i, i + 1 - len(row) : i + 1] = M[i + 1 - len(row) : i + 1, i] = row
    return M
