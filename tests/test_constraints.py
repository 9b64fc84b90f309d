"""Constraints with multipliers and embedded: closed forms, each other, and what is refused."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp

import mbkit as mb
from mbkit.errors import (
    DoubtfulRunWarning,
    InputError,
    MbkitWarning,
    NumericalError,
    TorqueError,
    UnknownNameError,
    UnsupportedError,
)
from mbkit.lagrangian import Lagrangian
from mbkit.simulate import METHODS, Event
from validation.closed_forms import published

x, y, z, vx, vy, m, ell, g, t = sp.symbols("x y z vx vy m l g t")
th, w, a, Om = sp.symbols("theta omega a Omega")
NUMBERS = {m: 2.0, ell: 1.5, g: 9.81}
# Rounding of states of size 1 and speeds of some 10.
DRIFT = 1e-13
OWN = {"compile": False}


def pendulum(**more) -> Lagrangian:
    rod = (x**2 + y**2 - ell**2) / 2
    given = {"parameters": NUMBERS, "constraints": [rod], "name": "pendulum", **more}
    return Lagrangian(m * (vx**2 + vy**2) / 2, m * g * y, [x, y], [vx, vy], **given)


def by_angle() -> Lagrangian:
    return Lagrangian(m * ell**2 * w**2 / 2, -m * g * ell * sp.cos(th), [th], [w], parameters=NUMBERS)


def on_circle(angle, rate):
    s, c = np.sin(angle), np.cos(angle)
    return 1.5 * np.array([s, -c]), 1.5 * np.array([c, s]) * rate


@pytest.fixture(scope="module")
def rod():
    return pendulum()


def drift(lag, run):
    """Return the largest |f| and |J v + ∂f/∂t| of a run, of constraints that end on the time."""
    f, rate = [], []
    for s, q, v in zip(run.t, run.q, run.v, strict=True):
        f.append(np.abs(lag.constraint(q, t=s)).max())
        h = 1e-6
        by_time = (lag.constraint(q, t=s + h) - lag.constraint(q, t=s - h)) / (2 * h)
        rate.append(np.abs(lag.constraint_jacobian(q, t=s) @ v + by_time).max())
    return max(f), max(rate)


# Multipliers


def test_multiplier_is_the_tension_of_the_rod(rod):
    for angle, rate in ((0.0, 0.0), (0.4, 1.3), (2.5, -2.0)):
        q, v = on_circle(angle, rate)
        tension = 2.0 * (1.5 * rate**2 + 9.81 * np.cos(angle))
        # Jᵀ λ points along the rod, of length l, outwards.
        assert np.allclose(rod.multipliers(q, v) * 1.5, -tension, rtol=0, atol=1e-13)
        a_t = -9.81 * np.sin(angle)
        expected = a_t * np.array([np.cos(angle), np.sin(angle)]) - 1.5 * rate**2 * np.array(
            [np.sin(angle), -np.cos(angle)]
        )
        assert np.allclose(rod.dynamics(options=OWN).forward_dynamics(q, v, [0, 0]), expected, rtol=0, atol=1e-13)


def test_applied_force_enters_the_multiplier(rod):
    q, v = on_circle(0.3, 0.5)
    along = q / 1.5
    assert np.allclose(rod.multipliers(q, v, 7.0 * along) * 1.5, rod.multipliers(q, v) * 1.5 - 7.0, rtol=0, atol=1e-13)
    many = rod.multipliers(np.tile(q, (3, 1)), np.tile(v, (3, 1)))
    assert many.shape == (3, 1)
    assert rod.multipliers(q, v, m=4.0)[0] == pytest.approx(2 * rod.multipliers(q, v)[0], rel=1e-14)


def test_equations_show_multipliers_and_the_constraint(rod):
    e = rod.equations()
    assert str(e).splitlines() == ["m*vxdot = lambda1*x", "m*vydot + g*m = lambda1*y", "x**2/2 + y**2/2 - l**2/2 = 0"]
    assert e.constraint_acceleration == sp.Matrix([vx**2 + vy**2])
    driven = pendulum(constraints=[(x - sp.sin(t)) ** 2 + y**2 - ell**2], time=t).equations()
    f = (x - sp.sin(t)) ** 2 + y**2 - ell**2
    X, Y = sp.Function("X")(t), sp.Function("Y")(t)
    second = f.subs({x: X, y: Y}).diff(t, 2)
    plain = {X.diff(t, 2): 0, Y.diff(t, 2): 0}
    named = [(X.diff(t), vx), (Y.diff(t), vy), (X, x), (Y, y)]
    assert sp.simplify(second.subs(plain).subs(named) - driven.constraint_acceleration[0]) == 0


# Drift


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("method", [n for n, k in METHODS.items() if not k.engines or "lagrangian" in k.engines])
def test_every_method_stays_on_the_constraints(rod, method):
    if method == "taylor":
        pytest.importorskip("heyoka")
    q, v = on_circle(1.0, 0.3)
    dyn = rod.dynamics(options=OWN)
    kind = METHODS[method]
    grid = np.linspace(0, 2.0, 21)
    how = {"dt": 0.01} if kind.kind == "fixed" else {"rtol": 1e-8}
    run = mb.simulate(dyn, q, v, 2.0, method, save=grid, **how)
    assert max(drift(rod, run)) < DRIFT
    exact = mb.simulate(by_angle().dynamics(options=OWN), [1.0], [0.3], 2.0, "dop853", rtol=1e-13, save=grid)
    error = np.abs(run.q - 1.5 * np.column_stack([np.sin(exact.q[:, 0]), -np.cos(exact.q[:, 0])])).max()
    # Of the methods' own order: Euler's of first order is the coarse one.
    assert error < {
        "semi_implicit_euler": 0.1,
        "moreau": 0.1,
        "implicit_midpoint": 1e-3,
        "bdf": 1e-5,
        "lsoda": 1e-5,
    }.get(method, 1e-6)


def test_projection_leaves_the_order_of_a_method(rod):
    q, v = on_circle(1.0, 0.3)
    exact = mb.simulate(by_angle().dynamics(options=OWN), [1.0], [0.3], 1.0, "dop853", rtol=1e-13, save=[1.0]).q[0, 0]
    errors = []
    for dt in (0.02, 0.01):
        run = mb.simulate(rod.dynamics(options=OWN), q, v, 1.0, "rk4", dt=dt, save=[1.0])
        errors.append(np.abs(run.q[0] - on_circle(exact, 0)[0]).max())
    assert 3.5 < np.log2(errors[0] / errors[1]) < 4.7


def test_batches_with_parameters_of_their_own():
    lag = pendulum(parameters={m: 2.0, ell: 1.5, g: None})
    own = lag.dynamics(options=OWN).at(g=np.array([9.81, 1.62]))
    q, v = on_circle(0.5, 0.0)
    for method in ("rk4", "rk853", "dop853"):
        how = {"dt": 0.01} if method == "rk4" else {}
        run = mb.simulate(own, np.tile(q, (2, 1)), np.tile(v, (2, 1)), 0.5, method, save=[0.0, 0.5], **how)
        assert np.abs((run.q**2).sum(axis=-1) - 1.5**2).max() < 1e-14
        alone = mb.simulate(lag.dynamics(options=OWN).at(g=1.62), q, v, 0.5, method, save=[0.0, 0.5], **how)
        assert np.abs(run.q[1] - alone.q).max() < 1e-12


# Consistent states


def test_project_returns_the_nearest_state():
    # An ellipse, in the metric of masses 1 and 4: the foot is stationary.
    lag = Lagrangian(
        (vx**2 + 4 * vy**2) / 2, 0, [x, y], [vx, vy], constraints=[x**2 / 4 + y**2 - 1], name="bead on an ellipse"
    )
    start = np.array([1.2, 1.1])
    q, v = lag.project(start, [1.0, 1.0])
    J, M = lag.constraint_jacobian(q)[0], np.diag([1.0, 4.0])
    # Of sums of terms of size 1.
    assert abs(lag.constraint(q)[0]) < 1e-14
    assert abs(J @ v) < 1e-14
    tangent = np.array([-J[1], J[0]])
    assert abs(tangent @ M @ (q - start)) < 1e-12
    assert abs(tangent @ M @ (v - [1.0, 1.0])) < 1e-12
    angles = np.linspace(0, 2 * np.pi, 100_001)
    around = np.column_stack([2 * np.cos(angles), np.sin(angles)]) - start
    assert (q - start) @ M @ (q - start) <= np.einsum("ni,ij,nj->n", around, M, around).min() + 1e-12


@pytest.mark.parametrize("on", ["multipliers", "embedded"])
def test_inconsistent_starts_are_refused_with_residuals(rod, on):
    dyn = rod.dynamics(options=OWN) if on == "multipliers" else rod.embedded()
    with pytest.raises(InputError, match=r"q0: .*constraints\[0\].* by -0\.125; project\("):
        mb.simulate(dyn, [1.0, 1.0], [0.0, 0.0], 1.0, "rk853")
    with pytest.raises(InputError, match=r"v0: .*constraints\[0\].* by -1\.5 per second; project\("):
        mb.simulate(dyn, [0.0, -1.5], [0.0, 1.0], 1.0, "rk853")
    mb.simulate(dyn, *rod.project([1.0, 1.0], [0.0, 1.0]), 0.01, "rk853")


def test_far_from_every_consistent_state():
    lag = pendulum(constraints=[x**2 + y**2 - ell**2])
    with pytest.raises(InputError, match="no consistent state"):
        lag.project([0.0, 0.0], [0.0, 0.0])
    with pytest.raises(UnsupportedError, match="constraints="):
        by_angle().project([0.0], [0.0])


# Sets that are none


def four_bar(*more) -> Lagrangian:
    """Three links between two pivots; the loop closes in x and y."""
    q1, q2, q3, u1, u2, u3 = sp.symbols("q1 q2 q3 u1 u2 u3")
    loop = [
        sp.cos(q1) + 2 * sp.cos(q2) - sp.Rational(3, 2) * sp.cos(q3) - 2,
        sp.sin(q1) + 2 * sp.sin(q2) - sp.Rational(3, 2) * sp.sin(q3),
    ]
    T = (u1**2 + 2 * u2**2 + u3**2 + u1 * u2 * sp.cos(q1 - q2)) / 2
    V = g * (sp.sin(q1) + sp.sin(q3))
    extra = [f(*loop, q1) for f in more]
    return Lagrangian(T, V, [q1, q2, q3], [u1, u2, u3], parameters={g: 9.81}, constraints=[*loop, *extra], name="bars")


def test_redundant_rows_are_named():
    # Along the first link the loop closes too: another row only where the first two hold.
    lag = four_bar(lambda cx, cy, q1: cx * sp.cos(q1) + cy * sp.sin(q1))
    with pytest.raises(InputError, match=r"redundant.*constraints\[.\].*follows from constraints\[.\]"):
        lag.project([0.5, 0.3, 1.0], np.zeros(3))
    with pytest.raises(InputError, match="redundant"):
        mb.simulate(lag.dynamics(options=OWN), [0.5, 0.3, 1.0], np.zeros(3), 1.0)


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        ([x + y, 2 * x + 2 * y], r"constraints\[1\] \(2\*x \+ 2\*y\) follows from constraints\[0\] \(x \+ y\)"),
        ([x + y, x + y - 1], r"constraints\[0\].*constraints\[1\].*contradict each other"),
        ([x**2 + 1], r"constraints\[0\] \(x\*\*2 \+ 1\) cannot hold"),
        ([(x - y) ** 2], r"constraints\[0\] .* has no slope where it holds"),
        ([sp.sin(x) ** 2 + sp.cos(x) ** 2 - 1], "holds by itself"),
        # With a slope that is rounding wherever it is looked at.
        ([32 * (sp.sin(2 * x + y) - sp.sin(2 * x) * sp.cos(y) - sp.cos(2 * x) * sp.sin(y))], "holds by itself"),
    ],
)
def test_rows_are_named_wherever_they_are_met(rows, told):
    lag = pendulum(constraints=rows)
    asked = [
        lambda: lag.dynamics(options=OWN).forward_dynamics([0, 0], [0, 0], [0, 0]),
        lambda: lag.multipliers([0, 0], [0, 0]),
        lambda: lag.project([0, 0], [0, 0]),
        lambda: mb.simulate(lag.dynamics(options=OWN), [0, 0], [0, 0], 1.0),
        lambda: mb.equilibrium(lag.dynamics(options=OWN)),
    ]
    if len(rows) == 1:
        asked.append(lambda: mb.simulate(lag.embedded(), [0, 0], [0, 0], 1.0))
    for ask in asked:
        with pytest.raises(InputError, match=told):
            ask()


def test_a_square_that_is_nearly_zero_is_told_from_a_row_that_bends():
    # A search for its zero ends at √eps, where its slope is small and not zero.
    with pytest.raises(InputError, match=r"constraints\[0\] .* has no slope where it holds"):
        pendulum(constraints=[(x - y) ** 2]).project([0.3, 0.0], [0.0, 0.0])
    # Beside x = 0 its slope is a million times that where it holds: x stays, and y falls freely.
    bends = pendulum(constraints=[x + 10**7 * x**3])
    assert bends.project([0.0, 0.5], [0.0, 0.0])[0] == pytest.approx([0.0, 0.5], abs=1e-15)
    # A row in tiny units has a slope, if a small one.
    assert pendulum(constraints=[5e-14 * (x - y)]).project([0.3, 0.1], [0.0, 0.0])[0] == pytest.approx([0.2, 0.2])


def test_rows_that_a_late_value_makes_the_same_are_named():
    lag = pendulum(constraints=[x + y, x + a * y], parameters={**NUMBERS, a: None})
    with pytest.raises(InputError, match=r"follows from constraints\[0\]"):
        lag.dynamics(options=OWN).at(a=1.0).forward_dynamics([0, 0], [0, 0], [0, 0])
    contradictory = pendulum(constraints=[x + y, x + y - 1]).model
    with pytest.raises(InputError, match="contradict each other"):
        contradictory.random_state(np.random.default_rng(0))


def test_several_states_are_projected_at_once(rod):
    q, v = np.array([[1.0, -1.0], [0.5, -2.0]]), np.array([[1.0, 0.0], [0.0, 1.0]])
    both = rod.project(q, v)
    for i in range(2):
        assert np.array_equal([part[i] for part in both], rod.project(q[i], v[i]))


def test_too_many_rows_and_a_gap_that_nothing_closes_are_named():
    with pytest.raises(InputError, match="3 of them for 2 coordinates"):
        pendulum(constraints=[x, y, x + y]).project([0, 0], [0, 0])
    # Too long a gap for these links.
    gap = sp.Symbol("gap")
    q1, q2 = sp.symbols("q1 q2")
    arm = Lagrangian(
        (vx**2 + vy**2) / 2, 0, [q1, q2], [vx, vy], parameters={gap: 2.5}, constraints=[sp.cos(q1) + sp.cos(q2) - gap]
    )
    with pytest.raises(InputError, match=r"constraints\[0\].*cannot hold.*0\.[0-9]"):
        arm.project([0.1, 0.1], [0, 0])
    assert np.abs(arm.constraint(arm.project([0.1, 0.1], [0, 0], gap=1.5)[0], gap=1.5)).max() < 1e-14


# Embedded


def test_embedded_is_the_same_motion_and_the_closed_form(rod):
    # Over the top and round: the choice of the coordinate has to change.
    q, v = on_circle(0.1, 8.0 / 1.5)
    save = np.linspace(0, 1.0, 6)
    own = mb.simulate(rod.embedded(), q, v, 1.0, "rk853", rtol=1e-14, save=save)
    other = mb.simulate(rod.dynamics(options=OWN), q, v, 1.0, "rk853", rtol=1e-14, save=save)
    exact = mb.simulate(by_angle().dynamics(options=OWN), [0.1], [8.0 / 1.5], 1.0, "dop853", rtol=3e-14, save=save)
    places = 1.5 * np.column_stack([np.sin(exact.q[:, 0]), -np.cos(exact.q[:, 0])])
    assert np.abs(own.q - other.q).max() < 1e-11
    assert np.abs(own.v - other.v).max() < 1e-10
    assert np.abs(own.q - places).max() < 1e-11
    assert np.array_equal(own.t, save)
    assert max(drift(rod, own)) < DRIFT
    chosen = [hit.name for hit in own.events]
    assert chosen == ["independent: x", "independent: y", "independent: x"]
    assert np.ptp(own.energy()) < 1e-10


def test_embedded_takes_torques_and_events_on_all_coordinates(rod):
    def torque(_t, q, v):
        return np.array([0.5 * v[1], -0.5 * v[0]]) + 0.1 * q[0]

    q, v = on_circle(0.4, 0.5)
    event = Event(lambda _t, q, _v: q[0], "plumb")
    own = mb.simulate(rod.embedded(), q, v, 3.0, "rk853", rtol=1e-12, torque=torque, events=event)
    other = mb.simulate(rod.dynamics(options=OWN), q, v, 3.0, "rk853", rtol=1e-12, torque=torque, events=event)
    assert own.stats.ended == other.stats.ended == "event"
    assert own.stats.reached == pytest.approx(other.stats.reached, abs=1e-10)
    assert own.t[-1] == own.stats.reached
    assert abs(own.q[-1, 0]) < 1e-12
    held = mb.simulate(rod.embedded(), q, v, 0.5, "rk853", rtol=1e-12, torque=[1.0, 2.0], save=[0.5])
    same = mb.simulate(rod.dynamics(options=OWN), q, v, 0.5, "rk853", rtol=1e-12, torque=[1.0, 2.0], save=[0.5])
    assert np.abs(held.q - same.q).max() < 1e-10


@pytest.mark.thorough("gauss6-setting1-5e-07")
@pytest.mark.parametrize(
    ("method", "setting", "close"), [("rk853", {"rtol": 1e-11}, 1e-9), ("gauss6", {"dt": 0.02}, 5e-7)]
)
def test_embedded_holds_samples_and_tables_from_chart_to_chart(rod, method, setting, close):
    """SciPy solves for the angle from jump to jump of the force; the choice of the coordinate changes between them."""

    def law(s, q, v):
        if s > 0.45:
            raise ValueError("no more")
        return np.array([np.sin(9 * s) - 0.3 * v[0], 2 + 0.2 * q[0]])

    state, forces, states = np.array([0.1, 8.0 / 1.5]), [], []
    for k in range(5):
        forces.append(law(0.1 * k, *on_circle(*state)))

        def rates(_s, y, force=forces[k]):
            along = force @ [np.cos(y[0]), np.sin(y[0])]
            return y[1], along / (2.0 * 1.5) - 9.81 / 1.5 * np.sin(y[0])

        state = solve_ivp(rates, (0.0, 0.1), state, method="DOP853", rtol=3e-14, atol=1e-14).y[:, -1]
        states.append(on_circle(*state)[0])
    start, save = on_circle(0.1, 8.0 / 1.5), 0.1 * np.arange(6)
    run = mb.simulate(rod.embedded(), *start, 0.5, method, torque=law, hold=0.1, save=save, **setting)
    assert np.abs(run.q[1:] - states).max() < close
    assert np.abs(run.tau[:-1] - forces).max() < 10 * close
    assert [hit.name for hit in run.events] == ["independent: x", "independent: y"]
    assert run.check()
    rows = np.repeat(forces, 1 if "rtol" in setting else 5, axis=0)
    table = mb.simulate(rod.embedded(), *start, 0.5, method, torque=rows, save=save, **setting)
    assert np.abs(table.q[1:] - states).max() < close
    assert np.abs(table.power_balance()).max() < 1e3 * close
    with pytest.raises(TorqueError, match=r"ValueError at t = 0\.5 s: no more") as failed:
        mb.simulate(rod.embedded(), *start, 0.6, method, torque=law, hold=0.1, **setting)
    assert failed.value.trajectory.stats.reached == pytest.approx(0.5)
    with pytest.raises(TorqueError, match=r"^torque: the callable raised ValueError at t = 0\.4.* s: no more"):
        mb.simulate(rod.embedded(), *start, 0.6, method, torque=law, **setting)


def test_a_choice_that_stays_ends_at_its_singular_pose(rod):
    q, v = on_circle(0.1, 8.0 / 1.5)
    with pytest.warns(MbkitWarning, match="singular pose at t = 0.3071"):
        run = mb.simulate(rod.embedded([x]), q, v, 1.0, "rk853")
    assert run.stats.ended == "step_too_small"
    assert "x no longer" in run.stats.message
    assert run.t[-1] == pytest.approx(0.3071, abs=1e-3)
    assert run.events[-1].name == "near a singular pose"
    with pytest.warns(MbkitWarning, match="near a singular pose at t = 0.0"):
        steps = mb.simulate(rod.embedded([x]), *on_circle(1.5, 2.0), 0.1, "rk4", dt=1e-4)
    assert steps.stats.ended == "step_too_small"
    assert "x no longer" in steps.stats.message
    assert steps.t[-1] == steps.stats.reached == steps.events[-1].t
    assert steps.stats.evaluations == 4 * steps.stats.steps
    assert steps.q[-1, 0] == pytest.approx(1.5, abs=1e-6)
    with pytest.raises(InputError, match="singular pose"):
        mb.simulate(rod.embedded(["x"]), [1.5, 0.0], [0.0, 1.0], 1.0, "rk853")


def row_of_bars(N):
    """N unit squares of equal rods side by side, upright and pushed: as one parallelogram, or as N rhombs that fold."""
    angles, rates = sp.symbols(f"a0:{N + 1}"), sp.symbols(f"u0:{N + 1}")
    couplers, turns = sp.symbols(f"c1:{N + 1}"), sp.symbols(f"w1:{N + 1}")
    T = sum(u**2 for u in rates) / 6
    V = g * sum(map(sp.sin, angles)) / 2
    rows = []
    for k in range(N):
        T += rates[k] ** 2 / 2 + turns[k] ** 2 / 6 + rates[k] * turns[k] * sp.cos(angles[k] - couplers[k]) / 2
        V += g * (sp.sin(angles[k]) + sp.sin(couplers[k]) / 2)
        rows += [f(angles[k]) + f(couplers[k]) - f(angles[k + 1]) for f in (sp.cos, sp.sin)]
        rows[-2] -= 1
    lag = Lagrangian(
        T, V, [*angles, *couplers], [*rates, *turns], parameters={g: 9.81}, constraints=rows, name=f"{N} four-bars"
    )
    # The parallelogram alone.
    one = Lagrangian(
        (sp.Rational(N + 1, 3) + N) * w**2 / 2, g * (sp.Rational(N + 1, 2) + N) * sp.sin(th), [th], [w],
        parameters={g: 9.81},
    )  # fmt: skip
    return lag, one, np.r_[np.full(N + 1, np.pi / 2), np.zeros(N)], np.r_[-np.ones(N + 1), np.zeros(N)]


def test_reproducible_is_judged_where_the_motion_is():
    # Random poses of such a row all close on branches where the constraints depend on each other.
    lag, one, q, v = row_of_bars(6)
    tau = np.zeros(13)
    tau[0] = 1.0
    own = lag.dynamics(options=OWN).forward_dynamics(q, v, tau)
    assert np.abs(own - lag.dynamics("oracle").forward_dynamics(q, v, tau)).max() < 1e-13
    assert own[0] == pytest.approx(one.dynamics(options=OWN).forward_dynamics([np.pi / 2], [-1.0], [1.0])[0], rel=1e-13)
    # In line, they depend on each other there alone.
    flat = np.zeros(13)
    for ask in (
        lambda: lag.multipliers(flat, 0 * flat),
        lambda: mb.simulate(lag.dynamics(options=OWN), flat, 0 * flat, 1.0),
    ):
        with pytest.raises((InputError, NumericalError), match=r"constraints\[.*\]"):
            ask()


def test_runs_go_through_singular_poses_and_name_them():
    lag, one, q, v = row_of_bars(2)
    save = np.array([1.0, 2.0, 5.0])
    level = Event(lambda _t, q, _v: np.sin(q[0]), "level", terminal=False)
    exact = mb.simulate(one.dynamics(options=OWN), q[:1], v[:1], 5.0, "dop853", rtol=1e-13, save=save, events=level)
    first = exact.events[0].t
    cases = [("auto", 1e-10, 1e-8), ("dop853", 1e-10, 1e-6)]
    for method, rtol, close in cases:
        with pytest.warns(DoubtfulRunWarning, match="singular pose"):
            run = mb.simulate(lag.dynamics(options=OWN), q, v, 5.0, method, rtol=rtol, save=save)
        assert run.stats.finished
        assert np.abs(run.q[:, :3] - exact.q).max() < close
        (told,) = run.stats.doubts
        assert float(told.split("t = ")[1].split(",")[0]) == pytest.approx(first, abs=1e-3)
    # On independent coordinates too, and telling how far it is.
    calls = []
    with pytest.warns(MbkitWarning, match="singular pose"):
        run = mb.simulate(lag.embedded(), q, v, 2.0, "rk853", rtol=1e-9, save=save[:2], progress=calls.append)
    assert run.stats.finished
    assert calls[-1] == 1.0
    assert np.abs(run.q[:, :3] - exact.q[:2]).max() < 1e-7


def test_light_and_massless_links_keep_their_digits():
    for light in (1e-9, 1e-12, 0.0):
        lag = massive_slider_crank().substituted({m2: light})
        q, v = lag.project([0.7, 0.2, 0.37], [1.0, 0.0, 0.0])
        own, exact = (
            d.forward_dynamics(q, v, np.zeros(3)) for d in (lag.dynamics(options=OWN), lag.dynamics("oracle"))
        )
        assert np.abs(own - exact).max() < 1e-14 * np.abs(exact).max()
    # A light body on a heavy one, and beside one that has nothing to do with it.
    for on in (z, 0):
        T = (vx**2 + vy**2 + a * sp.Symbol("vz") ** 2) / 2
        lag = Lagrangian(T, g * y, [x, y, z], [vx, vy, sp.Symbol("vz")], parameters={g: 9.81, a: 1e10},
                         constraints=[((x - on) ** 2 + y**2 - 1) / 2])  # fmt: skip
        state = lag.project([0.6, -0.8, 0.0], [1.0, 0.75, 0.0])
        own, exact = (
            d.forward_dynamics(*state, np.zeros(3)) for d in (lag.dynamics(options=OWN), lag.dynamics("oracle"))
        )
        assert np.abs(own - exact).max() < 1e-14 * np.abs(exact).max()


def test_a_slider_crank_of_equal_links_goes_through_its_singular_pose():
    # At a right angle of the crank the slider is at the pivot, and may stay there.
    lag, q, v = equal_slider_crank(angle=1.0, rate=1.0)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        run = mb.simulate(lag.embedded(), q, v, 0.8, "rk853", rtol=1e-9)
    near, *_ = (str(w.message) for w in told if issubclass(w.category, MbkitWarning))
    assert "near a singular pose at t = 0.63" in near
    assert run.stats.finished
    # The motion goes on with its velocity: the slider does not stay.
    assert run.q[-1, 0] > np.pi / 2 + 0.1
    assert run.q[-1, 2] == pytest.approx(0.6 * np.cos(run.q[-1, 0]), abs=1e-9)
    assert np.ptp(run.energy()) < 1e-9
    (near,) = (hit for hit in run.events if hit.name == "near a singular pose")
    assert near.q[0] == pytest.approx(np.pi / 2, abs=0.01)


def test_embedded_refuses_what_it_cannot_do(rod):
    with pytest.raises(UnsupportedError, match="rk853"):
        mb.simulate(rod.embedded(), [0.0, -1.5], [0.0, 0.0], 1.0, "taylor")
    with pytest.raises(UnknownNameError):
        rod.embedded(["z"])
    with pytest.raises(InputError, match="expected 1 of x, y"):
        rod.embedded([x, y])
    with pytest.raises(InputError, match="leave none"):
        pendulum(constraints=[x, y]).embedded()
    event = Event(lambda _t, q, _v: q[0], "plumb")
    with pytest.raises(UnsupportedError, match="events"):
        mb.simulate(rod.embedded(), [0.0, -1.5], [0.0, 0.0], 0.1, "rk4", events=event)
    with pytest.raises(InputError, match="q0"):
        mb.simulate(rod.embedded(), np.zeros((2, 2)), np.zeros((2, 2)), 1.0, "rk853")


# Slider-cranks


L1, L2, m1, m2, m3, M0 = sp.symbols("L1 L2 m1 m2 m3 M0")
psi, ups, ux = sp.symbols("psi upsilon u")


def slider_crank_numbers():
    told = published()["rigid_slider_crank"]
    return told, {L1: told["L1"], L2: told["L2"], m1: told["m1"], m2: told["m2"], m3: told["m3"], M0: told["torque"]}


def massive_slider_crank() -> Lagrangian:
    """Crank angle, rod angle and slider, each link a uniform bar."""
    vx2 = -L1 * sp.sin(th) * w - L2 / 2 * sp.sin(psi) * ups
    vy2 = L1 * sp.cos(th) * w - L2 / 2 * sp.cos(psi) * ups
    T = m1 * L1**2 / 3 * w**2 / 2 + m2 * (vx2**2 + vy2**2) / 2 + m2 * L2**2 / 12 * ups**2 / 2 + m3 * ux**2 / 2
    return Lagrangian(
        T,
        0,
        [th, psi, x],
        [w, ups, ux],
        forces={th: M0},
        parameters=slider_crank_numbers()[1],
        constraints=[L1 * sp.cos(th) + L2 * sp.cos(psi) - x, L1 * sp.sin(th) - L2 * sp.sin(psi)],
        name="slider_crank",
    )


def equal_slider_crank(angle, rate):
    lag = massive_slider_crank()
    lag = lag.substituted({L1: 0.3, L2: 0.3, M0: 0})
    q = np.array([angle, angle, 0.6 * np.cos(angle)])
    return lag, q, np.array([rate, rate, -0.6 * np.sin(angle) * rate])


def one_degree_slider_crank() -> Lagrangian:
    """The closed form J(θ) of the printed formula."""
    s, c, la = sp.sin(th), sp.cos(th), L1 / L2
    root = sp.sqrt(1 - la**2 * s**2)
    x2, y2 = -L1 * s - L1 * la * s * c / (2 * root), L1 * c / 2
    x3, turn = -L1 * s - L1 * la * s * c / root, -la * c / root
    J = m1 * L1**2 / 12 + m1 * L1**2 / 4 + m2 * (x2**2 + y2**2) + m2 * L2**2 / 12 * turn**2 + m3 * x3**2
    return Lagrangian(J * w**2 / 2, 0, [th], [w], forces={th: M0}, parameters=slider_crank_numbers()[1])


@pytest.mark.thorough
def test_slider_crank_with_massive_links_reaches_the_printed_digits():
    told, _ = slider_crank_numbers()
    exact = np.array([float(s) for s in told["exact_t3_theta_thetadot"]])
    J = one_degree_slider_crank().dynamics(options={"compile": True})
    assert J.mass_matrix([0.0])[0, 0] == pytest.approx(told["J0"], rel=1e-14)
    assert J.mass_matrix([np.pi / 2])[0, 0] == pytest.approx(told["J_half_pi"], rel=1e-14)
    # 19 turns at 100 rad/s: relative to these, tolerances of each step add up to a billionth.
    one = mb.simulate(J, [0.0], [0.0], 3.0, "rk853", rtol=1e-12, save=[3.0])
    assert np.abs(np.array([one.q[0, 0], one.v[0, 0]]) - exact).max() < 1e-7
    lag = massive_slider_crank()
    many = mb.simulate(lag.dynamics(options=OWN), [0, 0, 0.4], [0, 0, 0], 3.0, "rk853", rtol=1e-11, save=[1.5, 3.0])
    assert np.abs(np.array([many.q[1, 0], many.v[1, 0]]) - exact).max() < 1e-7
    assert max(drift(lag, many)) < 1e-12
    embedded = mb.simulate(lag.embedded(), [0, 0, 0.4], [0, 0, 0], 0.4, "rk853", rtol=1e-11, save=[0.2, 0.4])
    alone = mb.simulate(J, [0.0], [0.0], 0.4, "rk853", rtol=1e-12, save=[0.2, 0.4])
    assert np.abs(embedded.q[:, 0] - alone.q[:, 0]).max() < 1e-9
    assert max(drift(lag, embedded)) < 1e-12


def massless_slider_crank(F=0) -> Lagrangian:
    """Piston alone has mass: crank and rod angle move none."""
    tau = sp.Symbol("tau")
    return Lagrangian(
        m * ux**2 / 2,
        0,
        [th, psi, x],
        [w, ups, ux],
        forces={th: tau, x: -F},
        parameters={m: 2.0, L1: 0.1, L2: 0.3},
        constraints=[L1 * sp.cos(th) + L2 * sp.cos(psi) - x, L1 * sp.sin(th) - L2 * sp.sin(psi)],
        name="massless_slider_crank",
    )


def piston_form(F=0) -> Lagrangian:
    """J = m r² sin²(θ+φ)/cos²φ, and τ with the force's virtual work."""
    phi = sp.asin(L1 / L2 * sp.sin(th))
    by_angle_ = -L1 * sp.sin(th + phi) / sp.cos(phi)
    J = m * L1**2 * sp.sin(th + phi) ** 2 / sp.cos(phi) ** 2
    return Lagrangian(
        J * w**2 / 2, 0, [th], [w], forces={th: -F * by_angle_}, parameters={m: 2.0, L1: 0.1, L2: 0.3}, name="piston"
    )


