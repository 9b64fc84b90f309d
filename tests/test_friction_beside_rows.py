"""Runs with dry friction beside loops, couplers, rolling contacts and prescribed motions."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import mpmath
import numpy as np
import pytest
import sympy as sp
from numpy.polynomial import Polynomial
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq

import mbkit as mb
from mbkit.errors import DoubtfulRunWarning, MbkitWarning
from mbkit.model import Model
from mbkit.simulate.solvers.in_phases import moreau
from tests.scenes import mounted

ADAPTIVE = {"rtol": 1e-11, "atol": 1e-12}


def simulated(dyn: Any, *given: Any, **more: Any) -> mb.Trajectory:
    run = mb.simulate(dyn, *given, **more)
    assert run.stats.ended == "finished", run.stats.message
    return run


def dynamics(model: Model, engine: str) -> Any:
    """Return dynamics by an engine, or those of the own derivation as machine code."""
    return mb.dynamics(model, "lagrangian", compile=True) if engine == "compiled" else mb.dynamics(model, engine)


def names(run: mb.Trajectory) -> list[str]:
    return [e.name for e in run.events]


def rod(b: mb.ModelBuilder, name: str, parent: str, x: float, length: float, **friction: float | None) -> None:
    """Add a rod of 2 kg/m on a pin."""
    given = {key: value for key, value in friction.items() if value is not None}
    b.add_body(name, mass=2 * length, com=(length / 2, 0, 0), inertia=2 * length**3 / 12 * np.ones(3))
    place = {"axis": (0, 0, 1), "translation": (x, 0, 0)}
    b.add_joint(name, "continuous", parent=parent, child=name, **place, **given)


# A slider-crank, by quadrature in the crank's angle

R, L, SLIDER = 0.3, 0.8, 1.5


def slider_crank(pin: float, wrist: float, guide: float) -> Model:
    b = mb.ModelBuilder("slider_crank", gravity=(0, -9.81, 0))
    rod(b, "crank", "world", 0.0, R, friction=pin)
    rod(b, "rod", "crank", R, L, friction=wrist)
    b.add_body("slider", mass=SLIDER, inertia=np.ones(3))
    b.add_joint("slider", "prismatic", parent="world", child="slider", axis=(1, 0, 0), friction=guide)
    b.add_loop("wrist", "point", body_a="rod", body_b="slider", translation_a=(L, 0, 0))
    return b.build()


def crank_pose(theta: float) -> tuple[np.ndarray, np.ndarray]:
    """Return q, and dq/dθ."""
    phi = np.arcsin(-R * np.sin(theta) / L)
    turn = -R * np.cos(theta) / (L * np.cos(phi))
    q = np.array([theta, phi - theta, R * np.cos(theta) + L * np.cos(phi)])
    return q, np.array([1.0, turn - 1.0, -R * np.sin(theta) - L * np.sin(phi) * turn])


def crank_energies(theta: float) -> tuple[float, float]:
    """Return the kinetic energy at θ̇ = 1, and the potential one."""
    phi = np.arcsin(-R * np.sin(theta) / L)
    _, (_, turn, slide) = crank_pose(theta)
    turn += 1.0
    x = -R * np.sin(theta) - L / 2 * np.sin(phi) * turn
    y = R * np.cos(theta) + L / 2 * np.cos(phi) * turn
    crank, coupler = 2 * R, 2 * L
    kinetic = crank * R**2 / 3 + coupler * (x**2 + y**2 + L**2 / 12 * turn**2) + SLIDER * slide**2
    return kinetic / 2, 9.81 * (crank * R / 2 * np.sin(theta) + coupler * (R * np.sin(theta) + L / 2 * np.sin(phi)))


@pytest.mark.thorough(every=5)
@pytest.mark.parametrize(("engine", "method", "most", "t0"), [
    ("lagrangian", "rk853", 1e-9, 0.0), ("lagrangian", "dop853", 1e-9, 0.0), ("lagrangian", "rodas5", 1e-8, 0.0),
    ("lagrangian", "rk4", 2e-7, 0.0), ("lagrangian", "gauss4", 2e-7, 0.0), ("pinocchio", "dop853", 1e-9, 0.0),
    # Late times are known to 1e-8 s: there the slider's speed is no sharper at its dead centre.
    ("lagrangian", "rk853", 1e-6, 1e8),
])  # fmt: skip
def test_a_slider_crank_comes_to_rest_where_friction_has_taken_its_energy(
    engine: str, method: str, most: float, t0: float
) -> None:
    friction = np.array([0.4, 0.3, 3.0])
    dyn, start, speed = mb.dynamics(slider_crank(*friction), engine), 2.6, 3.0
    q, slope = crank_pose(start)

    def left(theta: float) -> float:
        turns = [np.pi * k for k in range(1, 9) if start < np.pi * k < theta]
        lost = quad(lambda x: friction @ np.abs(crank_pose(x)[1]), start, theta, points=turns or None, epsabs=1e-13)[0]
        (first, low), (_, high) = crank_energies(start), crank_energies(theta)
        return float(first * speed**2 + low - high - lost)

    # The first place without energy.
    grid = np.linspace(start, start + 9.0, 400)
    k = next(k for k, x in enumerate(grid) if left(x) < 0)
    end = brentq(left, grid[k - 1], grid[k], xtol=1e-13)
    more = {"dt": 2e-3} if method in ("rk4", "gauss4") else ADAPTIVE
    run = simulated(dyn, q, speed * slope, 2.0, method, t0=t0, **more)
    dead, *stops = run.events[:4]
    assert dead.name == "slider turns"
    assert abs(dead.q[0] - np.pi) < most
    # All three come to rest, or turn, at one time.
    assert [e.name.split()[0] for e in stops] == ["crank", "rod", "slider"]
    assert len({e.t for e in stops}) == 1
    assert abs(stops[0].q[0] - end) < most
    assert np.abs(run.power_balance()).max() < max(1e-6, 10 * most)


# A four-bar that rests

BARS = np.array([0.5, 1.0, 2.0])


def four_bar(stiction: float = 1.0, gravity: float = 9.81) -> Model:
    b = mb.ModelBuilder("four_bar", gravity=(0, -gravity, 0))
    for (name, parent, x, length), f in zip(
        (("crank", "world", 0.0, 0.3), ("coupler", "crank", 0.3, 0.9), ("rocker", "world", 1.0, 0.7)), BARS, strict=True
    ):
        rod(b, name, parent, x, length, friction=f, stiction=stiction * f)
    b.add_loop("pin", "point", body_a="coupler", body_b="rocker", translation_a=(0.9, 0, 0), translation_b=(0.7, 0, 0))
    return b.build()


def four_bar_terms(theta: Any, m: Any = np) -> tuple[Any, ...]:
    """Return the absolute angle of the coupler and its rate at θ̇ = 1, those of the rocker, I(θ) and V(θ)."""
    sin, cos = m.sin(theta), m.cos(theta)
    x, y = 1 - 3 * cos / 10, -3 * sin / 10
    far = m.sqrt(x * x + y * y)
    b = m.atan(y / x) + m.acos((far + 32 / (100 * far)) * 5 / 9)
    # The end of the rocker from its pin; its length does not change.
    rx, ry = 9 * m.cos(b) / 10 - x, 9 * m.sin(b) / 10 - y
    turn = (rx * sin - ry * cos) / (3 * (ry * m.cos(b) - rx * m.sin(b)))
    ux, uy = -3 * sin / 10 - 9 * turn * m.sin(b) / 20, 3 * cos / 10 + 9 * turn * m.cos(b) / 20
    rocks = (rx * (2 * uy - 3 * cos / 10) - ry * (2 * ux + 3 * sin / 10)) * 100 / 49
    inertia = (54 + 5400 * (ux**2 + uy**2) + 364.5 * turn**2 + 686 * rocks**2) / 3000
    potential = 981 * (9 * sin / 100 + 18 * (3 * sin / 10 + 9 * m.sin(b) / 20) / 10 + 7 * ry / 10) / 100
    return b, turn, m.atan(ry / rx), rocks, inertia, potential


def four_bar_pose(theta: float) -> tuple[np.ndarray, np.ndarray]:
    """Return q, and dq/dθ."""
    b, turn, r, rocks, *_ = four_bar_terms(theta)
    return np.array([theta, b - theta, r % np.pi]), np.array([1.0, turn - 1.0, rocks])


def four_bar_weight(theta: float) -> float:
    """Return dV/dθ."""
    return float(four_bar_terms(theta + 1e-40j)[-1].imag / 1e-40)


@pytest.mark.thorough(every=7)
@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio", "compiled"])
@pytest.mark.parametrize(("method", "more"), [
    ("rk853", ADAPTIVE), ("dop853", ADAPTIVE), ("rk4", {"dt": 0.01}), ("gauss4", {"dt": 0.01}),
])  # fmt: skip
@pytest.mark.parametrize("stiction", [1.0, 1.5])
def test_a_four_bar_lets_go_where_the_virtual_work_passes_that_of_all_its_pins(
    engine: str, method: str, more: dict[str, float], stiction: float
) -> None:
    q, slope = four_bar_pose(1.2)
    dyn, none = dynamics(four_bar(stiction), engine), np.zeros(3)
    # What the pins hold together: no share of it is unique.
    time = (stiction * BARS @ np.abs(slope) + four_bar_weight(1.2)) / 2.0
    run = simulated(dyn, q, none, time + 0.05, method, torque=lambda t, *_: np.array([2.0 * t, 0, 0]), **more)
    assert names(run) == [f"{x} lets go" for x in ("crank", "coupler", "rocker")]
    assert [e.t for e in run.events] == pytest.approx([time] * 3, rel=1e-11)
    rests = run.t < time
    assert (run.q[rests] == q).all()
    assert (run.v[rests] == 0).all()
    assert np.sign(run.v[-1]).tolist() == np.sign(slope).tolist()
    assert np.abs(dyn.constraint_residual(run.q[-1])).max() < 1e-12


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio"])
@pytest.mark.parametrize("quantity", ["constraint_forces", "generalized_constraint_force"])
def test_forces_that_hold_pins_in_more_than_one_way_are_told_to_be_so(engine: str, quantity: str) -> None:
    dyn, (q, v) = mb.dynamics(four_bar(), engine), started([1.0, 0.0, 0.0])
    ask, (pin, none) = getattr(dyn, quantity), np.zeros((2, 3))
    with pytest.warns(
        MbkitWarning, match=rf"{quantity}: what holds crank, coupler, rocker .* 2 of 3 states, first in 1"
    ):
        every = ask(q, v, np.zeros((3, 3)))
    with warnings.catch_warnings(action="error"):
        assert np.abs(ask(q[0], v[0], none) - every[0]).max() < 1e-12
        # One pin holds alone.
        b = mb.ModelBuilder.of(dyn.model.without("friction"))
        b.set_joint("crank", friction=50.0)
        getattr(mb.dynamics(b.build(), engine), quantity)(q[1], pin, none)


# Couplers, mimics, rolling contacts


def rotors(kind: str, ratio: float, friction: tuple[float, float], stiction: float) -> Model:
    """Return two rotors, the second of which turns `ratio` times as fast as the first."""
    b = mb.ModelBuilder(kind, gravity=(0, 0, 0))
    for name, inertia, f in zip("ab", (0.5, 0.2), friction, strict=True):
        b.add_body(name, mass=1.0, inertia=(1.0, 1.0, inertia))
        more = {"mimic": ("a", ratio, 0.0)} if (kind, name) == ("mimic", "b") else {}
        numbers = {"friction": f, "stiction": stiction * f}
        b.add_joint(name, "continuous", parent="world", child=name, axis=(0, 0, 1), **numbers, **more)
    if kind == "geared":
        b.add_coupler("gear", "b", "a", ratio=ratio)
    return b.build()


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("kind", ["geared", "mimic"])
@pytest.mark.parametrize(("method", "more"), [("rk853", ADAPTIVE), ("rk4", {"dt": 0.01}), ("moreau", {"dt": 0.01})])
def test_a_gear_comes_to_rest_and_is_pulled_loose_as_one_rotor(kind: str, method: str, more: dict[str, float]) -> None:
    ratio, friction, stiction = -3.0, (0.4, 0.1), 1.5
    dyn = mb.dynamics(rotors(kind, ratio, friction, stiction), "lagrangian")
    inertia, f = 0.5 + ratio**2 * 0.2, friction[0] + abs(ratio) * friction[1]
    n = dyn.model.nv
    slope = np.array([1.0, ratio])[:n]
    stop = 2.0 * inertia / f
    run = simulated(dyn, 0.3 * slope, 2.0 * slope, stop + 1.0, method, **more)
    close = 0.05 if method == "moreau" else 1e-10
    assert run.q[-1] == pytest.approx((0.3 + 2.0 * stop - f / inertia * stop**2 / 2) * slope, abs=close)
    assert (run.v[-1] == 0).all()
    assert (run.q[run.t > stop + 0.01] == run.q[-1]).all()
    assert np.abs(run.power_balance()).max() < 10 * close
    # A ramp lets it go where its stiction ends.
    time = stiction * f / 0.5
    pulled = simulated(
        dyn, 0 * slope, 0 * slope, time + 1.0, method, torque=lambda t, *_: 0.5 * t * np.eye(n)[0], **more
    )
    assert (pulled.v[pulled.t <= time - 0.02] == 0).all()
    # (c t - f) / I from there on.
    speed = (0.5 * (time + 0.5) - f) / inertia
    assert pulled.v[-1] == pytest.approx(speed * slope, abs=close)
    if method != "moreau":
        assert [e.t for e in run.events] == pytest.approx([stop] * n, rel=1e-11)
        assert [e.t for e in pulled.events] == pytest.approx([time] * n, rel=1e-11)


def test_a_cart_on_a_wheel_that_rolls_has_the_friction_of_its_axle() -> None:
    """Rows of height and of the side say nothing new there."""
    place = {"axis": (1, 0, 0), "translation": (0, 0, 0.25), "friction": 1.0}
    b = mounted("cart", "cart", "x", "prismatic", gravity=(2.0, 0, -9.81), mass=2.0, inertia=np.ones(3), **place)
    b.add_body("wheel", mass=1.0, inertia=(1.0, 0.03, 1.0))
    b.add_joint("axle", "continuous", parent="cart", child="wheel", axis=(0, 1, 0), friction=0.5)
    b.add_rolling("road", "disc", body_a="wheel", radius=0.25, axis_a=(0, 1, 0))
    dyn = mb.dynamics(b.build(), "lagrangian")
    rate, slope = (2.0 * 3.0 - 1.0 - 0.5 / 0.25) / (3.0 + 0.03 / 0.25**2), np.array([1.0, 4.0])
    for method, more in (("rk853", ADAPTIVE), ("rk4", {"dt": 0.01})):
        run = simulated(dyn, [0.0, 0.0], -0.5 * slope, 1.0, method, **more)
        # Uphill it is braked by the slope and by friction.
        braked = (2.0 * 3.0 + 1.0 + 0.5 / 0.25) / (3.0 + 0.03 / 0.25**2)
        stop = 0.5 / braked
        assert names(run) == ["x turns", "axle turns"]
        assert run.events[0].t == pytest.approx(stop, rel=1e-11)
        assert run.v[-1] == pytest.approx(rate * (1.0 - stop) * slope, rel=1e-10)


def rolling(friction: np.ndarray) -> Any:
    """Return a(q, v, sides, held) of a disc of 1 kg and 0.5 m that rolls, by Lagrange's equations on paper."""
    Q, V = sp.symbols("x y z psi theta phi"), sp.symbols("u:6")
    psi, theta = Q[3:5]
    spins = sp.Rational(1, 16), sp.Rational(1, 8)
    turns = (V[4] ** 2 + (V[3] * sp.cos(theta)) ** 2) * spins[0] + (V[5] + V[3] * sp.sin(theta)) ** 2 * spins[1]
    L = (V[0] ** 2 + V[1] ** 2 + V[2] ** 2 + turns) / 2 - sp.Rational(981, 100) * Q[2]
    momenta = sp.Matrix([L.diff(u) for u in V])
    h = momenta.jacobian(Q) * sp.Matrix(V) - sp.Matrix([L.diff(x) for x in Q])
    yaw, lean = sp.rot_axis3(-psi), sp.rot_axis1(-theta)
    omega = yaw * (sp.Matrix([V[4], 0, V[3]]) + lean * sp.Matrix([0, V[5], 0]))
    # Beyond a right angle the lowest point is on the side that is up at first.
    slip = sp.Matrix(V[:3]) + omega.cross(yaw * lean * sp.Matrix([0, 0, sp.Rational(1, 2)]))
    rows = slip.jacobian(V)
    terms = sp.lambdify((Q, V), (momenta.jacobian(V), h, rows, slip.jacobian(Q) * sp.Matrix(V)), "numpy", cse=True)

    def accelerations(q: np.ndarray, v: np.ndarray, sides: np.ndarray, held: list[int]) -> np.ndarray:
        M, force, J, gamma = (np.array(x, dtype=float) for x in terms(q, v))
        J, none = np.vstack([J, np.eye(6)[held]]), np.zeros((3 + len(held), 3 + len(held)))
        right = np.concatenate([-force[:, 0] - friction * sides, -gamma[:, 0], np.zeros(len(held))])
        return np.linalg.solve(np.block([[M, J.T], [J, none]]), right)

    return accelerations


