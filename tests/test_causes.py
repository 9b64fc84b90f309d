"""Planted differences are found and named, in descriptions and engines; what nothing explains is narrowed down."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from functools import cache
from typing import Any

import casadi as ca
import mujoco
import numpy as np
import pytest
from click.testing import CliRunner

import mbkit as mb
from mbkit import spatial
from mbkit.cli import cli
from mbkit.engines import Dynamics
from mbkit.engines.mujoco.engine import MujocoDynamics
from mbkit.engines.pinocchio.engine import PinocchioDynamics
from mbkit.errors import InputError, MbkitWarning, UnsupportedError
from mbkit.load.shapes import MassProperties, together
from mbkit.model import Body, Joint, Mimic, Model
from mbkit.model.elements.formula import Formula
from mbkit.model.model import unchecked
from mbkit.studies.baseline.description import SECTIONS, changes, described
from mbkit.studies.explain import hypotheses
from mbkit.studies.explain.merged_model import OTHERS, Tolerances, merge
from mbkit.studies.importers.study import written
from mbkit.testing import assert_same_dynamics
from tests.kind_examples import EXAMPLES, TYPES, example
from tests.random_trees import random_tree
from tests.scenes import chain, hinge

ROBOTS = ("panda", "ur5", "solo8", "so100", "kinova")


@cache
def robot(name: str) -> Model:
    """A robot with a free base, a helical joint, a mimic joint, damping and a tool fixed to it in a rotated frame."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MbkitWarning)
        model = mb.load(name, floating_base=True, mimic="free")
    joints = list(model.joints)
    hinges = [k for k, j in enumerate(joints) if j.kind in ("revolute", "continuous")]
    first, second, _, *_, last = hinges
    joints[second] = replace(joints[second], kind="helical", pitch=0.03)
    joints[last] = replace(joints[last], mimic=Mimic(joints[first].name, 0.5, 0.2))
    joints = [replace(j, damping=j.damping + 0.01) if j.type.nv == 1 else j for j in joints]
    R = spatial.matrix_from_rpy(0.4, -0.7, 1.1)
    fixed = _fixed("mount", joints[hinges[2]].child, "tool", R, np.array([0.1, 0.02, -0.05]))
    I = np.array([[3e-3, 2e-4, -1e-4], [2e-4, 4e-3, 3e-4], [-1e-4, 3e-4, 5e-3]])
    tool = Body("tool", 0.8, np.array([0.03, -0.02, 0.06]), I)
    return replace(model, joints=(*joints, fixed), bodies=(*model.bodies, tool), nonphysical=())


def _fixed(name: str, parent: str, child: str, R: np.ndarray, p: np.ndarray) -> Joint:
    none = np.empty(0)
    return Joint(name, "fixed", parent, child, R, p, np.empty((0, 3)), 0.0, *[none] * 9)


def hinges(model: Model) -> list[Joint]:
    return [j for j in model.joints if j.kind in ("revolute", "continuous") and j.mimic is None]


def carried(model: Model) -> Body:
    """A body whose inertia is no ball's and whose centre of mass is off its origin."""
    bodies = [model.body(j.child) for j in model.joints if j.type.nv == 1]
    return max(bodies, key=lambda b: np.ptp(np.linalg.eigvalsh(b.inertia)) * (1 + np.linalg.norm(b.com)))


def with_joint(model: Model, name: str, **changes: object) -> Model:
    return replace(model, joints=tuple(replace(j, **changes) if j.name == name else j for j in model.joints))


def with_body(model: Model, name: str, **changes: object) -> Model:
    return replace(model, bodies=tuple(replace(b, **changes) if b.name == name else b for b in model.bodies))


Planted = tuple[Model, str, str]
_PER = ("lower", "upper", "velocity_limit", "effort_limit", "armature", "damping", "friction", "stiffness", "rest")
FIXED = {**{f: np.empty(0) for f in _PER}, "kind": "fixed", "axes": np.empty((0, 3))}
TURN = spatial.matrix_from_rpy(0.3, 0.2, 0.5)


def reordered(R: np.ndarray) -> np.ndarray:
    """A rotation whose quaternion was read w first."""
    x, y, z, w = spatial.quaternion_from_matrix(R)
    return spatial.matrix_from_quaternion(np.array([w, x, y, z]))


def about_origin(b: Body) -> np.ndarray:
    return b.inertia + b.mass * (b.com @ b.com * np.eye(3) - np.outer(b.com, b.com))


def turned_zero(j: Joint) -> np.ndarray:
    return j.rotation @ spatial.matrix_from_quaternion(spatial.exp_quaternion(0.25 * j.axes[0]))


#: Mistakes in one joint or body: the kind of the cause, whose, and what the part then says.
IN_ONE_PART: dict[str, tuple[Callable[[Model], Joint | Body], Callable[..., dict[str, object]]]] = {
    "armature": (lambda m: hinges(m)[1], lambda j: {"armature": j.armature + 0.1}),
    "damping": (lambda m: hinges(m)[2], lambda _: {"damping": np.array([0.1])}),
    "quaternion order": (lambda m: hinges(m)[1], lambda j: {"rotation": reordered(j.rotation)}),
    "inertia about the wrong point": (carried, lambda b: {"inertia": about_origin(b)}),
    "mimic": (lambda m: next(j for j in m.joints if j.mimic), lambda _: {"mimic": None}),
    "base mass": (
        lambda m: m.body(m.joint("root_joint").child),
        lambda _: {"mass": 0.0, "com": np.zeros(3), "inertia": np.zeros((3, 3))},
    ),
    "unit of pitch": (
        lambda m: next(j for j in m.joints if j.kind == "helical"),
        lambda j: {"pitch": j.pitch / (2 * np.pi)},
    ),
    "axis sign": (lambda m: hinges(m)[2], lambda j: {"axes": -j.axes}),
    "joint origin": (lambda m: hinges(m)[1], lambda j: {"translation": j.translation + np.array([0.0, 0.01, 0.002])}),
    "inertia axes": (carried, lambda b: {"inertia": TURN @ b.inertia @ TURN.T}),
    "mass": (carried, lambda b: {"mass": 1.3 * b.mass, "inertia": 1.3 * b.inertia}),
    "zero position": (lambda m: hinges(m)[1], lambda j: {"rotation": turned_zero(j)}),
    "joint held still": (lambda m: hinges(m)[2], lambda _: FIXED),
    "friction": (lambda m: hinges(m)[1], lambda _: {"friction": np.array([0.3])}),
    "limits": (lambda m: hinges(m)[1], lambda _: {"upper": np.array([57.3])}),
    # Of a model of three links.
    "centre of mass": (lambda m: m.body("b2"), lambda b: {"com": -b.com}),
}