def test_massless_slider_crank_is_the_classic_equation():
    lag, one = massless_slider_crank(F=40), piston_form(F=40)
    own, alone = lag.dynamics(options=OWN), one.dynamics(options=OWN)
    for angle, rate, tau in ((0.7, 2.0, 0.4), (2.0, -3.0, 0.0), (-1.0, 0.0, 1.0)):
        lean = np.arcsin(np.sin(angle) / 3)
        q = np.array([angle, lean, 0.1 * np.cos(angle) + 0.3 * np.cos(lean)])
        v = np.linalg.lstsq(np.vstack([lag.constraint_jacobian(q), [1.0, 0, 0]]), np.array([0, 0, rate]), rcond=None)[0]
        a = own.forward_dynamics(q, v, [tau, 0, 0])[0]
        assert a == pytest.approx(alone.forward_dynamics([angle], [rate], [tau])[0], rel=1e-11)
    run = mb.simulate(own, q, v, 0.05, "rk853", rtol=1e-12, save=[0.05])
    same = mb.simulate(alone, q[:1], v[:1], 0.05, "rk853", rtol=1e-12, save=[0.05])
    assert np.abs(run.q[0, 0] - same.q[0, 0]) < 1e-9


def test_dead_centre_of_the_massless_slider_crank_is_told():
    with pytest.raises(NumericalError, match="theta"):
        piston_form().dynamics(options=OWN).forward_dynamics([0.0], [1.0], [1.0])
    # Whatever energy the piston has, the massless crank reaches the dead centre at infinite speed.
    with pytest.warns(MbkitWarning, match="step|diverged"):
        run = mb.simulate(piston_form().dynamics(options=OWN), [2.0], [5.0], 2.0, "rk853", rtol=1e-8)
    assert not run.stats.finished
    assert run.q[-1, 0] == pytest.approx(np.pi, abs=1e-3)
    assert run.v[-1, 0] > 100.0


