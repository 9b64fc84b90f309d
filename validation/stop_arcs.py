"""Motions between rigid stops, arc by arc, as Taylor series of 40 digits, written apart from mbkit.

Nothing here imports mbkit. A system gives M and f of M(q) v̇ = f(q, v, t) as formulas; `run` integrates them from event
to event. A joint rests where friction or a stop can hold it. Which joints rest is found by trying every pattern, and
so is which contacts of an impact act: Newton's restitution for each, impulses that only push (Pfeiffer, Glocker 1996,
Multibody Dynamics with Unilateral Contacts, ch. 5 and 8). The systems are planar and derived by hand.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import mpmath as mp

DIGITS = 40
#: Terms of each series.
ORDER = 48
#: A coefficient below is zero: a gap that has just opened has leading ones of rounding alone.
ZERO = mp.mpf(10) ** -28
#: Velocity behind a hit from which no more bounces are followed: all that are left take as long, and less.
REST = mp.mpf(10) ** -20
#: Places within a step at which signs are looked at.
PLACES = 32


class Series:
    """Taylor coefficients in the time since the start of an arc, each computed when it is first asked for."""

    def __init__(self, term: Callable[[int], Any]) -> None:
        self.known, self.term = list[Any](), term

    def __getitem__(self, k: int) -> Any:
        while len(self.known) <= k:
            self.known.append(self.term(len(self.known)))
        return self.known[k]

    def __add__(self, other: Any) -> Series:
        other = series(other)
        return Series(lambda k: self[k] + other[k])

    def __mul__(self, other: Any) -> Series:
        if not isinstance(other, Series):
            return Series(lambda k: self[k] * other)
        return Series(lambda k: mp.fdot((self[j], other[k - j]) for j in range(k + 1)))

    def __neg__(self) -> Series:
        return self * -1

    def __sub__(self, other: Any) -> Series:
        return self + -series(other)

    def __rsub__(self, other: Any) -> Series:
        return -self + other

    __radd__, __rmul__ = __add__, __mul__

    def polynomial(self) -> list[Any]:
        """Return the coefficients from the highest down, without leading terms of time that are zero."""
        c = [self[k] for k in range(ORDER)]
        first = next((k for k, x in enumerate(c) if abs(x) > ZERO), ORDER - 1)
        return c[first:][::-1]

    def at(self, h: Any) -> Any:
        return mp.polyval([self[k] for k in range(ORDER)][::-1], h)


def series(x: Any) -> Series:
    return x if isinstance(x, Series) else Series(lambda k: mp.mpf(x) if k == 0 else mp.mpf(0))


def sine_cosine(x: Any) -> tuple[Any, Any]:
    if not isinstance(x, Series):
        return mp.sin(x), mp.cos(x)
    s = Series(lambda k: mp.fdot((j * x[j], c[k - j]) for j in range(1, k + 1)) / k if k else mp.sin(x[0]))
    c = Series(lambda k: -mp.fdot((j * x[j], s[k - j]) for j in range(1, k + 1)) / k if k else mp.cos(x[0]))
    return s, c


# Systems: (q, v, t) -> M, f


def chain(m: Any, l: Any, c: Any, J: Any, g: Any) -> Callable[..., Any]:
    """Links in a plane, the first angle from the vertical down, others from the link before; J about the centres at c.

    In angles φ from the vertical Σⱼ Aᵢⱼ (cos(φᵢ - φⱼ) φ̈ⱼ + sin(φᵢ - φⱼ) φ̇ⱼ²) + Jᵢ φ̈ᵢ + g bᵢ sin φᵢ = 0, which sums
    bring to the joints.
    """
    n = range(len(m))
    arms = [[l[i] if i < k else c[k] if i == k else mp.mpf(0) for i in n] for k in n]
    A = [[mp.fsum(m[k] * arms[k][i] * arms[k][j] for k in n) for j in n] for i in n]
    b = [mp.fsum(m[k] * arms[k][i] for k in n) for i in n]

    def terms(q: Any, v: Any, _: Any) -> Any:
        turned, rate = (list(itertools.accumulate(x)) for x in (q, v))
        s, cosine = zip(*map(sine_cosine, turned), strict=True)
        square = [x * x for x in rate]
        M = [[mp.mpf(0) for _ in n] for _ in n]
        f = [-g * b[i] * s[i] for i in n]
        for i in n:
            M[i][i] = A[i][i] + J[i]
            for j in range(i):
                M[i][j] = M[j][i] = A[i][j] * (cosine[i] * cosine[j] + s[i] * s[j])
                across = A[i][j] * (s[i] * cosine[j] - cosine[i] * s[j])
                f[i], f[j] = f[i] - across * square[j], f[j] + across * square[i]
        at_joints = [sums([sums(row)[j] for row in M]) for j in n]
        return at_joints, sums(f)

    return terms


def sums(x: Any) -> list[Any]:
    """Return of each the sum from it on."""
    return list(itertools.accumulate(reversed(x)))[::-1]


def on_a_cart(M: Any, m: Any, c: Any, J: Any, g: Any) -> Callable[..., Any]:
    """A link that hangs on a cart: x of the cart, angle from the vertical down, J about the centre of mass at c."""

    def terms(q: Any, v: Any, _: Any) -> Any:
        s, cosine = sine_cosine(q[1])
        f = [m * c * (s * (v[1] * v[1])), -m * g * c * s]
        return [[M + m, m * c * cosine], [m * c * cosine, J + m * c**2]], f

    return terms


def sliders(m: Sequence[Any], g: Any = 0, push: Any = None) -> Callable[..., Any]:
    """Sliders each on the one before it, with gravity against the way; `push` gives forces of q, v and t."""
    above = [mp.fsum(m[i:]) for i in range(len(m))]

    def terms(q: Any, v: Any, t: Any) -> Any:
        n = range(len(m))
        more = push(q, v, t) if push else [0 for _ in n]
        return [[above[max(i, j)] for j in n] for i in n], [more[i] - above[i] * g for i in n]

    return terms


# Runs


class Event(NamedTuple):
    """`kind` is hits, rests or leaves, of a stop, and stops, turns or lets go, of friction.

    `side` is -1 for the lower stop, 1 for the upper, and for friction the way.
    """

    t: Any
    kind: str
    joint: int
    side: int
    q: list[Any]
    before: list[Any]
    after: list[Any]
    lost: Any


@dataclass(frozen=True)
class Stop:
    """Bounds of a joint, None where there is none."""

    lower: Any = None
    upper: Any = None
    e: Any = 0

    def reached(self, q: Any) -> int:
        """Return -1 on the lower bound, 1 on the upper, 0 between; states on a bound are set there."""
        return (self.upper is not None and q == self.upper) - (self.lower is not None and q == self.lower)


def inverse(M: Any, which: Sequence[int]) -> list[list[Any]]:
    """Return the inverse of some rows and columns, zero elsewhere."""
    out = [[mp.mpf(0) for _ in M] for _ in M]
    if which:
        part = mp.inverse(mp.matrix([[M[i][j] for j in which] for i in which]))
        for (k, i), (l, j) in itertools.product(enumerate(which), repeat=2):
            out[i][j] = part[k, l]
    return out


def times(M: Any, x: Any) -> list[Any]:
    return [mp.fdot(row, x) for row in M]


def energy_of_motion(M: Any, v: Any) -> Any:
    n = range(len(v))
    return mp.fsum(v[i] * M[i][j] * v[j] for i in n for j in n) / 2


def impact(M: Any, v: Any, sides: Sequence[int], e: Sequence[Any]) -> list[Any]:
    """Return velocities after an impact: 0 <= p, 0 <= u⁺ + e u⁻ with one of them zero, u inwards, at each contact."""
    n, contacts, found = range(len(v)), [k for k in range(len(v)) if sides[k]], []
    W = inverse(M, n)
    for closed in itertools.product((False, True), repeat=len(contacts)):
        acts = [k for k, on in zip(contacts, closed, strict=True) if on]
        p = times(inverse(W, acts), [-(1 + e[k]) * v[k] for k in n])
        after = [a + b for a, b in zip(v, times(W, p), strict=True)]
        pushes = all(-sides[k] * p[k] >= 0 for k in acts)
        if pushes and all(-sides[k] * (after[k] + e[k] * v[k]) >= -ZERO for k in contacts if k not in acts):
            for k in acts:
                after[k] = -e[k] * v[k]
            found.append(after)
    return found[-1]


class Arc:
    """Series of an arc on which some joints rest and others slide to a side."""

    def __init__(self, terms: Any, state: Any, sides: Sequence[int], friction: Sequence[Any]) -> None:
        q, v, t = state
        n = range(len(q))
        self.q = [Series(lambda k, i=i: self.v[i][k - 1] / k if k else q[i]) for i in n]
        self.v = [Series(lambda k, i=i: self.a[i][k - 1] / k if k else v[i]) for i in n]
        moving, solved = [i for i in n if sides[i]], list[Any]()
        M, f = terms(self.q, self.v, Series(lambda k: (t, 1)[k] if k < 2 else mp.mpf(0)))
        M, f = [[series(x) for x in row] for row in M], [series(f[i]) - sides[i] * friction[i] for i in n]

        W = inverse([[M[i][j][0] for j in n] for i in n], moving)

        def term(k: int) -> Any:
            if len(solved) <= k:
                late = [mp.fdot((M[i][j][p], solved[k - p][j]) for j in moving for p in range(1, k + 1)) for i in n]
                solved.append(times(W, [f[i][k] - late[i] for i in n]))
            return solved[k]

        self.a = [Series(lambda k, i=i: term(k)[i]) for i in n]
        #: Force that holds a joint, zero on one that moves.
        self.held = [sum((M[i][j] * self.a[j] for j in moving), -f[i]) for i in n]

    def span(self) -> Any:
        """Return how far the series hold all digits."""
        rate = max(abs(x[ORDER - d]) ** (mp.mpf(1) / (ORDER - d)) for x in self.q + self.v for d in (1, 2))
        return mp.mpf(10) ** (-mp.mpf(DIGITS + 4) / (ORDER - 2)) / max(rate, mp.mpf(1) / 2)

    def state(self, h: Any, t: Any) -> Any:
        return [x.at(h) for x in self.q], [x.at(h) for x in self.v], t + h


def first_root(margin: list[Any], h: Any) -> Any:
    """Return where within h a polynomial, positive at first, has its first zero; None where there is none."""
    slope = [x * (len(margin) - 1 - k) for k, x in enumerate(margin[:-1])] or [mp.mpf(0)]
    at = [h * k / PLACES for k in range(PLACES + 1)]
    for a, b in itertools.pairwise(at):
        end = b
        if mp.polyval(slope, a) < 0 < mp.polyval(slope, b):
            # It turns in between, and may have been below zero.
            end = _root(slope, a, b)
        if mp.polyval(margin, end) < 0:
            return _root(margin, a, end)
    return None


def _root(polynomial: list[Any], a: Any, b: Any) -> Any:
    """Return the zero between a and b, where signs differ: Newton's method, kept within them."""
    rises, x = mp.polyval(polynomial, b) > 0, (a + b) / 2
    for _ in range(20 * DIGITS):
        f, slope = mp.polyval(polynomial, x, derivative=True)
        a, b = (a, x) if (f > 0) == rises else (x, b)
        last, x = x, x - f / slope if slope else a
        if abs(x - last) < mp.mpf(10) ** (4 - DIGITS):
            return x
        if not a < x < b:
            x = (a + b) / 2
    raise ValueError(f"no zero found between {a} and {b}")