def with_part(model: Model, part: Joint | Body, **changes: object) -> Model:
    return (with_joint if isinstance(part, Joint) else with_body)(model, part.name, **changes)


def in_one_part(kind: str) -> Callable[[Model], Planted]:
    whose, changes = IN_ONE_PART[kind]
    return lambda m: (with_part(m, whose(m), **changes(whose(m))), kind, whose(m).name)


def fused_unturned(m: Model) -> Planted:
    """The tool fused to what it is fixed to, with its inertia as it stands in its own axes."""
    mount, tool = m.joint("mount"), m.body("tool")
    b = m.body(mount.parent)
    p = mount.translation + mount.rotation @ tool.com
    one = together([MassProperties(b.mass, b.com, b.inertia), MassProperties(tool.mass, p, tool.inertia)])
    changed = with_body(without_tool(m), b.name, mass=one.mass, com=one.com, inertia=one.inertia)
    return changed, "fused with a rotated frame", b.name


def without_tool(m: Model) -> Model:
    return replace(m, joints=m.joints[:-1], bodies=m.bodies[:-1])


def lost_tool(m: Model) -> Planted:
    return without_tool(m), "lost body", "tool"


def gravity(m: Model) -> Planted:
    return replace(m, gravity=(0, 0, -9.80)), "gravity", ""


def order(m: Model) -> Planted:
    joints = list(m.joints)
    i, k = (joints.index(j) for j in hinges(m)[:2])
    joints[i], joints[k] = joints[k], joints[i]
    return replace(m, joints=tuple(joints)), "joint order", joints[i].name


def names(m: Model) -> Planted:
    a, b = hinges(m)[1].name, hinges(m)[2].name
    other = {a: b, b: a}
    return replace(m, joints=tuple(replace(j, name=other.get(j.name, j.name)) for j in m.joints)), "names exchanged", a


PLANTS = {x.__name__: x for x in (fused_unturned, lost_tool, gravity, order, names)}
PLANTS |= {kind: in_one_part(kind) for kind in IN_ONE_PART}
SILENT = {"limits", "joint order"}


@pytest.mark.thorough(every=6)
@pytest.mark.parametrize(
    ("plant", "name"),
    # Each mistake in two robots, each robot with eight mistakes.
    [(p, ROBOTS[(k + i) % len(ROBOTS)]) for k, p in enumerate(PLANTS) for i in (0, 2) if p != "centre of mass"],
)
def test_a_planted_difference_is_named(plant: str, name: str) -> None:
    a = robot(name)
    b, kind, where = PLANTS[plant](a)
    found = mb.explain(a, b, samples=1)
    assert [c.kind for c in found.causes] == [kind], found.to_markdown()
    assert where in str(found.causes[0])
    assert found.explained
    assert found.causes[0].acts == (kind not in SILENT)
    assert found.agree == (kind in SILENT)


def test_an_inertia_whose_quaternion_was_read_in_the_wrong_order_is_named() -> None:
    a = robot("panda")
    body = carried(a)
    moments, axes = np.linalg.eigh(body.inertia)
    R = reordered(axes * np.linalg.det(axes))
    (cause,) = mb.explain(a, with_body(a, body.name, inertia=R @ np.diag(moments) @ R.T), samples=1).causes
    assert cause.kind == "quaternion order"
    assert body.name in str(cause)


def test_a_robot_agrees_with_itself_and_with_its_frames_drawn_elsewhere() -> None:
    a = robot("panda")
    assert mb.explain(a, a).agree
    assert not mb.explain(a, a).causes
    # Every one-axis joint's frame turned and slid along its axis: other numbers, the same robot.
    b = mb.ModelBuilder("again", gravity=a.gravity)
    rng = np.random.default_rng(0)
    moved = {"world": (np.eye(3), np.zeros(3))}
    for j in a.tree:
        R, p = moved[j.parent]
        turn = spatial.matrix_from_quaternion(spatial.normalized(rng.standard_normal(4)))
        shift = j.axes[0] * rng.standard_normal() if j.kind in ("revolute", "helical", "prismatic") else np.zeros(3)
        if j.kind in ("free", "fixed"):
            turn = np.eye(3)
        moved[j.child] = turn, shift
        body = a.body(j.child)
        b.add_body(j.child, mass=body.mass, com=turn.T @ (body.com - shift), inertia=turn.T @ body.inertia @ turn)
        numbers = {n: getattr(j, n) for n in _PER}
        b.add_joint(
            j.name,
            j.kind,
            parent=j.parent,
            child=j.child,
            rotation=R.T @ j.rotation @ turn,
            translation=R.T @ (j.translation + j.rotation @ shift - p),
            axis=None if not j.axes.size else turn.T @ j.axes[0],
            pitch=j.pitch,
            mimic=j.mimic,
            **numbers,
        )
    found = mb.explain(a, b.build(nonphysical="warn"))
    assert found.agree
    assert not [c for c in found.causes if c.kind != "joint order"]
    assert any("drawn elsewhere" in note for note in found.notes)


