"""The rules of numbers: each field of a part has one, and all that reads them agrees with closed forms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from typing import Annotated, get_args, get_type_hints

import casadi as ca
import numpy as np
import pytest

import mbkit as mb
from mbkit._check import Array
from mbkit.errors import InputError, ModelError
from mbkit.model.changes.freeing import numbers_of
from mbkit.model.description import Description
from mbkit.model.elements.formula import Formula
from mbkit.model.elements.kinds import PART_KINDS
from mbkit.model.elements.references import KINDS_OF_PARTS
from mbkit.model.parts import Mimic, NumberRule, _Frozen, acting, numbers, rules_of
from tests.kind_examples import EXAMPLES

#: Gravity, m/s², along -z.
G = 9.81


def example(name: str) -> mb.Model:
    """Return a new model, which has not yet said what acts in it."""
    return EXAMPLES[name](name).model


def accelerations(dyn: mb.Dynamics, names: tuple[str, ...], closed: bool) -> np.ndarray:
    """Return the acceleration at one state, or M and h where constraints leave a state no freedom, by joint."""
    dyn = dyn.at(t=0.3) if dyn.model.time_parameter else dyn
    order = [dyn.model.velocity_names.index(n) for n in names]
    x, v, tau = np.zeros((3, dyn.model.nv))
    x[order], v[order], tau[order] = 0.1 * np.arange(1, 1 + len(x)), 0.2 + 0.1 * np.arange(len(x)), 0.3
    q = dyn.model.integrate(dyn.model.neutral(), x)
    if closed:
        return np.vstack([dyn.mass_matrix(q)[np.ix_(order, order)], dyn.nle(q, v)[order], dyn.passive(q, v)[order]])
    return dyn.forward_dynamics(q, v, tau)[order]


def classes_of_parts() -> set[type]:
    hints = get_type_hints(Description)
    named = {x for section in KINDS_OF_PARTS for x in get_args(hints[section])[:1]}
    each = {x for kind in named for x in (get_args(kind) or (kind,))}
    every = {s for c in each for d in (c, *c.__subclasses__()) for s in (d, *d.__subclasses__())}
    return {c for c in every if is_dataclass(c)} | {Mimic}


def test_each_field_of_a_part_is_a_name_or_has_a_rule() -> None:
    assert {c.__name__ for c in classes_of_parts()} >= {"Joint", "SplineMotion", "Bushing", "GravityCompensation"}
    for cls in classes_of_parts():
        hints = get_type_hints(cls)
        others = {f.name for f in fields(cls)} - {*rules_of(cls)}
        for name in others:
            kinds = {*get_args(hints[name]), hints[name]} if get_args(hints[name]) else {hints[name]}
            assert kinds & {str, Formula, Mimic, tuple[str, ...]}, (cls, name)


def test_another_number_acts_where_one_is_not_given() -> None:
    """Without stiction friction holds what rests, and no curve falls."""
    without, given = example("joint.friction").joints[-1], example("joint.stiction").joints[-1]
    assert (without.stiction, without.stribeck_velocity) == (None, None)
    assert acting(without, "stiction").tolist() == acting(without, "friction").tolist() == without.friction.tolist()
    assert acting(without, "stribeck_velocity").tolist() == [0.0]
    assert acting(given, "stiction").tolist() == given.stiction.tolist() != given.friction.tolist()
    assert acting(given, "stribeck_velocity").tolist() == given.stribeck_velocity.tolist()
    assert acting(given, "mimic") is None


def test_a_field_without_a_rule_is_refused_by_name() -> None:
    @dataclass(frozen=True, eq=False)
    class Torsion(_Frozen):
        name: str
        stiffness: Annotated[float, NumberRule("N m/rad", least=0.0)]
        hardening: float

    @dataclass(frozen=True, eq=False)
    class Table(_Frozen):
        name: str
        numbers: Array | None

    Torsion.__annotations__, Table.__annotations__ = (
        {"name": str, "stiffness": Annotated[float, NumberRule()], "hardening": float},
        {"name": str, "numbers": Array | None},
    )
    with pytest.raises(TypeError, match=r"Torsion\.hardening: numbers without a NumberRule"):
        Torsion("x", 1.0, 2.0)
    with pytest.raises(TypeError, match=r"Table\.numbers"):
        Table("x", None)


@pytest.mark.thorough(every=5)
@pytest.mark.parametrize("name", [n for n in EXAMPLES if n != "energies" and not n.startswith("written.")])
def test_a_number_of_each_kind_may_be_free(name: str) -> None:
    """With other values the freed model is the one that has them as plain numbers."""
    model = example(name)
    free = model.with_free(*(x.path for x in numbers_of(model) if x.value))
    # Six numbers of an inertia stand in nine entries.
    bound = {(b.where, b.part, b.field) for b in free.bindings}
    own = ((k, p, n, rule, x) for k in KINDS_OF_PARTS for p in getattr(model, k) for n, rule, x in numbers(p))
    assert bound - {("gravity", "", "gravity")} == {
        (k, p.name, n) for k, p, n, rule, x in own if not rule.fixed and np.any(x) and getattr(p, "body", "") != "x"
    }
    values = {n: 1.03 * x for n, x in free.parameters.items() if n != free.time_parameter}
    plain = free.with_parameters(**values)
    at, exact = (mb.dynamics(m, "lagrangian", compile=False) for m in (free, plain))
    closed, names = model.constrained, model.velocity_names
    given, wanted = accelerations(at.at(**values), names, closed), accelerations(exact, names, closed)
    assert np.abs(given - wanted).max() < 1e-12 * np.abs(wanted).max()
    before = accelerations(at, names, closed)
    assert np.abs(before - wanted).max() > 1e-4 * np.abs(wanted).max()


def link(kind: str = "revolute", axis: tuple[float, ...] = (0, 1, 0)) -> mb.ModelBuilder:
    """Return a link of 2 kg, whose centre of mass is 0.5 m below its hinge."""
    b = mb.ModelBuilder("one", gravity=(0, 0, -G))
    b.add_body("link", mass=2.0, com=(0, 0, -0.5), inertia=(0.1, 0.1, 0.1))
    b.add_joint("j", kind, parent="world", child="link", axis=axis)
    return b


def bushing(b: mb.ModelBuilder) -> None:
    b.add_bushing("mount", body_a="world", body_b="link", stiffness=np.diag([7.0] * 6), damping=0.5)


def forced(b: mb.ModelBuilder) -> None:
    q, k = ca.SX.sym("q"), ca.SX.sym("k")
    b.add_joint_force("f", "j", -k * q**3, parameters={"k": 4.0})


@pytest.mark.parametrize(
    ("kind", "add", "path", "torque"),
    [
        # Of a slide along x: force for q = 0.3 and q' = 0.2 at rest's acceleration.
        ("prismatic", bushing, "mount.stiffness.x", lambda x: x * 0.3 + 0.5 * 0.2),
        ("prismatic", bushing, "mount.damping.x", lambda x: 7.0 * 0.3 + x * 0.2),
        ("prismatic", bushing, "mount.stiffness.x.y", lambda _: 7.0 * 0.3 + 0.5 * 0.2),
        ("prismatic", forced, "f.k", lambda x: x * 0.3**3),
        (
            *("prismatic", lambda b: b.add_coupling("tendon", {"j": 1.5}, stiffness=3.0), "tendon.factors.j"),
            lambda x: 3.0 * x**2 * 0.3,
        ),
        (
            *("revolute", lambda b: b.add_gravity_compensation("link", 0.4), "gravity compensation of link.fraction"),
            lambda x: (1 - x) * 2.0 * G * 0.5 * np.sin(0.3),
        ),
    ],
)
def test_freed_numbers_of_forces_act_as_their_formulas_say(
    kind: str, add: Callable[[mb.ModelBuilder], None], path: str, torque: Callable[[float], float]
) -> None:
    b = link(kind, axis=(1, 0, 0) if kind == "prismatic" else (0, 1, 0))
    add(b)
    free = b.build().with_free(path)
    assert list(free.parameters) == [path]
    dyn = mb.dynamics(free, "lagrangian", compile=False)
    for x in (0.5, 2.0):
        (tau,) = dyn.at(**{path: x}).inverse_dynamics([0.3], [0.2], [0.0])
        assert tau == pytest.approx(torque(x), rel=1e-13)
        # Engines with plain numbers have the same.
        (tau,) = mb.dynamics(free.with_parameters(**{path: x}), "pinocchio").inverse_dynamics([0.3], [0.2], [0.0])
        assert tau == pytest.approx(torque(x), rel=1e-13)


def test_freed_numbers_of_curves_and_laws_move_joints_as_their_formulas_say() -> None:
    b = link()
    b.add_body("other", mass=1.0, com=(0.1, 0, 0), inertia=(0.1, 0.1, 0.1))
    b.add_joint("k", "revolute", parent="world", child="other", axis=(0, 1, 0))
    b.add_coupler("gear", "k", "j", ratio=0.5, curve=(0.3, 0.0, 0.0))
    t, w, a = (ca.SX.sym(x) for x in ("t", "w", "a"))
    b.prescribe("j", a * ca.sin(w * t), parameters={"a": 0.4, "w": 1.0})
    free = b.build().with_free("gear.curve.2", "j.w")
    assert {*free.parameters} == {"gear.curve.2", "j.w", "t"}
    dyn = mb.dynamics(free, "lagrangian", compile=False)
    for c, w, t in ((0.7, 2.0, 0.3), (-0.4, 1.5, 0.9)):
        q, v, wanted = 0.4 * np.sin(w * t), 0.4 * w * np.cos(w * t), -0.4 * w**2 * np.sin(w * t)
        own = dyn.at(**{"gear.curve.2": c, "j.w": w, "t": t})
        got = own.forward_dynamics([q, 0.5 * q + c * q**2], [v, (0.5 + 2 * c * q) * v], [0.0, 0.0])
        assert got == pytest.approx([wanted, (0.5 + 2 * c * q) * wanted + 2 * c * v**2], rel=1e-11)


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("link.rotation", "did you mean|no number"),
        ("j.axes", "axes cannot be free: orientations and axes are no parameters"),
        ("j.stribeck_velocity", "stribeck_velocity cannot be free: Stribeck's curve is a number in every engine"),
        ("*.effort_limit", "effort_limit cannot be free: it is data"),
        ("tip.translation", "translation cannot be free: set_frame takes a Parameter"),
        ("spot.speed", "fits no number"),
        ("gravity compensation of rotor.fraction", "fits no number"),
    ],
)
def test_numbers_that_cannot_be_free_are_refused_by_name(path: str, words: str) -> None:
    b = link("free", axis=None)
    b.add_frame("tip", body="link")
    b.add_rolling("spot", "sphere", body_a="link", radius=0.5)
    b.add_body("rotor", mass=0.3, inertia=0.3 * np.eye(3))
    b.add_joint("to_rotor", "fixed", parent="link", child="rotor")
    b.add_gravity_compensation("rotor", 1.0)
    with pytest.raises(InputError, match=words):
        b.build().with_free(path)


def test_variants_reach_all_numbers_of_a_name() -> None:
    b = link()
    bushing(b)
    b.add_coupling("tendon", {"j": 1.5}, stiffness=3.0, rest_length=0.1)
    forced(b)
    model = b.build()
    many = mb.variants(model, {"*.stiffness": 0.1, "f.k": (1.0, 2.0)}, size=4)
    assert {*many.values} == {
        *(f"mount.stiffness.{x}" for x in ("x", "y", "z", "rx", "ry", "rz")),
        "f.k",
        "tendon.stiffness",
    }
    # A coupling may be at rest at any length, and its own is no distance.
    ends = mb.variants(model, {"tendon.rest_length": (-0.2, 0.3)}, size=50).values["tendon.rest_length"]
    assert ends.min() < 0 < ends.max()
    with pytest.raises(InputError, match="'mount' has a stiffness that drives the motion in"):
        mb.variants(model, {"mount.stiffness.x.ry": (8.0, 9.0)}, size=4)
    with pytest.raises(InputError, match="'mount' has a damping that drives the motion in"):
        mb.variants(model, {"mount.damping.z": (-1.0, -0.5)}, size=4)


def test_least_values_hold_of_each_part() -> None:
    b = link()
    b.add_coupling("tendon", {"j": 1.0}, stiffness=-3.0, rest_length=-0.1, armature=-1.0)
    b.add_spring("cord", body_a="world", body_b="link", stiffness=1.0, rest_length=-0.2)
    b.set_joint("j", damping=-0.1, stiction=-0.5, friction=0.0)
    with pytest.raises(ModelError) as told:
        b.build()
    text = str(told.value)
    for fault in (
        "coupling 'tendon': stiffness -3",
        "armature -1",
        "spring 'cord': rest_length -0.2",
        "joint 'j': damping",
    ):
        assert fault in text
    assert "joint 'j': stiction [-0.5] is negative" in text
    assert "'tendon': rest_length" not in text


def test_a_curve_that_a_parameter_may_bend_is_a_curve() -> None:
    b = link()
    b.add_body("other", mass=1.0, inertia=(0.1, 0.1, 0.1))
    b.add_joint("k", "revolute", parent="world", child="other", axis=(0, 1, 0))
    b.add_coupler("gear", "k", "j", ratio=0.5, curve=(mb.Parameter("c", 0.0), 0.0, 0.0))
    assert b.build().acts["coupler.curve"] == ("gear",)
    assert PART_KINDS["coupler.curve"].numbers == frozenset()


def test_a_bushing_that_a_parameter_may_damp_loses_energy() -> None:
    def mounted(damping: object) -> mb.Model:
        b = link("prismatic", axis=(1, 0, 0))
        b.add_bushing("mount", body_a="world", body_b="link", stiffness=7.0, damping=damping)
        return b.build()

    assert mounted([mb.Parameter("d", 0.0)] + [0.0] * 5).loses_energy
    assert not mounted(0.0).loses_energy
