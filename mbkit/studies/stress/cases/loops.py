"""Cases with loops and drives: poses that are nearly singular, redundant rows, stiff drives, and many turns."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit import catalog
from mbkit._check import EPS, Array
from mbkit.derivation.constraints import choose_rows
from mbkit.engines import dynamics
from mbkit.engines.applications.random_states import states_of
from mbkit.engines.registry import PINOCCHIO
from mbkit.model import Model, ModelBuilder
from mbkit.model.parts import Prescribed
from mbkit.studies.measurement import Problem
from mbkit.studies.stress.case import case, motion, powers

#: Crank, coupler and rocker of the four-bar that is cut down to a change point, m.
_CRANK, _COUPLER, _ROCKER = 0.3, 0.9, 0.7
_near = partial(
    case,
    *("near-singular", "distance", "m", powers(-1, -7), (1e-1, 1e-3, 1e-5)),
    measure="energy",
    bar=1e-6,
    why="what a run loses where rows nearly depend on each other shows in its energy",
)


def pose(theta: Array, ground: float) -> Array:
    """Return the configurations (K, 3) of the catalog's four-bar at crank angles (K,), by its two triangles."""

    def angles(theta: Array) -> Array:
        x, y = _CRANK * np.cos(theta) - ground, _CRANK * np.sin(theta)
        far = np.hypot(x, y)
        inside = np.arccos((far**2 + _ROCKER**2 - _COUPLER**2) / (2 * _ROCKER * far))
        # The crank's end is left of the rocker's pivot, where the angle has no jump.
        rocker = np.pi + np.arctan2(-y, -x) - inside
        coupler = np.arctan2(_ROCKER * np.sin(rocker) - y, _ROCKER * np.cos(rocker) - x)
        return np.stack([theta, coupler - theta, rocker], axis=-1)

    return np.asarray(angles(theta) - angles(np.zeros(1)) * [0.0, 1.0, 1.0])


def _moving(model: Model, q: ArrayLike, v: ArrayLike, duration: float) -> Problem:
    """Return the problem of a motion that begins near a state, and is judged by its energy."""
    start = states_of(model).manifold.project(np.array(q, dtype=np.float64), np.array(v, dtype=np.float64))
    return Problem(model, *start, duration=duration)


@_near()
def change_point(distance: float) -> Problem:
    """A four-bar swings past the pose in which its rods would lie in line if the ground were shorter by so much."""
    ground = _COUPLER + _CRANK - _ROCKER + distance
    # With a shorter ground the rods fold flat at zero, and two motions meet there.
    model = catalog.four_bar(crank=_CRANK, coupler=_COUPLER, rocker=_ROCKER, ground=ground, gravity=0.0)
    return _moving(model, pose(np.array([1.5]), ground)[0], [-3.0, 3.0, 0.0], 1.0)


@_near()
def dead_centre(distance: float) -> Problem:
    """A slider-crank turns past the pose in which its piston stands nearly on the crank's axis."""
    # Crank and rod of equal lengths fold onto each other there, and the piston could stand still from then on.
    model = catalog.slider_crank(crank=1.0, rod=1.0 + distance)
    return _moving(model, [0.0, 0.0, 0.0], [2.0, -4.0, 0.0], 2.0)


@case(
    *("mass ratio", "one bar over the others", "", powers(0, 9), (1.0, 1e3, 1e6)),
    measure="energy",
    bar=1e-6,
    why="a row that follows from the others may cost the digits of all of them",
)
def heavy_bricard(ratio: float) -> Problem:
    """Bricard's mechanism, of six rows five, falls for 1 s with one bar heavier than the others."""
    model = catalog.bricard()
    first, *others = model.bodies
    heavy = replace(first, mass=ratio * first.mass, inertia=ratio * first.inertia)
    model = replace(model, bodies=(heavy, *others))
    return _moving(model, model.neutral(), np.zeros(model.nv), 1.0)


# Loops that hold what others hold already, but for so much: at 0 the mechanism would move, and it stands still

_Y, _Z = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
#: At the last values rows count as equal: one more freedom is left, as the facts say, and the motion is that of 0.
_redundant = partial(
    case,
    *("near-singular", "apart", "", (*powers(-1, -10, 3), 1e-11, 1e-12), (1e-1, 1e-4, 1e-7)),
    measure="terms",
    bar=1e3 * EPS,
    why="accelerations lose digits with the condition of the rows in the metric of the mass matrix, which divides them",
)


