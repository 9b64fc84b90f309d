"""Systems written as energies: read as equations, and run like a robot."""

from __future__ import annotations

import pickle
import random
import warnings
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp
from sympy.physics.mechanics import dynamicsymbols

import mbkit as mb
from mbkit.errors import InputError, MbkitWarning, UnknownNameError, UnsupportedError
from mbkit.lagrangian import Lagrangian
from mbkit.lagrangian.printer import ExpressionPrinter
from mbkit.lagrangian.systems import one_degree
from mbkit.lagrangian.trig.simplify import forms, is_zero, tidy
from mbkit.simulate import METHODS as METHODS_OF

EPS = np.finfo(float).eps
m, l, g, k, c, a, W = sp.symbols("m l g k c a Omega", positive=True)  # the field's letter
th, x, t = sp.symbols("theta x t")
w, u = sp.symbols("thetadot xdot")
VALUES = {m: 0.7, l: 0.4, g: 9.81}


def pendulum(**more) -> Lagrangian:
    return Lagrangian(m * l**2 * w**2 / 2, -m * g * l * sp.cos(th), [th], parameters=VALUES, **more)


def hoop() -> Lagrangian:
    """A bead on a hoop that turns about its vertical diameter at Ω."""
    T = m * l**2 * (w**2 + W**2 * sp.sin(th) ** 2) / 2
    return Lagrangian(T, -m * g * l * sp.cos(th), [th], parameters={**VALUES, W: 9.0}, name="hoop")


def driven() -> Lagrangian:
    """A pendulum whose pivot moves up and down as a cos Ω t."""
    lift = a * sp.cos(W * t)
    y, s = lift - l * sp.cos(th), l * sp.sin(th)
    vy, vx = sp.diff(lift, t) + l * sp.sin(th) * w, sp.diff(s, th) * w
    return Lagrangian(
        m * (vx**2 + vy**2) / 2, m * g * y, [th], time=t, parameters={**VALUES, a: 0.05, W: 40.0}, name="driven"
    )


def cart(**more) -> Lagrangian:
    """A cart-pole with everything that a Lagrangian takes: spring, damping, drag, an input."""
    M, force = sp.symbols("M F")
    T = M * u**2 / 2 + m * ((u + l * sp.cos(th) * w) ** 2 + (l * sp.sin(th) * w) ** 2) / 2
    return Lagrangian(
        T,
        -m * g * l * sp.cos(th) + k * x**2 / 2,
        [x, th],
        [u, w],
        forces={x: force, th: -c * w * sp.Abs(w)},
        dissipation=c * u**2 / 2,
        parameters={**VALUES, M: 1.5, k: 20.0, c: 0.3},
        name="cart",
        **more,
    )


def rheonomic() -> Lagrangian:
    """Two coordinates, M(q, t), T1 with a curl, T0: every term that there is."""
    T = (2 + sp.cos(x) * sp.sin(t)) * u**2 / 2 + w**2 * (1 + x**2) + u * w * sp.sin(th) / 3
    T += u * th**2 * sp.cos(t) - w * x * t + x**2 * th**2 / 2
    V = sp.sin(th) * x + t * x**2
    return Lagrangian(T, V, [x, th], [u, w], time=t, dissipation=u**2 + u * w / 2 + w**2, name="rheonomic")


ALL = [pendulum, hoop, driven, cart, rheonomic]


def at(lag: Lagrangian, q, v, s: float = 0.0):
    """Return numbers for every symbol of a system at a state."""
    named = {
        **lag.parameters,
        **dict(zip(lag.coordinates, q, strict=True)),
        **dict(zip(lag.velocities, v, strict=True)),
    }
    named |= dict.fromkeys(lag.inputs.values(), 0.0)
    return {**named, lag.time: s} if lag.time else named


def states(lag: Lagrangian, n: int = 4):
    rng = np.random.default_rng(len(lag.name))
    return rng.uniform(-1, 1, (n, lag.model.nq)), rng.standard_normal((n, lag.model.nv)), rng.uniform(0, 2, n)


@pytest.mark.thorough("lagrangian-cart", "lagrangian-rheonomic", "oracle-cart", "oracle-rheonomic")
@pytest.mark.parametrize("make", ALL)
@pytest.mark.parametrize("engine", ["lagrangian", "oracle"])
def test_what_is_read_is_what_runs(make, engine):
    """The matrices on paper, evaluated in 30 digits, are the engine's, which derives them anew from T and V."""
    lag = make()
    eom = lag.equations()
    for q, v, s in zip(*states(lag), strict=True):
        put = at(lag, q, v, s)
        dyn = lag.dynamics(engine)
        dyn = dyn.at(**{lag.model.time_parameter: s}) if lag.time else dyn

        def paper(matrix, put=put):
            return np.array(sp.Matrix(matrix).subs(put).evalf(30).tolist(), dtype=float)

        M = paper(eom.mass_matrix)
        scale = 40 * EPS * max(1.0, np.abs(M).max()) * (1 + np.abs(v).max()) ** 2 * 100
        assert np.abs(dyn.mass_matrix(q) - M).max() < scale
        assert np.abs(dyn.gravity(q) - paper(eom.potential_gradient)[:, 0]).max() < scale
        assert np.abs(dyn.coriolis_force(q, v) - paper(eom.coriolis_force)[:, 0]).max() < scale
        assert np.abs(dyn.coriolis_matrix(q, v) - paper(eom.coriolis_matrix)).max() < scale
        nle = paper(eom.coriolis_force + eom.drift + eom.potential_gradient)[:, 0]
        assert np.abs(dyn.nle(q, v) - nle).max() < scale
        assert np.abs(dyn.passive(q, v) - paper(eom.forces)[:, 0]).max() < scale
        explicit = paper(sp.Matrix([e.rhs for e in eom.explicit()]))[:, 0]
        assert np.abs(dyn.forward_dynamics(q, v, 0 * v) - explicit).max() < scale * np.linalg.cond(M)


