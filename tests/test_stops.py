"""Joint stops on random systems: accelerations, impacts and runs, against every set of stops in turn; bad input."""

from __future__ import annotations

import pickle
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mbkit as mb
from mbkit.engines.elements.stop_impacts import after_impacts
from mbkit.errors import InputError, MbkitWarning, ModelError
from mbkit.model import Model
from mbkit.model.stops import StopLaw
from mbkit.simulate.solvers.in_phases import fixed
from tests.random_trees import coupled, random_tree
from tests.scenes import chain, hinge, slider

ENGINES = ("lagrangian", "pinocchio", "mujoco", "oracle")
ONE = ("revolute", "prismatic", "continuous", "helical")


def with_bounds(tree: Model, seed: int, e: float = 0.0, *, wide: float = 0.0) -> tuple[Model, np.ndarray]:
    """Return a tree with stops at most of its joints, and a state that is at some of them."""
    rng = np.random.default_rng([seed, 7])
    b, q = mb.ModelBuilder.of(tree), tree.neutral() + rng.uniform(-1, 1, tree.nq)
    for joint in (j for j in tree.independent_joints if j.type.nv == 1):
        at, side = float(q[tree.layout.q[joint.name].start]), int(rng.integers(-1, 2))
        low, high = (at - wide * (side == 1) - (side != 1), at + wide * (side == -1) + (side != -1))
        low, high = (at if side == 1 and not wide else low), (at if side == -1 and not wide else high)
        b.set_joint(joint.name, lower=low, upper=high, stops=True, restitution=e)
    return b.build(), q


def every_set(
    M: np.ndarray, J: np.ndarray, free: np.ndarray, rate: np.ndarray, side: np.ndarray, least: np.ndarray
) -> np.ndarray:
    """Return a with M a = free + Jᵀ λ + side μ, J a = rate and 0 <= μ ⟂ side a >= least, by all sets of stops."""
    at = np.flatnonzero(side)
    for pushes in product((False, True), repeat=len(at)):
        on = at[list(pushes)]
        R = np.vstack([J, np.eye(len(M))[on]])
        K = np.block([[M, R.T], [R, np.zeros((len(R), len(R)))]])
        x = np.linalg.lstsq(K, np.concatenate([free, rate, side[on] * least[on]]), rcond=1e-13)[0]
        a, force = x[: len(M)], side[on] * -x[len(M) + len(J) :]
        size = 1e-10 * max(1.0, np.abs(x).max())
        if (force >= -size).all() and (side * a >= least - size)[at].all():
            return np.asarray(a)
    raise AssertionError("no set of stops solves the problem")


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("seed", range(4))
def test_accelerations_at_stops_solve_gauss_s_problem(engine: str, seed: int) -> None:
    kinds = ONE[:3] if engine == "mujoco" else ONE
    model, q = with_bounds(random_tree(seed, 6, kinds, nearest=2), seed)
    dyn, smooth = mb.dynamics(model, engine), mb.dynamics(model.without("stops"), "pinocchio")
    rng = np.random.default_rng(seed)
    side, v = StopLaw(model).against(q), np.zeros(model.nv)
    assert np.count_nonzero(side) > 1
    for k in range(6):
        v = np.where(side == 0, rng.standard_normal(model.nv), 0.0)
        tau, M = 20 * rng.standard_normal(model.nv), smooth.mass_matrix(q)
        free = tau + smooth.passive(q, v) - smooth.nle(q, v)
        none = np.zeros((0, model.nv))
        wanted = every_set(M, none, free, np.zeros(0), side, np.zeros(model.nv))
        a, force = dyn.forward_dynamics(q, v, tau), dyn.stop_forces(q, v, tau)
        size = 1e-11 * np.abs(free).max() * np.linalg.cond(M) ** 0.5
        np.testing.assert_allclose(a, wanted, rtol=0, atol=size)
        np.testing.assert_allclose(M @ a - free, force, rtol=0, atol=size)
        assert (side * force >= 0).all(), k
        assert (a[(side != 0) & (np.abs(wanted) < size)] == 0).all()