# Time


def test_bead_on_a_driven_hoop_by_multipliers_and_embedded():
    """A hoop whose plane turns by Ω t: in space with two constraints, and on the hoop by its angle."""
    vz = sp.Symbol("vz")
    R = sp.Symbol("R")
    numbers = {m: 1.0, g: 9.81, R: 1.0, Om: 5.0}
    lag = Lagrangian(
        m * (vx**2 + vy**2 + vz**2) / 2,
        m * g * z,
        [x, y, z],
        [vx, vy, vz],
        time=t,
        parameters=numbers,
        constraints=[x**2 + y**2 + z**2 - R**2, x * sp.sin(Om * t) - y * sp.cos(Om * t)],
        name="bead on a hoop",
    )
    one = Lagrangian(
        m * R**2 * (w**2 + Om**2 * sp.sin(th) ** 2) / 2, -m * g * R * sp.cos(th), [th], [w], parameters=numbers
    )
    q, v = np.array([np.sin(0.4), 0.0, -np.cos(0.4)]), np.array([0.0, 5.0 * np.sin(0.4), 0.0])
    save = np.linspace(0, 1.0, 5)
    hoop = mb.simulate(one.dynamics(options=OWN), [0.4], [0.0], 1.0, "dop853", rtol=1e-13, save=save).q[:, 0]
    places = np.column_stack([np.sin(hoop) * np.cos(5 * save), np.sin(hoop) * np.sin(5 * save), -np.cos(hoop)])
    for dyn in (lag.dynamics(options=OWN), lag.embedded()):
        run = mb.simulate(dyn, q, v, 1.0, "rk853", rtol=1e-12, save=save)
        assert np.abs(run.q - places).max() < 1e-9
        # ∂f/∂t is of differences there.
        assert drift(lag, run)[0] < DRIFT
        assert drift(lag, run)[1] < 1e-8
    with pytest.raises(InputError, match="v0"):
        mb.simulate(lag.dynamics(options=OWN), q, np.zeros(3), 1.0, "rk853")
    assert np.abs(lag.project(q, np.zeros(3))[1] - v).max() < 1e-13


