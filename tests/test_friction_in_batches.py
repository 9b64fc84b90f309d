"""Runs with dry friction side by side: each trajectory is that of a run of its own, whatever the others do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import mbkit as mb
from mbkit._check import EPS
from mbkit.errors import InputError, MbkitWarning, ModelError
from mbkit.model import Model
from mbkit.simulate.solvers.in_phases import fixed
from mbkit.simulate.solvers.in_phases.fixed import first_zero
from tests.random_trees import off
from tests.scenes import mounted
from tests.test_dry_friction import mostly_at_rest, rubbed

#: A step, and a run of so many steps with a shorter one at its end.
STEP, STEPS = 5e-3, 60
DURATION = (STEPS - 0.4) * STEP
SINGLE = ("revolute", "prismatic")


def pushed_in_time(model: Model) -> Model:
    """Return the model with a force of t that passes what friction holds now and then."""
    b = mb.ModelBuilder.of(model)
    for k, joint in enumerate(model.independent_joints):
        b.add_joint_force(f"push {k}", joint.name, lambda t, q, v, k=k: 6.0 * (9.0 * t + k).sin())  # noqa: ARG005
    return b.build()


def together_and_alone(dyn: Any, q: Any, v: Any, method: str, each: dict[str, Any], **more: Any) -> tuple[Any, list]:
    """Return a batch, and runs of its members; `each` has the arguments with a row for each of them."""
    settings = {"dt": STEP, "doubt": False, **more}
    batch = mb.simulate(dyn, q, v, DURATION, method, **each, **settings)
    alone = []
    for i in range(len(q)):
        own = {name: x[i] if not isinstance(x, dict) else {f: w[i] for f, w in x.items()} for name, x in each.items()}
        one = dyn if dyn._samples is None else dyn._of_sample(i)
        alone.append(mb.simulate(one, q[i], v[i], DURATION, method, **own, **settings))
    return batch, alone


def require_same(batch: Any, alone: list, tolerance: float = 1e-9) -> None:
    """Events are the same, in the same order; states and times to rounding, which changes of phase enlarge."""
    for i, run in enumerate(alone):
        mine = [e for e in batch.events if e.member == i]
        assert [e.name for e in mine] == [e.name for e in run.events], i
        assert [e.t for e in mine] == pytest.approx([e.t for e in run.events], abs=tolerance)
        assert off(batch.q[i], run.q) < tolerance
        assert off(batch.v[i], run.v) < tolerance
        np.testing.assert_array_equal(batch.v[i] == 0, run.v == 0)
    # Otherwise nothing was tested.
    assert len(batch.events) > 2
    assert len({e.t for e in batch.events}) > len(batch.events) // 2


@pytest.mark.thorough("1-gauss4", "0-rk4", "0-gauss4", "1-semi_implicit_euler")
@pytest.mark.parametrize("method", ["rk4", "semi_implicit_euler", "gauss4"])
@pytest.mark.parametrize("seed", [0, 1])
def test_members_change_phases_at_their_own_times(method: str, seed: int) -> None:
    """With a force for each step of each, kept now and then, and a last step that is shorter."""
    model = rubbed(seed, 4, SINGLE)
    q, v, tau = mostly_at_rest(model, 6, seed)
    rows = tau[:, None] * np.random.default_rng(seed).uniform(0, 1.5, (6, STEPS, 1)).round()
    dyn = mb.dynamics(model, "lagrangian")
    require_same(*together_and_alone(dyn, q, v, method, {"torque": rows}, save=[0.0, 7 * STEP, 50 * STEP, DURATION]))


def test_members_under_wrenches_with_parameters_of_their_own() -> None:
    b = mb.ModelBuilder.of(rubbed(4, 3, SINGLE))
    b.set_body(b.build().bodies[1].name, mass=mb.Parameter("m", 1.0))
    model = b.build()
    q, v, _ = mostly_at_rest(model, 8)
    dyn = mb.dynamics(model, "lagrangian", compile=True).at(m=np.linspace(0.5, 4, 8))
    wrench = np.random.default_rng(1).uniform(-50, 50, (8, 1, 6)) * np.ones((1, STEPS, 1))
    require_same(*together_and_alone(dyn, q, v, "rk4", {"wrenches": {model.bodies[-1].name: wrench}}))


def test_members_under_a_state_feedback_and_under_a_function() -> None:
    model = rubbed(5, 3, SINGLE)
    q, v, _ = mostly_at_rest(model, 5)
    dyn = mb.dynamics(model, "lagrangian")
    law = mb.simulate.StateFeedback(np.hstack([20 * np.eye(3), np.eye(3)]))
    for torque in (law, lambda t, q, v: law(t, q, v)):
        require_same(*together_and_alone(dyn, q, v, "rk4", {}, torque=torque))


def test_no_number_depends_on_the_threads_or_on_the_neighbours() -> None:
    model = rubbed(6, 4, SINGLE)
    q, v, tau = mostly_at_rest(model, 72)
    runs = []
    for threads, which in ((1, slice(None)), (3, slice(None)), (1, slice(40, 57))):
        dyn = mb.dynamics(model, "lagrangian", threads=threads)
        each = tau[which, None] * np.ones((1, STEPS, 1))
        runs.append(mb.simulate(dyn, q[which], v[which], DURATION, dt=STEP, torque=each, doubt=False))
    np.testing.assert_array_equal(runs[0].q, runs[1].q)
    assert [(e.name, e.t, e.member) for e in runs[0].events] == [(e.name, e.t, e.member) for e in runs[1].events]
    assert off(runs[0].q[40:57], runs[2].q) < 1e-12
    assert [e.name for e in runs[0].events if 40 <= e.member < 57] == [e.name for e in runs[2].events]


def test_what_diverges_ends_alone() -> None:
    """A member whose force grows beyond all numbers stops there; the others finish, with what they do alone."""
    model = rubbed(7, 3, SINGLE)
    q, v, tau = mostly_at_rest(model, 5)
    rows = tau[:, None] * np.ones((1, STEPS, 1))
    rows[2, 33:] = 1e105
    with pytest.warns(MbkitWarning, match="1 of 5 trajectories"):
        batch, alone = together_and_alone(mb.dynamics(model, "lagrangian"), q, v, "rk4", {"torque": rows})
    assert batch.stats.ended == alone[2].stats.ended == "diverged"
    assert batch.stats.reached[2] == alone[2].stats.reached < DURATION
    assert [batch.stats.reached[i] for i in (0, 1, 3, 4)] == [DURATION] * 4
    for i in (0, 1, 3, 4):
        assert off(batch.q[i], alone[i].q) < 1e-9
    good = len(alone[2].t)
    assert off(batch.q[2, :good], alone[2].q) < 1e-9
    assert np.isnan(batch.q[2, good:]).all()


def test_steps_of_a_batch_are_those_of_its_states() -> None:
    """In one call, with what ends its phase within the step, under wrenches and at a time of their own."""
    model = pushed_in_time(rubbed(8, 3, SINGLE))
    q, v, tau = mostly_at_rest(model, 12)
    v *= 0.01
    dyn = mb.dynamics(model, "lagrangian")
    wrenches = {model.bodies[-1].name: np.random.default_rng(2).uniform(-5, 5, (12, 6))}
    batch = dyn.step(q, v, tau, 1e-2, wrenches=wrenches, t=0.2)
    for i in range(12):
        own = {name: w[i] for name, w in wrenches.items()}
        for together, alone in zip(batch, dyn.step(q[i], v[i], tau[i], 1e-2, wrenches=own, t=0.2), strict=True):
            assert off(together[i], alone) < 1e-12


# Friction as a parameter


def with_free_friction(seed: int, n: int = 3) -> tuple[Model, dict[str, np.ndarray]]:
    """Return a model whose friction and stiction are parameters, two with a common one; and values of three samples."""
    b = mb.ModelBuilder.of(rubbed(seed, n, SINGLE))
    common, model, values = mb.Parameter("common", 1.0), b.build(), {}
    rng = np.random.default_rng(seed)
    for k, joint in enumerate(model.joints):
        own = mb.Parameter(f"f{k}", float(joint.friction[0])) if k else common
        curve = None if k % 2 else 0.4
        b.set_joint(joint.name, friction=own, stiction=1.3 * own + 0.2 * common, stribeck_velocity=curve)
        values[own.name] = rng.uniform(0.2, 3, 3)
    return b.build(), values


@pytest.mark.thorough("rk853", "semi_implicit_euler", "rk4")
@pytest.mark.parametrize("method", ["rk4", "semi_implicit_euler", "gauss4", "moreau", "rk853"])
def test_samples_with_friction_of_their_own_are_models_with_these_numbers(method: str) -> None:
    model, values = with_free_friction(11)
    q, v, tau = mostly_at_rest(model, 3)
    settings = {"dt": STEP} if method != "rk853" else {"save": np.linspace(0, DURATION, 5), "rtol": 1e-11}
    dyn = mb.dynamics(model, "lagrangian", compile=method == "rk4").at(**values)
    rows = tau[:, None] * np.ones((1, STEPS if "dt" in settings else 4, 1))
    batch = mb.simulate(dyn, q, v, DURATION, method, torque=rows, doubt=False, **settings)
    for i in range(3):
        numbers = {name: float(x[i]) for name, x in values.items()}
        plain = mb.dynamics(model.with_parameters(**numbers), "lagrangian")
        assert not plain.model.parameters
        run = mb.simulate(plain, q[i], v[i], DURATION, method, torque=rows[i], doubt=False, **settings)
        assert off(batch.q[i], run.q) < 1e-8
        assert [e.name for e in batch.events if e.member == i] == [e.name for e in run.events]
        states = batch.q[i, -1], batch.v[i, -1], tau[i]
        assert off(dyn._of_sample(i).forward_dynamics(*states), plain.forward_dynamics(*states)) < 1e-9
    assert method == "moreau" or batch.events
    accelerations = dyn.forward_dynamics(q, v, tau)
    stepped = dyn.step(q, v, tau, STEP)
    for i in range(3):
        plain = mb.dynamics(model.with_parameters(**{name: float(x[i]) for name, x in values.items()}), "pinocchio")
        assert off(accelerations[i], plain.forward_dynamics(q[i], v[i], tau[i])) < 1e-9
        assert off(stepped[0][i], plain.step(q[i], v[i], tau[i], STEP)[0]) < 1e-9


def test_friction_is_freed_and_varied_like_other_numbers() -> None:
    """And zero, below which stiction cannot fall, and a number that comes later."""
    model = rubbed(12, 2, SINGLE)
    joint = model.joints[0].name
    free = model.with_free(f"{joint}.friction")
    assert dict(free.parameters) == {f"{joint}.friction": float(model.joints[0].friction[0])}
    assert free.with_parameters(**dict(free.parameters)) == model
    with pytest.raises(ModelError, match=r"stiction .* is below the friction of motion"):
        mb.dynamics(free).at(**{f"{joint}.friction": 99.0})
    b = mb.ModelBuilder.of(model)
    b.set_joint(joint, friction=mb.Parameter("f"), stiction=None)
    later = mb.dynamics(b.build(), "lagrangian")
    with pytest.raises(InputError, match="no value for parameter 'f'"):
        later.forward_dynamics(*(x[0] for x in mostly_at_rest(model, 1)))
    q, v, _ = mostly_at_rest(model, 3)
    b.set_joint(joint, friction=0.0)
    bare = mb.dynamics(b.build(), "lagrangian")
    runs = [mb.simulate(x, q, v, 0.1, dt=STEP, doubt=False).q for x in (later.at(f=np.zeros(3)), bare)]
    assert off(*runs) < 1e-12


@pytest.mark.parametrize("method", ["moreau", "rk4"])
@pytest.mark.parametrize("compiled", [True, False])
def test_what_rests_lets_go_where_a_wrench_passes_its_bound(method: str, compiled: bool) -> None:
    """2 kg under 2 N and then 3.5 N against a friction of 3 N: v = 0.25 m/s² (t - 0.1 s)."""
    b = mounted("block", "m", "x", "prismatic", gravity=(0, 0, 0), mass=2.0, axis=(1, 0, 0), friction=3.0)
    dyn = mb.dynamics(b.build(), "lagrangian", compile=compiled)
    wrench = np.zeros((2, 20, 6))
    wrench[:, :10, 0], wrench[:, 10:, 0] = 2.0, [[3.5], [-2.9]]
    for q, w in ((np.zeros((2, 1)), wrench), (np.zeros(1), wrench[0])):
        run = mb.simulate(dyn, q, 0 * q, 0.2, method, dt=0.01, wrenches={"m": w}, doubt=False)
        v = run.v.reshape(-1, 21)
        assert v[0] == pytest.approx(0.25 * np.maximum(np.arange(21) * 0.01 - 0.1, 0), abs=1e-12)
        assert not v[0, :11].any()
        assert not v[1:].any()


def test_variants_of_friction_slide_as_in_the_closed_form() -> None:
    """x = v t - f t²/2m of blocks that do not stop, each with a friction of its own."""
    b = mounted("slid", "block", "x", "prismatic", mass=1.0, axis=(1, 0, 0), friction=1.0)
    many = mb.variants(b.build(point_masses=True), {"x.friction": 0.2}, size=5, seed=1)
    run = mb.simulate(many.dynamics("lagrangian"), np.zeros((5, 1)), np.full((5, 1), 3.0), 1.0, dt=0.01)
    drawn = np.array(many.values["x.friction"])
    assert np.ptp(drawn) > 0.1
    np.testing.assert_allclose(run.q[:, -1, 0], 3.0 - drawn / 2, rtol=0, atol=1e-13)


@pytest.mark.thorough("rk853-True-1e-08", "rk4-False-1e-06")
@pytest.mark.parametrize(("method", "compiled", "most"), [
    ("rk853", False, 1e-8), ("rk853", True, 1e-8), ("rk4", False, 1e-6), ("rk4", True, 1e-6), ("moreau", True, 2e-2),
])  # fmt: skip
def test_a_joint_whose_friction_is_zero_in_a_member_has_no_phases_there(
    method: str, compiled: bool, most: float
) -> None:
    """A pendulum with a parameter as friction by SciPy's integrator, a block that slides 0.412 s, and one at rest."""
    place = {"axis": (0, 0, 1), "friction": mb.Parameter("f", 1.0)}
    b = mounted(
        "beside",
        "a",
        "a",
        "continuous",
        gravity=(0, -9.81, 0),
        mass=1.0,
        com=(0.5, 0, 0),
        inertia=0.1 * np.ones(3),
        **place,
    )
    for name in "xy":
        b.add_body(name, mass=2.0)
        b.add_joint(name, "prismatic", parent="world", child=name, axis=(1, 0, 0), friction=3.0)
    dyn = mb.dynamics(b.build(), "lagrangian", compile=compiled)

    def swung(t: float, f: float) -> np.ndarray:
        """Return the pendulum's state before it turns."""
        tight: Any = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}
        run = solve_ivp(lambda _, y: [y[1], (f - 9.81 / 2 * np.cos(y[0])) / 0.35], (0, t), [0.3, 0.0], **tight)
        return np.asarray(run.y[:, -1])

    # Without friction it swings from 0.3 to -π - 0.3 and back.
    period = 2 * brentq(lambda t: swung(t, 0.0)[1], 0.6, 1.6, xtol=1e-13)
    more = {"dt": 5e-3} if method in ("rk4", "moreau") else {"save": np.array([0.0, 0.5, period])}
    q, v = np.tile([0.3, 0.0, 0.0], (3, 1)), np.tile([0.0, 0.618, 0.0], (3, 1))
    run = mb.simulate(dyn.at(f=np.array([0.0, 0.8, 0.0])), q, v, period, method, doubt=False, **more)
    after = np.array([run.q[i, np.argmin(np.abs(run.t - 0.5)), 0] for i in range(3)])
    assert after == pytest.approx([swung(0.5, f)[0] for f in (0.0, 0.8, 0.0)], abs=most)
    alone = mb.simulate(dyn.at(f=0.0), q[0], v[0], period, method, doubt=False, **more)
    for end in (run.q[0, -1], run.q[2, -1], alone.q[-1]):
        assert end == pytest.approx([0.3, 0.618**2 / 3, 0.0], abs=most)
    for events in (alone.events, *([e for e in run.events if e.member == i] for i in (0, 2))):
        # Moreau's step has no events.
        assert [e.name for e in events] == ["x stops"] * (method != "moreau")
        assert [e.t for e in events] == pytest.approx([0.412] * len(events), abs=most)


