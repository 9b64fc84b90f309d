"""Laws of motions prescribed in time: what a joint's coordinate is at a time, on any arithmetic.

A law is one class and one line in `MOTION_LAWS`. Laws have continuous second derivatives, since accelerations and
the forces of drives follow from them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from math import inf
from typing import Annotated, Any, Final

import numpy as np

from mbkit._check import PRINTED, ROUNDING, Array
from mbkit.model.elements.formula import Arithmetic, Formula
from mbkit.model.parts import Constants, NumberRule, OfJoint, Prescribed

_TABLE: Final = NumberRule(shape=None, fixed="it is a table's")
#: Comparisons of each evaluation grow with the knots: at so many a step takes some 0.1 ms.
MAX_KNOTS: Final = 2000


@dataclass(frozen=True, eq=False)
class FormulaMotion(OfJoint):
    """A coordinate moved by a formula of the time.

    Attributes
    ----------
    joint : str
    formula : Formula
        Of the time ``"t"`` and of `symbols`; twice continuously differentiable.
    symbols : tuple of str
        The names of `numbers` in the formula.
    numbers : (k,) array
        May be parameters of the model.
    """

    joint: str
    formula: Formula
    symbols: tuple[str, ...]
    numbers: Constants

    @property
    def constants(self) -> tuple[float, ...]:
        """The numbers in the formula."""
        return self.formula.constants


@dataclass(frozen=True, eq=False)
class SplineMotion(OfJoint):
    """A coordinate moved by polynomials between knots: x = Σ_j coefficients[j, i] (t - knots[i])^(d - j).

    It is defined from the first knot to the last one.

    Attributes
    ----------
    joint : str
    knots : (k + 1,) array
        s, increasing.
    coefficients : (d + 1, k) array
        Highest power first, as `scipy.interpolate.PPoly` has them.
    """

    joint: str
    knots: Annotated[Array, _TABLE]
    coefficients: Annotated[Array, _TABLE]
    constants = ()


#: A motion prescribed in time.
Motion = Prescribed | FormulaMotion | SplineMotion


def _harmonic(_: Prescribed, x: Any, t: Any, arithmetic: Arithmetic) -> Any:
    return x.offset + x.rate * t + x.amplitude * arithmetic.operations["sin"](x.frequency * t + x.phase)


def _of_formula(part: FormulaMotion, x: Any, t: Any, arithmetic: Arithmetic) -> Any:
    return part.formula({"t": t} | dict(zip(part.symbols, x.numbers, strict=True)), arithmetic)[0]


def _of_pieces(_: SplineMotion, x: Any, t: Any, arithmetic: Arithmetic) -> Any:
    """Return the polynomial of the piece that t is in; the first and the last one go on beyond the ends.

    Of all pieces one counts, so that a sum selects its numbers without rounding.
    """
    le, no, pick, mul = (arithmetic.operations[n] for n in ("le", "not", "if_else_zero", "mul"))
    knots, rows = list(x.knots), [list(row) for row in x.coefficients]
    here: list[Any] = []
    if len(rows[0]) > 1:
        begun = [le(knot, t) for knot in knots[1:-1]]
        here = [no(begun[0]), *(mul(a, no(b)) for a, b in pairwise(begun)), begun[-1]]

    def chosen(values: list[Any]) -> Any:
        return sum((pick(c, v) for c, v in zip(here, values, strict=True)), 0.0) if here else values[0]

    s = t - chosen(knots[:-1])
    out = chosen(rows[0])
    for row in rows[1:]:
        out = out * s + chosen(row)
    return out


#: Class of a law -> its function of the part, its numbers or what stands for them, the time and an arithmetic, which
#: returns the coordinate.
MOTION_LAWS: Final[dict[type, Callable[[Any, Any, Any, Arithmetic], Any]]] = {
    Prescribed: _harmonic,
    FormulaMotion: _of_formula,
    SplineMotion: _of_pieces,
}


def motions_of(model: Any) -> list[Any]:
    """Return the motions among the constraints of a description."""
    return [x for x in model.constraints if type(x) in MOTION_LAWS]


def position(part: Motion, t: Any, arithmetic: Arithmetic) -> Any:
    """Return the coordinate at a time, with the part's own numbers; of NumPy's arithmetic also at an array of times."""
    return MOTION_LAWS[type(part)](part, part, t, arithmetic)


def interval(part: Motion) -> tuple[float, float]:
    """Return the times from and to which a motion is defined, s."""
    return (float(part.knots[0]), float(part.knots[-1])) if isinstance(part, SplineMotion) else (-inf, inf)


def beyond(motions: tuple[Motion, ...], *times: float) -> str:
    """Return why not all motions are defined at some times; empty where they are."""
    for part in motions:
        first, last = interval(part)
        slack = ROUNDING * (abs(first) + abs(last))
        for t in times:
            if not first - slack <= t <= last + slack:
                return (
                    f"the motion of joint {part.joint!r} is a table from {first:.9g} to {last:.9g} s, "
                    f"and is not known at {t:.9g} s"
                )
    return ""


def motion_faults(motions: tuple[Motion, ...]) -> Iterator[str]:
    """Yield the faults of each law, and tables that have no time in common."""
    ends = [(*interval(part), part.joint) for part in motions]
    if ends and max(ends)[0] >= (least := min(ends, key=lambda x: x[1]))[1]:
        first, _, joint = max(ends)
        yield f"prescribed {joint!r}: its table begins at {first:.9g} s, where that of {least[2]!r} is over"
    for part in motions:
        item = f"prescribed {part.joint!r}"
        if isinstance(part, FormulaMotion):
            for name in part.formula.arguments:
                if name != "t" and name not in part.symbols:
                    yield (
                        f"{item}: unknown symbol {name!r}; the time is 't', and a constant's value is given with "
                        f"parameters={{{name!r}: ...}}"
                    )
        elif isinstance(part, SplineMotion):
            yield from _spline_faults(item, part)


def _spline_faults(item: str, part: SplineMotion) -> Iterator[str]:
    knots, c = part.knots, part.coefficients
    if len(knots) > MAX_KNOTS:
        yield f"{item}: expected up to {MAX_KNOTS} knots, got {len(knots)}; thin out the table"
        return
    widths = np.diff(knots)
    if not (widths > 0).all():
        yield f"{item}: expected times that increase, got {knots[:-1][widths <= 0][0]:.9g} s and one not later"
        return
    for what in ("position", "velocity", "acceleration"):
        powers = np.arange(len(c) - 1, -1, -1)
        ends = sum(c[j] * widths ** powers[j] for j in range(len(c))) if len(c) else np.zeros(len(widths))
        starts = c[-1] if len(c) else np.zeros(len(widths))
        size = float(np.abs([ends, starts]).max(initial=0.0))
        jumps = np.abs(ends[:-1] - starts[1:])
        if size and (jumps > PRINTED * size).any():
            k = int(jumps.argmax())
            yield (
                f"{item}: the {what} jumps by {jumps[k]:.3g} at {knots[k + 1]:.9g} s; expected a spline with a "
                "continuous second derivative, such as scipy.interpolate.CubicSpline"
            )
            return
        c = c[:-1] * powers[:-1, None]
