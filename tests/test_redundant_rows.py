"""Loops that are redundant, or nearly so: accelerations against 40 digits, within the bound of their condition.

Between two bodies stand several point loops, whose points lie near each other, on a line, or on top of each other. How
near decides the condition of the rows; what 40 digits give knows nothing of mbkit.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mpmath as mp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import mbkit as mb
from mbkit.derivation.constraints import choose_rows
from mbkit.errors import InputError, NumericalError
from mbkit.methods import METHODS
from mbkit.model.parts import Prescribed

EPS = float(np.finfo(float).eps)
#: As `mbkit.derivation.constraints.DEPENDENT`: a row with less of it left follows from the others.
DEPENDENT = 1e-12
#: Kinds of a mechanism's joints that move a body in a plane, and in space.
PLANE = ("revolute", "revolute", "prismatic", "revolute", "prismatic")
SPACE = ("revolute", "prismatic", "revolute", "revolute", "prismatic", "revolute", "revolute")


class Mechanism:
    """A chain from the ground, and point loops from its last body to the ground, in numbers alone."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        rng = np.random.default_rng([seed, 52])
        self.planar = bool(rng.random() < 0.4)
        self.kinds = PLANE if self.planar else SPACE
        n = len(self.kinds)
        axes = rng.standard_normal((n, 3))
        axes = axes * [1, 0, 1] if self.planar else axes
        turns = [k == "revolute" for k in self.kinds]
        if self.planar:
            axes[turns] = [0, 1, 0]
        self.axes = [mp.matrix(x / np.linalg.norm(x)) for x in axes]
        self.places = rng.uniform(-0.5, 0.5, (n, 3)) * ([1, 0, 1] if self.planar else 1)
        self.masses, self.coms = rng.uniform(0.5, 2, n), rng.uniform(-0.3, 0.3, (n, 3)) * [1, not self.planar, 1]
        self.moments = [np.array([b + c, c + a, a + b]) for a, b, c in rng.uniform(0.05, 0.3, (n, 3))]
        self.q, self.tau = rng.uniform(-1, 1, n), rng.standard_normal(n)
        # One to four loops more than the first; a distance of 0 is a loop twice.
        extra = int(rng.integers(1, 5)) if not self.planar else int(rng.integers(1, 3))
        distances = 10.0 ** rng.uniform(-9, 0, extra) * (rng.random(extra) < 0.75)
        line, first = rng.standard_normal(3) * ([1, 0, 1] if self.planar else 1), rng.uniform(-0.3, 0.3, 3)
        first = first * ([1, 0, 1] if self.planar else 1)
        points = [first, *(first + x * line for x in distances)]
        pose = self.poses()[-1]
        self.points = [(np.array(pose[1] + pose[0] * mp.matrix(x), dtype=float).ravel(), x) for x in points]

    def model(self) -> mb.Model:
        b = mb.ModelBuilder("mechanism")
        for k, kind in enumerate(self.kinds):
            b.add_body(f"b{k}", mass=self.masses[k], com=self.coms[k], inertia=self.moments[k])
            axis = [float(x) for x in self.axes[k]]
            place = {"parent": f"b{k - 1}" if k else "world", "translation": self.places[k], "axis": axis}
            b.add_joint(f"j{k}", kind, child=f"b{k}", **place)
        for i, (a, p) in enumerate(self.points):
            ends = {"body_a": "world", "translation_a": a, "translation_b": p}
            b.add_loop(f"l{i}", "point", body_b=f"b{len(self.kinds) - 1}", **ends)
        return b.build()

    def poses(self) -> list[tuple[mp.matrix, mp.matrix]]:
        R, p, out = mp.eye(3), mp.zeros(3, 1), []
        for kind, axis, place, q in zip(self.kinds, self.axes, self.places, self.q, strict=True):
            p = p + R * mp.matrix(place)
            if kind == "prismatic":
                p = p + R * axis * mp.mpf(q)
            else:
                x, y, z = axis
                K = mp.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])
                R = R * (mp.eye(3) + mp.sin(q) * K + (1 - mp.cos(q)) * K * K)
            out.append((R, p))
        return out

    def slopes(self, k: int, point: np.ndarray) -> tuple[mp.matrix, mp.matrix]:
        """Return both Jacobians of a point of body k."""
        poses, n = self.poses(), len(self.kinds)
        J, W = mp.zeros(3, n), mp.zeros(3, n)
        at = poses[k][1] + poses[k][0] * mp.matrix(point)
        for i in range(k + 1):
            a = poses[i][0] * self.axes[i]
            if self.kinds[i] == "prismatic":
                J[:, i] = a
                continue
            d = at - poses[i][1]
            W[:, i] = a
            J[:, i] = mp.matrix([a[1] * d[2] - a[2] * d[1], a[2] * d[0] - a[0] * d[2], a[0] * d[1] - a[1] * d[0]])
        return J, W

    def bias(self, v: np.ndarray) -> list[tuple[mp.matrix, mp.matrix, mp.matrix]]:
        """Return ω of each body, and at v̇ = 0 its ω̇ and the acceleration of its origin."""
        turn, rate, at, place, R = *(mp.zeros(3, 1) for _ in range(4)), mp.eye(3)
        out = []
        for kind, axis, speed, (R_next, p) in zip(self.kinds, self.axes, v, self.poses(), strict=True):
            own = R * axis * mp.mpf(speed)
            at = at + drift(turn, rate, p - place)
            if kind == "prismatic":
                at = at + 2 * cross(turn, own)
            else:
                rate, turn = rate + cross(turn, own), turn + own
            place, R = p, R_next
            out.append((turn, rate, at))
        return out

    def exact(self, moving: bool) -> tuple[np.ndarray, np.ndarray, float, float]:
        """Return v that the rows allow, v̇, κ of L⁻¹ Jᵀ on independent rows, and the size of the free acceleration."""
        n, g, poses = len(self.kinds), mp.matrix([0, 0, mp.mpf("-9.81")]), self.poses()
        M, bodies = mp.zeros(n, n), []
        for k, (R, _) in enumerate(poses):
            (J, W), m = self.slopes(k, self.coms[k]), mp.mpf(self.masses[k])
            inertia = R * mp.diag([mp.mpf(x) for x in self.moments[k]]) * R.T
            M = M + m * J.T * J + W.T * inertia * W
            bodies.append((J, W, m, inertia, R * mp.matrix(self.coms[k])))
        L = mp.cholesky(M)
        # Of the rows, those that are left, one after the other, the largest first.
        rows = [mp.lu_solve(L, self.slopes(n - 1, p)[0][i, :].T) for _, p in self.points for i in range(3)]
        left, basis, kept = [x.copy() for x in rows], [], []
        sizes = [mp.norm(x) for x in rows]
        biggest = max(sizes)
        while True:
            parts = [mp.norm(x) / s if s > DEPENDENT * biggest else mp.mpf(0) for x, s in zip(left, sizes, strict=True)]
            k = max(range(len(left)), key=parts.__getitem__)
            if parts[k] <= DEPENDENT:
                break
            q = left[k] / mp.norm(left[k])
            basis.append((k, q))
            kept.append(np.array([float(x) for x in rows[k] / sizes[k]]))
            left = [x - q * (q.T * x)[0] for x in left]
        z = mp.matrix(np.random.default_rng([self.seed, 1]).standard_normal(n) * moving)
        y = without(basis, L.T * z)
        v = np.array([float(x) for x in mp.lu_solve(L.T, y)])
        # What the digits of v leave of J v belongs to the state: v̇ is exact for v as it is.
        bias, f = self.bias(v), mp.matrix(self.tau)
        for (J, W, m, inertia, com), (turn, rate, at) in zip(bodies, bias, strict=True):
            torque = inertia * rate + cross(turn, inertia * turn)
            f = f + m * J.T * (g - at - drift(turn, rate, com)) - W.T * torque
        turn, rate, at = bias[-1]
        gamma = [x for _, p in self.points for x in at + drift(turn, rate, poses[-1][0] * mp.matrix(p))]
        free = mp.lu_solve(L, f)
        # rowᵀ y = -γ, one after the other.
        y, held = without(basis, free), mp.zeros(n, 1)
        for k, q in basis:
            held = held - q * (gamma[k] + (rows[k].T * held)[0]) / (rows[k].T * q)[0]
        a, first = mp.lu_solve(L.T, y + held), mp.lu_solve(L.T, free)
        condition = np.linalg.cond(np.array(kept).T) if kept else 1.0
        return v, np.array([float(x) for x in a]), float(condition), float(mp.norm(first))