def run(
    terms: Any, q: Any, v: Any, stops: Sequence[Stop], duration: Any, friction: Any = None, most: int = 100
) -> tuple[list[Event], Any]:
    """Return the events and the last state (q, v, t), at the end or behind the last of `most` events."""
    with mp.workdps(DIGITS):
        return _run(terms, [mp.mpf(x) for x in q], [mp.mpf(x) for x in v], stops, duration, friction, most)


def _run(terms: Any, q: Any, v: Any, stops: Any, duration: Any, friction: Any, most: int) -> Any:
    n, t, events = range(len(q)), mp.mpf(0), list[Event]()
    friction = [mp.mpf(x) for x in friction or (0 for _ in n)]
    stops = [Stop(s.lower, s.upper, mp.mpf(s.e)) for s in stops]

    def limits(i: int) -> tuple[Any, Any]:
        on = stops[i].reached(q[i])
        return (-mp.inf if on > 0 else -friction[i], mp.inf if on < 0 else friction[i])

    def pattern() -> list[int]:
        """Return sides of what moves and 0 of what rests, consistent with accelerations and forces."""
        choices = []
        for i in n:
            on = stops[i].reached(q[i])
            ways = [s for s in (1, -1) if s != on]
            still = v[i] == 0 and (on or friction[i])
            # Without friction and away from stops the side says nothing.
            choices.append([0, *ways] if still else [int(mp.sign(v[i])) or 1])
        for sides in itertools.product(*choices):
            arc = Arc(terms, (q, v, t), sides, friction)
            fits = all(
                limits(i)[0] <= arc.held[i][0] <= limits(i)[1] if not s else len(choices[i]) == 1 or s * arc.a[i][0] > 0
                for i, s in enumerate(sides)
            )
            if fits:
                return list(sides)
        raise ValueError("no pattern is consistent")

    sides = pattern()
    while t < duration and len(events) < most:
        arc = Arc(terms, (q, v, t), sides, friction)
        h = min(arc.span(), duration - t)
        margins = []
        for i in n:
            if sides[i]:
                bounds = (-1, stops[i].lower), (1, stops[i].upper)
                margins += [(side * (x - arc.q[i]), "hits", i, side) for side, x in bounds if x is not None]
                if friction[i]:
                    margins.append((sides[i] * arc.v[i], "stops", i, sides[i]))
            else:
                low, high = limits(i)
                # Let go downwards at the greatest force that holds it up, and the other way round.
                margins += [(high - arc.held[i], "release", i, -1)] if high < mp.inf else []
                margins += [(arc.held[i] - low, "release", i, 1)] if low > -mp.inf else []
        found = [(s, *x[1:]) for x in margins if (s := first_root(x[0].polynomial(), h)) is not None]
        if not found:
            q, v, t = arc.state(h, t)
            continue
        s, kind, i, side = min(found)
        q, v, t = arc.state(s, t)
        for j in n:
            if not sides[j]:
                v[j] = mp.mpf(0)
        before, lost, hit, slid = list(v), mp.mpf(0), [(kind, i, side)], list(sides)
        if kind == "hits":
            # What arrives at the same time takes part in the same impact.
            for j in n:
                for way, bound in ((-1, stops[j].lower), (1, stops[j].upper)):
                    if bound is not None and abs(q[j] - bound) < ZERO:
                        q[j] = mp.mpf(bound)
                        hit += [(kind, j, way)] if j != i and way * v[j] > 0 else []
            M, _ = terms(q, v, t)
            v = impact(M, v, [stops[j].reached(q[j]) for j in n], [stops[j].e for j in n])
            if stops[i].e and abs(v[i]) < REST:
                hit, v[i] = [("rests", i, side)], mp.mpf(0)
            lost = energy_of_motion(M, before) - energy_of_motion(M, v)
            sides = pattern()
        elif kind == "stops":
            v[i] = mp.mpf(0)
            sides = pattern()
            hit = [("turns" if sides[i] else "stops", i, side)]
        else:
            on = stops[i].reached(q[i])
            hit = [("leaves", i, on) if on else ("lets go", i, side)]
            sides[i] = -on or side
        own = {j for _, j, _ in hit}
        for j in (j for j in n if j not in own):
            # An impact, or what has stopped, sets others free or brings them to rest.
            on, turned = stops[j].reached(q[j]), friction[j] and slid[j] * sides[j] < 0
            if bool(slid[j]) != bool(sides[j]):
                words = ("leaves", "rests") if on else ("lets go", "stops")
                hit.append((words[not sides[j]], j, on or sides[j] or slid[j]))
            elif turned:
                hit.append(("turns", j, slid[j]))
        # The first of what happens at once has the energy.
        events += [Event(t, kind, j, way, q, before, v, 0 if k else lost) for k, (kind, j, way) in enumerate(hit)]
    return events, (q, v, t)