@pytest.mark.thorough("cart", "rheonomic")
@pytest.mark.parametrize("make", ALL)
def test_the_parts_of_the_kinetic_energy(make):
    lag = make()
    T2, T1, T0 = lag.kinetic_split()
    assert sp.simplify(T2 + T1 + T0 - lag.T) == 0
    s = sp.Symbol("s")
    scaled = {v: s * v for v in lag.velocities}
    for part, degree in ((T2, 2), (T1, 1), (T0, 0)):
        assert sp.simplify(part.subs(scaled, simultaneous=True) - s**degree * part) == 0


def test_the_blackboards_own_form():
    one, two = dynamicsymbols("theta1 theta2")
    now = dynamicsymbols._t
    m1, m2, l1, l2 = sp.symbols("m1 m2 l1 l2")
    x1, y1 = l1 * sp.sin(one), -l1 * sp.cos(one)
    x2, y2 = x1 + l2 * sp.sin(two), y1 - l2 * sp.cos(two)
    T = m1 * (x1.diff(now) ** 2 + y1.diff(now) ** 2) / 2 + m2 * (x2.diff(now) ** 2 + y2.diff(now) ** 2) / 2
    lag = Lagrangian(T, g * (m1 * y1 + m2 * y2), [one, two], parameters=[m1, m2, l1, l2, g])
    d = sp.Symbol("theta1") - sp.Symbol("theta2")
    assert lag.equations().mass_matrix == sp.Matrix(
        [[l1**2 * (m1 + m2), l1 * l2 * m2 * sp.cos(d)], [l1 * l2 * m2 * sp.cos(d), l2**2 * m2]]
    )
    assert str(lag.equations()).splitlines()[1] == (
        "l1*l2*m2*thetaddot1*cos(theta1 - theta2) + l2**2*m2*thetaddot2"
        " - l1*l2*m2*thetadot1**2*sin(theta1 - theta2) + g*l2*m2*sin(theta2) = 0"
    )
    assert r"\ddot{\theta}_{1}" in lag.equations().latex()


def test_lagranges_own_formula_gives_the_same_accelerations():
    """d/dt ∂L/∂q̇ - ∂L/∂q + ∂R/∂q̇ = 0 with functions of the time, and nothing of mbkit's; also in quasi-velocities."""
    lag, now = rheonomic(), dynamicsymbols._t
    f = dynamicsymbols("x theta")
    put = {x: f[0], th: f[1], u: f[0].diff(now), w: f[1].diff(now), t: now}
    L, R = ((lag.T - lag.V).subs(put), lag.dissipation.subs(put))
    rows = [L.diff(q.diff(now)).diff(now) - L.diff(q) + R.diff(q.diff(now)) for q in f]
    second = sp.symbols("a1 a2")
    back = [(q.diff(now, 2), b) for q, b in zip(f, second, strict=True)]
    back += [(q.diff(now), v) for q, v in zip(f, lag.velocities, strict=True)] + [(f[0], x), (f[1], th), (now, t)]
    told = sp.Matrix([row.subs(back) for row in rows])
    A, rest = told.jacobian(second), -told.subs(dict.fromkeys(second, 0))
    # Products of D and M have cubes of cosines, which no tree of joints has.
    D = sp.Matrix([[1, sp.cos(th) ** 2 / 4], [0, 1 + sp.sin(th) / 3]])
    quasi, off = lag.quasi_velocities(D), []
    for q, v, s in zip(*states(lag), strict=True):
        at = {x: q[0], th: q[1], u: v[0], w: v[1], t: s}
        truth = np.linalg.solve(*(np.array(X.subs(at), dtype=float) for X in (A, rest)))[:, 0]
        dyn, turned = (made.dynamics(options={"compile": False}).at(t=s) for made in (lag, quasi))
        off.append(dyn.forward_dynamics(q, v, 0 * v) - truth)
        rates = quasi.to_quasi_velocity(q, v)
        flow = D * sp.Matrix(rates)
        drift = flow.jacobian([x, th]) * sp.Matrix(v)
        accelerations = turned.forward_dynamics(q, rates, 0 * v)
        off.append(np.array((D * sp.Matrix(accelerations) + drift).subs(at), dtype=float)[:, 0] - truth)
    assert np.abs(off).max() < 1e-12


METHODS = ("rk4", "gauss6", "rk853", "taylor", "dop853", "radau", "bdf", "lsoda", "implicit_midpoint")
SAVE = (0.0, 0.1, 0.3)


@cache
def solved(make):
    """Return a system's dynamics, a state, and its motion by SymPy's accelerations and SciPy."""
    lag = make()
    q, v, _ = (s[0] for s in states(lag))
    acceleration = sp.lambdify(
        [*lag.coordinates, *lag.velocities, *([lag.time] if lag.time else [])],
        [e.rhs.subs({**lag.parameters, **dict.fromkeys(lag.inputs.values(), 0)}) for e in lag.equations().explicit()],
    )

    def rate(s, y):
        n = len(q)
        return [*y[n:], *acceleration(*y, *([s] if lag.time else []))]

    return lag.dynamics(), q, v, solve_ivp(rate, (0, 0.3), [*q, *v], "DOP853", SAVE, rtol=1e-13, atol=1e-13).y


