"""Joint limits of MuJoCo and Drake: their own soft ones in their own steps, and how far they are from rigid stops."""

from __future__ import annotations

import pickle
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import mbkit as mb
from mbkit.engines.mujoco.constraints import Softness
from mbkit.engines.mujoco.engine import INTEGRATORS, MujocoDynamics
from mbkit.engines.mujoco.simulation import OwnSimulation
from mbkit.errors import DoubtfulRunWarning, InputError, UnknownNameError, UnsupportedError
from mbkit.studies.explain.worlds import file_settings

SLIDER = """<mujoco><option timestep="0.001" integrator="{integrator}" tolerance="0">
  <flag warmstart="disable" eulerdamp="disable"/></option>
  <worldbody><body name="block"><inertial pos="0 0 0" mass="2" diaginertia="1 1 1"/>
    <joint name="x" type="slide" axis="0 0 1" limited="true" range="-0.5 0.4" {softness}/></body>
  </worldbody></mujoco>"""
SOFTNESS: dict[str, tuple[dict[str, Any], str]] = {
    "default": ({}, ""),
    "shorter": ({"limit_solref": (0.01, 1.0)}, 'solreflimit="0.01 1"'),
    "direct": ({"limits": {"x": Softness((-3000.0, -40.0))}}, 'solreflimit="-3000 -40"'),
    "harder": ({"limits": {"x": Softness(solimp=(0.99, 0.999, 1e-3, 0.5, 2))}}, 'solimplimit="0.99 0.999 0.001 0.5 2"'),
}


def slider(**numbers: Any) -> mb.Model:
    """A block that falls 0.5 m onto the lower limit of its slide."""
    b = mb.ModelBuilder("slider")
    b.add_body("block", mass=2.0, inertia=(1.0, 1.0, 1.0))
    axis = (0.0, 0.0, 1.0)
    b.add_joint("x", "prismatic", parent="world", child="block", axis=axis, lower=-0.5, upper=0.4, **numbers)
    return b.build()


def bare(text: str, steps: int = 600) -> np.ndarray:
    """q and v of a run of MuJoCo alone."""
    m = mujoco.MjModel.from_xml_string(text)
    d, rows = mujoco.MjData(m), []
    for _ in range(steps + 1):
        rows.append([d.qpos[0], d.qvel[0]])
        mujoco.mj_step(m, d)
    return np.array(rows)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("kind", SOFTNESS)
def test_soft_limits_are_those_of_mj_step_bit_for_bit(kind: str, integrator: str) -> None:
    options, softness = SOFTNESS[kind]
    names = {"euler": "Euler", "rk4": "RK4"}
    own = bare(SLIDER.format(integrator=names.get(integrator, integrator), softness=softness))
    dyn = mb.dynamics(slider(), "mujoco", **({"limits": "soft"} | options))
    assert own[:, 0].min() < -0.5
    for x in (dyn, pickle.loads(pickle.dumps(dyn)), dyn.at()):
        run = mb.simulate(x, [0.0], [0.0], 0.6, f"mujoco_{integrator}", 1e-3)
        assert np.array_equal(np.hstack([run.q, run.v]), own)


def test_accelerations_and_other_methods_have_the_soft_limits_too() -> None:
    dyn, far = mb.dynamics(slider(), "mujoco", limits="soft"), [-0.6]
    assert dyn.forward_dynamics([0.0], [0.0], [0.0]) == [-9.81]
    assert dyn.forward_dynamics(far, [0.0], [0.0]) > 100
    assert dyn.inverse_dynamics(far, [0.0], [0.0]) == [2 * 9.81]
    for own, ours in (("mujoco_rk4", "rk4"), ("mujoco_euler", "semi_implicit_euler")):
        a, b = (mb.simulate(dyn, [0.0], [0.0], 0.6, method, 1e-3) for method in (own, ours))
        assert np.abs(a.q - b.q).max() < 1e-12
        # What the limit takes is work, and no sign of a wrong run; quadrature goes across the force's jump at first
        # order, with a power of some 2 kW over a step of 1 ms.
        assert not a.stats.doubts
        assert np.abs(a.power_balance()).max() < 0.2 * abs(a.energy()[-1] - a.energy()[0])
    assert "joint limits" not in dyn.disabled
    assert "joint limits" in mb.dynamics(slider(), "mujoco").disabled


