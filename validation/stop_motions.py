"""Truths of motions with rigid stops: closed forms, elliptic integrals, quadratures, and arcs of 40 digits.

Nothing here imports mbkit but for the stamp. Restitution is Newton's: behind a hit the velocity is -e times that before
it. ``python -m validation.stop_motions`` holds each closed form against a second route, runs the scenes by arcs
and writes ``validation/stop_motions.json``, which `kept` reads.

Sources: Landau, Lifshitz 1976, Mechanics, §11 (times of the pendulum); Herrmann, Seitz 1982, Am. J. Phys. 50, 977
(cradle); Holmes 1982, J. Sound Vib. 84, 173 (ball on a table that swings); Pfeiffer, Glocker 1996, Multibody Dynamics
with Unilateral Contacts, ch. 8 (projection).
"""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import mpmath as mp

from validation import stop_arcs
from validation.stamp import results, stamp
from validation.stop_arcs import DIGITS, Event, Stop, chain, on_a_cart, run, sliders

mp.mp.dps = DIGITS
G = mp.mpf(9.81)


def _floats(*given: float) -> list[Any]:
    return [mp.mpf(x) for x in given]


def _slides(t: Any, kind: str, side: int, q: Any, before: Any, after: Any, m: Any) -> Event:
    """Return an event of one coordinate of constant inertia."""
    return Event(t, kind, 0, side, [q], [before], [after], m * (before**2 - after**2) / 2)


# One coordinate


def bounces(height: float, e: float, count: int, v: float = 0.0, m: float = 1.0) -> tuple[list[Event], Any]:
    """Return hits on the floor of what falls from a height above it, and when the last of infinitely many is."""
    height, e, v = _floats(height, e, v)
    speed = mp.sqrt(v**2 + 2 * G * height)
    t, events = (v + speed) / G, []
    limit = t + 2 * speed * e / (G * (1 - e)) if e < 1 else mp.inf
    for _ in range(count):
        events.append(_slides(t, "hits", -1, mp.mpf(0), -speed, e * speed, m))
        speed *= e
        t += 2 * speed / G
    return events, limit


def between_plates(height: float, v: float, e: float, count: int) -> list[Event]:
    """Return hits of 1 kg thrown up from a floor at 0 below a ceiling, which it grazes at v² = 2 g `height`."""
    height, v, e = _floats(height, v, e)
    t, events = mp.mpf(0), []
    for _ in range(count):
        rest = v**2 - 2 * G * height
        if rest <= 0:
            t += 2 * v / G
            events.append(_slides(t, "hits", -1, mp.mpf(0), -v, e * v, 1))
            v *= e
            continue
        t += (v - mp.sqrt(rest)) / G
        events.append(_slides(t, "hits", 1, height, mp.sqrt(rest), -e * mp.sqrt(rest), 1))
        down = e * mp.sqrt(rest)
        v = mp.sqrt(down**2 + 2 * G * height)
        t += (v - down) / G
        events.append(_slides(t, "hits", -1, mp.mpf(0), -v, e * v, 1))
        v *= e
    return events[:count]


def pendulum(start: float, stop: float, e: float, count: int, w: Any = None) -> tuple[list[Event], Any]:
    """Return hits of a pendulum of inertia 1, let go at rest at `start` above its lower stop, and their limit.

    w is ω₀². Amplitudes follow from sin²(θ/2) + (θ̇/2 ω₀)² = k², and the time from the stop to the turn and back is
    2 (K - F(φ))/ω₀ with sin φ = sin(stop/2)/k.
    """
    start, stop, e = _floats(start, stop, e)
    w = mp.sqrt(G if w is None else w)

    def quarter(m: Any) -> Any:
        """Return the time between the stop and the turn."""
        return (mp.ellipk(m) - mp.ellipf(mp.asin(mp.sin(stop / 2) / mp.sqrt(m)), m)) / w

    m, low = mp.sin(start / 2) ** 2, mp.sin(stop / 2) ** 2
    t, events = quarter(m), []
    limit = None
    while len(events) < count or limit is None:
        speed = 2 * w * mp.sqrt(m - low)
        events.append(_slides(t, "hits", -1, stop, -speed, e * speed, 1))
        m = low + e**2 * (m - low)
        bounce = 2 * quarter(m) if e else mp.mpf(0)
        if stop <= 0 or e in (0, 1):
            limit = mp.inf if e and stop <= 0 else t
        elif bounce < mp.mpf(10) ** (3 - DIGITS):
            limit = t
        t += bounce
    return events[:count], limit