def test_a_disc_that_falls_flat_does_so_as_on_paper_and_ends_by_name() -> None:
    dyn, q, v = rubbing("rolling_disc", 0, compile=True)
    bounds, friction = ([float(getattr(j, x)[0]) for j in dyn.model.joints] for x in ("stiction", "friction"))
    accelerations, y, t, sides = rolling(np.array(friction)), np.concatenate([q, v]), 0.0, np.sign(v)
    found, held, names_of = [], list[int](), dyn.model.velocity_names
    for which, end in ((3, 0.2), (1, 0.2), (3, 0.2), (5, 0.2), (None, 0.149)):
        stops = lambda _, y, k=which: 1.0 if k is None else sides[k] * y[6 + k]  # noqa: E731
        stops.terminal, stops.direction = True, -1  # type: ignore[attr-defined]
        rates = lambda _, y, at=held: np.concatenate([y[6:], accelerations(y[:6], y[6:], sides, at)[:6]])  # noqa: E731
        path = solve_ivp(rates, (t, end), y, "DOP853", rtol=1e-12, atol=1e-13, events=stops)
        t, y = path.t[-1], path.y[:, -1]
        if which is not None:
            found.append((f"{names_of[which]} {'stops' if which == 5 else 'turns'}", pytest.approx(t, rel=1e-10)))
            y[6 + which], sides[which], held = 0.0, -sides[which] * (which != 5), [5] * (which == 5)
    assert abs(accelerations(y[:6], y[6:], sides, held)[-1]) < bounds[5]
    run = simulated(dyn, q, v, 0.149, "rk853", **ADAPTIVE)
    assert [(e.name, e.t) for e in run.events] == found
    assert np.abs(np.concatenate([run.q[-1], run.v[-1]]) - y).max() < 1e-10
    with pytest.warns(MbkitWarning, match=r"after t = 0.1496.* 'yaw' and 'spin'"):
        flat = mb.simulate(dyn, q, v, 0.3, "rk853")
    assert abs(flat.q[-1, 4] - np.pi / 2) < 1e-3


