"""Classical systems against closed forms written apart from mbkit: terms, momenta, frequencies, motions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.linalg import eigh

from mbkit import catalog
from mbkit.engines import dynamics
from mbkit.errors import InputError
from mbkit.model import Model
from mbkit.simulate import simulate
from validation import textbook
from validation.closed_forms import System, published

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


@pytest.mark.thorough(every=4)
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


# Slider-cranks


def test_massive_slider_crank_reaches_the_published_state() -> None:
    told, form = published()["rigid_slider_crank"], textbook.MassiveSliderCrank()
    assert form.inertia(0.0) == pytest.approx(told["J0"], rel=4 * EPS)
    assert form.inertia(np.pi / 2) == pytest.approx(told["J_half_pi"], rel=4 * EPS)
    exact = np.array(told["exact_t3_theta_thetadot"], dtype=float)
    # By energy and a quadrature. The rounding of an angle of 122 rad moves the speed, dθ̇/dθ ≈ 1e2, by 1e-14 of it.
    assert np.array(form.from_rest(3.0, told["torque"])) == pytest.approx(exact, rel=1e-13)
    # The simulation's energy is off by 2e-11 of the work done, its angle by 7e-10.
    assert np.array(told["simulated_t3_theta_thetadot"]) == pytest.approx(exact, rel=1e-9)


BAD: list[tuple[str, str, Any]] = [
    ("elastic_pendulum", "stiffness", 0.0),
    ("acrobot", "inertia2", np.nan),
    ("furuta_pendulum", "pendulum_inertia", (1.0, 1.0, 3.0)),
    ("gyroscope", "offset", -0.1),
    ("gyroscope", "rotor_axial", 1.0),
    ("gyroscope", "inner_inertia", (1.0, 2.0)),
    ("spacecraft_with_wheels", "wheel_axes", []),
    ("spacecraft_with_wheels", "wheel_axes", [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]),
    ("clamped_beam", "segments", 0),
    ("flexible_spacecraft", "hub", "ball"),
    ("flexible_spacecraft", "segments", 2.5),
]


@pytest.mark.parametrize(("name", "parameter", "value"), BAD)
def test_bad_parameters_are_named(name: str, parameter: str, value: Any) -> None:
    with pytest.raises(InputError, match=rf"^{parameter}: .*expected"):
        catalog.get(name)(**{parameter: value})