@dataclass(frozen=True)
class Rubbed:
    """A slider of mass m on a lower stop at 0, with a spring -k (x - x₀), friction f, and a force a + b t + c sin Ω t.

    Each arc is linear with constant coefficients. Without a spring the seat that swings is one too: with
    c = m A Ω² and a = -m g, x is the height above a table that moves by A sin Ω t.
    """

    m: float = 1.0
    k: float = 0.0
    rest: float = 0.0
    f: float = 0.0
    force: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    e: float = 0.0

    def net(self, x: Any, t: Any) -> Any:
        """Return the force without friction and stop."""
        a, b, c, w = self.force
        return a + b * t + c * mp.sin(w * t) - self.k * (x - mp.mpf(self.rest))

    def _particular(self, t: Any, side: int) -> tuple[Any, Any]:
        m, k, f, a, b, c, w = _floats(self.m, self.k, self.f, *self.force)
        a += k * mp.mpf(self.rest) - side * f
        wave = c / (k - m * w**2)
        x, v = wave * mp.sin(w * t), wave * w * mp.cos(w * t)
        if k:
            return x + (a + b * t) / k, v + b / k
        return x + (a * t**2 / 2 + b * t**3 / 6) / m, v + (a * t + b * t**2 / 2) / m

    def at(self, t: Any, start: Any, side: int) -> tuple[Any, Any]:
        """Return x and v on an arc from (t₀, x₀, v₀), with friction against the side."""
        t0, x0, v0 = start
        (x, v), (p, r) = self._particular(t, side), self._particular(t0, side)
        x0, v0, s = x0 - p, v0 - r, t - t0
        if not self.k:
            return x + x0 + v0 * s, v + v0
        w = mp.sqrt(mp.mpf(self.k) / self.m)
        return x + x0 * mp.cos(w * s) + v0 / w * mp.sin(w * s), v - x0 * w * mp.sin(w * s) + v0 * mp.cos(w * s)

    def _side(self, t: Any, x: Any, v: Any) -> int:
        """Return the way it slides, 0 where it rests."""
        if v:
            return int(mp.sign(v))
        net = self.net(x, t)
        return (net > self.f) - (x != 0 and net < -self.f)

    def _margins(self, t: Any, start: Any, side: int) -> list[Any]:
        if side:
            x, v = self.at(t, start, side)
            return [x, side * v if self.f else mp.inf]
        net = self.net(start[1], t)
        return [self.f - net, mp.inf if start[1] == 0 else self.f + net]

    def run(self, duration: float, x: float = 0.0, v: float = 0.0, step: float = 1e-3) -> tuple[list[Event], Any]:
        """Return events and the last x and v; ends of arcs are looked for in steps."""
        at, events, step = (mp.mpf(0), mp.mpf(x), mp.mpf(v)), list[Event](), mp.mpf(step)
        side = self._side(*at)
        while True:
            k, before = 1, self._margins(at[0] + step, at, side)
            while min(now := self._margins(at[0] + (k + 1) * step, at, side)) >= 0:
                k, before = k + 1, now
                if at[0] + k * step > duration:
                    return events, self.at(mp.mpf(duration), at, side) if side else at[1:]
            ends = []
            for i in (i for i in (0, 1) if now[i] < 0 <= before[i]):
                span = at[0] + k * step, at[0] + (k + 1) * step
                ends.append(
                    (mp.findroot(lambda t, arc=(at, side), i=i: self._margins(t, *arc)[i], span, solver="anderson"), i)
                )
            t, i = min(ends)
            if t > duration:
                return events, self.at(mp.mpf(duration), at, side) if side else at[1:]
            x, v = self.at(t, at, side) if side else at[1:]
            if not side:
                way = 1 if i == 0 else -1
                events.append(_slides(t, "lets go" if x else "leaves", way if x else -1, x, v, v, self.m))
                at, side = (t, x, v), way
                continue
            if i == 0:
                events.append(_slides(t, "hits", -1, mp.mpf(0), v, -self.e * v, self.m))
                at = t, mp.mpf(0), -self.e * v
            else:
                at = t, x, mp.mpf(0)
                kind = "turns" if self._side(*at) else "stops"
                events.append(_slides(t, kind, side, x, mp.mpf(0), mp.mpf(0), self.m))
            side = self._side(*at)

    def push(self, q: Any, _: Any, t: Any) -> list[Any]:
        """Return the force for `sliders`."""
        a, b, c, w = self.force
        return [a + b * t + c * stop_arcs.sine_cosine(w * t)[0] - self.k * (q[0] - mp.mpf(self.rest))]


