"""Impacts: textbooks' blows and rebounds, on paper and on every engine."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import sympy as sp

import mbkit as mb
from mbkit.errors import InputError, NumericalError
from mbkit.lagrangian import Lagrangian, from_model, systems
from tests.random_trees import random_tree

EPS = float(np.finfo(float).eps)
ENGINES = ("lagrangian", "pinocchio", "mujoco", "oracle")


# Textbooks


def test_a_blow_at_the_centre_of_percussion_leaves_the_hinge_at_rest() -> None:
    # A uniform rod, hung at its end: the blow S at s turns it by 3 S s / (m l²), with S (1 - 3 s / (2 l)) at the hinge.
    m, l, s, S, x, theta = sp.symbols("m l s S x theta", positive=True)
    xdot, omega = sp.symbols("xdot thetadot")
    # Of a rod that hangs, with its end at x and its angle small.
    T = m * (xdot + l / 2 * omega) ** 2 / 2 + m * l**2 / 12 * omega**2 / 2
    rod = Lagrangian(T, 0, [x, theta], parameters=[m, l])
    blow = rod.impulse({x: S, theta: S * s}, rows=[xdot])
    assert (
        sp.simplify(blow.after()[sp.Symbol("thetadot_after")] - omega - 3 * S * s / (m * l**2) - (3 * xdot / (2 * l)))
        == 0
    )
    hinge = blow.reactions()[sp.Symbol("P1")].subs({xdot: 0, omega: 0})
    assert sp.simplify(hinge + S * (1 - 3 * s / (2 * l))) == 0
    assert hinge.subs(s, 2 * l / 3).simplify() == 0


def test_two_rods_struck_at_an_end_turn_in_opposite_ways() -> None:
    """Two equal rods in line, hinged to each other and at rest: momenta and moments of each rod, written apart."""
    m, l, S = 1.3, 0.7, 0.4
    I = m * l**2 / 12
    # v1, v2 of the centres, the rates, and the hinge's impulse on the far rod.
    laws = [[m, 0, 0, 0, 1], [0, m, 0, 0, -1], [0, 0, I, 0, l / 2], [0, 0, 0, I, l / 2], [1, -1, l / 2, l / 2, 0]]
    v1, v2, w1, w2, _ = np.linalg.solve(laws, [S, 0, -S * l / 2, 0, 0])
    y, p, q, ydot, pdot, qdot = sp.symbols("y phi1 phi2 ydot phidot1 phidot2")
    first, second = ydot + l / 2 * pdot, ydot + l * pdot + l / 2 * qdot
    T = m * (first**2 + second**2) / 2 + I * (pdot**2 + qdot**2) / 2
    after = Lagrangian(T, 0, [y, p, q], [ydot, pdot, qdot]).impulse({y: S}).after()
    got = [float(x.subs(dict.fromkeys((ydot, pdot, qdot), 0))) for x in after.values()]
    assert got[1:] == pytest.approx([w1, w2], rel=1e-14)
    assert got[0] + l / 2 * got[1] == pytest.approx(v1, rel=1e-14)
    assert w1 < 0 < w2
    assert v2 < 0 < v1


def test_an_elastic_ball_on_a_rod_keeps_energy_and_an_inelastic_one_loses_carnots() -> None:
    m, M, l, e = sp.symbols("m M l e", positive=True)
    x, theta, xdot, omega = sp.symbols("x theta xdot thetadot")
    # A ball runs against the end of a rod on a hinge: the approach is xdot - l thetadot.
    system = Lagrangian(m * xdot**2 / 2 + M * l**2 * omega**2 / 6, 0, [x, theta], parameters=[m, M, l])
    hit = system.impulse(rows=[xdot - l * omega], restitution=e)
    reduced = m * M / (3 * m + M)
    assert sp.simplify(hit.energy_change + reduced * (1 - e**2) * (xdot - l * omega) ** 2 / 2) == 0
    assert "e" in str(hit)
    assert r"\dot{x}" in hit.latex()
    assert pickle.loads(pickle.dumps(hit)).equations() == hit.equations()


def test_symbols_of_a_blow_are_no_unknowns() -> None:
    theta, omega, P1, after = sp.symbols("theta thetadot P1 thetadot_after")
    blow = Lagrangian(omega**2 / 2, 0, [theta]).impulse({theta: P1 + after}, rows=[omega])
    assert not {P1, after} & {*blow.impulse_symbols, *blow.velocities_after}
    assert sp.expand(next(iter(blow.reactions().values())) + P1 + after + omega) == 0


# Engines


def test_every_engine_agrees_with_the_equations_on_paper() -> None:
    model = mb.catalog.double_pendulum()
    paper = from_model(model)
    q, v, blow = np.array([0.4, -0.9]), np.array([1.1, -2.0]), np.array([0.2, -0.1])
    row = [0.3, 0.8]
    first, second = paper.velocities
    a, b = paper.coordinates
    told = paper.impulse(
        {a: blow[0], b: blow[1]}, rows=[row[0] * first + row[1] * second], restitution=sp.Rational(2, 5)
    )
    numbers = {s: x for s, x in paper.parameters.items() if x is not None}
    place = {a: q[0], b: q[1], first: v[0], second: v[1], **numbers}
    after, reactions = ([float(x.subs(place)) for x in of().values()] for of in (told.after, told.reactions))
    lost = float(told.energy_change.subs(place))
    for engine in ENGINES:
        hit = mb.impact(mb.dynamics(model, engine), q, v, blow, jacobian=row, restitution=0.4)
        assert hit.v == pytest.approx(after, rel=200 * EPS)
        assert hit.impulses == pytest.approx(reactions, rel=200 * EPS)
        assert hit.energy_change == pytest.approx(lost, rel=1e3 * EPS)


@pytest.mark.parametrize("seed", range(2))
def test_random_trees_keep_the_laws_of_impact(seed) -> None:
    model, rng = random_tree(seed), np.random.default_rng(seed)
    dyn = mb.dynamics(model, "lagrangian", compile=False)
    q, v = model.random_state(rng)
    G = rng.standard_normal((min(2, model.nv), model.nv))
    M = dyn.mass_matrix(q)
    hit = mb.impact(dyn, q, v, jacobian=G)
    scale = np.abs(v).max() * np.linalg.cond(M) * EPS
    assert G @ hit.v == pytest.approx(np.zeros(len(G)), abs=100 * scale)
    change = hit.v - v
    assert M @ change == pytest.approx(G.T @ hit.impulses, abs=100 * scale * np.abs(M).max())
    # Carnot: what is lost is the energy of the velocity that is lost.
    assert hit.energy_change == pytest.approx(-0.5 * change @ M @ change, rel=1e3 * EPS * np.linalg.cond(M))
    elastic = mb.impact(dyn, q, v, jacobian=G, restitution=1.0)
    assert abs(elastic.energy_change) <= 1e3 * EPS * np.linalg.cond(M) * (v @ M @ v)
    many = mb.impact(dyn, np.stack([q, q]), np.stack([v, 2 * v]), jacobian=G)
    assert many.v[0] == pytest.approx(hit.v, abs=scale)
    assert many.v[1] == pytest.approx(2 * hit.v, abs=2 * scale)


def test_a_pushed_rolling_disc_still_rolls() -> None:
    sleigh_row = sp.Symbol("xdot") * sp.sin(sp.Symbol("theta")) - sp.Symbol("ydot") * sp.cos(sp.Symbol("theta"))
    x, y, theta = sp.symbols("x y theta")
    rates = sp.symbols("xdot ydot thetadot")
    lag = Lagrangian(sum(w**2 for w in rates) / 2, 0, [x, y, theta], rates, velocity_constraints=[sleigh_row])
    told = lag.impulse({y: 1}).after()
    hit = mb.impact(lag.dynamics(), [0, 0, 0.3], [0, 0, 0], [0, 1, 0])
    place = {theta: 0.3, **dict.fromkeys(rates, 0)}
    assert hit.v == pytest.approx([float(w.subs(place)) for w in told.values()], abs=1e-15)
    assert hit.v[:2] == pytest.approx(np.sin(0.3) * np.array([np.cos(0.3), np.sin(0.3)]), abs=1e-15)


# Bad input


def test_bad_impacts_are_refused() -> None:
    dyn = mb.dynamics(mb.catalog.double_pendulum(), "lagrangian")
    state = [0.1, 0.2], [0.3, 0.4]
    with pytest.raises(InputError, match="got neither"):
        mb.impact(dyn, *state)
    with pytest.raises(InputError, match="restitution: expected a number from 0 to 1"):
        mb.impact(dyn, *state, jacobian=[1, 0], restitution=1.5)
    with pytest.raises(NumericalError, match="depend on each other"):
        mb.impact(dyn, *state, jacobian=[[1, 0], [2, 0]])
    for rows in ("ab", [[1, 0], [1]], [1, 1j]):
        with pytest.raises(InputError, match="jacobian: expected"):
            mb.impact(dyn, *state, jacobian=rows)
    with pytest.raises(InputError, match="batches of different sizes"):
        mb.impact(dyn, *state, np.ones((2, 2)), jacobian=np.ones((3, 1, 2)))
    lag = systems.double_pendulum()
    with pytest.raises(InputError, match="stands twice"):
        lag.impulse({lag.coordinates[0]: 1, lag.coordinates[0].name: 2})
    with pytest.raises(InputError, match="linear in the velocities"):
        lag.impulse(rows=[lag.velocities[0] ** 2])
    with pytest.raises(InputError, match=f"restitution: .*the velocity {lag.velocities[0]}"):
        lag.impulse(rows=[lag.velocities[0]], restitution=lag.velocities[0])
    with pytest.raises(InputError, match="depend on each other"):
        lag.impulse(rows=[lag.velocities[0], 2 * lag.velocities[0]]).after()


def equal_cranks(n: int) -> mb.Model:
    """Return n cranks of 0.5 m that carry a plate: it moves, and each crank behind the second says nothing new."""
    b = mb.ModelBuilder("cranks", gravity=(0, -9.81, 0))
    for k in range(n):
        b.add_body(f"c{k}", mass=1.0, com=(0.25, 0, 0), inertia=(0.02, 0.02, 0.02))
        place = {"axis": (0, 0, 1), "translation": (0.6 * k, 0, 0)}
        b.add_joint(f"c{k}", "continuous", parent="world", child=f"c{k}", **place)
    b.add_body("plate", mass=3.0, com=(0.6, 0, 0), inertia=(0.3, 0.3, 0.3))
    b.add_joint("plate", "continuous", parent="c0", child="plate", axis=(0, 0, 1), translation=(0.5, 0, 0))
    for k in range(1, n):
        ends = {"translation_a": (0.6 * k, 0, 0), "translation_b": (0.5, 0, 0)}
        b.add_loop(f"pin{k}", "point", body_a="plate", body_b=f"c{k}", **ends)
    return b.build()


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio"])
def test_a_blow_on_cranks_of_which_one_is_redundant(engine: str) -> None:
    """The plate translates: I = n (0.02 + 0.25²) + 3 0.5² about the pivots, and ω = S / I."""
    for n in (2, 3, 4):
        model = equal_cranks(n)
        dyn, angles = mb.dynamics(model, engine), np.array([0.7, -1.2])
        q = np.array([[x] * n + [-x] for x in angles])
        blow = np.array([0.3] + [0.0] * n)
        hit = mb.impact(dyn, q, 0 * q, blow)
        rate = 0.3 / (n * (0.02 + 0.25**2) + 3 * 0.5**2)
        np.testing.assert_allclose(hit.v, [[rate] * n + [-rate]] * 2, rtol=0, atol=1e-13)
        J, M = dyn.constraint_jacobian(q), dyn.mass_matrix(q)
        needed = (M @ hit.v[..., None])[..., 0] - blow
        least = [np.linalg.lstsq(J[k].T, needed[k], rcond=1e-9)[0] for k in range(2)]
        np.testing.assert_allclose(hit.reactions, least, rtol=0, atol=1e-12)
        alone = mb.impact(dyn, q[0], 0 * q[0], blow)
        np.testing.assert_allclose(alone.reactions, least[0], rtol=0, atol=1e-12)
        # A row of the user's that the cranks hold already is one to leave out.
        with pytest.raises(NumericalError, match="leave such a row out"):
            mb.impact(dyn, q[0], 0 * q[0], blow, jacobian=J[0, :1])


def test_mobility_of_cranks_that_begin_folded() -> None:
    """All cranks lie on one line in the neutral pose, a singular one; its rank is not that of the branch."""
    for n, redundant in ((3, 1), (4, 2)):
        dyn = mb.dynamics(equal_cranks(n), "lagrangian")
        for found in (dyn.mobility(), dyn.mobility([0.7] * n + [-0.7])):
            assert (found.degrees_of_freedom, len(found.redundant)) == (1, redundant)
    assert "none is redundant" in str(mb.dynamics(equal_cranks(2), "lagrangian").mobility())


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio"])
def test_loops_hold_through_a_blow(engine) -> None:
    dyn = mb.dynamics(mb.catalog.four_bar(), engine)
    q, v = dyn.project([0.5, 0.0, 1.0], [1.0, 0.0, 0.0])
    hit = mb.impact(dyn, q, v, [0.1, 0.0, 0.0])
    assert dyn.constraint_rate(q, hit.v) == pytest.approx(np.zeros(2), abs=1e-13)
    jump = dyn.mass_matrix(q) @ (hit.v - v) - dyn.constraint_jacobian(q).T @ hit.reactions
    assert jump == pytest.approx([0.1, 0.0, 0.0], abs=1e-14)