def test_several_differences_are_told_apart_with_their_own_effects() -> None:
    a = robot("ur5")
    b, kinds = a, []
    for plant in ("armature", "damping", "mass", "axis sign", "gravity"):
        b, kind, _ = PLANTS[plant](b)
        kinds.append(kind)
    found = mb.explain(a, b, samples=1)
    assert sorted(c.kind for c in found.causes) == sorted(kinds)
    effects = {c.kind: c.effects for c in found.causes}
    assert effects["damping"]["M"] < 1e-14 < 1e-4 < effects["damping"]["passive"]
    assert effects["armature"]["nle"] < 1e-14 < 1e-4 < effects["armature"]["M"]
    told = json.loads(found.to_json())
    assert told["explained"]
    assert "axis sign: " in found.to_markdown()
    assert "axis sign" in found._repr_html_()


def planted_fields(m: Model, rng: np.random.Generator, many: int) -> dict[tuple[str, str], Callable[[Model], Model]]:
    """Changes of single fields of a tree's parts, at least two of them in one body."""
    joints = [j for j in m.joints if j.kind in ("revolute", "continuous", "prismatic", "helical")]
    body, other = (m.body(f"b{k}") for k in rng.choice(len(m.bodies), 2, replace=False))
    joint = joints[rng.integers(len(joints))]
    near, far = 0.1 * rng.standard_normal((2, 3))
    all_of_them = {
        (body.name, "mass"): lambda x: with_body(x, body.name, mass=1.4 * body.mass),
        (body.name, "centre of mass"): lambda x: with_body(x, body.name, com=body.com + near),
        (body.name, "inertia"): lambda x: with_body(x, body.name, inertia=body.inertia + np.diag([0.3, 0.4, 0.5])),
        (other.name, "mass"): lambda x: with_body(x, other.name, mass=0.7 * other.mass),
        (joint.name, "joint origin"): lambda x: with_joint(x, joint.name, translation=joint.translation + far),
        (joint.name, "armature"): lambda x: with_joint(x, joint.name, armature=joint.armature + 0.2),
        (joint.name, "damping"): lambda x: with_joint(x, joint.name, damping=joint.damping + 0.2),
        (joint.name, "friction"): lambda x: with_joint(x, joint.name, friction=joint.friction + 0.2),
    }
    keys = [list(all_of_them)[k] for k in rng.permutation(8)[:many]]
    return {k: all_of_them[k] for k in dict.fromkeys([*list(all_of_them)[:2], *keys])}


def moved(a: Model, b: Model) -> bool:
    """Whether a term of two descriptions with the same coordinates differs."""
    q, v = a.random_state(np.random.default_rng(3), 4)
    values = []
    for m in (a, b):
        dyn = mb.dynamics(m)
        values.append([dyn.mass_matrix(q), dyn.nle(q, v), dyn.passive(q, v)])
    return any(np.abs(x - y).max() > 1e-8 * np.abs(x).max() for x, y in zip(*values, strict=True))


@pytest.mark.thorough("1", "2", "3")
@pytest.mark.parametrize("seed", range(4))
def test_differences_together_are_named_each_and_silent_only_where_none_alone_changes_a_term(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a = random_tree(seed, 6, kinds=("revolute", "fixed", "prismatic", "helical", "free", "ball"))
    planted = planted_fields(a, rng, 2 + seed % 4)
    b = a
    for plant in planted.values():
        b = plant(b)
    found = mb.explain(a, b, samples=2)
    assert found.explained
    assert found.remainder < 1e-12
    causes = {(c.subject.split("'")[1], c.kind): c for c in found.causes if c.kind != "base mass"}
    # What is fixed to the world is told as the base.
    still = {name for name, _ in planted} - {name for name, _ in causes}
    assert not any(moved(a, plant(a)) for (name, _), plant in planted.items() if name in still)
    assert causes.keys() == {key for key in planted if key[0] not in still}
    for key, cause in causes.items():
        rest = a
        for other, plant in planted.items():
            rest = rest if other == key else plant(rest)
        assert cause.acts == (moved(a, planted[key](a)) or moved(rest, b)), cause


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("one", "two", "read"),
    [("ur5", "ur10", written), ("ur3", "ur5", mb.load), ("a1", "go1", mb.load), ("go1", "go2", written)],
)
def test_two_robots_are_explained_to_the_last_digit(one: str, two: str, read: Callable[[str], Model]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MbkitWarning)
        a, b = read(one), read(two)
    found = mb.explain(a, b, samples=1)
    assert not found.agree
    assert found.explained
    assert {g.term for g in found.left} == {"M", "g", "nle", "passive", "accelerations"}
    assert found.remainder < 1e-12
    # A mass that no term holds turns about a vertical axis through it.
    first = next(j.child for j in a.tree if j.type.nv)
    assert {c.subject for c in found.causes if c.kind == "mass" and not c.acts} <= {f"{x} {first!r}" for x in _PART}
    # The numbers are those of the files, and of links that are fixed to each other as one.
    for c in found.causes:
        if c.kind == "centre of mass" and c.subject.startswith("body"):
            assert any(np.allclose(c.b, x.com) for x in merge(b).model.bodies)


_PART = ("body", "link")


def test_a_mass_counts_whichever_side_shows_it() -> None:
    # With its centre of mass on the hinge, the mass of a body is in no term.
    a = random_tree(0, 1, kinds=("revolute",), springs=False)
    a = with_body(a, "b0", com=np.zeros(3))
    b = with_body(a, "b0", mass=2.0 * a.body("b0").mass, com=np.array([0.1, 0.2, 0.3]))
    for one, two in ((a, b), (b, a)):
        assert {c.kind for c in mb.explain(one, two).acting} == {"mass", "centre of mass"}


def test_robots_without_a_joint_in_common_are_not_compared() -> None:
    found = mb.explain(mb.catalog.pendulum(), mb.catalog.heavy_top())
    assert not found.matches
    assert not found.agree
    assert not found.explained
    assert "no joint in common" in found.verdict