# Sliders each on the one before it


def relative(x: Sequence[Any]) -> list[Any]:
    return [x[0], *(b - a for a, b in itertools.pairwise(x))]


def cradle(
    masses: Sequence[float], gaps: Sequence[float], speeds: Sequence[float], e: float, wall: float | None = None
) -> list[Event]:
    """Return hits of sliders in line without forces, in coordinates relative to the one before.

    `gaps` are those in front of each but the first, which may have a wall at so far behind it; speeds are absolute.
    Each hit is the pair formula's: of two equal ones with e = 1 each takes the other's velocity.
    """
    m, u, e = _floats(*masses), _floats(*speeds), mp.mpf(e)
    s = [mp.mpf(0 if wall is None else wall), *_floats(*gaps)]
    t, events = mp.mpf(0), list[Event]()
    while True:
        v = relative(u)
        ahead = [(-s[i] / v[i], i) for i in range(len(u)) if v[i] < 0 and (i or wall is not None)]
        if not ahead:
            return events
        step, i = min(ahead)
        t, s = t + step, [a + step * b for a, b in zip(s, v, strict=True)]
        s[i] = mp.mpf(0)
        energy = mp.fsum(a * b * b for a, b in zip(m, u, strict=True)) / 2
        if i:
            p = (1 + e) * -v[i] * m[i] * m[i - 1] / (m[i] + m[i - 1])
            u[i], u[i - 1] = u[i] + p / m[i], u[i - 1] - p / m[i - 1]
        else:
            u[0] *= -e
        lost = energy - mp.fsum(a * b * b for a, b in zip(m, u, strict=True)) / 2
        events.append(Event(t, "hits", i, -1, list(s), v, relative(u), lost))


def stack(masses: Sequence[float], t: float, speeds: Sequence[float], stops: Sequence[bool]) -> tuple[Any, ...]:
    """Return start q, v and, where all meet their lower stops at 0 at once, v before and after and the energy lost.

    Vertical sliders, each on the one before it and nearing it with `speeds`, the first's at the end; e = 0. What
    meets takes its common velocity, none with the ground: the projection of M on the velocities that stops allow.
    """
    m, speeds, t = _floats(*masses), _floats(*speeds), mp.mpf(t)
    before = [-u for u in speeds]
    start = [u * t for u in speeds]
    start[0] -= G * t**2 / 2
    down = list(itertools.accumulate(before))
    groups: list[list[int]] = [[]]
    for i, stop in enumerate(stops):
        groups += [] if stop else [[]]
        groups[-1].append(i)
    after = [mp.mpf(0)] * len(m)
    for k, group in enumerate(groups):
        common = mp.fsum(m[i] * down[i] for i in group) / mp.fsum(m[i] for i in group) if group and k else 0
        for i in group:
            after[i] = mp.mpf(common)
    carnot = mp.fsum(a * (x - y) ** 2 for a, x, y in zip(m, after, down, strict=True)) / 2
    return start, [before[0] + G * t, *before[1:]], before, relative(after), carnot


# A four-bar linkage with a stop at its crank


