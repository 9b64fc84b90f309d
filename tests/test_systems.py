"""Systems on paper: the same as the catalog's in every engine, and as closed forms written here."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

import mbkit as mb
from mbkit.errors import InputError, UnknownNameError
from mbkit.lagrangian import systems
from tests.random_trees import off

# A few dozen rounded operations.
CLOSE = 1e-14
INTERPRETED = {"compile": False}
RNG = np.random.default_rng(5)
Q3, V3 = RNG.uniform(-1.2, 1.2, (5, 3)), RNG.standard_normal((5, 3))
TAU3 = RNG.standard_normal((5, 3))


def run(name, **values):
    return systems.get(name)(**values).dynamics(options=INTERPRETED)


RELATIVE = np.array([[1.0, 0.0], [-1.0, 1.0]])
#: Paper's name, its arguments, the catalog's, and the matrix from paper's coordinates to the model's.
PAIRS = {
    "pendulum": ({"mass": 0.7, "length": 1.3}, {"mass": 0.7, "length": 1.3}, np.eye(1)),
    "double_pendulum": ({"mass1": 0.7, "length2": 0.6}, {"mass1": 0.7, "length2": 0.6}, RELATIVE),
    "elastic_pendulum": ({"stiffness": 30.0}, {"stiffness": 30.0}, np.eye(2)),
    "cart_pole": ({"pole_mass": 0.3}, {"pole_mass": 0.3}, np.eye(2)),
    "acrobot": ({}, {}, np.eye(2)),
    "furuta_pendulum": (
        {"arm_inertia": 4e-3, "pendulum_inertia": 7e-4},
        {"arm_mass": 0.2, "arm_com": 0.1, "arm_inertia": 2e-3, "pendulum_inertia": (7e-4, 7e-4, 0.0)},
        np.eye(2),
    ),
    "gyroscope": ({}, {}, np.eye(3)),
}


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio", "mujoco"])
@pytest.mark.parametrize("name", list(PAIRS))
def test_paper_is_the_catalogs_model_in_every_engine(name, engine):
    own, other, S = PAIRS[name]
    dyn = run(name, **own)
    ref = mb.dynamics(mb.catalog.get(name)(**other), engine)
    n = len(S)
    q, v, tau = Q3[:, :n], V3[:, :n], TAU3[:, :n]
    # q' = S q, so M = Sᵀ M' S and forces are Sᵀ f'.
    there = (q @ S.T, v @ S.T)
    M = S.T @ ref.mass_matrix(there[0]) @ S
    assert off(dyn.mass_matrix(q), M) < CLOSE
    stiff = ref.passive(*there) if "passive" in ref.supports else 0.0
    assert off(dyn.nle(q, v) - dyn.passive(q, v), (ref.nle(*there) - stiff) @ S) < CLOSE
    assert off(dyn.gravity(q), (ref.gravity(there[0]) - stiff) @ S) < CLOSE
    a = ref.forward_dynamics(*there, tau @ np.linalg.inv(S)) @ np.linalg.inv(S).T
    assert off(dyn.forward_dynamics(q, v, tau), a) < CLOSE * np.linalg.cond(M).max()
    T, V = dyn.kinetic_energy(q, v), dyn.potential_energy(q)
    assert off(T, ref.kinetic_energy(*there)) < CLOSE
    assert np.ptp(V - ref.potential_energy(there[0])) < CLOSE * max(1.0, np.abs(V).max())


def test_spherical_pendulum_is_the_catalogs_in_other_angles():
    dyn, ref = (
        run("spherical_pendulum", length=0.8),
        mb.dynamics(mb.catalog.spherical_pendulum(length=0.8), "pinocchio"),
    )
    th, ph = 0.9, 0.4
    w, u = 0.7, -1.1
    # Where the mass is, and how it moves, in both coordinates.
    p = np.array([np.sin(th) * np.cos(ph), np.sin(th) * np.sin(ph), -np.cos(th)])
    be, al = np.arcsin(p[1]), np.arctan2(p[0], -p[2])
    by = np.array(
        [
            [np.cos(th) * np.cos(ph), -np.sin(th) * np.sin(ph)],
            [np.cos(th) * np.sin(ph), np.sin(th) * np.cos(ph)],
            [np.sin(th), 0],
        ]
    )
    other = np.array(
        [
            [np.cos(al) * np.cos(be), -np.sin(al) * np.sin(be)],
            [0, np.cos(be)],
            [np.sin(al) * np.cos(be), np.cos(al) * np.sin(be)],
        ]
    )
    S = np.linalg.lstsq(other, by, rcond=None)[0]
    q = np.array([th, ph])
    assert np.allclose(dyn.mass_matrix(q), S.T @ ref.mass_matrix(np.array([al, be])) @ S, rtol=1e-13)
    assert np.allclose(dyn.gravity(q), S.T @ ref.gravity(np.array([al, be])), rtol=1e-13, atol=1e-14)
    v = np.array([w, u])
    assert dyn.kinetic_energy(q, v) == pytest.approx(ref.kinetic_energy(np.array([al, be]), S @ v), rel=1e-14)


def euler(q):
    """Return R of z-x-z and B of the body rates ω = B(q) q̇ (Goldstein, eq. 4.87)."""
    ph, th, ps = q

    def z(x):
        return np.array([[np.cos(x), -np.sin(x), 0], [np.sin(x), np.cos(x), 0], [0, 0, 1]])

    x = np.array([[1, 0, 0], [0, np.cos(th), -np.sin(th)], [0, np.sin(th), np.cos(th)]])
    B = np.array(
        [[np.sin(th) * np.sin(ps), np.cos(ps), 0], [np.sin(th) * np.cos(ps), -np.sin(ps), 0], [np.cos(th), 0, 1]]
    )
    return z(ph) @ x @ z(ps), B


def quaternion(R):
    w = np.sqrt(1 + np.trace(R)) / 2
    return np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 4 * w * w]) / (4 * w)


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio", "mujoco"])
@pytest.mark.parametrize("name", ["heavy_top", "rigid_body"])
def test_bodies_in_euler_angles_are_those_in_body_rates(name, engine):
    if name == "heavy_top":
        dyn = run("heavy_top", mass=2.0, length=0.3, across=0.5, axial=0.2)
        model = mb.catalog.heavy_top(mass=2.0, com=(0, 0, 0.3), inertia=(0.5 - 0.18, 0.5 - 0.18, 0.2))
    else:
        dyn = run("rigid_body")
        model = mb.catalog.heavy_top(mass=2.0, com=(0, 0, 0), inertia=(1.0, 2.0, 2.5), gravity=0.0)
    ref = mb.dynamics(model, engine)
    q, v = np.array([0.3, 0.8, -0.4]), np.array([1.1, -0.7, 2.0])
    R, B = euler(q)
    at, w = quaternion(R), B @ v
    assert np.allclose(dyn.mass_matrix(q), B.T @ ref.mass_matrix(at) @ B, rtol=1e-13, atol=1e-15)
    assert np.allclose(dyn.gravity(q), B.T @ ref.gravity(at), rtol=1e-13, atol=1e-14)
    # ω̇ = B q̈ + Ḃ q̇; Ḃ by a central difference of fourth order.
    h = 1e-4
    rate = sum(k * euler(q + s * h * v)[1] for s, k in ((-2, 1), (-1, -8), (1, 8), (2, -1))) / (12 * h)
    a = dyn.forward_dynamics(q, v, np.zeros(3))
    assert np.allclose(B @ a + rate @ v, ref.forward_dynamics(at, w, np.zeros(3)), rtol=1e-10, atol=1e-10)


def test_kepler_is_an_ellipse():
    dyn = run("kepler")
    # e = 1/2 from the pericentre: a = 2, and half a period later the apocentre at r = 3.
    q, v = np.array([1.0, 0.0]), np.array([0.0, np.sqrt(1.5)])
    assert np.allclose(dyn.forward_dynamics(q, v, np.zeros(2)), [0.5, 0.0], atol=1e-15)
    half = np.pi * np.sqrt(2.0**3)
    end = mb.simulate(dyn, q, v, half, "rk853", rtol=1e-12, save=[0.0, half])
    assert end.q[-1] == pytest.approx([3.0, np.pi], abs=1e-8)


def test_bead_rests_where_the_hoop_turns_fast():
    lag = systems.bead_on_hoop(radius=0.5, speed=6.0)
    assert lag.kinetic_split()[2] != 0
    rest = np.arccos(9.81 / (0.5 * 36))
    dyn = lag.dynamics(options=INTERPRETED)
    assert dyn.forward_dynamics([rest], [0.0], [0.0]) == pytest.approx([0.0], abs=1e-14)
    th = np.array([[0.3], [2.0]])
    expected = 36 * np.sin(th) * np.cos(th) - 9.81 / 0.5 * np.sin(th)
    assert dyn.forward_dynamics(th, th, 0 * th) == pytest.approx(expected, rel=1e-14)


def test_driven_pendulum_has_its_closed_form():
    dyn = run("driven_pendulum", length=0.7, amplitude=0.05, frequency=20.0)
    th, t = np.array([[0.4], [2.5]]), 0.123
    # θ̈ = -(g - a Ω² cos Ωt) sin θ / l, as gravity in the pivot's frame.
    expected = -(9.81 - 0.05 * 400 * np.cos(20 * t)) * np.sin(th) / 0.7
    assert dyn.at(t=t).forward_dynamics(th, 3 * th, 0 * th) == pytest.approx(expected, rel=1e-13)


def slider(th, r, l):
    ph = np.arcsin(r / l * np.sin(th))
    return np.sin(th + ph) / np.cos(ph)


def test_slider_crank_is_the_classic_text_s():
    m, r, l, tau, F = 0.4, 0.1, 0.25, 0.7, 30.0
    dyn = run("slider_crank", mass=m, crank=r, rod=l, torque=tau, force=F)
    th, w = np.array([0.3, 1.4, 2.6, 4.0]), np.array([2.0, -1.0, 5.0, 0.3])
    J = m * r**2 * slider(th, r, l) ** 2
    h = 1e-4
    slope = (
        m * r**2 * sum(k * slider(th + s * h, r, l) ** 2 for s, k in ((-2, 1), (-1, -8), (1, 8), (2, -1))) / (12 * h)
    )
    assert dyn.mass_matrix(th[:, None])[:, 0, 0] == pytest.approx(J, rel=1e-13)
    Q = tau + F * r * slider(th, r, l)
    a = dyn.forward_dynamics(th[:, None], w[:, None], np.zeros((4, 1)))[:, 0]
    assert a == pytest.approx((Q - slope * w**2 / 2) / J, rel=1e-9)
    # The force does the work of the piston's way: Q δθ = -F δx.
    x = [r * np.cos(t) + np.sqrt(l**2 - (r * np.sin(t)) ** 2) for t in (0.3 - h, 0.3 + h)]
    assert Q[0] - tau == pytest.approx(-F * (x[1] - x[0]) / (2 * h), rel=1e-7)


def test_dead_centres_have_no_inertia():
    dyn = run("slider_crank")
    assert dyn.mass_matrix([0.0])[0, 0] == 0.0
    assert systems.rigid_slider_crank().dynamics(options=INTERPRETED).mass_matrix([0.0])[0, 0] > 0


def test_rigid_slider_crank_has_the_published_inertia():
    dyn = run("rigid_slider_crank")
    assert dyn.mass_matrix([0.0])[0, 0] == pytest.approx(0.0013333333333333337, rel=1e-14)
    assert dyn.mass_matrix([np.pi / 2])[0, 0] == pytest.approx(0.006666666666666668, rel=1e-14)


def test_one_degree_takes_functions_and_expressions():
    k = sp.Symbol("k")
    lag = systems.one_degree(lambda q: 1 + q**2, lambda q: k * q**2 / 2, lambda _, w: -w / 2, parameters={k: 4.0})
    dyn = lag.dynamics(options=INTERPRETED)
    q, w = 0.3, 1.2
    assert dyn.forward_dynamics([q], [w], [0.1])[0] == pytest.approx(
        (0.1 - w / 2 - q * w**2 - 4 * q) / (1 + q**2), rel=1e-14
    )
    x = sp.Symbol("x")
    squared = systems.one_degree(2, x**2, coordinate=x)
    assert squared.V - x**2 == 0


def test_friction_and_drag():
    block = run("sliding_block", slope=0.5, friction=0.2)
    down = 9.81 * (np.sin(0.5) - 0.2 * np.cos(0.5))
    assert block.forward_dynamics([0.0], [1.0], [0.0]) == pytest.approx([down], rel=1e-13)
    body = run("falling_body", mass=2.0, drag=0.5)
    limit = np.sqrt(2.0 * 9.81 / 0.5)
    assert body.forward_dynamics([0.0], [-limit], [0.0]) == pytest.approx([0.0], abs=1e-14)
    assert body.forward_dynamics([0.0], [1.0], [0.0]) == pytest.approx([-9.81 - 0.25], rel=1e-14)


@pytest.mark.parametrize("name", systems.names())
def test_every_system_reads_and_says_where_it_is_from(name):
    function = systems.get(name)
    lag = function()
    assert lag.name == name
    assert "References" in function.__doc__
    assert all(f"``{q}``" in function.__doc__ for q in lag.coordinates)
    eq = lag.equations()
    assert str(eq)
    # M and the Christoffel matrix belong together: Ṁ - 2C is skew.
    rate = sum(
        (eq.mass_matrix.diff(q) * w for q, w in zip(lag.coordinates, lag.velocities, strict=True)),
        sp.zeros(*eq.mass_matrix.shape),
    )
    S = rate - 2 * eq.coriolis_matrix
    at = dict(zip((*lag.coordinates, *lag.velocities), (0.4, 0.7, 1.1, 0.3, -0.9, 0.5), strict=False))
    at |= {s: x or 0.3 for s, x in lag.parameters.items()} | ({lag.time: 0.1} if lag.time else {})
    defect = np.array((S + S.T).subs(at).evalf(), dtype=float)
    assert np.abs(defect).max() < 1e-13 * max(1.0, np.abs(np.array(rate.subs(at).evalf(), dtype=float)).max())


def test_bad_input():
    with pytest.raises(UnknownNameError, match="'kepler'"):
        systems.get("keplr")
    with pytest.raises(InputError, match="mass"):
        systems.pendulum(mass=-1.0)
    lag = systems.pendulum(mass=None)
    assert lag.dynamics(options=INTERPRETED, m=2.0).mass_matrix([0.0])[0, 0] == 2.0
