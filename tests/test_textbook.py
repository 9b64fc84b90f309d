"""Classical systems against closed forms written apart from mbkit: terms, momenta, frequencies, motions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import eigh

from mbkit import catalog
from mbkit.engines import dynamics
from mbkit.errors import InputError
from mbkit.model import Model
from mbkit.simulate import simulate
from validation import elliptic, motions, textbook
from validation.closed_forms import System, published


def missed(form: Any, low: float, high: float) -> float:
    """Return by how much a motion kept each 5 ms misses its turning points: θ̈ h²/8."""
    return float(max(abs(form.acceleration(low)), abs(form.acceleration(high))) * 0.005**2 / 8)


def top() -> tuple[textbook.ReducedTop, np.ndarray, float]:
    """Return the default heavy top reduced, its ω at the start and the reduced energy; its axis starts at θ = π/2."""
    w = np.array([0.4, 30.0, -4.6])
    across, along, weight = 0.234375 + 15.0, 0.46875, 15.0 * 9.81
    # The axis is the body's y and lies along the world's y; p_φ is about the world's z.
    form = textbook.ReducedTop(across, along, weight, across * w[2], along * w[1])
    energy = across * (w[0] ** 2 + w[2] ** 2) / 2
    return form, w, energy


EPS = np.finfo(float).eps
ENGINES = ("pinocchio", "lagrangian", "mujoco")

WHEELS = {
    "hub_mass": 7.0,
    "hub_inertia": (0.3, 0.4, 0.2),
    "wheel_axes": ((1.0, 0.2, 0.0), (0.0, -2.0, 0.3), (0.4, 0.1, 1.0)),
    "wheel_mass": 0.6,
    "wheel_inertia": 0.02,
    "wheel_distance": 0.35,
}
FURUTA = {
    "arm_length": 0.6,
    "arm_mass": 1.3,
    "arm_com": 0.2,
    "arm_inertia": 0.05,
    "pendulum_mass": 0.7,
    "pendulum_com": 0.4,
    "pendulum_inertia": (0.03, 0.02, 0.015),
}
GYROSCOPE = {
    "rotor_mass": 1.7,
    "rotor_axial": 0.03,
    "rotor_across": 0.02,
    "offset": 0.11,
    "inner_inertia": (0.02, 0.013, 0.03),
    "outer_inertia": 0.04,
}
ACROBOT = {
    "length1": 0.7,
    "mass1": 1.3,
    "mass2": 0.4,
    "com1": 0.2,
    "com2": 0.6,
    "inertia1": 0.1,
    "inertia2": 0.05,
}
BEAM = {"segments": 3, "length": 1.7, "mass": 0.6, "bending_stiffness": 0.9}
CRAFT = {**BEAM, "hub_mass": 1.1, "hub_radius": 0.4}

# Each system with its defaults and with numbers that hide no factor.
CASES: dict[str, tuple[Callable[[], Model], Callable[[], System]]] = {
    "elastic_pendulum": (catalog.elastic_pendulum, textbook.elastic_pendulum),
    "elastic_pendulum, other numbers": (
        lambda: catalog.elastic_pendulum(length=0.7, mass=1.3, stiffness=31.0, gravity=3.7),
        lambda: textbook.elastic_pendulum(0.7, 1.3, 31.0, 3.7),
    ),
    "acrobot": (catalog.acrobot, textbook.acrobot),
    "acrobot, other numbers": (
        lambda: catalog.acrobot(**ACROBOT, gravity=3.7),
        lambda: textbook.acrobot(**ACROBOT, g=3.7),
    ),
    "furuta_pendulum": (catalog.furuta_pendulum, textbook.furuta_pendulum),
    "furuta_pendulum, other numbers": (
        lambda: catalog.furuta_pendulum(**FURUTA, gravity=3.7),
        lambda: textbook.furuta_pendulum(**FURUTA, g=3.7),
    ),
    "gyroscope": (catalog.gyroscope, textbook.Gyroscope().system),
    "gyroscope, other numbers": (
        lambda: catalog.gyroscope(**GYROSCOPE, gravity=3.7),
        textbook.Gyroscope(**GYROSCOPE, g=3.7).system,
    ),
    "spacecraft_with_wheels": (catalog.spacecraft_with_wheels, textbook.WheeledSpacecraft().system),
    "spacecraft_with_wheels, other numbers": (
        lambda: catalog.spacecraft_with_wheels(**WHEELS),
        textbook.WheeledSpacecraft(**WHEELS).system,
    ),
    "clamped_beam": (catalog.clamped_beam, textbook.clamped_beam),
    "clamped_beam, other numbers": (lambda: catalog.clamped_beam(**BEAM), lambda: textbook.clamped_beam(**BEAM)),
    "flexible_spacecraft": (
        lambda: catalog.flexible_spacecraft(segments=4),
        lambda: textbook.flexible_spacecraft(4),
    ),
    "flexible_spacecraft, other numbers": (
        lambda: catalog.flexible_spacecraft(**CRAFT, hub_inertia=(0.2, 0.25, 0.3)),
        lambda: textbook.flexible_spacecraft(**CRAFT, hub_inertia=0.3),
    ),
}


def states(model: Model, count: int = 6) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return rest and random states, limits left aside."""
    rng = np.random.default_rng(5)
    # The elastic pendulum's mass stays off the pivot.
    reach = np.array([0.5 if name == "stretch" else 3.0 for name in model.velocity_names])
    turned = [model.integrate(model.neutral(), rng.uniform(-reach, reach)) for _ in range(count)]
    return [(model.neutral(), np.zeros(model.nv)), *((q, 3 * rng.standard_normal(model.nv)) for q in turned)]


