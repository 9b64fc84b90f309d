"""The structure of the equations of motion, on 40 random trees of every joint kind.

Each tree is derived once and run in CasADi's own machine. Every property gives an
error and a scale: the norms of the terms that meet in it, with ‖M‖ ‖v‖², ‖M‖ ‖a‖ and
|g| √(m tr M) where those may have met inside a term (see `mbkit.studies.compare.errors`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mbkit.derivation import Equations
from mbkit.derivation.kinematics import add
from mbkit.model import Model
from mbkit.model.joint_types import cross3
from tests.random_trees import random_tree, states

EPS = np.finfo(float).eps
# Rounding grows like the root of the number of roundings, not like the number: a few
# eps in a vector, √nv more in the norm of a matrix, which here is up to some 60 by 60.
K = 20
#: Any two of mimic joints, depth and size meet in one of four chunks.
CHUNKS, PER_CHUNK, SAMPLES = 4, 10, 1
#: Joints of the ten trees of a chunk; in the second and the third, the tenth has 24.
SIZES = (2, 3, 3, 4, 5, 6, 7, 8, 10, 14)
LARGE = 24


def tree(seed: int) -> Model:
    """Return the tree of a seed: shallow or deep, with and without mimic joints."""
    mimic, deep = seed // PER_CHUNK % 2 == 1, seed // (2 * PER_CHUNK) % 2 == 1
    size = SIZES[seed % PER_CHUNK]
    if size == SIZES[-1] and mimic != deep:
        size = LARGE
    return random_tree(seed, size, mimic=mimic, nearest=2 if deep else None)


class Derived:
    """A model's expressions, evaluated at states without compiling."""

    def __init__(self, model: Model) -> None:
        self.model = model
        eq = self.eq = Equations(model)
        x = ca.SX.sym("x", model.nv)
        tangent = ca.jacobian(eq.kin.qdot, eq.v)
        named = {
            "M": eq.mass_matrix,
            "C": eq.coriolis_matrix,
            "coriolis": eq.coriolis_force,
            "gravity": eq.gravity,
            "nle": eq.nle,
            "passive": eq.passive,
            "id": eq.inverse_dynamics,
            "fd": eq.forward_dynamics,
            "kinetic": eq.kinetic_energy,
            "energy_rate": eq.energy_rate,
            "dissipated": dissipated(eq),
            # Forward along D's columns, where the forces pull back a gradient.
            "slope": ca.jtimes(eq.potential_energy, eq.q, tangent),
        }
        # Common subexpressions stay: finding them takes longer than all the rest.
        self._all = ca.Function("all", [eq.q, eq.v, eq.a, eq.tau], [ca.densify(e) for e in named.values()])
        self.id = ca.Function("id", [eq.q, eq.v, eq.a], [eq.inverse_dynamics])
        # Ṁ x: the rate of the momentum M(q) x for fixed x along q̇ = D v.
        momentum = ca.substitute(eq.momentum, eq.v, x)
        self.rate = ca.Function("rate", [eq.q, eq.v, x], [ca.jtimes(momentum, eq.q, eq.kin.qdot)])
        self._names = tuple(named)

    def at(self, q, v, a, tau) -> dict[str, np.ndarray]:
        """Return every term at one state."""
        shapes = {"M": 2, "C": 2, "kinetic": 0, "energy_rate": 0, "dissipated": 0}
        out = {}
        for name, value in zip(self._names, self._all(q, v, a, tau), strict=True):
            x = value.full()
            out[name] = x if shapes.get(name, 1) == 2 else x.ravel() if shapes.get(name, 1) else float(x[0, 0])
        return out

    def inverse_dynamics(self, q, v, a) -> np.ndarray:
        return self.id(q, v, a).full()[:, 0]

    def columns(self, function: ca.Function, q, v) -> np.ndarray:
        """Return a function at unit vectors, as columns."""
        n = self.model.nv
        return function(np.tile(q[:, None], n), np.tile(v[:, None], n), np.eye(n)).full()


