"""Hamilton's function and canonical equations: the same motion as Lagrange's, and what Poisson's bracket says."""

from __future__ import annotations

import pickle
from functools import cache

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp
from sympy.physics.mechanics import dynamicsymbols

import mbkit as mb
from mbkit.errors import InputError, NumericalError, UnsupportedError
from mbkit.lagrangian.system import Lagrangian

m, M, ell, g, A, C, x, t, c = sp.symbols("m M l g A C x t c")
theta, phi, psi = sp.symbols("theta phi psi")
w, u, s, xdot = sp.symbols("thetadot phidot psidot xdot")
F, Omega, a = sp.symbols("F Omega a")
p_theta, p_phi, p_psi, p_x = sp.symbols("p_theta p_phi p_psi p_x")


@cache
def pendulum() -> Lagrangian:
    T, V = m * ell**2 * w**2 / 2, -m * g * ell * sp.cos(theta)
    return Lagrangian(T, V, [theta], parameters={m: 2.0, g: 9.81, ell: 0.8})


@cache
def cart_pole() -> Lagrangian:
    T = M * xdot**2 / 2 + m * ((xdot + ell * w * sp.cos(theta)) ** 2 + (ell * w * sp.sin(theta)) ** 2) / 2
    parameters = {m: 0.3, M: 1.0, g: 9.81, ell: 0.5}
    return Lagrangian(T, -m * g * ell * sp.cos(theta), [x, theta], parameters=parameters, forces={x: F})


@cache
def heavy_top() -> Lagrangian:
    T = A * (w**2 + u**2 * sp.sin(theta) ** 2) / 2 + C * (s + u * sp.cos(theta)) ** 2 / 2
    return Lagrangian(
        T, m * g * ell * sp.cos(theta), [phi, theta, psi], parameters={A: 0.5, C: 0.2, m: 1.0, g: 9.81, ell: 0.3}
    )


@cache
def hoop() -> Lagrangian:
    """A bead on a hoop that is turned at Ω and shaken: T1 and T0 are not zero."""
    T = m * ((ell * w + a * sp.cos(theta)) ** 2 + Omega**2 * ell**2 * sp.sin(theta) ** 2) / 2
    return Lagrangian(
        T, -m * g * ell * sp.cos(theta), [theta], parameters={m: 1.0, g: 9.81, ell: 0.5, Omega: 6.0, a: 0.4}
    )


@cache
def driven() -> Lagrangian:
    """A damped pendulum whose pivot is driven: time enters."""
    height = a * sp.cos(Omega * t)
    T = m * (ell**2 * w**2 + 2 * ell * w * sp.sin(theta) * height.diff(t) + height.diff(t) ** 2) / 2
    return Lagrangian(
        T, m * g * (height - ell * sp.cos(theta)), [theta], time=t, dissipation=c * w**2 / 2,
        parameters={m: 1.0, g: 9.81, ell: 0.5, Omega: 20.0, a: 0.05, c: 0.1},
    )  # fmt: skip


CASES = {
    "pendulum": (pendulum, [1.0], [0.5]),
    "cart-pole": (cart_pole, [0.2, 2.0], [0.3, -1.0]),
    "heavy top": (heavy_top, [0.1, 0.6, 0.2], [0.5, -0.2, 12.0]),
    "hoop": (hoop, [0.4], [1.0]),
    "driven": (driven, [0.4], [1.0]),
}


def states(system: Lagrangian, seed: int = 1, n: int = 5) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    shape = (n, len(system.coordinates))
    return rng.uniform(0.3, 1.3, shape), rng.standard_normal(shape)


def number(expression, *pairs, system: Lagrangian, time: float = 0.0) -> float:
    put = dict(system.parameters)
    for symbols, values in pairs:
        put.update(zip(symbols, values, strict=True))
    return float(expression.subs(put).subs(t, time))


# The function


def test_pendulum_and_top_are_the_textbooks():
    assert p_theta**2 / (2 * m * ell**2) - m * g * ell * sp.cos(theta) == pendulum().hamiltonian().H
    H = (p_phi - p_psi * sp.cos(theta)) ** 2 / (2 * A * sp.sin(theta) ** 2) + p_psi**2 / (2 * C) + p_theta**2 / (2 * A)
    assert H + m * g * ell * sp.cos(theta) == heavy_top().hamiltonian().H
    told = str(pendulum().hamiltonian().equations())
    assert told == "thetadot = p_theta/(l**2*m)\npdot_theta = -g*l*m*sin(theta)"
    assert r"\dot{p}_{\theta} &= - m g l \sin" in pendulum().hamiltonian().equations().latex()


