"""Many variants of one model: numbers drawn at random, reproducibly, and always of bodies that can be.

The inertia of a body is drawn by the Cholesky factor of its pseudo-inertia J, which is positive definite for every
distribution of mass: J' = L T Tᵀ Lᵀ with J = L Lᵀ and T lower triangular. T has a log-normal diagonal and normal
entries below it, and the spread is that of T Tᵀ, whatever units and axes (Wensing, Kim and Slotine 2018, Linear matrix
inequalities for physically consistent inertial parameter identification; Rucker and Wensing 2022, Smooth
parameterization of rigid-body inertia).
"""

from __future__ import annotations

import csv
import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, overload

import numpy as np

from mbkit._check import MAX_LINES, ROUNDING, Array, by_key, count, finite_array, real, shown
from mbkit._escape import csv_text, html
from mbkit.engines.base import Dynamics
from mbkit.engines.registry import DERIVED, dynamics, find_engine
from mbkit.errors import InputError, MbkitWarning, UnsupportedError, warn, writing
from mbkit.model.builder import expect_model, shape_of
from mbkit.model.changes.freeing import (
    FREE,
    LOG_CHOLESKY,
    SYMMETRIC,
    Scale,
    chosen,
    log_cholesky,
    numbers_of,
    with_free,
)
from mbkit.model.model import Model

#: Spread of a path: a size, the ends of a uniform range, or a function of a generator and how many to draw.
Spread = float | tuple[float, float] | Callable[[np.random.Generator, int], Any]
#: All ten numbers of a body together.
_INERTIAL: Final = ".inertial"
_LOWER: Final = np.tril_indices(3)


