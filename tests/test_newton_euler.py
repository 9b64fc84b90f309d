"""Free bodies: the rows of Newton and Euler, what d'Alembert leaves of them, and bodies in `from_particles`."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import sympy as sp
from sympy.physics.mechanics import dynamicsymbols

import mbkit as mb
from mbkit.errors import InputError
from mbkit.lagrangian import from_particles, newton_euler

m, l, g, k, r = sp.symbols("m l g k r")
a, b = sp.symbols("theta1 theta2")
adot, bdot = sp.symbols("thetadot1 thetadot2")
phi, theta, psi = sp.symbols("phi theta psi")
RATES = sp.symbols("phidot thetadot psidot")
VALUES = {m: 1.3, l: 0.8, g: 9.81, k: 0.05, r: 0.3}


def rods() -> dict:
    """Two rods on each other, by their angles from the vertical."""
    first = sp.Matrix([sp.sin(a), -sp.cos(a)]) * l / 2
    second = 2 * first + sp.Matrix([sp.sin(b), -sp.cos(b)]) * l / 2
    return {
        "masses": [m, 2 * m],
        "positions": [list(first), list(second)],
        "coordinates": [a, b],
        "velocities": [adot, bdot],
        "inertias": [m * l**2 / 12, m * l**2 / 6],
        "angular_velocities": [adot, bdot],
        "gravity": [0, -g],
    }


def top() -> dict:
    """A symmetric body on a point, by three angles about z, x, z, with its rates in body axes."""
    u, w, s = RATES
    turn = [
        u * sp.sin(theta) * sp.sin(psi) + w * sp.cos(psi),
        u * sp.sin(theta) * sp.cos(psi) - w * sp.sin(psi),
        u * sp.cos(theta) + s,
    ]
    return {
        "masses": [m],
        "positions": [[l * sp.sin(theta) * sp.sin(phi), -l * sp.sin(theta) * sp.cos(phi), l * sp.cos(theta)]],
        "coordinates": [phi, theta, psi],
        "velocities": RATES,
        "inertias": [(k, k, 2 * k)],
        "angular_velocities": [turn],
        "gravity": [0, 0, -g],
    }


@pytest.mark.parametrize("make", [rods, top])
def test_projected_rows_are_lagranges_equations(make) -> None:
    free, lag = newton_euler(**make()), from_particles(**make(), parameters=VALUES)
    rng, n = np.random.default_rng(0), len(free.coordinates)
    assert len(free.rows()) == len(free.reactions) == 6
    symbols = [*free.coordinates, *free.velocities, *free.accelerations]
    for _ in range(3):
        place = {**VALUES, **dict(zip(symbols, rng.uniform(0.3, 1.2, 3 * n), strict=True))}
        left = [float((e.lhs - e.rhs).subs(place)) for e in free.equations()]
        # Rows of Lagrange may have the other sign of nothing.
        right = [float((e.lhs - e.rhs).subs(place)) for e in lag.equations().equations()]
        assert left == pytest.approx(right, rel=1e-12, abs=1e-12)


def test_loads_are_those_that_hold_the_bodies() -> None:
    """Of two rods the reaction on both together is what the upper hinge bears, by the engine's own wrench."""
    free, model = newton_euler(**rods()), mb.ModelBuilder("rods", gravity=(0, 0, -9.81))
    for name, parent, mass, at in (("upper", "world", 1.3, 0.0), ("lower", "upper", 2.6, -0.8)):
        inertia = mass * 0.8**2 / 12
        model.add_body(name, mass=mass, com=(0, 0, -0.4), inertia=(inertia, inertia, 1e-6))
        # About -y an angle takes -z to x.
        model.add_joint(name[0], "revolute", parent=parent, child=name, axis=(0, -1, 0), translation=(0, 0, at))
    dyn = mb.dynamics(model.build(), "lagrangian", compile=False)
    first, turn = np.array([0.4, 0.9]), np.array([1.1, -0.7])
    q, v = np.array([first[0], first[1] - first[0]]), np.array([turn[0], turn[1] - turn[0]])
    rates = dyn.forward_dynamics(q, v, np.zeros(2))
    place = {**VALUES, a: first[0], b: first[1], adot: turn[0], bdot: turn[1]}
    place |= dict(zip(free.accelerations, [rates[0], rates.sum()], strict=True))
    loads = {s.name: float(x.subs(place)) for s, x in free.loads().items()}
    wrench = dyn.joint_wrenches(q, v, rates)[0]
    assert np.linalg.norm(wrench[:3]) == pytest.approx(
        np.hypot(loads["F1x"] + loads["F2x"], loads["F1y"] + loads["F2y"]), rel=1e-12
    )


