"""Quasi-velocities: Boltzmann and Hamel's equations are Lagrange's in other velocities, and Euler's come out."""

from __future__ import annotations

import pickle

import casadi as ca
import numpy as np
import pytest
import sympy as sp

import mbkit as mb
from mbkit.derivation import equations_of
from mbkit.errors import InputError, UnsupportedError
from mbkit.lagrangian.system import Lagrangian, QuasiLagrangian
from mbkit.spatial import rotate

I1, I2, I3, m, ell, g, c, t, tau = sp.symbols("I1 I2 I3 m l g c t tau")
phi, theta, psi = sp.symbols("phi theta psi")
u, w, s = sp.symbols("phidot thetadot psidot")
w1, w2, w3 = sp.symbols("w1 w2 w3")
x, y, xdot, ydot = sp.symbols("x y xdot ydot")
# Body-axes rates of R = Rz(phi) Rx(theta) Rz(psi) are W times the angles' rates.
W = sp.Matrix(
    [
        [sp.sin(theta) * sp.sin(psi), sp.cos(psi), 0],
        [sp.sin(theta) * sp.cos(psi), -sp.sin(psi), 0],
        [sp.cos(theta), 0, 1],
    ]
)
D = sp.Matrix(
    [
        [sp.sin(psi) / sp.sin(theta), sp.cos(psi) / sp.sin(theta), 0],
        [sp.cos(psi), -sp.sin(psi), 0],
        [-sp.sin(psi) / sp.tan(theta), -sp.cos(psi) / sp.tan(theta), 1],
    ]
)
VALUES = {I1: 0.5, I2: 0.4, I3: 0.25}
# Two adaptive runs at 1e-13 a step, over some hundred steps.
CLOSE = 1e-11
FIXED = ("rk4", "gauss4", "gauss6", "semi_implicit_euler", "implicit_midpoint")


def body(V=0, parameters=VALUES) -> Lagrangian:
    rates = W * sp.Matrix([u, w, s])
    T = (I1 * rates[0] ** 2 + I2 * rates[1] ** 2 + I3 * rates[2] ** 2) / 2
    return Lagrangian(T, V, [phi, theta, psi], parameters=parameters, name="body")


@pytest.fixture(scope="module")
def pair() -> tuple[Lagrangian, QuasiLagrangian]:
    whole = body()
    return whole, whole.quasi_velocities(D, "w1 w2 w3")


@pytest.fixture(scope="module")
def curved() -> QuasiLagrangian:
    """A frame that is no rotation's, with T1, T0, time, damping, a force and an input in the energies."""
    T = m * (xdot**2 * (1 + y**2) + ydot**2 + xdot * ydot * x) / 2 + m * t * (x * ydot - y * xdot) + t * x**2
    system = Lagrangian(
        T, m * g * x * y, [x, y], time=t, forces={x: tau, y: -c * xdot * ydot}, dissipation=c * (xdot - ydot) ** 2 / 2,
        parameters={m: 1.3, g: 0.7, c: 0.2},
    )  # fmt: skip
    return system.quasi_velocities([[1, x], [y, 2 + x * y]], ["a", "b"])


def matrix(quaternion: np.ndarray) -> np.ndarray:
    return np.stack([rotate(quaternion, e) for e in np.eye(3)], axis=-1)


# Reading


def test_eulers_equations_come_out(pair):
    _, quasi = pair
    eq = quasi.equations()
    assert eq.mass_matrix == sp.diag(I1, I2, I3)
    a1, a2, a3 = sp.symbols("wdot1 wdot2 wdot3")
    expected = [
        I1 * a1 + (I3 - I2) * w2 * w3,
        I2 * a2 + (I1 - I3) * w3 * w1,
        I3 * a3 + (I2 - I1) * w1 * w2,
    ]
    assert all(sp.expand(e.lhs - x_) == 0 and e.rhs == 0 for e, x_ in zip(eq.equations(), expected, strict=True))
    assert r"I_{1} \dot{w}_{1}" in eq.latex()
    assert sp.expand(quasi.T - (I1 * w1**2 + I2 * w2**2 + I3 * w3**2) / 2) == 0


def test_hamel_coefficients_of_a_rotation_are_the_permutation_symbol(pair):
    _, quasi = pair
    gamma = quasi.equations().hamel_coefficients
    assert all(gamma[k, i, j] == sp.LeviCivita(i, j, k) for k in range(3) for i in range(3) for j in range(3))


