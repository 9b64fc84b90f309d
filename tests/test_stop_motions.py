"""Runs that meet rigid stops, held against closed forms and arcs of 40 digits: times, states, order, energy lost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import mpmath as mp
import numpy as np
import pytest

import mbkit as mb
from mbkit.model import Model
from tests.scenes import chain, hinge, linkage, slider
from validation import stop_motions as truths
from validation.stop_arcs import Event, Stop

ENGINES = ("lagrangian", "pinocchio", "mujoco", "oracle")
TIGHT: dict[str, Any] = {"rtol": 1e-12, "atol": 1e-14}
X, Y, Z = np.eye(3)
SIDES = {-1: "lower", 1: "upper"}


# Scenes


def acting(stop: Stop) -> dict[str, Any]:
    """Return the arguments of a joint with these bounds."""
    bounds = {k: float(x) for k, x in (("lower", stop.lower), ("upper", stop.upper)) if x is not None}
    return bounds | ({"stops": True, "restitution": float(stop.e)} if bounds else {})


def hanging(scene: truths.Scene) -> Model:
    """Return the links of a scene, which turn about y."""
    n, links = len(scene.q), []
    rub = scene.friction or n * [0.0]
    for k, (m, c, J) in enumerate(zip(*(truths.LINKS[x][:n] for x in "mcJ"), strict=True)):
        place = (0, 0, -truths.LINKS["l"][k - 1] if k else 0.0)
        body = {"mass": m, "com": (0, 0, -c), "inertia": (J, J, J)}
        links.append(body | {"axis": Y, "translation": place, "friction": rub[k]} | acting(scene.stops[k]))
    return chain(*links, gravity=(0, 0, -scene.g)).build()


def on_a_cart(scene: truths.Scene) -> Model:
    c, J = truths.CART["c"], truths.CART["J"]
    cart = {"kind": "prismatic", "mass": truths.CART["M"], "inertia": (1, 1, 1), "axis": X} | acting(scene.stops[0])
    pole = {"mass": truths.CART["m"], "com": (0, 0, -c), "inertia": (J, J, J), "axis": -Y} | acting(scene.stops[1])
    return chain(cart, pole, gravity=(0, 0, -scene.g)).build()


def sliding(masses: Sequence[float], stops: Sequence[Stop], axis: Any = X, more: Any = None, **options: Any) -> Model:
    """Return sliders, each on the one before it."""
    links = [
        {"kind": "prismatic", "mass": m, "inertia": (1, 1, 1), "axis": axis} | acting(s) | (more[k] if more else {})
        for k, (m, s) in enumerate(zip(masses, stops, strict=True))
    ]
    return chain(*links, **options).build()


def pushed(scene: truths.Scene) -> Model:
    told = truths.PUSHED
    b = mb.ModelBuilder.of(sliding(told["m"], scene.stops, more=[{"friction": f} for f in scene.friction or ()]))
    for k, (a, w) in enumerate(zip(told["amplitude"], told["rate"], strict=True)):
        b.add_joint_force(f"push {k}", f"j{k}", lambda t, q, v, a=a, w=w: a * (w * t).sin())  # noqa: ARG005
    return b.build()


def rubbed(told: truths.Rubbed) -> Model:
    given = {"mass": told.m, "friction": told.f, "stiffness": told.k, "rest": told.rest} | acting(Stop(0, None, told.e))
    b = slider(inertia=(1, 1, 1), **given)
    a, r, c, w = told.force
    b.add_joint_force("push", "x", lambda t, q, v: a + r * t + c * (w * t).sin())  # noqa: ARG005
    return b.build()


def pendulum(stop: Stop) -> Model:
    return hinge(mass=2.0, com=(0, 0, -0.5), inertia=(0.5, 0.5, 0.5), **acting(stop)).build()


def four_bar(e: float) -> tuple[Model, np.ndarray]:
    """Return the linkage with a stop at its crank, and its pose let go at 0.8 rad."""
    b, bar = linkage(), truths.FourBar()
    b.set_joint("at_crank", **acting(Stop(0.3, None, e)))
    phi, psi = bar.angles(mp.mpf(0.8))
    return b.build(), np.array([0.8, float(phi) - 0.8, float(psi)])


@dataclass(frozen=True)
class Case:
    """A model, its start, how long it runs, and what happens; the last q and v, where they are known."""

    model: Model
    q: Any
    v: Any
    duration: float
    events: list[Event]
    end: tuple[Any, Any] | None = None

    def names(self) -> list[str]:
        joint = [j.name for j in self.model.joints]
        words = {"stops": "stops", "turns": "turns", "lets go": "lets go", "rests": "comes to rest on its {} stop"}
        words |= {"hits": "hits its {} stop", "leaves": "leaves its {} stop"}
        return [f"{joint[e.joint]} {words[e.kind].format(SIDES[e.side])}" for e in self.events]


def by_arcs(name: str) -> Case:
    """Return a scene up to its last event, where there are as many as are kept, or its end."""
    scene = truths.SCENES[name]
    events, (q, v, t) = truths.kept(name)
    model = {"links": hanging, "cart": on_a_cart, "sliders": pushed}[scene.kind](scene)
    if len(events) < scene.most:
        return Case(model, scene.q, scene.v, t, events, (q, v))
    # The state where the last event is depends on it; a little behind it nothing has happened yet.
    return Case(model, scene.q, scene.v, t * (1 + 1e-6), events)


def closed(name: str) -> Case:
    """Return a closed form: name -> what happens until a little behind the last event that is given."""
    n, half = 5, 0.5

    def up_to(model: Model, q: Any, v: Any, events: list[Event]) -> Case:
        return Case(model, q, v, float(events[-1].t) * (1 + 1e-6), events)

    if name == "bounces":
        model = slider(mass=2.0, inertia=(1, 1, 1), axis=Z, **acting(Stop(0, None, half))).build()
        return up_to(model, [1.3], [0.7], truths.bounces(1.3, half, n, 0.7, 2.0)[0])
    if name == "between plates":
        model = slider(inertia=(1, 1, 1), axis=Z, **acting(Stop(0, 0.4, 0.8))).build()
        return up_to(model, [0], [5], truths.between_plates(0.4, 5.0, 0.8, n))
    if name.startswith("pendulum"):
        stop = float(name.split()[-1])
        return up_to(pendulum(Stop(stop, None, half)), [1.2], [0], truths.pendulum(1.2, stop, half, n)[0])
    if name.startswith("cradle"):
        e, masses, gaps, u = float(name.split()[-1]), (1.0, 2.0, 0.5), (0.3, 0.2), (1.0, 0.0, -0.25)
        model = sliding(masses, [Stop(0, None, e)] * 3)
        return up_to(model, [0.5, *gaps], truths.relative(u), truths.cradle(masses, gaps, u, e, 0.5)[:n])
    told = truths.RUBBED[name]
    duration = 0.7 if name == "table" else 1.5
    events, end = told.run(duration, step=2e-3)
    return Case(rubbed(told), [0.0], [0.0], duration, events, ([end[0]], [end[1]]))


CLOSED = (
    *("bounces", "between plates"),
    *(f"pendulum with a stop at {x}" for x in ("-0.3", "0.0", "0.4")),
    *("cradle with e = 0.6", "cradle with e = 1.0"),
    *truths.RUBBED,
)


@cache
def case(name: str) -> Case:
    return (by_arcs if name in truths.SCENES else closed)(name)


def floats(x: Any) -> np.ndarray:
    return np.array(x, dtype=float)


# The scenes are those of the truths


@pytest.mark.parametrize("name", truths.SCENES)
def test_scenes_are_described_as_the_truths_are(name: str) -> None:
    scene, rng = truths.SCENES[name], np.random.default_rng(1)
    terms = scene.terms()
    told = case(name).model
    free = told.without("stops", "friction")
    q, v = rng.uniform(-1, 1, (2, told.nv))
    M, f = terms([mp.mpf(x) for x in q], [mp.mpf(x) for x in v], mp.mpf(0))
    a = np.linalg.solve(floats(M), floats(f))
    np.testing.assert_allclose(mb.dynamics(free, "pinocchio").forward_dynamics(q, v, np.zeros(told.nv)), a, rtol=1e-12)
    for e in case(name).events:
        if e.kind == "hits":
            # A joint that rests on its stop takes part.
            rows = [i for i, s in enumerate(scene.stops) if i == e.joint or (s.reached(e.q[i]) and not e.after[i])]
            hit = mb.impact(
                mb.dynamics(free, "pinocchio"),
                e.q,
                e.before,
                jacobian=np.eye(told.nv)[rows],
                restitution=scene.stops[e.joint].e,
            )
            np.testing.assert_allclose(hit.v, e.after, rtol=0, atol=1e-12)
            assert -hit.energy_change == pytest.approx(e.lost, rel=1e-11, abs=1e-13)


# Runs


def off(a: Any, b: Any) -> float:
    return float(np.abs(floats(a) - floats(b)).max(initial=0))


def paired(run: Any, told: Case) -> list[tuple[Any, Event]]:
    """Return each event of a run with that of the truth, which has the same name."""
    mine, expected = list(run.events), list(zip(told.names(), told.events, strict=True))
    for k, (_, truth) in enumerate(expected):
        if truth.kind == "rests":
            # Bounces from some size on are one.
            mine = [e for e in mine if not truth.t - 1e-4 < e.t < truth.t - 1e-8]
            expected = [x for x in expected[:k] if x[1].t < truth.t - 1e-4] + expected[k:]
            break
    if told.end is None:
        mine = mine[: len(expected)]
    assert [e.name for e in mine] == [name for name, _ in expected]
    return [(e, truth) for e, (_, truth) in zip(mine, expected, strict=True)]


def require(run: Any, told: Case, tolerance: float) -> None:
    """Events have the names and order of the truth; times, positions and the end are its."""
    assert run.stats.ended == "finished"
    for e, truth in paired(run, told):
        assert e.t == pytest.approx(float(truth.t), abs=tolerance)
        # What comes to rest has the state of its last hit, a little before.
        at = e.q + (e.v * (float(truth.t) - run.events[run.events.index(e) - 1].t) if truth.kind == "rests" else 0.0)
        assert off(at, truth.q) < 10 * tolerance
        if truth.kind != "rests":
            assert off(e.v, truth.after) < 100 * tolerance
    if told.end is not None:
        assert off(run.q[-1], told.end[0]) < 10 * tolerance
        assert off(run.v[-1], told.end[1]) < 100 * tolerance


def went(told: Case, method: str = "rk853", engine: str = "lagrangian", **more: Any) -> Any:
    """Return a run of a case."""
    settings = {"dt": more.pop("dt")} if "dt" in more else TIGHT
    return mb.simulate(mb.dynamics(told.model, engine), told.q, told.v, told.duration, method, **settings, **more)


@pytest.mark.parametrize("name", [*CLOSED, *truths.SCENES])
def test_a_run_meets_its_stops_as_the_truth_does(name: str) -> None:
    require(went(case(name)), case(name), 1e-10)


@pytest.mark.thorough(
    "rodas5-pendulum with a stop at -0.3",
    "rodas5-second joint, e = 0",
    "rodas5-cart, e = 0.7",
    "dop853-second joint, e = 0",
)
@pytest.mark.parametrize("name", ["pendulum with a stop at -0.3", "second joint, e = 0", "sticks", "cart, e = 0.7"])
@pytest.mark.parametrize("method", ["auto", "taylor", "dop853", "rodas5"])
def test_adaptive_methods_find_the_same_events(method: str, name: str) -> None:
    require(went(case(name), method), case(name), 1e-10)


@pytest.mark.thorough("mujoco-bounces and rest", "oracle-bounces and rest")
@pytest.mark.parametrize("name", ["bounces and rest", "rubbed links"])
@pytest.mark.parametrize("engine", ENGINES[1:])
def test_engines_meet_the_same_stops(engine: str, name: str) -> None:
    require(went(case(name), engine=engine), case(name), 1e-10)


@pytest.mark.parametrize("name", ["second joint, e = 0", "second joint, e = 0.5", "first joint, e = 1"])
def test_rk4_keeps_its_order_across_stops(name: str) -> None:
    """Hits and leaves fall within steps."""
    told = case(name)
    steps = [400, 800, 1600]
    errors = []
    for n in steps:
        run = went(told, "rk4", dt=told.duration / n)
        assert [e.name for e in run.events] == told.names()
        # At the last event, where there is no end of a known state.
        mine, truth = (run.q[-1], told.end[0]) if told.end else (run.events[-1].t, told.events[-1].t)
        errors.append(off(mine, truth))
    order = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert 3.5 < order < 4.7, errors


@pytest.mark.thorough("cart, e = 0")
@pytest.mark.parametrize("name", ["second joint, e = 0", "second joint, e = 0.5", "cart, e = 0", "rubbed, e = 0.5"])
def test_moreau_is_of_first_order_across_stops(name: str) -> None:
    told = case(name)
    ends = told.end or (told.events[-1].q, None)
    errors = [off(went(told, "moreau", dt=told.duration / n).q[-1], ends[0]) for n in (500, 2000)]
    assert errors[1] < 3e-2
    assert errors[1] < 0.5 * errors[0]


# Energy, rest, simultaneous hits


@pytest.mark.parametrize("name", ["cradle with e = 0.6", "between plates", "both joints", "three links"])
def test_a_run_loses_the_energy_of_its_hits_and_no_other(name: str) -> None:
    """Carnot's: that of the velocities that are lost, times (1 - e)/(1 + e)."""
    told, dyn = case(name), mb.dynamics(case(name).model, "lagrangian")
    run = went(told)
    states = (told.q, told.v), (run.q[-1], run.v[-1])
    energy = [float(dyn.kinetic_energy(q, v) + dyn.potential_energy(q)) for q, v in states]
    assert energy[1] - energy[0] == pytest.approx(sum(e.energy_change for e in run.events), rel=1e-11, abs=1e-11)
    for e, truth in zip(run.events, told.events, strict=False):
        assert e.energy_change == pytest.approx(-float(truth.lost), rel=1e-12, abs=1e-12)
        assert off(e.before, truth.before) < 1e-11
        if name == "both joints":
            jump = e.v - e.before
            assert e.energy_change == pytest.approx(-(jump @ floats(dyn.mass_matrix(e.q)) @ jump) / 2, rel=1e-12)


