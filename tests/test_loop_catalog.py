"""The catalog's mechanisms with loops against their geometry, written here apart from mbkit."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cache
from typing import Any, Final

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mbkit as mb
from mbkit import catalog
from mbkit.codegen.program import program
from mbkit.errors import DoubtfulRunWarning, InputError
from mbkit.lagrangian import from_model
from mbkit.model import Model, Parameter
from validation import four_bar as bare
from validation.closed_forms import published

OWN = {"compile": False}
EPS = np.finfo(float).eps
ZYX = "ZYX"

#: Degrees of freedom, and rows of the closures that are independent.
MOBILITY: Final = {
    "slider_crank": (1, 2),
    "four_bar": (1, 2),
    "four_bars": (1, 4),
    "five_bar": (2, 2),
    "scissor": (1, 6),
    "parallel_gripper": (1, 4),
    "planar_3rrr": (3, 6),
    "andrews_squeezer": (1, 6),
    # One of its six rows follows from the others.
    "bricard": (1, 5),
    "flyball_governor": (2, 4),
    "double_cardan_shaft": (1, 6),
    "stewart_platform": (6, 18),
    "delta_robot": (3, 18),
}
#: Numbers that hide no factor.
OTHER: Final[dict[str, dict[str, Any]]] = {
    "slider_crank": {"crank": 0.13, "rod": 0.41},
    "four_bar": {"crank": 0.37, "coupler": 1.3, "rocker": 1.1, "ground": 1.45},
    "four_bars": {"n": 3, "length": 0.7},
    "five_bar": {"ground": 0.35, "proximal": 0.41, "distal": 0.62},
    "scissor": {"n": 4, "rod": 0.37},
    "parallel_gripper": {"arm": 0.13, "base": 0.04, "palm": 0.06},
    "planar_3rrr": {"base_radius": 0.61, "platform_radius": 0.17, "proximal": 0.31, "distal": 0.37},
    "andrews_squeezer": {"stiffness": 3000.0},
    "bricard": {"length": 0.7, "width": 0.07},
    "flyball_governor": {"arm": 0.8, "height": 1.3, "offset": 0.07},
    "double_cardan_shaft": {"length": 0.7, "angle": 0.8},
    "stewart_platform": {"base_radius": 0.7, "platform_radius": 0.33, "height": 0.8},
    "delta_robot": {"base_radius": 0.17, "platform_radius": 0.06, "arm": 0.23, "rod": 0.57},
}
CASES: Final = [(name, values) for name in MOBILITY for values in ({}, OTHER[name])]
IDS: Final = [f"{name}{', other numbers' if values else ''}" for name, values in CASES]


class Mechanism:
    """A model, its tree's poses, and the gaps of its loops by plain geometry."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.tree = mb.dynamics(model.without("loops"), "lagrangian", compile=False)

    def pose(self, q: np.ndarray, name: str) -> np.ndarray:
        return np.eye(4) if name == "world" else self.tree.pose(q, name)

    def point(self, q: np.ndarray, name: str) -> np.ndarray:
        return self.pose(q, name)[:3, 3]

    def gaps(self, q: np.ndarray) -> np.ndarray:
        """Return r_a - r_b of each loop, m, and of a weld the axis times the sine of its angle."""
        out: list[np.ndarray] = []
        for x in self.model.loops:
            A, B = self.pose(q, x.body_a), self.pose(q, x.body_b)
            out.append(A[:3, :3] @ x.translation_a + A[:3, 3] - B[:3, :3] @ x.translation_b - B[:3, 3])
            if x.kind == "frame":
                E = A[:3, :3] @ x.rotation_a @ (B[:3, :3] @ x.rotation_b).T
                out.append(np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]]) / 2)
        return np.concatenate(out)

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        h = 1e-6
        slopes = [self.gaps(self.model.integrate(q, s * h * e)) for e in np.eye(self.model.nv) for s in (1, -1)]
        return (np.array(slopes[::2]) - np.array(slopes[1::2])).T / (2 * h)

    def rank(self, q: np.ndarray) -> int:
        # Differences leave 1e-10; the smallest singular value of a mechanism, Andrews', is 0.015.
        return int(np.linalg.matrix_rank(self.jacobian(q), tol=1e-6))

    def closed(self, q: np.ndarray, driven: Iterable[str] = ()) -> np.ndarray:
        """Return a closed pose near a pose, with the driven coordinates as they are; by Newton's method.

        Damped by the gap: a row that only closed poses make redundant leads nowhere before.
        """
        kept = [i for i, name in enumerate(self.model.coordinate_names) if name not in set(driven)]
        for _ in range(60):
            gap = self.gaps(q)
            if np.abs(gap).max() < 4 * EPS * self.size:
                break
            step = np.zeros(self.model.nv)
            U, sizes, W = np.linalg.svd(self.jacobian(q)[:, kept], full_matrices=False)
            step[kept] = -W.T @ (sizes / (sizes**2 + gap @ gap) * (U.T @ gap))
            q = self.model.integrate(q, step)
        assert np.abs(self.gaps(q)).max() < 1e-13 * max(1.0, self.size)
        return q

    @property
    def size(self) -> float:
        """Return the largest distance of a body or a pin from the origin at the neutral pose, m."""
        q = self.model.neutral()
        ends = [(self.pose(q, b), t) for x in self.model.loops for b, t in self._ends(x)]
        return max(float(np.linalg.norm(X[:3, :3] @ t + X[:3, 3])) for X, t in ends)

    @staticmethod
    def _ends(loop: Any) -> tuple[tuple[str, np.ndarray], ...]:
        return (loop.body_a, loop.translation_a), (loop.body_b, loop.translation_b)

    def driven(self, **angles: float) -> np.ndarray:
        """Return the closed pose with coordinates at given values, reached from the neutral pose in steps of 0.05."""
        names = self.model.coordinate_names
        q = self.model.neutral()
        steps = max(1, math.ceil(max(abs(x) for x in angles.values()) / 0.05))
        before = None
        for k in range(1, steps + 1):
            # The guess goes on as the last step went.
            guess = q.copy() if before is None else 2 * q - before
            before, q = q, guess
            for name, x in angles.items():
                q[names.index(name)] = x * k / steps
            q = self.closed(q, angles)
        return q

    def near(self, seed: int, reach: float = 0.1) -> np.ndarray:
        """Return a closed pose near the neutral one, of random direction."""
        step = reach * np.random.default_rng(seed).uniform(-1, 1, self.model.nv)
        return self.closed(self.model.integrate(self.model.neutral(), step))