def test_hamel_coefficients_are_those_of_the_inverse(curved):
    """γ^k_ij = Σ (∂W_kr/∂q_s - ∂W_ks/∂q_r) D_ri D_sj, which the code takes from the brackets of D's columns."""
    q, A, B = curved.coordinates, curved.D, curved.W
    for k in range(2):
        term = sum(
            (sp.diff(B[k, r], q[n]) - sp.diff(B[k, n], q[r])) * A[r, 0] * A[n, 1] for r in range(2) for n in range(2)
        )
        gamma = curved.hamel_coefficients[k, 0, 1]
        at = {x: 0.4, y: -0.7}
        assert float(gamma.subs(at)) == pytest.approx(float(term.subs(at)), rel=1e-13)
        assert gamma != 0
        assert curved.hamel_coefficients[k, 1, 0] == -gamma


def test_kinematics_and_what_is_conserved(pair):
    _, quasi = pair
    assert [e.lhs for e in quasi.equations().kinematics()] == [u, w, s]
    names = [q.name for q in quasi.conserved_quantities()]
    assert names == ["p_phi", "E"]
    # The vertical component of the angular momentum.
    vertical = sp.sin(theta) * (I1 * w1 * sp.sin(psi) + I2 * w2 * sp.cos(psi)) + I3 * w3 * sp.cos(theta)
    assert sp.expand(quasi.conserved_momenta()[phi] - vertical) == 0


# Terms


@pytest.mark.parametrize("engine", ["lagrangian", "oracle"])
def test_accelerations_are_lagranges(curved, engine):
    rng = np.random.default_rng(3)
    whole, model = curved.system, curved.model
    for at in (0.0, 0.8):
        q, v, force = rng.uniform(-1, 1, 2), rng.standard_normal(2), rng.standard_normal(2)
        dyn = curved.dynamics(engine, t=at) if engine == "oracle" else curved.dynamics(t=at, options={"compile": False})
        rate = dyn.forward_dynamics(q, v, curved.to_force(q, force))
        reference = whole.dynamics(t=at, options={"compile": False})
        expected = reference.forward_dynamics(q, curved.to_velocity(q, v), force)
        assert model.velocity_map.acceleration(q, v, rate) == pytest.approx(expected, rel=1e-13, abs=1e-13)
        assert curved.to_quasi_velocity(q, curved.to_velocity(q, v)) == pytest.approx(v, rel=1e-13)


def test_symbols_are_the_engines(curved):
    eq = curved.equations()
    q, v, at = np.array([0.4, -0.7]), np.array([0.3, 1.1]), 0.8
    put = {**curved.parameters, t: at, tau: 0.0}
    put |= {**dict(zip(curved.coordinates, q, strict=True)), **dict(zip(curved.velocities, v, strict=True))}

    def numbers(symbolic):
        return np.array(symbolic.subs(put), dtype=float)

    dyn = curved.dynamics(t=at, options={"compile": False})
    assert dyn.mass_matrix(q) == pytest.approx(numbers(eq.mass_matrix), rel=1e-14)
    assert dyn.coriolis_matrix(q, v) == pytest.approx(numbers(eq.coriolis_matrix), rel=1e-13)
    assert dyn.coriolis_force(q, v) == pytest.approx(numbers(eq.coriolis_force).ravel(), rel=1e-13)
    assert dyn.gravity(q) == pytest.approx(numbers(eq.potential_gradient).ravel(), rel=1e-14)
    assert dyn.passive(q, v) == pytest.approx(numbers(eq.forces).ravel(), rel=1e-13)
    nle = numbers(eq.coriolis_force + eq.drift + eq.potential_gradient).ravel()
    assert dyn.nle(q, v) == pytest.approx(nle, rel=1e-13)


def test_mass_matrix_rate_less_twice_coriolis_is_skew(curved):
    moving = curved.system
    arguments = {"dissipation": moving.dissipation, "parameters": moving.parameters}
    still = Lagrangian(moving.kinetic_split()[0], moving.V, moving.coordinates, moving.velocities, **arguments)
    quasi = still.quasi_velocities(curved.D, ["a", "b"])
    eq = equations_of(quasi.model)
    rate = ca.jtimes(ca.densify(eq.mass_matrix)[:], eq.q, eq.kin.qdot)
    f = ca.Function("S", [eq.q, eq.v, eq.parameters], [ca.reshape(rate, 2, 2) - 2 * eq.coriolis_matrix])
    S = np.array(f([0.4, -0.7], [0.3, 1.1], list(quasi.parameters.values())))
    assert np.abs(S + S.T).max() <= 1e-14
    assert np.abs(S).max() > 0.1