@pytest.mark.thorough("dynamics-gauss4", "embedded-rk4", "embedded-rk853")
@pytest.mark.parametrize(
    ("form", "method"),
    [("dynamics", method) for method in ("rk4", "gauss4", "dop853")] + [("embedded", "rk4"), ("embedded", "rk853")],
)
def test_a_start_time_shifts_all_times_of_a_constrained_run(form, method):
    """A pendulum in two coordinates, of which the independent one changes; blocks of steps end at rounded times."""
    x, y, u, w = sp.symbols("x y u w")
    lag = Lagrangian((u**2 + w**2) / 2, 9.81 * y, [x, y], [u, w], constraints=[x**2 + y**2 - 1])
    dyn, start = getattr(lag, form)(), ([np.sin(1.0), -np.cos(1.0)], [0.0, 0.0])
    setting = {"dt": 5e-3} if method in ("rk4", "gauss4") else {}
    runs = [
        mb.simulate(dyn, *start, 1.5, method, save=[t, t + 0.75, t + 1.5], t0=t, **setting) for t in (0.0, 2.0, 1000.0)
    ]
    for t, run in zip((0.0, 2.0, 1000.0), runs, strict=True):
        assert run.t == pytest.approx([t, t + 0.75, t + 1.5], rel=1e-15)
        assert run.q == pytest.approx(runs[0].q, abs=1e-9)
        assert [hit.t - t for hit in run.events] == pytest.approx([hit.t for hit in runs[0].events], abs=1e-9)
        assert run.stats.steps == runs[0].stats.steps or method in ("rk853", "dop853")


