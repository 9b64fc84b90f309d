"""Steady motions against the textbooks: cones, orbits, precession and a governor."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import sympy as sp

import mbkit as mb
from mbkit.errors import InputError, NumericalError, UnknownNameError
from mbkit.lagrangian import Lagrangian, systems


@pytest.mark.parametrize("rate", [3.5, 5.0, 20.0])
def test_a_spherical_pendulum_circles_on_a_cone(rate) -> None:
    length = 0.9
    cone = mb.steady_motion(systems.spherical_pendulum(), [1.0], rates={"phi": rate}, m=0.7, l=length)
    cosine = 9.81 / (length * rate**2)
    assert np.cos(cone.equilibrium.q) == pytest.approx([cosine], rel=1e-12)
    # Goldstein, Poole, Safko 2002, ch. 3: it nods at Ω √(1 + 3 cos² θ).
    assert cone.frequencies == pytest.approx([rate * np.sqrt(1 + 3 * cosine**2)], rel=1e-9)
    assert cone.stable
    assert cone.rates == pytest.approx({"phi": rate}, rel=1e-12)
    assert "steady motion, stable" in str(cone)
    assert pickle.loads(pickle.dumps(cone)).momenta == cone.momenta


def test_the_state_of_a_steady_motion_stays() -> None:
    top = systems.heavy_top()
    steady = mb.steady_motion(top, [0.0, 0.7, 0.0], momenta={"p_phi": 0.12, "p_psi": 0.2})
    A, C, moment = 0.02, 0.005, 1.0 * 9.81 * 0.1
    turn, spin, tilt = steady.rates["phi"], steady.rates["psi"], steady.q[1]
    # C ω₃ φ' = m g l + A φ'² cos θ (Goldstein, Poole, Safko 2002, eq. 5.76).
    assert C * (spin + turn * np.cos(tilt)) * turn == pytest.approx(moment + A * turn**2 * np.cos(tilt), rel=1e-10)
    run = mb.simulate(top.dynamics(), steady.q, steady.v, duration=2.0, method="rk853", rtol=1e-12, atol=1e-12)
    assert run.q[:, 1] == pytest.approx(tilt, abs=1e-9)
    assert run.v[:, [0, 2]] == pytest.approx(np.tile([turn, spin], (len(run.t), 1)), rel=1e-8)


@pytest.mark.parametrize(("power", "stable"), [(-1, True), (1, True), (2, True), (-2.5, False), (-3, False)])
def test_circular_orbits_are_stable_by_bertrands_condition(power, stable) -> None:
    """V = k r^p / p: ω_r² = (2 + p) ω², stable above p = -2."""
    r, (phi, rdot, turn) = sp.Symbol("r", positive=True), sp.symbols("phi rdot phidot")
    T, V = (rdot**2 + r**2 * turn**2) / 2, 4 * r ** sp.Rational(power) / sp.Rational(power)
    orbit = mb.steady_motion(Lagrangian(T, V, [r, phi], [rdot, turn]), [1.1], momenta={"p_phi": 2.0})
    assert orbit.q[0] == pytest.approx(1.0, rel=1e-10)
    assert orbit.stable is stable
    if stable:
        assert orbit.frequencies == pytest.approx([2 * np.sqrt(2 + power)], rel=1e-8)


def test_axes_that_turn_change_nothing() -> None:
    """A mass on a spring circles at the radius where Vₑ with -T0 is least."""
    r, phi, rdot, turn = sp.symbols("r phi rdot phidot")
    T, V = (rdot**2 + r**2 * (turn + 1) ** 2) / 2, 2 * r**2
    steady = mb.steady_motion(Lagrangian(T, V, [r, phi]), [0.8], momenta={"p_phi": 2.0})
    assert steady.q[0] == pytest.approx(1.0, rel=1e-12)
    assert steady.rates["phi"] == pytest.approx(1.0, rel=1e-12)


@pytest.mark.thorough("momentum-1000.0", "rate-1000.0")
@pytest.mark.parametrize("start", [3.0, 10.0, 1e3])
@pytest.mark.parametrize("given", [{"momenta": {"p_phi": 1.0}}, {"rates": {"phi": 1.0}}], ids=["momentum", "rate"])
def test_an_orbit_is_found_from_far_out(start, given) -> None:
    assert mb.steady_motion(systems.kepler(), [start], **given).equilibrium.q == pytest.approx([1.0], abs=1e-12)


def test_an_orbit_is_found_without_a_start() -> None:
    # At r = 0, where the search begins, there is no equation.
    orbit = mb.steady_motion(systems.kepler(), momenta={"p_phi": 1.7})
    assert orbit.equilibrium.q == pytest.approx([1.7**2], rel=1e-9)


def test_a_sleeping_top_has_no_verdict_in_eulers_angles() -> None:
    # Of 1.2e-14 rad of tilt rounding made a stable top of one that falls: p² < 4 I1 m g l.
    top = systems.heavy_top()
    with pytest.raises(NumericalError, match="phi, psi turn about one axis"):
        mb.steady_motion(top, [0.0, 0.3, 0.0], momenta={"p_phi": 0.05, "p_psi": 0.05})


def test_a_rate_that_turns_nothing_is_no_steady_motion() -> None:
    # Below sqrt(g/l) no cone is steady: the search ends in the pole, where sqrt(g/l + 3 ω²) came out.
    pendulum = systems.spherical_pendulum()
    with pytest.raises(NumericalError, match="phi turns nothing at"):
        mb.steady_motion(pendulum, [1.0], rates={"phi": 1.0})
    hanging = mb.steady_motion(pendulum, [1.0], momenta={"p_phi": 0.0})
    assert hanging.frequencies == pytest.approx([np.sqrt(9.81)], rel=1e-9)


def test_constraints_hold_at_given_rates() -> None:
    # A bead in the trough z = x², pushed along it: ω² = 2 g across.
    x, y, z, xdot, ydot, zdot, g = sp.symbols("x y z xdot ydot zdot g")
    T = (xdot**2 + ydot**2 + zdot**2) / 2
    trough = Lagrangian(T, g * z, [x, y, z], parameters={g: 9.81}, constraints=[z - x**2])
    found = mb.steady_motion(trough, [0.1, 0.0, 0.01], rates={"y": 1.0})
    assert found.frequencies == pytest.approx([np.sqrt(2 * 9.81)], rel=1e-9)


def test_bad_questions_are_refused() -> None:
    pendulum = systems.spherical_pendulum()
    for bad in ("fast", None, [1, 2], np.nan):
        with pytest.raises(InputError, match=r"rates\[phi\]: expected"):
            mb.steady_motion(pendulum, [1.0], rates={"phi": bad})
        with pytest.raises(InputError, match=r"momenta\[p_phi\]: expected"):
            mb.steady_motion(pendulum, [1.0], momenta={"p_phi": bad})
    with pytest.raises(InputError, match="q0: expected real numbers"):
        mb.steady_motion(pendulum, "a", rates={"phi": 1.0})
    with pytest.raises(InputError, match="seed"):
        mb.steady_motion(pendulum, rates={"phi": 1.0}, seed="a")
    with pytest.raises(InputError, match="one of the two"):
        mb.steady_motion(pendulum, [1.0])
    with pytest.raises(InputError, match="one of the two"):
        mb.steady_motion(pendulum, [1.0], momenta={"p_phi": 1.0}, rates={"phi": 1.0})
    with pytest.raises(InputError, match="got none for p_phi"):
        mb.steady_motion(pendulum, [1.0], momenta={})
    with pytest.raises(UnknownNameError, match="p_theta"):
        mb.steady_motion(pendulum, [1.0], momenta={"p_theta": 1.0})
    with pytest.raises(InputError, match="q0"):
        mb.steady_motion(pendulum, [1.0, 2.0, 3.0], rates={"phi": 1.0})
    with pytest.raises(InputError, match="expected a Lagrangian"):
        mb.steady_motion(mb.catalog.pendulum(), [1.0], rates={"phi": 1.0})
    with pytest.raises(InputError, match="can be ignored"):
        mb.steady_motion(systems.double_pendulum(), rates={"phi": 1.0})
    with pytest.raises(InputError, match="depends on the time"):
        mb.steady_motion(systems.driven_pendulum(), rates={"phi": 1.0})
