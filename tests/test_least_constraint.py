"""Forward dynamics that forms no mass matrix: its factors, what it keeps, and where it is taken."""

from __future__ import annotations

import warnings
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import mbkit as mb
from mbkit import catalog
from mbkit.derivation.equations import Equations
from mbkit.derivation.least_constraint import LeastConstraint, cancellation, inertia_squares, squares
from mbkit.derivation.mass_matrix_solve import elimination_order
from mbkit.engines.oracle import OracleDynamics
from mbkit.errors import NonPhysicalWarning, NumericalError
from mbkit.studies.stress import cases
from tests.random_trees import SOUND, off, random_tree, rotation, states
from tests.scenes import chain

EPS = np.finfo(float).eps


def errors(value, exact):
    """Return the relative error of each sample, against a pair of doubles."""
    high, low = exact
    return np.linalg.norm((value - high) - low, axis=1) / np.linalg.norm(high, axis=1)


def thinned(model, rng, decades=0.0):
    """Return the model with masses over some decades, and a rod and a point among its bodies."""
    bodies = list(model.bodies)
    for k, body in enumerate(bodies):
        scale = 10 ** rng.uniform(-decades, decades)
        inertia = scale * body.inertia
        if k == 3:
            axis = rotation(rng)[0]
            inertia = scale * (np.eye(3) - np.outer(axis, axis))
        bodies[k] = replace(body, mass=scale * body.mass, inertia=np.zeros((3, 3)) if k == 5 else inertia)
    return replace(model, bodies=tuple(bodies))


def cart_pole(cart, turned=0.0):
    """Return a pole of 1 kg on a cart, its zero turned."""
    model = catalog.cart_pole(cart_mass=cart)
    slide, pivot = model.joints
    c, s = np.cos(turned), np.sin(turned)
    placed = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return replace(model, joints=(slide, replace(pivot, rotation=pivot.rotation @ placed)))


def near_straight(n=20):
    """Return states of a cart-pole whose pole hangs or stands, more or less."""
    rng = np.random.default_rng(0)
    q = np.zeros((n, 2))
    q[:, 1] = np.pi * rng.integers(2, size=n) + 10 ** rng.uniform(-10, 0, n)
    v, tau = rng.standard_normal((2, n, 2))
    return q, v, tau


# The elimination


@pytest.mark.parametrize("mimic", [False, True])
def test_factors_reproduce_the_mass_matrix_and_solve_the_equation_of_motion(mimic):
    """Of every joint kind, with rods, points, rotors, springs and dampers."""
    model = thinned(random_tree(3, 10, mimic=mimic), np.random.default_rng(0))
    eq, n = Equations(model), model.nv
    way = LeastConstraint(squares(eq.kin), elimination_order(model))
    L = ca.SX.eye(n)
    for k, row in enumerate(way.factors):
        for i, factor in row.items():
            L[k, i] = factor
    D = ca.diag(1 / ca.vertcat(*way.inverse))
    a = way.accelerations(eq.tau + eq.passive)
    rest = ca.substitute(eq.inverse_dynamics, eq.a, a) - eq.tau
    unit = ca.mtimes(eq.mass_matrix, way.solve(ca.SX.eye(n)))
    f = ca.Function("f", [eq.q, eq.v, eq.tau], [ca.mtimes([L.T, D, L]), eq.mass_matrix, rest, unit, D])
    for q, v, _, tau in zip(*states(model, 3), strict=True):
        made, M, rest, unit, D = (x.full() for x in f(q, v, tau))
        assert off(made, M) < 50 * EPS
        assert (np.diag(D) > 0).all()
        loss = 20 * EPS * np.linalg.cond(M)
        assert np.linalg.norm(rest) < loss * (np.linalg.norm(tau) + np.linalg.norm(M) * np.linalg.norm(v) ** 2)
        assert off(unit, np.eye(n)) < loss