@pytest.mark.parametrize("run", [False, True])
@pytest.mark.parametrize("engine", ["pinocchio", "lagrangian"])
def test_arrays_of_an_open_state_are_told_also_after_a_run(engine, run):
    """A call that skips the checks of lists skips no open state."""
    dyn = mb.dynamics(mb.catalog.four_bar(), engine)
    q, v = mb.dynamics(dyn.model, "lagrangian").project([0.4, 0.0, 1.0], np.zeros(3))
    if run:
        mb.simulate(dyn, q, v, 0.002, dt=1e-3)
        dyn.step(q, v, v, 1e-3)
    with pytest.warns(MbkitWarning, match="is open by"):
        dyn.forward_dynamics(q + 0.1 * np.eye(3)[0], v, v)


@pytest.mark.parametrize("engine", ["pinocchio", "lagrangian", "oracle"])
def test_the_first_accelerations_of_an_open_loop_warn(engine):
    model = mb.catalog.slider_crank()
    open_q = np.array([0.5, 0.3, 0.2])
    with pytest.warns(MbkitWarning, match=r"slider_crank: constraint .* is open by .*project\(q, v\) returns"):
        mb.dynamics(model, engine).forward_dynamics(open_q, np.zeros(3), np.zeros(3))
    closed, v = model.random_state(0, 3)
    dyn = mb.dynamics(model, engine)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dyn.forward_dynamics(closed, v, np.zeros(3))
    with pytest.warns(MbkitWarning, match="is open by"):
        mb.dynamics(model, engine).forward_dynamics(np.array([closed[0], open_q]), v[:2], np.zeros(3))