@pytest.mark.parametrize("seed", range(3))
def test_accelerations_beside_couplers_solve_gauss_s_problem(seed: int) -> None:
    tree = coupled(random_tree(seed, 6, ONE, nearest=2), seed)
    q, _ = mb.dynamics(tree).project(tree.neutral(), np.zeros(tree.nv))
    rng = np.random.default_rng(seed)
    b = mb.ModelBuilder.of(tree)
    free_joint, tied = tree.joints[0].name, tree.couplers[0].joint
    for name in dict.fromkeys((free_joint, tied)):
        b.set_joint(name, lower=float(q[tree.joint_names.index(name)]), stops=True)
    model = b.build()
    smooth, side, v = mb.dynamics(tree), StopLaw(model).against(q), np.zeros(model.nv)
    for _ in range(6):
        tau = 20 * rng.standard_normal(model.nv)
        J, M = smooth.constraint_jacobian(q), smooth.mass_matrix(q)
        force = tau + smooth.passive(q, v) - smooth.nle(q, v)
        wanted = every_set(M, J, force, -smooth.constraint_bias(q, v), side, np.zeros(model.nv))
        for engine in ("lagrangian", "pinocchio"):
            a = mb.dynamics(model, engine).forward_dynamics(q, v, tau)
            np.testing.assert_allclose(a, wanted, rtol=0, atol=1e-9 * max(1.0, np.abs(force).max()))


