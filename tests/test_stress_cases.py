"""The cases of a study of stress: each makes its problems, and each closed form is a motion of its model."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
from scipy.integrate._ivp import dop853_coefficients

from mbkit import catalog
from mbkit.engines import dynamics
from mbkit.engines.base import at_times
from mbkit.errors import UnknownNameError
from mbkit.model.validation import sample_mass_matrix
from mbkit.simulate import simulate
from mbkit.studies import exact_motions as exact_motions
from mbkit.studies.exact_motions import cart_pole, pendulum, precession
from mbkit.studies.reference_motions import gap
from mbkit.studies.stress import cases
from mbkit.studies.stress.case import Case, problem_of, times_of
from mbkit.studies.stress.cases.rigid import box_spin, straight_inertia
from mbkit.studies.stress.cases.springs import largest_step, stable_steps
from mbkit.studies.stress.measurements import Limits, measure, prepare
from validation import closed_forms, elliptic

ALL = tuple(cases.CASES.values())
MOTIONS = tuple(c for c in ALL if c.measure == "motion")
#: What is slow to make: long chains, whose description is checked, and robots of many links.
SLOW = {"chain": 64.0, "robots_as_found": 330.0}


def ids(case: Case) -> str:
    return case.name


def test_cases_go_by_name() -> None:
    assert cases.names() == tuple(c.name for c in ALL)
    assert cases.get("joint_spring") is cases.CASES["joint_spring"]
    with pytest.raises(UnknownNameError, match="did you mean 'elastic_pendulum'"):
        cases.get("elastic_pendulm")
    families = list(dict.fromkeys(c.family for c in ALL))
    assert [c.family for c in ALL] == sorted((c.family for c in ALL), key=families.index)


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("case", ALL, ids=ids)
def test_every_value_makes_a_problem(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    # Making a problem integrates nothing.
    monkeypatch.setattr(exact_motions, "_step", None)
    problem_of(case, case.values[0])  # loads files, which may warn
    for value in (v for v in case.values if v <= SLOW.get(case.name, math.inf)):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            problem = problem_of(case, value)
        assert all(math.isfinite(x) for x in problem.facts.values())
        if case.measure == "terms":
            assert len(problem.q) == len(problem.v) == len(problem.tau)
            continue
        assert (case.measure == "motion") == (problem.exact is not None)
        if problem.exact is not None:
            assert problem.source
            assert problem.floor < 0.5 * (case.bar or 1e-6) * problem.scale
        if problem.dt is not None:
            assert times_of(problem, case.measure)[-1] == pytest.approx(problem.duration)


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("case", MOTIONS, ids=ids)
def test_the_mildest_motion_is_the_models_own(case: Case) -> None:
    problem = problem_of(case, case.values[0])
    times = problem.duration * np.array([0.0, 0.2, 0.4])
    exact = problem.exact(times)
    own = dynamics(problem.model, "lagrangian")
    run = simulate(own, problem.q, problem.v, times[-1], "rk853", rtol=1e-11, save=times)
    # The tolerance of each of some hundred steps, and what a pendulum or a chain makes of it.
    assert gap(problem.model, run.q, exact).max() < 1e-9 * problem.scale + problem.floor


#: Where a fast motion stands beside a slow one. Rates of quaternions are no velocities: those are compared with
#: runs alone; so is dry friction, which at rest is any force.
_APART = ("step", "spin", "friction")
FAST = {c.name: c.quick[1] for c in MOTIONS if c.family not in _APART and c.name != "far_base"}
FAST["gimbal_pass"] = 1e-2


@pytest.mark.thorough(every=2)
@pytest.mark.parametrize("case", [c for c in MOTIONS if c.name in FAST], ids=ids)
def test_exact_motions_satisfy_the_equation_of_motion(case: Case) -> None:
    """M(q) q̈ + nle - τ_passive of the differentiated closed form, beside the size of its parts."""
    problem = problem_of(case, FAST[case.name])
    model = problem.model
    fastest = max([1.0, *(x for n, x in problem.facts.items() if n.startswith("fastest"))])
    h = 2e-3 / fastest
    t = np.array([0.3, 0.71]) * problem.duration
    near = np.stack([problem.exact(t + k * h) for k in (-2, -1, 0, 1, 2)])
    # Differences from the middle: the coordinates themselves may be large.
    near -= (middle := near[2].copy())
    v = (8 * (near[3] - near[1]) - (near[4] - near[0])) / (12 * h)
    a = (16 * (near[3] + near[1]) - (near[4] + near[0])) / (12 * h * h)
    own = dynamics(model, "lagrangian")
    if model.constrained:
        # A drive's force is not known: accelerations of the times are compared.
        held = at_times(own, t).forward_dynamics(middle, v, np.zeros(model.nv))
        rounding = 32 * np.spacing(np.abs(middle).max()) / h**2
        assert np.abs(a - held).max() < 1e-6 * np.abs(held).max() + rounding
        return
    parts = [np.einsum("kij,kj->ki", own.mass_matrix(middle), a), own.nle(middle, v), -own.passive(middle, v)]
    size = sum(np.abs(x) for x in parts).max()
    # Some roundings of q over h², and h⁴ of a sixth derivative.
    rounding = np.abs(own.mass_matrix(middle)).max() * 32 * np.spacing(np.abs(middle).max()) / h**2
    assert np.abs(sum(parts)).max() < 1e-6 * size + rounding


@pytest.mark.thorough(every=2)
@pytest.mark.parametrize("case", MOTIONS, ids=ids)
def test_starts_are_consistent(case: Case) -> None:
    """At the most extreme value, too, where only the beginning can be looked at."""
    for value in (case.values[0], case.values[-1]):
        problem = problem_of(case, value)
        model = problem.model
        rate = max([1.0, *(x for n, x in problem.facts.items() if n.startswith("fastest"))])
        h = 1e-4 / rate
        first, second, third = problem.exact(np.array([0.0, h, 2 * h]))
        assert gap(model, np.array([first]), np.array([problem.q])).max() <= max(
            1e-9 * problem.scale, 2 * problem.floor
        )
        v = (4 * model.difference(first, second) - model.difference(first, third)) / (2 * h)
        rounding = 8 * np.spacing(np.abs(problem.q).max()) / h
        assert v == pytest.approx(problem.v, abs=1e-6 * (np.abs(problem.v).max() + rate * problem.scale) + rounding)
        M = sample_mass_matrix(model) if model.has_bodies else np.eye(1)
        scaled = M / np.sqrt(np.diag(M))[:, None] / np.sqrt(np.diag(M))
        assert np.linalg.eigvalsh(scaled)[0] > 0


@pytest.mark.thorough("neck", "bennett", "bricard_turned", "delta_robot")
@pytest.mark.parametrize("name", ["cranks", "neck", "bennett", "bricard_turned", "delta_robot"])
def test_nearly_redundant_loops_lose_digits_with_their_condition(name: str) -> None:
    case, scales = cases.get(name), []
    for value in case.quick:
        scales += [problem_of(case, value).scale]
        truth = prepare(case, value, case.bar, 1.0).truth
        for engine in ("lagrangian", "pinocchio"):
            cell = measure(case, value, engine, "forward_dynamics", Limits(1.0, 1e-3, 1e-8), truth)
            assert cell.outcome(case.bar) == "held", (value, engine, cell)
    # κ grows as the inverse of what makes the rows differ.
    assert scales[2] / scales[1] == pytest.approx(1e3, rel=0.02)


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio", "oracle"])
def test_cranks_stand_still_until_their_rows_count_as_equal(engine: str) -> None:
    case = cases.get("cranks")
    assert (case.values[0], case.values[-1]) == (1e-1, 1e-12)
    for value in case.values:
        problem = problem_of(case, value)
        a = dynamics(problem.model, engine).forward_dynamics(problem.q[0], problem.v[0], problem.tau[0])
        together = np.array([1.0, 1.0, 1.0, -1.0])
        # Three bars and a plate of 1 kg on cranks of 0.3 m at 0.4 rad, as one.
        force = (3 / 2 + 1) * 0.3 * 9.81 * math.sin(0.4) + problem.tau[0] @ together
        moved = force / (3 * (0.01 + 0.3**2 / 4) + 0.3**2)
        assert problem.facts["freedoms"] == (value == 1e-12)
        assert a == pytest.approx(problem.facts["freedoms"] * moved * together, rel=1e-10, abs=1e-9)


# Closed forms against 40 digits and published figures


@pytest.mark.parametrize("cart", [1.0, 1e-6, 1e-12])
def test_cart_poles_agree_with_40_digits(cart: float) -> None:
    t = np.array([0.0, 0.7, 3.3, 7.5, 10.0])
    told, _ = elliptic.CartPole(math.pi / 2, cart).states(t)
    assert cart_pole(math.pi / 2, cart)(t) == pytest.approx(told, abs=2e-11)


def test_the_light_cart_pole_is_the_published_one() -> None:
    published = closed_forms.published()["light_cart_pole"]["published"]
    t = np.array([float(x) for x in published])
    # The published run was made with the same tolerance as it is judged by.
    assert cart_pole(math.pi / 2, 1e-6)(t) == pytest.approx(np.array(list(published.values())), abs=1e-6)


def test_the_box_agrees_with_40_digits_after_a_thousand_flips() -> None:
    motion, period = box_spin()
    assert period == pytest.approx(float(closed_forms.published()["dzhanibekov_box"]["exact_period"]), rel=1e-14)
    t = np.array([0.0, 0.3, 2.2, 500.1]) * period
    told = elliptic.free_body(t, np.diag(catalog.free_body().bodies[0].inertia), (0.1, 5, 0.1)).q
    off = np.minimum(np.abs(motion(t) - told).max(axis=1), np.abs(motion(t) + told).max(axis=1))
    assert off.max() < 2e-11


def test_a_top_in_steady_precession_feels_its_weights_torque() -> None:
    """Euler's equation, with the rates of the closed form."""
    mass, g, across, along = 15.0, 9.81, 15.234375, 0.46875
    for spin in (1.0, 1e3, 1e6):
        motion, q, v, slow = precession(spin, 2.0, mass * g, across, along)
        top = dynamics(catalog.heavy_top(), "oracle")
        # ω in body axes turns about the body's axis, and nothing else of it changes.
        own = spin - slow * math.cos(2.0)
        a = np.cross(v, [0.0, own, 0.0])
        assert top.inverse_dynamics(q, v, a) == pytest.approx(0, abs=1e-14 * np.abs(top.nle(q, v)).max())
        assert np.linalg.norm(motion(np.array([0.7])), axis=1) == pytest.approx(1, abs=1e-15)