# Frames that move by themselves


def along(A, system, rate):
    return sum((sp.diff(A, q_) * r for q_, r in zip(system.coordinates, rate, strict=True)), sp.diff(A, t))


@pytest.mark.thorough("0")
@pytest.mark.parametrize("seed", range(2))
def test_quasi_velocities_that_depend_on_time_are_lagranges_equations_by_substitution(curved, seed):
    """Dᵀ times Lagrange's left sides with q̇ = D w + e and its derivative in them."""
    rng, system = np.random.default_rng(seed), curved.system
    held = [1, x, y, t, x * t, sp.sin(t) * y]

    def entry():
        return sum(sp.Rational(int(rng.integers(-5, 6)), 10) * held[k] for k in rng.choice(6, 1, replace=False))

    A = sp.Matrix(2, 2, lambda i, j: 2 * (i == j) + entry())
    drift = sp.Matrix([entry(), entry()]) if seed else sp.zeros(2, 1)
    quasi = system.quasi_velocities(A, "a b", drift=drift)
    e, rates, of_rates = quasi.equations(), system.velocities, system.equations()
    w, wdot = sp.Matrix(quasi.velocities), sp.Matrix(e.accelerations)
    rate = A * w + drift
    second = A * wdot + along(A, system, rate) * w + along(drift, system, rate)
    put = dict(zip((*rates, *of_rates.accelerations), (*rate, *second), strict=True))
    left = sp.Matrix([row.lhs - row.rhs for row in of_rates.equations()]).subs(put, simultaneous=True)
    ours = sp.Matrix([row.lhs - row.rhs for row in e.equations()])
    own = (x, y, t, tau, m, g, c, *w, *wdot)
    at = rng.uniform(-1, 1, len(own))
    expected, got = (np.array(sp.lambdify(own, B)(*at), dtype=float) for B in (A.T * left, ours))
    assert np.abs(got - expected).max() < 1e-13 * max(1, np.abs(expected).max())
    # What the time adds is no rounding.
    still = sp.lambdify(own, e.drift - e.transport_coefficients.T * (quasi.kinetic.M * w + quasi.kinetic.b))(*at)
    assert np.abs(np.array(sp.lambdify(own, e.drift)(*at)) - still).max() > 1e-3
    now = float(at[2])
    values, q_, w_ = {"m": at[4], "g": at[5], "c": at[6]}, at[:2], at[7:9]
    v_ = quasi.to_velocity(q_, w_, t=now, **values)
    assert v_ == pytest.approx(np.array(sp.lambdify(own, rate)(*at), dtype=float).ravel(), rel=1e-13)
    assert quasi.to_quasi_velocity(q_, v_, t=now, **values) == pytest.approx(w_, rel=1e-12)
    again = pickle.loads(pickle.dumps(quasi))
    assert again.equations() == e


def test_on_a_turning_table_coriolis_and_centrifugal_forces_come_out():
    """Velocities relative to a table that turns with Ω, in its axes: m u̇ + 2 m Ω × u - m Ω² ρ = 0."""
    Om, p, r = sp.symbols("Omega p r")
    point = Lagrangian(m * (xdot**2 + ydot**2) / 2, 0, [x, y], time=t, parameters=[m, Om])
    R = sp.Matrix([[sp.cos(Om * t), -sp.sin(Om * t)], [sp.sin(Om * t), sp.cos(Om * t)]])
    table = point.quasi_velocities(R, [p, r], drift=[-Om * y, Om * x])
    e, place = table.equations(), R.T * sp.Matrix([x, y])
    acceleration = sp.Matrix(e.accelerations)
    expected = m * (acceleration + 2 * Om * sp.Matrix([-r, p]) - Om**2 * place)
    ours = sp.Matrix([row.lhs - row.rhs for row in e.equations()])
    assert (ours - expected).applyfunc(sp.simplify).is_zero_matrix
    # The energy is that of the rest frame.
    assert [k.name for k in table.conserved_quantities()] == ["p_x", "p_y", "E"]
    rates = R * sp.Matrix([p, r]) + sp.Matrix([-Om * y, Om * x])
    assert sp.simplify(table.energy_function - m * rates.dot(rates) / 2) == 0