@cache
def _known(name: str, other: bool) -> Mechanism:
    return Mechanism(catalog.get(name)(**(OTHER[name] if other else {})))


def mechanism(name: str, **values: Any) -> Mechanism:
    """Return a mechanism with its defaults, or with the numbers of `OTHER`."""
    assert values in ({}, OTHER[name])
    return _known(name, bool(values))


def turned(x: float, z: float, angle: float) -> np.ndarray:
    """Return a point of the x-z plane turned from +x towards +z."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c * x - s * z, 0.0, s * x + c * z])


# What all of them keep


def test_every_system_with_loops_is_here() -> None:
    assert {n for n, f in catalog.systems().items() if f().loops} == set(MOBILITY) == set(OTHER)


@pytest.mark.parametrize(("name", "values"), CASES, ids=IDS)
def test_the_neutral_pose_is_closed(name: str, values: dict[str, Any]) -> None:
    m = mechanism(name, **values)
    assert not m.model.neutral().any()
    assert np.abs(m.gaps(m.model.neutral())).max() < 1e-14 * m.size


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("name", MOBILITY)
def test_mobility_at_the_neutral_pose_and_near_it(name: str) -> None:
    m = mechanism(name)
    freedoms, rows = MOBILITY[name]
    assert freedoms + rows == m.model.nv
    for q in (m.model.neutral(), *(m.near(seed) for seed in range(3))):
        assert m.rank(q) == rows


def _lengths(name: str) -> dict[str, float]:
    """Return the arguments that may be parameters."""
    return {k: x for k, x in OTHER[name].items() if isinstance(x, float) and (name, k) not in FIXED}


FIXED: Final = {("double_cardan_shaft", "angle")} | {
    ("stewart_platform", k) for k in ("base_radius", "platform_radius", "height")
}


@pytest.mark.parametrize("name", [n for n in MOBILITY if _lengths(n)])
def test_the_neutral_pose_stays_closed_when_parameters_change(name: str) -> None:
    rest = {k: x for k, x in OTHER[name].items() if k not in _lengths(name)}
    free = catalog.get(name)(**{k: Parameter(k) for k in _lengths(name)}, **rest)
    bound = free.with_parameters(**_lengths(name))
    m = Mechanism(bound)
    assert np.abs(m.gaps(bound.neutral())).max() < 1e-14 * m.size
    plain = catalog.get(name)(**OTHER[name])
    assert [x.name for x in bound.loops] == [x.name for x in plain.loops]
    for a, b in zip(bound.bodies, plain.bodies, strict=True):
        assert a.com == pytest.approx(b.com, abs=1e-15)
        assert a.inertia == pytest.approx(b.inertia, abs=1e-15)


REFUSED = [
    ("four_bar", {"crank": 0.3, "coupler": 1.0, "rocker": 0.3}, "ground - crank, coupler, rocker"),
    # Rounding leaves the flat parallelogram a height of 1e-8.
    ("four_bar", {"crank": 0.2, "coupler": 0.5, "rocker": 0.2, "ground": 0.5}, "ground - crank, coupler, rocker"),
    ("four_bar", {"ground": 0.3}, "ground - crank, coupler, rocker"),
    ("four_bar", {"coupler": 0.1, "rocker": 0.1}, "ground - crank, coupler, rocker"),
    ("five_bar", {"distal": 0.3}, "ground, distal, distal"),
    ("planar_3rrr", {"distal": 0.01}, "base_radius - platform_radius, proximal, distal"),
    ("delta_robot", {"rod": 0.3}, r"rod, base_radius \+ arm - platform_radius"),
    ("double_cardan_shaft", {"angle": 2.0}, "angle"),
    ("double_cardan_shaft", {"angle": Parameter("a", 0.5)}, "angle"),
    ("stewart_platform", {"height": Parameter("h", 0.5)}, "height"),
]


@pytest.mark.parametrize(("name", "values", "said"), REFUSED)
def test_lengths_that_do_not_meet_are_named(name: str, values: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=rf"^{said}: expected .*, got "):
        catalog.get(name)(**values)


# Masses


#: Mass a metre of thin rods, or None where the mass is an argument, and the bodies that are none.
RODS: Final[dict[str, tuple[float | None, str]]] = {
    "four_bar": (2.0, ""),
    "four_bars": (1.0, ""),
    "five_bar": (2.0, ""),
    "scissor": (1.0, "roller"),
    "planar_3rrr": (2.0, "disc"),
    "flyball_governor": (0.3, "sleeve arm"),
    "stewart_platform": (None, "platform carrier"),
    "delta_robot": (0.5, "platform carrier"),
}


@pytest.mark.parametrize("name", RODS)
def test_rods_are_thin_and_uniform(name: str) -> None:
    """∫ r rᵀ dm along the rod, whose end is the body's origin."""
    density, others = RODS[name]
    rods = [b for b in catalog.get(name)().bodies if not any(x in b.name for x in others.split())]
    assert len(rods) > 1
    for body in rods:
        e = 2 * body.com
        assert density is None or body.mass == pytest.approx(density * np.linalg.norm(e), rel=1e-14)
        second = body.mass * np.outer(e, e) / 12
        assert body.inertia == pytest.approx(np.trace(second) * np.eye(3) - second, abs=1e-15)