@pytest.mark.parametrize("method", ["rk853", "taylor", "rk4"])
@pytest.mark.parametrize(("e", "start"), [(0.5, 1.3), (0.8, 0.02), (0.01, 1.0)])
def test_bounces_end_where_zenos_series_does(e: float, start: float, method: str) -> None:
    model = slider(mass=2.0, inertia=(1, 1, 1), axis=Z, **acting(Stop(0, None, e))).build()
    _, limit = truths.bounces(start, e, 1)
    # A step that hits is cut within the digits of a position.
    settings, tolerance = ({"dt": 1e-2}, 1e-7) if method == "rk4" else (TIGHT, 1e-10)
    run = mb.simulate(mb.dynamics(model, "lagrangian"), [start], [0], float(limit) + 0.3, method, **settings)
    assert run.stats.ended == "finished"
    assert run.events[-1].name == "x comes to rest on its lower stop"
    assert run.events[-1].t == pytest.approx(float(limit), abs=tolerance)
    still = run.t > run.events[-1].t
    assert still.any()
    assert not run.q[still].any()
    assert not run.v[still].any()


def test_a_pendulum_comes_to_rest_on_a_stop_above_the_bottom() -> None:
    _, limit = truths.pendulum(1.2, 0.4, 0.5, 1)
    run = mb.simulate(mb.dynamics(pendulum(Stop(0.4, None, 0.5))), [1.2], [0], float(limit) + 0.2, "rk853", **TIGHT)
    assert run.events[-1].name == "j comes to rest on its lower stop"
    assert run.events[-1].t == pytest.approx(float(limit), abs=1e-9)
    assert run.q[-1] == 0.4
    assert run.v[-1] == 0.0


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("stops", [(True, True, True), (True, False, True), (False, True, True)])
def test_what_meets_its_stops_at_once_is_projected(stops: tuple[bool, ...], engine: str) -> None:
    masses = (1.0, 2.0, 0.5)
    q, v, _, after, carnot = truths.stack(masses, 0.5, (5.0, 0.3, 0.7), stops)
    model = sliding(masses, [Stop(0) if s else Stop() for s in stops], Z)
    dyn = mb.dynamics(model, engine)
    run = mb.simulate(dyn, floats(q), floats(v), 0.5 + 1e-7, "rk853", **TIGHT)
    assert sorted(e.name for e in run.events) == [f"j{k} hits its lower stop" for k in range(3) if stops[k]]
    # A group that no stop joins to the ground falls on, the next one with it.
    fall = np.array([0.0 if stops[0] else -9.81e-7, 0 if stops[1] or not stops[0] else -9.81e-7, 0])
    assert off(run.v[-1], floats(after) + fall) < 1e-9
    M = floats(dyn.mass_matrix(run.q[-1]))
    jump = floats(after) - floats(truths.stack(masses, 0.5, (5.0, 0.3, 0.7), stops)[2])
    assert jump @ M @ jump / 2 == pytest.approx(float(carnot), rel=1e-12)
    if all(stops):
        weights = np.cumsum(masses[::-1])[::-1] * 9.81
        np.testing.assert_allclose(
            floats(dyn.stop_forces(0 * run.q[-1], 0 * run.v[-1], np.zeros(3))), weights, rtol=1e-12
        )