# Terms


@pytest.mark.thorough(every=2)
@pytest.mark.parametrize("name", ENGINES)
@pytest.mark.parametrize("case", CASES)
def test_engines_agree_with_closed_forms(case: str, name: str) -> None:
    """Terms to 64 eps of their scale, accelerations to that times cond(M)."""
    build, form = CASES[case][0], CASES[case][1]()
    model = build()
    dyn = dynamics(model, name)
    rng = np.random.default_rng(6)
    for q, v in states(model):
        tau = rng.standard_normal(model.nv)
        M, g, nle = form.mass_matrix(q), form.gravity(q), form.nle(q, v)
        springs = form.passive(q) if isinstance(form, textbook.Sprung) else np.zeros(model.nv)
        diagonal = np.sqrt(np.diag(M))
        assert np.all(np.abs(dyn.mass_matrix(q) - M) <= 64 * EPS * np.outer(diagonal, diagonal))
        # Gravity may vanish at a pose by cancellation, so its scale is not its own size.
        weight = model.mass * float(np.linalg.norm(model.gravity)) * max(1.0, diagonal.max(), float(np.abs(q).max()))
        force = weight + float(np.linalg.norm(M) * (v @ v))
        assert np.all(np.abs(dyn.gravity(q) - g) <= 64 * EPS * weight)
        assert np.all(np.abs(dyn.nle(q, v) - nle) <= 64 * EPS * force)
        assert np.all(np.abs(dyn.passive(q, v) - springs) <= 64 * EPS * (np.abs(springs) + 1e-300))
        if "coriolis_matrix" in dyn.supports:
            assert np.all(np.abs(dyn.coriolis_matrix(q, v) @ v - form.velocity_force(q, v)) <= 64 * EPS * force)
        a = form.forward_dynamics(q, v, tau)
        push = force + float(np.linalg.norm(springs))
        scale = float(np.linalg.cond(M) * (np.linalg.norm(a) + push / np.linalg.norm(M)))
        assert np.linalg.norm(dyn.forward_dynamics(q, v, tau) - a) <= 64 * EPS * max(scale, 1.0)
        assert abs(dyn.kinetic_energy(q, v) - form.kinetic_energy(q, v)) <= 64 * EPS * max(force, 1e-300)
        stored = abs(springs) @ abs(q[-model.nv :]) + weight
        assert abs(dyn.potential_energy(q) - form.potential_energy(q)) <= 64 * EPS * max(stored, 1.0)


# Spacecraft with wheels