# Prescribed motions


def shaken(phase: float = 0.0, of_table: float = 0.7) -> Model:
    """Return a block of 1.5 kg on a table that is shaken, in coordinates of the table."""
    b = mounted("table", "table", "x", "prismatic", gravity=(0, 0, 0), mass=5.0, axis=(1, 0, 0), friction=of_table)
    b.add_body("block", mass=1.5)
    b.add_joint("y", "prismatic", parent="table", child="block", axis=(1, 0, 0), friction=2.0, stiction=3.0)
    b.prescribe("x", amplitude=0.5, frequency=3.0, phase=phase)
    return b.build()


def slid(start: float, end: float, side: float) -> tuple[float, float]:
    """Return the way and the speed at the end of a block that begins to slide on the table."""
    push = -side * 2.0 / 1.5
    # ÿ = 4.5 sin 3t + push.
    speed = 1.5 * (np.cos(3 * start) - np.cos(3 * end)) + push * (end - start)
    way = 1.5 * np.cos(3 * start) * (end - start) - 0.5 * (np.sin(3 * end) - np.sin(3 * start))
    return way + push * (end - start) ** 2 / 2, speed


@pytest.mark.thorough(every=3)
@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio"])
@pytest.mark.parametrize(("method", "more", "most"), [("rk853", ADAPTIVE, 1e-9), ("rk4", {"dt": 0.01}, 1e-7)])
def test_a_block_on_a_shaken_table_sticks_and_slides(
    engine: str, method: str, more: dict[str, float], most: float
) -> None:
    dyn = mb.dynamics(shaken(), engine)
    loose = np.arcsin(3.0 / 1.5 / 4.5) / 3
    turn = brentq(lambda t: slid(loose, t, 1.0)[1], loose + 0.5, 2.0, xtol=1e-14)
    run = simulated(dyn, [0.0, 0.0], [1.5, 0.0], 2.0, method, **more)
    way = slid(loose, turn, 1.0)[0]
    after = slid(turn, 2.0, -1.0)
    assert names(run) == ["y lets go", "x turns", "y turns", "x turns"]
    assert [e.t for e in run.events] == pytest.approx([loose, np.pi / 6, turn, np.pi / 2], rel=most)
    assert run.q[-1] == pytest.approx([0.5 * np.sin(6.0), way + after[0]], abs=most)
    assert run.v[-1] == pytest.approx([1.5 * np.cos(6.0), after[1]], abs=most)
    rests = run.t < loose
    assert (run.q[rests, 1] == 0).all()
    # The drive gives what friction takes, and what the table's motion needs.
    if method == "rk853":
        assert np.abs(run.power_balance("lagrangian")).max() < 1e-3
        assert (run.v[rests, 1] == 0).all()


