"""Powers of the cosines and sines of single angles in place of multiples of angles: sin² θ for ½ - ½ cos 2θ."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from math import comb, gcd
from typing import Final

import sympy as sp

from mbkit.lagrangian.harmonic import Harmonic, Space

__all__ = ["Form", "FormKey", "of_one_angle", "split"]

#: Sums of angles that are taken as one.
_COMBINED: Final = 2

#: Powers (angle, of cos, of sin) of single angles.
_Powers = tuple[tuple[int, int, int], ...]
#: Those, the kind and multiples of what is left, exponents of the generators.
FormKey = tuple[_Powers, int, tuple[int, ...], tuple[int, ...]]
Form = dict[FormKey, Fraction]


def split(x: Harmonic, subset: tuple[int, ...], kept: int) -> Form:
    """Return a form: Re or Im of Π (cos a + i sin a)^k (cos rest + i sin rest), power by power."""
    out: Form = {}
    for (kind, multiples, powers), value in x.terms.items():
        rest = tuple(0 if i in subset else k for i, k in enumerate(multiples))
        first = next((k for k in rest if k), 0)
        sign = -1 if first < 0 else 1
        rest = tuple(sign * k for k in rest)
        parts: list[tuple[_Powers, int, int]] = [((), 0, 1)]
        for i in subset:
            if multiples[i]:
                parts = [
                    ((*done, (i, c, s)), turns + (s if multiples[i] > 0 else -s), factor * times)
                    for done, turns, factor in parts
                    for c, s, times in _powers(abs(multiples[i]))
                ]
        for done, turns, factor in parts:
            for part in (0, 1) if first else (0,):
                # A power of i: real for a cosine, imaginary for a sine.
                total = (turns + part) % 4
                if total % 2 == kind:
                    amount = value * factor * (-1 if total >= 2 else 1) * (sign if part else 1)
                    for reduced, weight in _reduced(done, kept):
                        _gather(out, (reduced, part, rest, powers), amount * weight)
    return out


def _powers(k: int) -> list[tuple[int, int, int]]:
    """Return (power of cos, of sin, coefficient) of (cos + i sin)^k, without the powers of i."""
    return [(k - s, s, comb(k, s)) for s in range(k + 1)]


def _reduced(done: _Powers, kept: int) -> Iterator[tuple[_Powers, int]]:
    """Yield a product of powers with the square that is not kept replaced by 1 less the other's."""
    if not done:
        yield (), 1
        return
    (i, c, s), *others = done
    gone, stays = (s, c) if kept == 0 else (c, s)
    for rest, weight in _reduced(tuple(others), kept):
        half = gone // 2
        for n in range(half + 1):
            a, b = stays + 2 * n, gone % 2
            power = (i, a, b) if kept == 0 else (i, b, a)
            yield ((power, *rest) if a or b else rest), weight * comb(half, n) * (-1) ** n


def _gather(out: Form, key: FormKey, value: Fraction) -> None:
    total = out.get(key, Fraction(0)) + value
    if total:
        out[key] = total
    else:
        out.pop(key, None)


def of_one_angle(x: Harmonic) -> Iterator[Harmonic]:
    """Yield a sum with an angle more, such as θ₁ - θ₂, where twice that angle stands in it."""
    space = x.space
    found = dict.fromkeys(_direction(key[1]) for key in x.terms if gcd(*key[1]) > 1 and sum(map(bool, key[1])) > 1)
    for direction in list(found)[:_COMBINED]:
        angle = sp.Add(*(k * a for k, a in zip(direction, space.angles, strict=True)))
        # SymPy writes sin(b - a) as -sin(a - b).
        sign = -1 if sp.sin(angle).is_Mul else 1
        wider = Space(space.name, [*space.angles, sign * angle], space.generators, space.most, space.instead)
        terms = {}
        for (kind, turns, powers), value in x.terms.items():
            along = any(turns) and _direction(turns) == direction
            more = ((0,) * len(turns), gcd(*turns)) if along else (turns, 0)
            # Of a sine the sign of the angle comes before it.
            terms[kind, (*more[0], more[1]), powers] = value * (sign if along and kind else 1)
        yield Harmonic(wider, terms)


def _direction(turns: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(k // gcd(*turns) for k in turns) if any(turns) else turns
