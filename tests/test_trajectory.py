# Torques have the signature they are called with.
# ruff: noqa: ARG001, ARG005
"""What a run returns: energies, work, momenta, pictures; and that it travels."""

from __future__ import annotations

import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mbkit as mb
from mbkit import catalog
from mbkit.engines import dynamics
from mbkit.errors import InputError, LoadError, MbkitWarning, OutputError, TorqueError, UnsupportedError
from mbkit.model import Model, ModelBuilder
from mbkit.simulate import METHODS, Trajectory, at_section, simulate
from mbkit.simulate.plotting.motion_strip import skeleton
from mbkit.simulate.run_data import _by_cubics
from tests.random_trees import off, random_tree, rotation, states
from tests.scenes import slider

EPS = np.finfo(float).eps


def free_tree(seed: int, n: int = 5) -> Model:
    """A floating tree that nothing outside acts on; springs and dampers inside it may."""
    rng = np.random.default_rng(seed)
    b = ModelBuilder(f"floating{seed}", gravity=np.zeros(3))
    kinds = ["free", *rng.permutation(["revolute", "ball", "prismatic", "planar", "helical", "free", "fixed"])[: n - 1]]
    for i, kind in enumerate(kinds):
        d = rng.uniform(0.1, 1, 3)
        R = rotation(rng)
        inertia = R @ np.diag([d[0] + d[1], d[1] + d[2], d[2] + d[0]]) @ R.T
        b.add_body(f"b{i}", mass=rng.uniform(0.5, 2), com=0.3 * rng.standard_normal(3), inertia=inertia)
        joint: dict[str, Any] = {"translation": 0.5 * rng.standard_normal(3), "rotation": rotation(rng)}
        if kind in ("revolute", "prismatic", "helical"):
            joint |= {"axis": rng.standard_normal(3), "damping": 0.3 if i else 0.0}
        if kind == "helical":
            joint["pitch"] = 0.2
        parent = "world" if i == 0 else f"b{rng.integers(i)}"
        b.add_joint(f"j{i}", str(kind), parent=parent, child=f"b{i}", **joint)
    return b.build()


def slope(steps: list[float], errors: list[float]) -> float:
    return float(np.polyfit(np.log(steps), np.log(errors), 1)[0])


def swing(**options: Any) -> Trajectory:
    step = {} if METHODS[options.get("method", "rk4")].kind == "adaptive" else {"dt": 0.01}
    return simulate(dynamics(catalog.double_pendulum()), [0.6, -0.3], [0.2, 0.5], 0.3, **{**step, **options})


# Energies


def test_energy_is_kinetic_and_potential_by_any_engine() -> None:
    model = random_tree(3, 6, kinds=("revolute", "ball", "free", "prismatic", "planar"), springs=True)
    q, v, *_ = states(model, 2)
    runs = simulate(dynamics(model, "lagrangian"), q, v, 0.01)
    assert np.array_equal(runs.energy(), runs.kinetic_energy() + runs.potential_energy())
    assert runs.energy().shape == runs.kinetic_energy().shape == (2, 11)
    for engine in ("pinocchio", "mujoco", dynamics(model, "pinocchio")):
        assert off(runs.energy(engine), runs.energy()) < 1e-12
        assert off(runs.momentum(engine), runs.momentum()) < 1e-12
        assert off(runs.canonical_momentum(engine), runs.canonical_momentum()) < 1e-12
        assert off(runs.work(engine), runs.work()) < 1e-12
    with pytest.raises(InputError, match="engine: expected a Dynamics of tree3, got one of pendulum"):
        runs.energy(dynamics(catalog.pendulum()))


# Torque and work


