"""Linearization: the tangent's rate, the derivative of steps, second derivatives, and derivatives by parameters."""

from __future__ import annotations

import inspect

import numpy as np
import pytest
import sympy as sp

import mbkit as mb
from mbkit.engines.linearization import DIFFERENTIABLE, tangent_rate
from mbkit.errors import InputError, NumericalError, UnknownNameError, UnsupportedError
from mbkit.spatial import skew
from tests.random_trees import random_tree, states
from tests.scenes import chain, slider

EPS = np.finfo(float).eps
TREES = {
    "all types": {"seed": 1, "n": 11},
    "free and balls": {"seed": 5, "n": 3, "kinds": ("free", "ball"), "nearest": 1},
    "mimic": {"seed": 3, "n": 7, "mimic": True, "nearest": 2},
}


@pytest.fixture(scope="module", params=list(TREES))
def tree(request):
    model = random_tree(**TREES[request.param])
    return mb.dynamics(model, "lagrangian", compile=False), [x[0] for x in states(model, 1, 5)]


def close(x, y, limit):
    assert np.abs(x - y).max(initial=0.0) <= limit * max(np.abs(y).max(initial=0.0), 1.0)


def slope(f, h=3e-4):
    """Return df/dt at 0, by a rule that is good to h⁴ times a fifth derivative and to eps / h."""
    return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)


def columns(f, n):
    """Return the derivatives of f(x) by the n entries of x, as the last axis."""
    return np.stack([slope(lambda t, e=e: f(t * e)) for e in np.eye(n)], axis=-1)


def quasi():
    """Return a particle in polar coordinates with the velocities along and across its arm."""
    r, phi, rate, turn = sp.symbols("r phi rdot phidot")
    whole = mb.lagrangian.Lagrangian((rate**2 + r**2 * turn**2) / 2, 5 * r**2, [r, phi], name="polar")
    return whole.quasi_velocities(sp.Matrix([[1, 0], [0, 1 / r]]), "along across").dynamics()


# The rate of the tangent


def test_the_tangent_moves_as_model_integrate_and_difference_say(tree):
    dyn, (q, v, _, _) = tree
    check_rate(dyn.model, q, v)
    check_rate(quasi().model, np.array([0.7, 0.3]), np.array([0.4, -0.9]))


def check_rate(model, q, v):
    def along(e, moving):
        """Return d/dt of a change e of the start, both starts moving with v."""

        def changed(t):
            start = model.integrate(q, t * v) if moving else q
            return model.difference(start, model.integrate(model.integrate(q, e), t * v))

        return slope(changed)

    e = np.random.default_rng(0).standard_normal(model.nv)
    for X, moving in zip(tangent_rate(model, q, v), (True, False), strict=True):
        # Two rules one in the other: eps / h².
        close(X @ e, slope(lambda t, moving=moving: along(t * e, moving)), 1e-7)


def test_free_and_ball_joints_have_the_adjoint_of_their_velocity():
    for kind in ("free", "ball"):
        model = random_tree(2, 1, (kind,))
        _, v = model.random_state(np.random.default_rng(0))
        w = skew(v[-3:])
        expected = w if kind == "ball" else np.block([[w, skew(v[:3])], [0 * w, w]])
        A = mb.dynamics(model, "lagrangian", compile=False).linearize(model.neutral(), v, 0 * v)
        n = model.nv
        np.testing.assert_array_equal(A.A[:n, :n], -expected)
        np.testing.assert_array_equal(A.A_fixed[:n, :n], -expected / 2)
        np.testing.assert_array_equal(A.A[:n, n:], np.eye(n))


def test_drake_differentiates_mimic_joints_and_reports_a_pole():
    pytest.importorskip("pydrake")
    model = random_tree(3, 7, ("revolute", "prismatic", "helical"), mimic=True, springs=False, damping=True)
    q, v, a, _ = states(model, 2, 1)
    own, drake = (mb.dynamics(model, e).inverse_dynamics_derivatives(q, v, a) for e in ("lagrangian", "drake"))
    for x, y in zip(own, drake, strict=True):
        close(x, y, 100 * EPS)
    ball = random_tree(2, 1, ("ball",), springs=False)
    upright = np.array([0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)])
    with pytest.raises(NumericalError, match="drake"):
        mb.dynamics(ball, "drake").inverse_dynamics_derivatives(upright, np.ones(3), np.ones(3))