def test_the_shortest_of_several_forms():
    hamiltonian = cart_pole().hamiltonian()
    square = (p_x - p_theta * sp.cos(theta) / ell) ** 2 / (M + m * sp.sin(theta) ** 2) / 2
    assert p_theta**2 / (2 * m * ell**2) + square - m * g * ell * sp.cos(theta) == hamiltonian.H
    turned = (p_phi - p_psi * sp.cos(theta)) * (p_phi * sp.cos(theta) - p_psi) / (A * sp.sin(theta) ** 3)
    assert sp.expand(heavy_top().hamiltonian().equations().pdot[1] - turned - m * g * ell * sp.sin(theta)) == 0
    # No sum of squares, but not singular.
    assert p_theta * p_x + theta * x == Lagrangian(w * xdot, x * theta, [theta, x], [w, xdot]).hamiltonian().H


def test_symbols_are_known_by_their_names():
    hamiltonian = cart_pole().hamiltonian()
    rate = hamiltonian.poisson(x, hamiltonian.H)
    assert rate != 0
    for other in (dynamicsymbols("x"), sp.Symbol("x", real=True), "x"):
        assert hamiltonian.poisson(other, hamiltonian.H) == rate
    assert sp.simplify(hamiltonian.canonical(dynamicsymbols("x").diff()) - rate) == 0
    with pytest.raises(InputError, match="p_y is no symbol of"):
        hamiltonian.poisson("p_y", hamiltonian.H)
    # An input that is called as the momentum would be.
    taken = Lagrangian(w**2 / 2, 0, [theta], [w], forces={theta: p_theta}).hamiltonian()
    assert str(taken.equations()) == "thetadot = P_theta\nPdot_theta = p_theta"


@pytest.mark.parametrize("case", CASES)
def test_hamiltonian_is_the_legendre_transform(case):
    system = CASES[case][0]()
    hamiltonian = system.hamiltonian()
    L, names = system.L, (system.coordinates, system.velocities)
    for q, v in zip(*states(system), strict=True):
        p = hamiltonian.to_momentum(q, v, t=0.3)
        H = number(hamiltonian.H, (system.coordinates, q), (hamiltonian.momenta, p), system=system, time=0.3)
        expected = p @ v - number(L, (names[0], q), (names[1], v), system=system, time=0.3)
        assert pytest.approx(expected, abs=1e-13 * (1 + abs(p) @ abs(v) + abs(expected))) == H


@pytest.mark.parametrize("case", CASES)
def test_momenta_and_velocities_are_each_others_inverse(case):
    system = CASES[case][0]()
    hamiltonian = system.hamiltonian()
    q, v = states(system)
    p = hamiltonian.to_momentum(q, v, t=0.3)
    # M's condition is below 100 there.
    assert hamiltonian.to_velocity(q, p, t=0.3) == pytest.approx(v, abs=1e-13)
    for qi, vi, pi in zip(q, v, p, strict=True):
        at = ((system.coordinates, qi), (hamiltonian.momenta, pi))
        symbolic = [number(e, *at, system=system, time=0.3) for e in hamiltonian.velocities]
        assert symbolic == pytest.approx(vi, abs=1e-13)


def test_when_it_is_the_energy_and_when_it_is_kept():
    found = {case: (h.is_energy, h.is_conserved) for case in CASES if (h := CASES[case][0]().hamiltonian())}
    assert found == {
        "pendulum": (True, True),
        "cart-pole": (True, False),
        "heavy top": (True, True),
        "hoop": (False, True),
        "driven": (False, False),
    }
    assert [x.name for x in heavy_top().hamiltonian().conserved_quantities()] == ["p_phi", "p_psi", "H"]
    assert "not the energy" in hoop().hamiltonian().conserved_quantities()[0].meaning


# The equations


@pytest.mark.thorough("cart-pole", "driven")
@pytest.mark.parametrize("case", CASES)
def test_canonical_equations_move_as_lagranges_do(case):
    make, q, v = CASES[case]
    system = make()
    hamiltonian, n = system.hamiltonian(), len(q)
    tau = np.array([0.7, 0.0]) if case == "cart-pole" else np.zeros(n)
    times = np.linspace(0.0, 3.0, 7)
    dyn = system.dynamics(options={"compile": False})
    lagranges = mb.simulate(dyn, q, v, 3.0, "rk853", rtol=1e-13, torque=tau, save=times)
    start = np.concatenate([q, hamiltonian.to_momentum(q, v)])
    solved = solve_ivp(hamiltonian.field(tau), (0.0, 3.0), start, "DOP853", times, rtol=1e-13, atol=1e-13).y.T
    # Two integrators at 1e-13 a step, through SciPy's interpolant, over three seconds.
    assert solved[:, :n] == pytest.approx(lagranges.q, abs=1e-9)
    speeds = [hamiltonian.to_velocity(y[:n], y[n:], t=at) for at, y in zip(times, solved, strict=True)]
    assert np.array(speeds) == pytest.approx(lagranges.v, abs=1e-9)