@pytest.mark.thorough(every=6)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("make", ALL)
def test_every_method_runs_it(make, method):
    dyn, q, v, truth = solved(make)
    if method == "taylor" and make is cart:
        # Its drag has a kink, where a series would go on as if there were none.
        return
    tight = {"bdf": 1e-9, "radau": 1e-9}
    setting = {"dt": 1e-3} if METHODS_OF[method].kind == "fixed" else {"rtol": tight.get(method, 1e-11)}
    run = mb.simulate(dyn, q, v, 0.3, method, save=SAVE, **setting)
    bound = {"implicit_midpoint": 1e-4, "bdf": 1e-6, "radau": 1e-7, "rk4": 1e-7}.get(method, 1e-8)
    assert np.abs(run.q.T - truth[: len(q)]).max() < bound


@pytest.mark.thorough("radau", "bdf", "taylor", "rodas5")
@pytest.mark.parametrize("method", ["rk4", "implicit_midpoint", "rk853", "radau", "bdf", "taylor", "auto", "rodas5"])
def test_a_run_goes_on_from_its_middle(method):
    """Started again at 0.1 s from its own state, a run under a force of the time moves as it did."""
    dyn, q, v, _ = solved(driven)
    fixed = METHODS_OF[method].kind == "fixed"
    setting = {"dt": 1e-3} if fixed else {"rtol": {"bdf": 1e-9, "radau": 1e-9}.get(method, 1e-12)}
    whole = mb.simulate(dyn, q, v, 0.3, method, save=SAVE, **setting)
    rest = mb.simulate(dyn, whole.q[1], whole.v[1], 0.2, method, save=SAVE[1:], t0=0.1, **setting)
    assert rest.t == pytest.approx(SAVE[1:], abs=2 * EPS)
    bound = 1e-12 if fixed else {"bdf": 1e-6, "radau": 1e-7}.get(method, 1e-8)
    assert np.abs(rest.q[-1] - whole.q[-1]).max() < bound
    assert np.abs(rest.energy() - whole.energy()[1:]).max() < 1e3 * bound
    # The drive turns several times a second: a start at 0 s is another motion.
    other = mb.simulate(dyn, whole.q[1], whole.v[1], 0.2, method, save=[0.0, 0.2], **setting)
    assert np.abs(other.q[-1] - whole.q[-1]).max() > 1e-3
    held = mb.simulate(dyn.at(t=0.1), whole.q[1], whole.v[1], 0.2, method, save=SAVE[1:], **setting)
    assert np.array_equal(held.q, rest.q), "a run starts at the time that the dynamics holds"


def test_the_oracle_starts_at_its_time():
    dyn, q, v, _ = solved(driven)
    own = mb.dynamics(dyn.model, "oracle")
    near = mb.simulate(dyn, q, v, 0.2, "taylor", rtol=1e-15, save=[0.1, 0.3], t0=0.1)
    far = mb.simulate(own.at(t=0.1), q, v, 0.2, "taylor", rtol=1e-25, save=[0.1, 0.3])
    assert np.abs(near.q - far.q).max() < 1e-13


def test_samples_at_different_times_need_a_start_time():
    dyn, q, v, _ = solved(driven)
    several = dyn.at(t=np.array([0.0, 1.0]))
    with pytest.raises(InputError, match=r"^t0: .*2 different values of t"):
        mb.simulate(several, q, v, 0.1, "rk4")


def test_the_midpoint_rule_in_time_is_symplectic():
    """Area in (q, p) is kept over 20 steps; p = M v + b, so that of (q, v) at the start is M times as large."""
    lag = driven()
    dyn, h = lag.dynamics(), 1e-6
    q, v = np.full((4, 1), 0.4), np.full((4, 1), 0.3)
    q[:2, 0] += [h, -h]
    v[2:, 0] += [h, -h]
    run = mb.simulate(dyn, q, v, 0.2, "implicit_midpoint", dt=0.01, save=[0.2])
    end = np.stack([run.q[:, 0, 0], run.canonical_momentum()[:, 0, 0]])
    J = np.stack([end[:, 0] - end[:, 1], end[:, 2] - end[:, 3]], axis=1) / (2 * h)
    # Differences are good to 1e-9.
    assert np.linalg.det(J) == pytest.approx(dyn.mass_matrix([0.4])[0, 0], rel=1e-7)


def test_the_midpoint_rule_in_time_is_of_second_order_in_machine_code_too():
    lag = driven()
    truth = mb.simulate(lag.dynamics(), [0.4], [0.3], 0.3, "rk853", rtol=1e-13, save=[0.3])
    found = {}
    for compiled in (False, True):
        dyn = lag.dynamics(options={"compile": compiled})
        found[compiled] = [
            mb.simulate(dyn, [0.4], [0.3], 0.3, "implicit_midpoint", dt=dt, save=[0.3]) for dt in (4e-3, 2e-3)
        ]
        for part in ("q", "v"):
            errors = [np.abs(getattr(run, part) - getattr(truth, part)).max() for run in found[compiled]]
            assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)
    # Newton's iteration of either ends within 1e-12 of the step.
    for own, other in zip(*found.values(), strict=True):
        assert np.abs(own.q - other.q).max() < 1e-11


