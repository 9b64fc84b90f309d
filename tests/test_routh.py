"""Cyclic coordinates, what a system keeps, and Routh's reduction: the reduced motion is the whole one's."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import sympy as sp
from sympy.physics.mechanics import dynamicsymbols

import mbkit as mb
from mbkit.errors import InputError, UnknownNameError, UnsupportedError
from mbkit.lagrangian.system import Lagrangian
from validation import elliptic

m, ell, g, A, C, mu, r, x, t, k, c = sp.symbols("m l g A C mu r x t k c")
theta, phi, psi = sp.symbols("theta phi psi")
w, u, s, rdot, xdot = sp.symbols("thetadot phidot psidot rdot xdot")
F, Omega, a = sp.symbols("F Omega a")
# Two runs at a tolerance of 1e-13, and the quadrature at 1e-13 behind one of them.
CLOSE = 1e-11


@cache
def spherical_pendulum() -> Lagrangian:
    T = m * ell**2 * (w**2 + sp.sin(theta) ** 2 * u**2) / 2
    return Lagrangian(T, -m * g * ell * sp.cos(theta), [theta, phi], parameters={m: 2.0, g: 9.81, ell: 0.8})


@cache
def heavy_top() -> Lagrangian:
    T = A * (w**2 + u**2 * sp.sin(theta) ** 2) / 2 + C * (s + u * sp.cos(theta)) ** 2 / 2
    parameters = {A: 0.5, C: 0.2, m: 1.0, g: 9.81, ell: 0.3}
    # The ignored ones on both sides of what remains.
    return Lagrangian(T, m * g * ell * sp.cos(theta), [phi, theta, psi], parameters=parameters)


@cache
def kepler() -> Lagrangian:
    return Lagrangian(m * (rdot**2 + r**2 * u**2) / 2, -mu * m / r, [r, phi], parameters={m: 3.0, mu: 1.7})


@cache
def driven() -> Lagrangian:
    """A spherical pendulum whose pivot moves up and down: T1 and T0 are not zero, and time enters."""
    height = a * sp.cos(Omega * t)
    T = m * (ell**2 * (w**2 + sp.sin(theta) ** 2 * u**2) + 2 * ell * w * sp.sin(theta) * height.diff(t)) / 2
    T += m * height.diff(t) ** 2 / 2
    parameters = {m: 2.0, g: 9.81, ell: 0.8, a: 0.05, Omega: 20.0}
    return Lagrangian(T, m * g * (height - ell * sp.cos(theta)), [theta, phi], time=t, parameters=parameters)


CASES = {
    "spherical pendulum": (spherical_pendulum, [0.9, 0.2], [0.3, 1.5]),
    "heavy top": (heavy_top, [0.1, 0.6, 0.2], [0.5, -0.2, 12.0]),
    "Kepler": (kepler, [0.7, 0.4], [0.5, 1.6]),
    "driven pivot": (driven, [0.9, 0.2], [0.3, 1.5]),
}


def run(system: Lagrangian, q, v, duration=2.0, save=None, **values):
    at = np.linspace(0.0, duration, 6) if save is None else save
    dyn = system.dynamics(options={"compile": False}, **values)
    return mb.simulate(dyn, q, v, float(at[-1]), "rk853", rtol=1e-13, save=at)


# What is kept


@pytest.mark.parametrize(
    "acting",
    [{"forces": {phi: F}}, {"dissipation": F * u**2}, {"constraints": [phi - theta]}],
    ids=["input", "dissipation", "constraint"],
)
def test_a_coordinate_that_is_acted_on_keeps_no_momentum(acting):
    T = m * ell**2 * (w**2 + sp.sin(theta) ** 2 * u**2) / 2
    parameters = [m, ell, g] if acting.get("forces") else [m, ell, g, F]
    system = Lagrangian(T, -m * g * ell * sp.cos(theta), [theta, phi], parameters=parameters, **acting)
    assert system.cyclic_coordinates() == ()
    assert list(system.forced_cyclic_coordinates()) == [phi]
    assert not system.conserved_momenta()


def test_jacobis_integral_is_told_from_the_energy():
    hoop = Lagrangian(
        m * ell**2 * (w**2 + Omega**2 * sp.sin(theta) ** 2) / 2,
        -m * g * ell * sp.cos(theta),
        [theta],
        parameters=[m, ell, g, Omega],
    )
    (kept,) = hoop.conserved_quantities()
    assert kept.name == "h"
    assert "not the energy" in kept.meaning
    expected = m * ell**2 * (w**2 - Omega**2 * sp.sin(theta) ** 2) / 2 - m * g * ell * sp.cos(theta)
    assert sp.simplify(kept.expression - expected) == 0


def test_energy_is_lost_to_time_forces_and_dissipation_but_not_to_gyroscopic_forces():
    names = [x.name for x in driven().conserved_quantities()]
    assert names == ["p_phi"]
    V, T = k * (x**2 + r**2) / 2, (xdot**2 + rdot**2) / 2
    assert not Lagrangian(T, V, [x, r], parameters=[k, c], dissipation=c * xdot**2).conserved_quantities()
    assert not Lagrangian(T, V, [x, r], parameters=[k], forces={x: F}).conserved_quantities()
    across = Lagrangian(T, V, [x, r], parameters=[k, c], forces={x: c * rdot, r: -c * xdot})
    assert [x.name for x in across.conserved_quantities()] == ["E"]


# The reduction


def test_routhian_of_the_heavy_top_is_the_textbooks():
    p_phi, p_psi = sp.symbols("p_phi p_psi")
    routhian = heavy_top().routhian()
    V = (
        (p_phi - p_psi * sp.cos(theta)) ** 2 / (2 * A * sp.sin(theta) ** 2)
        + p_psi**2 / (2 * C)
        + m * g * ell * sp.cos(theta)
    )
    assert routhian.effective_potential == V
    assert sp.expand(routhian.lagrangian.T - A * w**2 / 2) == 0
    assert set(routhian.momenta) == {p_phi, p_psi}
    assert routhian.lagrangian.coordinates == (theta,)
    assert "p_{\\phi}" in routhian.latex()


def test_the_effective_potential_has_the_part_of_axes_that_turn():
    """In axes that turn at Ω a mass on a spring rests at the same radius, where Vₑ is least: T0 belongs to it."""
    r, angle, k, W = sp.symbols("r phi k Omega", positive=True)
    rdot, turn = sp.symbols("rdot phidot")
    T = m * (rdot**2 + r**2 * (turn + W) ** 2) / 2
    reduced = Lagrangian(T, k * r**2 / 2, [r, angle], [rdot, turn], parameters=[m, k, W]).routhian()
    p = sp.Symbol("p_phi")
    assert sp.simplify(reduced.effective_potential - (k * r**2 / 2 + p**2 / (2 * m * r**2) - W * p)) == 0
    slope = sp.diff(reduced.effective_potential, r).subs({m: 1, k: 4, W: 1, p: 2})
    assert slope.subs(r, 1) == 0


def test_momenta_of_numbered_angles_are_set_below_the_line():
    first, second = sp.symbols("theta1 theta2")
    rates = sp.symbols("thetadot1 thetadot2")
    free = Lagrangian(m * (rates[0] ** 2 + rates[1] ** 2) / 2, 0, [first, second], rates, parameters=[m])
    assert r"p_{\theta_{1}} = " in free.conserved_quantities()[0].latex()
    assert r"\dot{p}_{\theta_{2}}" in free.hamiltonian().equations().latex()


@pytest.mark.thorough("spherical pendulum", "driven pivot")
@pytest.mark.parametrize("case", CASES)
def test_reduced_motion_is_the_whole_one(case):
    make, q, v = CASES[case]
    system = make()
    routhian = system.routhian()
    start = routhian.reduce(q, v)
    whole = run(system, q, v)
    reduced = run(routhian.lagrangian, start.q, start.v, **start.values)
    kept = [system.coordinates.index(x) for x in routhian.lagrangian.coordinates]
    assert reduced.q == pytest.approx(whole.q[:, kept], abs=CLOSE)
    motion = routhian.reconstruct(reduced, q)
    assert motion.q == pytest.approx(whole.q, abs=CLOSE)
    assert motion.v == pytest.approx(whole.v, abs=CLOSE * max(1.0, np.abs(whole.v).max()))


def test_some_of_the_cyclic_coordinates_leave_gyroscopic_terms():
    top, (_, q, v) = heavy_top(), CASES["heavy top"]
    routhian = top.routhian(psi)
    assert routhian.lagrangian.coordinates == (phi, theta)
    assert routhian.lagrangian.kinetic_split()[1] != 0
    start = routhian.reduce(q, v)
    whole, reduced = run(top, q, v), run(routhian.lagrangian, start.q, start.v, **start.values)
    assert routhian.reconstruct(reduced, q).q == pytest.approx(whole.q, abs=CLOSE)
    # What the first reduction leaves is reduced again.
    assert routhian.lagrangian.routhian().effective_potential == top.routhian().effective_potential


def test_reconstruction_reaches_elliptic_functions():
    times = np.linspace(0.0, 5.0, 9)
    exact = elliptic.SphericalPendulum(0.9, 0.3, 1.5, length=0.8, g=9.81)
    routhian = spherical_pendulum().routhian()
    azimuth, angle = exact.angles(times)[0].T
    start = routhian.reduce([0.9, 0.0], [0.3, 1.5])
    motion = routhian.reconstruct(run(routhian.lagrangian, start.q, start.v, save=times, **start.values), [0.9, 0.0])
    # 13 digits a step, over some fifty steps.
    assert motion.q[:, 0] == pytest.approx(angle, abs=1e-11)
    assert motion.q[:, 1] == pytest.approx(azimuth, abs=1e-11)


def test_keplers_ellipse_closes():
    routhian = kepler().routhian()
    q, v = [0.7, 0.4], [0.0, 2.4]
    start = routhian.reduce(q, v)
    axis = 1 / (2 / 0.7 - (0.7 * 2.4) ** 2 / 1.7)
    times = np.array([0.0, 0.3, 0.5, 1.0]) * 2 * np.pi * np.sqrt(axis**3 / 1.7)
    motion = routhian.reconstruct(run(routhian.lagrangian, start.q, start.v, save=times, **start.values), q)
    assert motion.q[-1] == pytest.approx([0.7, 0.4 + 2 * np.pi], abs=1e-11)
    eccentricity = 1 - 0.7 / axis
    ellipse = axis * (1 - eccentricity**2) / (1 + eccentricity * np.cos(motion.q[:, 1] - 0.4))
    assert motion.q[:, 0] == pytest.approx(ellipse, abs=1e-11)


@pytest.mark.thorough("spherical pendulum", "Kepler")
@pytest.mark.parametrize("case", ["spherical pendulum", "heavy top", "Kepler"])
def test_momenta_are_constant_to_rounding(case):
    make, q, v = CASES[case]
    system = make()
    hamiltonian, routhian = system.hamiltonian(), system.routhian()
    kept = [system.coordinates.index(x) for x in routhian.cyclic]
    p = hamiltonian.to_momentum(*(getattr(run(system, q, v), n) for n in "qv"))[:, kept]
    # The eighth order's own error at 1e-13 a step.
    assert p == pytest.approx(np.tile(p[0], (len(p), 1)), rel=1e-12)
    steps = mb.simulate(system.dynamics(options={"compile": False}), q, v, 1.0, "implicit_midpoint", dt=1e-2)
    p = hamiltonian.to_momentum(steps.q, steps.v)[:, kept]
    # The momenta themselves stay to the bit; velocities are made of them and momenta of those.
    assert p == pytest.approx(np.tile(p[0], (len(p), 1)), rel=32 * np.finfo(float).eps)


def test_forces_and_dissipation_on_what_remains():
    bare = spherical_pendulum()
    system = Lagrangian(
        bare.T, bare.V, [theta, phi], parameters={**bare.parameters, k: 0.2, c: 0.1},
        dissipation=c * w**2 / 2, forces={theta: -k * u**2 * sp.sin(theta)},
    )  # fmt: skip
    routhian = system.routhian()
    q, v = [0.9, 0.2], [0.3, 1.5]
    start = routhian.reduce(q, v)
    whole, reduced = run(system, q, v), run(routhian.lagrangian, start.q, start.v, **start.values)
    assert routhian.reconstruct(reduced, q).q == pytest.approx(whole.q, abs=CLOSE)


def test_reconstruction_from_arrays_and_of_the_ignored_alone():
    routhian = spherical_pendulum().routhian()
    start = routhian.reduce([0.9, 0.2], [0.3, 1.5])
    reduced = run(routhian.lagrangian, start.q, start.v, **start.values)
    told = routhian.reconstruct(reduced, [0.9, 0.2])
    again = routhian.reconstruct((reduced.t, reduced.q, reduced.v), [0.2], **start.values)
    assert np.array_equal(told.q, again.q)
    assert np.array_equal(told.v, again.v)
    batch = routhian.reduce(*(np.array([x, x]) for x in ([0.9, 0.2], [0.3, 1.5])))
    assert batch.values["p_phi"] == pytest.approx(start.values["p_phi"])


# What cannot be


def test_what_cannot_be_ignored_says_why():
    top = heavy_top()
    with pytest.raises(InputError, match="L holds theta; cyclic are phi, psi"):
        top.routhian(theta)
    with pytest.raises(InputError, match="x is no coordinate"):
        top.routhian([x])
    with pytest.raises(InputError, match="expected a list of symbols, got 3"):
        top.routhian(3)
    with pytest.raises(InputError, match="expected at least one"):
        top.routhian([])
    assert top.routhian(dynamicsymbols("phi")).R == top.routhian("phi").R
    forced = Lagrangian(m * (xdot**2 + rdot**2) / 2, k * r**2, [x, r], parameters=[m, k], forces={x: F})
    with pytest.raises(InputError, match="x is in no energy, but F acts along it"):
        forced.routhian()
    with pytest.raises(InputError, match="the force F acts along it"):
        forced.routhian("x")
    with pytest.raises(InputError, match="none would remain"):
        Lagrangian(m * (xdot**2 + rdot**2) / 2, 0, [x, r], parameters=[m]).routhian()
    held = Lagrangian(m * (xdot**2 + rdot**2) / 2, k * r**2, [x, r], parameters=[m, k], forces={r: sp.sin(x)})
    with pytest.raises(InputError, match=r"force sin\(x\) along r holds x"):
        held.routhian()


def test_bad_input_to_the_reconstruction():
    routhian = spherical_pendulum().routhian()
    start = routhian.reduce([0.9, 0.2], [0.3, 1.5])
    reduced = run(routhian.lagrangian, start.q, start.v, **start.values)
    with pytest.raises(InputError, match="expected the whole configuration"):
        routhian.reconstruct(reduced, [1.0, 2.0, 3.0])
    with pytest.raises(InputError, match="differ from the run's first state"):
        routhian.reconstruct(reduced, [0.8, 0.2])
    with pytest.raises(InputError, match="no value for parameter 'p_phi'"):
        routhian.reconstruct((reduced.t, reduced.q, reduced.v), [0.2])
    with pytest.raises(UnknownNameError, match="p_psi"):
        routhian.reconstruct(reduced, [0.2], p_psi=1.0)
    with pytest.raises(InputError, match="expected a Trajectory"):
        routhian.reconstruct(3, [0.2])
    with pytest.raises(InputError, match="ascend"):
        routhian.reconstruct((reduced.t[::-1], reduced.q, reduced.v), [0.2], **start.values)
    dyn = routhian.lagrangian.dynamics(options={"compile": False}, **start.values)
    pushed = mb.simulate(dyn, start.q, start.v, 0.1, torque=[1.0])
    with pytest.raises(UnsupportedError, match="a torque acted"):
        routhian.reconstruct(pushed, [0.2])
    with pytest.raises(InputError, match="no value for parameter"):
        Lagrangian(m * (xdot**2 + rdot**2) / 2, k * r**2, [x, r], parameters=[m, k]).routhian().reduce([0, 1], [1, 1])
