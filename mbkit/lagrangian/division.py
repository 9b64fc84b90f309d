"""Exact division of sums of cosines and sines.

With z = exp(i θ) a cosine is (z + 1/z)/2 and a sine (z - 1/z)/(2 i), so a sum is a polynomial in the z's and the
generators with exponents of either sign. Such polynomials factor in one way only: whether one divides another is
found term by term, modulo sin² + cos² = 1 and without a search.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Final

from mbkit.lagrangian.harmonic import Harmonic

__all__ = ["quotient"]

#: Terms of a quotient that is worth having.
_MOST: Final = 400

#: Exponents of the z's and the generators -> real and imaginary part.
_Exponents = tuple[int, ...]
_Complex = tuple[Fraction, Fraction]
_Exponential = dict[_Exponents, _Complex]


def quotient(above: Harmonic, below: Harmonic) -> Harmonic | None:
    """Return above / below where that is such a sum again; None where it is not."""
    if not above.terms or not below.terms:
        return None
    a, b = _exponential(above), _exponential(below)
    # Of a product the least and the largest exponents add, of each variable by itself.
    low, high = ([p - q for p, q in zip(f(a), f(b), strict=True)] for f in (_least, _largest))
    lead = max(b)
    out: _Exponential = {}
    while a:
        first = max(a)
        step = tuple(p - q for p, q in zip(first, lead, strict=True))
        if any(not i <= e <= j for i, e, j in zip(low, step, high, strict=True)) or len(out) == _MOST:
            return None
        out[step] = factor = _ratio(a[first], b[lead])
        for exponents, value in b.items():
            _subtract(a, tuple(p + q for p, q in zip(exponents, step, strict=True)), _times(factor, value))
    return _sum(above, out)


def _exponential(x: Harmonic) -> _Exponential:
    out: _Exponential = {}
    for (kind, turns, powers), value in x.terms.items():
        if not any(turns):
            out[(*turns, *powers)] = value, Fraction(0)
            continue
        half, back = value / 2, tuple(-k for k in turns)
        for exponents, sign in (((*turns, *powers), -1), ((*back, *powers), 1)):
            real, imaginary = out.get(exponents, (Fraction(0), Fraction(0)))
            out[exponents] = (real, imaginary + sign * half) if kind else (real + half, imaginary)
    return out


def _sum(like: Harmonic, x: _Exponential) -> Harmonic:
    n, terms = len(like.space.angles), {}
    for exponents, (real, imaginary) in x.items():
        turns, powers = exponents[:n], exponents[n:]
        first = next((k for k in turns if k), 0)
        if not first:
            terms[0, turns, powers] = real
        elif first > 0:
            terms |= {(kind, turns, powers): part for kind, part in ((0, 2 * real), (1, -2 * imaginary)) if part}
    return Harmonic(like.space, terms)


def _least(x: _Exponential) -> list[int]:
    return [min(e) for e in zip(*x, strict=True)]


def _largest(x: _Exponential) -> list[int]:
    return [max(e) for e in zip(*x, strict=True)]


def _times(x: _Complex, y: _Complex) -> _Complex:
    return x[0] * y[0] - x[1] * y[1], x[0] * y[1] + x[1] * y[0]


def _ratio(x: _Complex, y: _Complex) -> _Complex:
    size = y[0] ** 2 + y[1] ** 2
    real, imaginary = _times(x, (y[0], -y[1]))
    return real / size, imaginary / size


def _subtract(out: _Exponential, exponents: _Exponents, value: _Complex) -> None:
    real, imaginary = out.get(exponents, (Fraction(0), Fraction(0)))
    left = real - value[0], imaginary - value[1]
    if any(left):
        out[exponents] = left
    else:
        out.pop(exponents, None)