def test_other_names_are_matched_by_structure_and_six_digits_are_told_as_rounding() -> None:
    a = robot("so100")
    b = replace(a, joints=tuple(replace(j, name=f"motor_{j.name}", mimic=None) for j in a.joints))
    a = replace(a, joints=tuple(replace(j, mimic=None) for j in a.joints))
    found = mb.explain(a, b, samples=1)
    assert [c.kind for c in found.causes] == ["renamed"]
    assert {m.how for m in found.matches} == {"structure"}
    noise = np.random.default_rng(0)
    six = [replace(x, mass=x.mass * (1 + 3e-6 * noise.random()), inertia=x.inertia * (1 + 3e-6)) for x in a.bodies]
    c = replace(a, bodies=tuple(six))
    found = mb.explain(a, c, samples=1)
    assert [x.kind for x in found.causes] == ["rounding"]
    assert found.explained


@pytest.mark.parametrize(("many", "apart", "rounding"), [(5, 1.5e-5, True), (5, 2.5e-5, False), (4, 1.5e-5, False)])
def test_rounding_is_five_small_differences_at_least(many: int, apart: float, rounding: bool) -> None:
    rods = [{"mass": 1.0, "com": (0.1, 0, 0.2), "inertia": (0.1, 0.2, 0.3), "axis": (0, 1, 0)} for _ in range(5)]
    a = chain(*rods, name="rods").build()
    b = replace(a, bodies=tuple(replace(x, mass=1 + apart) if k < many else x for k, x in enumerate(a.bodies)))
    found = mb.explain(a, b, samples=1)
    assert [c.kind for c in found.causes] == (["rounding"] if rounding else ["mass"] * many)
    assert found.explained


@pytest.mark.parametrize(("far", "same"), [(2e-6, True), (1.5e-5, False)])
def test_a_state_keeps_constraints_to_the_digits_of_a_description(far: float, same: bool) -> None:
    model = mb.catalog.four_bar()
    (loop,) = model.loops
    moved = replace(model, loops=(replace(loop, translation_b=loop.translation_b + np.array([far, 0, 0])),))
    with warnings.catch_warnings(action="error"):
        (cause,) = mb.explain(model, moved, samples=1).causes
    assert np.isfinite(cause.effects["accelerations"]) == same


# Engines, of which nothing is known but their answers.


def engine(name: str, base: type[Dynamics] = PinocchioDynamics, **methods: Callable[..., Any]) -> type[Dynamics]:
    """An engine with some methods of its own."""
    return type(name.title(), (base,), {"engine": name, **methods})


def other_engine(change: Callable[[Model], Model]) -> type[Dynamics]:
    """Pinocchio, told something else than it says."""
    inner = cache(lambda model: PinocchioDynamics(change(model)))

    def told(name: str) -> Callable[..., np.ndarray]:
        return lambda self, *x: getattr(inner(self.model), name)(*x)

    return engine("other", **{x: told(x) for x in ("_mass_matrix", "_gravity", "_nle", "_passive")})


@cache
def arm() -> Model:
    rng, links = np.random.default_rng(1), []
    for k, ax in enumerate(np.eye(3)[[2, 1, 0]]):
        d, com, at = rng.uniform(0.01, 0.02, 3), rng.uniform(-0.1, 0.1, 3), rng.uniform(0.1, 0.3, 3)
        body = {"mass": 1.0 + k, "com": com, "inertia": [d[0] + d[1], d[1] + d[2], d[2] + d[0]]}
        links.append(body | {"translation": at, "rpy": (0.1, 0.2, k), "axis": ax, "damping": 0.2})
    return chain(*links, name="arm").build()


@pytest.mark.thorough("armature", "axis sign")
@pytest.mark.parametrize("plant", ["armature", "damping", "gravity", "axis sign", "centre of mass"])
def test_an_engine_that_was_told_something_else(plant: str) -> None:
    _, kind, where = PLANTS[plant](arm())
    b = other_engine(lambda m: PLANTS[plant](m)[0])(arm())
    (cause,) = mb.explain(mb.dynamics(arm()), b).causes
    assert cause.kind == kind
    assert where in str(cause)