def test_chains_grow_ill_conditioned_with_the_fourth_power() -> None:
    assert straight_inertia(5) == pytest.approx(
        dynamics(catalog.chain(n=5), "oracle").mass_matrix(np.zeros(5)), rel=1e-14
    )
    for n, told in closed_forms.published()["chain_conditioning"]["cond"].items():
        if int(n) > 64:
            continue
        facts = cases.get("chain").make(float(n)).facts if int(n) <= 16 else {}
        assert np.linalg.cond(straight_inertia(int(n))) == pytest.approx(told["cond"], rel=1e-6)
        assert facts.get("cond(M) / N⁴", told["cond_over_N4"]) == pytest.approx(told["cond_over_N4"], rel=1e-6)


def test_robots_are_as_they_were_found() -> None:
    """Their names stand beside the ratio of the masses in their files."""
    case = cases.get("robots_as_found")
    for ratio in case.values[:3]:
        assert case.make(ratio).facts["heaviest over lightest body"] == pytest.approx(ratio, rel=0.1)


# Linear theory

LINEAR = {
    "step_oscillator": (1.0, 0.0),
    "step_critically_damped": (1.0, 1.0),
    "step_overdamped": (0.1, 5.0),
}


def characteristic(method: str, x: float, zeta: float) -> list[np.ndarray]:
    """The polynomials whose roots a step of length h multiplies by, x = ω h, from the recurrences."""
    k, c = x * x, 2 * zeta * x
    if method in ("semi_implicit_euler", "mujoco_euler"):
        return [np.array([1.0, k + c - 2, 1 - c])]
    if method in ("mujoco_implicit", "mujoco_implicitfast"):
        return [np.array([1 + c, k - c - 2, 1.0])]
    if method == "mujoco_discrete":
        return [np.array([1 + c + k, -c - 2, 1.0])]
    z = np.roots([1.0, c, k]).astype(complex)
    if method in ("rk4", "mujoco_rk4"):
        return [np.array([1.0, -(1 + y + y**2 / 2 + y**3 / 6 + y**4 / 24)]) for y in z]
    above = {"implicit_midpoint": (1, 1 / 2), "gauss4": (1, 1 / 2, 1 / 12), "gauss6": (1, 1 / 2, 1 / 10, 1 / 120)}[
        method
    ]
    pade = np.polynomial.Polynomial(above)
    return [np.array([pade(-y), -pade(y)]) for y in z]