def dissipated(eq: Equations) -> ca.SX:
    """Return the power of all dampers, from the description and the bodies' twists."""
    kin, total = eq.kin, ca.SX(0)
    for joint in eq.model.joints:
        total += sum(d * rate * rate for d, rate in zip(joint.damping, kin.velocities(joint), strict=True))
    for spring in eq.model.springs:
        ends, rates = [], []
        for body, point in ((spring.body_a, spring.point_a), (spring.body_b, spring.point_b)):
            linear, angular = kin.twists[body]
            ends.append(ca.vertcat(*kin.to_world(body, list(point))))
            rates.append(ca.vertcat(*kin.to_world(body, add(linear, cross3(angular, list(point))), 0.0)))
        along, apart = ends[1] - ends[0], rates[1] - rates[0]
        total += spring.damping * ca.dot(along, apart) ** 2 / ca.dot(along, along)
    return total


@dataclass
class State:
    """A state of a tree, and the terms there."""

    derived: Derived
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    tau: np.ndarray

    @cached_property
    def x(self) -> dict[str, np.ndarray]:
        return self.derived.at(self.q, self.v, self.a, self.tau)

    @cached_property
    def resting(self) -> dict[str, np.ndarray]:
        return self.derived.at(self.q, 0 * self.v, self.a, self.tau)

    @cached_property
    def size(self) -> float:
        """‖M‖."""
        return float(np.linalg.norm(self.x["M"], 2))

    @cached_property
    def forces(self) -> float:
        """A bound on the forces that may have cancelled."""
        model = self.derived.model
        weight = np.linalg.norm(model.gravity) * np.sqrt(model.mass * np.trace(self.x["M"]))
        inertial = self.size * (np.linalg.norm(self.v) ** 2 + np.linalg.norm(self.a))
        return inertial + weight + sum(norm(self.x[n]) for n in ("nle", "passive", "id"))


def norm(x) -> float:
    return float(np.linalg.norm(x))


def mass_matrix_is_symmetric(s: State) -> tuple[float, float]:
    M = s.x["M"]
    return norm(M - M.T), s.size


def mass_matrix_is_positive(s: State) -> tuple[float, float]:
    # Scaled to a unit diagonal, so that no unit can hide a negative eigenvalue.
    root = np.sqrt(np.diag(s.x["M"]))
    return max(0.0, -np.linalg.eigvalsh(s.x["M"] / np.outer(root, root)).min()), 1.0


def kinetic_energy_is_half_v_m_v(s: State) -> tuple[float, float]:
    return abs(s.x["kinetic"] - 0.5 * s.v @ s.x["M"] @ s.v), 0.5 * s.size * norm(s.v) ** 2


def mass_matrix_is_the_derivative_of_inverse_dynamics(s: State) -> tuple[float, float]:
    # Linear in a, so that unit steps are exact.
    moved = s.derived.columns(s.derived.id, s.q, s.v) - s.derived.inverse_dynamics(s.q, s.v, 0 * s.a)[:, None]
    return norm(moved - s.x["M"]), norm(s.x["M"]) + s.forces


def coriolis_matrix_makes_the_coriolis_force(s: State) -> tuple[float, float]:
    return norm(s.x["C"] @ s.v - s.x["coriolis"]), s.size * norm(s.v) ** 2


def coriolis_force_vanishes_at_rest(s: State) -> tuple[float, float]:
    return norm(s.resting["coriolis"]), 0.0


def coriolis_and_gravity_make_nle(s: State) -> tuple[float, float]:
    return norm(s.x["C"] @ s.v + s.x["gravity"] - s.x["nle"]), s.forces


def terms_make_inverse_dynamics(s: State) -> tuple[float, float]:
    return norm(s.x["M"] @ s.a + s.x["nle"] - s.x["passive"] - s.x["id"]), s.forces


def mass_matrix_rate_less_twice_coriolis_is_skew(s: State) -> tuple[float, float]:
    S = s.derived.columns(s.derived.rate, s.q, s.v) - 2 * s.x["C"]
    return norm(S + S.T), s.size * norm(s.v)


def forces_are_the_slope_of_the_potential(s: State) -> tuple[float, float]:
    return norm(s.x["slope"] - (s.x["gravity"] - s.resting["passive"])), s.forces


