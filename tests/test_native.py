"""MuJoCo's own five integrators: their order, what each does to damping, springs and rotations."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mbkit import catalog
from mbkit.engines import Dynamics, dynamics
from mbkit.engines.mujoco.engine import INTEGRATORS
from mbkit.errors import MbkitWarning
from mbkit.model import Model
from mbkit.simulate import METHODS, simulate
from tests import orders
from tests.scenes import damped_arm, slider

NATIVE = tuple(m.name for m in METHODS.values() if m.kind == "native" and "mujoco" in m.engines)
IMPLICIT = ("mujoco_implicit", "mujoco_implicitfast", "mujoco_discrete")


def sliding(**joint: float) -> Dynamics:
    return dynamics(slider(**joint).build(), "mujoco")


def cases() -> dict[str, tuple[Model, np.ndarray, np.ndarray, float]]:
    sprung = damped_arm(), np.array([1.0, -0.5]), np.array([2.0, 1.0]), 1.0
    known = ("double pendulum", "heavy top", "Dzhanibekov box")
    return {"damped, on a spring": sprung} | {name: orders.cases()[name] for name in known}


def test_there_are_all_of_mujocos() -> None:
    import mujoco

    assert len(INTEGRATORS) == len(mujoco.mjtIntegrator.__members__) == len(NATIVE) == 5
    assert [f"mujoco_{name}" for name in INTEGRATORS] == list(NATIVE)


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("case", cases())
@pytest.mark.parametrize("method", NATIVE)
def test_observed_order(case: str, method: str) -> None:
    counts = (60, 90, 140, 200) if METHODS[method].order == 4 else (300, 450, 700, 1000)
    order = orders.observed(cases()[case], method, counts, "mujoco")
    assert order == pytest.approx(METHODS[method].order, abs=0.2)


def gain(method: str, model: Model, v: np.ndarray) -> float:
    """Return the relative growth of kinetic energy of what is left to itself for 0.5 s."""
    energy = simulate(dynamics(model, "mujoco"), model.neutral(), v, 0.5, method, dt=1e-3).energy()
    return float(energy[-1] / energy[0] - 1)


def test_implicit_methods_damp_a_tumbling_body_and_explicit_ones_drive_it() -> None:
    box, spin = catalog.free_body(), np.array([0.0, 0.0, 0.0, 2.0, 10.0, 2.0])
    assert gain("mujoco_euler", box, spin) > 1e-4
    for method in IMPLICIT:
        assert gain(method, box, spin) < -1e-4
    assert abs(gain("mujoco_rk4", box, spin)) < 1e-8


def test_only_the_fully_implicit_method_damps_a_body_on_a_ball_joint() -> None:
    top, spin = catalog.heavy_top(gravity=0.0), np.array([1.0, 20.0, -4.0])
    gains = {method: gain(method, top, spin) for method in NATIVE}
    assert gains["mujoco_implicit"] < -1e-2
    for method in ("mujoco_euler", "mujoco_implicitfast", "mujoco_discrete"):
        assert gains[method] > 1e-2
    assert gains["mujoco_implicitfast"] == pytest.approx(gains["mujoco_euler"], rel=1e-9)


def test_dampers_are_implicit_in_three_and_springs_in_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    h, damping, stiffness = 1e-3, 1e6, 1e9
    for method in NATIVE:
        if method in IMPLICIT:
            run = simulate(sliding(damping=damping), [1.0], [1.0], 0.01, method, dt=h)
            factor = 1 / (1 + h * damping)
            assert run.v[:, 0] == pytest.approx(factor ** np.arange(11), rel=1e-9)
        else:
            with pytest.warns(MbkitWarning, match="diverged"):
                simulate(sliding(damping=damping), [1.0], [1.0], 0.1, method, dt=h)
        if method == "mujoco_discrete":
            run = simulate(sliding(stiffness=stiffness), [1.0], [0.0], 0.1, method, dt=h)
            # v⁺ = v - h K (q + h v⁺), q⁺ = q + h v⁺: implicit Euler.
            step = np.linalg.inv([[1.0, -h], [h * stiffness, 1.0]])
            exact = [np.linalg.matrix_power(step, k) @ [1.0, 0.0] for k in range(6)]
            assert np.column_stack([run.q, run.v])[:6] == pytest.approx(np.array(exact), rel=1e-9, abs=1e-12)
            assert abs(run.q[-1, 0]) < 1e-100
        else:
            with pytest.warns(MbkitWarning, match="diverged"):
                simulate(sliding(stiffness=stiffness), [1.0], [0.0], 0.1, method, dt=h)
    # MuJoCo writes MUJOCO_LOG.TXT where it stands, if it is let.
    assert not list(tmp_path.iterdir())


def test_no_log_is_left_in_the_working_folder(tmp_path: Path) -> None:
    code = """
