"""Events: zero crossings of a function of the state, that end a run or are noted.

A crossing is searched between the ends of each accepted step; one that comes and goes within a step is not seen, and a
smaller tolerance makes smaller steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import ClassVar, Final

import numpy as np

from mbkit._check import EPS, Array, real
from mbkit.engines import Dynamics
from mbkit.engines.base import at_time
from mbkit.errors import EventError, FunctionError, InputError, NumericalError, UnknownNameError
from mbkit.model import Model

#: state(t) -> (q, v) within a step
State = Callable[[float], tuple[Array, Array]]
#: Largest error of parabolas, relative to a function's values, with which they have its sign.
_MAX_PARABOLA_ERROR: Final = 1e-4
#: A time and the value of a function there.
Sample = tuple[float, float]


@dataclass(frozen=True)
class Event:
    """A zero crossing of a function.

    Attributes
    ----------
    function : callable
        function(t, q, v) -> float, of one state; q has unit quaternions.
    name : str
    direction : {-1, 0, 1}
        A falling crossing, both, or a rising one.
    terminal : bool
        Whether the run ends there.
    """

    function: Callable[[float, Array, Array], float]
    name: str = "event"
    direction: int = 0
    terminal: bool = True
    _named: ClassVar[tuple[type[Exception], ...]] = (FunctionError,)

    def __post_init__(self) -> None:
        if not callable(self.function):
            raise InputError(f"events: expected a function of (t, q, v), got {type(self.function).__name__}")
        if not isinstance(self.name, str):
            raise InputError(f"events: expected a name, got {self.name!r}")
        if isinstance(self.direction, bool) or self.direction not in (-1, 0, 1):
            raise InputError(f"events: direction of {self.name!r}: expected -1, 0 or 1, got {self.direction!r}")
        if not isinstance(self.terminal, (bool, np.bool_)):
            raise InputError(f"events: terminal of {self.name!r}: expected True or False, got {self.terminal!r}")

    def __call__(self, t: float, q: Array, v: Array) -> float:
        """Return the function's value, checked."""
        when = f"at t = {t:.9g} s"
        try:
            value = float(self.function(t, q.copy(), v.copy()))
        except self._named:
            # The error of a torque that it asks, or of an engine, has a name and a message of its own.
            raise
        except Exception as error:
            raise EventError(
                f"events: {self.name!r} {when}: expected a number from the function; "
                f"it raised {type(error).__name__}: {error}"
            ) from error
        if not np.isfinite(value):
            raise EventError(f"events: {self.name!r} returned {value} {when}; expected a finite number")
        return value


@dataclass(frozen=True)
class Followed(Event):
    """A fall below zero that is looked for within each step, too: parabolas follow the function from above zero.

    Attributes
    ----------
    parts : int
        Fewest parts of a step that are looked at on their own.
    noise : float
        Largest value that does not count, relative to the function's largest.
    """

    direction: int = -1
    parts: int = 1
    noise: float = 1e-9
    _named = (FunctionError, NumericalError)


@dataclass(frozen=True, eq=False, repr=False)
class Hit:
    """An event that happened.

    Attributes
    ----------
    name : str
    t : float
        s.
    q, v : (nq,) and (nv,) arrays
    member : int or None
        Which trajectory of a batch.
    before : (nv,) array or None
        Velocities before an impact on joint stops; of several stops at one time the first event has it.
    energy_change : float
        Energy that an impact on this stop changes, J.
    """

    name: str
    t: float
    q: Array
    v: Array
    member: int | None = None
    before: Array | None = None
    energy_change: float = 0.0

    def __repr__(self) -> str:
        of = "" if self.member is None else f" (trajectory {self.member})"
        return f"{self.t:{'.3f' if abs(self.t) >= 1 else '.3g'}} s  {self.name}{of}"


