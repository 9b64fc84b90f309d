"""Taylor series: exact motions to their stated digits, saved states, torques, parameters and events."""

# Torques and events have the signature they are called with.
# ruff: noqa: ARG005

from __future__ import annotations

import sys
import warnings
from itertools import pairwise
from typing import Any

import casadi as ca
import mpmath as mp
import numpy as np
import pytest

import mbkit as mb
from mbkit import catalog
from mbkit.codegen.program import program
from mbkit.codegen.taylor import TaylorSystem, _functions, order_of, precision, rates
from mbkit.derivation import Equations
from mbkit.engines import dynamics
from mbkit.errors import InputError, MbkitWarning, UnsupportedError
from mbkit.model import Model
from mbkit.simulate import Event, Trajectory, at_section, simulate
from mbkit.simulate.solvers.taylor import rounded
from tests.scenes import mounted

hy = pytest.importorskip("heyoka")
# No test reads what an earlier run left, or leaves anything.
hy.llvm_state.set_diskcache_enabled(False)

EPS = float(np.finfo(float).eps)
TIMES = np.linspace(0.0, 3.0, 13)


def exact_pendulum(start: float, times: Any) -> list[Any]:
    """Return the angles of a pendulum of 1 m that starts at rest, to 40 digits (Landau, Lifshitz, Mechanics, §11)."""
    with mp.workdps(40):
        k, rate = mp.sin(mp.mpf(start) / 2), mp.sqrt(mp.mpf(9.81))
        K = mp.ellipk(k**2)
        return [2 * mp.asin(k * mp.ellipfun("sn", K - rate * mp.mpf(float(t)), m=k**2)) for t in times]


def taylor(dyn: Any, q: Any, v: Any, duration: float = 3.0, rtol: float = EPS, **more: Any) -> Trajectory:
    return simulate(dyn, q, v, duration, "taylor", rtol=rtol, **more)


def slider() -> Model:
    b = mounted("slider", "block", "slide", "prismatic", gravity=(0, 0, 0), mass=1.0, axis=(1, 0, 0))
    return b.build()


@pytest.fixture(scope="module")
def swing() -> Any:
    return dynamics(catalog.pendulum(), "lagrangian")


@pytest.fixture(scope="module")
def double() -> Any:
    return dynamics(catalog.double_pendulum(), "lagrangian")