def test_bars_of_bricard_are_cuboids_and_two_halves_one_bar() -> None:
    bar, half = (next(b for b in catalog.bricard().bodies if b.name == name) for name in ("bar2", "half1"))
    across = (1.0**2 + 0.1**2) / 12
    assert bar.inertia == pytest.approx(np.diag([across, across, 0.1**2 / 6]), abs=1e-16)
    both = 2 * (half.inertia + half.mass * 0.25**2 * np.diag([1.0, 0.0, 1.0]))
    assert both == pytest.approx(np.diag([across, 0.1**2 / 6, across]), abs=1e-16)


def test_arms_of_the_governor_carry_their_balls() -> None:
    arm = next(b for b in catalog.flyball_governor().bodies if b.name == "arm1")
    u = np.array([math.cos(math.pi / 6), 0.0, -math.sin(math.pi / 6)])
    assert arm.mass * arm.com == pytest.approx((0.3 * 0.5 + 5.0) * u, rel=1e-14)
    # About the hinge.
    at_hinge = arm.inertia[1, 1] + arm.mass * arm.com @ arm.com
    assert at_hinge == pytest.approx(0.3 / 3 + 5.0, rel=1e-14)


def test_a_thick_rod_is_a_solid_cylinder() -> None:
    front = next(b for b in catalog.double_cardan_shaft().bodies if b.name == "front")
    mass, length, r = 2.0, 0.2, 0.02
    axis = front.com / np.linalg.norm(front.com)
    assert front.mass == pytest.approx(mass, rel=1e-14)
    assert axis @ front.inertia @ axis == pytest.approx(mass * r**2 / 2, rel=1e-12)
    for across in (np.array([0.0, 1.0, 0.0]), np.cross(axis, [0.0, 1.0, 0.0])):
        assert front.inertia @ across == pytest.approx(mass * (3 * r**2 + length**2) / 12 * across, abs=1e-15)