@dataclass(frozen=True)
class FourBar:
    """Thin rods of `density` kg/m on pins, angles from the ground bar, gravity across it; one degree of freedom."""

    crank: float = 0.3
    coupler: float = 0.9
    rocker: float = 0.7
    ground: float = 1.0
    density: float = 2.0

    def angles(self, x: Any) -> tuple[Any, Any]:
        """Return those of coupler and rocker, with the pin above the line between their other ends."""
        a, b, c, d = _floats(self.crank, self.coupler, self.rocker, self.ground)
        along, up = d - a * mp.cos(x), -a * mp.sin(x)
        far = mp.hypot(along, up)
        phi = mp.atan2(up, along) + mp.acos((b**2 + far**2 - c**2) / (2 * b * far))
        return phi, mp.atan2(a * mp.sin(x) + b * mp.sin(phi), a * mp.cos(x) + b * mp.cos(phi) - d)

    def rates(self, x: Any) -> tuple[Any, Any]:
        """Return those of coupler and rocker for a crank of 1 rad/s: velocities of the pin along the two rods."""
        phi, psi = self.angles(x)
        turn = mp.sin(psi - phi)
        return self.crank * mp.sin(x - psi) / (self.coupler * turn), self.crank * mp.sin(x - phi) / (self.rocker * turn)

    def inertia(self, x: Any) -> Any:
        a, b, c, rho = _floats(self.crank, self.coupler, self.rocker, self.density)
        (phi, _), (p, r) = self.angles(x), self.rates(x)
        middle = a**2 + a * b * p * mp.cos(x - phi) + b**2 * p**2 / 4
        return rho * (a**3 / 3 + b * middle + b**3 / 12 * p**2 + c**3 / 3 * r**2)

    def potential(self, x: Any) -> Any:
        a, b, c, rho = _floats(self.crank, self.coupler, self.rocker, self.density)
        phi, psi = self.angles(x)
        return rho * G * (a**2 / 2 * mp.sin(x) + b * (a * mp.sin(x) + b / 2 * mp.sin(phi)) + c**2 / 2 * mp.sin(psi))

    def slope(self, x: Any) -> Any:
        """Return dV/dθ: the torque with which the stop holds the linkage."""
        a, b, c, rho = _floats(self.crank, self.coupler, self.rocker, self.density)
        (phi, psi), (p, r) = self.angles(x), self.rates(x)
        pulls = a**2 / 2 * mp.cos(x) + b * (a * mp.cos(x) + b / 2 * p * mp.cos(phi)) + c**2 / 2 * r * mp.cos(psi)
        return rho * G * pulls

    def time(self, start: Any, end: Any, energy: Any) -> Any:
        """Return ∫ dθ √(J/2(E - V)), with a root at its start taken away by a square."""
        span = end - start

        def slow(u: Any) -> Any:
            x = start + span * u**2
            return 2 * u * abs(span) * mp.sqrt(self.inertia(x) / (2 * (energy - self.potential(x))))

        return mp.quad(slow, [0, 1])

    def hits(self, start: float, stop: float, e: float, count: int) -> list[Event]:
        """Return hits of a crank let go at rest at an angle above its lower stop, towards which its weight turns it."""
        # Small differences of energies beside the turns take a third of the digits.
        with mp.workdps(DIGITS + 25):
            start, stop, e = _floats(start, stop, e)
            energy, J, turn, t, events = self.potential(start), self.inertia(stop), start, mp.mpf(0), list[Event]()
            for n in range(count):
                t += (2 if n else 1) * self.time(turn, stop, energy)
                speed = mp.sqrt(2 * (energy - self.potential(stop)) / J)
                events.append(_slides(t, "hits", -1, stop, -speed, e * speed, J))
                if not e:
                    break
                energy = self.potential(stop) + J * (e * speed) ** 2 / 2
                turn = mp.findroot(lambda x, E=energy: self.potential(x) - E, (stop, start), solver="anderson")
                energy = self.potential(turn)
        return events


# Scenes of more coordinates, by arcs

LINKS = {"m": (1.0, 0.7, 0.4), "l": (1.0, 0.8, 0.5), "c": (0.5, 0.45, 0.2), "J": (0.09, 0.04, 0.01)}
CART = {"M": 1.5, "m": 0.8, "c": 0.6, "J": 0.05}
#: Masses, and amplitudes and rates of the forces on each.
PUSHED = {"m": (1.0, 0.5), "amplitude": (6.0, 3.0), "rate": (5.0, 3.0)}


def links(n: int, g: float = 9.81) -> Any:
    return chain(*(_floats(*LINKS[x][:n]) for x in ("m", "l", "c", "J")), mp.mpf(g))


def _pushed(_q: Any, _v: Any, t: Any) -> list[Any]:
    return [a * stop_arcs.sine_cosine(w * t)[0] for a, w in zip(PUSHED["amplitude"], PUSHED["rate"], strict=True)]


@dataclass(frozen=True)
class Scene:
    """`kind` and `g` say which system: "links", "cart" or "sliders"."""

    kind: str
    q: tuple[float, ...]
    v: tuple[float, ...]
    stops: tuple[Stop, ...]
    duration: float = 3.0
    g: float = 9.81
    friction: tuple[float, ...] | None = None
    most: int = 6

    def terms(self) -> Any:
        if self.kind == "links":
            return links(len(self.q), self.g)
        if self.kind == "cart":
            return on_a_cart(*_floats(*CART.values(), self.g))
        return sliders(_floats(*PUSHED["m"]), 0, _pushed)

    def run(self) -> tuple[list[Event], Any]:
        return run(self.terms(), self.q, self.v, self.stops, self.duration, self.friction, self.most)