def test_wheels_turn_the_body_by_euler() -> None:
    """Accelerations with motor torques alone are I ω̇ + ω × (I ω + h) = -ḣ about the centre of mass."""
    for values in ({}, WHEELS):
        model, form = catalog.spacecraft_with_wheels(**values), textbook.WheeledSpacecraft(**values)
        n = len(form.axes)
        rng = np.random.default_rng(3)
        for name in ENGINES:
            dyn = dynamics(model, name)
            for q, v in states(model, 3)[1:]:
                u = rng.standard_normal(n)
                a = dyn.forward_dynamics(q, v, np.concatenate([np.zeros(6), u]))
                turning, spinning = form.attitude_rates(v[3:6], v[6:], u)
                scale = 64 * EPS * np.linalg.cond(form.system().mass_matrix(q)) * max(np.abs(a).max(), v @ v)
                assert np.abs(a[3:6] - turning).max() <= scale
                assert np.abs(a[6:] - spinning).max() <= scale


def test_a_wheel_spun_up_turns_the_body_back() -> None:
    """From rest, u held on one wheel along a principal axis: θ = -u t²/(2 (I - J)), Ω = u t (1/J + 1/(I - J))."""
    J, u, t = 0.02, 0.3, 4.0
    model = catalog.spacecraft_with_wheels(wheel_axes=[[0.0, 0.0, 2.0]], wheel_inertia=J, hub_inertia=(4.0, 5.0, 3.0))
    torque = np.zeros(7)
    torque[6] = u
    run = simulate(dynamics(model), model.neutral(), np.zeros(7), t, "rk853", rtol=1e-13, torque=torque)
    angle = 2 * np.arctan2(run.q[-1, 5], run.q[-1, 6])
    # The hub alone is I - J, as the wheel turns by itself about that axis.
    assert angle == pytest.approx(-u * t**2 / 2 / 3.0, rel=1e-12)
    assert run.v[-1, 6] == pytest.approx(u * t * (1 / J + 1 / 3.0), rel=1e-12)
    assert np.abs(run.momentum()).max() <= 64 * EPS * u * t


# Beams


def frequencies(model: Model, count: int) -> np.ndarray:
    """Return the lowest ω of M⁻¹ K about zero, without motions of the whole."""
    dyn = dynamics(model, "pinocchio")
    q, v = model.neutral(), np.zeros(model.nv)
    first = model.nv - sum(len(j.stiffness) for j in model.joints if np.any(j.stiffness))
    K = np.zeros((model.nv, model.nv))
    for i in range(first, model.nv):
        e = np.eye(model.nv)[i]
        K[:, i] = -dyn.passive(model.integrate(q, e), v)
    squares = eigh(K, dyn.mass_matrix(q), eigvals_only=True)
    return np.asarray(np.sqrt(squares[first : first + count]))


def order(counts: tuple[int, ...], errors: list[np.ndarray]) -> np.ndarray:
    """Return the slope of log error over -log segments, for each mode."""
    return np.asarray(-np.polyfit(np.log(counts), np.log(np.abs(errors)), 1)[0])


COUNTS = (16, 24, 36)


def unit(values: Any) -> np.ndarray:
    """Return ω from β L with the default beam."""
    return np.asarray(np.asarray(values) ** 2 * np.sqrt(1500.0 * 10.0 / 20.0) / 10.0**2)


def test_cantilever_roots_are_the_printed_ones() -> None:
    printed = np.array(published()["beam_bending"]["betaL"]["clamped_free"], dtype=float)
    assert textbook.cantilever_roots(5) == pytest.approx(printed, rel=2 * EPS)


def test_frequencies_of_the_clamped_beam_converge_with_third_order() -> None:
    exact = unit(textbook.cantilever_roots(3))
    errors = [frequencies(catalog.clamped_beam(segments=n), 3) / exact - 1 for n in COUNTS]
    assert order(COUNTS, errors) == pytest.approx(3.0, abs=0.25)
    few = np.abs(frequencies(catalog.clamped_beam(segments=8), 3) / exact - 1)
    assert np.all(few < [1.5e-4, 1.7e-3, 4e-3])