def test_a_force_that_is_one_symbol_is_the_torque():
    lag = cart()
    assert [str(s) for s in lag.inputs.values()] == ["F"]
    q, v = np.array([0.1, 0.4]), np.array([0.2, -0.3])
    dyn = lag.dynamics()
    force = sp.Matrix(lag.equations().forces).subs(at(lag, q, v) | {lag.inputs[x]: 3.0})
    assert np.allclose(dyn.passive(q, v) + np.array([3.0, 0.0]), np.array(force, dtype=float)[:, 0], atol=1e-14)


def test_momenta_of_a_moving_frame():
    lag = driven()
    run = mb.simulate(lag.dynamics(), [1.0], [0.3], 0.2, "rk853", save=[0.0, 0.05, 0.2])
    p = sp.lambdify([th, w, t], lag.momenta[0].subs(lag.parameters))
    assert np.allclose(run.canonical_momentum()[:, 0], p(run.q[:, 0], run.v[:, 0], run.t), rtol=1e-13)
    T = sp.lambdify([th, w, t], lag.T.subs(lag.parameters))
    assert np.allclose(run.kinetic_energy(), T(run.q[:, 0], run.v[:, 0], run.t), rtol=1e-13)


def test_parameters_move_without_deriving_again():
    lag = pendulum()
    dyn = lag.dynamics()
    assert dyn.at(l=0.8).gravity([1.0]) == pytest.approx(0.7 * 9.81 * 0.8 * np.sin(1.0), rel=1e-15)
    assert lag.dynamics(l=0.8).equations is not dyn.equations
    assert dyn.at(m=np.array([1.0, 2.0])).mass_matrix([0.0])[:, 0, 0] == pytest.approx([0.16, 0.32], rel=1e-15)
    plain = lag.model.with_parameters(l=0.8, m=1.0)
    assert dict(plain.parameters) == {"g": 9.81}
    assert mb.dynamics(plain, "lagrangian").gravity([1.0]) == pytest.approx(9.81 * 0.8 * np.sin(1.0), rel=1e-15)
    with pytest.raises(UnknownNameError):
        dyn.at(length=1.0)


def test_functions_of_every_kind_are_converted():
    terms = [sp.tan(th / 3), sp.asin(th / 4), sp.acos(th / 4), sp.atan(th), sp.exp(th), sp.log(th + 4)]
    terms += [sp.sinh(th), sp.cosh(th), sp.tanh(th), sp.sqrt(th + 3), (th + 2) ** sp.Rational(5, 3), sp.atan2(th, l)]
    terms += [sp.Abs(th), 1 / (th + 2), (th + 2) ** -3, sp.pi * th, sp.Rational(1, 3) * th**5, sp.sec(th), sp.exp(-2)]
    terms += [sp.asinh(th), sp.acosh(th + 3), sp.atanh(th / 2), sp.Max(th, l) ** 2, sp.Min(th, l) ** 3]
    terms += [sp.Piecewise((th**2, th < l), (2 * l * th - l**2, True))]
    V = sum(terms, sp.Integer(0)).subs(th, angle := sp.Symbol("theta", real=True))
    lag = Lagrangian(w**2 / 2, V, [angle], [w], parameters={l: 0.4})
    expected = sp.diff(V, angle)
    for engine in ("lagrangian", "oracle"):
        dyn = lag.dynamics(engine)
        for value in (-0.9, 0.3, 1.2):
            truth = float(expected.subs({angle: sp.Float(value, 40), l: 0.4}).doit().evalf(30))
            assert dyn.gravity([value])[0] == pytest.approx(truth, rel=1e-14)


def test_a_third_keeps_34_digits():
    lag = Lagrangian(w**2 / 2, th / 3, [th])
    assert str(lag.dynamics("oracle").digits("gravity", [0.5])[0]).startswith("0.33333333333333333333333333333333")