def amplification(method: str, x: float, zeta: float) -> float:
    return float(max(np.abs(np.roots(p)).max() for p in characteristic(method, x, zeta)))


@pytest.mark.parametrize("name", LINEAR)
def test_theory_is_where_the_roots_leave_the_unit_circle(name: str) -> None:
    case, (frequency, zeta) = cases.get(name), LINEAR[name]
    for method in case.methods:
        limit = case.theory("any", method)
        assert limit == largest_step("any", method, frequency=frequency, damping=zeta)
        if math.isinf(limit):
            assert all(amplification(method, frequency * h, zeta) < 1 + 1e-12 for h in (0.1, 10, 1e3, 1e6))
            continue
        steps = limit * np.array([0.05, 0.5, 0.999])
        # Undamped and symplectic, the roots lie on the circle.
        assert all(amplification(method, frequency * h, zeta) < 1 + 1e-12 for h in steps)
        assert amplification(method, frequency * limit * 1.001, zeta) > 1 + 1e-5
        # One of the values stands closely on either side of it.
        assert max(v for v in case.values if v < limit) > 0.9 * limit
        assert min(v for v in case.values if v > limit) < 1.1 * limit
    assert case.theory("any", "dop853") is None


def test_explicit_steps_are_counted_by_the_longest_stable_one() -> None:
    """Of DOP853's stability polynomial, from the coefficients that SciPy has."""
    A, b = dop853_coefficients.A[:12, :12], dop853_coefficients.B
    powers = [np.ones(12)]
    for _ in range(11):
        powers.append(A @ powers[-1])
    R = np.polynomial.Polynomial([1.0, *(b @ x for x in powers)])
    for damped, direction in ((False, 1j), (True, -1)):
        limit = 1e6 / stable_steps(1e6, 1.0, damped=damped)
        x = np.linspace(0, limit, 500)
        assert np.abs(R(direction * x)).max() < 1 + 1e-12
        assert abs(R(direction * 1.002 * limit)) > 1