def test_a_large_batch_is_computed_in_slices():
    model = mb.catalog.double_pendulum(mass1=mb.Parameter("m", 2.0))
    dyn, n = mb.dynamics(model, "lagrangian"), 12_000
    q, v, _, tau = states(model, n, 2)
    own = dyn.at(m=np.linspace(1.0, 2.0, n))
    many = own.discretize(q, v, tau, 0.01)
    for k in (0, n // 2, n - 1):
        one = own._of_samples([k]).discretize(q[k : k + 1], v[k : k + 1], tau[k : k + 1], 0.01)
        for x, y in zip(many, one, strict=True):
            close(x[k], y[0], 1e-13)


# Zero-order hold


def test_a_held_force_moves_a_mass_by_parabolas():
    model, h = slider(mass=2.0, axis=(0, 0, 1)).build(), 0.3
    A, B, f = mb.dynamics(model, "lagrangian").linearize([1.0], [3.0], [0.5]).discretize(h)
    a = 0.25 - 9.81
    np.testing.assert_allclose(A, [[1, h], [0, 1]], atol=4 * EPS)
    np.testing.assert_allclose(B, [[h**2 / 4], [h / 2]], atol=4 * EPS)
    np.testing.assert_allclose(f, [3 * h + a * h**2 / 2, a * h], atol=40 * EPS)


def test_hold_is_the_linear_limit_of_every_method(tree):
    dyn, (q, v, _, tau) = tree
    linear = dyn.linearize(q, v, tau)
    errors = []
    for h in (2e-3, 1e-3):
        held, step = linear.discretize(h), dyn.discretize(q, v, tau, h)
        errors.append([np.abs(x - y).max() for x, y in zip(held, step, strict=True)])
    ratio = np.divide(*errors)
    # Both change with the state, which moves by h: errors of h² and, of what f moves by, h³; B has h³ as well.
    assert (ratio > [3.5, 3.5, 6.0]).all()


def test_a_hold_of_no_time_or_beyond_all_numbers_is_refused():
    linear = mb.dynamics(mb.catalog.pendulum(), "lagrangian").linearize([0.0], [0.0], [0.0])
    for dt in (0.0, np.nan):
        with pytest.raises(InputError, match="dt"):
            linear.discretize(dt)
    with pytest.raises(NumericalError, match="overflows"), np.errstate(all="ignore"):
        mb.dynamics(mb.catalog.pendulum(), "lagrangian").linearize([np.pi], [0.0], [0.0]).discretize(1e4)
    # A step that ends nowhere.
    dyn = mb.dynamics(mb.catalog.double_pendulum(), "lagrangian")
    for method in ("rk4", "gauss4", "implicit_midpoint"):
        with pytest.raises(NumericalError):
            dyn.discretize([0.1, 0.2], [1e160, 1e160], [0, 0], 10.0, method)


# Steps


METHODS = ("rk4", "semi_implicit_euler", "gauss4", "gauss6", "implicit_midpoint")


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("method", METHODS)
def test_the_derivative_of_a_step_is_its_differences(tree, method):
    dyn, (q, v, _, tau) = tree
    model, n, h = dyn.model, dyn.model.nv, 0.01

    def stepped(q, v, tau):
        run = mb.simulate(dyn, q, v, h, method, h, torque=tau, doubt=False)
        return run.q[-1], run.v[-1]

    q1, v1 = stepped(q, v, tau)

    def changed(x):
        there = stepped(model.integrate(q, x[:n]), v + x[n : 2 * n], tau + x[2 * n :])
        return np.concatenate([model.difference(q1, there[0]), there[1] - v1])

    A, B, f = dyn.discretize(q, v, tau, h, method)
    for e in np.random.default_rng(0).standard_normal((2, 3 * n)):
        close(np.hstack([A, B]) @ e, slope(lambda t, e=e: changed(t * e)), 1e-9)
    close(f, np.concatenate([model.difference(q, q1), v1 - v]), 1e-12)


def test_of_a_linear_system_it_is_the_methods_stability_function():
    dyn, h = mb.dynamics(slider(stiffness=4.0, damping=0.3).build(), "lagrangian"), 0.1
    Z, one = h * dyn.linearize([0.3], [0.2], [0.0]).A, np.eye(2)
    rk4 = one + Z @ (one + Z / 2 @ (one + Z / 3 @ (one + Z / 4)))
    gauss4 = np.linalg.solve(one - Z / 2 + Z @ Z / 12, one + Z / 2 + Z @ Z / 12)
    gauss2 = np.linalg.solve(one - Z / 2, one + Z / 2)
    for method, expected in (("rk4", rk4), ("gauss4", gauss4), ("implicit_midpoint", gauss2)):
        close(dyn.discretize([0.3], [0.2], [0.0], h, method).A, expected, 8 * EPS)


@pytest.mark.parametrize("kinds", [("revolute", "universal", "prismatic"), ("revolute",)])
def test_the_midpoint_rule_is_symplectic_in_canonical_coordinates(kinds):
    model = random_tree(6, 4, kinds, damping=False, nearest=1)
    dyn = mb.dynamics(model, "lagrangian", compile=False)
    q, v, _, _ = (x[0] for x in states(model, 1, 3))
    n, zero = model.nv, np.zeros(model.nv)
    J = np.block([[0 * np.eye(n), np.eye(n)], [-np.eye(n), 0 * np.eye(n)]])

    def canonical(q, v):
        """Return ∂(q, p)/∂(q, v) with p = M v."""
        by_q = dyn.inverse_dynamics_second_derivatives(q, v, zero).qa @ v
        return np.block([[np.eye(n), 0 * J[:n, :n]], [by_q, dyn.mass_matrix(q)]])

    A, _, f = dyn.discretize(q, v, zero, 0.05, "implicit_midpoint")
    Phi = canonical(q + f[:n], v + f[n:]) @ A @ np.linalg.inv(canonical(q, v))
    close(Phi.T @ J @ Phi, J, 1e3 * EPS * np.linalg.cond(dyn.mass_matrix(q)))


def test_methods_engines_and_models_without_derivatives_say_why():
    pendulum, q, v = mb.catalog.pendulum(), [0.1], [0.2]
    for method in ("rk853", "dop853", "mujoco_rk4", "implicit_midpoint"):
        with pytest.raises(UnsupportedError, match=rf"{method}.*'rk4'"):
            mb.dynamics(pendulum).discretize(q, v, v, 0.1, method)
    with pytest.raises(UnknownNameError):
        mb.dynamics(pendulum).discretize(q, v, v, 0.1, "rk5")
    for engine, call, words in (
        ("mujoco", lambda d: d.linearize([0], [0], [0]), "finite differences"),
        ("mujoco", lambda d: d.discretize([0], [0], [0], 0.1), "finite differences"),
        ("pinocchio", lambda d: d.inverse_dynamics_second_derivatives([0], [0], [0]), "lagrangian"),
        ("pinocchio", lambda d: d.parameter_derivatives("mass_matrix", [0]), "lagrangian"),
    ):
        with pytest.raises(UnsupportedError, match=words):
            call(mb.dynamics(pendulum, engine))
    dyn = quasi()
    with pytest.raises(UnsupportedError, match="quasi-velocities"):
        dyn.discretize([1.0, 0.2], [0.1, 0.2], [0, 0], 0.1)
    assert dyn.linearize([1.0, 0.2], [0.1, 0.2], [0, 0]).A.shape == (4, 4)


# Second derivatives and parameters


@pytest.mark.thorough("free and balls", "mimic")
def test_second_derivatives_are_differences_of_the_first(tree):
    dyn, (q, v, a, _) = tree
    model, n, first = dyn.model, dyn.model.nv, dyn.inverse_dynamics_derivatives
    got = dyn.inverse_dynamics_second_derivatives(q, v, a)
    e = np.random.default_rng(0).standard_normal(n)
    expected = (
        slope(lambda t: first(model.integrate(q, t * e), v, a).q),
        slope(lambda t: first(q, v + t * e, a).q),
        slope(lambda t: first(q, v + t * e, a).v),
        slope(lambda t: first(q, v, a + t * e).q),
    )
    for x, y in zip(got, expected, strict=True):
        close(x @ e, y, 1e-9)
    close(got.vv, got.vv.swapaxes(1, 2), 50 * EPS)
    # The order of two directions along the manifold matters by their bracket.
    c = np.stack([-tangent_rate(model, q, e)[0].T for e in np.eye(n)])
    turned = np.einsum("kjl,il->ijk", c, first(q, v, a).q)
    close(got.qq - got.qq.swapaxes(1, 2), turned, 1e3 * EPS)


def test_second_derivatives_have_the_oracles_digits():
    model = random_tree(8, 3, ("revolute", "ball", "prismatic"), nearest=1)
    q, v, a, _ = states(model, 2, 1)
    own, oracle = (mb.dynamics(model, e).inverse_dynamics_second_derivatives(q, v, a) for e in ("lagrangian", "oracle"))
    for x, y in zip(own, oracle, strict=True):
        assert x.shape == (2, model.nv, model.nv, model.nv)
        close(x, y, 50 * EPS)


def parametric():
    links = []
    for i in range(2):
        com = (0.3, 0.1, mb.Parameter("c", 0.2))
        links.append({"mass": mb.Parameter(f"m{i}", 1.0 + i), "com": com, "inertia": np.diag([0.1, 0.2, 0.25])})
    ball = {"kind": "ball", "damping": mb.Parameter("d", 0.3)}
    return chain(links[0] | ball, links[1] | {"axis": (1, 2, 0), "stiffness": mb.Parameter("s", 4.0)}).build()


def test_derivatives_by_parameters_are_the_oracles_and_differences():
    model = parametric()
    own, oracle = (mb.dynamics(model, e) for e in ("lagrangian", "oracle"))
    q, v, a, tau = states(model, 2, 4)
    nominal = np.array([*model.parameters.values()])
    for name in DIFFERENTIABLE:
        method = getattr(own, name)
        known = {"q": q, "v": v, "a": a, "tau": tau}
        arguments = [known[x] for x in inspect.signature(method).parameters if x in known]
        got = own.parameter_derivatives(name, *arguments)
        assert got.shape == (*np.shape(method(*arguments)), len(nominal))

        def moved(x, name=name, arguments=arguments):
            return getattr(own.at(**dict(zip(model.parameters, nominal + x, strict=True))), name)(*arguments)

        close(got, columns(moved, len(nominal)), 1e-8)
        close(got, oracle.parameter_derivatives(name, *arguments), 500 * EPS)
        close(got[1], own.parameter_derivatives(name, *(x[1] for x in arguments)), 4 * EPS)


def test_derivatives_by_parameters_are_taken_at_their_values():
    dyn = mb.dynamics(mb.catalog.pendulum(mass=mb.Parameter("m", 2.0), length=mb.Parameter("l", 1.0)), "lagrangian")
    lengths = np.array([0.5, 1.0, 2.0])
    got = dyn.at(l=lengths).parameter_derivatives("mass_matrix", [0.0])
    np.testing.assert_allclose(got[:, 0, 0], np.stack([lengths**2, 4 * lengths], -1)[:, [*"ml"].index("m") :])
    plain = mb.dynamics(mb.catalog.pendulum(), "lagrangian")
    assert plain.parameter_derivatives("gravity", [0.1]).shape == (1, 0)
    with pytest.raises(UnknownNameError, match="inverse_dynamics"):
        dyn.parameter_derivatives("inverse_dynamic", [0.0])
    with pytest.raises(InputError, match="q, v"):
        dyn.parameter_derivatives("nle", [0.0])