# Running


#: What each method leaves behind after a second at 2 ms, or at 1e-11 a step.
METHODS = {
    "rk853": 1e-10, "taylor": 1e-10, "dop853": 1e-10, "lsoda": 1e-9, "radau": 1e-8, "bdf": 1e-6,
    "rk4": 1e-9, "semi_implicit_euler": 2e-2, "gauss6": 1e-12, "gauss4": 1e-10, "implicit_midpoint": 1e-5,
}  # fmt: skip


# The others call the same functions either way.
@pytest.mark.thorough(every=5)
@pytest.mark.parametrize(
    ("method", "compiled"),
    [(x, False) for x in METHODS]
    + [(x, True) for x in ("rk853", "taylor", "rk4", "semi_implicit_euler", "implicit_midpoint")],
)
def test_every_method_knows_that_qdot_is_d_w(pair, method, compiled):
    whole, quasi = pair
    q, rates = np.array([0.1, 0.9, 0.2]), np.array([0.5, 2.0, -1.0])
    push = np.array([0.1, 0.2, -0.3])
    reference = mb.simulate(
        quasi.dynamics(options={"compile": False}), q, rates, 1.0, "rk853", rtol=1e-13, torque=push, save=[0.0, 1.0]
    )
    given = {"dt": 2e-3, "save": 500} if method in FIXED else {"rtol": 1e-11, "save": [0.0, 1.0]}
    dyn = quasi.dynamics(options={"compile": compiled})
    run = mb.simulate(dyn, q, rates, 1.0, method, torque=push, **given)
    assert run.q[-1] == pytest.approx(reference.q[-1], abs=METHODS[method])
    assert run.v[-1] == pytest.approx(reference.v[-1], abs=METHODS[method])
    # A force Dᵀ τ(q) on the rates is τ on the angles: the reference itself against Lagrange's.
    if method == "rk853":

        def turned(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:  # noqa: ARG001
            return np.linalg.solve(quasi.to_force(q, np.eye(3)).T, push)

        lag = mb.simulate(
            whole.dynamics(options={"compile": False}), q, quasi.to_velocity(q, rates), 1.0, "dop853",
            rtol=1e-12, torque=turned, save=[0.0, 1.0],
        )  # fmt: skip
        assert lag.q[-1] == pytest.approx(run.q[-1], abs=1e-10)


def test_torque_functions_and_their_work(pair):
    _, quasi = pair
    q, rates = np.array([0.1, 0.9, 0.2]), np.array([0.5, 2.0, -1.0])
    dyn = quasi.dynamics(options={"compile": False})

    def torque(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.array([0.1 * np.sin(t), 0.2 * q[1], -0.1 * v[2]])

    reference = mb.simulate(dyn, q, rates, 0.5, "dop853", rtol=1e-12, torque=torque, save=[0.0, 0.5])
    for method, close in (("rk4", 1e-9), ("radau", 1e-8), ("implicit_midpoint", 1e-4)):
        setting = {} if method == "radau" else {"dt": 5e-3}
        run = mb.simulate(dyn, q, rates, 0.5, method, torque=torque, **setting)
        assert run.q[-1] == pytest.approx(reference.q[-1], abs=close)
    run = mb.simulate(dyn, q, rates, 0.5, "rk4", dt=2e-3, torque=torque)
    # The rules of the work are of fourth order.
    assert run.energy() - run.energy()[0] == pytest.approx(run.work(), abs=1e-9)
    run = mb.simulate(dyn, q, rates, 0.5, "rk4", dt=2e-3, torque=np.array([0.1, 0.2, 0.3]))
    assert run.energy() - run.energy()[0] == pytest.approx(run.work(), abs=1e-9)


def test_derivatives_are_along_the_columns(pair):
    _, quasi = pair
    dyn, model = quasi.dynamics(options={"compile": False}), quasi.model
    q, v, force = np.array([0.1, 0.9, 0.2]), np.array([0.5, 2.0, -1.0]), np.array([0.1, 0.2, 0.3])
    by = dyn.inverse_dynamics_derivatives(q, v, force)
    h = 1e-6
    for k, e in enumerate(np.eye(3)):
        ends = [dyn.inverse_dynamics(model.integrate(q, z * h * e), v, force) for z in (1, -1)]
        # A central difference loses a third of the digits.
        assert by.q[:, k] == pytest.approx((ends[0] - ends[1]) / (2 * h), abs=1e-8)
    assert model.difference(q, model.integrate(q, v)) == pytest.approx(v, rel=1e-13)


# What cannot be


def test_bad_input_says_what_is_wrong():
    whole = body()
    for given, told in (
        (sp.eye(2), "expected shape"),
        (sp.Matrix([[1, 0, 0], [0, 1, 0], [1, 1, 0]]), "singular everywhere"),
        (sp.diag(1, 1, x), "parameters only, got x"),
        (sp.diag(1, 1, u), "drift of q and t alone"),
        (sp.diag(1, 1, sp.oo), "expected finite"),
        ("no matrix", "expected a SymPy matrix"),
    ):
        with pytest.raises(InputError, match=told):
            whole.quasi_velocities(given)
    for names, told in (
        (["a", "b"], "expected 3"),
        (["I1", "a", "b"], "'I1' stands"),
        ([1, 2, 3], "expected names"),
        (3, "names: expected a list"),
        (["v", "vdot", "b"], "'vdot' stands"),
    ):
        with pytest.raises(InputError, match=told):
            whole.quasi_velocities(sp.eye(3), names)
    bound = Lagrangian(m * (xdot**2 + ydot**2), 0, [x, y], parameters=[m], constraints=[x - y])
    with pytest.raises(UnsupportedError, match="has holonomic constraints"):
        bound.quasi_velocities(sp.eye(2))
    with pytest.raises(InputError, match=r"got t; .*give the time to the system as time="):
        Lagrangian(m * xdot**2, 0, [x], parameters=[m]).quasi_velocities([[t]])
    with pytest.raises(InputError, match=r"drift: expected shape \(3, 1\)"):
        whole.quasi_velocities(sp.eye(3), drift=[1, 2])
    timed = Lagrangian(m * xdot**2, 0, [x], time=t, parameters={m: 1.0})
    with pytest.raises(InputError, match="'t' stands for something else"):
        timed.quasi_velocities([[1]], "t")
    for moving in (timed.quasi_velocities([[1 + t**2]]), timed.quasi_velocities([[1]], drift=[[x]])):
        with pytest.raises(UnsupportedError, match=r"run its \.system"):
            moving.dynamics()


def test_parameters_in_d_are_read_and_put_in_before_a_run():
    swing = Lagrangian(
        m * ell**2 * w**2 / 2, -m * g * ell * sp.cos(theta), [theta], parameters={m: 1.0, ell: 0.5, g: 9.81}
    )
    quasi = swing.quasi_velocities([[1 / ell]], "s")
    assert m * sp.Symbol("s") ** 2 / 2 == quasi.T
    assert quasi.to_velocity([0.1], [2.0]) == pytest.approx([4.0])
    with pytest.raises(UnsupportedError, match="it holds l"):
        quasi.dynamics()
    fixed = quasi.substituted({ell: 0.5})
    assert fixed.dynamics(options={"compile": False}).nle([0.3], [1.0]) == pytest.approx([9.81 * np.sin(0.3)])
    again = pickle.loads(pickle.dumps(fixed.dynamics(options={"compile": False})))
    assert again.model.digest == fixed.model.digest != fixed.system.model.digest
    assert again.nle([0.3], [1.0]) == pytest.approx([9.81 * np.sin(0.3)])
    heavier = fixed.model.with_parameters(m=2.0)
    assert isinstance(heavier.form, QuasiLagrangian)
    assert mb.dynamics(heavier, compile=False, engine="lagrangian").mass_matrix([0.3]) == pytest.approx(
        np.array([[2.0]])
    )


@pytest.mark.parametrize("method", ["rk4", "rk853", "radau", "taylor", "implicit_midpoint"])
def test_a_singular_start_is_refused(pair, method):
    _, quasi = pair
    dyn = quasi.dynamics(options={"compile": False})
    with pytest.raises(InputError, match=r"singular at \[0.0, 0.0, 0.5\]"):
        mb.simulate(dyn, [[1.0, 1.0, 1.0], [0.0, 0.0, 0.5]], [0.1, 0.2, 0.3], 0.1, method, save=[0.0, 0.1])