MANY = sp.symbols("b:6")
WRONG = [
    (lambda: Lagrangian(w**3 * m, 0, [th], parameters=[m]), "its term m\\*thetadot\\*\\*3 is not"),
    (lambda: Lagrangian(sp.sqrt(1 - w**2), 0, [th]), "T: expected at most the second degree"),
    (lambda: Lagrangian(m * w**2, l * th, [th], parameters=[m]), "l stands in V and is not declared"),
    (lambda: Lagrangian(w**2 + u**2, 0, [th]), "xdot stands in T and is not declared"),
    (lambda: Lagrangian(w**2, 0, [th], [w, u]), "2 velocities for 1 coordinates"),
    (lambda: Lagrangian(w**2, 0, [th, x], [w, u]), "singular everywhere: no kinetic energy has xdot"),
    (lambda: Lagrangian(w**2, w**2 * th, [th]), "V: expected at most the first degree in the velocities"),
    (lambda: Lagrangian(w**2, 0, []), "coordinates: expected at least one"),
    (lambda: Lagrangian(w**2, 0, [th, th]), "'theta' stands twice"),
    (lambda: Lagrangian(w**2, 0, [th], parameters={th: 1.0}), "theta is a coordinate"),
    (lambda: Lagrangian(w**2, 0, [th], forces={x: 1}), "forces: x is no coordinate"),
    (lambda: Lagrangian(w**2, 0, [th], forces={th: k * a}), "a, k stands in forces"),
    (lambda: Lagrangian("w +", 0, [th]), "T: expected a SymPy expression"),
    (lambda: Lagrangian(w**2 * sp.oo, 0, [th]), "not finite"),
    (lambda: Lagrangian(sp.Matrix([w]), 0, [th]), "T: expected a scalar"),
    (lambda: Lagrangian(w**2 * m, 0, [th], parameters={m: float("nan")}), "parameter m"),
    (lambda: Lagrangian(w**2, dynamicsymbols("z"), [th]), "z\\(t\\) is no coordinate"),
    (lambda: Lagrangian(w**2, sp.gamma(th), [th]).dynamics().gravity([1.0]), "gamma: no engine computes"),
    (lambda: Lagrangian(m * w**2, 0, [th], parameters=[m]).dynamics().mass_matrix([0.0]), "no value for parameter 'm'"),
    # What is of no degree at all, found without a search.
    (lambda: Lagrangian(w**2 + sp.Abs(w) * w, 0, [th]), "its term thetadot\\*Abs\\(thetadot\\) is not"),
    (lambda: Lagrangian(sp.Piecewise((w**2, w > 0), (2 * w**2, True)), 0, [th]), "second degree.*Piecewise"),
    (lambda: Lagrangian(w**2 + u**3 / w, 0, [th, x], [w, u]), "its term xdot\\*\\*3/thetadot is not"),
    # Singular everywhere, by an identity and for more coordinates than have a short determinant.
    (lambda: Lagrangian((w * sp.cos(th) + u * sp.sin(th)) ** 2, 0, [th, x], [w, u]), "thetadot, xdot together"),
    (lambda: Lagrangian(sum((a + b) ** 2 for a, b in pairwise(MANY)), 0, sp.symbols("a:6"), MANY), "b5 together"),
    (lambda: Lagrangian(w**2, x, [th, x], [w, u], constraints=[th - 1]), "no kinetic energy has xdot and no con"),
    # Names stand for one thing each.
    (lambda: Lagrangian(w**2 * m, 0, [th], parameters={m: 1.0, sp.Symbol("m"): 2.0}), "'m' stands twice"),
    (lambda: Lagrangian(w**2, 0, [th], parameters=[sp.Symbol("thetaddot")]), "the derivative of thetadot is called"),
    (lambda: Lagrangian(w**2, 0, [th], forces={th: sp.Symbol("thetaddot")}), "the derivative of thetadot is called"),
    (lambda: Lagrangian(w**2, 0, [th], parameters={sp.Symbol("theta", real=True): 1.0}), "theta is a coordinate"),
    (lambda: Lagrangian(w**2, 0, [th], forces={th: 1, "theta": 2}), "theta stands twice"),
    (lambda: Lagrangian(w**2 + u**2, 0, {th, x}, [w, u]), "a set, which has no order"),
    (lambda: Lagrangian(sp.Symbol("n") ** 2, 0, [sp.Symbol("k", integer=True)], [sp.Symbol("n")]), "to be integer"),
    (lambda: Lagrangian(m * w**2, 0, [th], [sp.Symbol("thetadot", positive=True)]), "to be nonnegative"),
    (lambda: Lagrangian((1 + sp.I) * w**2, 0, [th]), "imaginary unit"),
    (lambda: Lagrangian(w**2 * sp.IndexedBase("m")[0], 0, [th]), "m\\[0\\] is no plain symbol"),
    (lambda: Lagrangian(w**2, th * t, [th]), "pass the time as time=t"),
    (lambda: Lagrangian(w**2, 0, [th], forces=[k]), "expected {coordinate: force}"),
    (lambda: Lagrangian(w**2, 0, [th], forces={th: -k}), "an input is a symbol that is all of one force"),
    (lambda: Lagrangian(w**2, 0, [th], dissipation=th**2), "holds none of the velocities thetadot"),
    (lambda: Lagrangian(w**2, 0, [th], constraints=[k], parameters=[k]), "k holds no coordinate"),
    (lambda: Lagrangian(w**2, 0, [th], name=5), "name: expected a text"),
    (lambda: pendulum().dynamics("pinocchio"), "was written as energies and has no bodies"),
    (lambda: pendulum().dynamics().pose([0.0], "tip"), "was written as energies and has no frames"),
    (lambda: pendulum().model.without("gravity"), "only 'damping' can be left out"),
]


@pytest.mark.parametrize(("call", "told"), WRONG)
def test_bad_input_is_named(call, told):
    with pytest.raises((InputError, UnsupportedError), match=told):
        call()


def test_a_name_is_one_symbol_whatever_is_assumed_of_it():
    plain, real = sp.Symbol("m"), sp.Symbol("theta", real=True)
    lag = Lagrangian(m * w**2, plain * real**2, [th], parameters={sp.Symbol("m", real=True): 2.0})
    assert str(lag.equations()) == "2*m*thetaddot + 2*m*theta = 0"
    assert 3 * th**2 == lag.substituted({m: 3}).V
    # A speed of what is positive has either sign.
    r = sp.Symbol("r", positive=True)
    speed = Lagrangian(sp.Symbol("rdot") ** 2, r, [r]).velocities[0]
    assert sp.Abs(speed) != speed
    assert Lagrangian("m*rdot**2/2", "beta*gamma*r", [r], parameters=sp.symbols("m beta gamma")).V.has(r)


def test_constraints_are_equations_or_one_expression():
    assert Lagrangian(w**2 + u**2, 0, [th, x], [w, u], constraints=sp.Eq(th, 2 * x)).constraints == (th - 2 * x,)
    one = sp.Symbol("lambda1")
    taken = Lagrangian(one * (w**2 + u**2), 0, [th, x], [w, u], parameters=[one], constraints=th - x)
    assert str(taken.equations()).splitlines()[0] == "2*lambda1*thetaddot = Lambda1"