# Planar mechanisms


def test_four_bar_has_the_accelerations_of_its_closed_form() -> None:
    m, dyn = mechanism("four_bar"), from_model(catalog.four_bar()).dynamics(options=OWN)
    (phi0, psi0), *_ = bare.geometry(np.longdouble(0))
    for theta in (0.5, 2.0, -1.3):
        (phi, psi), first, _ = bare.geometry(np.longdouble(theta))
        q = m.driven(theta=theta)
        for got, expected in zip(q, (theta, phi - theta - phi0, psi - psi0), strict=True):
            assert math.remainder(got - float(expected), math.tau) == pytest.approx(0.0, abs=1e-13)
        v = 5.0 * np.array([1.0, first[0] - 1, first[1]], dtype=float)
        a, _ = bare.acceleration(np.longdouble(theta), np.longdouble(5))
        assert dyn.forward_dynamics(q, v, np.zeros(3))[0] == pytest.approx(float(a), rel=1e-12)


def test_four_bars_of_iftomm_a02_reach_the_exact_state() -> None:
    """The start of A02: upright, the first upper end at 1 m/s along +x; x, z and their rates after a second."""
    dyn = from_model(catalog.four_bars()).dynamics(options=OWN)
    v = [1.0 if name.startswith("phi") else -1.0 for name in dyn.model.coordinate_names]
    # It turns over, through the pose in which all rods lie flat.
    with pytest.warns(DoubtfulRunWarning, match="singular pose"):
        run = mb.simulate(dyn, np.zeros(5), v, 1.0, "rk853", rtol=1e-11, save=[1.0])
    (theta, *_), (rate, *_) = run.q[0], run.v[0]
    got = [-math.sin(theta), math.cos(theta), -math.cos(theta) * rate, -math.sin(theta) * rate]
    assert got == pytest.approx(published()["iftomm_A02_double_four_bar"]["exact_x_y_vx_vy_of_B0"]["1"], abs=1e-8)


@pytest.mark.parametrize("values", [{}, OTHER["five_bar"]])
@pytest.mark.parametrize("driven", [(0.4, -0.3), (-0.5, -0.7)])
def test_five_bars_tip_is_where_two_circles_meet(values: dict[str, float], driven: tuple[float, float]) -> None:
    d, p, s = ({"ground": 0.6, "proximal": 0.3, "distal": 0.5} | values).values()
    m = mechanism("five_bar", **values)
    q = m.driven(theta1=driven[0], theta2=driven[1])
    elbows = [turned(0.0, p, x) + np.array([side * d / 2, 0, 0]) for side, x in zip((-1, 1), driven, strict=True)]
    span = elbows[1] - elbows[0]
    above = np.array([-span[2], 0.0, span[0]]) / np.linalg.norm(span)
    tip = (elbows[0] + elbows[1]) / 2 + above * math.sqrt(s**2 - span @ span / 4)
    assert m.point(q, "tip") == pytest.approx(tip, abs=1e-13)