@pytest.mark.thorough("rk853")
@pytest.mark.parametrize("method", ["rk853", "rk4"])
def test_a_drive_that_leaves_no_freedom_turns_the_pins_with_it(method: str) -> None:
    """The pose and the speed are those of the crank's angle, 1.2 + ½ sin 3t, which turns at π/6 s."""
    b = mb.ModelBuilder.of(slider_crank(0.0, 0.3, 3.0))
    b.prescribe("crank", offset=1.2, amplitude=0.5, frequency=3.0)
    dyn = mb.dynamics(b.build(), "lagrangian")

    def at(t: float) -> tuple[np.ndarray, np.ndarray]:
        q, slope = crank_pose(1.2 + 0.5 * np.sin(3 * t))
        return q, 1.5 * np.cos(3 * t) * slope

    more = {"dt": 0.01} if method == "rk4" else ADAPTIVE
    for states in (at(0.0), tuple(np.tile(x, (2, 1)) for x in at(0.0))):
        grid = {"save": np.array([0.0, 0.7])} if method == "rk853" and states[0].ndim == 2 else {}
        run = simulated(dyn, *states, 0.7, method, **more, **grid)
        assert {*names(run)} == {"rod turns", "slider turns"}
        assert [e.t for e in run.events] == pytest.approx([np.pi / 6] * len(run.events), abs=1e-9)
        for end, value in zip((run.q[..., -1, :], run.v[..., -1, :]), at(0.7), strict=True):
            assert np.abs(end - value).max() < 1e-9
    q, v = dyn.at(t=0.5).step(*at(0.5), np.zeros(3), 0.05, method="rk4", t=0.5)
    assert np.abs(q - at(0.55)[0]).max() < 1e-9
    assert np.abs(v - at(0.55)[1]).max() < 1e-9


@pytest.mark.thorough(every=5)
@pytest.mark.parametrize(("method", "more"), [
    ("rk853", {}), ("dop853", {}), ("rk4", {"dt": 2e-3}), ("rk4", {"dt": 1.9e-3}), ("gauss4", {"dt": 1.9e-2}),
])  # fmt: skip
@pytest.mark.parametrize("compiled", [False, True])
def test_a_drive_that_fades_out_stops_its_pins_where_it_ends(method: str, more: Any, compiled: bool) -> None:
    """The crank's angle is 1.2 + t³ (1 - t)³ up to 1 s: speed and acceleration fade to zero there, and stay so."""
    t = ca.SX.sym("t")
    b = mb.ModelBuilder.of(slider_crank(0.4, 0.3, 3.0))
    b.prescribe("crank", 1.2 + ca.if_else(t < 1, t**3 * (1 - t) ** 3, 0))
    dyn = mb.dynamics(b.build(), "lagrangian", compile=compiled)
    run = simulated(dyn, crank_pose(1.2)[0], np.zeros(3), 2.0, method, **more)
    ends = [e for e in run.events if e.t > 0.7]
    assert {e.name for e in ends} == {"crank stops", "rod stops", "slider stops"}
    assert len(ends) == 3
    assert all(abs(e.t - 1) < 1e-8 for e in ends)
    assert [e.t for e in run.events if e.name.endswith("turns")] == pytest.approx([0.5] * 3, abs=1e-9)


def test_a_drive_that_begins_slowly_lets_its_pins_go_once() -> None:
    t = ca.SX.sym("t")
    b = mb.ModelBuilder.of(slider_crank(0.4, 0.3, 3.0))
    b.prescribe("crank", 1.2 + t**14)
    run = simulated(mb.dynamics(b.build(), "lagrangian"), crank_pose(1.2)[0], np.zeros(3), 1.0, "rk853")
    assert sorted(names(run)) == ["crank lets go", "rod lets go", "slider lets go"]
    assert len({e.t for e in run.events}) == 1
    q, slope = crank_pose(2.2)
    assert run.q[-1] == pytest.approx(q, abs=1e-9)
    assert run.v[-1] == pytest.approx(14 * slope, abs=1e-8)


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio"])
def test_phases_beside_a_drive_are_kept_for_their_time(engine: str) -> None:
    """A step of Moreau's asks for the same one each time, which otherwise chooses its rows again."""
    dyn, still = mb.dynamics(shaken(), engine), np.array([False, True])
    law, later = dyn._jumps, dyn.at(t=1.5)
    phase = law.phase(dyn, np.zeros(2), still)
    assert law.phase(dyn, np.zeros(2), still) is phase
    assert law.phase(later, np.zeros(2), still).model.time == 1.5
    assert phase.model.time == 0.0


def test_what_a_drive_lets_rest_goes_on_with_it() -> None:
    """The table moves from 1 s to 2 s; the block slides on it, and rests by itself later on."""
    b = mounted("dwell", "table", "x", "prismatic", gravity=(0, 0, 0), mass=5.0, axis=(1, 0, 0), friction=0.7)
    b.add_body("block", mass=1.5)
    b.add_joint("y", "prismatic", parent="table", child="block", axis=(1, 0, 0), friction=1.0)
    from scipy.interpolate import PPoly

    moves = [[0, 6, 0], [0, -15, 0], [0, 10, 0], [0, 0, 0], [0, 0, 0], [0, 0, 1.0]]
    b.prescribe("x", PPoly(np.array(moves), [0.0, 1.0, 2.0, 5.0]))
    dyn = mb.dynamics(b.build(), "lagrangian")
    table, f = Polynomial([0, 0, 0, 10, -15, 6]), 1.0 / 1.5
    speed, push = table.deriv(), table.deriv(2)
    begin = brentq(lambda s: push(s) - f, 0, 0.2)
    turn = brentq(lambda s: speed(begin) - speed(s) + f * (s - begin), 0.5, 1.0)
    back = table(begin) - table(turn) + speed(begin) * (turn - begin) + f * (turn - begin) ** 2 / 2
    left = speed(turn) - f * (1 - turn)
    on = table(turn) - 1 + speed(turn) * (1 - turn) - f * (1 - turn) ** 2 / 2 + left**2 / (2 * f)
    run = simulated(dyn, [0.0, 0.0], [0.0, 0.0], 5.0, "rk853", **ADAPTIVE)
    times = {e.name: e.t for e in run.events}
    assert times["y lets go"] == pytest.approx(1 + begin, abs=1e-7)
    assert times["y stops"] == pytest.approx(2 + left / f, abs=1e-7)
    assert run.q[-1] == pytest.approx([1.0, back + on], abs=1e-7)
    assert (run.v[run.t > times["y stops"], 1] == 0).all()


# Parallelograms, whose rows follow from each other, or are singular where all bars are in line


