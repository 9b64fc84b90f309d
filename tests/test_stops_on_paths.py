"""Joint stops on paths of their own numbers: impacts, soft loops, files, studies and a GPU beside them."""

from __future__ import annotations

import numpy as np
import pytest

import mbkit as mb
from mbkit.errors import UnsupportedError
from mbkit.studies.compare.terms import states
from mbkit.studies.explain import Motion
from tests.fake_cuda import fake_gpu
from tests.kind_examples import LIMBS, Arm, Site, example


def pendulum(**numbers) -> mb.Model:
    b = mb.ModelBuilder("pendulum", gravity=(0, 0, -9.81))
    b.add_body("bob", mass=2.0, com=(0, 0, -0.5), inertia=(0.1, 0.1, 0.1))
    b.add_joint("pivot", "revolute", parent="world", child="bob", axis=(0, 1, 0), **numbers)
    return b.build()


def closed(**numbers) -> tuple[mb.Model, np.ndarray, np.ndarray]:
    """Return a loop whose first joint has these numbers, a configuration of it, and a force."""
    a = Arm("loop")
    LIMBS["loop.point"](a, Site(body="world"))
    x = a.built()
    b = mb.ModelBuilder.of(x.model)
    b.set_joint("j0", **(numbers or {"lower": x.q[0], "stops": True}))
    return b.build(), x.q, x.tau


def test_an_impulse_that_leads_through_a_stop_is_refused_without_its_row() -> None:
    model = pendulum(upper=0.3, stops=True)
    dyn = mb.dynamics(model, "pinocchio")
    with pytest.raises(UnsupportedError, match="pivot would go through its stop"):
        mb.impact(dyn, [0.3], [0.0], [0.5])
    assert mb.impact(dyn, [0.3], [0.0], [0.5], jacobian=[1.0]).impulses == pytest.approx([-0.5])
    # Away from it, and inwards.
    for q, impulse in ((0.2, 0.5), (0.3, -0.5)):
        assert mb.impact(dyn, [q], [0.0], [impulse]).v == pytest.approx([impulse / (0.1 + 2 * 0.25)])


@pytest.mark.parametrize("numbers", [{}, {"friction": 0.5}])
@pytest.mark.parametrize("sign", [1, -1])
def test_what_rests_beside_soft_loops_does_so_in_their_rigid_law(numbers: dict, sign: int) -> None:
    model, q, tau = closed(**numbers)
    v = np.zeros(model.nv)
    exact = mb.dynamics(model).forward_dynamics(q, v, sign * tau)
    rigid = mb.dynamics(model, "mujoco").constraint_law(q, v, sign * tau).rigid
    assert np.abs(rigid - exact).max() < 1e-13
    # One of both signs moves between stops.
    assert (np.abs(exact).max() > 0.1) == (not numbers and sign == 1)


def test_loads_between_loops_are_refused_at_rest_on_a_stop_alone() -> None:
    model, q, tau = closed()
    dyn = mb.dynamics(model)
    with pytest.raises(UnsupportedError, match="joint stops at rest"):
        dyn.loop_wrenches(q, np.zeros(model.nv), tau)
    q, v = dyn.project(q, np.ones(model.nv))
    plain = mb.dynamics(model.without("stops"))
    assert np.array_equal(dyn.loop_wrenches(q, v, tau), plain.loop_wrenches(q, v, tau))


@pytest.mark.parametrize("to", ["urdf", "mjcf"])
def test_stops_of_a_file_come_back_where_they_are_asked_for(to: str, tmp_path) -> None:
    made = mb.convert(pendulum(lower=-0.2, upper=0.3, stops=True), to)
    assert any("load the file with stops=True" in str(n) for n in made.notes)
    path = made.write(tmp_path / f"p.{'urdf' if to == 'urdf' else 'xml'}")
    assert not mb.load(path).needs.stops
    back = mb.load(path, stops=True)
    assert mb.dynamics(back).forward_dynamics([0.3], [0.0], [9.0]) == 0.0


def test_stops_without_restitution_are_no_limits_that_are_data() -> None:
    """Newton's e of 0 is a number; none lets a velocity pass."""
    one, other = pendulum(upper=0.3, stops=True), pendulum(upper=0.3)
    for a, b, says in ((one, other, "has no stops"), (other, one, "has stops")):
        (cause,) = mb.explain(a, b, samples=1).causes
        assert (cause.kind, cause.says.partition("second ")[2]) == ("stops", says)
    closer = mb.explain(one, pendulum(upper=0.1, stops=True), samples=1)
    assert [c.kind for c in closer.causes] == ["limits"]
    assert dict(closer.causes[0].effects)["joint stops"] == pytest.approx(0.2)
    assert mb.explain(other, pendulum(upper=0.1), samples=1).agree


def test_motions_of_causes_keep_stops_though_mujoco_is_asked() -> None:
    motion = Motion(controller="passive", q=[0.29], v=[1.0], times=(0.2,))
    out = mb.explain(pendulum(upper=0.3, stops=True), pendulum(upper=0.3), samples=1, motion=motion).motion
    run = [
        mb.simulate(mb.dynamics(pendulum(upper=0.3, stops=x)), [0.29], [1.0], 0.2, "rk853", save=[0.2]).q[-1, 0]
        for x in (True, False)
    ]
    assert out.whole[0] == pytest.approx(abs(run[0] - run[1]), rel=1e-6)


def test_comparisons_have_states_at_rest_on_stops_and_say_what_runs_leave_out() -> None:
    model = pendulum(lower=-0.2, upper=0.3, stops=True)
    at = states(model, 16, 0)
    rests = [k for k, kind in enumerate(at.kinds) if kind == "at rest"]
    assert not at.v[rests].any()
    assert {*at.q[rests, 0]} == {-0.2, 0.3}
    out = mb.work_precision(model, ["lagrangian"], ["rk4"], duration=0.1, steps=[0.01], repeats=1)
    assert out.facts["notes"] == ["without joint stops"]


def test_runs_on_a_gpu_take_stops_as_those_of_the_cpu() -> None:
    x = example("joint.stop")
    q, v = (
        x.q + np.array([[0.0], [0.001], [0.002]]) * [0, 0, 0, 1],
        x.v - np.array([[0.0], [0.1], [0.2]]) * [0, 0, 0, 1],
    )
    given = q, v, 0.02, "rk4", 1e-3
    cpu = mb.simulate(mb.dynamics(x.model, "lagrangian", compile=True), *given, torque=x.tau)
    with fake_gpu():
        gpu = mb.simulate(mb.dynamics(x.model, "lagrangian", compile=True, device="cuda"), *given, torque=x.tau)
    assert [h.name for h in gpu.events] == [h.name for h in cpu.events]
    assert len(cpu.events) >= 2
    assert np.abs(gpu.q - cpu.q).max() < 1e-14