_FREE, _STILL = Stop(), (0.0, 0.0)
SCENES = {
    **{
        f"second joint, e = {e:g}": Scene("links", (1.0, 0.3), _STILL, (_FREE, Stop(-0.2, None, e)))
        for e in (0.0, 0.5, 1.0)
    },
    **{
        f"first joint, e = {e:g}": Scene("links", (1.2, -0.4), (0.0, 1.0), (Stop(0.3, None, e), _FREE))
        for e in (0.0, 0.5, 1.0)
    },
    "both joints": Scene("links", (1.2, 0.4), _STILL, (Stop(0.2, None, 0.0), Stop(-0.5, 0.6, 0.0))),
    "arm between walls": Scene("links", (0.1, 0.2), (3.0, -1.0), (Stop(-0.5, 0.9, 0.6), Stop(-1.2, 1.1, 0.8)), g=0.0),
    "three links": Scene(
        "links",
        (0.3, -0.2, 0.3),
        (2.0, -1.0, 3.0),
        (Stop(-0.3, 0.5, 0.4), Stop(-0.3, 0.25, 0.0), Stop(-0.4, 0.4, 0.6)),
        1.5,
    ),
    **{f"cart, e = {e:g}": Scene("cart", (0.0, 1.2), _STILL, (Stop(-0.1, 0.15, e), _FREE)) for e in (0.0, 0.7)},
    "rubbed sliders": Scene(
        "sliders", _STILL, _STILL, (Stop(-0.2, 0.3, 0.0), Stop(-0.25, 0.1, 0.5)), friction=(1.0, 0.5)
    ),
    "rubbed links": Scene(
        "links", (1.2, 0.4), _STILL, (Stop(-0.2, None, 0.3), Stop(-0.5, 0.6, 0.0)), friction=(1.5, 0.8)
    ),
    # It bounces, rests and leaves.
    "bounces and rest": Scene("links", (1.0, 0.3), _STILL, (_FREE, Stop(-0.2, None, 0.3)), 2.0, most=99),
}
#: Restitution of the linkage's hits that are kept.
FOUR_BAR = (0.0, 0.5)
#: Events that closed forms are compared in.
MOST = 6


def _text(x: Any) -> Any:
    return [mp.nstr(y, 30) for y in x] if isinstance(x, list) else mp.nstr(x, 30)


def _told(events: Sequence[Event]) -> list[dict[str, Any]]:
    numbers = ("t", "q", "before", "after", "lost")
    return [e._replace(**{k: _text(getattr(e, k)) for k in numbers})._asdict() for e in events]


def measured(name: str) -> dict[str, Any]:
    """Return events and the last state as text of 30 digits, with how far series of other lengths come to others."""
    events, (q, v, t) = SCENES[name].run()
    order = stop_arcs.ORDER
    try:
        stop_arcs.ORDER = order + 8
        again, end = SCENES[name].run()
    finally:
        stop_arcs.ORDER = order

    def numbers(e: Event) -> list[Any]:
        return [e.t, *e.q, *e.before, *e.after, e.lost]

    # Of bounces without end the first.
    events, again = ([e for e in x if e.kind != "hits" or abs(e.before[e.joint]) > 1e-4] for x in (events, again))
    pairs = [([*q, *v, t], [*end[0], *end[1], end[2]]), *zip(map(numbers, events), map(numbers, again), strict=True)]
    off = max(abs(x - y) for a, b in pairs for x, y in zip(a, b, strict=True))

    return {"events": _told(events), "end": [_text(q), _text(v), _text(t)], "off": float(off)}


def kept(name: str) -> tuple[list[Event], tuple[list[float], list[float], float]]:
    """Return events and the last state of a scene from the file, in doubles."""
    data = json.loads((Path(__file__).with_suffix(".json")).read_text(encoding="utf-8"))["scenes"][name]

    def number(x: Any) -> Any:
        return [float(y) for y in x] if isinstance(x, list) else float(x)

    events = [
        Event(*(x if k in ("kind", "joint", "side") else number(x) for k, x in e.items())) for e in data["events"]
    ]
    return events, tuple(map(number, data["end"]))


# Second routes