@pytest.mark.thorough("values0")
@pytest.mark.parametrize("values", [{}, OTHER["scissor"]])
def test_scissors_height(values: dict[str, Any]) -> None:
    m = mechanism("scissor", **values)
    n, rod = ({"n": 3, "rod": 0.5} | values).values()
    dyn, zero = None if values else from_model(m.model).dynamics(options=OWN), np.zeros(m.model.nv)
    for x in (-0.3 * rod, 0.15 * rod):
        q = m.driven(x=x)
        phi = math.acos(0.8 + x / rod)
        assert m.point(q, "top") == pytest.approx([0.0, 0.0, n * rod * math.sin(phi)], abs=1e-12)
        # The force at the roller that holds the rods' weight: virtual work on their middles.
        if dyn is not None:
            force = -9.81 * 2 * n * rod * (n / 2) / math.tan(phi)
            assert np.abs(dyn.forward_dynamics(q, zero, [force, *zero[1:]])).max() < 1e-10


@pytest.mark.parametrize("values", [{}, OTHER["parallel_gripper"]])
def test_grippers_fingers_stay_parallel(values: dict[str, float]) -> None:
    m = mechanism("parallel_gripper", **values)
    arm, palm = (({"arm": 0.1, "palm": 0.05} | values)[k] for k in ("arm", "palm"))
    for theta in (-0.2, 0.5, 1.1):
        q = m.driven(theta=theta)
        left, right = (m.pose(q, f"pad{k}") for k in (1, 2))
        assert np.abs([left[:3, :3] - np.eye(3), right[:3, :3] - np.eye(3)]).max() < 1e-13
        opening = palm + 2 * arm * math.sin(theta)
        assert right[:3, 3] - left[:3, 3] == pytest.approx([opening, 0, 0], abs=1e-13)
        assert left[2, 3] == pytest.approx(0.08 + arm * math.cos(theta), abs=1e-13)


@pytest.mark.parametrize("values", [{}, OTHER["planar_3rrr"]])
@pytest.mark.parametrize("seed", range(3))
def test_3rrr_has_the_arms_angles_of_its_platforms_pose(values: dict[str, float], seed: int) -> None:
    m = mechanism("planar_3rrr", **values)
    R, r, p, d = ({"base_radius": 0.5, "platform_radius": 0.14, "proximal": 0.3, "distal": 0.3} | values).values()
    q = m.near(seed, 0.2)
    for k in range(3):
        u = np.array([math.cos(k * math.tau / 3), math.sin(k * math.tau / 3)])
        c, s = math.cos(q[2]), math.sin(q[2])
        way = q[:2] + r * np.array([c * u[0] - s * u[1], s * u[0] + c * u[1]]) - R * u

        def angle(way: np.ndarray) -> float:
            """Return the direction of the first of two links whose end is that way, bent to the left."""
            w = float(np.linalg.norm(way))
            return math.atan2(way[1], way[0]) + math.acos((w**2 + p**2 - d**2) / (2 * w * p))

        assert q[3 + 2 * k] == pytest.approx(math.remainder(angle(way) - angle(-(R - r) * u), math.tau), abs=1e-12)


# Andrews' squeezing mechanism


def test_andrews_squeezer_starts_as_published() -> None:
    told = published()["andrews_squeezing_mechanism"]
    m = mechanism("andrews_squeezer")
    g, q = told["geometry"], [float(x) for x in told["q0"]]
    beta, Theta, gamma, _, delta, _, epsilon = q
    assert list(m.model.coordinate_names) == told["coords"]
    assert [b.mass for b in m.model.bodies] == told["m"]
    assert [b.inertia[2, 2] for b in m.model.bodies] == told["I_com"]
    zero = m.model.neutral()

    def centre(k: int) -> np.ndarray:
        return (m.pose(zero, f"K{k}") @ [*m.model.bodies[k - 1].com, 1])[:2]

    def unit(angle: float) -> np.ndarray:
        return np.array([math.cos(angle), math.sin(angle)])

    # The centres of mass of the source, at its angles.
    A, B = np.array([g["xa"], g["ya"]]), np.array([g["xb"], g["yb"]])
    side = np.array([[0.0, 1.0], [-1.0, 0.0]])
    crank, chain = g["rr"] * unit(beta), unit(beta + Theta)
    expected = {
        1: g["ra"] * unit(beta),
        2: crank - g["da"] * chain,
        3: B + g["sb"] * unit(gamma) + g["sa"] * side @ unit(gamma),
        4: A + g["zt"] * unit(delta) + (g["e"] - g["ea"]) * side @ unit(q[3] + delta),
        5: A + g["ta"] * unit(delta) - g["tb"] * side @ unit(delta),
        6: A + g["u"] * side @ unit(epsilon) + (g["zf"] - g["fa"]) * unit(q[5] + epsilon),
        7: A + g["ua"] * side @ unit(epsilon) - g["ub"] * unit(epsilon),
    }
    for k, place in expected.items():
        assert centre(k) == pytest.approx(place, abs=1e-16)