def random_sum(pick: random.Random) -> sp.Expr:
    """Return a sum of products of powers, cosines, roots and quotients."""
    angles = [th, k, th + k, th - k, 2 * th, c * th]
    others = [sp.sqrt(l**2 + m * sp.cos(th) + 3), 1 / (m + l * sp.sin(k)), 1 / sp.sin(th), sp.tan(k), sp.exp(m)]
    others += [(3 + sp.cos(th - k)) ** sp.Rational(-3, 2), 1 / (3 + sp.cos(th - k)), 1 / (l + 1 / (m + c))]

    def factor() -> sp.Expr:
        turned = pick.choice([sp.sin, sp.cos])(pick.choice(angles)) ** pick.choice([1, 1, 2, 3])
        power = pick.choice([m, l, c]) ** pick.choice([1, 2, -1])
        return pick.choice([turned, turned, power, power, pick.choice(others)])

    return sum(
        (pick.choice([1, -1, sp.Rational(2, 3)]) * sp.prod(factor() for _ in range(2)) for _ in range(3)), sp.S(0)
    )


CUBES = [
    # A square's other half, where the cosine stands before it and where such a term is there already.
    th + sp.sin(c) ** 3 * sp.cos(m * c) ** 3 / 2 - 2 * sp.sin(2 * c),
    2 * m * k * sp.sin(th) - l * sp.cos(th) ** 3 - sp.sin(2 * c) * sp.cos(th) / 2,
    # Roots that are no square roots.
    sp.cbrt(m) ** -1 + k * (l + sp.cos(th)) ** sp.Rational(-2, 3) + c**m / sp.sqrt(2),
]


@pytest.mark.thorough("2", "3", "1")
@pytest.mark.parametrize("seed", range(4))
def test_shorter_forms_are_equal(seed):
    """What is cancelled, put over one denominator or freed of even powers of roots is the same function."""
    pick = random.Random(seed)
    at = {s: sp.Float(0.3 + 0.17 * i, 40) for i, s in enumerate((th, k, m, l, c))}
    for long in [*CUBES[seed : seed + 1], *(random_sum(pick) for _ in range(3))]:
        for form in [*forms(long), tidy(long)]:
            scale = 1 + sum(abs(x.subs(at).evalf(25)) for x in sp.Add.make_args(long))
            assert abs((form - long).subs(at).evalf(25)) < 1e-20 * scale, long


@pytest.mark.thorough("2", "3", "4", "5", "0")
@pytest.mark.parametrize("seed", range(6))
def test_angles_that_depend_on_each_other_lose_no_term(seed):
    """θ + 1 and θ + 2 · ½ are one angle, and so are θ and 2 · θ/2: their terms add."""
    half, pick = sp.Rational(1, 2), random.Random(seed)
    assert tidy(5 * x * sp.cos(th + 1) + x * sp.cos(th + half) * sp.cos(half)).coeff(x).subs(th, 0).evalf() == (
        pytest.approx(5 * np.cos(1) + np.cos(0.5) ** 2)
    )
    angles = [th, th / 2, 2 * th, c / 3, c, th + 1, th - half, 1 - th]
    angles += [c + sp.pi / 3, c - sp.pi / 6, half, sp.Integer(1)]
    at = {th: sp.Float(0.3, 40), c: sp.Float(0.7, 40)}
    for _ in range(10):
        factors = [pick.choice([sp.sin, sp.cos])(pick.choice(angles)) ** pick.randint(1, 2) for _ in range(9)]
        long = sum(pick.randint(-3, 3) * sp.Mul(*factors[k : k + 3]) for k in (0, 3, 6)) + pick.choice(factors)
        for form in [*forms(long), tidy(long)]:
            assert abs((form - long).subs(at).evalf(25)) < 1e-20, long


def test_what_cancels_is_found_without_a_search():
    s, co, rho = sp.sin(th), sp.cos(th), sp.sqrt(l**2 - a**2 * sp.sin(th) ** 2)
    long = co * (1 + a * co / rho) + s * sp.diff(a * co / rho, th)
    short = co + (a * l**2 * sp.cos(2 * th) + a**3 * s**4) / rho**3
    assert tidy(long) == short
    assert tidy(1 / s**2 - 1 / sp.tan(th) ** 2) == 1
    assert tidy((m * s**2 - k * s**2 + k) / (m * s**2 + k * co**2)) == 1
    assert tidy((m**2 - k**2) / (m + k)) == m - k
    assert tidy(co**3 * x - co * x) == -x * s**2 * co
    # What no form makes short is left, at once.
    assert tidy((m + k + l + c + a) ** 12 * (1 + co) ** 12 / (1 + s) ** 12).count_ops() < 30


def test_zero_is_told_by_value():
    assert is_zero(sp.cosh(x) ** 2 - sp.sinh(x) ** 2 - 1)
    assert is_zero(sp.log(sp.exp(x) * m) - x - sp.log(m))
    for other in (sp.sqrt(x**2) - x, sp.Abs(x) - x, sp.Max(x, th) - th, 1e-40 * x, sp.sign(x) - 1):
        assert not is_zero(other)
    hidden = Lagrangian(w**2 / 2, sp.asin(th / 9) + sp.acos(th / 9) + sp.tan(th) * sp.cos(th) - sp.sin(th), [th])
    assert hidden.cyclic_coordinates() == (th,)