def test_a_heavy_hub_clamps_its_appendages() -> None:
    """Two of each cantilever's frequency, and what a finite hub leaves falls with its mass."""
    apart = []
    for weight in (1e6, 1e8):
        model = catalog.flexible_spacecraft(hub_mass=weight, hub_inertia=(weight,) * 3)
        clamped = frequencies(catalog.clamped_beam(), 2)
        apart.append(np.abs(frequencies(model, 4) / np.repeat(clamped, 2) - 1).max())
    assert apart[1] == pytest.approx(apart[0] / 100, rel=0.05)
    assert apart[1] < 1e-4


@pytest.mark.parametrize("hub", ["planar", "free"])
def test_frequencies_of_the_free_spacecraft_converge(hub: Any) -> None:
    """To those of the partial differential equation with a hub that sways and turns."""
    swaying = unit(textbook.spacecraft_roots(2, "swaying", 500.0))
    turning = unit(textbook.spacecraft_roots(2, "turning", 300.0))
    exact = np.sort(np.concatenate([swaying, turning]))
    counts = COUNTS if hub == "planar" else COUNTS[:1]
    errors = [frequencies(catalog.flexible_spacecraft(segments=n, hub=hub), 4) / exact - 1 for n in counts]
    assert np.abs(errors[0]).max() < 2e-3
    if hub == "planar":
        assert order(counts, errors) == pytest.approx(3.0, abs=0.3)


@pytest.mark.parametrize("hub", ["planar", "free"])
def test_momentum_of_the_free_spacecraft_stays(hub: Any) -> None:
    model = catalog.flexible_spacecraft(segments=2, hub=hub, **{k: x for k, x in CRAFT.items() if k != "segments"})
    rng = np.random.default_rng(8)
    q, v = model.integrate(model.neutral(), rng.uniform(-0.5, 0.5, model.nv)), rng.standard_normal(model.nv)
    run = simulate(dynamics(model), q, v, 2.0, "rk853", rtol=1e-13)
    momentum = run.momentum()
    assert run.stats.finished
    assert np.abs(momentum - momentum[0]).max() <= 1e-12 * np.abs(momentum).max()
    assert np.abs(run.energy() / run.energy()[0] - 1).max() <= 1e-12
    assert np.abs(run.q[:, -4:]).max() > 0.3, "the beams should bend on the way"


# Gyroscope


@pytest.mark.parametrize("nutation", [0.0, 0.4, -0.7])
def test_gyroscope_precesses_steadily(nutation: float) -> None:
    form = textbook.Gyroscope(**GYROSCOPE)
    model = catalog.gyroscope(**GYROSCOPE)
    for spin in (60.0, -60.0):
        for rate in form.steady_precession(nutation, spin):
            if not np.isfinite(rate):
                continue
            q, v = np.array([0.3, nutation, 0.0]), np.array([rate, 0.0, spin])
            for name in ENGINES:
                a = dynamics(model, name).forward_dynamics(q, v, np.zeros(3))
                assert np.abs(a).max() <= 1e-12 * (rate**2 + spin**2)
    slow = form.steady_precession(nutation, 60.0)[0]
    run = simulate(dynamics(model), [0.0, nutation, 0.0], [slow, 0.0, 60.0], 2.0, "rk853", rtol=1e-13)
    # The motion is steady and stable; what is left is the rounding of its start.
    assert run.q[-1] == pytest.approx([2 * slow, nutation, 120.0], abs=1e-11)
    assert slow == pytest.approx(form.moment / (form.rotor_axial * 60.0), rel=0.1), "the rule of thumb"


def test_balanced_gyroscope_nutates() -> None:
    """After a small push β swings with the closed form's frequency: once round brings it back."""
    form = textbook.Gyroscope(offset=0.0)
    spin, push = 200.0, 1e-6
    period = 2 * np.pi / form.nutation_rate(spin)
    run = simulate(dynamics(catalog.gyroscope(offset=0.0)), np.zeros(3), [0.0, push, spin], period, "rk853", rtol=1e-13)
    # Linear in the push, so its square over the nutation's own speed is left.
    assert run.v[-1, 1] == pytest.approx(push, rel=1e-6)
    assert abs(run.q[-1, 1]) <= 1e-6 * push
    peak = np.abs(run.q[:, 1]).max()
    assert peak == pytest.approx(push / form.nutation_rate(spin), rel=0.1)


# Slider-cranks