# In space


@pytest.mark.parametrize("values", [{}, OTHER["bricard"]])
def test_bricard_moves_though_its_rows_say_otherwise(values: dict[str, float]) -> None:
    m = mechanism("bricard", **values)
    length = ({"length": 1.0} | values)["length"]
    for q1 in (0.3, -0.4):
        q = m.driven(q1=q1)
        corners = [m.pose(q, b)[:3] @ [*x, 1] for b, x in (("bar1", (0, 0, 0)), ("bar1", (length, 0, 0)))]
        corners += [m.pose(q, b)[:3] @ [*x, 1] for b, x in (("bar2", (0, 0, -length)), ("half2", (0, 0, 0)))]
        corners += [m.pose(q, b)[:3] @ [*x, 1] for b, x in (("bar4", (0, 0, 0)), ("bar5", (0, 0, 0)))]
        sides = np.roll(corners, -1, axis=0) - corners
        assert np.linalg.norm(sides, axis=1) == pytest.approx(np.full(6, length), abs=1e-12)
        across = [corners[(i + 2) % 6] - corners[i] for i in range(6)]
        # By the symmetry the corners 1, 3, 5 and 2, 4, 6 are equilateral triangles.
        sizes = np.linalg.norm(across, axis=1)
        assert np.ptp(sizes[::2]) < 1e-12
        assert np.ptp(sizes[1::2]) < 1e-12
        assert m.rank(q) == 5
    # IFToMM A04 gives -29.43 J.
    assert m.tree.potential_energy(m.model.neutral()) == pytest.approx(-29.43 * length, rel=1e-14)


@pytest.mark.thorough
@pytest.mark.parametrize("values", [{}, OTHER["flyball_governor"]])
def test_governors_sleeve_and_speed(values: dict[str, float]) -> None:
    m = mechanism("flyball_governor", **values)
    L, h, o = ({"arm": 1.0, "height": 1.0, "offset": 0.05} | values).values()
    rho, ball, sleeve, g = 0.3, 5.0, 3.0, 9.81
    dyn = from_model(m.model).dynamics(options=OWN)
    for alpha in (-0.3, 0.35):
        q = m.driven(alpha1=alpha, alpha2=alpha, turn=0.2)
        y = math.pi / 6 - alpha
        assert m.point(q, "sleeve")[2] == pytest.approx(h - L * math.sin(y), abs=1e-13)
        # Each side: ball, arm, link with the square of the distance from the axis as it grows along them.
        sine, cosine = math.sin(y), math.cos(y)
        slope_I = -2 * ball * (o + L * cosine) * L * sine
        slope_I -= rho * L * (o * L * sine + 2 * L**2 * cosine * sine / 3)
        slope_I -= rho * L / 2 * (o * L / 2 * sine + 2 * (L / 2) ** 2 * cosine * sine / 3)
        slope_V = -g * cosine * (2 * ball * L + rho * L**2 + 2 * rho * L / 2 * 0.75 * L + sleeve * L)
        omega = math.sqrt(slope_V / slope_I)
        v = np.zeros(6)
        v[0] = omega
        assert np.abs(dyn.forward_dynamics(q, v, np.zeros(6))).max() < 1e-10