@pytest.mark.parametrize("thin", [False, True])
def test_an_inertia_is_a_sum_of_squares_whose_turning_is_its_torque(thin):
    rng = np.random.default_rng(1)
    R = rotation(rng)
    inertia = R @ np.diag([1.0, 1.0, 0.0] if thin else [1.0, 2.0, 2.5]) @ R.T
    rows = inertia_squares(tuple(inertia.ravel().tolist()))
    w = rng.standard_normal(3)
    u = np.array([row.direction for row in rows])
    weights = np.array([row.weight for row in rows])
    turning = [sum(c * w[i] * w[j] for (i, j), c in row.turning) for row in rows]
    assert off((u.T * weights) @ u, inertia) < 4 * EPS
    assert off(u.T @ (weights * turning), np.cross(w, inertia @ w)) < 8 * EPS


def test_rods_points_and_what_no_matter_can_have():
    rod = inertia_squares((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0))
    assert [row.weight for row in rod] == [1.0, 1.0]
    assert inertia_squares((0.0,) * 9) == ()
    # One moment alone: a torque about another axis finds nothing to turn.
    assert inertia_squares((1.0, *(0.0,) * 8)) is None
    assert inertia_squares((0.0, 1.0, 0.0, 1.0, *(0.0,) * 5)) is None


# What it keeps


@pytest.mark.parametrize("mass", [1e-6, 1e-9, 1e-12])
def test_a_light_cart_keeps_all_digits_where_its_pole_is_straight(mass):
    model, (q, v, tau) = catalog.cart_pole(cart_mass=mass), near_straight()
    dyn = mb.dynamics(model, "lagrangian")
    assert dyn.elimination == "least constraint"
    exact = mb.dynamics(model, "oracle").extended("forward_dynamics", q, v, tau)
    assert errors(dyn.forward_dynamics(q, v, tau), exact).max() < 8 * EPS


def test_machine_code_and_derivatives_take_the_same_way():
    model, (q, v, tau) = catalog.cart_pole(cart_mass=1e-9), near_straight()
    dyn, oracle = mb.dynamics(model, "lagrangian", compile=True), mb.dynamics(model, "oracle")
    exact = oracle.extended("forward_dynamics", q, v, tau)
    assert errors(dyn.forward_dynamics(q, v, tau), exact).max() < 8 * EPS
    inverse = mb.dynamics(model, "lagrangian").forward_dynamics_derivatives(q, v, tau).tau
    assert off(inverse, oracle.forward_dynamics_derivatives(q, v, tau).tau) < 16 * EPS


@pytest.mark.parametrize("name", ["heavy_tip", "loaded_arm"])
def test_a_heavy_end_costs_no_digits(name):
    """Where the mass matrix costs seven: the chain's lengths, ones and halves, are known exactly."""
    model = cases.get(name).make(1e9).model
    rng = np.random.default_rng(0)
    q, v = model.random_state(rng, 20)
    dyn = mb.dynamics(model, "lagrangian")
    assert dyn.elimination == "least constraint"
    exact = mb.dynamics(model, "oracle").extended("forward_dynamics", q, v, np.zeros_like(v))
    assert errors(dyn.forward_dynamics(q, v, np.zeros_like(v)), exact).max() < 1e5 * EPS