@pytest.mark.parametrize("e", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_an_impact_is_newton_s_and_takes_carnot_s_energy(seed: int, e: float) -> None:
    model, q = with_bounds(random_tree(seed, 6, ONE, nearest=2), seed, e)
    dyn, rng = mb.dynamics(model, "lagrangian"), np.random.default_rng(seed)
    side, M = StopLaw(model).against(q), dyn.mass_matrix(q)
    for _ in range(5):
        v = rng.standard_normal(model.nv)
        out = side * v < 0
        after, hit, lost = (x[0] for x in after_impacts(dyn._jumps, dyn, q[None], v[None]))
        assert (side * after >= -1e-12).all()
        # The impulses are those of stops alone, and push.
        P = M @ (after - v)
        assert (np.abs(P[side == 0]) < 1e-12).all()
        assert (side * P > -1e-12).all()
        energy = 0.5 * after @ M @ after - 0.5 * v @ M @ v
        assert abs(energy - lost.sum()) < 1e-12 * (v @ M @ v)
        if e == 0.0:
            wanted = every_set(M, np.zeros((0, model.nv)), M @ v, np.zeros(0), side, np.zeros(model.nv))
            np.testing.assert_allclose(after, wanted, rtol=0, atol=1e-10)
            assert abs(energy + 0.5 * (after - v) @ M @ (after - v)) < 1e-12 * (v @ M @ v)
        if e == 1.0:
            assert abs(energy) < 1e-12 * (v @ M @ v)
        if out.sum() == 1 and hit.sum() == 1:
            (i,) = np.flatnonzero(hit)
            known = mb.impact(dyn, q, v, jacobian=np.eye(model.nv)[i], restitution=e)
            if e > 0 or (side * known.v >= 0).all():
                np.testing.assert_allclose(after, known.v, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("method", "seed", "e", "friction"),
    [
        ("rk4", 0, 0.0, 0.0),
        ("rk4", 2, 0.3, 0.4),
        ("rk853", 1, 0.5, 0.0),
        ("rk853", 3, 0.0, 0.4),
        ("gauss4", 0, 0.0, 0.0),
    ],
)
def test_runs_of_random_trees_stay_between_their_stops(method: str, seed: int, e: float, friction: float) -> None:
    tree = random_tree(seed, 4, ("revolute", "prismatic"), nearest=1, springs=False)
    model, q = with_bounds(tree, seed, e, wide=0.3)
    b = mb.ModelBuilder.of(model)
    for name in model.joint_names:
        b.set_joint(name, friction=friction)
    model = b.build()
    how: dict[str, Any] = {"rtol": 1e-11} if method == "rk853" else {"dt": 5e-3 if method == "gauss4" else 2e-3}
    starts = q + np.random.default_rng(seed).uniform(-0.05, 0.05, (3, model.nq))
    starts = mb.dynamics(model, "lagrangian").project(starts, np.zeros((3, model.nv)))[0]
    rests = np.zeros(starts.shape)
    dyn, save = mb.dynamics(model, "lagrangian"), np.linspace(0, 1.0, 101)
    together = mb.simulate(dyn, starts, rests, 1.0, method=method, save=save, **how)
    room = 64 * 2.0**-52 * max(1.0, np.abs([model.lower, model.upper]).max())
    assert (together.q >= model.lower - room).all()
    assert (together.q <= model.upper + room).all()
    assert any("hits" in x.name for x in together.events)
    for i, start in enumerate(starts):
        alone = mb.simulate(dyn, start, rests[i], 1.0, method=method, save=save, **how)
        assert [x.name for x in alone.events] == [x.name for x in together.events if x.member == i]
        # gauss4 is not compiled: the products of a batch are rounded as a batch's.
        exact = {"rtol": 0, "atol": 1e-11 if method == "gauss4" else 0}
        np.testing.assert_allclose(alone.q, together.q[i], **exact)
        np.testing.assert_allclose(alone.v, together.v[i], **exact)
    if method == "rk4":
        q1, v1 = starts, rests
        for _ in range(500):
            q1, v1 = dyn.step(q1, v1, np.zeros(v1.shape), 2e-3, "rk4")
        assert np.array_equal(q1, together.q[:, -1])
        assert np.array_equal(v1, together.v[:, -1])


def test_the_energy_of_a_run_goes_where_its_events_and_friction_say() -> None:
    links = [{"mass": 1.0, "com": (0.5, 0, 0), "inertia": (0.1, 0.1, 0.1), "axis": (0, 1, 0)} for _ in range(2)]
    own = {"lower": -0.7, "upper": 0.9, "stops": True, "restitution": 0.3, "friction": 0.4}
    model = chain(links[0] | own, links[1] | own | {"translation": (1, 0, 0)}).build()
    for engine, method, more in (("lagrangian", "rk853", {}), ("pinocchio", "rk4", {"dt": 1e-3})):
        run = mb.simulate(mb.dynamics(model, engine), [0.0, 0.0], [0.0, 0.0], 2.0, method=method, **more)
        assert sum("hits" in x.name for x in run.events) > 10
        assert np.abs(run.power_balance()).max() < 1e-7


def test_impacts_at_one_time_go_through_sixty_bodies() -> None:
    links = [{"kind": "prismatic", "mass": 1.0, "axis": (1, 0, 0)} for _ in range(60)]
    own = {"lower": 0.0, "stops": True, "restitution": 1.0}
    dyn = mb.dynamics(chain(links[0], *(x | own for x in links[1:]), gravity=(0, 0, 0)).build(), "pinocchio")
    v = np.zeros((1, 60))
    v[0, :2] = 1.0, -1.0
    after = after_impacts(dyn._jumps, dyn, np.zeros((1, 60)), v)
    np.testing.assert_allclose(np.cumsum(after.v), [*np.zeros(59), 1.0], atol=1e-12)
    assert after.hit.sum() == 59


def test_bodies_that_close_in_on_one_come_to_an_end() -> None:
    links = [{"kind": "prismatic", "mass": m, "axis": (1, 0, 0)} for m in (1e4, 1.0, 1e4)]
    own = {"lower": 0.0, "stops": True, "restitution": 0.99}
    dyn = mb.dynamics(chain(links[0], *(x | own for x in links[1:]), gravity=(0, 0, 0)).build(), "lagrangian")
    after = after_impacts(dyn._jumps, dyn, np.zeros((1, 3)), np.array([[1.0, 0.0, -2.0]])).v[0]
    assert (after[1:] >= 0).all()
    assert abs(1e4 * after[0] + after[:2].sum() + 1e4 * after.sum() - 1.0) < 1e4 * 1e-11


def test_a_row_of_touching_balls_hands_the_velocity_on() -> None:
    links = [{"kind": "prismatic", "mass": 1.0, "axis": (1, 0, 0)} for _ in range(4)]
    own = {"lower": 0.0, "stops": True, "restitution": 1.0}
    model = chain(links[0], *(x | own for x in links[1:]), gravity=(0, 0, 0)).build()
    dyn = mb.dynamics(model, "lagrangian")
    run = mb.simulate(dyn, [0, 0.5, 0, 0], [1.0, -1.0, 0, 0], 1.0, method="rk4", dt=0.01)
    np.testing.assert_allclose(np.cumsum(run.v[-1]), [0, 0, 0, 1], atol=1e-13)
    assert [x.name for x in run.events] == [
        *(f"j{k} hits its lower stop" for k in (1, 2, 3)),
        "j3 leaves its lower stop",
    ]


def test_a_description_says_that_its_limits_act() -> None:
    model = slider(lower=-0.2, upper=0.3, stops=True, restitution=0.5).build()
    assert model.needs.stops
    assert model.acts["joint.stop"] == ("x",)
    assert model.joints[0].stops
    plain = model.without("stops")
    assert not plain.needs.stops
    assert plain.needs.limits
    assert plain.digest != model.digest
    assert not model.without("limits").needs.stops
    assert not model.smooth.needs.stops
    assert plain.with_stops(0.5) == model == pickle.loads(pickle.dumps(model))
    b = mb.ModelBuilder.of(model)
    b.set_joint("x", stops=False)
    assert b.build() == plain
    b = mb.ModelBuilder.of(model)
    b.set_joint("x", restitution=0.25)
    assert b.build().joints[0].restitution == 0.25
    panda = mb.load("panda", stops=True)
    assert len(panda.acts["joint.stop"]) == 9
    assert mb.load("panda") == panda.without("stops")


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"stops": True}, "stops without limits; give lower, upper or both"),
        ({"lower": 0.3, "upper": 0.3, "stops": True}, "stops of zero width"),
        ({"lower": 0.0, "upper": 1e-15, "stops": True}, "leave x no room"),
        ({"lower": 0.4, "upper": 0.3, "stops": True}, "lower limit [0.4] above upper limit [0.3]"),
        ({"lower": 0.0, "stops": True, "restitution": 1.5}, "restitution: expected numbers from 0 to 1, got [1.5]"),
        ({"lower": 0.0, "stops": True, "restitution": -0.1}, "restitution: expected numbers from 0 to 1, got [-0.1]"),
        ({"lower": 0.0, "restitution": 0.1}, "restitution without stops; give stops=True too"),
        ({"lower": 0.0, "stops": 1}, "stops: expected True or False, got 1"),
    ],
)
def test_stops_that_cannot_be_are_refused(given: dict[str, Any], says: str) -> None:
    with pytest.raises(ModelError) as refused:
        slider(**given).build()
    assert says in str(refused.value)