def test_engines_that_are_asked_in_another_convention() -> None:
    free = random_tree(2, 3, kinds=("free", "revolute", "revolute"), springs=False, damping=False, armature=False)

    def raw_nle(self: MujocoDynamics, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        self._set(q, v)
        self._velocities()
        return self._force(self._d.qfrc_bias)

    def w_first(self: PinocchioDynamics, q: np.ndarray) -> np.ndarray:
        q = q.copy()
        start = self.model.quaternions[0][0]
        q[..., start : start + 4] = np.roll(q[..., start : start + 4], -1, axis=-1)
        return PinocchioDynamics._full_q(self, q)

    # MuJoCo as it is, with linear velocity in the world's axes; and with forces turned and ω × v forgotten.
    raw = engine("raw", MujocoDynamics, _rotation=lambda *_: np.eye(3), _nle=raw_nle)
    unturned = engine("unturned", MujocoDynamics, _nle=raw_nle)
    base = next(j for j in free.joints if j.kind == "free")
    world = with_joint(free, base.name, rotation=np.eye(3), translation=np.zeros(3))
    for other in (raw, unturned):
        (cause,) = mb.explain(mb.dynamics(world), other(world)).causes
        assert cause.kind == "velocity frame"
    assert "ω × v" in str(cause)
    shuffled = engine("shuffled", _full_q=w_first)
    assert [c.kind for c in mb.explain(mb.dynamics(free), shuffled(free)).causes] == ["quaternion order"]


def scaled_entry(M: np.ndarray, i: int, k: int) -> np.ndarray:
    M = M.copy()
    M[..., i, k] *= 1.1
    if i != k:
        M[..., k, i] *= 1.1
    return M


def differing(gaps: Any, tolerance: float) -> list[str]:
    return [g.term for g in gaps if g.relative > tolerance]


def test_a_term_that_is_not_always_there_is_compared_too() -> None:
    odd = engine("odd", _coriolis_force=lambda self, q, v: 1.1 * (self._nle(q, v) - self._gravity(q)))
    found = mb.explain(mb.dynamics(arm()), odd(arm()))
    assert not found.agree
    assert not found.explained
    assert differing(found.left, found.tolerance) == ["C v"]


def test_a_known_defect_is_the_cause_and_no_defect_is_none() -> None:
    tree = random_tree(4, 3, kinds=("revolute",))
    found = mb.explain(mb.dynamics(tree), mb.dynamics(tree, "mujoco"))
    assert [c.kind for c in found.causes] == ["engine defect"]
    assert "computeKineticEnergy" in str(found.causes[0])
    assert not found.agree
    clean = tree.without("armature")
    assert mb.explain(mb.dynamics(clean), mb.dynamics(clean, "mujoco")).agree


def test_what_nothing_explains_is_narrowed_to_its_joints() -> None:
    def odd(self: PinocchioDynamics, q: np.ndarray) -> np.ndarray:
        M, own = PinocchioDynamics._mass_matrix(self, q), self.model.joint_names
        return scaled_entry(M, own.index("j1"), own.index("j2")) if {"j1", "j2"} <= set(own) else M

    found = mb.explain(mb.dynamics(arm()), engine("odd", _mass_matrix=odd)(arm()))
    assert not found.explained
    assert found.subtree == ("j1", "j2")
    assert "no usual cause" in found.verdict
    assert differing(found.left, found.tolerance) == ["M"]


def test_an_engine_without_a_mass_matrix_is_refused_by_name() -> None:
    def none(*_: Any) -> np.ndarray:
        raise UnsupportedError("forces: no mass matrix")

    forces = engine("forces", _mass_matrix=none)(arm())
    for pair in ((mb.dynamics(arm()), forces), (forces, mb.dynamics(arm()))):
        with pytest.raises(UnsupportedError, match=r"explain: forces: expected the mass matrix of arm.* g, nle"):
            mb.explain(*pair)


def test_an_engine_that_refuses_bodies_without_mass_is_explained_as_far_as_it_goes() -> None:
    """It is wrong in one entry of M, and has no answer where nothing has mass."""

    def picky(self: PinocchioDynamics, q: np.ndarray) -> np.ndarray:
        if not all(b.mass for b in self.model.bodies):
            raise UnsupportedError("picky: a body has no mass")
        return scaled_entry(PinocchioDynamics._mass_matrix(self, q), 0, 0)

    found = mb.explain(engine("picky", _mass_matrix=picky)(arm()), mb.dynamics(arm()))
    assert not found.agree
    assert differing(found.gaps, found.tolerance) == ["M"]


def test_bad_input_is_refused() -> None:
    with pytest.raises(InputError, match="expected a Model"):
        mb.explain("panda", arm())  # type: ignore[arg-type]
    with pytest.raises(InputError, match="samples"):
        mb.explain(arm(), arm(), samples=0)
    unknown = mb.catalog.pendulum(mass=mb.Parameter("m"))
    with pytest.raises(InputError, match="no value for parameter 'm'"):
        mb.explain(unknown, unknown)


# Nothing is said to move as another thing that does not

#: Fields of a description that move nothing: names, where things are drawn, and what the loader says.
SAYS = {"name", "frames", "notes", "nonphysical", "bindings", "source", "drawn_from", "locked", "time", "layout"}


ROD = {"mass": 1.0, "com": (0, 0, -0.5), "inertia": (0.1, 0.1, 0.01), "axis": (0, 1, 0)}


def coupled(ratio: float, offset: float = 0.0) -> Model:
    b = chain(ROD, ROD | {"mass": 2.0, "parent": "world", "translation": (1, 0, 0)}, name="pair")
    b.add_coupler("gear", "j0", "j1", ratio=ratio, offset=offset)
    return b.build()


def test_another_ratio_of_a_coupler_is_another_motion() -> None:
    for other in (coupled(3.0), coupled(2.0, 0.1)):
        found = mb.explain(coupled(2.0), other)
        assert not found.agree
        (cause,) = found.acting
        assert cause.kind == "coupler"
        assert found.explained
    assert "has j0 = 3 j1 for j0 = 2 j1" in repr(mb.explain(coupled(2.0), coupled(3.0)))
    assert mb.explain(coupled(2.0), coupled(2.0)).agree
    assert not mb.explain(coupled(2.0), replace(coupled(2.0), couplers=())).agree
    with pytest.raises(AssertionError, match="coupler 'gear'"):
        assert_same_dynamics(coupled(2.0), coupled(3.0))


def test_what_no_list_of_mistakes_knows_is_no_agreement(monkeypatch: pytest.MonkeyPatch) -> None:
    """The accelerations of the whole systems are compared, whatever parts are looked at one by one."""
    known = tuple(x for x in OTHERS if x not in ("couplers", "prescribed", "loops"))
    monkeypatch.setattr(hypotheses, "OTHERS", known)
    moved = mb.catalog.four_bar()
    (loop,) = moved.loops
    longer = replace(moved, loops=(replace(loop, translation_b=loop.translation_b + np.array([0.01, 0, 0])),))
    for a, b in ((coupled(2.0), coupled(3.0)), (moved, longer), (coupled(2.0), replace(coupled(2.0), couplers=()))):
        found = mb.explain(a, b)
        assert not found.agree
        assert not found.explained
        assert "moves as" not in found.verdict


def test_every_part_that_moves_something_is_compared() -> None:
    assert {f.name for f in fields(Model)} - SAYS == {*OTHERS} - {"frames"} | {"gravity", "joints", "bodies"}
    assert {*described(coupled(2.0))} <= {*SECTIONS}
    for name in ("four_bar", "rolling_disc", "bicycle"):
        assert {*described(mb.catalog.get(name)())} <= {*SECTIONS}
    (change,) = changes(described(coupled(2.0)), described(coupled(3.0)))
    assert change.text == "ratio of coupler gear: 2 → 3"


def test_one_motion_by_two_formulas_is_no_difference() -> None:
    def driven(amplitude: float, phase: float) -> Model:
        b = chain(ROD, {"mass": 1.0, "kind": "prismatic", "axis": (0, 0, 1)})
        b.prescribe("j0", amplitude=amplitude, frequency=3.0, phase=phase)
        return b.build()

    assert mb.explain(driven(1.0, 0.0), driven(-1.0, np.pi)).agree
    assert [c.kind for c in mb.explain(driven(1.0, 0.0), driven(1.0, 0.1)).acting] == ["prescribed motion"]


def test_an_inertia_along_another_axis_is_no_misread_quaternion() -> None:
    """A capsule that lies along y and not along z: no file has a quaternion for that."""
    for moments in ((0.3, 0.3, 0.1), (0.3, 0.25, 0.1)):
        model = hinge(mass=2.0, com=(0.1, 0, 0), inertia=moments, axis=(1, 1, 1)).build()
        x, y, z = moments
        (cause,) = mb.explain(model, with_body(model, "a", inertia=np.diag([x, z, y]))).causes
        assert cause.kind == "inertia axes"
        assert " for [" in cause.says


def test_products_of_inertia_of_the_other_sign_are_named() -> None:
    I = np.array([[0.3, 0.02, 0.03], [0.02, 0.4, 0.01], [0.03, 0.01, 0.35]])
    model, diagonal = hinge(com=(0.1, 0, 0), inertia=I, axis=(1, 1, 1)).build(), np.diag(np.diag(I))
    one = np.where([[0, 1, 0], [1, 0, 0], [0, 0, 0]], -I, I)
    for wrong, says in (
        (2 * diagonal - I, "has the products of inertia with the other sign"),
        (diagonal, "has no products of inertia"),
        (one, "has Ixy with the other sign"),
    ):
        (cause,) = mb.explain(model, with_body(model, "a", inertia=wrong)).causes
        assert cause.kind == "products of inertia"
        assert says in cause.says


def test_a_joint_that_the_other_side_has_not_is_not_held_still() -> None:
    link = {"com": (0, 0, -0.2), "inertia": (1e-2, 1e-2, 1e-3), "axis": (0, 1, 0)}
    links = [link | {"mass": 1.0 - 0.3 * k, "translation": (0, 0, -0.4 * k)} for k in range(3)]
    whole, short = (chain(*links[:n], name="arm").build() for n in (3, 2))
    for a, c, kind, says in ((whole, short, "lost joint", "lacks it"), (short, whole, "added joint", "has it besides")):
        (cause,) = (x for x in mb.explain(a, c).causes if x.subject == "joint 'j2'")
        assert (cause.kind, says in cause.says) == (kind, True)


@pytest.mark.thorough
def test_two_that_cannot_move_are_not_said_to_move_alike() -> None:
    """A loop whose hinge is turned out of the plane of a four-bar is never closed."""
    (loop,) = mb.catalog.four_bar().loops
    tilt = spatial.matrix_from_rpy(0.3, 0.2, 0.1)
    locked = replace(mb.catalog.four_bar(), loops=(replace(loop, kind="revolute", rotation_a=tilt),))
    found = mb.explain(locked, replace(locked, name="other"))
    assert found.agree
    assert not found.compared
    assert "is described as" in found.verdict
    assert "moves as" not in found.verdict


@pytest.mark.thorough("1.0-xzy", "1.3-xzy", "1.3-yzx")
@pytest.mark.parametrize("order", ["xzy", "zxy", "yzx"])
@pytest.mark.parametrize("heavier", [1.0, 1.3])
def test_slides_that_follow_each_other_in_another_order_are_an_order_and_no_exchange_of_names(order, heavier):
    """Translations commute: gymnasium's and dm_control's walkers differ so."""

    def cart(names: str, mass: float) -> Model:
        slides = ({"joint": x, "kind": "prismatic", "axis": np.eye(3)["xyz".index(x)]} for x in names)
        turn = {"axis": (0, 1, 0), "mass": mass, "com": (0.1, 0, 0.2), "inertia": np.eye(3)}
        return chain(*slides, turn, name="cart").build()

    why = mb.explain(cart("xyz", 1.0), cart(order, heavier))
    assert why.agree == (heavier == 1.0)
    kinds = {c.kind for c in why.causes}
    assert kinds <= {"joint order", "mass"}
    assert ("mass" in kinds) == (heavier != 1.0)
    assert why.explained or why.agree
    (told,) = (c for c in why.causes if c.kind == "joint order")
    assert not told.acts


def pushed(joint: str = "j", shift: float = 0.0, formula: Callable[..., Any] | None = None) -> Model:
    """Return two hinges and a fixed tool with forces; frames of the second body drawn `shift` away along its axis."""
    moved = np.array([0.0, shift, 0.0])
    ROD = {"mass": 1.0, "inertia": (0.1, 0.1, 0.01), "axis": (0, 1, 0)}
    b = chain(
        ROD | {"joint": f"{joint}0", "com": (0, 0, -0.5)},
        ROD | {"joint": f"{joint}1", "com": (0, -shift, -0.5), "translation": moved - (0, 0, 1)},
        {"kind": "fixed", "body": "tool", "mass": 0.3, "translation": (0.1, 0, -1) - moved},
        name="pushed",
    )
    b.add_frame("tip", body="tool", translation=(0, 0.2, 0))
    other = ca.SX.sym(f"{joint}1")
    b.add_joint_force("motor", f"{joint}0", formula or (lambda t, q, v: -3 * q * other - v * ca.cos(t)))
    b.add_force("push", "tip", force=(1.0, 0.0, 2.0), axes="local")
    b.add_force("pull", "tool", force=(0.0, 0.0, -1.0), axes="world")
    b.add_bushing("rubber", body_a="world", body_b="b1", translation_b=(0, 0, -0.5) - moved, stiffness=[3.0] * 6)
    b.add_gravity_compensation("tool", 0.5)
    return b.build()


def test_forces_of_other_names_frames_and_formulas_are_the_same() -> None:
    model, sym = pushed(), ca.SX.sym
    for other in (pushed("hinge"), pushed(shift=0.2), pushed("hinge", 0.2)):
        assert mb.explain(model, other).agree
    assert mb.explain(model, pushed(formula=lambda t, q, v: -(v * ca.cos(t) + sym("j1") * 3 * q))).agree
    (cause,) = mb.explain(model, pushed("hinge", formula=lambda t, q, v: -2 * q * sym("hinge1") - v * ca.cos(t))).acting
    assert (cause.kind, cause.subject) == ("force", "force 'motor'")
    # What is zero at t = 0 is told, and a place that is another one.
    assert not mb.explain(model, pushed(formula=lambda t, q, v: -3 * q * sym("j1") - v * (ca.cos(t) + t))).agree
    frame = replace(model.frames[0], translation=np.array([0.1, 0.2, 0]))
    (cause,) = mb.explain(model, replace(model, frames=(frame,))).acting
    assert (cause.subject, cause.says) == (
        "frame 'tip'",
        "frame 'tip': second has translation (0.2, 0.2, -1) for (0.1, 0.2, -1) m",
    )
    with pytest.raises(AssertionError, match="force 'pull'"):
        assert_same_dynamics(model, replace(model, forces=tuple(f for f in model.forces if f.name != "pull")))
    assert mb.explain(mb.dynamics(model, "lagrangian", compile=False), mb.dynamics(model, "pinocchio")).agree
    loses = engine("other", passive=lambda _, *x: PinocchioDynamics(model.without("forces")).passive(*x))
    told = mb.explain(PinocchioDynamics(model), loses(model))
    assert [c.says for c in told.acting] == ["other has no forces"]


@pytest.mark.parametrize("what", ["coupler", "motion", "force"])
def test_what_binds_a_joint_that_one_side_has_alone_goes_with_it(what: str) -> None:
    def arm(**last: Any) -> mb.ModelBuilder:
        return chain(ROD, ROD | {"translation": (0, 0, -1)}, ROD | {"translation": (0, 0, -1)} | last, name="arm")

    b = arm()
    if what == "coupler":
        b.add_coupler("gear", "j2", "j1", ratio=2.0)
    elif what == "motion":
        b.prescribe("j2", amplitude=0.3, frequency=2.0)
    else:
        b.add_joint_force("motor", "j0", lambda _t, q, _v: -q * ca.SX.sym("j2"))
    sides = b.build(), arm(kind="fixed", axis=None).build()
    for a, other in (sides, sides[::-1]):
        (cause,) = mb.explain(a, other).acting
        assert (cause.kind, cause.subject) == ("joint held still", "joint 'j2'")


def rubbing(**numbers: float) -> Model:
    """Return two hinges, both with a friction of 1 and the second with these numbers."""
    b, parent = mb.ModelBuilder("rubbing"), "world"
    for k in range(2):
        b.add_body(f"b{k}", mass=1.0, com=(0.4, 0, 0), inertia=(0.05, 0.05, 0.05))
        place = {"axis": (0, 1, 0), "translation": (0.8 * k, 0, 0), "friction": 1.0}
        b.add_joint(f"j{k}", "revolute", parent=parent, child=f"b{k}", **place, **(numbers if k else {}))
        parent = f"b{k}"
    return b.build()


@pytest.mark.parametrize(
    ("one", "other", "kind", "apart"),
    [
        ({"stiction": 2.0}, {"stiction": 3.0}, "stiction", 1 / 3),
        ({}, {"stiction": 3.0}, "stiction", 2 / 3),
        ({"stiction": 3.0}, {}, "stiction", 2 / 3),
        # At v_s = 2 mm/s it is 1 + 2 e⁻¹ for 1 + 2 e⁻⁴ of 3.
        (
            {"stiction": 3.0, "stribeck_velocity": 1e-3},
            {"stiction": 3.0, "stribeck_velocity": 2e-3},
            "Stribeck velocity",
            2 / 3 * max(np.exp(-0.25) - np.exp(-1), np.exp(-1) - np.exp(-4)),
        ),
    ],
)
def test_friction_at_rest_and_its_curve_are_compared(one, other, kind, apart) -> None:
    found = mb.explain(rubbing(**one), rubbing(**other))
    assert not found.agree
    assert found.explained
    (cause,) = found.causes
    assert (cause.kind, cause.subject) == (kind, "joint 'j1'")
    assert cause.effects["dry friction"] == pytest.approx(apart, rel=1e-12)
    with pytest.raises(AssertionError, match=kind):
        assert_same_dynamics(rubbing(**one), rubbing(**other))
    # A stiction that is the friction is none.
    assert mb.explain(rubbing(stiction=1.0), rubbing()).agree


def changed_fields(part: Any, model: Model) -> Iterator[tuple[str, Any]]:
    """Yield every field of a part with another value; a field that no rule knows is an error."""
    others = {
        "joint": [j.name for j in model.joints],
        "leader": ["j2"],
        "frame": ["b0", "b1"],
        "axes": ["world", "local"],
    }
    others |= dict.fromkeys(("body", "body_a", "body_b", "parent"), tuple(b.name for b in model.bodies))
    for f in fields(part):
        x = getattr(part, f.name)
        if f.name.startswith("rotation"):
            yield f.name, x @ TURN
        elif f.name in others and isinstance(x, str):
            yield f.name, next(y for y in others[f.name] if y not in (x, getattr(part, "child", "")))
        elif isinstance(x, (float, np.ndarray)):
            known = np.isfinite(x)
            yield f.name, np.where(known, 1.1 * np.where(known, x, 0) + 0.05 * (x == 0), 4.0)
        elif isinstance(x, Formula):
            twice = ("twice", (x.outputs[0],), 0.0)
            yield f.name, replace(x, operations=(*x.operations, twice), outputs=(len(x.operations), *x.outputs[1:]))
        elif isinstance(x, Mimic):
            yield from ((f.name, replace(x, **{n: y})) for n, y in changed_fields(x, model))
        elif f.name in ("joints", "without", "leader"):
            yield f.name, (*x, "j2")[-len(x or "1") :]
        else:
            assert f.name in ("name", "kind", "child", "symbols") or x is None, f.name


@pytest.mark.thorough(every=3)
@pytest.mark.parametrize("name", [*EXAMPLES, *TYPES])
def test_each_field_of_each_kind_of_part_is_a_difference_that_makes_the_other(name: str) -> None:
    """With all differences applied, one description is the other: to the last field, whatever it does."""
    model = example(name).model
    if not model.has_bodies:
        return
    with unchecked():
        near, one = Tolerances.of(model, 1e-9), merge(model)
        assert not hypotheses.differences(one, one, near)
        parts = [(kind, p) for kind in OTHERS for p in getattr(one.model, kind)]
        parts += [("joints", p) for p in one.model.joints if p.name == "x"] + [("bodies", one.model.bodies[-1])]
        for kind, part in parts:
            for field, value in changed_fields(part, one.model):
                new = tuple(replace(part, **{field: value}) if p is part else p for p in getattr(one.model, kind))
                other = replace(merge(model), model=replace(one.model, **{kind: new}))
                changed = one
                for h in hypotheses.differences(one, other, near):
                    changed = h.apply(changed)
                    assert h.says
                if changed.model != other.model:
                    # A spring that is not there has no rest, and a point no axes.
                    loose = kind == "joints" and field == "rest" and not part.stiffness.any()
                    assert loose or (field.startswith("rotation") and part.kind in ("point", "distance")), field
                    assert changed is one


ARM = (
    '<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body name="b"><joint name="j" '
    'axis="0 1 0"/><geom size="0.1" pos="0.2 0 0"/></body></worldbody><actuator><position name="servo" joint="j" '
    'kp="100" kv="9"/></actuator></mujoco>'
)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("0.002", "0.01", "beside the terms: timestep 0.002 → 0.01"),
        ("implicitfast", "Euler", "integrator implicitfast → euler"),
        ('kp="100"', 'kp="80"', "gainprm of actuator servo 100 → 80"),
        ('kp="100"', 'kp="100" forcerange="-1 1"', "forcerange of actuator servo 0 → -1 1"),
        ('0.1"', '0.1" friction="0.5"', "friction of geom 0 1 0.005 0.0001 → 0.5 0.005 0.0001"),
        ('name="j"', 'name="j" range="-1 1" limited="true"', "limited of jnt j 0 → 1"),
        ("<worldbody>", '<contact><exclude body1="world" body2="b"/></contact><worldbody>', "exclusions of contact"),
    ],
)
def test_files_that_mujoco_runs_otherwise_are_told_apart(old, new, told, tmp_path):
    """Time step, integrator and servo decide the motion of 0.3 s, by bare MuJoCo, where all terms are the same."""
    paths = [tmp_path / "a.xml", tmp_path / "b.xml", tmp_path / "same.xml"]
    for path, text in zip(paths, (ARM, ARM.replace(old, new, 1), ARM), strict=True):
        path.write_text(text, encoding="utf-8")
    shown = CliRunner().invoke(cli, ["diff", *map(str, paths[:2])])
    first = " ".join(shown.output.split("\n\n")[0].split())
    assert first.startswith("✗ a.xml and b.xml: b.xml has the terms of a.xml (to 0.0e+00)")
    assert told in first
    assert shown.exit_code == 1
    assert json.loads(CliRunner().invoke(cli, ["diff", *map(str, paths[:2]), "--json"]).stdout)["agree"] is False
    same = CliRunner().invoke(cli, ["diff", str(paths[0]), str(paths[2])])
    assert same.exit_code == 0
    assert "beside" not in same.output
    if old in ("0.002", "implicitfast", 'kp="100"') and "forcerange" not in new:
        ends = []
        for path in paths[:2]:
            m = mujoco.MjModel.from_xml_path(str(path))
            d = mujoco.MjData(m)
            d.ctrl[:] = 1.0
            while d.time < 0.3 - 1e-9:
                mujoco.mj_step(m, d)
            ends.append(d.qpos[0])
        assert abs(ends[1] - ends[0]) > 1e-6