@pytest.mark.parametrize("form", [textbook.SliderCrank(), textbook.MassiveSliderCrank()])
def test_slider_crank_slopes_are_the_derivatives(form: Any) -> None:
    """By complex steps, which round to the last digits."""
    theta, h = np.linspace(-7, 7, 101), 1e-40
    scale = np.abs(form.inertia(theta)).max()
    assert form.inertia_slope(theta) == pytest.approx(np.imag(form.inertia(theta + 1j * h)) / h, abs=16 * EPS * scale)
    if isinstance(form, textbook.SliderCrank):
        assert form.slope(theta) == pytest.approx(np.imag(form.position(theta + 1j * h)) / h, abs=16 * EPS)
        assert form.bend(theta) == pytest.approx(np.imag(form.slope(theta + 1j * h)) / h, abs=16 * EPS)
        assert form.inertia(theta) == pytest.approx(form.mass * form.slope(theta) ** 2, rel=64 * EPS, abs=1e-30)


def test_dead_centres() -> None:
    form = textbook.SliderCrank()
    for theta, place, bend in form.dead_centres():
        assert form.position(theta) == pytest.approx(place, rel=4 * EPS)
        assert abs(form.slope(theta)) <= EPS
        assert form.bend(theta) == pytest.approx(bend, rel=16 * EPS)
        assert abs(form.inertia_slope(theta)) <= EPS
        assert form.force(theta, 2.0, 5.0) == pytest.approx(2.0, abs=8 * EPS), "no push turns the crank there"
        # J grows as m s''² δ², so a torque gives an acceleration without bound.
        near = theta + 1e-4
        assert form.inertia(near) == pytest.approx(form.mass * bend**2 * 1e-8, rel=1e-3)
        assert form.angular(near, 0.0, 1.0, 0.0) == pytest.approx(1e8 / (form.mass * bend**2), rel=1e-3)


def test_slider_crank_equation_moves_the_piston_by_newton() -> None:
    """Without torque the piston feels its push alone: s̈ = F/m, wherever the crank stands."""
    form = textbook.SliderCrank()
    for theta in (0.3, 1.2, -2.0, 4.0):
        angular = form.angular(theta, 7.0, 0.0, 5.0)
        assert form.acceleration(theta, 7.0, angular) == pytest.approx(5.0 / form.mass, rel=1e-12)
        assert form.velocity(theta, 7.0) == 7.0 * form.slope(theta)


def test_massive_slider_crank_reaches_the_published_state() -> None:
    told, form = published()["rigid_slider_crank"], textbook.MassiveSliderCrank()
    assert form.inertia(0.0) == pytest.approx(told["J0"], rel=4 * EPS)
    assert form.inertia(np.pi / 2) == pytest.approx(told["J_half_pi"], rel=4 * EPS)
    exact = np.array(told["exact_t3_theta_thetadot"], dtype=float)
    # By energy and a quadrature. The rounding of an angle of 122 rad moves the speed, dθ̇/dθ ≈ 1e2, by 1e-14 of it.
    assert np.array(form.from_rest(3.0, told["torque"])) == pytest.approx(exact, rel=1e-13)
    # The simulation's energy is off by 2e-11 of the work done, its angle by 7e-10.
    assert np.array(told["simulated_t3_theta_thetadot"]) == pytest.approx(exact, rel=1e-9)


# Kepler