@pytest.mark.thorough("1")
@pytest.mark.parametrize("seed", [0, 1])
def test_an_error_is_what_the_descriptions_own_rounding_makes(seed):
    """On random trees of any axes: no double arithmetic can know more of a system whose numbers are doubles."""
    rng = np.random.default_rng([seed, 5])
    model = random_tree(seed, 8, SOUND, armature=False, springs=False, damping=False, nearest=2)
    masses = 10 ** rng.uniform(-4.5, 4.5, len(model.bodies))
    scaled = (replace(b, mass=s * b.mass, inertia=s * b.inertia) for b, s in zip(model.bodies, masses, strict=True))
    model = replace(model, bodies=tuple(scaled))
    q, v, _, tau = states(model, 6, seed)
    oracle, eq = OracleDynamics(model), Equations(model)
    exact = oracle.extended("forward_dynamics", q, v, tau)
    numbers = oracle.equations.constant_values
    inherent = np.zeros(len(q))
    for _ in range(2):
        changed = numbers * (1 + EPS / 2 * rng.choice([-1, 1], numbers.shape))
        other = OracleDynamics(model, constants=changed).extended("forward_dynamics", q, v, tau)[0]
        inherent = np.maximum(inherent, errors(other, exact))
    a = LeastConstraint(squares(eq.kin), elimination_order(model)).accelerations(eq.tau + eq.passive)
    f = ca.Function("f", [eq.q, eq.v, eq.tau], [a])
    found = errors(np.array([f(*x).full()[:, 0] for x in zip(q, v, tau, strict=True)]), exact)
    # Two draws of signs find the worst to a factor of some ten.
    assert (found < 30 * (inherent + EPS)).all()
    assert inherent.max() > 100 * EPS


# Where it is taken


def test_taken_where_a_mass_matrix_would_lose_digits():
    assert mb.dynamics(cart_pole(1e-8, turned=0.3), "lagrangian").elimination == "least constraint"
    for model in (
        catalog.cart_pole(),
        catalog.cart_pole(cart_mass=1e-3),
        catalog.chain(n=12),
        random_tree(0, kinds=SOUND),
    ):
        assert mb.dynamics(model, "lagrangian").elimination == "links"
    # Gimbal lock is a pose of every mass.
    assert mb.dynamics(random_tree(0, 3, ("ball", "spherical_zyx")), "lagrangian").elimination == "least constraint"
    # Nothing is lost where a coordinate does nothing by itself.
    assert mb.dynamics(catalog.spherical_pendulum(), "lagrangian").elimination == "links"
    # The orthogonal elimination would take too many operations.
    assert mb.dynamics(catalog.chain(n=40), "lagrangian").elimination == "links"


def test_how_much_would_be_lost():
    """M + m over M for the cart, found where its pole is straight, wherever that is."""
    assert cancellation(cart_pole(1e-8)) == pytest.approx(1e8, rel=1e-2)
    assert cancellation(cart_pole(1e-8, turned=0.3)) == pytest.approx(1e8, rel=0.5)
    assert cancellation(catalog.pendulum()) == 1.0


def test_a_joint_that_moves_nothing_is_told_as_before():
    rod = {"mass": 1.0, "com": (0, 0, -0.5), "inertia": (1.0, 1.0, 0.0), "axis": (0, -1, 0)}
    with pytest.warns(NonPhysicalWarning):
        model = chain(rod, {"mass": 1.0, "axis": (0, 0, 1)}).build(nonphysical="warn")
    dyn = mb.dynamics(model, "lagrangian")
    assert dyn.elimination == "links"
    with pytest.raises(NumericalError):
        dyn.forward_dynamics(np.ones(2), np.ones(2), np.ones(2))


def test_parameters_are_decided_at_their_nominal_values():
    light = mb.dynamics(catalog.cart_pole(cart_mass=mb.Parameter("M", 1e-9)), "lagrangian")
    heavy = mb.dynamics(catalog.cart_pole(cart_mass=mb.Parameter("M", 1.0)), "lagrangian")
    none = mb.dynamics(catalog.cart_pole(cart_mass=mb.Parameter("M")), "lagrangian")
    ways = [dyn.elimination for dyn in (light, heavy, heavy.at(M=1e-9), none)]
    assert ways == ["least constraint", "links", "links", "links"]
    assert light.model.form_digest == heavy.model.form_digest
    assert light._form != heavy._form
    q, v, tau = near_straight()
    exact = mb.dynamics(catalog.cart_pole(cart_mass=1e-9), "oracle").extended("forward_dynamics", q, v, tau)
    assert errors(light.forward_dynamics(q, v, tau), exact).max() < 8 * EPS
    assert off(light.at(M=1.0).forward_dynamics(q, v, tau), heavy.forward_dynamics(q, v, tau)) < 1e-14