@pytest.mark.thorough("cart-pole", "heavy top")
@pytest.mark.parametrize("case", ["pendulum", "cart-pole", "heavy top"])
def test_symplectic_integration_keeps_h_without_drift(case):
    make, q, v = CASES[case]
    system = make()
    dyn, f = system.dynamics(options={"compile": True}), system.hamiltonian().H
    run = mb.simulate(dyn, q, v, 60.0, "implicit_midpoint", dt=1e-2)
    names = (*system.coordinates, *system.hamiltonian().momenta)
    p = system.hamiltonian().to_momentum(run.q, run.v)
    H = sp.lambdify(names, f.subs(dict(system.parameters)))(*run.q.T, *p.T)
    off = H - H[0]
    # An error of second order that comes and goes: over 60 s it is no larger than over the
    # first ten, where a drift would make it six times as large.
    assert np.abs(off).max() <= 1.1 * np.abs(off[:1001]).max()
    assert run.energy() == pytest.approx(H, rel=1e-13, abs=1e-12)


# Brackets


def test_canonical_brackets():
    h = heavy_top().hamiltonian()
    for i, q in enumerate(h.coordinates):
        for j, p in enumerate(h.momenta):
            assert h.poisson(q, p) == int(i == j)
            assert h.poisson(q, h.coordinates[j]) == h.poisson(h.momenta[i], p) == 0


def test_jacobis_identity():
    h = cart_pole().hamiltonian()
    f, g_, k = x * p_theta, sp.sin(theta) * p_x, x * sp.cos(theta) * p_theta**2 + p_x**2
    total = sum(h.poisson(e[0], h.poisson(e[1], e[2])) for e in ((f, g_, k), (g_, k, f), (k, f, g_)))
    size = abs(
        number(h.poisson(f, h.poisson(g_, k)), (h.coordinates, (0.3, 0.8)), (h.momenta, (0.7, -0.4)), system=h.system)
    )
    value = number(total, (h.coordinates, (0.3, 0.8)), (h.momenta, (0.7, -0.4)), system=h.system)
    assert abs(value) <= 1e-13 * size


def test_angular_momenta_close_under_the_bracket():
    y, z = sp.symbols("y z")
    free = Lagrangian(m * sum(v**2 for v in sp.symbols("xdot ydot zdot")) / 2, 0, [x, y, z], parameters=[m])
    h = free.hamiltonian()
    (px, py, pz) = h.momenta
    L = (y * pz - z * py, z * px - x * pz, x * py - y * px)
    assert sp.expand(h.poisson(L[0], L[1]) - L[2]) == 0
    assert h.time_derivative(L[2]) == 0


def test_time_derivative_is_that_along_the_motion():
    top = heavy_top().hamiltonian()
    assert top.time_derivative(p_phi) == top.time_derivative(top.H) == 0
    # Velocities are written in momenta first.
    assert top.time_derivative(C * (s + u * sp.cos(theta))) == 0
    cart = cart_pole().hamiltonian()
    assert sp.simplify(cart.time_derivative(cart.H) - F * cart.velocities[0]) == 0
    shaken = driven()
    h = shaken.hamiltonian()
    power = sp.diff(h.H, t) - c * h.velocities[0] ** 2
    assert sp.simplify(h.time_derivative(h.H) - power) == 0


# What cannot be


def test_what_cannot_be_says_why():
    bound = Lagrangian(m * (w**2 + u**2), 0, [theta, phi], parameters=[m], constraints=[theta - phi])
    with pytest.raises(UnsupportedError, match="has constraints"):
        bound.hamiltonian()
    with pytest.raises(InputError, match="no input along theta"):
        cart_pole().hamiltonian().field([0.0, 1.0])
    with pytest.raises(InputError, match="q: expected shape"):
        pendulum().hamiltonian().to_momentum([1.0, 2.0], [1.0])
    with pytest.raises(NumericalError, match="singular at q"):
        heavy_top().hamiltonian().to_velocity([0.0, 0.0, 0.0], [1.0, 1.0, 1.0])
    unknown = Lagrangian(m * w**2, 0, [theta], parameters=[m]).hamiltonian()
    with pytest.raises(InputError, match="no value for parameter 'm'"):
        unknown.to_momentum([0.0], [1.0])
    assert unknown.to_momentum([0.0], [1.0], m=2.0) == pytest.approx([4.0])


def test_pickled_and_batched():
    h = heavy_top().hamiltonian()
    q, v = states(h.system)
    p = h.to_momentum(q, v)
    assert np.array_equal(p[2], h.to_momentum(q[2], v[2]))
    assert np.array_equal(pickle.loads(pickle.dumps(h)).to_momentum(q, v), p)