@pytest.mark.parametrize("e", [0.0, 0.2, 0.7, 0.99])
def test_kepler_orbit_obeys_its_equations(e: float) -> None:
    orbit = textbook.Kepler(3.0, 1.7, e, apse=0.4, passage=-0.3)
    t = np.linspace(-9, 25, 400)
    q, v = orbit.at(t)
    E = orbit.anomaly(t)
    mean = orbit.rate * (t + 0.3)
    assert np.abs(E - e * np.sin(E) - mean).max() <= 8 * EPS * np.abs(mean).max()
    r, radial, turning = q[:, 0], v[:, 0], v[:, 1]
    # 1/(1 - e) of a rounding enters where the orbit is fast.
    assert r**2 * turning == pytest.approx(orbit.momentum, rel=16 * EPS)
    energy = (radial**2 + (r * turning) ** 2) / 2 - orbit.k / r
    assert energy == pytest.approx(orbit.energy, abs=64 * EPS * orbit.k / r.min())
    later, _ = orbit.at(t + orbit.period)
    assert later - q == pytest.approx(np.tile([0.0, 2 * np.pi], (400, 1)), abs=1e-12 / (1 - e) ** 2)
    conic = orbit.momentum**2 / orbit.k / (1 + e * np.cos(q[:, 1] - 0.4))
    assert r == pytest.approx(conic, rel=64 * EPS / (1 - e) ** 2)
    # Differences see r̈ up to the h² of their own.
    h = 1e-4 * (1 - e) ** 1.5
    ahead, behind = orbit.at(t + h)[1][:, 0], orbit.at(t - h)[1][:, 0]
    size = orbit.k / r**2
    assert np.abs((ahead - behind) / (2 * h) - orbit.radial_acceleration(r)).max() <= 1e-6 * size.max()
    back = textbook.Kepler.of(3.0, *orbit.at(0.0)[0], *orbit.at(0.0)[1])
    assert (back.semi_major, back.eccentricity) == pytest.approx((1.7, e), abs=64 * EPS / (1 - e))
    assert back.at(2.0)[0] == pytest.approx(orbit.at(2.0)[0], abs=1e-12 / (1 - e) ** 2)


def test_kepler_says_what_is_no_ellipse() -> None:
    with pytest.raises(ValueError, match="bound"):
        textbook.Kepler.of(1.0, 1.0, 0.0, 0.0, 1.5)
    with pytest.raises(ValueError, match="positive"):
        textbook.Kepler.of(1.0, 1.0, 0.0, 0.3, 0.0)


# Driven systems


@pytest.mark.parametrize("spin", [2.0, 3.0, 5.0])
def test_bead_rests_where_the_closed_form_says(spin: float) -> None:
    form = textbook.BeadOnHoop(radius=1.3, spin=spin)
    found = form.equilibria()
    assert len(found) == (4 if spin > form.threshold else 2)
    h = 1e-5
    for theta, square in found:
        assert abs(form.acceleration(theta)) <= 8 * EPS * spin**2
        slope = (form.acceleration(theta + h) - form.acceleration(theta - h)) / (2 * h)
        assert -slope == pytest.approx(square, rel=1e-8, abs=1e-8)
        assert (square > 0) == (theta != np.pi and (theta != 0 or spin < form.threshold))
    run = solve_ivp(lambda _, y: [y[1], form.acceleration(y[0])], (0, 5), [0.3, 1.0], rtol=1e-11, atol=1e-12)
    kept = form.jacobi_integral(*run.y)
    assert np.ptp(kept) <= 1e-8 * np.abs(kept).max()
    assert np.ptp(kept + 2 * form.kinetic_split(*run.y)[2]) > 0.1, "the energy is not kept"


def test_kapitza_upright_is_stable_as_the_average_says() -> None:
    fast = textbook.Kapitza()
    assert fast.upright_is_stable
    assert abs(motions.half_trace(fast, np.pi)) < 1
    slow = textbook.Kapitza(frequency=60.0)
    assert not slow.upright_is_stable
    assert motions.half_trace(slow, np.pi) > 1
    # The true frequency tends to the averaged one with the square of the shaking's a/l.
    apart = []
    for a in (0.02, 0.01):
        form = textbook.Kapitza(amplitude=a, frequency=6.0 / a)
        true = np.arccos(motions.half_trace(form, np.pi)) * form.frequency / (2 * np.pi)
        apart.append(true**2 / form.upright_square - 1)
    assert apart[1] / apart[0] == pytest.approx(0.25, rel=0.1)
    assert abs(apart[1]) < 1e-3
    h = 1e-4
    curved = np.array([fast.effective_potential(np.pi + x) for x in (-h, 0, h)])
    assert curved @ [1, -2, 1] / h**2 == pytest.approx(fast.upright_square, rel=1e-4)


def test_kapitza_kinetic_energy_splits() -> None:
    """T of the bob's velocity, and the work of the pivot is the rate of energy."""
    form = textbook.Kapitza(length=0.8, mass=1.4)
    t, theta, speed = 0.37, 1.1, -2.3
    velocity = form.length * speed * np.array([np.cos(theta), np.sin(theta)]) + [0.0, form.pivot(t)[1]]
    assert sum(form.kinetic_split(t, theta, speed)) == pytest.approx(form.mass * velocity @ velocity / 2, rel=8 * EPS)