def cross(a: mp.matrix, b: mp.matrix) -> mp.matrix:
    return mp.matrix([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def drift(turn: mp.matrix, rate: mp.matrix, arm: mp.matrix) -> mp.matrix:
    """Return the acceleration of a point against a body's origin: ω̇ × r + ω × (ω × r)."""
    return cross(rate, arm) + cross(turn, cross(turn, arm))


def without(basis: list[tuple[int, mp.matrix]], y: mp.matrix) -> mp.matrix:
    for _, q in basis:
        y = y - q * (q.T * y)[0]
    return y


@pytest.mark.thorough(every=501)
@pytest.mark.parametrize("seed", range(1000))
def test_accelerations_keep_what_the_condition_of_the_rows_leaves(seed: int) -> None:
    mechanism = Mechanism(seed)
    model = mechanism.model()
    engines = {name: mb.dynamics(model, name) for name in ("lagrangian", "pinocchio")}
    for moving in (False, True):
        with mp.workdps(40):
            v, exact, condition, free = mechanism.exact(moving)
        assert v.any() == moving
        for engine, dyn in engines.items():
            a = dyn.forward_dynamics(mechanism.q, v, mechanism.tau)
            # The points are rounded, by eps of their size over their distance: the condition too.
            assert np.abs(a - exact).max() <= 1e3 * EPS * condition * free, (engine, moving, condition, a, exact)


# Three cranks that carry a plate: one freedom where they are equal, none where they differ however little

LENGTH, CRANK, PLATE, ABOUT_Y, G, THETA = 0.3, 1.0, 2.0, 0.01, 9.81, 0.4
ENGINES = ("lagrangian", "oracle", "pinocchio")
#: Closed mechanisms of the catalog.
LOOPS = (
    *("slider_crank", "four_bar", "four_bars", "five_bar"),
    *("scissor", "parallel_gripper", "planar_3rrr", "andrews_squeezer", "bricard"),
    *("flyball_governor", "double_cardan_shaft", "stewart_platform", "delta_robot"),
)


def cranks(apart: float, count: int = 3, friction: float = 0.0) -> mb.Model:
    """Return cranks under a plate; a third stands at THETA + apart where the others stand at THETA."""
    b = mb.ModelBuilder("cranks")
    for k in range(count):
        b.add_body(f"crank{k}", mass=CRANK, com=(0, 0, LENGTH / 2), inertia=(ABOUT_Y, ABOUT_Y, 0.001))
        place = {"parent": "world", "axis": (0, 1, 0), "translation": (0.5 * k, 0, 0)}
        b.add_joint(f"hinge{k}", "revolute", child=f"crank{k}", friction=0.0 if k else friction, **place)
    b.add_body("plate", mass=PLATE, com=(0.5, 0, 0), inertia=(0.02, 0.1, 0.1))
    b.add_joint("pin", "revolute", parent="crank0", child="plate", axis=(0, 1, 0), translation=(0, 0, LENGTH))
    x = 1.0 + LENGTH * (np.sin(THETA + apart) - np.sin(THETA))
    z = LENGTH * (np.cos(THETA + apart) - np.cos(THETA))
    for k, at in ((1, (0.5, 0, 0)), (2, (x, 0, z)))[: count - 1]:
        end = {"body_a": f"crank{k}", "translation_a": (0, 0, LENGTH)}
        b.add_loop(f"loop{k}", "point", **end, body_b="plate", translation_b=at)
    return b.build()


def swing(theta: float, tau: float = 0.0) -> float:
    """Return θ̈ of equal cranks: (3 (I + m L²/4) + M L²) θ̈ = (3 m L/2 + M L) g sin θ + τ."""
    inertia = 3 * (ABOUT_Y + CRANK * LENGTH**2 / 4) + PLATE * LENGTH**2
    return float(((3 * CRANK * LENGTH / 2 + PLATE * LENGTH) * G * np.sin(theta) + tau) / inertia)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("apart", [1e-1, 1e-8, 1e-11])
def test_cranks_that_differ_by_little_do_not_move(engine: str, apart: float) -> None:
    dyn = mb.dynamics(cranks(apart), engine)
    q = np.array([THETA, THETA, THETA + apart, -THETA])
    # A formed J M⁻¹ Jᵀ gives 4e-2 at 1e-6 and 20 at 1e-8.
    assert np.abs(dyn.forward_dynamics(q, np.zeros(4), [1.0, 0, 0, 0])).max() < 1e-9
    assert dyn.mobility(q).degrees_of_freedom == dyn.mobility().degrees_of_freedom == 0


@pytest.mark.parametrize("apart", [1e-1, 1e-2])
def test_an_iteration_whose_ends_do_not_agree_is_solved_otherwise(apart: float) -> None:
    """Pivots of constraintDynamics are good here, and its answer lost as much as the square of the condition, 2e-11."""
    dyn, q = mb.dynamics(cranks(apart), "pinocchio"), np.array([THETA, THETA, THETA + apart, -THETA])
    assert dyn.constraint_solver == "constraintDynamics"
    assert np.abs(dyn.forward_dynamics(q, np.zeros(4), [1.0, 0, 0, 0])).max() < 1e-14


@pytest.mark.parametrize("apart", [1e-3, 1e-6, 1e-8])
def test_forces_of_cranks_that_differ_by_little_lose_digits_with_the_condition(apart: float) -> None:
    model, q, still = cranks(apart), np.array([THETA, THETA, THETA + apart, -THETA]), np.zeros(4)
    oracle = mb.dynamics(model, "oracle")
    forces, loads = oracle.actuator_forces(q, still, still), oracle.loop_wrenches(q, still, [1.0, 0, 0, 0])
    for engine in ("lagrangian", "pinocchio"):
        dyn = mb.dynamics(model, engine)
        tau, multipliers = dyn.actuator_forces(q, still, still)
        # No force at all is the least, for the loops hold everything; with factors of J Jᵀ it was 1 N m at 1e-8.
        assert tau == pytest.approx(forces.tau, abs=1e-13)
        close = 1e2 * EPS / apart
        size = np.abs(forces.constraint_forces).max()
        assert multipliers == pytest.approx(forces.constraint_forces, abs=close * size)
        assert dyn.loop_wrenches(q, still, [1.0, 0, 0, 0]) == pytest.approx(loads, abs=close * np.abs(loads).max())


@pytest.mark.parametrize("size", [1e-4, 1.0, 1e5])
def test_rows_are_told_apart_whatever_the_size_of_a_mechanism(size: float) -> None:
    """Three equal cranks, in metres or not, have one freedom."""
    b = mb.ModelBuilder("scaled")
    for k in range(3):
        b.add_body(f"crank{k}", mass=1.0, inertia=(0.1 * size**2,) * 3)
        place = {"axis": (0, 1, 0), "translation": (0.5 * size * k, 0, 0)}
        b.add_joint(f"hinge{k}", "revolute", parent="world", child=f"crank{k}", **place)
    b.add_body("plate", mass=1.0, inertia=(size**2,) * 3)
    end = (0.1 * size, 0, 0.3 * size)
    b.add_joint("pin", "revolute", parent="crank0", child="plate", axis=(0, 1, 0), translation=end)
    for k in (1, 2):
        place = {"body_b": "plate", "translation_b": (0.5 * size * k, 0, 0)}
        b.add_loop(f"loop{k}", "point", body_a=f"crank{k}", translation_a=end, **place)
    dyn = mb.dynamics(b.build(), "lagrangian", compile=False)
    # Of the row that follows from the others, rounding leaves up to some 1e-13 at a pose.
    for q in (None, *np.outer(np.linspace(0.3, 2.5, 8), [1.0, 1, 1, -1])):
        mobility = dyn.mobility(q)
        assert (mobility.degrees_of_freedom, len(mobility.redundant)) == (1, 1)


@pytest.mark.parametrize("engine", ENGINES)
def test_equal_cranks_move_as_one(engine: str) -> None:
    model = cranks(0.0)
    dyn, q, still = mb.dynamics(model, engine), np.array([THETA, THETA, THETA, -THETA]), np.zeros(4)
    one = np.array([1.0, 1.0, 1.0, -1.0])
    a = dyn.forward_dynamics(q, still, [1.0, 0, 0, 0])
    assert a == pytest.approx(swing(THETA, 1.0) * one, rel=1e-13)
    assert swing(THETA, 1.0) == pytest.approx(18.058391477, abs=1e-9)
    for mobility in (dyn.mobility(), dyn.mobility(q), dyn.mobility(q + 1e-9 * np.arange(4))):
        assert (mobility.degrees_of_freedom, len(mobility.redundant)) == (1, 1)
        assert mobility.gap[0] > 0.1
        assert mobility.gap[1] < 1e-15
    inertia = 3 * (ABOUT_Y + CRANK * LENGTH**2 / 4) + PLATE * LENGTH**2
    assert dyn.reduced_inertia(q, "hinge0").inertia == pytest.approx(inertia, rel=1e-14)
    # Three motors share what one freedom asks for.
    held = dyn.actuator_forces(q, still, 0 * one)
    assert held.tau @ one == pytest.approx(-swing(THETA) * inertia, rel=1e-13)
    closed = dyn.project(q + 0.01, still)[0]
    assert closed == pytest.approx(closed[0] * one, rel=1e-13)


@pytest.mark.thorough("rodas5", "gauss4", "implicit_midpoint", "dop853", "taylor")
@pytest.mark.parametrize(
    "method", ["rk853", "auto", "rk4", "gauss6", "taylor", "dop853", "rodas5", "gauss4", "implicit_midpoint"]
)
def test_runs_of_equal_cranks_are_those_of_one_freedom(method: str) -> None:
    dyn = mb.dynamics(cranks(0.0), "lagrangian")
    fixed = METHODS[method].kind == "fixed"
    setting = {"dt": 2e-3} if fixed else {"rtol": 1e-12 if method != "rodas5" else 1e-8}
    duration, grid = (4.0, np.linspace(0, 4, 9)) if method in ("rk853", "taylor") else (1.0, np.linspace(0, 1, 11))
    run = mb.simulate(dyn, [THETA, THETA, THETA, -THETA], np.zeros(4), duration, method, save=grid, **setting)
    exact = solve_ivp(
        lambda _, y: [y[1], swing(y[0])], (0, duration), [THETA, 0], "DOP853", grid, rtol=1e-13, atol=1e-14
    )
    exact_q, close = np.outer(exact.y[0], [1, 1, 1, -1]), 1e-9 if method in ("rk853", "taylor") else 1e-5
    if method == "implicit_midpoint":
        # Order 2 is off by 3.3e-5 at this step, and no bar of 1e-5 can hold. As the rule is symmetric, its error is a
        # series in dt²: half the step has a quarter of it, up to dt⁴.
        half = mb.simulate(dyn, run.q[0], run.v[0], duration, method, save=grid, dt=1e-3)
        assert half.q - exact_q == pytest.approx((run.q - exact_q) / 4, abs=1e-9)
        close = 4e-5
    assert np.abs(run.q - exact_q).max() < close
    energy = run.energy()
    assert np.abs(energy - energy[0]).max() < (1e-10 if method in ("rk853", "taylor") else 1e-3)


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio", "oracle"])
def test_dry_friction_at_rest_knows_the_branch_of_redundant_rows(engine: str) -> None:
    """Where the mechanism moves, friction holds or slides; where it cannot, the rows say so, and not an inertia."""
    dyn, still = mb.dynamics(cranks(0.0, friction=0.2), engine), np.zeros(4)
    moving = np.array([THETA, THETA, THETA, -THETA])
    other = np.array([4.7123890, -1.5707963, -1.5707963, 1.5707963])
    held = -swing(THETA) / (swing(THETA, 1.0) - swing(THETA))
    slides = dyn.forward_dynamics(moving, still, still)
    assert slides == pytest.approx(swing(THETA, -0.2) * np.array([1, 1, 1, -1]), rel=1e-9)
    assert not dyn.forward_dynamics(moving, still, [held + 0.1, 0, 0, 0])[0]
    for states in (other, np.array([moving, other])):
        with pytest.raises(NumericalError, match=r"loop 'loop2' z.*contradicts"):
            dyn.forward_dynamics(states, np.zeros(states.shape), np.zeros(states.shape))
    if dyn._significand_bits == 53:
        with pytest.raises(
            NumericalError, match=r"singular pose, where .*loop 'loop2' x depend on each other, and at rest"
        ):
            mb.simulate(dyn, other, still, 0.1, "rk853")


@pytest.mark.parametrize("engine", ENGINES)
def test_forces_and_inertias_on_another_branch_are_refused_as_accelerations_are(engine: str) -> None:
    dyn, still = mb.dynamics(cranks(0.0), engine), np.zeros(4)
    moving = np.array([THETA, THETA, THETA, -THETA])
    # The third crank crosses the others: four rows of rank four, and nothing moves.
    other = np.array([4.7123890, -1.5707963, -1.5707963, 1.5707963])
    assert len(choose_rows(dyn.model).independent) == 3
    asked = {
        "forward_dynamics": (still, [1.0, 0, 0, 0]),
        "constraint_forces": (still, [1.0, 0, 0, 0]),
        "generalized_constraint_force": (still, [1.0, 0, 0, 0]),
        "forward_dynamics_derivatives": (still, [1.0, 0, 0, 0]),
        "actuator_forces": (still, still),
        "loop_wrenches": (still, still),
        "project_acceleration": (still, still),
        "reduced_inertia": ("hinge0",),
    }
    for name, given in asked.items():
        if name in dyn.supports or name == "project_acceleration":
            getattr(dyn, name)(moving, *given)
            with pytest.raises(NumericalError, match=r"loop 'loop2' z.*contradicts"):
                getattr(dyn, name)(other, *given)


@pytest.mark.parametrize("options", [{"compile": True}, {"engine": "oracle"}, {"engine": "pinocchio"}])
def test_a_singular_pose_is_told_by_its_rows(options: dict[str, Any]) -> None:
    """Bars in line: the row along them has the slope that rounding of π leaves; no link without mass is to blame."""
    b = mb.ModelBuilder("in_line")
    for k, parent in enumerate(("world", "bar0", "bar1")):
        b.add_body(f"bar{k}", mass=1.0, com=(0.5, 0, 0), inertia=(0.01, 0.1, 0.1))
        place = {"axis": (0, 1, 0), "translation": (float(k > 0), 0, 0)}
        b.add_joint(f"hinge{k}", "revolute", parent=parent, child=f"bar{k}", **place)
    b.add_loop("pin", "point", body_a="bar2", body_b="world", translation_a=(1, 0, 0), translation_b=(1, 0, 0))
    dyn, still = mb.dynamics(b.build(), **{"engine": "lagrangian", **options}), np.zeros((2, 3))
    rhombus = np.array([0.4, np.pi - 0.8, -np.pi + 0.8])
    q, _ = dyn.project(rhombus, still[0])
    poses = np.array([q, [0.0, np.pi, -np.pi]])
    for name in ("forward_dynamics", "constraint_forces", "actuator_forces"):
        if name != "actuator_forces":
            getattr(dyn, name)(q, still[0], still[0])
        with pytest.raises(NumericalError, match=r"singular pose, where rows depend on each other \(loop 'pin' x;"):
            getattr(dyn, name)(poses, still, still)


# A neck of two parallel rods, each welded to a pin: singular values of J from 2.45 down to 4.6e-9

NECK = """
<mujoco model="two_rods"><compiler angle="radian"/><worldbody><body name="base" pos="0.016 0 0.122487">
<inertial pos="0.01 0 -0.002" mass="0.00673" diaginertia="6e-7 5e-7 3e-7"/>
<body name="plate" pos="0 0.004 0.0194" quat="-0.499092 -0.499092 -0.500906 0.500906">
 <inertial pos="0.01 0 -0.002" mass="0.137" diaginertia="1e-4 1e-4 9e-5"/><joint name="plate" axis="0 0 1"/>
 <body name="crank" pos="-0.0326157 -0.027 0.0025" quat="0 0 1 0">
  <inertial pos="0.01 0 -0.002" mass="0.0017" diaginertia="6e-7 5e-7 3e-7"/>
  <joint name="crank" armature="0.0035" axis="0 0 1"/>
  <body name="pin_a" pos="-0.00194114 -0.00724444 -0.0055" quat="0.904588 0 0 0.426286">
   <inertial pos="0.01 0 -0.002" mass="0.000487" diaginertia="6e-7 5e-7 3e-7"/><joint name="pin_a" axis="0 0 1"/></body>
  <body name="pin_b" pos="0.00194114 0.00724444 -0.0055" quat="0.905205 0 0 0.424976">
   <inertial pos="0.01 0 -0.002" mass="0.000487" diaginertia="6e-7 5e-7 3e-7"/><joint name="pin_b" axis="0 0 1"/></body>
 </body></body>
<body name="rod_a" pos="-0.00724444 -0.004 0.0174589" quat="0.302589 -0.302589 -0.639093 -0.639093">
 <inertial pos="0.01 0 -0.002" mass="0.00316" diaginertia="6e-7 5e-7 3e-7"/><joint name="rod_a" axis="0 0 1"/></body>
<body name="rod_b" pos="0.00724444 -0.004 0.0213411" quat="-0.301664 0.301664 0.63953 0.63953">
 <inertial pos="0.01 0 -0.002" mass="0.00316" diaginertia="6e-7 5e-7 3e-7"/><joint name="rod_b" axis="0 0 1"/></body>
</body></worldbody><equality><weld body1="rod_a" body2="pin_a"/><weld body1="rod_b" body2="pin_b"/></equality></mujoco>
"""


@pytest.mark.parametrize("engine", ENGINES)
def test_a_neck_of_two_rods_stands_still(engine: str, tmp_path: Path) -> None:
    (tmp_path / "neck.xml").write_text(NECK)
    model = mb.load(tmp_path / "neck.xml")
    dyn, tau = mb.dynamics(model, engine), np.zeros(6)
    tau[model.joint_names.index("crank")] = 0.05
    sizes = np.linalg.svd(dyn.constraint_jacobian(model.neutral()), compute_uv=False)
    assert sizes[0] == pytest.approx(2.45, rel=1e-2)
    assert sizes[-1] < 1e-8
    assert np.abs(dyn.forward_dynamics(model.neutral(), np.zeros(6), tau)).max() < 1e-9


# Loops that cannot be, poses off their branch, and rows that contradict each other

QUICK = [("lagrangian", {"compile": False}), ("pinocchio", {}), ("oracle", {})]
#: Each way to ask for a motion, of dynamics at (q, v).
ASKED = {
    "forward_dynamics": lambda dyn, q, v: dyn.forward_dynamics(q, v, 0 * v),
    "constraint_forces": lambda dyn, q, v: dyn.constraint_forces(q, v, 0 * v),
    "actuator_forces": lambda dyn, q, v: dyn.actuator_forces(q, v, 0 * v),
    "step": lambda dyn, q, v: dyn.step(q, v, 0 * v, 1e-3, "rk4", t=0.0),
    "simulate": lambda dyn, q, v: mb.simulate(dyn, q, v, 2e-3, "rk4", dt=1e-3),
    "project": lambda dyn, q, v: dyn.project(q, v),
    "random_state": lambda dyn, *_: dyn.model.random_state(0),
    "mobility": lambda dyn, *_: dyn.mobility(),
    "mobility of q": lambda dyn, q, _: dyn.mobility(q),
}


def rod_between_cranks(length: float) -> mb.Model:
    b = mb.ModelBuilder("rod")
    for k in range(2):
        b.add_body(f"crank{k}", mass=1.0, com=(0, 0, 0.15), inertia=(0.01, 0.01, 0.001))
        place = {"axis": (0, 1, 0), "translation": (0.5 * k, 0, 0)}
        b.add_joint(f"hinge{k}", "revolute", parent="world", child=f"crank{k}", **place)
    ends = {"translation_a": (0, 0, LENGTH), "translation_b": (0, 0, LENGTH)}
    b.add_loop("rod", "distance", body_a="crank0", body_b="crank1", length=length, **ends)
    return b.build()


@pytest.mark.thorough("oracle-options2")
@pytest.mark.parametrize(("engine", "options"), QUICK)
def test_a_rod_that_is_too_long_for_its_cranks_is_refused_with_what_is_left(engine: str, options: dict) -> None:
    q, v = np.array([0.3, 0.6]), np.zeros(2)
    # The cranks' ends are 0.3 + 0.5 + 0.3 m apart at most: (1.1² - 5²)/(2 5) is left of the row.
    more = ("project", "random_state", "mobility") if engine == "lagrangian" else ()
    for ask in ("forward_dynamics", "step", *more):
        # Each time anew: what was looked at once would be let through.
        dyn = mb.dynamics(rod_between_cranks(5.0), engine, **options)
        with pytest.raises(InputError, match=r"no configuration.*loop 'rod' length cannot hold.* is \[-2.38\]"):
            ASKED[ask](dyn, q, v)
        with pytest.raises(InputError, match="no configuration"):
            ASKED[ask](dyn, q, v)


@pytest.mark.parametrize(("engine", "options"), QUICK)
def test_a_pose_off_the_branch_is_refused_with_its_residual_and_a_closed_pose(engine: str, options: dict) -> None:
    dyn, v = mb.dynamics(cranks(0.0), engine, **options), np.zeros(4)
    q = np.array([THETA, THETA, THETA + 0.01, -THETA])
    # The end of the third crank beside the plate's point.
    left = LENGTH * (np.sin(THETA + 0.01) - np.sin(THETA))
    for ask in ("step", "simulate", "mobility of q"):
        with pytest.raises(InputError, match=rf"{left:.3g}.*closed is q = \[") as told:
            ASKED[ask](dyn, q, v)
        closed = np.array([float(x) for x in str(told.value).split("q = [")[1].split("]")[0].split(",")])
        assert closed == pytest.approx(closed[0] * np.array([1, 1, 1, -1]), abs=1e-7)
        assert closed == pytest.approx(q, abs=0.02)
    with pytest.warns(mb.errors.MbkitWarning, match=rf"loop 'loop2' x is open by {left:.2g}"):
        dyn.constraint_forces(q, v, v)


def driven(first: float, second: float, amplitudes: tuple[float, float] | None = None) -> mb.Model:
    """Return two equal cranks that are both driven, at a rate or by a sine of this frequency."""
    model = cranks(0.0, 2)
    laws = [{"rate": first}, {"rate": second}]
    if amplitudes is not None:
        laws = [{"amplitude": a, "frequency": f} for a, f in zip(amplitudes, (first, second), strict=True)]
    return replace(model, prescribed=tuple(Prescribed(f"hinge{k}", **law) for k, law in enumerate(laws)))


@pytest.mark.parametrize(("engine", "options"), QUICK)
def test_drives_that_contradict_each_other_are_named(engine: str, options: dict) -> None:
    q, v = np.zeros(3), np.array([1.0, 1.0, -1.0])
    same = mb.dynamics(driven(1.0, 1.0), engine, **options)
    assert same.step(q, v, 0 * v, 1e-3, "rk4", t=0.0)[0] == pytest.approx(1e-3 * v, rel=1e-12)
    # One crank turns at 1 rad/s, the other is to turn at 2.
    dyn = mb.dynamics(driven(1.0, 2.0), engine, **options)
    for ask in ("step", "simulate", "project", "random_state"):
        with pytest.raises(InputError, match=r"motion of 'hinge1' by -[\d.]+.* against .*motion of 'hinge0'") as told:
            ASKED[ask](dyn, q, v)
        assert ask == "random_state" or "by -1 per second" in str(told.value)


@pytest.mark.parametrize(("engine", "options"), QUICK)
@pytest.mark.parametrize("ask", ["forward_dynamics", "constraint_forces", "actuator_forces"])
def test_accelerations_at_rates_that_contradict_each_other_are_refused(ask: str, engine: str, options: dict) -> None:
    q, v = np.zeros(3), np.array([1.0, 1.0, -1.0])
    ASKED[ask](mb.dynamics(driven(1.0, 1.0), engine, **options), q, v)
    for lead in ((), (2,)):
        dyn = mb.dynamics(driven(1.0, 2.0), engine, **options)
        with pytest.raises(InputError, match=r"motion of 'hinge1' by -1 per second against .*motion of 'hinge0'"):
            ASKED[ask](dyn, np.broadcast_to(q, (*lead, 3)), np.broadcast_to(v, (*lead, 3)))


@pytest.mark.parametrize("compiled", [False, True])
def test_a_run_along_which_drives_part_ends_by_name(compiled: bool) -> None:
    # With the same rate at first: ½ sin 2t and sin t.
    dyn = mb.dynamics(driven(2.0, 1.0, (0.5, 1.0)), "lagrangian", compile=compiled)
    with pytest.warns(mb.errors.MbkitWarning, match=r"diverged after t = 0 s .*'hinge1'.*contradicts.*'hinge0'"):
        run = mb.simulate(dyn, np.zeros(3), [1.0, 1.0, -1.0], 0.05, "rk4", dt=1e-3)
    # A compiled run said that it had finished, with NaN.
    assert not run.stats.finished
    assert np.isfinite(run.q).all()


@pytest.mark.parametrize(("engine", "options"), QUICK)
def test_a_step_within_which_drives_part_is_refused_by_name(engine: str, options: dict) -> None:
    dyn = mb.dynamics(driven(2.0, 1.0, (0.5, 1.0)), engine, **options)
    with pytest.raises(NumericalError, match=r"'hinge1'.*contradicts.*'hinge0'"):
        dyn.step(np.zeros(3), [1.0, 1.0, -1.0], np.zeros(3), 1e-3, "rk4", t=0.0)


def test_blades_of_different_speeds_contradict_each_other() -> None:
    b = mb.ModelBuilder("cart", gravity=(0, 0, 0))
    b.add_body("cart", mass=2.0, inertia=(0.1, 0.2, 0.3))
    b.add_joint("move", "planar", parent="world", child="cart")
    for k, speed in enumerate((1.0, 2.0)):
        b.add_blade(f"axle{k}", body_a="cart", translation_a=(0, 0.2 * k, 0), axis_a=(0, 1, 0), speed=speed)
    model = b.build()
    for ask in (lambda: mb.dynamics(model, "lagrangian").project([0, 0, 0], [0, 1, 0]), lambda: model.random_state(0)):
        with pytest.raises(InputError, match=r"'axle1' velocity by -1 per second against no slip 'axle0' velocity"):
            ask()


@pytest.mark.parametrize("engine", ENGINES)
def test_multipliers_of_redundant_rows_are_the_least_and_said_not_to_be_unique(engine: str) -> None:
    dyn, q, v = mb.dynamics(cranks(0.0), engine), np.array([THETA, THETA, THETA, -THETA]), np.zeros(4)
    tau = np.array([1.0, 0.5, -0.3, 0.2])
    forces, J = dyn.constraint_forces(q, v, tau), dyn.constraint_jacobian(q)
    assert forces == pytest.approx(np.linalg.pinv(J.T) @ dyn.generalized_constraint_force(q, v, tau), abs=1e-12)
    # Others have the same force Jᵀ λ, and so the same norm of M⁻¹, which chooses none.
    other = forces + np.linalg.svd(J.T)[2][-1]
    assert J.T @ other == pytest.approx(J.T @ forces, abs=1e-13)
    assert str(dyn.mobility(q)).endswith("1 is redundant: loop 'loop2' z; multipliers are not unique")
    assert "not unique" not in str(mb.dynamics(cranks(0.1), engine).mobility())


@pytest.mark.parametrize("name", ["cranks", *LOOPS])
def test_mobility_is_the_same_at_each_pose_of_the_branch(name: str) -> None:
    model = cranks(0.0) if name == "cranks" else getattr(mb.catalog, name)()
    dyn = mb.dynamics(model, "lagrangian", compile=False)
    known = dyn.mobility()
    if name == "cranks":
        poses = np.outer([0.3, 1.1, 2.9], [1, 1, 1, -1])
    elif name == "bricard":
        # Each joint by the same angle.
        poses = dyn.model.neutral()[None]
    else:
        poses = model.random_state(3, 3)[0]
    for q in poses:
        here = dyn.mobility(q)
        told = ("degrees_of_freedom", "configuration_freedoms", "rows", "redundant")
        assert [getattr(here, x) for x in told] == [getattr(known, x) for x in told]