@dataclass(frozen=True, eq=False)
class Variants:
    """Variants of a model, as parameters and their values.

    Attributes
    ----------
    model : Model
        With the varied numbers as parameters.
    values : dict of str to (n,) array
        Drawn values of each parameter.
    seed : int
    """

    model: Model
    values: Mapping[str, Array]
    seed: int

    def __len__(self) -> int:
        return len(next(iter(self.values.values())))

    @overload
    def __getitem__(self, k: int) -> Model: ...
    @overload
    def __getitem__(self, k: slice) -> Variants: ...
    def __getitem__(self, k: int | slice) -> Model | Variants:
        """Return variant k as a model of plain numbers, for every engine; the variants of a slice, as of a list."""
        if isinstance(k, slice) and len(range(len(self))[k]):
            return replace(self, values={name: x[k] for name, x in self.values.items()})
        if isinstance(k, bool) or not isinstance(k, (int, np.integer)) or not -len(self) <= k < len(self):
            last = len(self) - 1
            raise InputError(f"variant: expected a whole number from 0 to {last}, or from the end, got {shown(k)}")
        return self.model.with_parameters(**{name: float(x[k]) for name, x in self.values.items()})

    def __iter__(self) -> Iterator[Model]:
        return (self[k] for k in range(len(self)))

    def dynamics(self, engine: str | None = None, **options: Any) -> Dynamics:
        """Return the own derivation's dynamics of all variants, one a member of each batch; derived once.

        Parameters
        ----------
        engine : str, optional
            ``"lagrangian"``; others take variants one by one.
        **options
            Those of ``mbkit.dynamics(model, "lagrangian", ...)``.
        """
        if engine not in (None, DERIVED):
            name = find_engine(engine).name
            raise UnsupportedError(f"variants: {name} takes them one by one, as mbkit.dynamics(many[k], {name!r})")
        return dynamics(self.model, DERIVED, **options).at(**self.values)

    def to_dict(self) -> dict[str, Any]:
        """Return the seed and the values by name, as JSON takes them."""
        values = {name: x.tolist() for name, x in self.values.items()}
        return {"model": self.model.name, "seed": self.seed, "values": values}

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Write a table of what was drawn, a row a variant."""
        if not isinstance(path, (str, os.PathLike)):
            raise InputError(f"path: expected a path, got {shown(path)}")
        rows = np.stack([*self.values.values()], 1).tolist()
        with writing(path), Path(path).open("w", newline="", encoding="utf-8") as file:
            write = csv.writer(file)
            write.writerow(["variant", *map(csv_text, self.values)])
            write.writerows([k, *map(repr, row)] for k, row in enumerate(rows))

    def _summary(self) -> list[tuple[str, str, str, str, str]]:
        nominal = self.model.parameters
        return [
            (name, f"{nominal[name]:.4g}", f"{x.mean():.4g}", f"{x.std():.2g}", f"{x.min():.4g} to {x.max():.4g}")
            for name, x in self.values.items()
        ]

    def __repr__(self) -> str:
        return f"<Variants of {self.model.name!r}: {len(self)} of {len(self.values)} numbers, seed {self.seed}>"

    def __str__(self) -> str:
        rows = [("number", "nominal", "mean", "std", "range"), *self._summary()]
        more = len(rows) - 1 - MAX_LINES
        rows = rows[: MAX_LINES + 1]
        widths = [max(len(row[k]) for row in rows) for k in range(5)]
        lines = ["  ".join(x.ljust(w) for x, w in zip(row, widths, strict=True)).rstrip() for row in rows]
        head = f"{self.model.name}: {len(self)} variants, seed {self.seed}"
        return "\n".join([head, *lines, *([f"and {more} more numbers"] if more > 0 else [])])

    def _repr_html_(self) -> str:
        head = "".join(f"<th>{x}</th>" for x in ("number", "nominal", "mean", "std", "range"))
        rows = "".join(f"<tr>{''.join(f'<td>{html(x)}</td>' for x in row)}</tr>" for row in self._summary())
        title = f"<p><b>{html(self.model.name)}</b>: {len(self)} variants, seed {self.seed}</p>"
        return f"{title}<table><tr>{head}</tr>{rows}</table>"


def variants(robot: Model, spread: Mapping[Any, Spread], *, size: int = 1000, seed: int = 0) -> Variants:
    """Draw variants of a model: other masses, inertias, dampers, payloads, gravity; what takes no parameter stays.

    Parameters
    ----------
    robot : Model
    spread : mapping
        From paths, as `Model.with_free` takes them, or a `scale`, to how far their numbers spread. One number is the
        standard deviation of the logarithm, so that masses, dampers and the like keep their sign (0.1 is about 10 %).
        Of places, ``com``, ``rest``, gravity, and ``offset``, ``rate`` and ``phase`` of motions it is that of the
        number itself, in its units. Two numbers are the ends of a uniform range; a function gets a
        `numpy.random.Generator` and how many numbers to return.

        ``"link.inertia"`` draws the six numbers about the centre of mass, and ``"link.inertial"`` all ten numbers of a
        body together, by their pseudo-inertia: every draw is a body that can be. ``"link.log_cholesky"`` draws the
        ten parameters of `Model.with_free` themselves, each with the same spread.
    size : int
        How many variants.
    seed : int
        The same numbers for the same seed, whatever else is varied beside a path.

    Returns
    -------
    Variants

    Raises
    ------
    InputError
        A path that fits nothing, another spread than these, and draws that no body can have, by name.

    Warns
    -----
    MbkitWarning
        A standard deviation of a logarithm above 1.

    Examples
    --------
    >>> import mbkit as mb
    >>> many = mb.variants(mb.load("ur5"), {"*.mass": 0.1, "forearm_link.inertia": 0.2}, size=100, seed=1)
    >>> many
    <Variants of 'ur5': 100 of 12 numbers, seed 1>
    >>> many.dynamics().mass_matrix([0.0] * 6).shape, many[7].nv
    ((100, 6, 6), 6)
    """
    model = expect_model(robot, "robot")
    FREE.admit(model, "variants: not known of")
    size, seed = count("size", size, least=1), count("seed", seed)
    if not isinstance(spread, Mapping) or not spread:
        raise InputError(f"spread: expected a mapping from paths to spreads, got {shown(spread)}")
    values: dict[str, Array] = {}
    paths: list[Any] = []
    added = {x.path for x in numbers_of(model) if x.rule.added}
    for path, how in spread.items():
        rng = np.random.default_rng([seed, zlib.crc32(str(path).encode())])
        # A number beyond a double's range is told by name.
        with np.errstate(over="ignore", invalid="ignore"):
            drawn = _drawn(model, path, how, rng, size)
        factor = drawn and not callable(how) and shape_of(how) == () and not {*drawn} <= added
        # A factor of more than e: per cent are a common reason.
        if factor and (away := real("spread", how)) > 1.0:
            name, x = next(iter(drawn.items()))
            says = "is the standard deviation of the logarithm, in which 0.1 is about 10 %"
            warn(f"spread: {str(path)!r}: {away:g} {says}; {name!r} is {x.min():.1g} to {x.max():.1g}", MbkitWarning)
        if twice := [name for name in drawn if name in values]:
            raise InputError(f"spread: {twice[0]!r} is in two entries of the spread; draw it by one")
        if wide := [name for name, x in drawn.items() if not np.isfinite(x).all()]:
            raise InputError(f"spread: {str(path)!r}: {wide[0]!r} leaves a double's range; give a smaller spread")
        values |= drawn
        whole = isinstance(path, Scale) or path.endswith(LOG_CHOLESKY)
        paths += [path] if whole else [*drawn]
    free = with_free(model, paths)
    _require_bodies_that_can_be(model, values, [x for x in spread if isinstance(x, Scale)], size)
    return Variants(free, values, seed)


def _drawn(model: Model, path: Any, how: Spread, rng: np.random.Generator, size: int) -> dict[str, Array]:
    """Return the draws of one entry of a spread, by parameter."""
    item = f"spread: {str(path)!r}"
    if isinstance(path, Scale):
        return {path.name: _numbers(item, 1.0, how, rng, size, added=False)}
    if not isinstance(path, str):
        raise InputError(f"spread: expected paths such as '*.mass' or a scale, got {shown(path)}")
    if path.endswith(LOG_CHOLESKY):
        bodies = dict.fromkeys(x.part for x in chosen(model, f"{path.removesuffix(LOG_CHOLESKY)}.mass"))
        ten = {k: x for name in bodies for k, x in log_cholesky(model.body(name)).items()}
        return {k: _numbers(f"{item}: {k}", x, how, rng, size, added=True) for k, x in ten.items()}
    if path.endswith(_INERTIAL):
        bodies = dict.fromkeys(x.part for x in chosen(model, f"{path.removesuffix(_INERTIAL)}.mass"))
        return {k: x for name in bodies for k, x in _bodies_drawn(model, name, _size(item, how), rng, size).items()}
    numbers = chosen(model, path)
    out: dict[str, Array] = {}
    if not callable(how) and shape_of(how) == ():
        for name in dict.fromkeys(x.part for x in numbers if x.field == "inertia"):
            six = [x for x in numbers if (x.part, x.field) == (name, "inertia")]
            # A single moment is a number like others.
            if len(six) == len(SYMMETRIC):
                out |= _bodies_drawn(model, name, _size(item, how), rng, size, about_com=True)
                numbers = [x for x in numbers if x not in six]
    for x in numbers:
        if path != x.path and not (x.value or x.rule.added or callable(how)) and shape_of(how) == ():
            # A factor leaves the zeros of a vector as they are.
            continue
        out[x.path] = _numbers(f"{item}: {x.path}", x.value, how, rng, size, added=x.rule.added)
    return out


def _size(item: str, how: Spread) -> float:
    if callable(how) or shape_of(how) != ():
        raise InputError(f"{item}: expected one number for a whole inertia, got {shown(how)}")
    return real(item, how, positive=True)


def _numbers(item: str, nominal: float, how: Spread, rng: np.random.Generator, size: int, *, added: bool) -> Array:
    if callable(how):
        try:
            drawn = how(rng, size)
        except TypeError as error:
            raise InputError(f"{item}: expected a function of a generator and a number of draws: {error}") from None
        return finite_array(item, drawn, (size,))
    if shape_of(how) == ():
        if not nominal and not added:
            raise InputError(f"{item} is zero, which a spread by a factor leaves; give a range, such as (0, 1)")
        away = real(item, how, positive=True) * rng.standard_normal(size)
        return np.asarray(nominal + away if added else nominal * np.exp(away))
    low, high = finite_array(item, how, (2,))
    if low > high:
        raise InputError(f"{item}: expected the lower end first, got {low:g} and {high:g}")
    return rng.uniform(low, high, size)


def _bodies_drawn(
    model: Model, name: str, spread: float, rng: np.random.Generator, size: int, *, about_com: bool = False
) -> dict[str, Array]:
    """Return draws of a body's inertial numbers by the Cholesky factor of its pseudo-inertia."""
    body = model.body(name)
    if not body.mass > 0:
        raise InputError(f"spread: body {name!r} has no mass, so that no inertia is drawn about it; give a range")
    # Second moments about the centre of mass, m (Σ_c + c cᵀ) below m and m c.
    second = 0.5 * np.trace(body.inertia) * np.eye(3) - body.inertia
    try:
        # A rod or a point has none across.
        L = np.linalg.cholesky(second + ROUNDING * max(np.trace(second), body.mass * 1e-9) * np.eye(3))
    except np.linalg.LinAlgError:
        raise InputError(
            f"spread: body {name!r} has an inertia that no matter has, so that none is drawn about it; correct it"
        ) from None
    T = np.zeros((size, 3, 3))
    # Half of it, since the inertia has the factor's square.
    T[:, *_LOWER] = 0.5 * spread * rng.standard_normal((size, 6))
    diagonal = np.arange(3)
    out: dict[str, Array] = {}
    T[:, diagonal, diagonal] = np.exp(T[:, diagonal, diagonal])
    factor = L @ T
    moments = factor @ factor.swapaxes(1, 2)
    if not about_com:
        # The rest of the whole factor: the mass, and below it the centre of mass, in the body's radii of gyration.
        out[f"{name}.mass"] = body.mass * np.exp(spread * rng.standard_normal(size))
        away = spread * rng.standard_normal((size, 3)) @ L.T / np.sqrt(body.mass)
        out |= {f"{name}.com.{axis}": body.com[k] + away[:, k] for k, axis in enumerate("xyz")}
    inertias = np.trace(moments, axis1=1, axis2=2)[:, None, None] * np.eye(3) - moments
    wanted = [x for x in numbers_of(model) if (x.where, x.part, x.field) == ("bodies", name, "inertia")]
    return out | {x.path: inertias[:, x.indices[0][0], x.indices[0][1]] for x in wanted}