import mbkit as mb, numpy as np, mujoco, warnings
from mbkit.engines.mujoco.engine import Variant
dyn = mb.dynamics(mb.catalog.pendulum(), "mujoco")
for call in (lambda q: Variant(dyn).accelerations(q, q), lambda q: mujoco.mj_step(dyn.mj_model, data(q))):
    def data(q):
        made = mujoco.MjData(dyn.mj_model)
        made.qpos[:] = q
        return made
    call(np.array([np.nan]))
"""
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True, env=os.environ | {"PYTHONPATH": os.getcwd()})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("method", NATIVE)
def test_batches_are_their_states_one_by_one_and_may_be_empty(method: str) -> None:
    model = catalog.double_pendulum()
    dyn = dynamics(model, "mujoco")
    q, v = model.random_state(np.random.default_rng(0), 3)
    tau = np.random.default_rng(1).standard_normal((3, 6, 2))
    run = simulate(dyn, q, v, 0.055, method, dt=0.01, torque=tau)
    assert run.t[-1] == 0.055
    for i in range(3):
        alone = simulate(dyn, q[i], v[i], 0.055, method, dt=0.01, torque=tau[i])
        assert np.array_equal(run.q[i], alone.q)
    assert run.stats.evaluations == run.stats.steps * METHODS[method].stages
    empty = simulate(dyn, np.empty((0, 2)), [0.0, 0.0], 0.05, method)
    assert empty.q.shape == (0, 51, 2)
    assert empty.stats.steps == 0


@pytest.mark.parametrize("method", NATIVE)
def test_a_run_is_interrupted_between_its_parts_and_does_not_depend_on_them(
    monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    """MuJoCo's own loop ignores Ctrl-C; it is left after a tenth of a second."""
    dyn = dynamics(catalog.double_pendulum(), "mujoco")
    start = [[0.6, -0.3], [1.0, 2.0]], [[0.2, 0.5], [0.0, 0.0]]
    torque = np.sin(np.arange(100.0)[:, None] * [0.1, 0.2])
    runs = []
    for period in (0.0, 1e9):
        monkeypatch.setattr("mbkit.engines.mujoco.engine.LOOK_SECONDS", period)
        runs.append(simulate(dyn, *start, 0.1, method, torque=torque))
    assert np.array_equal(runs[0].q, runs[1].q)
    assert np.array_equal(runs[0].v, runs[1].v)

    seen: list[float] = []

    def interrupt(fraction: float) -> None:
        seen.append(fraction)
        raise KeyboardInterrupt

    monkeypatch.setattr("mbkit.engines.mujoco.engine.LOOK_SECONDS", 0.0)
    monkeypatch.setattr("mbkit.simulate.progress.LOOK_SECONDS", 0.0)
    with pytest.raises(KeyboardInterrupt):
        simulate(dyn, *start, 1.0, method, progress=interrupt)
    assert len(seen) == 1
    assert seen[0] < 0.1