def apart(mine: Sequence[Event], other: Sequence[Event]) -> float:
    """Return the largest difference of two lists of events."""
    if [(e.kind, e.joint, e.side) for e in mine] != [(e.kind, e.joint, e.side) for e in other]:
        return float("inf")
    pairs = [
        (x, y)
        for a, b in zip(mine, other, strict=True)
        for x, y in zip([a.t, *a.q, *a.before, *a.after, a.lost], [b.t, *b.q, *b.before, *b.after, b.lost], strict=True)
    ]
    return float(max((abs(x - y) for x, y in pairs), default=0))


def _hinge(q: Any, _v: Any, _t: Any) -> list[Any]:
    return [-G * stop_arcs.sine_cosine(q[0])[0]]


def _rubbed(which: str) -> float:
    slider = RUBBED[which]
    arcs = run(sliders([slider.m], 0, slider.push), [0], [0], [Stop(0, None, slider.e)], 3, [slider.f], most=MOST)
    return apart(slider.run(3.0)[0][:MOST], arcs[0])


def _cradle(e: float) -> float:
    masses, gaps, speeds, ends = (1.0, 2.0, 0.5), (0.3, 0.2), (1.0, 0.0, -0.25), [Stop(0, None, e)] * 3
    told = cradle(masses, gaps, speeds, e, 0.5)[:MOST]
    return apart(told, run(sliders(masses), [0.5, *gaps], relative(speeds), ends, 99, most=len(told))[0])


def _stack(*stops: bool) -> float:
    q, v, before, after, carnot = stack((1.0, 2.0, 0.5), 0.5, (5.0, 0.3, 0.7), stops)
    event = run(sliders((1.0, 2.0, 0.5), G), q, v, [Stop(0) if s else Stop() for s in stops], 0.6, most=1)[0][0]
    pairs = [*zip(event.before, before, strict=True), *zip(event.after, after, strict=True), (event.lost, carnot)]
    return float(max(abs(x - y) for x, y in [(event.t, mp.mpf(0.5)), *pairs]))


def _four_bar() -> float:
    """Compare rates and torque with derivatives, and the time with that of a path of two parts."""
    bar, (start, middle, end) = FourBar(), _floats(0.8, 0.5, 0.3)
    rates = [mp.diff(lambda x, k=k: bar.angles(x)[k], middle) - bar.rates(middle)[k] for k in (0, 1)]
    with mp.workdps(DIGITS + 25):
        energy = bar.potential(start)
        whole, first = bar.time(start, end, energy), bar.time(start, middle, energy)
        second = mp.quad(lambda x: mp.sqrt(bar.inertia(x) / (2 * (energy - bar.potential(x)))), [end, middle])
        halves = whole - first - second
    work = mp.quad(bar.slope, [end, start]) - (bar.potential(start) - bar.potential(end))
    return float(max(map(abs, [*rates, halves, work])))


def _pendulum(stop: float) -> float:
    told, _ = pendulum(1.2, stop, 0.5, MOST)
    arcs = run(sliders([1], 0, _hinge), [1.2], [0], [Stop(stop, None, 0.5)], 30, most=MOST)
    return apart(told, arcs[0])


def _formulas(terms: Any, q: Sequence[Any], place: Callable[[int, Any], Any], m: Any, turning: Any) -> float:
    """Compare M and f with T of velocities of centres of mass, by derivatives of their places (x, height)."""
    n, v = range(len(q)), [mp.mpf("0.7") - i for i in range(len(q))]

    def slopes(x: Any, k: int, axis: int) -> list[Any]:
        return [mp.diff(lambda y, i=i: place(k, [*x[:i], y, *x[i + 1 :]])[axis], x[i]) for i in n]

    def mass(x: Any) -> Any:
        J = [(m[k], slopes(x, k, axis)) for k in range(len(m)) for axis in (0, 1)]
        return [[mp.fsum(w * r[i] * r[j] for w, r in J) + turning[i][j] for j in n] for i in n]

    M, f = terms(q, v, mp.mpf(0))
    # The momenta's change along q + t v, less the change of T with q.
    moved = [mp.diff(lambda t, i=i: mp.fdot(mass([a + t * b for a, b in zip(q, v, strict=True)])[i], v), 0) for i in n]
    energy = [mp.diff(lambda y, i=i: stop_arcs.energy_of_motion(mass([*q[:i], y, *q[i + 1 :]]), v), q[i]) for i in n]
    weight = [mp.fsum(m[k] * G * slopes(q, k, 1)[i] for k in range(len(m))) for i in n]
    off = [f[i] - energy[i] + moved[i] + weight[i] for i in n]
    return float(
        max(map(abs, [*off, *(a - b for x, y in zip(M, mass(q), strict=True) for a, b in zip(x, y, strict=True))]))
    )