# Routh


def test_a_top_sleeps_when_it_spins_fast_enough() -> None:
    """The upright's potential has a minimum on one side of the threshold and a maximum on the other."""
    edge = 2 * np.sqrt(1.5 * 20.0)
    for p, stable in ((1.01 * edge, True), (0.99 * edge, False)):
        form = textbook.ReducedTop(1.5, 0.4, 20.0, p, p)
        assert form.sleeps() == stable
        assert (form.acceleration(0.01) < 0) == stable


BAD: list[tuple[str, str, Any]] = [
    ("elastic_pendulum", "stiffness", 0.0),
    ("elastic_pendulum", "length", -1.0),
    ("acrobot", "inertia2", np.nan),
    ("acrobot", "com1", 0.0),
    ("furuta_pendulum", "pendulum_inertia", (1.0, 1.0, 3.0)),
    ("furuta_pendulum", "arm_length", 0.0),
    ("gyroscope", "offset", -0.1),
    ("gyroscope", "rotor_axial", 1.0),
    ("gyroscope", "inner_inertia", (1.0, 2.0)),
    ("spacecraft_with_wheels", "wheel_axes", []),
    ("spacecraft_with_wheels", "wheel_axes", (1.0, 0.0, 0.0)),
    ("spacecraft_with_wheels", "wheel_axes", "xyz"),
    ("spacecraft_with_wheels", "wheel_axes", [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]),
    ("spacecraft_with_wheels", "wheel_axes", [[1.0, np.nan, 0.0]]),
    ("spacecraft_with_wheels", "wheel_axes", [[1.0, 0.0, 0.0], [0.0, 1.0]]),
    ("spacecraft_with_wheels", "wheel_distance", -0.1),
    ("clamped_beam", "segments", 0),
    ("clamped_beam", "bending_stiffness", 0.0),
    ("flexible_spacecraft", "hub", "ball"),
    ("flexible_spacecraft", "segments", 2.5),
    ("flexible_spacecraft", "hub_inertia", (1.0, 1.0, 3.0)),
    ("flexible_spacecraft", "hub_radius", -1.0),
]


@pytest.mark.parametrize(("name", "parameter", "value"), BAD)
def test_bad_parameters_are_named(name: str, parameter: str, value: Any) -> None:
    with pytest.raises(InputError, match=rf"^{parameter}: .*expected"):
        catalog.get(name)(**{parameter: value})


@pytest.mark.parametrize("case", CASES)
def test_closed_forms_agree_with_themselves(case: str) -> None:
    """T is ½ vᵀMv, g and the springs are V's slope, and no power is in the velocity force."""
    build, form = CASES[case][0], CASES[case][1]()
    model = build()
    h = 1e-5
    for q, v in states(model):
        M = form.mass_matrix(q)
        assert form.kinetic_energy(q, v) == pytest.approx(v @ M @ v / 2, rel=50 * EPS, abs=1e-300)
        springs = form.passive(q) if isinstance(form, textbook.Sprung) else np.zeros(model.nv)
        for i, e in enumerate(np.eye(model.nv)):
            up, down = (form.potential_energy(model.integrate(q, x * e)) for x in (h, -h))
            # Central differences: of V's rounding h is left, of its third derivative h² / 6.
            scale = max(abs(up), abs(springs).max(), 1.0)
            assert form.gravity(q)[i] - springs[i] == pytest.approx((up - down) / (2 * h), abs=1e-9 * scale)
        # Along a velocity field of constant v, d/dt ½ vᵀMv is the power of h = C v.
        ahead, behind = (form.kinetic_energy(model.integrate(q, x * v), v) for x in (h, -h))
        power = v @ form.velocity_force(q, v)
        scale = float(np.linalg.norm(M) * np.linalg.norm(v) ** 3)
        assert power == pytest.approx((ahead - behind) / (2 * h), abs=1e-9 * max(scale, 1e-300))