def test_half_of_the_time_constant_halves_the_penetration() -> None:
    """A critically damped stop is v t exp(-t/T) deep, at most v T/e, where T = 0.95 of the time constant.

    The impedance, 0.9 to 0.95, lets gravity and a tenth of the free motion through, so that the ratio is near two.
    """
    depths = []
    for constant in (0.02, 0.01, 0.005):
        dyn = mb.dynamics(slider(), "mujoco", limits="soft", limit_solref=(constant, 1.0))
        depths.append(-0.5 - mb.simulate(dyn, [0.0], [0.0], 0.6, "mujoco_rk4", 1e-4).q.min())
        assert 0.9 < depths[-1] / (np.sqrt(2 * 9.81 * 0.5) * 0.95 * constant / np.e) < 1.2
    assert np.allclose([depths[0] / depths[1], depths[1] / depths[2]], 2.0, atol=0.1)


def test_a_loop_beside_limits_keeps_its_written_law() -> None:
    model = mb.catalog.slider_crank()
    joints = [replace(j, lower=np.array([-0.1]), upper=np.array([0.1])) for j in model.joints[:1]]
    limited = replace(model, joints=(*joints, *model.joints[1:]))
    free, dyn = mb.dynamics(model, "mujoco"), mb.dynamics(limited, "mujoco", limits="soft")
    q, v = free.project([0.5, -0.2, -0.1], [1.0, 0.0, 0.0])
    tau = np.zeros(3)
    assert np.abs(free.constraint_law(q, v, tau).acceleration - dyn.constraint_law(q, v, tau).acceleration).max() < 1e-9
    assert np.abs(free.forward_dynamics(q, v, tau) - dyn.forward_dynamics(q, v, tau)).max() > 1.0
    with pytest.warns(DoubtfulRunWarning, match="two steps"):
        mb.simulate(dyn, q, v, 0.1, "mujoco_rk4", 0.05)


def test_drake_s_discrete_plant_has_its_own_nearly_rigid_limits() -> None:
    dyn = mb.dynamics(slider(), "drake", limits="soft")
    for x in (dyn, pickle.loads(pickle.dumps(dyn)), dyn.at()):
        run = mb.simulate(x, [0.0], [0.0], 0.6, "drake_sap", 1e-3)
        assert -1e-6 < run.q.min() + 0.5 < 1e-6
    assert mb.simulate(mb.dynamics(slider(), "drake"), [0.0], [0.0], 0.6, "drake_sap", 1e-3).q.min() < -1.5
    for method in ("rk4", "drake_runge_kutta3"):
        with pytest.raises(UnsupportedError, match="discrete plant alone; method='drake_sap' runs it"):
            mb.simulate(dyn, [0.0], [0.0], 0.1, method, save=[0.0, 0.1])


def test_what_soft_limits_do_not_go_with_is_refused_by_name() -> None:
    with pytest.raises(InputError, match="limits: expected 'soft' or None, got 'hard'"):
        mb.dynamics(slider(), "mujoco", limits="hard")
    with pytest.raises(InputError, match="limit_solref: is of soft limits"):
        mb.dynamics(slider(), "mujoco", limit_solref=(0.01, 1.0))
    with pytest.raises(UnknownNameError, match="joint with limits"):
        mb.dynamics(slider(), "mujoco", limits={"y": Softness()})
    with pytest.raises(InputError, match="two positive or two negative"):
        mb.dynamics(slider(), "mujoco", limits="soft", limit_solref=(0.01, -1.0))
    with pytest.raises(UnsupportedError, match="exact friction of slider; give soft_friction=True"):
        mb.dynamics(slider(friction=1.0), "mujoco", limits="soft")
    with pytest.raises(UnsupportedError, match="mimic joints"):
        mb.dynamics(mb.load("tiago_pro"), "mujoco", limits="soft", soft_friction=True)
    with pytest.raises(InputError, match="limits: pinocchio has no such option"):
        mb.dynamics(slider(), "pinocchio", limits="soft")
    both = mb.dynamics(slider(friction=1.0), "mujoco", limits="soft", soft_friction=True)
    assert mb.simulate(both, [0.0], [0.0], 0.6, "mujoco_rk4", 1e-3).q.min() < -0.5