class Watch:
    """Search for events along one trajectory (of a batch)."""

    def __init__(self, events: Sequence[Event], member: int | None = None) -> None:
        self._events, self._member = tuple(events), member
        self._t, self._values = 0.0, [0.0] * len(self._events)

    def start(self, t: float, q: Array, v: Array) -> None:
        """Begin at a state; a function that is zero there crosses when it is zero again."""
        self._t, self._values = t, [self._value(event, t, (q, v)) for event in self._events]

    def look(self, t1: float, state: State) -> tuple[list[Hit], Hit | None]:
        """Return the crossings since the last look, in order, up to the first that ends the run, and that one."""
        there = state(t1)
        values = [self._value(event, t1, there) for event in self._events]
        crossings: list[tuple[float, int]] = []
        for k, (event, before, after) in enumerate(zip(self._events, self._values, values, strict=True)):
            ends = (self._t, before), (t1, after)
            if isinstance(event, Followed):
                ends = self._first_fall(event, state, *ends)
            rises, falls = ends[0][1] < 0 <= ends[1][1], ends[0][1] > 0 >= ends[1][1]
            if (rises and event.direction >= 0) or (falls and event.direction <= 0):
                crossings.append((self._root(event, state, *ends), k))
        hits: list[Hit] = []
        for t, k in sorted(crossings):
            hits.append(Hit(self._events[k].name, t, *state(t), self._member))
            if self._events[k].terminal:
                return hits, hits[-1]
        self._t, self._values = t1, values
        return hits, None

    def _value(self, event: Event, t: float, state: tuple[Array, Array]) -> float:
        try:
            return event(t, *state)
        except EventError as error:
            error.member = self._member
            raise

    def _first_fall(self, event: Followed, state: State, first: Sample, last: Sample) -> tuple[Sample, Sample]:
        """Return the ends of the first part of a step in which the function falls below zero, or those of the step."""
        times = np.linspace(first[0], last[0], 4 * event.parts + 1).tolist()
        all_of_it = [first, *((t, self._value(event, t, state(t))) for t in times[1:-1]), last]
        size = max(abs(x) for _, x in all_of_it)
        parts, above = [all_of_it[i : i + 5] for i in range(4 * event.parts - 4, -1, -4)], first
        while parts:
            part = parts.pop()
            x = [value for _, value in part]
            # The two samples in between differ by this from the parabola through the ends and the middle.
            bend = max(abs(3 * a + 6 * x[2] - b - 8 * c) / 8 for a, b, c in ((x[0], x[4], x[1]), (x[4], x[0], x[3])))
            room = part[4][0] - part[0][0] > 1e-9 * (last[0] - first[0])
            dips = _lowest(x) - bend < -event.noise * size <= min(x)
            if room and (dips or bend > max(min(x) / 2, _MAX_PARABOLA_ERROR * size)):
                middles = [(a[0] + b[0]) / 2 for a, b in pairwise(part)]
                finer = sorted([*part, *((t, self._value(event, t, state(t))) for t in middles)])
                parts += [finer[4:], finer[:5]]
                continue
            for sample in part:
                if sample[1] < -event.noise * size:
                    return above, sample
                above = sample if sample[1] > 0 else above
        return first, last

    def _root(self, event: Event, state: State, first: Sample, last: Sample) -> float:
        if last[1] == 0.0:
            return last[0]
        from scipy.optimize import brentq

        # An interpolant may round to another sign at the ends.
        known = dict((first, last))
        xtol = 4 * EPS * max(abs(first[0]), abs(last[0]))

        def value(t: float) -> float:
            return known[t] if t in known else self._value(event, t, state(t))

        return float(brentq(value, first[0], last[0], xtol=xtol, rtol=4 * EPS))


def _lowest(x: Sequence[float]) -> float:
    """Return the least value of the parabola through the first, third and fifth of five samples, infinite at ends."""
    slope, curve = x[4] - x[0], x[4] - 2 * x[2] + x[0]
    inside = curve > 0 and abs(slope) < 2 * curve
    return x[2] - slope**2 / (8 * curve) if inside else np.inf


def as_events(events: object) -> tuple[Event, ...]:
    """Return the argument `events` as a tuple: one, several, or functions."""
    if events is None:
        return ()
    if isinstance(events, Event) or callable(events):
        events = (events,)
    if not isinstance(events, Sequence) or isinstance(events, (str, bytes)):
        raise InputError(f"events: expected an Event, a function of (t, q, v) or several, got {type(events).__name__}")
    return tuple(e if isinstance(e, Event) else Event(e, getattr(e, "__name__", "event")) for e in events)


def at_limits(model: Model) -> tuple[Event, ...]:
    """Return events that end a run where a coordinate passes a limit of its joint; InputError where none has one."""
    _require("at_limits: model", model, Model)
    out = []
    for i, (name, low, high) in enumerate(zip(model.coordinate_names, model.lower, model.upper, strict=True)):
        for limit, side in ((low, -1), (high, 1)):
            if np.isfinite(limit):
                text = f"{name} {'above' if side > 0 else 'below'} {limit:g}"
                out.append(Event(partial(_beyond, i, float(limit)), text, side))
    if not out:
        raise InputError(f"at_limits: {model.name} has no joint limits, so no run would end there")
    return tuple(out)


def at_energy(dyn: Dynamics, joules: float, *, direction: int = 0) -> Event:
    """Return an event that ends a run where kinetic plus potential energy passes a value."""
    _require("at_energy: dyn", dyn, Dynamics)
    level = real("joules", joules)
    return Event(partial(_above, dyn, level), f"energy {level:g} J", direction)


def at_section(
    model: Model, coordinate: str, value: float = 0.0, *, direction: int = 0, terminal: bool = False
) -> Event:
    """Return an event where one of ``model.coordinate_names`` passes a value (m or rad): a Poincaré section.

    The run ends there if it is `terminal`; `direction` is that of `Event`.
    """
    _require("at_section: model", model, Model)
    if coordinate not in model.coordinate_names:
        raise UnknownNameError("coordinate", str(coordinate), model.coordinate_names)
    i, value = model.coordinate_names.index(coordinate), real("value", value)
    return Event(partial(_beyond, i, value), f"{coordinate} = {value:g}", direction, terminal)


def _require(what: str, value: object, kind: type) -> None:
    if not isinstance(value, kind):
        makes = "mbkit.load(...)" if kind is Model else "mbkit.dynamics(model, engine)"
        raise InputError(f"{what}: expected a {kind.__name__}, got {type(value).__name__}; {makes} makes one")


# Functions of the module, so that events can be sent to other processes.
def _beyond(i: int, value: float, _t: float, q: Array, _v: Array) -> float:
    return float(q[i] - value)


def _above(dyn: Dynamics, level: float, t: float, q: Array, v: Array) -> float:
    own = at_time(dyn, t)
    kinetic = 0.5 * v @ own.mass_matrix(q) @ v if own.model.has_bodies else own.kinetic_energy(q, v)
    return float(kinetic + own.potential_energy(q) - level)