def test_what_takes_a_description_or_an_engine_says_where_paper_has_it() -> None:
    lag = pendulum()
    with pytest.raises(InputError, match=r"model: expected a Model, got Lagrangian; its \.model is one"):
        mb.dynamics(lag)
    with pytest.raises(InputError, match=r"dyn: expected a Dynamics, got Lagrangian; its \.dynamics\(\) makes one"):
        mb.simulate(lag, [0.1], [0.0], 1.0)


def test_functions_that_are_not_given_stand_in_the_equation():
    J, h = sp.Function("J"), sp.Function("h")
    system = one_degree(J(th), m * g * h(th), coordinate=th, parameters={m: 1.0, g: 9.81}, name="cam")
    (equation,) = system.equations().equations()
    thdot, thddot = sp.symbols("thetadot thetaddot")
    slope = sp.diff(J(th), th)
    assert sp.expand(equation.lhs - (J(th) * thddot + slope * thdot**2 / 2 + m * g * sp.diff(h(th), th))) == 0
    assert r"J\left(\theta\right)" in system.equations().latex()
    assert pickle.loads(pickle.dumps(system)).equations() == system.equations()
    with pytest.raises(UnsupportedError, match=r"J\(theta\): an undefined function .*substituted"):
        system.dynamics().forward_dynamics([0.1], [0.0], [0.0])
    given = system.substituted({J: 1 + sp.sin(th) ** 2 / 2, h(th): -sp.cos(th)})
    direct = one_degree(1 + sp.sin(th) ** 2 / 2, -m * g * sp.cos(th), coordinate=th, parameters={m: 1.0, g: 9.81})
    at = [0.3], [0.7], [0.2]
    assert given.dynamics().forward_dynamics(*at) == pytest.approx(direct.dynamics().forward_dynamics(*at), rel=1e-15)
    with pytest.raises(InputError, match=r"J\(thetadot\) is a function of a velocity"):
        Lagrangian(J(thdot) * thdot**2, 0, [th])
    with pytest.raises(InputError, match=r"J\(c\) is no coordinate"):
        Lagrangian(J(c) * thdot**2, 0, [th])
    with pytest.raises(InputError, match="F is no parameter or function"):
        system.substituted({sp.Function("F"): th})


def test_a_charge_in_a_magnetic_field_circles():
    # Goldstein, Poole, Safko 2002, ch. 1.5: U = e φ - e A·v; the cyclotron turns at e B/m.
    x, y, xdot, ydot, e, B, t = sp.symbols("x y xdot ydot e B t")
    T, V = m * (xdot**2 + ydot**2) / 2, -e * B * (x * ydot - y * xdot) / 2
    charge = Lagrangian(T, V, [x, y], parameters={m: 2.0, e: 3.0, B: 0.5})
    assert charge.V == 0
    assert sp.expand(charge.L - (T - V)) == 0
    run = mb.simulate(charge.dynamics(), [0, 0], [1.0, 0], 3.0, "rk853", rtol=1e-12, atol=1e-12)
    turn = 0.75 * run.t
    exact = np.stack([np.sin(turn), np.cos(turn) - 1], axis=1) / 0.75
    assert np.abs(run.q - exact).max() < 1e-11
    p, A = sp.symbols("p_x p_y"), (-B * y / 2, B * x / 2)
    H = sum((a - e * b) ** 2 for a, b in zip(p, A, strict=True)) / (2 * m)
    assert sp.expand(charge.hamiltonian().H - H) == 0
    # A gauge changes nothing: A less the gradient of B x y/2, and that of a potential that moves.
    gauge = Lagrangian(T, e * B * (y * xdot + t * xdot), [x, y], time=t, parameters=charge.parameters)
    state = [0.3, 0.2], [0.4, -0.7], [0.0, 0.0]
    found = gauge.dynamics().forward_dynamics(*state) - charge.dynamics().forward_dynamics(*state)
    assert found == pytest.approx([0.75, 0.0], abs=1e-14)


def test_centrifugal_and_coriolis_terms_stand_apart():
    systems = mb.lagrangian.systems
    equations = systems.double_pendulum().equations()
    for system in (systems.furuta_pendulum(), systems.double_pendulum(), systems.gyroscope()):
        e = system.equations()
        centrifugal, coriolis = e.velocity_terms()
        assert all(is_zero(x) for x in centrifugal + coriolis - e.coriolis_force)
        for i, a in enumerate(e.velocities):
            assert all(is_zero(sp.diff(x, a, 2)) for x in coriolis)
            assert all(is_zero(sp.diff(x, a, b)) for x in centrifugal for b in e.velocities[:i])
    assert not any(equations.velocity_terms()[1])
    assert systems.furuta_pendulum().equations().latex(apart=True).count("&=") == 2


def test_the_slope_of_a_function_at_another_angle_is_written_and_gets_a_value():
    J, y = sp.Function("J"), sp.Symbol("y")
    system = one_degree(1, J(2 * th).diff(th), coordinate=th)
    assert ExpressionPrinter().text(system.V) == "2 J′(2 θ)"
    with pytest.raises(UnsupportedError, match=r"^a derivative of J: .*substituted\(\{J\(x\)"):
        one_degree(1, 0, J(2 * th).diff(th), coordinate=th).dynamics().forward_dynamics([0.1], [0.0], [0.0])
    assert 24 * th**2 == system.substituted({J(y): y**3}).V