def test_a_falling_stick_on_a_smooth_table_needs_one_reaction() -> None:
    """Its centre falls straight: the table bears m g / (1 + 3 sin² θ) when it starts from rest."""
    x, xdot = sp.symbols("x xdot")
    th, thdot = sp.symbols("theta thetadot")
    stick = newton_euler(
        [m],
        [[x, l / 2 * sp.cos(th)]],
        [x, th],
        [xdot, thdot],
        inertias=[m * l**2 / 12],
        angular_velocities=[thdot],
        gravity=[0, -g],
    )
    at_rest = dict.fromkeys((xdot, thdot), 0)
    solved = sp.solve([e.subs(at_rest) for e in stick.equations()], list(stick.accelerations), dict=True)[0]
    load = stick.loads()[sp.Symbol("F1y")].subs(at_rest).subs(solved)
    assert sp.simplify(load - m * g / (1 + 3 * sp.sin(th) ** 2)) == 0
    assert "3 equations of 3 reactions and 2 accelerations; 2 without reactions" in str(stick)
    assert pickle.loads(pickle.dumps(stick)).rows() == stick.rows()
    assert "F_{1x}" in stick.latex() or "F1x" in stick.latex()


def test_given_forces_moments_and_time_stand_in_the_rows() -> None:
    t = dynamicsymbols._t
    angle = dynamicsymbols("alpha")
    shift, F, N = sp.sin(2 * t), *sp.symbols("F N")
    cart = newton_euler(
        [m],
        [[shift + l * sp.sin(angle), 0]],
        [angle],
        inertias=[k],
        angular_velocities=[angle.diff(t)],
        forces=[[F, 0]],
        torques=[N],
        time=t,
    )
    (row,) = cart.equations()
    alpha, alphadot, alphaddot = sp.symbols("alpha alphadot alphaddot")
    time = cart.inertial.free_symbols & {sp.Symbol("t"), t}
    assert time
    expected = (
        m * l * sp.cos(alpha) * (-4 * sp.sin(2 * t) + l * (alphaddot * sp.cos(alpha) - alphadot**2 * sp.sin(alpha)))
        + k * alphaddot
    )
    assert sp.simplify(row.lhs - row.rhs - (expected - F * l * sp.cos(alpha) - N)) == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"masses": [m]}, "masses: 1 of them for 2 positions"),
        ({"masses": None}, "masses: expected a list"),
        ({"masses": [], "positions": []}, "masses|positions: expected"),
        ({"inertias": [m]}, "inertias: 1 of them for 2"),
        ({"inertias": [None, m]}, "expected an inertia and an angular velocity"),
        ({"inertias": [(k, k, k), k]}, "expected 1 number with 1 angular velocity"),
        ({"gravity": [0, 0, -g]}, "gravity: 3 components"),
    ],
)
def test_bad_bodies_are_refused(change, message) -> None:
    for make in (newton_euler, from_particles):
        with pytest.raises(InputError, match=message):
            make(**{**rods(), **change})
    with pytest.raises(InputError, match="forces: 1 of them for 2 bodies"):
        newton_euler(**rods(), forces=[[0, 0]])
    with pytest.raises(InputError, match=r"torques\[0\]: expected 1 components"):
        newton_euler(**rods(), torques=[[0, 0], None])
    skew = sp.Matrix([[k, 1, 0], [0, k, 0], [0, 0, k]])
    with pytest.raises(InputError, match="symmetric"):
        newton_euler(**{**top(), "inertias": [skew]})
