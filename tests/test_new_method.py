"""Tutorial: a Runge-Kutta method of one's own is its tableau, and everything runs it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from click.testing import CliRunner

import mbkit as mb
from mbkit.cli import cli
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import InputError, UnsupportedError
from mbkit.simulate import METHODS, RK4, ImplicitTableau, Method, Tableau, register_method, simulate
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.solvers import compiled_fixed_step
from tests.scenes import slider

HEUN = Tableau("heun", [[0, 0], [1, 0]], [1 / 2, 1 / 2], order=2)
TRAPEZOID = ImplicitTableau("trapezoid", [[0, 0], [1 / 2, 1 / 2]], [1 / 2, 1 / 2], 2)
START = np.array([0.6, 0.3]), np.array([0.5, -0.5])


@pytest.fixture(autouse=True)
def methods() -> Iterator[None]:
    register_method(HEUN)
    register_method(TRAPEZOID)
    yield
    for name in set(METHODS) - BUILT_IN:
        del METHODS[name]


BUILT_IN = frozenset(METHODS)


@pytest.mark.thorough
def test_heun_reaches_its_order_on_every_engine() -> None:
    model = mb.catalog.double_pendulum()
    truth = simulate(mb.dynamics(model), *START, 1.0, "dop853", rtol=1e-12, save=[0.0, 1.0])
    ends = {}
    for engine in ("lagrangian", "pinocchio", "mujoco"):
        for method in ("heun", "trapezoid"):
            steps = 0.01 / 2.0 ** np.arange(4)
            runs = [simulate(mb.dynamics(model, engine), *START, 1.0, method, dt=dt) for dt in steps]
            errors = [np.linalg.norm(run.q[-1] - truth.q[-1]) for run in runs]
            assert np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(2, abs=0.1)
            ends[engine, method] = runs[0].q[-1]
    for (_, method), q in ends.items():
        # 100 steps of rounding.
        assert q == pytest.approx(ends["lagrangian", method], abs=1e-13)


def test_heun_runs_as_machine_code_where_rk4_does(monkeypatch: pytest.MonkeyPatch) -> None:
    dyn = LagrangianDynamics(mb.catalog.double_pendulum(), compile=True)
    compiled = []

    def run(problem: IntegrationProblem) -> object:
        compiled.append(problem.method)
        return run_rollout(problem)

    run_rollout = compiled_fixed_step.run_rollout
    monkeypatch.setattr(compiled_fixed_step, "run_rollout", run)
    for name in ("heun", "rk4", "trapezoid"):
        simulate(dyn, *START, 0.1, name, dt=0.01, doubt=False)
    assert compiled == ["heun", "rk4", "trapezoid"]
    # No step of it is given up: two of its stages, of one step and of the next, are at one time.
    monkeypatch.setattr(compiled_fixed_step, "run_fixed", None)
    assert simulate(dyn, *START, 1.0, "trapezoid", dt=0.01, doubt=False).stats.finished
    # One by one, in a batch, and in NumPy under a torque function.
    q, v = (np.tile(x, (9, 1)) for x in START)
    one, batch = simulate(dyn, *START, 0.1, "heun", dt=0.01), simulate(dyn, q, v, 0.1, "heun", dt=0.01)
    by_function = simulate(dyn, *START, 0.1, "heun", dt=0.01, torque=lambda t, q, v: np.zeros(2))  # noqa: ARG005
    assert one.stats.evaluations == by_function.stats.evaluations == 20
    assert batch.q == pytest.approx(np.tile(one.q, (9, 1, 1)), abs=1e-14)
    assert by_function.q == pytest.approx(one.q, abs=1e-14)


def test_rotations_are_moved_by_their_exponential() -> None:
    top = mb.catalog.heavy_top()
    q, v = top.random_state(np.random.default_rng(0))
    truth = simulate(mb.dynamics(top), q, v, 0.2, "dop853", rtol=1e-12, save=[0.0, 0.2])
    errors = []
    for dt in (2e-3, 1e-3):
        run = simulate(mb.dynamics(top), q, v, 0.2, "heun", dt=dt)
        errors.append(np.linalg.norm(top.difference(truth.q[-1], run.q[-1])))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.2)


def test_another_tableau_of_the_same_name_is_another_code() -> None:
    dyn = LagrangianDynamics(mb.catalog.double_pendulum(), compile=True)
    heun = simulate(dyn, *START, 0.1, "heun", dt=0.01)
    del METHODS["heun"]
    register_method(Tableau("heun", [[0, 0], [1 / 2, 0]], [0, 1], order=2))
    midpoint = simulate(dyn, *START, 0.1, "heun", dt=0.01)
    numpy = simulate(dyn, *START, 0.1, "heun", dt=0.01, torque=lambda t, q, v: np.zeros(2))  # noqa: ARG005
    assert np.abs(midpoint.q[-1] - heun.q[-1]).max() > 1e-8
    assert midpoint.q[-1] == pytest.approx(numpy.q[-1], abs=1e-14)


def test_studies_and_the_command_take_it(tmp_path: object) -> None:
    steps = [0.02, 0.01, 0.005]
    found = mb.work_precision(mb.catalog.pendulum(), ["lagrangian", "pinocchio"], ["heun"], steps=steps, repeats=1)
    assert {(curve.engine, curve.method) for curve in found.curves} == {("lagrangian", "heun"), ("pinocchio", "heun")}
    for curve in found.curves:
        errors = [point.error for point in curve.points]
        assert np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(2, abs=0.2)
    arguments = ["bench", "pendulum", "--engines", "pinocchio", "--methods", "heun", "--quick", "--duration", "0.1"]
    result = CliRunner().invoke(cli, [*arguments, "--out", str(tmp_path)])
    assert result.exit_code == 0
    assert "heun" in result.output


def test_its_stability_is_computed_from_its_tableau() -> None:
    assert METHODS["heun"].stability.largest_step(1.0, 0.0) == 0.0  # type: ignore[union-attr]
    assert METHODS["heun"].stability.largest_step(1.0, 1.0) == pytest.approx(2.0)  # type: ignore[union-attr]
    assert METHODS["trapezoid"].stability.largest_step(1.0, 0.0) == np.inf  # type: ignore[union-attr]
    # Hairer, Wanner 1996, figure IV.2.1.
    assert METHODS["rk4"].stability.largest_step(1.0, 0.0) == pytest.approx(np.sqrt(8), rel=1e-12)  # type: ignore[union-attr]
    assert METHODS["rk4"].stability.largest_step(1.0, 1.0) == pytest.approx(2.785293563405282, rel=1e-12)  # type: ignore[union-attr]
    runs = [
        simulate(mb.dynamics(spring()), [1.0], [0.0], 1000 * dt, "heun", dt=dt, doubt=False)
        for dt in np.array([0.99, 1.01]) * METHODS["heun"].stability.largest_step(10.0, 1.0)  # type: ignore[union-attr]
    ]
    assert abs(runs[0].q[-1, 0]) < 1 < abs(runs[1].q[-1, 0])


def spring() -> mb.Model:
    """A mass with ω = 10 rad/s and ζ = 1."""
    b = slider("spring", stiffness=100.0, damping=20.0)
    return b.build()


@pytest.mark.parametrize(
    ("method", "says"),
    [
        (Tableau("rk4", RK4.A, RK4.b, 4), "rk4 is registered already"),
        (Tableau("Heun 2", HEUN.A, HEUN.b, 2), "expected a name of lower-case letters"),
        (METHODS["rk853"], "got EmbeddedTableau"),
        (METHODS["dop853"], "got NoneType"),
        ("heun", "got str"),
        (Method("other", "adaptive", 2, 2, "", formula_source=HEUN), "kind 'fixed'"),
        (Method("other", "fixed", 3, 2, "", formula_source=HEUN), "order 2"),
        (ImplicitTableau("twice", [[0.5, 0], [0.5, 0]], [0.5, 0.5], 2), "different times"),
    ],
)
def test_what_cannot_run_is_refused(method: object, says: str) -> None:
    with pytest.raises(InputError, match=says):
        register_method(method)  # type: ignore[arg-type]


def test_it_is_refused_by_name_where_it_cannot_run() -> None:
    dyn = mb.dynamics(mb.catalog.pendulum(), "lagrangian")
    with pytest.raises(InputError, match=r"rtol: heun has a fixed step"):
        simulate(dyn, [0.1], [0.0], 1.0, "heun", rtol=1e-6)
    with pytest.raises(UnsupportedError, match="heun: events"):
        simulate(
            dyn, [0.1], [0.0], 1.0, "heun", events=mb.simulate.at_section(dyn.model, dyn.model.coordinate_names[0])
        )


def test_a_ragged_argument_of_a_tableau_is_named() -> None:
    ragged = [[], [1.0]]
    with pytest.raises(InputError, match=r"tableau 'x': A: expected an array of numbers, got \[\[\], \[1.0\]\]"):
        Tableau("x", ragged, [0.5, 0.5], 2)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="tableau 'x': b: expected an array of numbers"):
        ImplicitTableau("x", [[0.5]], [[1.0], []], 2)  # type: ignore[arg-type]