@pytest.mark.parametrize("e", [0.0, 0.5])
@pytest.mark.parametrize("method", ["rk853", "rk4"])
def test_a_linkage_feels_the_stop_of_its_crank(method: str, e: float) -> None:
    (model, q), bar = four_bar(e), truths.FourBar()
    hits, _ = truths.kept(f"four-bar, e = {e:g}")
    dyn = mb.dynamics(model, "lagrangian")
    settings = {"dt": 1e-3} if method == "rk4" else TIGHT
    run = mb.simulate(dyn, q, np.zeros(3), float(hits[-1].t) + 0.01, method, **settings)
    tolerance = 1e-6 if method == "rk4" else 1e-10
    assert [e.name for e in run.events] == ["at_crank hits its lower stop"] * len(hits)
    assert off([e.t for e in run.events], [e.t for e in hits]) < tolerance
    assert off([e.v[0] for e in run.events], [e.after[0] for e in hits]) < 100 * tolerance
    if not e:
        force = floats(dyn.stop_forces(run.q[-1], run.v[-1], np.zeros(3)))
        np.testing.assert_allclose(force, [float(bar.slope(mp.mpf(0.3))), 0, 0], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("engine", ENGINES)
def test_what_rests_on_a_stop_has_the_force_of_the_formulas(engine: str) -> None:
    """Both links on stops, one of them, and one that is pulled off."""
    scene = truths.SCENES["both joints"]
    dyn, terms = mb.dynamics(case("both joints").model, engine), scene.terms()
    for q, v, tau in (
        ([0.2, -0.5], [0, 0], [0, 0]),
        ([0.7, -0.5], [1.5, 0], [0, 0]),
        ([0.2, -0.5], [0, 0], [9.0, 0.5]),
    ):
        M, f = (floats(x) for x in terms([mp.mpf(x) for x in q], [mp.mpf(x) for x in v], mp.mpf(0)))
        on, best = [i for i in (0, 1) if q[i] == scene.stops[i].lower], None
        for held in ((0, 1), (0,), (1,), ()):
            if not {*held} <= {*on}:
                continue
            free, a = [i for i in (0, 1) if i not in held], np.zeros(2)
            if free:
                a[free] = np.linalg.solve(M[np.ix_(free, free)], (f + tau)[free])
            force = M @ a - f - tau
            if all(force[i] >= 0 for i in held) and all(a[i] >= 0 for i in on if i not in held):
                best = a, np.where(np.isin([0, 1], held), force, 0)
                break
        np.testing.assert_allclose(floats(dyn.forward_dynamics(q, v, tau)), best[0], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(floats(dyn.stop_forces(q, v, tau)), best[1], rtol=1e-12, atol=1e-12)


# Edges


@pytest.mark.parametrize(("method", "beyond"), [
    *(("rk853", x) for x in (1e-2, 1e-6, 1e-10, -1e-10, -1e-6)), *(("taylor", x) for x in (1e-6, -1e-10)),
    *(("rk4", x) for x in (1e-2, -1e-10)),
])  # fmt: skip
def test_a_stop_is_touched_or_missed(method: str, beyond: float) -> None:
    """What flies up to a ceiling with a little more than it needs, or less: a hit of speed √(2 g beyond), or none."""
    height = 0.4
    v = float(np.sqrt(2 * 9.81 * (height + beyond)))
    model = slider(inertia=(1, 1, 1), axis=Z, **acting(Stop(0, height, 0.5))).build()
    told = truths.between_plates(height, v, 0.5, 2)
    settings = {"dt": 1e-2} if method == "rk4" else TIGHT
    run = mb.simulate(mb.dynamics(model, "lagrangian"), [0], [v], float(told[-1].t) + 1e-4, method, **settings)
    assert [e.name for e in run.events] == [f"x hits its {SIDES[e.side]} stop" for e in told]
    # The time of a touch is the root of a small number.
    assert off([e.t for e in run.events], [e.t for e in told]) < 1e-14 / np.sqrt(abs(beyond)) + 1e-11


@pytest.mark.parametrize("method", ["rk853", "rk4", "taylor", "moreau"])
def test_a_joint_that_begins_on_its_stop_is_driven_off_stays_or_hits(method: str) -> None:
    model = slider(gravity=(0, 0, 0), inertia=(1, 1, 1), **acting(Stop(0, 1, 0.5))).build()
    dyn = mb.dynamics(model, "lagrangian")
    settings = {"dt": 1e-3} if method in ("rk4", "moreau") else TIGHT
    # From rest: v = τ t off the stop, none against it.
    for tau, end in ((2.0, 0.2), (-2.0, 0.0), (0.0, 0.0)):
        run = mb.simulate(dyn, [0], [0], 0.1, method, torque=[tau], **settings)
        assert run.v[-1, 0] == pytest.approx(end, abs=1e-12)
        assert not [e for e in run.events if "hits" in e.name]
    # With a velocity into it: the impact is at the start.
    run = mb.simulate(dyn, [0], [-3.0], 0.1, method, **settings)
    assert run.v[-1, 0] == pytest.approx(1.5, abs=1e-12)
    assert run.q[-1, 0] == pytest.approx(0.15, abs=1e-2 if method == "moreau" else 1e-12)


def test_a_table_that_swings_throws_its_ball_as_in_its_own_frame() -> None:
    told = truths.RUBBED["table"]
    events, end = told.run(0.4)
    b = chain(
        {"kind": "prismatic", "mass": 1.0, "axis": Z},
        {"kind": "prismatic", "mass": told.m, "axis": Z} | acting(Stop(0, None, told.e)),
    )
    b.prescribe("j0", lambda t: 0.05 * (20.0 * t).sin())
    model = b.build(point_masses=True)
    run = mb.simulate(mb.dynamics(model), [0.0, 0.0], [1.0, 0.0], 0.4, "rk853", **TIGHT)
    assert [e.name for e in run.events] == [f"j1 {e.kind} its lower stop" for e in events]
    assert off([e.t for e in run.events], [e.t for e in events]) < 1e-10
    assert off([e.v[-1] for e in run.events], [e.after[0] for e in events]) < 1e-8
    assert off([run.q[-1, 1], run.v[-1, -1]], end) < 1e-9


def test_two_bodies_that_float_keep_their_momentum() -> None:
    """Scissors on a common axis, in free flight: ω₁ - ω₂ is turned round, J₁ ω₁ + J₂ ω₂ stays."""
    b = chain(
        {"kind": "planar", "mass": 1.0, "inertia": (0.1, 0.1, 0.2)},
        {"mass": 0.5, "inertia": (0.2, 0.2, 0.3), "axis": Z} | acting(Stop(-0.4, 0.6, 0.5)),
        gravity=(0, 0, 0),
    )
    model = b.build()
    q, v = np.zeros(4), np.array([0.3, -0.1, 1.0, 2.0])
    for engine in ENGINES:
        run = mb.simulate(mb.dynamics(model, engine), q, v, 1.5, "rk853", **TIGHT)
        assert [e.name for e in run.events] == ["j1 hits its upper stop", "j1 hits its lower stop"]
        assert off([e.t for e in run.events], [0.3, 1.3]) < 1e-11
        # 0.5 ω₁ + 0.3 θ̇ = 1.1.
        assert off(run.v[-1], [0.3, -0.1, (1.1 - 0.3 * 0.5) / 0.5, 0.5]) < 1e-11


@pytest.mark.parametrize("engine", ENGINES[:3])
def test_armature_takes_part_in_the_impact(engine: str) -> None:
    """A slider of m + A falls with g m/(m + A) on another that stands on its stop, and both carry on by the pair."""
    m, A, e = 2.0, 0.5, 0.4
    b = chain(
        {"kind": "prismatic", "mass": m, "inertia": (1, 1, 1), "axis": Z, "armature": A} | acting(Stop(0, None, e))
    )
    run = mb.simulate(mb.dynamics(b.build(), engine), [0.5], [0], 0.9, "rk853", **TIGHT)
    g = 9.81 * m / (m + A)
    first, speed = np.sqrt(1.0 / g), np.sqrt(g)
    assert (
        off([x.t for x in run.events[:3]], [first, first + 2 * e * speed / g, first + 2 * e * (1 + e) * speed / g])
        < 1e-10
    )


def test_a_nut_on_a_screw_hits_its_end() -> None:
    """θ̈ = -m g p/(J + m p²)."""
    m, J, p, e = 0.7, 0.02, 0.05, 0.6
    b = chain({"kind": "helical", "pitch": p, "mass": m, "inertia": (J, J, J), "axis": Z} | acting(Stop(-3.0, None, e)))
    run = mb.simulate(mb.dynamics(b.build()), [0], [0], 4.0, "rk853", **TIGHT)
    g = 9.81 * m * p / (J + m * p**2)
    first = np.sqrt(6 / g)
    expected = [first, first * (1 + 2 * e)]
    assert off([x.t for x in run.events[:2]], expected) < 1e-10


# Batches


@pytest.mark.parametrize("method", ["rk4", "rk853", "moreau"])
def test_members_of_a_batch_do_what_they_do_alone(method: str) -> None:
    told = case("cart, e = 0.7")
    rng = np.random.default_rng(3)
    q, v = told.q + rng.uniform(-0.1, 0.1, (6, 2)), rng.uniform(-1, 1, (6, 2))
    settings = {"rtol": 1e-10, "save": np.linspace(0, 1.5, 7)} if method == "rk853" else {"dt": 5e-3}
    dyn = mb.dynamics(told.model, "lagrangian")
    batch = mb.simulate(dyn, q, v, 1.5, method, **settings)
    for i in range(6):
        run = mb.simulate(dyn, q[i], v[i], 1.5, method, **settings)
        assert [e.name for e in run.events] == [e.name for e in batch.events if e.member == i]
        assert off([e.t for e in run.events], [e.t for e in batch.events if e.member == i]) < 1e-9
        assert off(batch.q[i], run.q) < 1e-9
        assert off(batch.v[i], run.v) < 1e-8


def test_without_stops_joints_pass_their_limits() -> None:
    told = case("second joint, e = 0.5")
    free = replace(told, model=told.model.without("stops"))
    run = went(free)
    assert not run.events
    assert run.q[:, 1].min() < -0.2


# Coordinates that others move


@pytest.mark.parametrize("joint", ["at_coupler", "at_rocker"])
def test_a_linkage_stops_at_any_of_its_joints_alike(joint: str) -> None:
    bar, end = truths.FourBar(), mp.mpf(0.3)
    (phi, psi), (p, r) = bar.angles(end), bar.rates(end)
    place, rate = (phi - end, p - 1) if joint == "at_coupler" else (psi, r)
    b = linkage()
    b.set_joint(joint, **acting(Stop(place, None, 0.5) if rate > 0 else Stop(None, place, 0.5)))
    phi, psi = bar.angles(mp.mpf(0.8))
    hits, _ = truths.kept("four-bar, e = 0.5")
    start = floats([0.8, phi - 0.8, psi])
    run = mb.simulate(mb.dynamics(b.build()), start, np.zeros(3), float(hits[-1].t) + 0.01, "rk853", **TIGHT)
    assert [e.name for e in run.events] == [f"{joint} hits its {SIDES[-1 if rate > 0 else 1]} stop"] * len(hits)
    assert off([e.t for e in run.events], [e.t for e in hits]) < 1e-10


def test_a_joint_that_follows_stops_its_leader() -> None:
    """The follower turns -2 times as far and starts at 0.1: its upper stop at 0.5 is the leader's lower at -0.2."""
    m = (1.0, 0.5)
    b = chain(
        {"kind": "prismatic", "mass": m[0], "inertia": (1, 1, 1), "axis": X},
        {"kind": "prismatic", "mass": m[1], "inertia": (1, 1, 1), "axis": X, "parent": "world"}
        | {"mimic": ("j0", -2.0, 0.1)}
        | acting(Stop(None, 0.5, 0.5)),
    )
    run = mb.simulate(mb.dynamics(b.build()), [0], [-1.0], 0.5, "rk853", **TIGHT)
    assert [e.name for e in run.events] == ["j1 hits its upper stop"]
    assert run.events[0].t == pytest.approx(0.2, abs=1e-12)
    assert run.v[-1, 0] == pytest.approx(0.5, abs=1e-12)


@pytest.mark.parametrize("method", ["rk853", "rk4"])
def test_a_planar_joint_has_four_walls(method: str) -> None:
    """A disc in a box, each way with a restitution of its own, and then in a corner, both at once."""
    b = mb.ModelBuilder("box", gravity=(0, 0, 0))
    b.add_body("disc", mass=1.3, inertia=(0.1, 0.1, 0.2))
    walls = {"lower": (0, 0, -np.inf), "upper": (1.0, 0.5, np.inf), "stops": True, "restitution": (0.5, 1.0, 0.0)}
    b.add_joint("j", "planar", parent="world", child="disc", **walls)
    settings = {"dt": 1e-2} if method == "rk4" else TIGHT
    dyn = mb.dynamics(b.build())
    # x meets 1 at 0.5 s, and 0 with half the speed at 1.5 s; y 0.5 at 0.6 s and 0 at 1.35 s.
    run = mb.simulate(dyn, [0, 0.1, 0], [2.0, 2 / 3, 3.0], 2.0, method, **settings)
    assert off([e.t for e in run.events], [0.5, 0.6, 1.35, 1.5]) < 1e-11
    assert off(run.v[-1], [0.5, 2 / 3, 3.0]) < 1e-12
    run = mb.simulate(dyn, [0.5, 0.25, 0], [1.0, 0.5, 3.0], 0.6, method, **settings)
    assert off(run.v[-1], [-0.5, -0.5, 3.0]) < 1e-12
    assert off(run.q[-1], [0.95, 0.45, 1.8]) < 1e-12