def test_stops_of_several_joints_leave_room() -> None:
    leader, follower = {"upper": 0.1, "stops": True}, {"lower": 0.4, "stops": True, "mimic": ("j0", 2.0, 0.1)}
    links = [{"mass": 1.0, "com": (0.1, 0, 0), "inertia": (1, 1, 1), "axis": (0, 1, 0)} for _ in range(2)]
    with pytest.raises(ModelError, match="stops of j1 and j0 leave j0 no room"):
        chain(links[0] | leader, links[1] | follower).build()
    with pytest.raises(ModelError, match="stops, while it follows 'j0' by a parameter"):
        chain(links[0], links[1] | follower | {"mimic": ("j0", mb.Parameter("r", 2.0), 0.1)}).build()
    with pytest.raises(ModelError, match="stops on a ball joint, which has no coordinate with such a rate"):
        chain(links[0] | {"kind": "ball", "axis": None, "stops": True}).build()


@pytest.mark.parametrize("method", ["rk853", "rk4", "moreau"])
def test_stops_of_a_joint_that_follows_nothing_hold_nothing(method: str) -> None:
    link = {"mass": 1.0, "com": (0.1, 0, 0), "inertia": (1, 1, 1), "axis": (0, 1, 0)}
    model = chain(link, link | {"lower": -0.1, "upper": 0.1, "stops": True, "mimic": ("j0", 0.0, 0.0)}).build()
    runs = [
        mb.simulate(mb.dynamics(x, "lagrangian"), [0.3], [0.1], 0.3, method) for x in (model, model.without("stops"))
    ]
    np.testing.assert_allclose(runs[0].q[-1], runs[1].q[-1], rtol=1e-8)
    assert not runs[0].events


@pytest.mark.parametrize("method", ["rk853", "rk4", "moreau"])
def test_a_motion_that_leads_a_joint_beyond_its_stop_ends_the_run_with_its_name(method: str) -> None:
    b = mb.ModelBuilder.of(slider(lower=-0.05, upper=0.05, stops=True).build())
    b.prescribe("x", amplitude=0.1, frequency=3.0)
    with pytest.warns(MbkitWarning, match="x is led beyond its upper stop by constraints, which no impact can stop"):
        run = mb.simulate(mb.dynamics(b.build(), "lagrangian"), [0.0], [0.3], 0.3, method)
    assert run.stats.ended == "diverged"
    assert not run.events
    assert run.q.max() <= 0.05