def parallelogram(friction: tuple[float, ...], bar: float) -> Model:
    """Return as many cranks as numbers of friction, of which that of the bar stands last."""
    b = mb.ModelBuilder("parallelogram", gravity=(0, -9.81, 0))
    b.add_body("bar", mass=1.0, com=(0.5, 0, 0), inertia=0.1 * np.ones(3))
    for k, f in enumerate(friction):
        x, name = 0.5 * k, f"crank{k}"
        b.add_body(name, mass=1.0, com=(0.25, 0, 0), inertia=np.ones(3) / 48)
        place = {"axis": (0, 0, 1), "translation": (x, 0, 0)}
        b.add_joint(name, "continuous", parent="world", child=name, **place, friction=f)
        if k:
            ends = {"translation_a": (x, 0, 0), "translation_b": (0.5, 0, 0)}
            b.add_loop(name, "point", body_a="bar", body_b=name, **ends)
    place = {"axis": (0, 0, 1), "translation": (0.5, 0, 0)}
    b.add_joint("bar", "continuous", parent="crank0", child="bar", **place, friction=bar)
    return b.build()


def turned(model: Model, angle: float) -> np.ndarray:
    """Return the configuration in which all cranks are at an angle, as the bar does not turn."""
    return np.array([-angle if j.name == "bar" else angle for j in model.joints])


@pytest.mark.thorough(every=5)
@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio", "compiled"])
@pytest.mark.parametrize(("method", "more"), [("dop853", ADAPTIVE), ("rk4", {"dt": 2e-3}), ("gauss4", {"dt": 5e-3})])
def test_a_parallelogram_of_three_cranks_rests_where_next_to_no_force_is_needed(
    engine: str, method: str, more: dict[str, float]
) -> None:
    model = parallelogram((0.5, 0.7, 0.9), 0.3)
    dyn, crank = dynamics(model, engine), model.velocity_names.index("crank0")
    # The torque balances the weight on the way.
    time = (0.5 + 0.7 + 0.9 + 0.3 + 9.81 * 1.25 * np.cos(1.5)) / 8
    q, push = turned(model, 1.5), 8.0 * np.eye(4)[crank]
    run = simulated(dyn, q, np.zeros(4), time + 0.02, method, torque=lambda t, *_: t * push, **more)
    assert [e.t for e in run.events] == pytest.approx([time] * 4, rel=1e-11)
    assert (run.q[run.t < time] == q).all()
    hangs = simulated(dyn, turned(model, -np.pi / 2 + 1e-4), np.zeros(4), 0.05, method, **more)
    assert (hangs.q == hangs.q[0]).all()


@pytest.mark.parametrize(("method", "friction"), [("rk853", 0.0), ("rk853", 0.3), ("auto", 0.3)])
def test_states_within_a_step_across_a_singular_pose_are_those_of_the_motion(method: str, friction: float) -> None:
    """As machine code, whose steps go across the pose."""
    dyn = mb.dynamics(parallelogram((friction,) * 3, friction), "lagrangian", compile=True)
    q, slope = turned(dyn.model, 0.5), turned(dyn.model, 1.0)
    with pytest.warns(DoubtfulRunWarning, match="passed a singular pose"):
        run = simulated(dyn, q, -2.0 * slope, 0.7, method, save=np.linspace(0, 0.7, 401), rtol=1e-9, atol=1e-11)

    def speed(angle: Any) -> Any:
        taken = 9.81 * 1.25 * (np.sin(0.5) - np.sin(angle)) - 4 * friction * (0.5 - angle)
        return np.sqrt(4.0 + taken / 0.25)

    crank = dyn.model.velocity_names.index("crank0")
    assert len(run.t) == 401
    assert run.v[:, crank] == pytest.approx(-speed(run.q[:, crank]), rel=1e-7)
    assert quad(lambda x: 1 / speed(x), run.q[-1, crank], 0.5)[0] == pytest.approx(0.7, rel=1e-7)


@pytest.mark.parametrize(
    ("method", "more", "speeds"), [("rk853", {"rtol": 1e-12}, [3.0]), ("rk4", {"dt": 1e-3}, [3.0, 2.8, 0.0])]
)
def test_a_run_tells_once_of_the_poses_that_its_phases_pass(
    method: str, more: dict[str, float], speeds: list[float]
) -> None:
    """Upwards through the pose, round, and down through it again, by energy and quadrature; other members beside it."""
    dyn = mb.dynamics(parallelogram((0.05,) * 3, 0.05), "lagrangian")
    v = np.array(speeds)[:, None] * turned(dyn.model, 1.0)
    run = simulated(dyn, turned(dyn.model, -0.1), v if len(v) > 1 else v[0], 0.25, method, **more)
    (told,) = run.stats.doubts
    assert len(v) == 1 or "2 of 3 trajectories passed singular poses; trajectory 0" in told

    def up(x: float) -> float:
        return float(9 - (9.81 * 1.25 * (np.sin(x) + np.sin(0.1)) + 0.2 * (x + 0.1)) / 0.25)

    top = brentq(up, 0, 0.2)
    rest, _ = quad(lambda s: 2 * s / np.sqrt(up(top - s * s)), 0, np.sqrt(top))
    back, _ = quad(
        lambda s: 2 * s / np.sqrt((9.81 * 1.25 * (np.sin(top) - np.sin(top - s * s)) - 0.2 * s * s) / 0.25),
        *(0, np.sqrt(top)),
    )
    first, _ = quad(lambda x: up(x) ** -0.5, -0.1, 0)
    times = [float(x) for x in re.search(r"t = (.*) \(s\)", told)[1].split(", ")]  # type: ignore[index]
    assert times == pytest.approx([first, first + rest + back], rel=2e-3)


@pytest.mark.thorough("1-True")
@pytest.mark.parametrize(("count", "compiled"), [(1, True), (3, False)])
def test_moreau_s_steps_tell_the_singular_pose_that_they_pass(count: int, compiled: bool) -> None:
    dyn = mb.dynamics(parallelogram((0.05,) * 3, 0.05), "lagrangian", compile=compiled)
    q, v = turned(dyn.model, 0.1), -3.0 * turned(dyn.model, 1.0)
    speeds = np.linspace(1.0, 0.0, count)[:, None]
    states = (q, v) if count == 1 else (np.repeat(q[None], count, axis=0), speeds * v)
    with pytest.warns(DoubtfulRunWarning, match="passed a singular pose") as warned:
        run = mb.simulate(dyn, *states, 0.08, "moreau", dt=5e-4)
    text = str(warned[0].message)
    assert count == 1 or "2 of 3 trajectories" in text
    time, _ = quad(lambda x: (9 + (9.81 * 1.25 * (np.sin(0.1) - np.sin(x)) - 0.2 * (0.1 - x)) / 0.25) ** -0.5, 0, 0.1)
    assert float(re.search(r"t = (\S+) \(s\)", text)[1]) == pytest.approx(time, rel=2e-3)
    # A method with a fixed step has no tolerance.
    assert "tolerance" not in str(run.stats.doubts)