def test_the_least_of_two_margins_that_end_together_is_found_in_few_rounds() -> None:
    slopes, bends = np.array([[1.0, 3.0], [2.0, 0.5]]), np.array([[0.3, -1.0], [0.2, 4.0]])
    # Both fall through zero at nearly one place, where the least of them has a kink.
    roots = np.array([[0.4, 0.4 + 1e-9], [0.7, 0.3]])
    rounds = []

    def margins(x: Any, rows: Any) -> Any:
        rounds.append(len(x))
        d = roots[rows] - x[:, None]
        return (slopes[rows] * d + bends[rows] * d**3) / EPS

    both = np.arange(2)
    found = first_zero(margins, margins(np.zeros(2), both), margins(np.ones(2), both))
    assert np.abs(found - roots.min(axis=1)).max() < 4 * EPS
    assert len(rounds) < 13


@pytest.mark.parametrize("engine", ["lagrangian", "mujoco"])
def test_what_stands_for_ever_is_that_of_steps_that_hold_it(engine: str) -> None:
    b = mb.ModelBuilder.of(mb.catalog.double_pendulum())
    for joint in b.build().joints:
        b.set_joint(joint.name, friction=30.0)
    dyn, q, v = mb.dynamics(b.build(), engine), np.array([[0.3, -0.2], [1.0, 0.5]]), np.zeros(2)
    push = np.array([1.0, -2.0])
    table = push * np.linspace(0.5, 1.0, STEPS)[:, None]
    ways = push, table, lambda *_: push
    held, rows, stepped = (mb.simulate(dyn, q, v, DURATION, dt=STEP, torque=x) for x in ways)
    for run in (held, rows):
        assert (run.q == stepped.q).all()
        assert (run.q == q[:, None]).all()
        assert not run.v.any()
        assert run.stats.steps == stepped.stats.steps
        assert run.stats.evaluations == 0 < stepped.stats.evaluations
    # The row that passes what holds lets go at its beginning, in one run and in a batch.
    table[20:] *= 50
    for run in (
        mb.simulate(dyn, q, v, DURATION, dt=STEP, torque=table),
        mb.simulate(dyn, q[0], v, DURATION, dt=STEP, torque=table),
    ):
        assert {e.t for e in run.events if e.name.endswith("lets go")} == {20 * STEP}
        assert not run.v[..., :21, :].any()
        assert run.v[..., 21, :].any(axis=-1).all()
    loose = mb.simulate(dyn, q, v, DURATION, dt=STEP, torque=50 * push)
    assert abs(loose.v[:, 1]).min() > 0