@pytest.fixture(autouse=True)
def quick_to_compile(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loops for all but the smallest systems: what is run once is not worth more."""
    monkeypatch.setattr("mbkit.codegen.taylor._MAX_UNROLLED_OPERATIONS", 2000)


# Exact motions


@pytest.mark.parametrize("rtol", [1e-4, 1e-8, 1e-12, EPS])
def test_the_error_follows_the_tolerance(swing: Any, rtol: float) -> None:
    run = taylor(swing, [2.0], [0.0], rtol=rtol, save=TIMES)
    exact = np.array(exact_pendulum(2.0, TIMES), dtype=float)
    # Some twenty steps, whose errors add up and grow with the angle's difference in time.
    assert np.abs(run.q[:, 0] - exact).max() < 30 * rtol
    assert run.stats.ended == "finished"
    assert run.stats.evaluations == run.stats.steps < 60


def test_the_oracle_rounds_once() -> None:
    dyn = dynamics(catalog.pendulum(), "oracle")
    run = taylor(dyn, [2.0], [0.0], rtol=1e-32, save=TIMES)
    exact = np.array(exact_pendulum(2.0, TIMES), dtype=float)
    assert np.array_equal(run.q[:, 0], exact)
    assert run.engine == "oracle"


def test_the_oracle_takes_constants_with_32_digits() -> None:
    model = catalog.pendulum()
    q, v = [2.0], [0.0]
    plain = mb.dynamics(model, "oracle")
    high = plain.equations.constant_values  # type: ignore[attr-defined]
    more = np.where(high == 9.81, 1e-9, 0.0)
    moved = type(plain)(model, constants=(high, more))  # type: ignore[call-arg]
    by_hand = type(plain)(model, constants=high + more)  # type: ignore[call-arg]
    ends = [taylor(dyn, q, v, rtol=1e-20, save=[0.0, 3.0]).q[-1, 0] for dyn in (plain, moved, by_hand)]
    assert abs(ends[1] - ends[2]) < 4 * EPS
    assert 1e-12 < abs(ends[1] - ends[0]) < 1e-8


@pytest.mark.parametrize("rtol", [1e-6, 1e-9])
def test_a_drift_of_the_norm_never_bends_the_motion(rtol: float) -> None:
    """The rates at a quaternion of any length are those of its rotation."""
    model = catalog.heavy_top()
    f = rates(Equations(model))
    q, v = model.random_state(np.random.default_rng(0))
    one, two = (f(s * q, v, np.zeros(3)) for s in (1.0, 1 + 1e3 * rtol))
    assert np.asarray(two[1]) == pytest.approx(np.asarray(one[1]), rel=1e-13)
    assert np.asarray(two[0]) == pytest.approx(np.asarray(one[0]) * (1 + 1e3 * rtol), rel=1e-13)


# Saved states


def test_saved_states_do_not_change_the_steps(double: Any) -> None:
    own = taylor(double, [2.0, 1.0], [0.0, 0.0])
    assert own.t[0] == 0.0
    assert own.t[-1] == 3.0
    assert len(own.t) == own.stats.steps + 1
    grid = taylor(double, [2.0, 1.0], [0.0, 0.0], save=np.sort(np.append(own.t, 0.5 * (own.t[1:] + own.t[:-1]))))
    assert grid.stats.steps == own.stats.steps
    assert np.array_equal(grid.q[::2], own.q)
    # Within a step the series is as good as at its end.
    energy = grid.energy()
    assert np.abs(energy - energy[0]).max() < 200 * EPS * np.abs(energy).max()


def test_later_saved_times_leave_out_the_start(swing: Any) -> None:
    run = taylor(swing, [2.0], [0.0], save=TIMES[4:7])
    assert run.t.tolist() == TIMES[4:7].tolist()
    assert run.stats.reached == 3.0
    exact = np.array(exact_pendulum(2.0, TIMES[4:7]), dtype=float)
    assert run.q[:, 0] == pytest.approx(exact, abs=1e-14)


# Torques and parameters


def test_a_held_torque_jumps_where_it_should(swing: Any) -> None:
    save = np.array([0.0, 0.3, 0.7, 1.0])
    torque = np.array([[1.0], [-3.0], [2.0]])
    run = taylor(swing, [0.5], [0.0], 1.0, save=save, torque=torque)
    q, v = np.array([0.5]), np.array([0.0])
    for k, (a, b) in enumerate(pairwise(save)):
        part = taylor(swing, q, v, b - a, torque=torque[k])
        q, v = part.q[-1], part.v[-1]
        assert run.q[k + 1] == pytest.approx(q, abs=1e-15)
        assert run.v[k + 1] == pytest.approx(v, abs=1e-14)
    batch = taylor(swing, [[0.5], [1.0]], [0.0], 1.0, save=save, torque=np.stack([torque, 0 * torque]))
    assert np.array_equal(batch.q[0], run.q)
    assert np.array_equal(batch.q[1], taylor(swing, [1.0], [0.0], 1.0, save=save, torque=0 * torque).q)


def test_parameters_are_no_reason_to_compile_again(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    original = TaylorSystem._compiled
    monkeypatch.setattr(TaylorSystem, "_compiled", lambda *a: made.append(a) or original(*a))
    dyn = dynamics(catalog.pendulum(length=mb.Parameter("l", 1.0)), "lagrangian")
    lengths = np.array([0.5, 1.0, 2.0])
    batch = taylor(dyn.at(l=lengths), [1.0], [0.0], save=TIMES)
    for i, length in enumerate(lengths):
        literal = taylor(dynamics(catalog.pendulum(length=length), "lagrangian"), [1.0], [0.0], save=TIMES)
        assert batch.q[i] == pytest.approx(literal.q, abs=1e-13)
        again = taylor(dyn.at(l=float(length)), [1.0], [0.0], save=TIMES)
        assert np.array_equal(batch.q[i], again.q)
    assert len(made) == 1 + len(lengths)
    # Tolerances of one order make one run.
    assert order_of(1e-10) == order_of(1.1e-10)
    assert np.array_equal(
        taylor(dyn, [1.0], [0.0], rtol=1e-10, save=TIMES).q, taylor(dyn, [1.0], [0.0], rtol=1.1e-10, save=TIMES).q
    )
    assert len(made) == 2 + len(lengths)


def test_every_operation_of_a_derivation_has_its_expression() -> None:
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    outs = ca.vertcat(
        ca.fabs(x),
        ca.sign(x),
        x < y,
        ca.SX.binary(ca.OP_IF_ELSE_ZERO, x < y, x),
        -x,
        2 * x,
        x**2,
        1 / x,
        ca.sqrt(y),
        ca.sin(x),
        x / y,
    )
    made = program(ca.Function("f", [ca.vertcat(x, y)], [ca.densify(outs)]))
    functions, variables, values = _functions(hy), hy.make_vars("x", "y"), []
    for operation in made.operations:
        if operation.name == "input":
            values.append(variables[operation.arguments[1]])
        elif operation.name == "const":
            values.append(hy.expression(operation.value))
        else:
            values.append(functions[operation.name](*(values[i] for i in operation.arguments)))
    compiled = hy.cfunc([values[k] for k in made.outputs[0].ravel()], vars=variables)
    expected = ca.Function("g", [x, y], [outs])
    for point in ((-1.5, 2.0), (2.5, 0.5), (-0.25, 0.25)):
        assert compiled(np.array(point)) == pytest.approx(np.asarray(expected(*point))[:, 0], rel=4 * EPS)


# Events


def test_events_are_found_as_exactly_as_the_steps(swing: Any) -> None:
    model = swing.model
    with mp.workdps(30):
        quarter = float(mp.ellipk(mp.sin(mp.mpf(1)) ** 2) / mp.sqrt(mp.mpf(9.81)))
    run = taylor(swing, [2.0], [0.0], 5.0, save=[0.0, 5.0], events=at_section(model, "theta"))
    assert [hit.t for hit in run.events] == pytest.approx(np.arange(quarter, 5.0, 2 * quarter), abs=2e-14)
    assert run.stats.ended == "finished"
    end = taylor(swing, [2.0], [0.0], 5.0, events=at_section(model, "theta", terminal=True))
    assert end.stats.ended == "event"
    assert end.t[-1] == end.stats.reached == pytest.approx(quarter, abs=1e-14)
    assert end.q[-1] == pytest.approx([0.0], abs=1e-14)


def test_an_event_ends_one_of_a_batch(swing: Any) -> None:
    low = Event(lambda t, q, v: q[0] - 0.5, "low", direction=-1)
    run = taylor(swing, [[2.0], [0.3]], [0.0], save=TIMES, events=low)
    assert [(hit.name, hit.member) for hit in run.events] == [("low", 0)]
    reached = run.stats.reached
    assert isinstance(reached, tuple)
    assert reached[0] == run.events[0].t < reached[1] == 3.0
    assert np.array_equal(np.isfinite(run.q[0, :, 0]), run.t <= reached[0])


# Ends


@pytest.mark.parametrize("engine", ["lagrangian", "oracle"])
def test_a_diverging_run_keeps_what_it_has(engine: str) -> None:
    dyn = dynamics(slider(), engine)
    with pytest.warns(MbkitWarning, match="diverged: the state grew beyond all bounds after t = 1 s"):
        run = taylor(dyn, [0.0], [0.0], save=[0.0, 1.0, 2.0, 3.0], rtol=1e-10, torque=[[1.0], [1e120], [0.0]])
    assert run.stats.ended == "diverged"
    assert run.stats.reached == 1.0
    assert run.t.tolist() == [0.0, 1.0]
    assert run.q[:, 0] == pytest.approx([0.0, 0.5])


def test_a_singular_point_ends_the_run() -> None:
    """A spring's direction turns round where its length is zero; a series would go on as it was."""
    b = mounted("bead", "bead", "slide", "prismatic", gravity=(0, 0, 0), mass=1.0, axis=(1, 0, 0))
    b.add_spring("rubber", body_a="world", body_b="bead", stiffness=1.0, rest_length=0.5)
    dyn = dynamics(b.build(), "lagrangian")
    with pytest.warns(
        MbkitWarning, match=r"stopped where a force jumps, which a series cannot follow \(method='rk853' can\), after"
    ):
        run = taylor(dyn, [1.0], [-10.0], 1.0)
    assert run.stats.ended == "step_too_small"
    assert run.stats.reached < 0.11  # type: ignore[operator]
    passing = taylor(dyn, [1.0], [3.0], 0.3)
    assert passing.stats.ended == "finished"
    assert np.isfinite(run.q).all()
    assert np.isfinite(run.v).all()


# Bad input


def test_what_has_no_series_is_refused(swing: Any) -> None:
    with pytest.raises(UnsupportedError, match=r"torque.*rk853.*dop853"):
        taylor(swing, [1.0], [0.0], torque=lambda t, q, v: [0.0])
    with pytest.raises(UnsupportedError, match="not on the pinocchio engine"):
        taylor(dynamics(catalog.pendulum()), [1.0], [0.0])
    with pytest.raises(InputError, match="save: expected a grid of times for a batch"):
        taylor(swing, [[1.0], [2.0]], [0.0])
    with pytest.raises(InputError, match=r"rtol: expected at least 2.22e-16"):
        taylor(swing, [1.0], [0.0], rtol=1e-17)
    with pytest.raises(UnsupportedError, match="no 11-bit numbers"):
        precision(11)


def test_too_large_a_model_is_refused_before_it_is_derived(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mbkit.codegen.taylor._MAX_TAYLOR_OPERATIONS", 3)
    with pytest.raises(UnsupportedError, match=r"double_pendulum takes \d+ operations.*'rk853' or 'dop853'"):
        TaylorSystem(Equations(catalog.double_pendulum()))


def test_without_heyoka_it_is_told_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "heyoka", None)
    dyn = dynamics(catalog.cart_pole(), "lagrangian")
    with pytest.raises(UnsupportedError, match=r"heyoka is not installed; pip install heyoka.*rk853"):
        taylor(dyn, [0.0, 1.0], [0.0, 0.0])


def test_forces_of_the_time_alone_are_no_jumps() -> None:
    import sympy as sp

    x, u, t = sp.symbols("x u t")
    V = x * (sp.sqrt(2 + t) + (2 + t) ** sp.Float(1.7) + sp.atan2(1, 2 + t))
    lag = mb.lagrangian.Lagrangian(u**2 / 2, V, [x], [u], time=t)
    exact = simulate(lag.dynamics(options={"compile": False}), [0.0], [0.0], 1.0, "rk853", rtol=1e-13, save=[1.0])
    for engine in ("lagrangian", "oracle"):
        run = simulate(lag.dynamics(engine), [0.0], [0.0], 1.0, "taylor", rtol=1e-14, save=[1.0])
        assert run.stats.finished
        assert abs(run.q[0, 0] - exact.q[0, 0]) < 1e-12


@pytest.mark.skipif(not hasattr(hy, "real128"), reason="heyoka was built without quadruple numbers")
def test_a_number_beyond_all_doubles_is_infinite_without_a_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert rounded(np.array([1e300, 2.0]).astype(hy.real128) ** 2).tolist() == [np.inf, 4.0]
