"""Work and power balance of runs: with every part that acts in it, against closed forms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest

import mbkit as mb
from mbkit.lagrangian import systems
from mbkit.model import Model
from mbkit.simulate import Trajectory, simulate
from tests.scenes import mounted


def block(mass: float = 2.0, **joint: Any) -> mb.ModelBuilder:
    return mounted("block", "m", "x", "prismatic", gravity=(0, 0, 0), mass=mass, axis=(1, 0, 0), **joint)


def rubbing(**joint: Any) -> Model:
    return block(friction=3.0, **joint).build(point_masses=True)


@pytest.mark.thorough("save1")
@pytest.mark.parametrize("save", [None, [0.0, 0.7, 1.5]])
def test_the_way_back_and_forth_counts_between_saved_states_too(save: Any) -> None:
    """From turn to turn the swing on a spring shrinks by 2 f/k, until the spring cannot pull the block."""
    k, start = 100.0, np.array([0.2, -0.14])
    run = simulate(mb.dynamics(rubbing(stiffness=k)), start[:, None], [[0.0], [0.0]], 1.5, "rk4", 2e-3, save=save)
    assert not run.v[:, -1].any()
    # To 0.02, which is below 3/100.
    np.testing.assert_allclose(run.work()[:, -1], -k / 2 * (start**2 - 0.02**2), atol=1e-8)
    assert np.abs(run.power_balance()).max() < 1e-8


@pytest.mark.parametrize("batch", [False, True])
def test_nothing_does_work_on_what_rests_before_it_lets_go(batch: bool) -> None:
    """A ramp of 3 N/s lets go at 5/3 s; from there on the torque gives the kinetic energy and what friction takes."""
    dyn = mb.dynamics(block(friction=3.0, stiction=5.0).build(), "lagrangian")
    start = np.zeros((2, 1) if batch else 1)
    # Times that are not even, with that of the change among them.
    save = {"save": np.array([0.0, 0.1, 0.2, 1.2, 5 / 3, 5 / 3 + 1e-4, 1.8, 1.9, 2.0])} if batch else {}
    run = mb.simulate(dyn, start, start, 2.0, "rk853", torque=lambda t, q, v: np.array([3 * t]), **save)  # noqa: ARG005
    go, work = 5 / 3, run.work()
    assert np.all(work[..., run.t < go + 1e-9] == pytest.approx(0.0, abs=1e-13))
    speed = (1.5 * (4 - go**2) - 3 * (2 - go)) / 2
    assert work[..., -1] == pytest.approx(speed**2, abs=1e-9 if batch else 1e-12)


def conveyed(engine: str, h: float) -> Trajectory:
    b = mb.ModelBuilder("skate", gravity=(0, 0, 0))
    b.add_body("skate", mass=1.0, inertia=(0.1, 0.1, 0.1))
    b.add_joint("glide", "planar", parent="world", child="skate")
    b.add_blade("edge", body_a="skate", axis_a=(0, 1, 0), speed=0.3)
    dyn = mb.dynamics(b.build(), engine)
    pushed = np.repeat(np.cos(np.arange(150.0)).reshape(-1, 3), round(0.02 / h), axis=0)
    return simulate(dyn, *dyn.project([0, 0, 0.2], [1.0, 0.2, 0.5]), 1.0, dt=h, torque=pushed)


def soft_loop(h: float) -> Trajectory:
    model = mb.catalog.four_bar()
    q, v = mb.dynamics(model, "lagrangian").project([0.5, 0, 1.0], [1.0, 0, 0])
    return simulate(mb.dynamics(model, "mujoco"), q, v, 0.2, dt=h / 10)


def soft_friction(h: float) -> Trajectory:
    dyn = mb.dynamics(rubbing(damping=0.2), "mujoco", soft_friction=True)
    return simulate(dyn, [0.0], [3.0], 0.06, dt=h / 10, torque=[1.0])


def prescribed(torque: Any, h: float) -> Trajectory:
    b = block(1.0)
    b.prescribe("x", amplitude=0.5, frequency=3.0)
    dyn = mb.dynamics(b.build(point_masses=True), "lagrangian")
    return simulate(dyn, [0.0], [1.5], 2.0, dt=h, torque=torque)


def floating(h: float) -> Trajectory:
    """A floating body on a bushing, with a link that rubs, dampers, gravity compensation and a force of t."""
    b = mb.ModelBuilder("floating")
    b.add_body("base", mass=1.0, com=(0.1, 0, 0), inertia=(0.15, 0.16, 0.17))
    b.add_body("link", mass=1.0, com=(0.2, 0, 0), inertia=(0.1, 0.1, 0.1))
    b.add_joint("free", "free", parent="world", child="base")
    more = {"translation": (0.3, 0, 0), "axis": (0, 1, 0)}
    b.add_joint("hinge", "revolute", parent="base", child="link", friction=0.1, damping=0.1, **more)
    b.add_bushing("mount", body_a="world", body_b="base", stiffness=[50.0] * 6, damping=[1.0] * 6)
    b.add_spring("strut", body_a="world", body_b="link", point_a=(0, 0, 2), stiffness=5.0, rest_length=1, damping=0.3)
    b.add_gravity_compensation("link", 0.5, without=["hinge"])
    b.add_force("gust", "link", force=ca.vertcat(ca.cos(3 * ca.SX.sym("t")), 0, 1))
    model = b.build()
    v = np.array([0.3, 0.2, 0.1, -0.2, 0.3, 0.1, 4.0])
    wrench = {"link": [0.5, 0.1, 0.2, 0, 0.1, 0]}
    run = simulate(mb.dynamics(model, "lagrangian"), model.neutral(), v, 0.3, dt=h, torque=[0.2] * 7, wrenches=wrench)
    assert (run.v[:, -1] > 0).all()
    return run


def written(system: Callable[[], Any], h: float) -> Trajectory:
    return simulate(system().dynamics(), [1.0], [0.5], 0.5, dt=h / 10)


@pytest.mark.thorough("<lambda>1", "<lambda>3", "<lambda>6")
@pytest.mark.parametrize(
    "run",
    [
        *(lambda h, e=engine: conveyed(e, h) for engine in ("lagrangian", "pinocchio")),
        *(lambda h, x=torque: prescribed(x, h) for torque in (None, [0.7], lambda t, q, v: [np.cos(2 * t)])),  # noqa: ARG005
        soft_loop,
        soft_friction,
        floating,
        lambda h: written(systems.bead_on_hoop, h),
        lambda h: written(systems.driven_pendulum, h),
    ],
)
def test_whatever_acts_is_in_the_balance(run: Callable[[float], Trajectory]) -> None:
    """What is left falls with the fourth power of the distance of the states."""
    coarse, fine = run(0.02), run(0.01)
    left = [np.abs(x.power_balance()).max() for x in (coarse, fine)]
    size = np.abs(fine.work()).max()
    assert size > 1e-3
    assert left[1] < 1e-4 * size
    assert left[1] < left[0] / 8 or left[1] < 1e-9 * size


def test_the_drive_of_a_prescribed_motion_does_the_work() -> None:
    run = prescribed(None, 2e-3)
    np.testing.assert_allclose(run.work(), 0.5 * 1.5**2 * (np.cos(3 * run.t) ** 2 - 1), atol=1e-9)
    with pytest.raises(mb.errors.UnsupportedError, match="holds one time; evaluate along a run with the lagrangian"):
        run.work("pinocchio")


def test_the_drive_of_a_table_works_from_its_first_time_to_its_last() -> None:
    """Nothing is known of a table beyond its ends, where rates are those of one side."""
    b, t = block(), np.linspace(0, 2, 41)
    b.prescribe("x", (t, 0.3 * np.sin(2 * t)))
    dyn = mb.dynamics(b.build(point_masses=True), "lagrangian")
    q, v = dyn.at(**{str(dyn.model.time_parameter): 0.0}).project([0.0], [0.6])
    run = simulate(dyn, q, v, 2.0, dt=1e-3)
    assert run.work()[-1] == pytest.approx(run.v[-1, 0] ** 2 - run.v[0, 0] ** 2, abs=3e-6)
    # At the knots of a cubic spline the power has another rate on each side.
    assert np.abs(run.power_balance()).max() < 3e-6


def test_a_hoop_that_turns_does_work_on_its_bead() -> None:
    """T2 - T0 + V stays, so that T + V changes by 2 T0 = m R² Ω² sin² θ."""
    run = written(systems.bead_on_hoop, 0.02)
    np.testing.assert_allclose(run.work(), 16.0 * (np.sin(run.q[:, 0]) ** 2 - np.sin(1.0) ** 2), atol=1e-8)
    assert run.check()


def test_joints_that_mimic_and_stribeck_s_curve_take_their_part() -> None:
    """A block that stops has lost what it had, and so has a pair of which one mimics the other."""
    pair = block(1.0, stiction=3.5, friction=3.0, stribeck_velocity=0.1)
    pair.add_body("other", mass=1.0)
    more = {"axis": (0, 1, 0), "mimic": ("x", -2.0, 0.0), "friction": 0.5}
    pair.add_joint("y", "prismatic", parent="world", child="other", **more)
    for model, energy in (
        (rubbing(stiction=3.5, stribeck_velocity=0.1), 0.25),
        (pair.build(point_masses=True), 0.625),
    ):
        run = simulate(mb.dynamics(model), [0.0], [0.5], 1.0, "rk4", 1e-3)
        assert run.v[-1] == 0.0
        assert run.work()[-1] == pytest.approx(-energy, abs=1e-8)


# A controller that samples, beside wrenches


def sampled_law(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:  # noqa: ARG001
    return -4.0 * q - v


def stepped(start: np.ndarray, wrench: np.ndarray, h: float, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States of 2 kg after each step under a force that is held, and the work of the controller and of the wrench."""
    states, work = [start], [0.0]
    for k in range(len(wrench)):
        x, v = states[-1]
        if k % steps == 0:
            tau = -4.0 * x - v
        force = tau + wrench[k]
        states.append(np.array([x + v * h + force / 4 * h**2, v + force / 2 * h]))
        work.append(work[-1] + force * (states[-1][0] - x))
    return (*np.array(states).T, np.array(work))  # type: ignore[return-value]


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio"])
@pytest.mark.parametrize("table", ["constant", "table", "short"])
def test_wrenches_beside_a_sampled_controller(engine: str, table: str) -> None:
    """A table of wrenches counts from the start of the run, over samples of four steps."""
    h, steps, n = 0.05, 4, {"constant": 20, "table": 20, "short": 18}[table]
    w = np.zeros((n, 6))
    w[:, 0] = 1.5 if table == "constant" else np.cos(np.arange(n))
    dyn = mb.dynamics(block().build(point_masses=True), engine)
    given = {"m": w[0] if table == "constant" else w}
    run = simulate(dyn, [0.3], [0.2], n * h, dt=h, torque=sampled_law, hold=steps * h, wrenches=given)
    q, v, work = stepped(np.array([0.3, 0.2]), w[:, 0], h, steps)
    np.testing.assert_allclose(np.column_stack([run.q, run.v]), np.column_stack([q, v]), atol=1e-13)
    np.testing.assert_array_equal(run.wrenches()["m"], np.vstack([w, w[-1:]]))
    np.testing.assert_allclose(run.work(), work, atol=1e-13)
    assert np.abs(run.power_balance()).max() < 1e-13
    with pytest.raises(mb.errors.InputError, match=rf"wrench on 'm': expected shape .*\({n}, 6\), got \(3, 6\)"):
        simulate(dyn, [0.3], [0.2], n * h, dt=h, torque=sampled_law, hold=steps * h, wrenches={"m": w[:3]})