@pytest.mark.thorough("values1")
@pytest.mark.parametrize("values", [{}, OTHER["double_cardan_shaft"]])
def test_two_cardan_joints_take_back_what_one_does(values: dict[str, float]) -> None:
    m, bend = mechanism("double_cardan_shaft", **values), ({"angle": 0.5} | values)["angle"]
    names = m.model.coordinate_names
    along = np.array([math.cos(bend), 0.0, math.sin(bend)])
    for theta in (0.7, 1.4, -2.0):
        q = m.driven(theta1=theta)
        assert q[names.index("theta2")] == pytest.approx(theta, abs=1e-12)
        assert q[names.index("slide")] == pytest.approx(0.0, abs=1e-13)
        front = m.pose(q, "front")[:3, :3]
        assert front @ along == pytest.approx(along, abs=1e-13)
        # tan of the intermediate shaft's turn about itself, on the driver's side of the circle.
        turn = Rotation.from_matrix(front).as_rotvec() @ along
        expected = math.atan2(math.cos(bend) * math.sin(theta), math.cos(theta))
        assert math.remainder(turn - expected, math.tau) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.thorough("0-values0", "0-values1", "2-values0", "2-values1")
@pytest.mark.parametrize("values", [{}, OTHER["stewart_platform"]])
@pytest.mark.parametrize("seed", range(3))
def test_stewarts_legs_have_the_lengths_of_the_pose(values: dict[str, float], seed: int) -> None:
    m = mechanism("stewart_platform", **values)
    A, B, h = ({"base_radius": 0.5, "platform_radius": 0.3, "height": 0.6} | values).values()
    q, up = m.near(seed), np.array([0.0, 0.0, h])
    names = m.model.coordinate_names
    R, p = Rotation.from_euler(ZYX, q[3:6]).as_matrix(), q[:3] + up
    pairs = [(10, 50), (110, 70), (130, 170), (230, 190), (250, 290), (350, 310)]
    for k, (foot, joint) in enumerate(np.radians(pairs), 1):
        a, b = (r * np.array([math.cos(x), math.sin(x), 0.0]) for r, x in ((A, foot), (B, joint)))
        length = np.linalg.norm(p + R @ b - a) - np.linalg.norm(b + up - a)
        assert q[names.index(f"length{k}")] == pytest.approx(length, abs=1e-13)


@pytest.mark.thorough("0-values0", "1-values1", "2-values1")
@pytest.mark.parametrize("values", [{}, OTHER["delta_robot"]])
@pytest.mark.parametrize("seed", range(3))
def test_delta_never_turns_and_has_the_arms_angles_of_its_place(values: dict[str, float], seed: int) -> None:
    m = mechanism("delta_robot", **values)
    base, plate, arm, rod = ({"base_radius": 0.15, "platform_radius": 0.05, "arm": 0.2, "rod": 0.5} | values).values()
    names = m.model.coordinate_names
    q = m.near(seed, 0.3)
    assert np.abs(q[3:6]).max() < 1e-12
    assert np.abs(q[:3]).max() > 0.01
    p = m.point(q, "platform")
    assert p == pytest.approx(q[:3] - [0, 0, math.sqrt(rod**2 - (base + arm - plate) ** 2)], abs=1e-13)
    for k in range(3):
        u = np.array([math.cos(k * math.tau / 3), math.sin(k * math.tau / 3), 0.0])
        w = p + (plate - base) * u
        # |w|² + arm² - rod² = 2 arm (cos θ u · w - sin θ z · w), and the elbow is outside.
        reach = (w @ w + arm**2 - rod**2) / (2 * arm)
        theta = -math.acos(reach / math.hypot(u @ w, w[2])) - math.atan2(w[2], u @ w)
        got = q[names.index(f"theta{k + 1}")]
        assert math.remainder(theta - got, math.tau) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "most", "roots"),
    [("four_bar", 240, 0), ("planar_3rrr", 1110, 2), ("bricard", 1760, 1), ("double_cardan_shaft", 2380, 2)],
)
def test_accelerations_under_loops_take_few_operations_and_roots(name: str, most: int, roots: int) -> None:
    # With a root for each row, and γ as a derivative of the rates, they were up to 1.3 times as many, and 1.6 times as
    # slow as those of the formed J M⁻¹ Jᵀ.
    derived = program(mb.dynamics(catalog.get(name)(), "lagrangian", **OWN).function("forward_dynamics"))
    assert derived.arithmetic <= most
    assert sum(operation.name == "sqrt" for operation in derived.operations) <= roots