def test_momenta_of_a_torque_free_spacecraft_stay() -> None:
    model = catalog.spacecraft_with_wheels(**WHEELS)
    q, v = states(model, 1)[1]
    run = simulate(dynamics(model), q, v, 3.0, "rk853", rtol=1e-13)
    assert run.stats.finished
    momentum = run.momentum()
    # About the origin: its angular part holds position × momentum, so the scale is the largest of them.
    assert np.abs(momentum - momentum[0]).max() <= 1e-12 * np.abs(momentum).max()
    drift = run.energy() - run.energy()[0]
    assert np.abs(drift).max() <= 1e-12 * run.energy()[0]


def test_reduced_spherical_pendulum_moves_as_the_whole() -> None:
    model = catalog.spherical_pendulum(length=0.7, mass=1.3)
    theta, turning, swinging = 0.9, 2.1, 0.6
    form = textbook.ReducedPendulum(1.3 * 0.7**2 * np.sin(theta) ** 2 * turning, 0.7, 1.3)
    h = 1e-5
    slope = (form.effective_potential(theta + h) - form.effective_potential(theta - h)) / (2 * h)
    assert form.acceleration(theta) == pytest.approx(-slope / (1.3 * 0.7**2), rel=1e-8)
    assert form.azimuth_rate(theta) == pytest.approx(turning, rel=8 * EPS)
    energy = 1.3 * 0.7**2 * swinging**2 / 2 + form.effective_potential(theta)
    low, high = form.limits(energy)
    for end in (low, high):
        assert form.effective_potential(end) == pytest.approx(energy, rel=1e-12)
    # At azimuth 0 and in its plane: α = θ, and β turns with the azimuth.
    run = simulate(
        dynamics(model),
        [theta, 0.0],
        [swinging, turning * np.sin(theta)],
        4.0,
        "rk853",
        rtol=1e-12,
        save=np.linspace(0, 4, 801),
    )
    cosine = np.cos(run.q[:, 0]) * np.cos(run.q[:, 1])
    angle = np.arccos(cosine)
    assert (angle.min(), angle.max()) == pytest.approx((low, high), abs=missed(form, low, high))
    reduced = solve_ivp(
        lambda _, y: [y[1], form.acceleration(y[0])], (0, 4), [theta, swinging], method="DOP853", rtol=1e-12, atol=1e-12
    )
    assert reduced.y[0, -1] == pytest.approx(angle[-1], abs=1e-10)


def test_reduced_top_moves_as_the_whole() -> None:
    form, w, energy = top()
    model = catalog.heavy_top()
    low, high = form.limits(energy)
    for end in (low, high):
        assert form.effective_potential(end) == pytest.approx(energy, abs=1e-11 * form.weight)
    h = 1e-5
    slope = (form.effective_potential(1.3 + h) - form.effective_potential(1.3 - h)) / (2 * h)
    assert form.acceleration(1.3) == pytest.approx(-slope / form.across, rel=1e-8)
    assert form.ignored_rates(np.pi / 2) == pytest.approx((w[2], w[1]), rel=8 * EPS)
    times = np.linspace(0, 3, 601)
    run = simulate(dynamics(model), [0.0, 0.0, 0.0, 1.0], w, 3.0, "rk853", rtol=1e-12, save=times)
    x, y, z, s = run.q.T
    # The world's z of the body's y.
    angle = np.arccos(2 * (y * z + x * s))
    assert (angle.min(), angle.max()) == pytest.approx((low, high), abs=missed(form, low, high))
    reduced = solve_ivp(
        lambda _, y: [y[1], form.acceleration(y[0])],
        (0, 3),
        [np.pi / 2, -w[0]],
        method="DOP853",
        rtol=1e-12,
        atol=1e-12,
    )
    assert reduced.y[0, -1] == pytest.approx(angle[-1], abs=1e-9)


def test_limits_of_the_top_are_those_of_the_elliptic_solution() -> None:
    form, w, energy = top()
    A = form.across
    motion = elliptic.Nutation.of(0, w[0], form.p_psi / A, form.p_phi / A, 2 * form.weight / A, w[1])
    low, high = form.limits(energy)
    assert (np.cos(high), np.cos(low)) == pytest.approx((float(motion.u1), float(motion.u2)), abs=1e-13)