def _nearly_redundant(model: Model) -> Problem:
    """Return the accelerations of a mechanism from rest, under random forces."""
    tau = np.random.default_rng(0).standard_normal((1, model.nv))
    facts = {"freedoms": model.nv - len(choose_rows(model).independent)}
    return Problem(model, model.neutral()[None], 0 * tau, tau, scale=condition_of_rows(model), facts=facts)


def _bar(b: ModelBuilder, name: str, parent: str, axis: ArrayLike, place: ArrayLike, tip: ArrayLike) -> None:
    b.add_body(name, mass=1.0, com=0.5 * np.asarray(tip), inertia=(0.01, 0.01, 0.01))
    b.add_joint(f"{name} hinge", "revolute", parent=parent, child=name, axis=axis, translation=place)


@_redundant()
def cranks(apart: float) -> Problem:
    """Three cranks carry a plate, and one differs by so much, m or rad."""
    b = ModelBuilder("nearly_redundant")
    tips = [(0.3 * math.sin(angle), 0.0, 0.3 * math.cos(angle)) for angle in (0.4, 0.4, 0.4 + apart)]
    for k, tip in enumerate(tips):
        _bar(b, f"crank{k}", "world", _Y, (0.5 * k, 0.0, 0.0), tip)
    _bar(b, "plate", "crank0", _Y, tips[0], (1.0, 0.0, 0.0))
    for k in (1, 2):
        on = tuple(0.5 * k * (i == 0) + x - y for i, (x, y) in enumerate(zip(tips[k], tips[0], strict=True)))
        b.add_loop(f"loop{k}", "point", body_a=f"crank{k}", translation_a=tips[k], body_b="plate", translation_b=on)
    return _nearly_redundant(b.build())


@_redundant()
def neck(apart: float) -> Problem:
    """Two rods beside a plate turn a crank, each welded to its pin."""
    b = ModelBuilder("nearly_redundant")
    top, lever = np.array([-0.033, -0.027, 0.0]), np.array([0.002, 0.007, 0.0])
    _bar(b, "plate", "world", _Z, (0, 0, 0), top)
    _bar(b, "crank", "plate", _Z, top, lever)
    for k, (end, foot) in enumerate(((lever, lever), (-lever, (apart - 1) * lever))):
        _bar(b, f"pin{k}", "crank", _Z, end, -end)
        _bar(b, f"rod{k}", "world", _Z, foot, top + end - foot)
        b.add_loop(f"weld{k}", "frame", body_a=f"rod{k}", translation_a=top + end - foot, body_b=f"pin{k}")
    return _nearly_redundant(b.build())


@_redundant()
def bennett(apart: float) -> Problem:
    """Bennett's mechanism, of six rows three, with one hinge turned."""
    # A skew quadrilateral whose opposite sides are equal (Bennett 1914, The skew isogram mechanism); its hinges are
    # square to both their bars.
    b = ModelBuilder("nearly_redundant")
    corners = np.array([[0.5, 0.1, 0.2], [0.1, 0.4, -0.2], [-0.5, -0.1, 0.2], [-0.1, -0.4, -0.2]])
    sides = np.roll(corners, -1, axis=0) - corners
    axes = np.cross(np.roll(sides, 1, axis=0), sides)
    axes[1] += apart * np.linalg.norm(axes[1]) * sides[1] / np.linalg.norm(sides[1])
    for k in range(4):
        place = sides[k - 1] if k else corners[0]
        _bar(b, f"bar{k}", f"bar{k - 1}" if k else "world", axes[k] / np.linalg.norm(axes[k]), place, sides[k])
    b.add_loop("closed", "frame", body_a="bar3", body_b="world", translation_b=corners[3])
    return _nearly_redundant(b.build())


@_redundant()
def bricard_turned(apart: float) -> Problem:
    """Bricard's mechanism, of six rows five, with one hinge turned."""
    model = catalog.bricard()
    axes = np.array([[apart, 1.0, 0.0]]) / math.hypot(apart, 1.0)
    turned = (replace(x, axes=axes) if x.name == "q2" else x for x in model.joints)
    return _nearly_redundant(replace(model, joints=tuple(turned)))