def test_a_start_beyond_a_stop_is_refused_with_the_amount_and_projected() -> None:
    model = hinge(lower=-0.2, upper=0.3, stops=True).build()
    for engine in ("lagrangian", "pinocchio", "mujoco"):
        dyn = mb.dynamics(model, engine)
        with pytest.raises(InputError, match=r"j is 0\.1 beyond its upper stop at 0\.3; start between the stops"):
            mb.simulate(dyn, [0.4], [0.0], 0.1)
        with pytest.raises(InputError, match=r"trajectory 1: j is 0\.05 beyond its lower stop at -0\.2"):
            mb.simulate(dyn, [[0.1], [-0.25]], np.zeros((2, 1)), 0.1)
        q, v = dyn.project([[0.4], [-0.25], [0.1]], [[1.0], [1.0], [1.0]])
        assert q.tolist() == [[0.3], [-0.2], [0.1]]
        assert v.tolist() == [[0.0], [1.0], [1.0]]
        mb.simulate(dyn, q, v, 0.1)


def test_a_loop_goes_between_its_stops_or_is_refused() -> None:
    free = mb.catalog.four_bar()
    crank, coupler, rocker = free.joint_names
    b = mb.ModelBuilder.of(free)
    b.set_joint(crank, lower=-0.5, upper=0.4, stops=True)
    dyn = mb.dynamics(b.build(), "lagrangian")
    q, v = dyn.project([-0.9, 0.3, 0.3], [-1.0, 0.0, 0.0])
    assert q[0] == -0.5
    assert v[0] == 0
    assert np.abs(dyn.constraint_residual(q)).max() < 1e-13
    b.set_joint(rocker, lower=0.9, upper=1.0, stops=True)
    b.set_joint(coupler, lower=-0.1, upper=0.1, stops=True)
    with pytest.raises(InputError):
        mb.dynamics(b.build(), "lagrangian").project([0.0, 0.0, 0.0], np.zeros(3))


def test_stops_that_are_reached_within_the_digits_of_a_time_are_hit_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    # Two sliders of one mass fall on bounds that differ by a few roundings, and a bar feels both.
    links = [{"kind": "prismatic", "mass": 1.0, "axis": (0, 0, 1), "parent": "world"} for _ in range(2)]
    model = chain(
        *(x | {"lower": -1.0 - 3e-13 * k, "stops": True} for k, x in enumerate(links)), gravity=(0, 0, -9.81)
    ).build()
    run = mb.simulate(mb.dynamics(model, "lagrangian"), [0, 0], [0, 0], 0.5, method="rk853", rtol=1e-12)
    assert len({x.t for x in run.events}) == 1
    assert len(run.events) == 2
    monkeypatch.setattr("mbkit.simulate.solvers.in_phases.phases._SIMULTANEOUS", 1e-14)
    run = mb.simulate(mb.dynamics(model, "lagrangian"), [0, 0], [0, 0], 0.5, method="rk853", rtol=1e-12)
    assert len({x.t for x in run.events}) == 2


def test_the_search_begins_on_the_parabola_of_the_speed() -> None:
    """Return to a stop: x (0.3 - x) has its zero at 0.3; chords from a first value of 1e-9 would take many rounds."""
    calls = []

    def height(x: np.ndarray, _: Any) -> np.ndarray:
        calls.append(x)
        return 1e15 * (x * (0.3 - x) + 1e-9 - 0.001 * x**3 * (x - 0.3))[:, None]

    counts = []
    for slope in (0.3e15, np.nan):
        calls.clear()
        ends = (height(np.array([x]), None) for x in (0.0, 1.0))
        found = fixed.first_zero(height, *ends, np.array([[slope]]))
        assert abs(height(found, None)) < 1e3
        counts.append(len(calls))
    assert counts[0] + 5 < counts[1]


def test_moreau_s_steps_rest_on_stops_to_the_bit_and_take_any_number() -> None:
    links = [
        {"kind": "prismatic", "mass": 1.0, "axis": (0, 0, 1), "lower": 0.0, "stops": True, "restitution": 0.2}
        for _ in range(12)
    ]
    model = chain(*links).build()
    for engine in ("lagrangian", "pinocchio"):
        dyn = mb.dynamics(model, engine)
        run = mb.simulate(dyn, np.linspace(0.01, 0.1, 12), np.zeros(12), 1.0, method="moreau", dt=1e-3)
        assert (run.q[-1] == 0).all()
        assert (run.v[-1] == 0).all()
        assert run.q.min() >= -1e-14
        np.testing.assert_allclose(
            dyn.stop_forces(run.q[-1], run.v[-1], np.zeros(12)), 9.81 * np.arange(12, 0, -1), rtol=1e-12
        )