def _require_bodies_that_can_be(model: Model, values: Mapping[str, Array], scales: Sequence[Scale], size: int) -> None:
    """Refuse draws that no body, damper or spring can have (InputError)."""
    numbers = {x.path: x for x in numbers_of(model)}
    drawn = {path: values[path] for path in numbers if path in values}
    for one in scales:
        for x in {x.path: x for pattern in one.patterns for x in chosen(model, pattern)}.values():
            drawn[x.path] = drawn.get(x.path, x.value) * values[one.name]
    for path, value in drawn.items():
        x, never = numbers[path], np.zeros(size, dtype=bool)
        if x.value >= x.rule.least:
            never = value <= x.rule.least if x.rule.positive and x.value > x.rule.least else value < x.rule.least
        if len(bad := np.flatnonzero(never)):
            raise InputError(
                f"spread: {path!r} is {'zero or ' * x.rule.positive}negative in {len(bad)} of {size} variants, "
                f"such as {value[bad[0]]:.3g} in {bad[0]}; give a smaller spread, or a range that it can have"
            )
    matrices = (x for path in drawn if len((x := numbers[path]).indices[0]) == 2)
    for (where, name, field), own in by_key(((x.where, x.part, x.field), x) for x in matrices).items():
        nominal = next(getattr(part, field) for part in getattr(model, where) if part.name == name)
        every = np.tile(nominal, (size, 1, 1))
        for x in own:
            for index in x.indices:
                every[:, index[0], index[1]] = drawn[x.path]
        trace = np.trace(every, axis1=1, axis2=2)
        if field == "inertia":
            moments, says = 0.5 * trace[:, None, None] * np.eye(3) - every, "an inertia that no matter has"
            instead = f"one number for {name + '.inertia'!r} draws inertias that can be"
        else:
            moments, says = 0.5 * (every + every.swapaxes(1, 2)), f"a {field} that drives the motion"
            instead = "give a smaller spread"
        least = np.linalg.eigvalsh(moments)[:, 0]
        if len(bad := np.flatnonzero(least < -ROUNDING * np.abs(trace))):
            raise InputError(
                f"spread: {name!r} has {says} in {len(bad)} of {size} variants, such as {bad[0]}; {instead}"
            )