@pytest.mark.parametrize("each", [False, True])
def test_batches_have_the_wrenches_of_their_trajectories(each: bool) -> None:
    h, n = 0.05, 20
    w = np.zeros((2, n, 6))
    w[..., 0] = np.array([[1.0], [-2.0]]) if each else np.cos(np.arange(2 * n)).reshape(2, n)
    dyn = mb.dynamics(block().build(point_masses=True))
    start = np.array([[0.3, 0.2], [-0.1, 0.5]])
    given = {"m": w[:, 0] if each else w}
    run = simulate(dyn, start[:, :1], start[:, 1:], n * h, dt=h, torque=sampled_law, hold=4 * h, wrenches=given)
    assert run.wrenches()["m"].shape == (2, n + 1, 6)
    for i in range(2):
        q, _, work = stepped(start[i], w[i, :, 0], h, 4)
        np.testing.assert_allclose(run.q[i, :, 0], q, atol=1e-13)
        np.testing.assert_array_equal(run.wrenches()["m"][i, :-1], w[i])
        np.testing.assert_allclose(run.work()[i], work, atol=1e-13)
    assert np.abs(run.power_balance()).max() < 1e-13


@pytest.mark.parametrize("batch", [False, True])
def test_adaptive_methods_take_a_table_over_the_saved_times(batch: bool) -> None:
    """The times of `save` and of the samples are other ones."""
    dyn = mb.dynamics(block().build(point_masses=True))
    save = np.array([0.0, 0.1, 0.25, 0.5])
    w = np.zeros((3, 6))
    w[:, 0] = 2.0, -1.0, 3.0
    fine = np.zeros((10, 6))
    fine[:, 0] = np.repeat(w[:, 0], [2, 3, 5])
    q, v, _ = stepped(np.array([0.3, 0.2]), fine[:, 0], 0.05, 4)
    shape = (2, 1) if batch else (1,)
    for given in (w, np.tile(w, (2, 1, 1))) if batch else (w,):
        run = simulate(
            *(dyn, np.full(shape, 0.3), np.full(shape, 0.2), 0.5, "rk853"),
            torque=sampled_law,
            hold=0.2,
            save=save,
            wrenches={"m": given},
        )
        at = [0, 2, 5, 10]
        np.testing.assert_allclose(run.q.reshape(-1, 4), np.tile(q[at], (len(run.q.reshape(-1, 4)), 1)), atol=1e-12)
        np.testing.assert_allclose(run.v.reshape(-1, 4)[0], v[at], atol=1e-12)
        np.testing.assert_array_equal(run.wrenches()["m"].reshape(-1, 4, 6)[0, :-1], w)