def test_few_blocks_are_set_up_and_few_steps_behind_ends_are_in_vain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks become as long as changes are rare: half swings of 0.63 s come to rest after 1 to 12 of them.

    All swing together, so that phases end in every other block or so.
    """
    b = mb.ModelBuilder("swings", gravity=(0, 0, 0))
    b.add_body("m", mass=2.0)
    b.add_joint("x", "prismatic", parent="world", child="m", axis=(1, 0, 0), friction=1.0, stiffness=50.0)
    count, steps, blocks, one = 200, 3000, list[int](), fixed._Members._block
    monkeypatch.setattr(fixed._Members, "_block", lambda run: blocks.append(1) or one(run))
    q = np.linspace(0.1, 1.0, count)[:, None]
    run = mb.simulate(mb.dynamics(b.build(), "lagrangian", compile=True), q, 0 * q, 6.0, "rk4", dt=6.0 / steps)
    # Each half swing is 2 f / k shorter.
    swings = [int(np.ceil(x / 0.04 - 0.5)) for x in q[:, 0]]
    assert len(run.events) == sum(min(n, 9) for n in swings)
    assert len(blocks) <= 20
    assert run.stats.steps < 1.3 * count * steps
    # Most never stop, and are at the end before the few that did.
    b.set_joint("x", stiffness=0.0)
    v = np.concatenate([np.linspace(0.1, 2.9, 20), np.full(count - 20, 100.0)])[:, None]
    run = mb.simulate(mb.dynamics(b.build(), "lagrangian", compile=True), q, v, 6.0, "rk4", dt=6.0 / steps)
    assert len(run.events) == 20
    assert run.stats.steps < 1.02 * count * steps