@pytest.mark.parametrize("method", ["rk4", "gauss4"])
def test_a_run_whose_first_step_fails_says_so(method: str) -> None:
    dyn = mb.dynamics(parallelogram((0.5, 0.7, 0.9), 0.3), "lagrangian")
    with pytest.warns(MbkitWarning, match="diverged"):
        run = mb.simulate(dyn, turned(dyn.model, 0.3), np.zeros(4), 2e3, method, dt=1e3, torque=[30.0, 0, 0, 0])
    assert run.stats.ended == "diverged"
    assert run.t.tolist() == [0.0]


# Two degrees of freedom

FIVE = np.array([1.0, 0.7, 0.4, 0.8, 0.5])


def five_bar(stiction: float, friction: np.ndarray = FIVE, gravity: float = 3.0) -> Model:
    b = mb.ModelBuilder("five_bar", gravity=(0, -gravity, 0))
    for (name, parent, x, length), f in zip(
        (("a", "world", 0.0, 0.4), ("b", "a", 0.4, 0.6), ("c", "world", 0.5, 0.4), ("d", "c", 0.4, 0.6)),
        friction,
        strict=False,
    ):
        rod(b, name, parent, x, length, friction=f, stiction=stiction * f)
    b.add_body("tip", mass=0.1, inertia=1e-3 * np.ones(3))
    pin = {"axis": (0, 0, 1), "translation": (0.6, 0, 0), "friction": friction[4], "stiction": stiction * friction[4]}
    b.add_joint("e", "continuous", parent="b", child="tip", **pin)
    b.add_loop("pin", "frame", body_a="tip", body_b="d", translation_b=(0.6, 0, 0))
    return b.build()


def five_pins(q: np.ndarray) -> np.ndarray:
    """Return velocities of the pins by two numbers, the freedoms that the loop leaves the absolute angles of rods."""
    a, b, c, d = q[0], q[0] + q[1], q[2], q[2] + q[3]
    ends = [[-0.4 * np.sin(a), -0.6 * np.sin(b), 0.4 * np.sin(c), 0.6 * np.sin(d)]]
    ends += [[0.4 * np.cos(a), 0.6 * np.cos(b), -0.4 * np.cos(c), -0.6 * np.cos(d)]]
    turns = np.linalg.svd(np.array(ends))[2][2:].T
    return np.array([[1, 0, 0, 0], [-1, 1, 0, 0], [0, 0, 1, 0], [0, 0, -1, 1], [0, -1, 0, 1]]) @ turns


def part_of_bounds(pins: np.ndarray, bounds: np.ndarray, needed: np.ndarray) -> float:
    """Return the largest part of a bound that is used at least: forces within bounds fill a polygon of known edges."""
    normals = [np.array([-row[1], row[0]]) for row in pins]
    return max(abs(n @ needed) / (bounds @ np.abs(pins @ n)) for n in normals)


@pytest.mark.thorough("lagrangian", "compiled")
@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio", "compiled"])
def test_a_five_bar_lets_go_where_no_share_of_its_pins_is_within_their_bounds(engine: str) -> None:
    """The forces of five pins along two freedoms fill a polygon; its edges are those of its vertices' hull."""
    stiction, pull = 1.4, np.array([1.0, 0.3, -0.5, 0.2, 0.0])
    dyn = dynamics(five_bar(stiction), engine)
    bare = mb.dynamics(five_bar(stiction).without("friction"), "lagrangian")
    q, none = bare.project([1.9, -1.0, 1.1, 1.0, 0.0], np.zeros(5))
    pins = five_pins(q)
    weight, push = pins.T @ bare.nle(q, none), pins.T @ pull
    bounds = stiction * FIVE

    def used(t: float) -> float:
        return part_of_bounds(pins, bounds, t * push - weight)

    assert used(0.0) < 1
    time = brentq(lambda t: used(t) - 1, 0.0, 60.0, xtol=1e-14)
    for method, more in (("dop853", ADAPTIVE), ("rk4", {"dt": time / 40.5})):
        run = simulated(dyn, q, none, time + 0.05, method, torque=lambda t, *_: t * pull, **more)
        assert run.events[0].t == pytest.approx(time, rel=1e-10)
        assert {e.t for e in run.events[:3]} == {run.events[0].t}
        rests = run.t < time
        assert (run.q[rests] == q).all()
        assert (run.v[rests] == 0).all()
        assert np.abs(run.v[-1]).max() > 1e-4
        assert np.abs(dyn.constraint_residual(run.q[-1])).max() < 1e-12


@pytest.mark.thorough(every=6)
@pytest.mark.parametrize("friction", [1e-10 * FIVE, np.array([1e-9, 1, 1, 1e-9, 1]), np.array([1, 1e-14, 1, 1, 1])])
@pytest.mark.parametrize(("method", "more"), [("dop853", ADAPTIVE), ("rk4", {"dt": 0.01})])
def test_a_five_bar_lets_go_as_its_bounds_say_whatever_their_sizes(
    friction: np.ndarray, method: str, more: dict[str, float]
) -> None:
    dyn, scale = mb.dynamics(five_bar(1.0, friction, gravity=0.0), "lagrangian"), friction.max()
    q, none = dyn.project([1.9, -1.0, 1.1, 1.0, 0.0], np.zeros(5))
    pull = scale * np.array([1.0, 0.3, -0.5, 0.2, 0.0])
    pins = five_pins(q)
    time = 1 / part_of_bounds(pins, friction, pins.T @ pull)
    run = simulated(dyn, q, none, time + 0.05, method, torque=lambda t, *_: t * pull, **more)
    assert run.events[0].t == pytest.approx(time, rel=1e-11)
    assert {(e.name.split(maxsplit=1)[1], e.t) for e in run.events} == {("lets go", run.events[0].t)}
    assert np.abs(run.v[-1]).max() > 0


@pytest.mark.parametrize(("method", "more"), [("rk853", {}), ("rk4", {"dt": 0.01})])
def test_bounds_that_differ_by_14_decades_are_refused_by_name_where_the_large_one_does_not_hold(
    method: str, more: dict[str, float]
) -> None:
    dyn = mb.dynamics(five_bar(1.0, np.array([1e-14, 1, 1e-14, 1e-14, 1e-14]), gravity=0.0), "lagrangian")
    q, none = dyn.project([1.9, -1.0, 1.1, 1.0, 0.0], np.zeros(5))
    pull = np.array([1e-14, 0.0, 0.0, 0.0, 0.0])
    with pytest.warns(MbkitWarning, match="what holds 5 joints at rest"):
        run = mb.simulate(dyn, q, none, 1.0, method, torque=lambda t, *_: t * pull, **more)
    assert run.stats.ended == "diverged"