def test_tau_is_what_acted() -> None:
    assert not swing().tau.any()
    assert np.array_equal(swing(torque=[1.0, 2.0]).tau, np.tile([1.0, 2.0], (31, 1)))
    rows = np.arange(60.0).reshape(30, 2)
    assert np.array_equal(swing(torque=rows).tau, rows[[*range(30), 29]])
    assert np.array_equal(swing(torque=rows, save=7).tau, rows[[0, 7, 14, 21, 28, 29]])
    run = swing(torque=lambda t, q, v: [t, q[0] * v[1]])
    assert np.array_equal(run.tau, np.column_stack([run.t, run.q[:, 0] * run.v[:, 1]]))
    both = simulate(
        dynamics(run.model), [[0.1, 0.2]] * 2, [0.0, 0.0], 0.02, dt=0.01, torque=np.arange(8.0).reshape(2, 2, 2)
    )
    assert np.array_equal(both.tau, np.arange(8.0).reshape(2, 2, 2)[:, [0, 1, 1]])
    saved = swing(torque=np.array([[1.0, 0.0], [0.0, 1.0]]), method="dop853", save=[0.0, 0.1, 0.3])
    assert np.array_equal(saved.tau, [[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])


def test_a_function_is_asked_once_and_its_answers_travel() -> None:
    asked = []

    def torque(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        asked.append(t)
        q[:] = 0.0
        return np.array([0.1, -0.2]) * v

    run = swing(torque=torque)
    during = len(asked)
    again = pickle.loads(pickle.dumps(run))
    assert np.array_equal(again.tau, run.tau)
    assert np.array_equal(again.power_balance(), run.power_balance())
    assert run.tau.shape == run.v.shape
    run.work()
    assert len(asked) == during + 2 * 31, "once for the pickle, once for the run"
    assert np.array_equal(run.tau, [[0.1, -0.2]] * run.v)
    assert not run.tau.flags.writeable


def test_a_held_torque_does_tau_times_distance() -> None:
    rows = np.random.default_rng(0).standard_normal((30, 2))
    run = swing(torque=rows, dt=0.01)
    exact = np.cumsum(np.sum(rows * np.diff(run.q, axis=0), axis=1))
    assert np.abs(run.work()[1:] - exact).max() < 30 * EPS
    assert run.work()[0] == 0.0
    # Where nothing but the run errs, its fourth order shows, whatever the torque's jumps.
    steps = [0.01 / k for k in (1, 2, 4)]
    runs = [swing(torque=np.repeat(rows, k, axis=0), dt=0.01 / k) for k in (1, 2, 4)]
    errors = [np.abs(run.power_balance()).max() for run in runs]
    assert slope(steps, errors) == pytest.approx(4, abs=0.3)
    one = swing(torque=rows[:1], dt=0.3)
    assert one.work()[-1] == pytest.approx(rows[0] @ (one.q[1] - one.q[0]), abs=1e-15)
    with pytest.raises(UnsupportedError, match=r"changes between the saved states at 0 and 0.05 s.*save=None"):
        swing(torque=rows, save=5).work()
    # One that does not change between them may be saved more rarely.
    same = np.repeat(rows[:6], 5, axis=0)
    assert swing(torque=same, save=5).work()[-1] == pytest.approx(swing(torque=same).work()[-1], abs=1e-14)


def test_the_quadrature_is_exact_for_cubics() -> None:
    rng = np.random.default_rng(0)
    for n in (0, 1, 2, 3, 4, 9):
        t = np.sort(rng.uniform(0, 2, n))
        degree = min(max(n - 1, 0), 3)
        c = rng.standard_normal(degree + 1)
        whole = np.polynomial.Polynomial(c).integ()
        got = _by_cubics(t, np.stack([np.polynomial.Polynomial(c)(t)] * 2))
        assert got.shape == (2, max(n - 1, 0))
        # Close states are as many digits worse as their cubic's weights are larger than one.
        assert got[0] == pytest.approx(np.diff(whole(t)), abs=1e-12)


# Momenta


@pytest.mark.thorough("1", "2", "3")
@pytest.mark.parametrize("seed", range(4))
def test_momentum_of_what_floats_is_kept(seed: int) -> None:
    model = free_tree(seed)
    dyn = dynamics(model)
    q, v, *_ = states(model, 2, seed)
    push = np.zeros(model.nv)
    push[6:] = 1.0  # inner forces change no momentum
    run = simulate(dyn, q, 0.5 * v, 0.2, dt=1e-3, torque=push)
    P = run.momentum()
    assert P.shape == (2, 201, 6)
    # Inner motion is rough, and the error of RK4 at this step is what is left of it.
    assert np.abs(P - P[:, :1]).max() < 1e-7 * np.abs(P).max()
    assert np.abs(run.canonical_momentum() - run.canonical_momentum()[:, :1]).max() > 1e-3
    exact = simulate(dyn, q[0], 0.5 * v[0], 0.2, "dop853", rtol=1e-12, torque=push)
    assert np.abs(exact.momentum() - exact.momentum()[0]).max() < 1e-10 * np.abs(P).max()
    alone = simulate(dyn, q[1], 0.5 * v[1], 0.2, dt=1e-3, torque=push)
    assert P[1] == pytest.approx(alone.momentum(), abs=1e-12)


def test_momentum_of_one_body_is_m_v_and_i_w() -> None:
    b = ModelBuilder("body", gravity=(0, 0, 0))
    inertia, com = np.diag([0.3, 0.4, 0.5]), np.array([0.1, -0.2, 0.3])
    b.add_body("box", mass=2.0, com=com, inertia=inertia)
    b.add_joint("float", "free", parent="world", child="box")
    # A frame that hides the body's own.
    b.add_body("dot", mass=0.0)
    b.add_joint("on", "fixed", parent="box", child="dot", translation=(1, 0, 0))
    model = b.build()
    rng = np.random.default_rng(0)
    q, v = model.random_state(rng)
    run = simulate(dynamics(model, "lagrangian"), q, v, 0.0)
    x, y, z, w = q[3:]
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    p = 2.0 * R @ (v[:3] + np.cross(v[3:], com))
    L = np.cross(q[:3] + R @ com, p) + R @ inertia @ v[3:]
    assert run.momentum()[0] == pytest.approx(np.concatenate([p, L]), abs=1e-14)


def test_trajectories_with_parameters_of_their_own() -> None:
    model = catalog.double_pendulum(mass1=mb.Parameter("m1", 1.0), length2=mb.Parameter("l2", 1.0))
    dyn = dynamics(model, "lagrangian")
    m1, l2 = np.array([1.0, 3.0]), np.array([0.5, 2.0])
    runs = simulate(dyn.at(m1=m1, l2=l2), [0.5, 0.2], [0.1, 0.3], 0.05, torque=[0.1, 0.2])
    again = pickle.loads(pickle.dumps(runs))
    for i in range(2):
        alone = simulate(
            dynamics(model.with_parameters(m1=m1[i], l2=l2[i])), [0.5, 0.2], [0.1, 0.3], 0.05, torque=[0.1, 0.2]
        )
        for name in ("energy", "momentum", "canonical_momentum", "work"):
            expected = getattr(alone, name)()
            assert getattr(runs, name)()[i] == pytest.approx(expected, abs=1e-11), name
            assert np.array_equal(getattr(again, name)(), getattr(runs, name)()), name
    with pytest.raises(UnsupportedError, match="parameters of their own"):
        runs.energy("pinocchio")
    heights = [np.ptp(runs.picture(count=1, member=i).axes[0].dataLim.intervaly) for i in range(2)]
    assert heights[1] > 1.5 * heights[0]


# What went wrong


def test_what_diverged_is_nan_and_the_rest_is_not() -> None:
    b = ModelBuilder("stiff")
    b.add_body("mass", mass=1.0)
    b.add_joint("x", "prismatic", parent="world", child="mass", axis=(1, 0, 0), stiffness=1e9, damping=0.1)
    with pytest.warns(MbkitWarning, match="1 of 2 trajectories diverged"):
        run = simulate(dynamics(b.build()), [[0.0], [1.0]], [0.0], 0.2, torque=np.ones((200, 1)) * 0.0)
    assert isinstance(run.stats.reached, tuple)
    for values in (run.energy(), run.work(), run.power_balance(), run.momentum()[..., 0], run.tau[..., 0]):
        assert np.isfinite(values[0]).all()
        assert np.array_equal(np.isfinite(values[1]), run.t <= run.stats.reached[1])
    run.plot()
    for member in (0, 1):
        run.picture(member=member)


def test_a_failed_torque_leaves_nan_where_it_failed() -> None:
    def torque(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        if t > 0.1:
            raise ZeroDivisionError("mine")
        return np.array([0.1, 0.2])

    with pytest.raises(TorqueError) as caught:
        swing(torque=torque)
    for error in (caught.value, pickle.loads(pickle.dumps(caught.value))):
        run = error.trajectory
        assert run.stats.ended == "function_failed"
        assert run.stats.reached == run.t[-1] == pytest.approx(0.1)
        assert np.isfinite(run.tau[:-1]).all()
        assert np.isfinite(run.power_balance()[:-2]).all()
        assert "ZeroDivisionError" in repr(run)
        run.plot()
        run.picture()


def test_a_function_that_fails_afterwards_says_so() -> None:
    calls = []

    def torque(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        calls.append(t)
        if len(calls) > 130:
            raise RuntimeError("used up")
        return np.zeros(2)

    run = swing(torque=torque)
    with pytest.raises(TorqueError, match="used up"):
        run.work()
    assert np.isnan(pickle.loads(pickle.dumps(run)).tau).any()


def test_runs_of_one_state_and_of_none() -> None:
    dyn = dynamics(catalog.double_pendulum())
    run = simulate(dyn, [0.1, 0.2], [0.0, 0.0], 0.0, torque=lambda t, q, v: [1.0, 1.0])
    assert run.work().tolist() == run.power_balance().tolist() == [0.0]
    assert len(times(run.picture())) == 1
    run.plot()
    none = simulate(dyn, np.empty((0, 2)), np.empty((0, 2)), 0.02)
    assert none.energy().shape == none.work().shape == (0, len(none.t))
    assert none.momentum().shape == (0, len(none.t), 6)
    assert none.tau.shape == none.v.shape
    none.plot()
    with pytest.raises(InputError, match="member: expected less than 0"):
        none.picture()


# Pictures


def times(figure: Any) -> list[str]:
    return [t.get_text() for t in figure.axes[0].texts if t.get_text().startswith("t = ")]


def test_plot_has_a_panel_for_each_unit(tmp_path: Path) -> None:
    b = ModelBuilder("mixed $kinds_")
    for i, kind in enumerate(("free", "revolute", "prismatic")):
        b.add_body(f"b{i}", mass=1.0, inertia=(0.1, 0.1, 0.1))
        axis = {} if kind == "free" else {"axis": (0, 1, 0)}
        b.add_joint(f"$j_{i}", kind, parent="world" if i == 0 else f"b{i - 1}", child=f"b{i}", **axis)
    model = b.build()
    q, v = model.random_state(np.random.default_rng(0))
    run = simulate(dynamics(model), q, v, 0.05, "dop853", events=at_section(model, "$j_1", q[7] + 0.01 * np.sign(v[6])))
    assert len(run.events) == 1
    figure = run.plot()
    labels = [axis.get_ylabel() for axis in figure.axes]
    assert labels[::2] == ["lengths (m)", "angles (rad)", "quaternions (1)", "energy (J)"]
    assert [re.search(r"\(([^()]*)\)$", x)[1] for x in labels[1::2]] == ["m/s", "rad/s", "rad/s", "J"]  # type: ignore[index]
    # A line for each coordinate, and one for the event.
    assert [len(axis.lines) for axis in figure.axes] == [4 + 1, 4 + 1, 1 + 1, 1 + 1, 4 + 1, 3 + 1, 3 + 1, 1 + 1]
    assert "$j_1" in figure.axes[0].texts[0].get_text()
    assert "$j_1" in run._repr_html_()
    figure.savefig(tmp_path / "run.png")


def test_plot_marks_a_divergence_and_shows_what_was_before_it() -> None:
    b = ModelBuilder("stiff")
    b.add_body("mass", mass=1.0)
    b.add_joint("x", "prismatic", parent="world", child="mass", axis=(1, 0, 0), stiffness=1e7)
    with pytest.warns(MbkitWarning):
        run = simulate(dynamics(b.build()), [1.0], [0.0], 1.0)
    figure = run.plot()
    assert figure.axes[0].texts[0].get_text().strip() == "diverged"
    assert max(map(abs, figure.axes[0].get_ylim())) < 1e-3 * np.abs(run.q).max()
    assert "diverged" in [run.picture().axes[0].get_title("right")]


def test_plot_says_what_it_cannot_draw() -> None:
    run = swing(torque=np.random.default_rng(0).standard_normal((30, 2)), save=5)
    assert "save=None" in run.plot().axes[-1].texts[0].get_text().replace("\n", " ")


@pytest.mark.thorough("8", "13")
@pytest.mark.parametrize("count", [1, 2, 5, 8, 13])
def test_a_picture_has_as_many_figures_as_asked(count: int) -> None:
    assert len(times(swing().picture(count))) == count
    assert len(times(swing(method="dop853", rtol=1e-3).picture(count))) == count, "also between the states"


def test_the_plane_is_the_motions_or_the_one_asked_for() -> None:
    def told(run: Trajectory, **options: Any) -> str:
        return str(run.picture(2, **options).axes[0].texts[-1].get_text())

    assert "x to the right, z upwards" in told(swing())
    assert "y to the right, z upwards" in told(swing(), view="yz")
    assert "(0.71, 0.71, 0) to the right" in told(swing(), view=[[1, 1, 0], [0, 0, 1]])
    # On a table, seen from above.
    b = ModelBuilder("table")
    for i in range(2):
        b.add_body(f"b{i}", mass=1.0, com=(0.5, 0, 0), inertia=(0.1, 0.1, 0.1))
        place = (1.0, 0, 0) if i else (0, 0, 0)
        b.add_joint(
            f"j{i}", "revolute", parent=f"b{i - 1}" if i else "world", child=f"b{i}", axis=(0, 0, 1), translation=place
        )
    run = simulate(dynamics(b.build()), [0.0, 0.5], [1.0, 2.0], 1.0, dt=0.01)
    assert "x to the right, y upwards" in told(run)
    for view, message in (
        ("xx", "view: expected two of x, y and z"),
        ("up", "view: expected two"),
        ([[1, 0, 0], [2, 0, 0]], "not along one line"),
        ([[0, 0, 0], [2, 0, 0]], "not along one line"),
        ([1, 0, 0], r"view: expected shape \(2, 3\)"),
    ):
        with pytest.raises(InputError, match=message):
            run.picture(view=view)
    for options, message in (
        ({"count": 0}, "count: expected a whole number of at least 1"),
        ({"count": 2.5}, "count: expected a whole number"),
        ({"member": 1}, "member: expected less than 1"),
    ):
        with pytest.raises(InputError, match=message):
            run.picture(**options)


@pytest.mark.parametrize("seed", range(3))
def test_skeletons_stand_where_engines_put_them(seed: int) -> None:
    model = random_tree(seed, 10, mimic=True)
    q, *_ = states(model, 4, seed)
    drawn, dyn = skeleton(model, q), dynamics(model, "lagrangian")
    for points, bodies in (
        (drawn.joints, [j.child for j in model.tree if not j.type.lengths and j.kind != "fixed"]),
        (drawn.slides[:, 1], [j.child for j in model.tree if j.kind in ("prismatic", "planar")]),
    ):
        places = [dyn.pose(q, body)[:, :3, 3] for body in bodies]
        assert places
        for place in places:
            pool = np.concatenate([points, drawn.carts])
            assert np.abs(pool - place).max(axis=(1, 2)).min() < 1e-13


def driven(batch: bool) -> Trajectory:
    model = catalog.cart_pole()
    start = np.zeros((3, 2)) if batch else np.zeros(2)
    return simulate(dynamics(model), start, start, 0.05, torque=lambda t, q, v: [np.cos(t), 0.1 - q[0]], dt=0.01)


@pytest.mark.parametrize("batch", [False, True])
def test_a_table_of_a_controlled_run_has_the_torques(batch):
    run = driven(batch)
    head, *rows = run.to_csv().splitlines()
    assert head.split(",")[-2:] == [f"tau.{n}" for n in run.model.velocity_names]
    assert np.array([row.split(",") for row in rows], float)[:, -2:].tolist() == run.tau.reshape(-1, 2).tolist()
    free = simulate(dynamics(run.model), [0.0, 0.0], [0.0, 0.0], 0.05)
    assert "tau" not in free.to_csv()


def test_a_controlled_run_is_drawn_with_its_torques_and_forces():
    labels = [axis.get_ylabel() or axis.get_title() for axis in driven(False).plot().axes]
    assert any("torques (N m)" in x for x in labels)
    assert any("forces (N)" in x for x in labels)
    free = simulate(dynamics(catalog.cart_pole()), [0.0, 0.0], [0.0, 0.0], 0.05)
    assert not any("torques" in (axis.get_ylabel() or axis.get_title()) for axis in free.plot().axes)


def test_a_batch_with_parameters_of_its_own_is_not_saved_without_them(tmp_path):
    dyn = dynamics(catalog.pendulum(mass=mb.Parameter("m", 2.0)), "lagrangian").at(m=[1.0, 2.0])
    with pytest.raises(UnsupportedError, match=r"save: .* have parameters of their own"):
        simulate(dyn, np.ones((2, 1)), np.zeros((2, 1)), 0.01).save(tmp_path / "run.npz")


def test_the_work_of_a_saved_run_holds_wrenches_held_torques_and_turns_of_dry_friction(tmp_path):
    """A slide of 2 kg with friction 3 N turns at 0.1 s under a held torque of -7 N, then a table of wrenches pushes."""
    b = ModelBuilder("slide", gravity=(0, 0, 0))
    b.add_body("block", mass=2.0, inertia=(1, 1, 1))
    b.add_joint("x", "prismatic", parent="world", child="block", axis=(1, 0, 0), friction=3.0)
    push, start = np.zeros((100, 6)), {"q0": [0.0], "v0": [0.5]}
    push[30:, 0], push[60:, 0] = -2.0, -6.0
    more = {"torque": lambda t, q, v: [-7.0], "hold": 0.05, "wrenches": {"block": push}}
    run, path = simulate(dynamics(b.build()), **start, duration=1.0, dt=0.01, **more), tmp_path / "run.npz"
    run.save(path)
    again = Trajectory.load(path, run.model)
    np.testing.assert_array_equal(again.wrenches()["block"], run.wrenches()["block"])
    assert str(again.events) == str(run.events)
    assert run.events
    # 1/2 m (v² - v0²) is the work, as nothing stores energy.
    np.testing.assert_allclose(again.work(), run.v[:, 0] ** 2 - 0.25, atol=1e-12)
    np.testing.assert_allclose(again.power_balance(), 0.0, atol=1e-12)


@pytest.mark.parametrize("batch", [False, True])
def test_a_saved_run_comes_back_with_all_its_digits(batch, tmp_path):
    run, path = driven(batch), tmp_path / "run.npz"
    run.save(path)
    again = Trajectory.load(path, run.model)
    for name in ("t", "q", "v", "tau"):
        np.testing.assert_array_equal(getattr(again, name), getattr(run, name))
    assert (again.method, again.engine, again.stats) == (run.method, run.engine, run.stats)
    np.testing.assert_array_equal(again.energy(), run.energy())
    np.testing.assert_allclose(again.work(), run.work(), atol=1e-15)
    with pytest.raises(InputError, match="digests differ"):
        Trajectory.load(path, catalog.cart_pole(gravity=1.6))
    for content in (b"", b"PK", b"no run"):
        (tmp_path / "other.npz").write_bytes(content)
        with pytest.raises(LoadError, match=r"expected a run that Trajectory.save wrote"):
            Trajectory.load(tmp_path / "other.npz", run.model)
    with pytest.raises(OutputError, match="cannot write"):
        run.save(tmp_path / "no" / "run.npz")


def test_a_data_frame_is_pandas_or_told():
    run = driven(True)
    try:
        import pandas  # noqa: F401
    except ImportError:
        with pytest.raises(UnsupportedError, match="pip install pandas"):
            run.to_dataframe()
        return
    table = run.to_dataframe()
    assert list(table.columns) == run.to_csv().splitlines()[0].split(",")
    assert (table["trajectory"] == np.repeat([0, 1, 2], len(run.t))).all()


def test_samples_far_from_zero_make_no_steps_of_rounding():
    """2,500 differences of times, a quarter of which are longer than the hold by rounding."""
    dyn, dt = dynamics(slider(mass=2.0).build()), 2e-3
    setting = {"dt": dt, "torque": lambda _, q, v: -5 * q - v, "hold": 2e-3, "save": [0.0, 0.1, 1.0, 5.0]}
    run = simulate(dyn, [1.0], [0.0], 5.0, "semi_implicit_euler", **setting)
    assert run.t == pytest.approx([0.0, 0.1, 1.0, 5.0], abs=1e-12)
    assert run.stats.steps == round(5.0 / dt)
    # An interval at the end that is no multiple of the step, and a batch.
    ragged = simulate(dyn, [[1.0], [1.0]], [0.0], 1.0005 * 2e-3, "semi_implicit_euler", **(setting | {"save": None}))
    assert ragged.t[-1] == pytest.approx(1.0005 * 2e-3, abs=1e-15)


def test_a_picture_of_a_four_bar_has_links_that_meet() -> None:
    """Coupler and rocker end at the pin, wherever each of them begins, and the links stand on two feet."""
    model = mb.catalog.four_bar()
    dyn = mb.dynamics(model, "lagrangian")
    q, v = dyn.project([0.5, 0.0, 1.0], [1.0, 0.0, 0.0])
    run = simulate(dyn, q, v, 0.5, dt=0.01)
    drawn = skeleton(model, run.q)
    starts, ends = drawn.links[:, 0], drawn.links[:, 1]
    (pin,) = model.loops
    where = (dyn.pose(run.q, pin.body_a) @ np.append(pin.translation_a, 1.0))[:, :3]
    meeting = [k for k, end in enumerate(ends) if np.abs(end - where).max() < 1e-8]
    assert len({tuple(starts[k, 0].round(6)) for k in meeting}) == 2
    assert len(drawn.anchors) == 2
    assert not len(drawn.masses)
    run.picture(3)