@_redundant()
def delta_robot(apart: float) -> Problem:
    """Delta with a third rod between two parallel ones."""
    model = catalog.delta_robot()
    # Its lower end is so far out of their plane.
    out, aside = np.array([apart, 0.0, 0.0]), np.array([1.0, 0.0, 1.0])
    body = next(x for x in model.bodies if x.name == "rod1a")
    joint, loop = model.joint("rod1a"), next(x for x in model.loops if x.name == "ball1a")
    ends = {"translation_a": loop.translation_a + out, "translation_b": aside * loop.translation_b + out}
    middle = replace(joint, name="rod1c", child="rod1c", translation=aside * joint.translation)
    loops = (*model.loops, replace(loop, name="ball1c", body_a="rod1c", **ends))
    bodies, joints = (*model.bodies, replace(body, name="rod1c")), (*model.joints, middle)
    return _nearly_redundant(replace(model, bodies=bodies, joints=joints, loops=loops))


def condition_of_rows(model: Model) -> float:
    """Return κ of L⁻¹ Jᵀ at the neutral pose with M = L Lᵀ, of independent rows of unit size."""
    dyn, q = dynamics(model, PINOCCHIO), model.neutral()
    L = np.linalg.cholesky(dyn.mass_matrix(q))
    B = np.linalg.solve(L, dyn.constraint_jacobian(q)[list(choose_rows(model).independent)].T)
    return float(np.linalg.cond(B / np.linalg.norm(B, axis=0)))


#: Amplitude and frequency of a drive, m and rad/s.
_AMPLITUDE, _FREQUENCY = 0.1, 3.0


@case("stiffness", "stiffness", "N/m", powers(2, 12), (1e2, 1e6, 1e10))
def stiff_drive(stiffness: float) -> Problem:
    """A mass of 1 kg on a spring follows a carriage whose motion is prescribed, for 2 s."""
    b, along = ModelBuilder("driven_mass", gravity=(0.0, 0.0, 0.0)), (1.0, 0.0, 0.0)
    b.add_body("carriage", mass=1.0)
    b.add_body("mass", mass=1.0)
    b.add_joint("drive", "prismatic", parent="world", child="carriage", axis=along)
    b.add_joint("spring", "prismatic", parent="carriage", child="mass", axis=along, stiffness=stiffness)
    b.prescribe("drive", amplitude=_AMPLITUDE, frequency=_FREQUENCY)
    # m (ẍ + ÿ) = -k y with x = a sin ω t: y = a ω²/(k/m - ω²) sin ω t is the motion without vibration.
    bent = _AMPLITUDE * _FREQUENCY**2 / (stiffness - _FREQUENCY**2)
    size = np.array([_AMPLITUDE, bent])

    def exact(t: Array) -> Array:
        return np.asarray(np.multiply.outer(np.sin(_FREQUENCY * t), size))

    source, facts = "steady motion of a linear system", {"fastest frequency, rad/s": math.sqrt(stiffness)}
    v, floor = _FREQUENCY * size, 16 * EPS * _AMPLITUDE
    return motion(b.build(), [0.0, 0.0], v, 2.0, exact, floor, source, facts=facts, scale=_AMPLITUDE)


#: Speed of a crank that turns steadily, rad/s, and its ground, m; the four-bar of `validation.four_bar` has the same.
_RATE, _GROUND = 5.0, 1.0
_STEP: Final = 4e-3


@case(
    *("long", "steps", "", powers(3, 6), (1e3, 1e4, 1e5)),
    methods=("rk4", "semi_implicit_euler", "gauss4"),
    patience=6.0,
)
def driven_loop(steps: float) -> Problem:
    """A four-bar whose crank is driven steadily: its loop and its drive open by what steps leave of them."""
    model = catalog.four_bar(crank=_CRANK, coupler=_COUPLER, rocker=_ROCKER, ground=_GROUND)
    model = replace(model, prescribed=(Prescribed("theta", rate=_RATE),))

    def exact(t: Array) -> Array:
        return pose(_RATE * t, _GROUND)

    ahead, behind = exact(np.array([1e-4, -1e-4]))
    _, v = states_of(model).manifold.project(np.zeros(3), (ahead - behind) / 2e-4)
    floor = 16 * EPS * (1 + _RATE * steps * _STEP)
    return motion(model, np.zeros(3), v, steps * _STEP, exact, floor, "two triangles", dt=_STEP)