@pytest.mark.thorough("lagrangian", "pinocchio")
@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio", "compiled"])
def test_moreau_s_steps_pass_dead_centres(engine: str) -> None:
    """The rocker turns while the others go on; a rate of the rows that is not zero would let all three never rest."""
    b = mounted("free", "base", "base", "free", gravity=(0, 0, 0), mass=5.0, inertia=0.3 * np.ones(3))
    for name, parent, x, length in (
        ("crank", "base", 0, 0.3),
        ("coupler", "crank", 0.3, 0.9),
        ("rocker", "base", 1, 0.7),
    ):
        rod(b, name, parent, x, length, friction=0.1, stiction=0.2)
    b.add_loop("pin", "point", body_a="coupler", body_b="rocker", translation_a=(0.9, 0, 0), translation_b=(0.7, 0, 0))
    model = b.build()
    truth = mb.dynamics(model, "lagrangian")
    q, v = truth.project([*model.neutral()[:7], 1.2, -0.6, 1.5], [0, 0, 0, 0, 0, 0.5, 4, 0, 0], hold=["crank"])
    dead = simulated(truth, q, v, 1.01, "rk853", **ADAPTIVE).events[-1]
    assert dead.name == "rocker turns"
    h, steps = 5e-4, 3
    times = dead.t - h * np.linspace(0.4, 2.4, 41)
    run = simulated(
        truth, q, v, 1.02, "rk853", save=np.concatenate([[0], times[::-1], times[::-1] + h * steps]), **ADAPTIVE
    )
    starts, ends = slice(1, 42), slice(42, 83)
    few = simulated(dynamics(model, engine), run.q[starts], run.v[starts], steps * h, "moreau", dt=h)
    assert np.abs(few.q[:, -1] - run.q[ends]).max() < 1e-5
    assert np.abs(few.v[:, -1] - run.v[ends]).max() < 1e-3


# Stribeck's curve in the crank of a four-bar, to 34 digits

CURVE = (1.0, 2.0, 0.8)


def curved() -> Model:
    b = mb.ModelBuilder.of(four_bar().without("friction"))
    b.set_joint("crank", **dict(zip(("friction", "stiction", "stribeck_velocity"), CURVE, strict=True)))
    return b.build()


def extrapolated(f: Any, y: Any, length: Any, columns: int = 9) -> Any:
    """Return y after one long step, by Gragg's midpoint rule and extrapolation in h² (Hairer et al. 1993, II.9)."""
    table: list[Any] = []
    for j in range(1, columns + 1):
        n = 2 * j
        h, before, now = length / n, y, y + length / n * f(y)
        for _ in range(n - 1):
            before, now = now, before + 2 * h * f(now)
        row = [(before + now + h * f(now)) / 2]
        for k, last in enumerate(table):
            row.append(row[k] + (row[k] - last) / ((mpmath.mpf(n) / (2 * (j - k - 1))) ** 2 - 1))
        table = row
    return table[-1]


#: Times and crank's angles at which it turns, and where it stops.
TURNS = (
    (1.067831659764165836, -3.500003874729065935),
    (1.622990018959465764, -0.820627295899820519),
    (2.124276457466296951, -2.606950859841216653),
    (2.525023182415206242, -1.590911543038260509),
)


@pytest.mark.thorough
def test_the_turns_of_a_four_bar_with_stribeck_friction_are_those_of_34_digits() -> None:
    f, s, w = (mpmath.mpf(round(100 * x)) / 100 for x in CURVE)
    with mpmath.workdps(34):
        tiny = mpmath.mpf(10) ** -60

        def rate(y: Any, side: int) -> Any:
            with mpmath.workdps(80):
                *_, inertia, potential = four_bar_terms(mpmath.mpc(y[0], tiny), mpmath)
            friction = side * (f + (s - f) * mpmath.exp(-((y[1] / w) ** 2)))
            pull = inertia.imag * y[1] ** 2 / 2 + potential.imag
            return mpmath.matrix([y[1], (-pull / tiny - friction) / inertia.real])

        y, t, found, side, step = mpmath.matrix([mpmath.mpf(9) / 10, 0]), mpmath.mpf(0), [], -1, mpmath.mpf(1) / 60
        while len(found) < len(TURNS):
            moved = extrapolated(lambda x, side=side: rate(x, side), y, step)
            if side * moved[1] >= 0 or not t:
                y, t = moved, t + step
                continue
            # Newton's iteration on the speed gives the end of the phase.
            part, correction = step / 2, mpmath.mpf(1)
            while abs(correction) > mpmath.mpf(10) ** -25:
                at = extrapolated(lambda x, side=side: rate(x, side), y, part)
                correction = at[1] / rate(at, side)[1]
                part -= correction
            y, t, side = extrapolated(lambda x, side=side: rate(x, side), y, part), t + part, -side
            y[1] = mpmath.mpf(0)
            found.append((t, y[0]))
    assert np.array(found, dtype=float) == pytest.approx(np.array(TURNS), rel=1e-14)


@pytest.mark.thorough(every=3)
@pytest.mark.parametrize("method", ["rk853", "dop853", "rk4"])
def test_stribeck_friction_in_a_four_bar_turns_and_stops_where_34_digits_say(method: str) -> None:
    dyn = mb.dynamics(curved(), "lagrangian")
    more, most = ({"rtol": 1e-13, "atol": 1e-14}, 1e-11) if method != "rk4" else ({"dt": 2e-3}, 1e-7)
    run = simulated(dyn, four_bar_pose(0.9)[0], np.zeros(3), TURNS[-1][0] + 0.3, method, **more)
    assert names(run) == ["crank turns"] * (len(TURNS) - 1) + ["crank stops"]
    assert [(e.t, e.q[0]) for e in run.events] == [pytest.approx(x, rel=most) for x in TURNS]


# Uses of runs