def test_softness_of_a_file_s_limits_is_a_setting_of_its_runs(tmp_path: Path) -> None:
    path, text = tmp_path / "a.xml", SLIDER.format(integrator="RK4", softness='solreflimit="0.005 1"')
    path.write_text(text.replace(' tolerance="0"', "").replace('warmstart="disable"', ""))
    model = mb.load(path)
    held, left = file_settings(path, model)
    assert held is not None
    assert not left
    assert held.limit_softness == (("x", (0.005, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0)),)
    dyn = mb.dynamics(model, "mujoco", limits="soft")
    assert isinstance(dyn, MujocoDynamics)
    assert dyn.limit_softness == {"x": Softness((0.005, 1.0))}
    _, q, _ = OwnSimulation(model, held).run(np.zeros(1), np.zeros(1), None, 0.6)
    assert np.array_equal(q[:, 0], bare(path.read_text(), len(q) - 1)[:, 0])
    assert (
        np.abs(
            q.min()
            - OwnSimulation(model, replace(held, limit_softness=())).run(np.zeros(1), np.zeros(1), None, 0.6)[1].min()
        )
        > 1e-3
    )


def test_rigid_stops_give_way_to_soft_limits_and_are_refused_without_them() -> None:
    model = slider(stops=True, restitution=0.3)
    for engine, method in (("mujoco", "mujoco_rk4"), ("drake", "drake_sap")):
        with pytest.raises(
            UnsupportedError, match=rf"{method}: .*joint 'x' has stops.*limits='soft' of mujoco and drake"
        ):
            mb.simulate(mb.dynamics(model, engine), [0.0], [0.0], 0.1, method, 1e-3)
        soft, plain = (mb.dynamics(m, engine, limits="soft") for m in (model, slider()))
        assert not soft.model.needs.stops
        a, b = (mb.simulate(d, [0.0], [0.0], 0.6, method, 1e-3) for d in (soft, plain))
        assert np.array_equal(a.q, b.q)
    with pytest.raises(UnsupportedError, match="joint 'x' has stops"):
        mb.dynamics(model, "mujoco").rollout("rk4", [0.0], [0.0], 1e-3, None, 10)  # type: ignore[attr-defined]
    with pytest.raises(UnsupportedError, match="joint 'x' has stops"):
        mb.dynamics(model, "mujoco", soft_friction=True)


# The study


def test_a_soft_limit_beside_the_rigid_stop_as_closed_forms_have_it() -> None:
    """The block falls for √(2 h/g); a critically damped limit lets it go two time constants later."""
    found = mb.soft_stops(slider(), [0.0], dt=1e-4)
    usual, half = found.rows
    assert (usual.softness, half.softness) == ("solref (0.02, 1)", "solref (0.01, 1)")
    assert {r.limit for r in found.rows} == {"x lower"}
    fall = np.sqrt(2 * 0.5 / 9.81)
    for r in found.rows:
        # It is told where it is within 1e-6 m.
        assert np.allclose([r.arrives + 1e-6 / (9.81 * fall), r.arrives_rigid], fall, rtol=0, atol=2e-7)
        assert np.isclose(r.lost_rigid, 2 * 9.81 * 0.5, rtol=1e-9)
        assert np.isnan(r.leaves_rigid)
        assert r.turned == 0.0
        # What the block has lost in the end is its whole fall, down into the limit.
        assert 0 < r.lost - r.lost_rigid < 2 * 9.81 * r.penetration
        # It is farthest from the rigid one where it is deepest.
        assert np.isclose(r.moved, r.penetration, rtol=1e-6)
    assert np.isclose(usual.penetration / half.penetration, 2.0, atol=0.1)
    assert half.leaves > fall + 2 * 0.95 * 0.01
    assert found.verdict.startswith(
        "mujoco with solref (0.02, 1) passes x lower by 2.3e-02, and within 1.00 s is 0 rad"
    )