@pytest.mark.parametrize("method", ["rk4", "gauss4"])
def test_long_steps_take_many_bounces(method: str) -> None:
    model = slider(lower=-0.05, stops=True, restitution=0.95, gravity=(-9.81, 0, 0)).build()
    run = mb.simulate(mb.dynamics(model, "lagrangian"), [0.0], [0.0], 40.0, method=method, dt=20.0)
    first = np.sqrt(2 * 0.05 / 9.81)
    assert run.stats.ended == "finished"
    assert run.events[-1].name == "x comes to rest on its lower stop"
    assert abs(run.events[-1].t - first * (1 + 2 * 0.95 / 0.05)) < 1e-9


def test_joints_knock_between_their_stops_in_long_steps() -> None:
    """One stop swallows, one throws back: they are hit in turn, sooner and sooner, far below a step."""
    links = [{"mass": 1.0, "com": (0, 0, -0.5), "inertia": (0.1, 0.1, 0.1), "axis": (0, 1, 0)} for _ in range(3)]
    own = [{"lower": -0.1, "stops": True, "friction": 0.1}, {"lower": 0.2, "stops": True, "restitution": 1.0}]
    model = chain(
        *(x | {"translation": (0, 0, -1.0 * (k > 0))} | (own[k] if k < 2 else {}) for k, x in enumerate(links)),
        gravity=(0, 0, 0),
    ).build()
    dyn = mb.dynamics(model, "lagrangian")
    rng = np.random.default_rng(8)
    q = np.array([-0.05, 0.25, 0.3]) + 0.04 * rng.uniform(-1, 1, (8, 3))
    v = np.array([-2.0, -4.0, 3.0]) + rng.standard_normal((8, 3))
    for dt in (1e-3, 1e-2):
        run = mb.simulate(dyn, q, v, 0.6, method="rk4", dt=dt)
        assert run.stats.ended == "finished"
    assert sum("j1 hits" in x.name for x in run.events) > 20


def test_bounces_that_a_hit_elsewhere_wakes_do_not_end_twice() -> None:
    links = [{"mass": 1.0, "com": (0.25, 0, 0), "inertia": (0.02, 0.02, 0.02), "axis": (0, 1, 0)} for _ in range(2)]
    own = [
        {"lower": -2.0, "upper": 0.4, "stops": True, "restitution": 0.4},
        {"lower": -0.5, "upper": 0.3, "stops": True},
    ]
    model = chain(links[0] | own[0], links[1] | own[1] | {"translation": (0.5, 0, 0)}).build()
    for q in np.random.default_rng(0).uniform([-1.0, -0.4], [0.2, 0.2], (6, 2)):
        runs = [
            mb.simulate(mb.dynamics(model, "lagrangian"), q, [0.0, 0.0], 3.0, method=m, **how)
            for m, how in (("rk853", {"rtol": 1e-12}), ("rk4", {"dt": 1e-3}))
        ]
        for run in runs:
            times = [x.t for x in run.events]
            assert times == sorted(times)
            assert times[-1] <= 3.0
            last = {name: max(x.t for x in run.events if x.name == name) for name in {x.name for x in run.events}}
            assert last["j0 comes to rest on its upper stop"] >= last["j0 hits its upper stop"]
        assert [x.name for x in runs[0].events] == [x.name for x in runs[1].events]


def test_a_run_with_impacts_has_its_energies_when_it_is_loaded(tmp_path: Path) -> None:
    model = slider(lower=0.0, stops=True, restitution=0.5, axis=(0, 0, 1)).build()
    run = mb.simulate(mb.dynamics(model, "lagrangian"), [1.0], [0.0], 1.0, "rk853", rtol=1e-10)
    run.save(tmp_path / "run.npz")
    again = mb.Trajectory.load(tmp_path / "run.npz", model)
    assert [x.energy_change for x in again.events] == [x.energy_change for x in run.events]
    assert [x.before.tolist() for x in again.events if x.before is not None] == [
        x.before.tolist() for x in run.events if x.before is not None
    ]
    assert again.events[0].before is not None
    np.testing.assert_array_equal(again.work(), run.work())