def test_what_is_no_table_of_wrenches_is_named() -> None:
    dyn = mb.dynamics(block().build(point_masses=True))
    with pytest.raises(mb.errors.InputError, match=r"between 0 and 1 s, got 1\.0000000001 to 1\.0000000001 s"):
        simulate(dyn, [0.0], [0.0], 1.0, save=[1.0 + 1e-10])
    with pytest.raises(mb.errors.InputError, match="wrenches: expected a dict of frame names"):
        simulate(dyn, [0.0], [0.0], 1.0, torque=sampled_law, hold=0.1, wrenches=[1.0] * 6)  # type: ignore[arg-type]
    run = simulate(dyn, [0.0], [0.0], 0.0, torque=sampled_law, hold=0.1, wrenches={"m": [1.0] * 6})
    assert run.wrenches()["m"].tolist() == [[1.0] * 6]


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio"])
@pytest.mark.parametrize(("method", "setting"), [("rk4", {"dt": 0.02}), ("rk853", {})])
def test_friction_takes_f_times_the_way(engine: str, method: str, setting: dict[str, float]) -> None:
    run = simulate(mb.dynamics(rubbing(), engine), [0.0], [0.5], 2.0, method, torque=[5.0], **setting)
    # a = (5 - 3)/2, so that 3 m are gone along.
    assert run.work()[-1] == pytest.approx((5.0 - 3.0) * 3.0, abs=1e-12)
    assert np.abs(run.power_balance()).max() < 1e-12