def test_a_result_goes_through_json_and_shows_its_sentence_first() -> None:
    found = mb.soft_stops(slider(), [0.0], duration=0.5)
    back = type(found).from_json(found.to_json())
    assert back.to_json() == found.to_json()
    assert back.rows[0].penetration == found.rows[0].penetration
    assert found.to_markdown().startswith("**slider**: mujoco with solref")
    assert found._repr_html_().startswith("<p><b>slider</b>: mujoco with solref")
    assert found.to_csv().count("\n") == 3


def test_a_block_that_rests_on_its_limit_sinks_into_the_soft_one() -> None:
    found = mb.soft_stops(slider(), [-0.5], duration=0.5)
    usual, half = found.rows
    assert usual.lost_rigid == 0.0
    # At rest the limit carries the weight by (A + R) m g = k d r + g, where A = 1/m and R = (1 - d) / d A.
    for row, constant in ((usual, 0.02), (half, 0.01)):
        law = Softness((constant, 1.0))
        dyn = mb.dynamics(slider(), "mujoco", limits={"x": law})
        r = -0.5 - float(mb.simulate(dyn, [-0.5], [0.0], 1.0, "mujoco_rk4", 1e-3).q[-1, 0])
        d = law.impedance(r)
        assert np.isclose(law.gains[0] * d * r, 9.81 * (1 - d) / d, rtol=1e-9)
        assert r < row.penetration < 1.01 * r
    assert np.isclose(usual.moved, usual.penetration, rtol=1e-9)
    with pytest.raises(InputError, match="q0, v0: expected one state"):
        mb.soft_stops(slider(), [[0.0], [0.1]])
    with pytest.raises(InputError, match="expected q0 beside it"):
        mb.soft_stops(slider(), v0=[1.0])


def test_a_start_is_found_whose_motion_reaches_a_limit() -> None:
    model = mb.catalog.double_pendulum()
    with pytest.raises(InputError, match="expected joints with limits, double_pendulum has none"):
        mb.soft_stops(model)
    limited = replace(
        model, joints=tuple(replace(j, lower=np.array([-1.0]), upper=np.array([1.2])) for j in model.joints)
    )
    found = mb.soft_stops(limited, duration=0.8)
    assert found.rows
    assert all(r.penetration > 0 and np.isclose(r.arrives, r.arrives_rigid, atol=0.05) for r in found.rows[:1])
    assert found.rows[0].turned > 0.0 == found.rows[0].moved
    assert mb.soft_stops(limited, [0.1, 0.0], duration=0.1).verdict == "no joint reaches a limit within 100 ms"
    drake = mb.soft_stops(limited, found.q0, found.v0, duration=0.8, engine="drake")
    assert drake.rows[0].penetration < 1e-3 * found.rows[0].penetration
    assert drake.rows[0].softness == "steps of 1.00 ms"
    with pytest.raises(InputError, match="pinocchio has no such option"):
        mb.soft_stops(limited, engine="pinocchio")
    stiff = replace(limited, joints=tuple(replace(j, damping=np.array([2e4])) for j in limited.joints))
    wrong = mb.soft_stops(stiff, [0.1, 0.0], [5.0, 0.0], duration=0.1)
    assert wrong.doubts
    assert wrong.verdict.startswith("in doubt: mujoco with solref")