def test_low_bounces_on_two_stops_come_to_rest_together() -> None:
    """Each keeps the other up at 1e-10 rad/s: a run went on with hits at every 1e-11 s."""
    numbers = zip(
        (0.54921817, 1.29413386, 0.47913855),
        (0.45058098, 0.22642737, 0.55538039),
        (0.03645416, 0.02515479, 0.03410424),
        (0.75330186, 0.0, 0.93343847),
        (0.0, 0.70768277, 0.48155176),
        ((0.12755864, 0.90772461, 1.0), (-0.42614369, -0.03529701, 1.0), (-0.13102448, 0.39215834, 0.6)),
        strict=True,
    )
    links = [
        {
            "mass": m,
            "com": (0, 0, -c),
            "inertia": (J, J, J),
            "axis": (0, 1, 0),
            "translation": (0, 0, -d),
            "friction": f,
        }
        | {"lower": low, "upper": high, "stops": True, "restitution": e}
        for m, c, J, f, d, (low, high, e) in numbers
    ]
    dyn = mb.dynamics(chain(*links).build(), "lagrangian")
    start, v = np.array([0.33056252, -0.22408007, 0.28512146]), np.array([2.16624942, 0.0, 0.0])
    for method, how in (("rk853", {"rtol": 1e-11}), ("rk4", {"dt": 1e-3})):
        run = mb.simulate(dyn, start, v, 0.45, method=method, **how)
        assert len(run.events) < 200
        assert run.stats.ended == "finished"


def test_an_mjcf_says_of_limits_what_they_are_here() -> None:
    model = slider(lower=-0.2, stops=True).build()
    leaves_out = "which mbkit's terms leave out"
    assert not any(leaves_out in x for x in mb.convert(model, "mjcf").notes)
    assert any(leaves_out in x for x in mb.convert(model.without("stops"), "mjcf").notes)


@pytest.mark.parametrize(("method", "how"), [("rk853", {}), ("rk4", {"dt": 1e-3})])
def test_a_stop_at_a_singular_pose_ends_the_run_with_that_reason(method: str, how: dict[str, Any]) -> None:
    b = mb.ModelBuilder.of(mb.catalog.four_bars(n=2))
    b.set_joint("theta0", upper=np.pi / 2, stops=True)
    dyn = mb.dynamics(b.build(), "lagrangian")
    q, v = dyn.project(np.full(5, 0.3), np.zeros(5))
    with pytest.warns(MbkitWarning, match="theta0 reaches its upper stop at a singular pose"):
        run = mb.simulate(dyn, q, v, 1.0, method=method, **how)
    assert run.stats.ended == "diverged"


def test_limits_that_are_not_there_make_no_stops() -> None:
    with pytest.raises(InputError, match="pendulum has no joint with limits that could act"):
        mb.catalog.pendulum().with_stops()


def test_forces_that_stops_share_are_told_to_be_one_solution() -> None:
    free = mb.catalog.four_bar()
    q, v = mb.dynamics(free).project([0.3, -0.3, 0.0], np.zeros(3), hold=["theta"])
    b = mb.ModelBuilder.of(free)
    b.set_joint("theta", upper=float(q[0]), stops=True)
    alone = mb.dynamics(b.build(), "lagrangian").stop_forces(q, v, np.array([50.0, 0, 0]))
    assert alone[0] < 0
    assert (alone[1:] == 0).all()
    side = np.sign(mb.dynamics(free).project(q, [1.0, 0, 0], hold=["theta"])[1][2])
    b.set_joint("psi", **{"upper" if side > 0 else "lower": float(q[2])}, stops=True)
    with pytest.warns(MbkitWarning, match="stop_forces: what holds theta and psi|what holds theta, psi at rest is one"):
        mb.dynamics(b.build(), "lagrangian").stop_forces(q, v, np.array([50.0, 0, 0]))


def test_dampers_lose_what_they_lose_up_to_a_hit_and_from_it_on() -> None:
    model = slider(lower=0.0, stops=True, restitution=0.5, damping=2.0, gravity=(-9.81, 0, 0)).build()
    run = mb.simulate(mb.dynamics(model, "lagrangian"), [1.0], [0.0], 2.0, method="dop853", rtol=1e-12)
    assert sum("hits" in x.name for x in run.events) > 5
    assert np.abs(run.power_balance()).max() < 1e-3