@pytest.mark.filterwarnings("ignore::mbkit.errors.MbkitWarning")  # the steps are long on purpose
@pytest.mark.parametrize("name", LINEAR)
def test_a_step_multiplies_by_what_theory_says(name: str) -> None:
    """The recurrences above are the methods': a step from each unit vector is their matrix."""
    case, value = cases.get(name), 1.4
    model = case.make(value).model
    frequency, zeta = LINEAR[name]
    engines = {engine: dynamics(model, engine) for engine in ("lagrangian", "mujoco")}
    for method in case.methods:
        dyn = engines["mujoco" if method.startswith("mujoco") else "lagrangian"]
        columns = []
        for q, v in (([1.0], [0.0]), ([0.0], [1.0])):
            run = simulate(dyn, q, v, value, method, dt=value)
            columns.append([run.q[-1, 0], run.v[-1, 0]])
        seen = np.abs(np.linalg.eigvals(np.array(columns))).max()
        assert seen == pytest.approx(amplification(method, frequency * value, zeta), rel=1e-7), method


def test_pendulums_agree_with_40_digits() -> None:
    t = np.linspace(0, 2, 4)
    for theta, speed, square in ((1.0, 0.0, 9.81), (1.0, 1.0, 1e-6), (0.5, -7.0, 9.81), (1.0, 0.0, 1e6)):
        told = elliptic.pendulum(t, theta, speed, 1, square)[0]
        assert pendulum(theta, speed, square)(t) == pytest.approx(told, abs=1e-15 * (1 + 2 * math.sqrt(square)) * 8)
    assert pendulum(1.0, 0.5, 0.0)(t)[:, 0] == pytest.approx(1 + 0.5 * t, abs=1e-15)