@pytest.mark.filterwarnings("ignore::mbkit.errors.MbkitWarning")
def test_a_comparison_tells_what_limits_do_to_motions() -> None:
    model = mb.catalog.pendulum()
    limited = replace(
        model, joints=tuple(replace(j, lower=np.array([-0.5]), upper=np.array([0.4])) for j in model.joints)
    )
    (limits,) = (x for x in mb.compare(limited, samples=2).findings if x.kind == "limits")
    reached = re.fullmatch(
        r"off here in every engine: limits at 1 joint; (\d+) of 16 motions of 1 s from random states within them reach "
        r"one, theta first, after (\S+) s; rigid stops move that one by (\S+) rad or m",
        limits.says,
    )
    assert reached
    # By the same starts, step by step of a textbook's formula.
    q, v = limited.random_state(np.random.default_rng([0, 3]), size=16)
    dyn = mb.dynamics(model, "lagrangian")
    runs = [mb.simulate(dyn, *s, 1.0, save=np.linspace(0.0, 1.0, 1001)) for s in zip(q, v, strict=True)]
    beyond = [(x.q[:, 0] < -0.5) | (x.q[:, 0] > 0.4) for x in runs]
    assert int(reached[1]) == sum(x.any() for x in beyond) > 0
    assert np.isclose(
        float(reached[2]), min(x.t[np.argmax(b)] for x, b in zip(runs, beyond, strict=True) if b.any()), rtol=0.05
    )
    assert 0.01 < float(reached[3]) < 10
    (bare,) = (x for x in mb.compare(limited, samples=2, terms_only=True).findings if x.kind == "limits")
    assert bare.says == "off here in every engine: limits at 1 joint"


def test_coordinates_of_one_joint_arrive_each_at_its_own_stop() -> None:
    b = mb.ModelBuilder("plate", gravity=(0.0, -9.81, 0.0))
    b.add_body("plate", mass=2.0, inertia=(1.0, 1.0, 1.0))
    b.add_joint("p", "planar", parent="world", child="plate", lower=[-np.inf, -0.3, -1.0], upper=[0.4, 0.6, 1.2])
    for engine, late in (("mujoco", 1e-4), ("drake", 0.03)):
        found = mb.soft_stops(b.build(), [0.0, 0.2, 0.1], [2.0, 0.0, 0.5], engine=engine, duration=0.4)
        x, y = found.rows[:2]
        assert (x.limit, y.limit) == ("p.x upper", "p.y lower")
        assert np.allclose([x.arrives_rigid, y.arrives_rigid], [0.2, np.sqrt(2 * 0.5 / 9.81)], rtol=0, atol=1e-9)
        assert np.allclose([x.arrives, y.arrives], [x.arrives_rigid, y.arrives_rigid], rtol=0, atol=late)
        # ½ m vₓ² and m g h, at two stops without restitution.
        assert np.isclose(x.lost_rigid, 4.0 + 2 * 9.81 * 0.5, rtol=1e-9)
        assert x.turned < 1e-12 < x.moved


@pytest.mark.filterwarnings("ignore::mbkit.errors.MbkitWarning")
def test_motions_of_a_mechanism_begin_within_its_limits() -> None:
    model = mb.catalog.four_bar()
    joints = [replace(model.joints[0], lower=np.array([-0.7]), upper=np.array([0.9])), *model.joints[1:]]
    found = mb.soft_stops(replace(model, joints=tuple(joints)), duration=0.3)
    assert -0.7 < found.q0[0] < 0.9
    assert {r.limit for r in found.rows} <= {"theta lower", "theta upper"} != set()
    assert abs(found.rows[0].arrives - found.rows[0].arrives_rigid) < 2e-3
    crank = mb.catalog.slider_crank()
    far = [*crank.joints[:-1], replace(crank.joints[-1], lower=np.array([50.0]), upper=np.array([51.0]))]
    with pytest.raises(InputError, match="no random state of slider_crank is within its limits"):
        mb.soft_stops(replace(crank, joints=tuple(far)))