def test_an_inertia_that_is_a_parameter_may_become_a_rods():
    moments = (mb.Parameter("A", 0.1), mb.Parameter("B", 0.2), mb.Parameter("C", 0.25))
    body = {"kind": "spherical_zyx", "mass": 1.0, "com": (0.1, 0.2, 0.3), "inertia": moments}
    dyn = mb.dynamics(chain(body).build(), "lagrangian")
    assert dyn.elimination == "least constraint"
    q, v, _, tau = states(dyn.model, 5)
    for values in ({}, {"A": 0.0, "B": 0.2, "C": 0.2}):
        at = dyn.at(**values)
        assert off(at.inverse_dynamics(q, v, at.forward_dynamics(q, v, tau)), tau) < 1e-12


def test_symbols_and_written_systems_keep_the_mass_matrix():
    model = catalog.cart_pole(cart_mass=1e-9)
    assert Equations(model, "symbols").least_constraint is None
    written = mb.lagrangian.from_model(model).dynamics()
    assert written.elimination == "mass matrix"
    assert written.equations.least_constraint is None


def test_fewer_squares_than_velocities_are_a_singular_mass_matrix_and_no_fault():
    """Two virtual links and a point: whether its mass is a number or a parameter."""
    for mass in (1.0, mb.Parameter("m", 1.0)):
        light = {"mass": 0.0, "com": (0.3, 0.1, 0.2)}
        links = light | {"kind": "planar"}, light | {"axis": (0, 1, 0)}, light | {"mass": mass, "axis": (1, 0, 0)}
        model = chain(*links).build(nonphysical="warn")
        dyn = mb.dynamics(model, "lagrangian", compile=False)
        assert dyn.elimination == "links"
        q, _ = model.random_state(np.random.default_rng(0))
        assert np.linalg.matrix_rank(dyn.mass_matrix(q)) == 3


@pytest.mark.parametrize("inertia", [(0, 0, 1.0), (0, 1.0, 1.0)], ids=["flat", "rod"])
def test_planar_descriptions_keep_their_digits(inertia):
    """Two light links and a point of 1 kg at their end; a flat inertia is no body's, and common in planar models."""
    light = {"mass": 1e-9, "com": (0.5, 0, 0), "inertia": np.multiply(inertia, 1e-9 / 12), "axis": (0, 0, 1)}
    further = {"translation": (1.0, 0, 0)}
    point = {"mass": 1.0, "com": (1.0, 0, 0), "inertia": (0, 0, 0), "axis": (0, 0, 1)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NonPhysicalWarning)
        b = chain(light, light | further, point | further, gravity=(0, -9.81, 0))
        model = b.build(nonphysical="warn")
    dyn, oracle = mb.dynamics(model, "lagrangian", compile=False), OracleDynamics(model)
    assert dyn.elimination == "least constraint"
    q, v, tau = np.random.default_rng(1).standard_normal((3, 20, 3))
    exact = oracle.extended("forward_dynamics", q, v, tau)
    # Two in the angles' sines are half of what is left where the arm is nearly straight.
    assert errors(dyn.forward_dynamics(q, v, tau), exact).max() < 1e-13


def test_poses_are_found_one_coordinate_after_the_other():
    """Three poles of any zeros on one light cart; a ball on a rod that is turned into its own axis."""
    rng = np.random.default_rng(3)
    coms = [(np.sin(turned), 0, np.cos(turned)) for turned in rng.uniform(-3, 3, 3)]
    poles = [{"mass": 1.0, "com": com, "parent": "b0", "axis": (0, 1, 0)} for com in coms]
    assert cancellation(chain({"kind": "prismatic", "mass": 1e-9, "axis": (1, 0, 0)}, *poles).build()) > 1e8
    rod = {"kind": "universal", "mass": 1e-3, "inertia": (1, 1, 1e-9), "axis": (1, 0, 0), "axis2": (0, 1, 0)}
    assert cancellation(chain(rod, {"kind": "ball", "mass": 1.0, "inertia": (1, 1, 1)}).build()) > 1e6