def started(speeds: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return states of the four-bar at several angles, with these speeds of the crank."""
    states = [four_bar_pose(1.2 + 0.1 * k) for k in range(len(speeds))]
    return np.array([q for q, _ in states]), np.array([x * slope for (_, slope), x in zip(states, speeds, strict=True)])


@pytest.mark.thorough(every=5)
@pytest.mark.parametrize(
    ("method", "engine"),
    [(x, "lagrangian") for x in ("rk4", "gauss4", "moreau")] + [("rk4", "compiled"), ("moreau", "compiled")],
)
def test_members_of_a_batch_slide_stop_and_rest_as_they_do_alone(method: str, engine: str) -> None:
    dyn, tau = (
        dynamics(four_bar(1.2), engine),
        np.array([[0.0, 0, 0], [9.0, 0, 0], [four_bar_weight(1.4), 0, 0], [0.0, 0, 1]]),
    )
    q, v = started([3.0, 0.0, 0.0, -2.0])
    both = {"torque": tau[:, None].repeat(60, axis=1)}
    run = simulated(dyn, q, v, 0.6, method, dt=0.01, **both)
    for i in range(len(q)):
        alone = simulated(dyn, q[i], v[i], 0.6, method, dt=0.01, torque=tau[i])
        assert np.abs(run.q[i] - alone.q).max() < 1e-12
        assert np.abs(run.v[i] - alone.v).max() < 1e-12
        assert [(e.name, e.t) for e in run.events if e.member == i] == [
            (e.name, pytest.approx(e.t, rel=1e-12)) for e in alone.events
        ]
    assert (run.v[0, -1] == 0).all()
    assert np.abs(run.v[1, -1]).max() > 1
    if method != "moreau":
        assert {e.member for e in run.events} == {0, 1, 3}


def test_steps_samples_files_and_wrenches_are_those_of_one_run(tmp_path: Path) -> None:
    dyn, dt = mb.dynamics(four_bar(1.2), "lagrangian"), 0.01
    (q,), (v,) = started([2.0])
    tau = np.array([1.0, 0.2, -0.3])
    run = simulated(dyn, q, v, 0.4, "rk4", dt=dt, torque=tau)
    assert names(run) == [f"{x} stops" for x in ("crank", "coupler", "rocker")]
    at = q, v
    for k in range(40):
        at = dyn.step(*at, tau, dt)
        assert np.abs(at[0] - run.q[k + 1]).max() < 1e-12
        assert np.abs(at[1] - run.v[k + 1]).max() < 1e-12
    assert not run.check().doubts
    run.save(tmp_path / "run.npz")
    back = mb.Trajectory.load(tmp_path / "run.npz", dyn.model)
    assert names(back) == names(run)
    assert (back.q == run.q).all()
    assert (back.work() == run.work()).all()
    held = simulated(dyn, q, v, 0.4, "rk4", dt=dt, torque=lambda *_: tau, hold=0.05)
    assert names(held) == names(run)
    assert np.abs(held.q - run.q).max() < 1e-13
    # A force on the rocker is its moment, whether it rests or moves.
    pushed = simulated(dyn, q, v, 0.4, "rk4", dt=dt, torque=tau * [1, 1, 0], wrenches={"rocker": [0, 0, 0, 0, 0, -0.3]})
    assert np.abs(pushed.q - run.q).max() < 1e-12
    assert names(pushed) == names(run)


def rubbing(name: str, seed: int, **options: bool) -> tuple[Any, np.ndarray, np.ndarray]:
    """Return dynamics of a system of the catalog with stiction at all of its joints, and a state."""
    rng, b = np.random.default_rng(seed), getattr(mb.catalog, name)()
    numbers = [(j, 0.2 * (0.5 + rng.random(j.type.nv))) for j in b.joints]
    joints = tuple(replace(j, friction=f, stiction=1.3 * f) if j.type.nv else j for j, f in numbers)
    dyn = mb.dynamics(replace(b, joints=joints), "lagrangian", **options)
    return dyn, *dyn.model.random_state(rng)


@pytest.mark.thorough("double_cardan_shaft", "chaplygin_sleigh")
@pytest.mark.parametrize("name", ["five_bar", "double_cardan_shaft", "chaplygin_sleigh"])
def test_moreau_s_steps_beside_rows_in_machine_code_are_those_in_python(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    dyn, q, v = rubbing(name, 3, compile=True)
    tau = 0.3 * np.random.default_rng(0).standard_normal((60, dyn.model.nv))
    monkeypatch.delattr(moreau._Stepper, "__call__")
    run = simulated(dyn, q, v, 0.0595, "moreau", dt=1e-3, torque=tau)
    monkeypatch.undo()
    monkeypatch.setattr(moreau, "_compiles", lambda _: False)
    other = simulated(dyn, q, v, 0.0595, "moreau", dt=1e-3, torque=tau)
    assert np.abs(run.q - other.q).max() < 1e-13
    assert np.abs(run.v - other.v).max() < 1e-12
    np.testing.assert_array_equal(run.v == 0, other.v == 0)


def test_moreau_s_steps_of_a_robot_whose_code_takes_long_to_make_are_in_python() -> None:
    for name, few in (("delta_robot", False), ("planar_3rrr", True)):
        dyn, *_ = rubbing(name, 2, compile=False)
        dyn.__class__ = type("Compiling", (type(dyn),), {"_compiles_steps": True})
        problem: Any = SimpleNamespace(dyn=dyn, torque=SimpleNamespace(callable=False))
        assert moreau._compiles(problem) == few


def test_moreau_s_steps_in_machine_code_follow_a_table_that_is_shaken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(moreau._Stepper, "__call__")
    run = simulated(dynamics(shaken(), "compiled"), [0.0, 0.0], [1.5, 0.0], 1.0, "moreau", dt=5e-4)
    loose = np.arcsin(3.0 / 1.5 / 4.5) / 3
    turn = brentq(lambda t: slid(loose, t, 1.0)[1], loose + 0.5, 2.0, xtol=1e-14)
    assert turn > 1
    assert run.q[-1] == pytest.approx([0.5 * np.sin(3.0), slid(loose, 1.0, 1.0)[0]], abs=2e-3)
    assert run.v[-1] == pytest.approx([1.5 * np.cos(3.0), slid(loose, 1.0, 1.0)[1]], abs=3e-3)
    rests = run.t < loose - 1e-3
    assert (run.q[rests, 1] == 0).all()


def test_moreau_s_steps_in_machine_code_end_where_friction_has_taken_the_energy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A crank and a slider, whose friction at any pose is known: without gravity all of T goes into it."""
    friction, start, speed = np.array([0.4, 0.3, 3.0]), 0.4, 5.0
    b = mb.ModelBuilder.of(slider_crank(*friction))
    b.set_gravity((0, 0, 0))
    dyn, (q, slope) = mb.dynamics(b.build(), "lagrangian", compile=True), crank_pose(start)
    monkeypatch.delattr(moreau._Stepper, "__call__")

    def left(theta: float) -> float:
        lost = quad(lambda x: friction @ np.abs(crank_pose(x)[1]), start, theta, points=[np.pi], epsabs=1e-12)[0]
        return float(crank_energies(start)[0] * speed**2 - lost)

    end, far = brentq(left, start, start + 6.0, xtol=1e-12), []
    for h in (1e-3, 5e-4):
        run = simulated(dyn, q, speed * slope, 2.0, "moreau", dt=h)
        assert (run.v[-1] == 0).all()
        far.append(run.q[-1, 0] - end)
    assert abs(far[0]) < 5e-3
    # The order is one.
    assert far[1] / far[0] == pytest.approx(0.5, abs=0.1)


@pytest.mark.thorough("planar_3rrr", "five_bar")
@pytest.mark.parametrize("name", ["planar_3rrr", "five_bar", "double_cardan_shaft", "chaplygin_sleigh"])
def test_methods_agree_on_mechanisms_with_stiction_at_all_joints(name: str) -> None:
    """A slide of the shaft rests by itself, and hardly responds to forces."""
    dyn, q, v = rubbing(name, 2)
    settings = ("rk853", ADAPTIVE), ("rk4", {"dt": 1e-3})
    runs = [simulated(dyn, q, v, 0.3, method, save=[0.0, 0.3], **more) for method, more in settings]
    assert np.abs(runs[0].q[-1] - runs[1].q[-1]).max() < 1e-7


def test_a_joint_that_turns_at_a_singular_pose_ends_a_run_by_name_or_passes_with_a_doubt() -> None:
    """The scissor's slide turns where it is flat, at which a step may have no state."""
    dyn, q, v = rubbing("scissor", 2)
    with warnings.catch_warnings(action="ignore"):
        run = mb.simulate(dyn, q, v, 0.6, "rk853", rtol=1e-10)
    assert "singular pose" in "".join((run.stats.message, *run.stats.doubts))


@pytest.mark.thorough("rk853")
@pytest.mark.parametrize("method", ["rk853", "rk4"])
def test_rods_that_only_shift_are_in_no_event(method: str) -> None:
    """Two of these pins do not turn, but for rounding."""
    dyn, q, v = rubbing("four_bars", 2)
    more = ADAPTIVE if method == "rk853" else {"dt": 2e-3}
    for run in (simulated(dyn, q, v, 1.0, method, **more), simulated(dyn, [q, q], [v, v], 1.0, "rk4", dt=2e-3)):
        assert {e.name for e in run.events} == {f"{x} turns" for x in ("theta0", "theta1", "phi1")}