def test_a_function_of_several_arguments_gets_one_value():
    J, (a, b), (u, w) = sp.Function("J"), sp.symbols("theta1 theta2"), sp.symbols("thetadot1 thetadot2")
    system = Lagrangian(J(a) * u**2 + J(2 * b) * w**2, 0, [a, b])
    assert sp.expand(system.substituted({J(a): 1 + a**2}).T - (1 + a**2) * u**2 - (1 + 4 * b**2) * w**2) == 0
    with pytest.raises(InputError, match=r"J stands as J\(2\*theta2\), J\(theta1\); give one of them"):
        system.substituted({J: 1 + a**2})
    with pytest.raises(InputError, match="expected J of a symbol"):
        system.substituted({J(2 * b): b})
    for bad in (None, [1, 2], sp.nan):
        with pytest.raises(InputError, match=r"values\[J\(theta1\)\]"):
            system.substituted({J(a): bad})
    # A parameter may have the function's name.
    both = Lagrangian(J(a) * u**2, sp.Symbol("J") * a, [a], parameters={sp.Symbol("J"): 2.0})
    given = both.substituted({J(a): 3})
    assert (3 * u**2, both.V) == (given.T, given.V)


def test_mass_that_changes_with_time_is_told():
    v, gas = sp.symbols("xdot u_e")
    rocket = {"coordinates": [x], "time": t, "parameters": [m, k, gas]}
    with pytest.warns(MbkitWarning, match="Meshchersky"):
        Lagrangian((m - k * t) * v**2 / 2, 0, **rocket)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # With the force of what leaves it is Meshchersky's equation, (m - k t) x'' = k u.
        right = Lagrangian((m - k * t) * v**2 / 2, 0, forces={x: -k * (v - gas)}, **rocket)
        # A length that is driven leaves its own rate in T.
        length = l + sp.sin(t)
        Lagrangian(m * (length**2 * w**2 + sp.diff(length, t) ** 2) / 2, 0, [th], time=t, parameters=[m, l])
    (equation,) = right.equations().equations()
    xddot = sp.Symbol("xddot")
    assert sp.expand(equation.lhs - equation.rhs - ((m - k * t) * xddot - k * gas)) == 0


@pytest.mark.parametrize("numbers", [{m: -1.0, k: 1.0}, {m: 1.0, k: -0.5}])
def test_negative_masses_are_told(numbers):
    T = m * u**2 / 2 + k * (w + u * sp.cos(th)) ** 2 / 2
    with pytest.warns(MbkitWarning, match="has negative kinetic energy"):
        Lagrangian(T, 0, [x, th], parameters=numbers)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Without numbers nothing is known, and a light mass is no negative one.
        Lagrangian(T, 0, [x, th], parameters=[m, k])
        Lagrangian(T, 0, [x, th], parameters={m: 1.0, k: 1e-9})


# Forces that jump


def sliding(force=0, **more) -> Lagrangian:
    return Lagrangian(
        m * u**2 / 2, k * x**2 / 2, [x], [u], forces={x: force}, parameters={m: 2.0, k: 50.0, c: 3.0}, **more
    )


@pytest.mark.parametrize(
    "lag",
    [
        sliding(-c * sp.sign(u)),
        sliding(-c * sp.sign(2 * u - k)),
        sliding(dissipation=c * sp.Abs(u)),
        sliding(-c * sp.sign(u)).quasi_velocities([[1 + x**2]]),
    ],
    ids=["sign", "belt", "dissipation", "quasi"],
)
def test_a_run_warns_of_a_force_that_jumps_and_terms_do_not(lag):
    dyn = lag.dynamics(options={"compile": False})
    with pytest.warns(MbkitWarning, match=r"jumps where a velocity.*friction="):
        mb.simulate(dyn, [0.1], [5.0], 0.01, "rk4", dt=1e-3)


@pytest.mark.parametrize("force", [-c * u**2 * sp.sign(u), -c * (u - k) * sp.sign(u - k), -c * sp.sign(x), -c * u])
def test_a_force_that_is_continuous_in_the_velocity_is_not_warned_of(force):
    assert not sliding(force).jumps
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mb.simulate(sliding(force).dynamics(options={"compile": False}), [0.1], [5.0], 0.01, "rk4", dt=1e-3)


def test_dry_friction_on_paper_at_speed_is_that_of_a_joint():
    b = mb.ModelBuilder("block", gravity=(0, 0, 0))
    b.add_body("block", mass=2.0)
    b.add_joint("x", "prismatic", parent="world", child="block", axis=(1, 0, 0), stiffness=50.0, friction=3.0)
    exact = mb.dynamics(b.build(), "lagrangian", compile=False)
    for lag in (sliding(-c * sp.sign(u)), sliding(dissipation=c * sp.Abs(u))):
        dyn = lag.dynamics(options={"compile": False})
        for v in (-2.0, 0.5):
            assert dyn.forward_dynamics([0.3], [v], [0.1]) == pytest.approx(
                exact.forward_dynamics([0.3], [v], [0.1]), rel=4 * EPS
            )
        # |ẋ| is that of a real number.
        assert lag.equations().forces[0] == -c * sp.sign(u)


def test_no_product_of_a_program_begins_with_1():
    b = mb.ModelBuilder("rod")
    b.add_body("rod", mass=mb.Parameter("m", 2.0) * 0.99999999, com=(mb.Parameter("r", 0.5), 0, 0), inertia=[0.1] * 3)
    b.add_joint("j", "revolute", parent="world", child="rod", axis=(0, 0, 1))
    text = mb.lagrangian.program(b.build(), "mass_matrix")
    assert str(text).endswith("mass_matrix = 0.1 + m r²")
    assert "0.9999999" in text.python()