def test_what_a_file_of_another_format_cannot_hold_is_not_compared(tmp_path):
    (tmp_path / "a.xml").write_text(ARM, encoding="utf-8")
    model = mb.load(tmp_path / "a.xml").without("limits")
    (tmp_path / "a.urdf").write_text(mb.convert(model, "urdf").text, encoding="utf-8")
    shown = CliRunner().invoke(cli, ["diff", str(tmp_path / "a.xml"), str(tmp_path / "a.urdf")])
    first = " ".join(shown.output.split("\n\n")[0].split())
    assert "not compared: options of simulation, servos, force ranges, contacts, limits of a.xml" in first


@pytest.mark.parametrize("more", [False, True])
def test_a_body_behind_a_joint_of_one_side_alone_does_not_stand_still(more: bool) -> None:
    def built(base: float, second: bool) -> Model:
        b = mb.ModelBuilder("robot")
        if base:
            b.add_body("base", mass=base)
            b.add_joint("weld", "fixed", parent="world", child="base")
        for name in ["first", "second"][: 1 + second]:
            b.add_body(f"{name} link", mass=1.2, com=(0.1, 0, 0), inertia=(0.1, 0.1, 0.1))
            b.add_joint(name, "revolute", parent="world", child=f"{name} link", axis=(0, 1, 0))
        return b.build()

    found = mb.explain(built(3.0, False), built(0.0, more), names=("first", "second"))
    (base,) = (c for c in found.causes if c.kind == "base mass")
    assert (base.a, base.b) == (3.0, 0.0)
    assert "no mass in what stands still, where first has 3 kg" in str(base)
    assert not any(c.kind == "base mass" for c in mb.explain(built(3.0, False), built(3.0, more)).causes)