def _chain() -> float:
    l, c, m, J = (_floats(*LINKS[x]) for x in ("l", "c", "m", "J"))

    def place(k: int, q: Any) -> Any:
        phi = list(itertools.accumulate(q))
        ways = [(mp.sin(x), -mp.cos(x)) for x in phi]
        return [mp.fsum(l[i] * ways[i][a] for i in range(k)) + c[k] * ways[k][a] for a in (0, 1)]

    turning = [[mp.fsum(J[max(i, j) :]) for j in range(3)] for i in range(3)]
    return _formulas(links(3), _floats(0.4, -0.7, 1.1), place, m, turning)


def _cart() -> float:
    M, m, c, J = _floats(*CART.values())

    def place(k: int, q: Any) -> Any:
        return [q[0] + k * c * mp.sin(q[1]), -k * c * mp.cos(q[1])]

    terms = on_a_cart(M, m, c, J, G)
    return _formulas(terms, _floats(0.2, 0.7), place, [M, m], [[0, 0], [0, J]])


def _bounces() -> float:
    arcs = run(sliders([2], G), [1.3], [0.7], [Stop(0, None, 0.5)], 9, most=MOST)
    return apart(bounces(1.3, 0.5, MOST, 0.7, 2.0)[0], arcs[0])


def _plates() -> float:
    arcs = run(sliders([1], G), [0], [5], [Stop(0, mp.mpf(0.4), mp.mpf(0.8))], 9, most=MOST)
    return apart(between_plates(0.4, 5.0, 0.8, MOST), arcs[0])


RUBBED = {
    "pulled off": Rubbed(2.0, 50.0, -0.1, 1.5, (0.0, 4.0, 0.0, 1.0)),
    "sticks": Rubbed(1.0, 5.0, -1.0, 7.0, (0.0, 0.0, 16.0, 3.0)),
    "rubbed, e = 0.5": Rubbed(2.0, 50.0, -0.02, 0.6, (0.0, 0.0, 14.0, 4.0), 0.5),
    "driven off": Rubbed(force=(-1.0, 2.0, 0.0, 1.0)),
    "table": Rubbed(force=(-9.81, 0.0, 0.05 * 400, 20.0), e=0.4),
}
#: Differences of closed forms from arcs of series or from derivatives of their own.
ROUTES: dict[str, Callable[[], float]] = {
    "formulas of links": _chain,
    "formulas of a cart": _cart,
    "bounces": _bounces,
    "between plates": _plates,
    "four-bar": _four_bar,
    **{f"pendulum, stop at {x:g}": partial(_pendulum, x) for x in (-0.3, 0.0, 0.4)},
    **{name: partial(_rubbed, name) for name in RUBBED},
    **{f"cradle, e = {e:g}": partial(_cradle, e) for e in (0.6, 1.0)},
    **{
        f"stack, stops {x}": partial(_stack, *x) for x in ((True, True, True), (True, False, True), (False, True, True))
    },
}
SMOKE = {
    "SCENES": {"cart, e = 0.7": SCENES["cart, e = 0.7"]},
    "MOST": 2,
    "FOUR_BAR": (),
    "ROUTES": {"bounces": _bounces, "sticks": partial(_rubbed, "sticks")},
}
#: Of series that are cut where 40 digits end, over three seconds and some hits.
TOLERANCE = 1e-30


def main() -> int:
    routes = {name: route() for name, route in ROUTES.items()}
    told = {name: measured(name) for name in SCENES}
    routes |= {name: scene["off"] for name, scene in told.items()}
    for e in FOUR_BAR:
        told[f"four-bar, e = {e:g}"] = {"events": _told(FourBar().hits(0.8, 0.3, e, 4)), "end": []}
    for name, off in routes.items():
        print(f"{name:32} {off:8.1e}")
    data = {**stamp(__file__), "second_routes": routes, "scenes": told}
    results("stop_motions.json").write_text(json.dumps(data, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return int(max(routes.values()) > TOLERANCE)


if __name__ == "__main__":
    sys.exit(main())