def power_balances(s: State) -> tuple[float, float]:
    damping = s.x["passive"] - s.resting["passive"]
    return abs(s.x["energy_rate"] - (s.x["id"] + damping) @ s.v), s.forces * norm(s.v)


def dampers_take_their_power(s: State) -> tuple[float, float]:
    damping = s.x["passive"] - s.resting["passive"]
    return abs(damping @ s.v + s.x["dissipated"]), (norm(s.x["passive"]) + norm(s.resting["passive"])) * norm(s.v)


def forward_dynamics_inverts_inverse_dynamics(s: State) -> tuple[float, float]:
    # As a force: a itself may lose cond(M). Where M is singular to rounding a pivot
    # may be 0, and not a number is the right answer.
    back = s.derived.at(s.q, s.v, s.a, s.x["id"])["fd"]
    if not np.all(np.isfinite(back)) and np.linalg.cond(s.x["M"]) > 1 / EPS:
        return 0.0, 1.0
    return norm(s.x["M"] @ (back - s.a)), s.forces + s.size * norm(back)


PROPERTIES = (
    mass_matrix_is_symmetric,
    mass_matrix_is_positive,
    kinetic_energy_is_half_v_m_v,
    mass_matrix_is_the_derivative_of_inverse_dynamics,
    coriolis_matrix_makes_the_coriolis_force,
    coriolis_force_vanishes_at_rest,
    coriolis_and_gravity_make_nle,
    terms_make_inverse_dynamics,
    mass_matrix_rate_less_twice_coriolis_is_skew,
    forces_are_the_slope_of_the_potential,
    power_balances,
    dampers_take_their_power,
    forward_dynamics_inverts_inverse_dynamics,
)


def violations(state: State) -> list[tuple[str, str]]:
    """Return what does not hold, with the error in eps."""
    out = []
    for law in PROPERTIES:
        error, scale = law(state)
        # Not written as >, so that what is not a number is found.
        if not error <= K * EPS * scale:
            out.append((law.__name__, f"{error / scale / EPS:.3g} eps" if scale else f"{error}"))
    return out


@pytest.mark.thorough("1", "2", "3")
@pytest.mark.parametrize("chunk", range(CHUNKS))
def test_the_equations_have_their_structure(chunk):
    found = {}
    for seed in range(chunk * PER_CHUNK, (chunk + 1) * PER_CHUNK):
        model = tree(seed)
        derived = Derived(model)
        for k, row in enumerate(zip(*states(model, SAMPLES, seed), strict=True)):
            if wrong := violations(State(derived, *row)):
                found[seed, k] = wrong
    assert not found


@cache
def every_kind() -> Derived:
    return Derived(random_tree(0, 10, nearest=2))


@given(
    speed=st.sampled_from((0.0, 1e-60, 1e-8, 1.0, 1e8, 1e60)),
    corner=st.sampled_from((0.0, np.pi / 2, -np.pi / 2, np.pi)),
    near=st.sampled_from((0.0, 1e-16, 1e-12, 1e-8, 1e-4, 1.0)),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=60)
def test_the_structure_holds_at_extremes(speed, corner, near, seed):
    """At rest, at any speed, and near the poses where Euler angles and hinges line up."""
    derived = every_kind()
    model = derived.model
    q, v, a, tau = (x[0] for x in states(model, 1, seed))
    for joint in model.independent_joints:
        part = model.layout.q[joint.name]
        for i in joint.type.angular:
            q[part.start + i] = corner + near * q[part.start + i]
    assert not violations(State(derived, q, speed * v, a, tau))


@given(power=st.integers(-100, 100), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_coriolis_forces_are_quadratic_to_the_last_bit(power, seed):
    """Scaling by powers of two rounds nothing, so that a stray term cannot hide."""
    derived = every_kind()
    q, v, a, tau = (x[0] for x in states(derived.model, 1, seed))
    once, scaled = derived.at(q, v, a, tau), derived.at(q, 2.0**power * v, a, tau)
    assert np.array_equal(scaled["coriolis"], 4.0**power * once["coriolis"])
    assert np.array_equal(scaled["C"], 2.0**power * once["C"])
