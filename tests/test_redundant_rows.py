"""Loops that are redundant, or nearly so: accelerations against 40 digits, within the bound of their condition.

Between two bodies stand several point loops, whose points lie near each other, on a line, or on top of each other. How
near decides the condition of the rows; what 40 digits give knows nothing of mbkit.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mpmath as mp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import mbkit as mb
from mbkit.derivation.constraints import choose_rows
from mbkit.errors import NumericalError
from mbkit.methods import METHODS

EPS = float(np.finfo(float).eps)
#: As `mbkit.derivation.constraints.DEPENDENT`: a row with less of it left follows from the others.
DEPENDENT = 1e-12
#: Kinds of a mechanism's joints that move a body in a plane, and in space.
PLANE = ("revolute", "revolute", "prismatic", "revolute", "prismatic")
SPACE = ("revolute", "prismatic", "revolute", "revolute", "prismatic", "revolute", "revolute")


class Mechanism:
    """A chain from the ground, and point loops from its last body to the ground, in numbers alone."""

    def __init__(self, seed: int) -> None:
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
            b.add_joint(
                f"j{k}",
                kind,
                parent=f"b{k - 1}" if k else "world",
                child=f"b{k}",
                translation=self.places[k],
                axis=axis,
            )
        for i, (a, p) in enumerate(self.points):
            b.add_loop(
                f"l{i}", "point", body_a="world", body_b=f"b{len(self.kinds) - 1}", translation_a=a, translation_b=p
            )
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

    def exact(self) -> tuple[np.ndarray, float, float]:
        """Return v̇ at rest, κ of L⁻¹ Jᵀ on independent rows, and the size of the free acceleration."""
        n, g = len(self.kinds), mp.matrix([0, 0, mp.mpf("-9.81")])
        M, f = mp.zeros(n, n), mp.matrix(self.tau)
        for k, (R, _) in enumerate(self.poses()):
            J, W = self.slopes(k, self.coms[k])
            m = mp.mpf(self.masses[k])
            M = M + m * J.T * J + W.T * R * mp.diag([mp.mpf(x) for x in self.moments[k]]) * R.T * W
            f = f + m * J.T * g
        L = mp.cholesky(M)
        free = mp.lu_solve(L, f)
        # Of the rows, those that are left, one after the other, the largest first; twice taken away.
        rows = [mp.lu_solve(L, self.slopes(n - 1, p)[0][i, :].T) for _, p in self.points for i in range(3)]
        left, basis, kept = [x.copy() for x in rows], [], []
        sizes = [mp.norm(x) for x in rows]
        biggest = max(sizes)
        while left:
            parts = [mp.norm(x) / s if s > DEPENDENT * biggest else mp.mpf(0) for x, s in zip(left, sizes, strict=True)]
            k = max(range(len(left)), key=parts.__getitem__)
            if parts[k] <= DEPENDENT:
                break
            q = left[k] / mp.norm(left[k])
            basis.append(q)
            kept.append(np.array([float(x) for x in rows[k] / sizes[k]]))
            left = [x - q * (q.T * x)[0] for x in left]
        y = free
        for q in basis:
            y = y - q * (q.T * y)[0]
        a, first = mp.lu_solve(L.T, y), mp.lu_solve(L.T, free)
        condition = np.linalg.cond(np.array(kept).T) if kept else 1.0
        return np.array([float(x) for x in a]), float(condition), float(mp.norm(first))


@pytest.mark.thorough(every=50)
@pytest.mark.parametrize("seed", range(1000))
def test_accelerations_keep_what_the_condition_of_the_rows_leaves(seed: int) -> None:
    with mp.workdps(40):
        mechanism = Mechanism(seed)
        exact, condition, free = mechanism.exact()
    model = mechanism.model()
    n = model.nv
    for engine in ("lagrangian", "pinocchio"):
        dyn = mb.dynamics(model, engine, **({"compile": False} if engine == "lagrangian" else {}))
        a = dyn.forward_dynamics(mechanism.q, np.zeros(n), mechanism.tau)
        # The points are rounded, by eps of their size over their distance: the condition too.
        assert np.abs(a - exact).max() <= 1e3 * EPS * condition * free, (engine, condition, a, exact)


# Three cranks that carry a plate: one freedom where they are equal, none where they differ however little

LENGTH, CRANK, PLATE, ABOUT_Y, G, THETA = 0.3, 1.0, 2.0, 0.01, 9.81, 0.4
ENGINES = ("lagrangian", "oracle", "pinocchio")


def cranks(apart: float) -> mb.Model:
    """Return three cranks under a plate; the third stands at THETA + apart where the others stand at THETA."""
    b = mb.ModelBuilder("cranks")
    for k in range(3):
        b.add_body(f"crank{k}", mass=CRANK, com=(0, 0, LENGTH / 2), inertia=(ABOUT_Y, ABOUT_Y, 0.001))
        b.add_joint(
            f"hinge{k}", "revolute", parent="world", child=f"crank{k}", axis=(0, 1, 0), translation=(0.5 * k, 0, 0)
        )
    b.add_body("plate", mass=PLATE, com=(0.5, 0, 0), inertia=(0.02, 0.1, 0.1))
    b.add_joint("pin", "revolute", parent="crank0", child="plate", axis=(0, 1, 0), translation=(0, 0, LENGTH))
    x = 1.0 + LENGTH * (np.sin(THETA + apart) - np.sin(THETA))
    z = LENGTH * (np.cos(THETA + apart) - np.cos(THETA))
    for k, at in ((1, (0.5, 0, 0)), (2, (x, 0, z))):
        end = {"body_a": f"crank{k}", "translation_a": (0, 0, LENGTH)}
        b.add_loop(f"loop{k}", "point", **end, body_b="plate", translation_b=at)
    return b.build()


def swing(theta: float, tau: float = 0.0) -> float:
    """Return θ̈ of equal cranks: (3 (I + m L²/4) + M L²) θ̈ = (3 m L/2 + M L) g sin θ + τ."""
    inertia = 3 * (ABOUT_Y + CRANK * LENGTH**2 / 4) + PLATE * LENGTH**2
    return float(((3 * CRANK * LENGTH / 2 + PLATE * LENGTH) * G * np.sin(theta) + tau) / inertia)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("apart", [1e-1, 1e-3, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11])
def test_cranks_that_differ_by_little_do_not_move(engine: str, apart: float) -> None:
    dyn = mb.dynamics(cranks(apart), engine)
    q = np.array([THETA, THETA, THETA + apart, -THETA])
    # A formed J M⁻¹ Jᵀ gives 4e-2 at 1e-6 and 20 at 1e-8.
    assert np.abs(dyn.forward_dynamics(q, np.zeros(4), [1.0, 0, 0, 0])).max() < 1e-9
    assert dyn.mobility(q).degrees_of_freedom == dyn.mobility().degrees_of_freedom == 0


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


def test_a_linearization_has_the_swing() -> None:
    dyn = mb.dynamics(cranks(0.0), "lagrangian", compile=False)
    slopes = dyn.forward_dynamics_derivatives(np.zeros(4), np.zeros(4), np.zeros(4))
    one = np.array([1.0, 1.0, 1.0, -1.0])
    assert slopes.q @ one == pytest.approx(swing(1e-8) / 1e-8 * one, rel=1e-12)


@pytest.mark.thorough("rodas5", "gauss4", "implicit_midpoint", "dop853", "taylor")
@pytest.mark.parametrize(
    "method", ["rk853", "auto", "rk4", "gauss6", "taylor", "dop853", "rodas5", "gauss4", "implicit_midpoint"]
)
def test_runs_of_equal_cranks_are_those_of_one_freedom(method: str) -> None:
    dyn = mb.dynamics(cranks(0.0), "lagrangian")
    fixed = METHODS[method].kind == "fixed"
    setting = {"dt": 2e-3} if fixed else {"rtol": 1e-12 if method != "rodas5" else 1e-8}
    duration, grid = (10.0, np.linspace(0, 10, 21)) if method in ("rk853", "taylor") else (1.0, np.linspace(0, 1, 11))
    run = mb.simulate(dyn, [THETA, THETA, THETA, -THETA], np.zeros(4), duration, method, save=grid, **setting)
    exact = solve_ivp(
        lambda _, y: [y[1], swing(y[0])], (0, duration), [THETA, 0], "DOP853", grid, rtol=1e-13, atol=1e-14
    )
    close = 1e-9 if method in ("rk853", "taylor") else 1e-5
    assert np.abs(run.q - np.outer(exact.y[0], [1, 1, 1, -1])).max() < close
    energy = run.energy()
    assert np.abs(energy - energy[0]).max() < (1e-10 if method in ("rk853", "taylor") else 1e-3)


@pytest.mark.parametrize(
    ("engine", "options"), [("lagrangian", {"compile": False}), ("lagrangian", {}), ("pinocchio", {})]
)
def test_a_pose_on_another_branch_is_refused_by_its_row(engine: str, options: dict[str, bool]) -> None:
    model = cranks(0.0)
    dyn = mb.dynamics(model, engine, **options)
    moving = np.array([THETA, THETA, THETA, -THETA])
    assert dyn.forward_dynamics(moving, np.zeros(4), np.zeros(4)).any()
    assert len(choose_rows(model).independent) == 3
    # The third crank crosses the others: four rows of rank four, and nothing moves.
    other = np.array([4.7123890, -1.5707963, -1.5707963, 1.5707963])
    with pytest.raises(NumericalError, match=r"loop 'loop2' z.*contradicts"):
        dyn.forward_dynamics(np.array([moving, other]), np.zeros((2, 4)), [1.0, 0, 0, 0])
    with pytest.raises(NumericalError, match=r"loop 'loop2' z.*contradicts"):
        dyn.forward_dynamics(other, np.zeros(4), np.eye(4)[0])


def test_the_digits_of_an_acceleration_under_redundant_rows_are_its_own() -> None:
    # As many rows as velocities, so that the shapes tell nothing.
    oracle, q, v = mb.dynamics(mb.catalog.bricard(), "oracle"), np.zeros(6), np.zeros(6)
    high, low = oracle.extended("forward_dynamics", q, v, np.ones(6))
    assert np.array_equal(high, oracle.forward_dynamics(q, v, np.ones(6)))
    assert np.abs(low).max() < EPS * np.abs(high).max()
    assert high == pytest.approx(high[0] * np.ones(6), rel=1e-14)
    wrenches = {"bar1": np.ones(6)}
    high, _ = oracle.extended("forward_dynamics", q, v, np.ones(6), wrenches)
    assert np.array_equal(high, oracle.forward_dynamics(q, v, np.ones(6), wrenches))


@pytest.mark.parametrize("engine", ENGINES)
def test_forces_and_inertias_on_another_branch_are_refused_as_accelerations_are(engine: str) -> None:
    dyn, still = mb.dynamics(cranks(0.0), engine), np.zeros(4)
    moving = np.array([THETA, THETA, THETA, -THETA])
    other = np.array([4.7123890, -1.5707963, -1.5707963, 1.5707963])
    asked = {
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


@pytest.mark.parametrize("options", [{}, {"compile": False}, {"engine": "oracle"}, {"engine": "pinocchio"}])
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
