"""Descriptions: frozen, checked at once, and at home on their manifold."""

from __future__ import annotations

import importlib
import inspect
import math
import pickle
import warnings
from collections.abc import Callable
from dataclasses import FrozenInstanceError, fields, replace
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mbkit as mb
from mbkit.engines import ENGINES
from mbkit.errors import InputError, MbkitError, ModelError, NonPhysicalWarning, UnknownNameError
from mbkit.model import KINDS, Mimic
from mbkit.model.manifold import unit_quaternions
from mbkit.model.model import unchecked
from mbkit.model.validation import idle_joints, sample_mass_matrix
from tests.random_trees import off, random_tree, states
from tests.scenes import chain, hinge

I3 = (1.0, 1.0, 1.0)


def pendulum(**joint):
    bob = {"body": "bob", "joint": "hinge", "mass": 1.0, "com": (0, 0, -1), "axis": (0, 1, 0)}
    return chain(bob | joint, name="pendulum")


# Arguments


class Rude:
    """Raises whatever is asked of it."""

    def __getattr__(self, name):
        raise RuntimeError(name)

    __float__ = __repr__ = __str__ = __iter__ = __len__ = __array__ = lambda *_: 1 / 0


def nested(depth):
    out = []
    for _ in range(depth):
        out = [out]
    return out


HOSTILE = [
    *(10**400, -(10**400), Decimal("1e500"), Decimal("sNaN"), Fraction(10**400, 3), 1j, None, True, int, {}, [], {1}),
    *({"j": 10**400}, {"j": None}, {1: 1.0}, {None: 1.0}, {"\ud800": 1.0}, {"j": mb.Parameter("p")}, {"k": 1.0}),
    *({"j": 1e200}, {"j": [1.0, 2.0]}, {"j": True}, {("j",): 1.0}, dict.fromkeys(range(1000), 1.0)),
    *([[1, [2]]], nested(10_000), b"1", bytearray(b"1"), math.nan, math.inf, 1e200, [1e160] * 3, "\ud800", "a\0b", ""),
    *(np.zeros((2, 2)), np.array([10**400, 1, 2], dtype=object), np.array([1j, 0, 0]), np.array(["a", "b", "c"])),
    *(np.array([True, False, True]), np.arange(3).astype(">f8"), Rude(), "x" * 100_000, mb.Parameter("p")),
    *(mb.Parameter("p", 1e300), np.datetime64("2020"), mb.Parameter("p", 1e200) * 1e100),
    *(np.complex128(1 + 1j), np.array(1 + 1j)),
]
METHODS = {
    "__init__": {"name": "m"},
    "add_body": {"name": "b", "mass": 1.0, "com": (0, 0, 1)},
    "add_joint": {"name": "j", "kind": "revolute", "parent": "world", "child": "b", "axis": (0, 1, 0)},
    "add_frame": {"name": "f", "body": "b"},
    "add_spring": {"name": "s", "body_a": "b", "body_b": "world", "stiffness": 1.0},
    "add_coupling": {"name": "c", "factors": {"j": 1.0}, "stiffness": 1.0},
    "add_loop": {"name": "l", "kind": "point", "body_a": "b", "body_b": "world"},
    "prescribe": {"joint": "j"},
    "add_joint_force": {"name": "u", "joint": "j", "force": 1.0},
    "add_force": {"name": "w", "frame": "b", "force": (1.0, 0, 0)},
    "add_gravity_compensation": {"body": "b"},
    "add_bushing": {"name": "g", "body_a": "b", "body_b": "world", "stiffness": 1.0},
    "note": {"text": "words"},
    "build": {},
}
PLACES = [(m, a) for m in METHODS for a in inspect.signature(getattr(mb.ModelBuilder, m)).parameters if a != "self"]


def built_or_refused(wrong):
    def arguments(method):
        return METHODS[method] | {a: x for (m, a), x in wrong.items() if m == method}

    try:
        b = mb.ModelBuilder(**arguments("__init__"))
        for method in list(METHODS)[1:-1]:
            getattr(b, method)(**arguments(method))
        model = b.build(**arguments("build"))
    except (ModelError, InputError) as error:
        message = str(error)
        assert len(message) < 10_000
        message.encode()
    else:
        assert len(model.digest) == 64
        assert np.isfinite(sample_mass_matrix(model)).all() or model.parameters


@given(wrong=st.dictionaries(st.sampled_from(PLACES), st.sampled_from(HOSTILE), min_size=2, max_size=3))
@settings(max_examples=60)
def test_whatever_a_builder_is_given_is_built_or_refused_by_name(wrong):
    built_or_refused(wrong)


@pytest.mark.thorough(every=6)
@pytest.mark.parametrize("method", METHODS)
def test_each_argument_of_a_builder_is_built_or_refused_by_name(method):
    for place in (p for p in PLACES if p[0] == method):
        for value in HOSTILE:
            built_or_refused({place: value})


@pytest.mark.parametrize("value", [np.complex128(1 + 1j), np.complex64(2), np.array(1 + 1j)])
def test_a_complex_number_is_not_cut_to_its_real_part(value):
    b = pendulum()
    body_c(mass=value)(b)
    with pytest.raises(ModelError, match="body 'c': mass"):
        b.build()


def test_numbers_whose_mass_matrix_overflows_are_refused_by_name():
    b = pendulum()
    b.add_body("far", mass=1.0, com=(1e160, 0, 0))
    b.add_joint("arm", "revolute", parent="bob", child="far", axis=(0, 1, 0))
    with pytest.raises(ModelError, match="'far': com"):
        b.build()
    heavy = pendulum().build()
    heavy = replace(heavy, bodies=(replace(heavy.bodies[0], mass=1e300, com=np.array([1e10, 0, 0])),))
    with pytest.raises(InputError, match="hinge"):
        idle_joints(heavy)


# The manifold


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_difference_undoes_integrate(seed):
    model = random_tree(seed % 7, 10, springs=False)
    rng = np.random.default_rng(seed)
    q, dq = model.random_state(rng, 3)
    # Rotations come back whole up to half a turn.
    dq *= 0.9
    for joint in model.independent_joints:
        if joint.type.quaternion is not None:
            w = slice(model.layout.v[joint.name].stop - 3, model.layout.v[joint.name].stop)
            dq[:, w] *= np.minimum(1, 3.0 / np.linalg.norm(dq[:, w], axis=1, keepdims=True))
    moved = model.integrate(q, dq)
    assert off(model.difference(q, moved), dq) < 1e-14
    model.check_q(moved)


def test_integrate_is_the_flow_of_constant_velocity():
    """Steps along one twist add up: exp((s + t) ξ) = exp(s ξ) exp(t ξ); it starts off along D v."""
    model = random_tree(1, 6, ("free", "ball", "planar", "revolute", "universal"))
    q, v, _, _ = states(model, 5)
    twice = model.integrate(model.integrate(q, 0.3 * v), 0.7 * v)
    assert off(model.difference(model.integrate(q, v), twice), 0 * v) < 1e-14
    h = 1e-6
    rate = (model.integrate(q, h * v) - model.integrate(q, -h * v)) / (2 * h)
    for joint in model.independent_joints:
        iq, iv = model.layout.q[joint.name], model.layout.v[joint.name]
        for one, at, along in zip(rate, q, v, strict=True):
            assert np.allclose(one[iq], joint.type.qdot(list(at[iq]), list(along[iv])), atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-160, 1e-12, 1e-8, 9.99e-3, 1.001e-2, 0.0999, 0.1001, 1.0, 3.1415])
def test_exponentials_keep_their_digits_at_every_size(angle):
    model = chain({"kind": "free", "mass": 1.0, "inertia": I3}).build()
    dq = np.array([0.3, -0.2, 0.5, *(angle * np.array([0.6, -0.48, 0.64]))])
    back = model.difference(model.neutral(), model.integrate(model.neutral(), dq))
    assert np.allclose(back, dq, rtol=3e-15, atol=3e-16)
    assert np.allclose(back[3:], dq[3:], rtol=3e-14, atol=0)


def test_random_states_keep_to_the_limits_and_fill_them():
    swing = {"mass": 1.0, "com": (0, 0, -1), "axis": (0, 1, 0), "lower": -0.5, "upper": 7.0}
    slide = {"mass": 1.0, "kind": "prismatic", "axis": (1, 0, 0)}
    wound = {"mass": 1.0, "com": (0, 1, 0), "axis": (1, 0, 0), "lower": 4.0, "upper": 9.0}
    q, v = chain(swing, slide, wound).build().random_state(np.random.default_rng(0), 4000)
    assert -0.5 <= q[:, 0].min() < -0.49
    assert np.pi - 0.01 < q[:, 0].max() <= np.pi
    assert -1 <= q[:, 1].min() < -0.99
    assert 0.99 < q[:, 1].max() <= 1
    # A range that lies beyond the clip is kept as it is.
    assert 4.0 <= q[:, 2].min() < q[:, 2].max() <= 9.0
    assert abs(v.mean()) < 0.05
    assert abs(v.std() - 1) < 0.05


@pytest.mark.parametrize(
    ("lower", "upper"),
    [(5.0, None), (None, -5.0), (5.0, 30.0), (-30.0, -5.0), (7.0, 1e308), (-1e308, -9.0), (1e300, 1e301), (2.0, 2.0)],
)
def test_limits_far_from_zero_are_kept(lower, upper):
    model = hinge(kind="prismatic", lower=lower, upper=upper).build()
    q, _ = model.random_state(np.random.default_rng(0), 100)
    assert (q >= model.lower).all()
    assert (q <= model.upper).all()
    near = lower if lower is not None and lower > 0 else upper
    assert (np.abs(q - near) <= 2 * np.pi + abs(near) * 1e-12).all()


def test_limits_of_a_follower_bound_its_leader():
    b = pendulum(lower=-1.0, upper=1.0)
    joint_k(mimic=("hinge", -2.0, 0.5), lower=0.1, upper=0.9)(b)
    model = b.build()
    q, _ = model.random_state(np.random.default_rng(0), 500)
    y = model.layout.expand_q(q)[:, 1]
    assert 0.1 <= y.min() < 0.11
    assert 0.89 < y.max() <= 0.9


def test_random_states_repeat_and_have_the_asked_shape():
    model = random_tree(0, 10)
    for size, lead in ((None, ()), (0, (0,)), (3, (3,))):
        q, v = model.random_state(np.random.default_rng(5), size)
        assert q.shape == (*lead, model.nq)
        assert v.shape == (*lead, model.nv)
    first, again = (model.random_state(np.random.default_rng(5), 3) for _ in range(2))
    assert np.array_equal(first[0], again[0])
    assert np.array_equal(model.random_state(5, 3)[0], first[0]), "a seed stands for its generator"
    for wrong in (None, -1, 1.0, "five", True):
        with pytest.raises(InputError, match="rng"):
            model.random_state(wrong)
    with pytest.raises(InputError, match="size"):
        model.random_state(np.random.default_rng(0), -1)


# Frozen data


def test_quaternions_of_a_batch_are_scaled_as_those_of_each_state():
    model = random_tree(0, 4, ("ball", "revolute", "free"))
    q = 3.0 * model.random_state(np.random.default_rng(0), 6)[0].reshape(2, 3, -1)
    unit, lengths = unit_quaternions(model, q)
    model.check_q(unit.reshape(6, -1))
    assert lengths.shape == (2, 3, len(model.quaternions))
    for i in np.ndindex(2, 3):
        one, own = unit_quaternions(model, q[i])
        np.testing.assert_allclose(unit[i], one, rtol=4e-16)
        np.testing.assert_allclose(lengths[i], own, rtol=4e-16)
    assert unit_quaternions(pendulum().build(), np.zeros((5, 1)))[1].shape == (5, 0)


def test_a_model_is_frozen_and_survives_pickling_and_comparison():
    model = random_tree(4, 10, mimic=True)
    copy = pickle.loads(pickle.dumps(model))
    assert copy == model
    assert hash(copy) == hash(model)
    assert copy.digest == model.digest
    assert copy.joints[0] == model.joints[0]
    with pytest.raises(FrozenInstanceError):
        model.name = "other"
    assert model.bodies[0] == replace(model.bodies[0], com=model.bodies[0].com + 0.0)
    assert Mimic("j", 1, 0) == Mimic("j", 1.0, -0.0)
    assert hash(Mimic("j", 1, 0)) == hash(Mimic("j", 1.0, -0.0))
    for array in (model.lower, model.upper, model.layout.G, model.layout.G_q, model.layout.offsets):
        if array.size:
            with pytest.raises(ValueError, match="read-only"):
                array.flat[0] = 1.0
    for array in (copy.gravity, copy.bodies[0].com, copy.joints[0].rotation):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


@pytest.mark.parametrize("part", ["bodies", "joints", "springs", "frames"])
def test_the_digest_changes_with_every_number(part):
    model = random_tree(4, 10, mimic=True)
    digests = {model.digest}
    for k, thing in enumerate(getattr(model, part)):
        for f in fields(thing):
            value = getattr(thing, f.name)
            if isinstance(value, np.ndarray) and value.size:
                changed = value.copy()
                first = changed.flat[0]
                changed.flat[0] = 7.0 if np.isinf(first) else np.nextafter(first, 9)
            elif isinstance(value, float):
                changed = float(np.nextafter(value, 9))
            elif isinstance(value, Mimic):
                changed = Mimic(value.joint, value.ratio, value.offset + 1)
            else:
                continue
            things = list(getattr(model, part))
            things[k] = replace(thing, **{f.name: changed})
            # Some numbers have no business on some joints; a digest has them all the same.
            with unchecked():
                new = replace(model, **{part: tuple(things)}).digest
            assert new not in digests, (thing.name, f.name)
            digests.add(new)
    assert replace(model, gravity=model.gravity + 1e-9).digest != model.digest
    assert replace(model, notes=("read me",)).digest == model.digest


def test_needs_are_read_off_the_description():
    bare = pendulum().build()
    assert [k for k, on in bare.needs.as_dict().items() if on] == ["gravity"]
    assert pendulum(friction=1.0).build().needs.friction
    assert pendulum(lower=-1.0).build().needs.limits
    assert random_tree(0, 4, ("ball", "revolute")).needs.quaternions
    pushed = pendulum(effort_limit=5.0).build()
    assert pushed.needs.effort_limits
    assert not pushed.without("limits").needs.effort_limits
    timed = pendulum()
    timed.prescribe("hinge", amplitude=0.1, frequency=2.0)
    assert timed.build().needs.time


# Mimic joints


def test_chains_of_mimics_are_resolved_to_free_joints():
    b = pendulum()
    for i, (leader, ratio, offset) in enumerate((("hinge", 2.0, 0.1), ("m0", -3.0, 0.5), ("m1", 0.5, 0.0))):
        b.add_body(f"c{i}", mass=1.0, com=(0, 0, -1))
        b.add_joint(f"m{i}", "revolute", parent="bob", child=f"c{i}", axis=(0, 1, 0), mimic=(leader, ratio, offset))
    model = b.build()
    assert model.nq == 1
    q = 0.7
    y0 = 2 * q + 0.1
    y1 = -3 * y0 + 0.5
    assert model.layout.expand_q(np.array([q])) == pytest.approx([q, y0, y1, 0.5 * y1])
    assert model.layout.expand_v(np.array([1.0])) == pytest.approx([1, 2, -6, -3])


# The builder's checks


def cycle(b):
    b.add_body("c", mass=1.0, inertia=I3)
    b.add_body("d", mass=1.0, inertia=I3)
    b.add_joint("k", "ball", parent="c", child="d")
    b.add_joint("l", "ball", parent="d", child="c")


def body_c(**kwargs):
    def change(b):
        b.add_body("c", **kwargs)
        b.add_joint("k", "revolute", parent="bob", child="c", axis=(1, 0, 0))

    return change


def joint_k(kind="revolute", parent="bob", **kwargs):
    def change(b):
        b.add_body("c", mass=1.0, com=(0, 1, 1), inertia=I3)
        if KINDS.get(kind) and KINDS[kind].n_axes and "axis" not in kwargs:
            kwargs["axis"] = (1, 0, 0)
        b.add_joint("k", kind, parent=parent, child="c", **kwargs)

    return change


def call(method, *args, **kwargs):
    return lambda b: getattr(b, method)(*args, **kwargs)


def joined(name, kind, parent, child):
    return call("add_joint", name, kind, parent=parent, child=child)


FAULTS = {
    "negative mass": (body_c(mass=-1.0), "body 'c': mass -1 is negative"),
    "negative inertia": (body_c(mass=1.0, inertia=(-1, 1, 1)), "body 'c': inertia is not positive"),
    "triangle": (body_c(mass=1.0, inertia=(1, 1, 3)), "body 'c': inertia violates A \\+ B >= C"),
    "inertia without mass": (body_c(inertia=I3), "body 'c': no mass but inertia"),
    "inertia of a wrong shape": (body_c(mass=1.0, inertia=np.ones(6)), r"body 'c': inertia: expected shape \(3, 3\)"),
    "massless end": (body_c(), "body 'c': no mass moves with joint 'k'"),
    "point on its axis": (body_c(mass=1.0, com=(1, 0, 0)), "body 'c': no mass moves with joint 'k'"),
    "two bodies of a name": (call("add_body", "bob", mass=1.0), "body 'bob': declared 2 times"),
    "body called world": (call("add_body", "world", mass=1.0), "body 'world'"),
    "body without joint": (call("add_body", "c", mass=1.0), "body 'c': no joint carries it"),
    "two parents": (joined("k", "ball", "world", "bob"), r"'bob': carried by 2 joints \('hinge', 'k'\)"),
    "cycle": (cycle, "body 'c': not connected to the world"),
    "world as child": (joined("k", "ball", "bob", "world"), "the world cannot be a child"),
    "unknown kind": (joint_k("revolut"), "joint 'k': unknown kind 'revolut'; use one of revolute"),
    "unknown parent": (joint_k(parent="bib"), "joint 'k': unknown body 'bib'; did you mean 'bob'"),
    "zero axis": (joint_k(axis=(0, 0, 0)), "joint 'k': axis is zero"),
    "missing axis": (joint_k(axis=None), "revolute joint takes axis, got 0"),
    "axis too many": (joint_k("ball", axis=(1, 0, 0)), "ball joint takes no axis, got 1"),
    "crossed limits": (joint_k(lower=1.0, upper=-1.0), "joint 'k': lower limit .* above upper"),
    "negative damping": (joint_k(damping=-1.0), "joint 'k': damping .* is negative"),
    "armature on a ball": (joint_k("ball", armature=(1.0, 1.0, 2.0)), "joint 'k': armature on a ball joint"),
    "spring on a ball": (joint_k("ball", stiffness=1.0), "joint 'k': joint spring on a ball joint"),
    "pitch on a hinge": (joint_k(pitch=0.1), "joint 'k': pitch 0.1 on a revolute joint"),
    "ragged limit": (joint_k(lower=[1, [2]]), "joint 'k': lower: expected 1 numbers"),
    "limits on a quaternion": (joint_k("ball", lower=-1.0), "joint 'k': limits on the quaternion"),
    "frame of the ground": (call("add_frame", "world", body="bob"), "frame 'world'"),
    "skewed rotation": (joint_k(rotation=2 * np.eye(3)), "joint 'k': rotation is not a rotation matrix"),
    "reflection": (joint_k(rotation=np.diag([1, 1, -1])), "joint 'k': rotation is not a rotation matrix"),
    "rotation twice": (joint_k(rotation=np.eye(3), rpy=(0, 0, 0)), "rotation or rpy"),
    "mimics nobody": (joint_k(mimic=("hinje", 1.0, 0.0)), "joint 'k': mimics unknown joint 'hinje'; near: 'hinge'"),
    "mimics itself": (joint_k(mimic=("k", 1.0, 0.0)), "joint 'k': mimics in a circle"),
    "mimic on a ball": (joint_k("ball", mimic=("hinge", 1.0, 0.0)), "'k': mimics 'hinge', but both must have one"),
    "mimic in parts": (joint_k(mimic=("hinge",)), "joint 'k': mimic: expected"),
    "spring to nowhere": (call("add_spring", "s", body_a="bob", body_b="bb"), "spring 's': unknown body 'bb'"),
    "spring to itself": (call("add_spring", "s", body_a="bob", body_b="bob"), "spring 's': both ends on 'bob'"),
    "soft spring": (call("add_spring", "s", body_a="bob", body_b="world", stiffness=-1.0), "stiffness -1 is negative"),
    "loop kind": (call("add_loop", "l", "line", body_a="bob", body_b="world"), "loop 'l': unknown kind 'line'"),
    "prescribed nothing": (call("prescribe", "hing"), "prescribed 'hing': expected a joint of one velocity"),
}


@pytest.mark.parametrize("name", list(FAULTS))
def test_each_fault_is_named_with_its_remedy(name):
    change, message = FAULTS[name]
    b = pendulum()
    change(b)
    with pytest.raises(ModelError, match=message) as caught:
        b.build()
    assert str(caught.value).startswith("pendulum")
    again = pickle.loads(pickle.dumps(caught.value))
    assert again.faults == caught.value.faults


def test_all_faults_come_in_one_error():
    b = mb.ModelBuilder("many", gravity=(0, 0, np.nan))
    b.add_body("a", mass=-1.0)
    b.add_body("b", mass=1.0, inertia=(1, 1, 3))
    b.add_joint("j", "revolute", parent="world", child="a", axis=(0, 0, 0), lower=2, upper=1)
    with pytest.raises(ModelError, match="6 faults") as caught:
        b.build()
    told = " ".join(caught.value.faults)
    for culprit in ("gravity", "body 'a'", "body 'b': inertia", "body 'b': no joint", "axis", "lower limit"):
        assert culprit in told


def test_impossible_bodies_can_be_kept_with_a_warning_but_not_negative_masses():
    b = pendulum()
    body_c(mass=1.0, com=(0, 1, 0), inertia=(1, 1, 3))(b)
    with pytest.warns(NonPhysicalWarning, match="'c': inertia violates"):
        model = b.build(nonphysical="warn")
    assert model.nonphysical[0][0] == "c"
    b.add_body("d", mass=-1.0)
    b.add_joint("l", "fixed", parent="c", child="d")
    with pytest.raises(ModelError, match="negative"):
        b.build(nonphysical="warn")
    # Thin rods, plates and points are matter.
    for inertia in ((1.0, 1.0, 0.0), (1.0, 1.0, 2.0), (0.1 + 0.2, 0.1, 0.2), None):
        b = pendulum()
        body_c(mass=1.0, com=(0, 1, 1), inertia=inertia)(b)
        b.build()


@pytest.mark.parametrize("seed", range(4))
def test_the_builders_own_mass_matrix_is_right(seed):
    """The definition Σ Jᵀ I J that finds idle joints agrees with CRBA."""
    model = random_tree(seed, 12, mimic=seed % 2 == 1)
    q, _ = model.random_state(np.random.default_rng(0))
    assert off(sample_mass_matrix(model), mb.dynamics(model).mass_matrix(q)) < 1e-14


# How public names look in a shell.


@pytest.mark.parametrize(
    ("package", "function"),
    [
        ("mbkit.load", "mbkit.load.loader"),
        ("mbkit.simulate", "mbkit.simulate.run"),
        ("mbkit.studies.stress", "mbkit.studies.stress.study"),
    ],
)
def test_a_package_that_is_called_looks_like_its_function(package, function):
    called = importlib.import_module(package)
    function = getattr(importlib.import_module(function), package.rpartition(".")[2])
    assert inspect.signature(called) == inspect.signature(called.__call__) == inspect.signature(function)
    assert called.__doc__ == function.__doc__
    # A shell shows both docstrings where there are two.
    assert inspect.getdoc(called.__call__) is None
    assert set(dir(called)) == set(called.__all__)
    assert pickle.loads(pickle.dumps(called)) is called
    with pytest.raises(TypeError):
        called(nonsense=1)


def test_parts_of_a_model_are_short_to_look_at_and_every_engine_is_documented():
    assert all(f'"{name}"' in mb.dynamics.__doc__ for name in ENGINES)
    model = mb.load("panda")
    for part in (*model.joints, *model.bodies, *model.frames):
        assert part.name in repr(part)
        assert len(repr(part)) < 160
    assert "\n" not in repr(model.layout)
    assert len(repr(model.layout)) < 160


# A single number is no vector


@pytest.mark.parametrize("x", [0.5, np.array(0.5)])
def test_a_single_number_is_no_vector(x: Any) -> None:
    """Repeated, it would be a direction along (1, 1, 1) that nobody meant."""
    with pytest.raises(ModelError, match=r"gravity: expected shape \(3,\), got the single number"):
        mb.load("ur5", gravity=x)
    b = mb.ModelBuilder("scalars", gravity=x)
    b.add_body("a", mass=1.0, com=x, inertia=(1, 1, 1))
    b.add_joint("one", "revolute", parent="world", child="a", axis=x, translation=x, rpy=x)
    b.add_body("b", mass=1.0, inertia=(1, 1, 1))
    b.add_joint("two", "universal", parent="a", child="b", axis=(1, 0, 0), axis2=x, translation=(x, x, x))
    b.add_frame("tool", body="b", translation=x, rpy=x)
    b.add_spring("spring", body_a="a", body_b="b", point_a=x, point_b=x)
    b.add_loop("pin", "point", body_a="a", body_b="b", translation_a=x, translation_b=x)
    b.add_blade("blade", body_a="a", translation_a=x, axis_a=x)
    with pytest.raises(ModelError) as told:
        b.build()
    faults = [line for line in str(told.value).splitlines() if "got the single number" in line]
    assert len(faults) == 14
    assert not any("is zero" in line for line in str(told.value).splitlines())


def test_a_single_number_stands_for_each_velocity_of_a_joint() -> None:
    model = hinge(kind="universal", axis2=(0, 0, 1), damping=0.5).build()
    assert model.joints[0].damping.tolist() == [0.5, 0.5]


# A description cannot come into being unchecked


ARM, ELBOW = "upper_arm_link", "elbow_joint"


@pytest.mark.parametrize(
    ("part", "changed", "says"),
    [
        (ARM, {"mass": -5.0}, "body 'upper_arm_link': mass -5 is negative"),
        (ARM, {"mass": "heavy"}, "body 'upper_arm_link': mass: expected numbers, got 'heavy'"),
        (ARM, {"com": [1.0, 2.0]}, r"com: expected shape \(3,\), got \(2,\)"),
        (ARM, {"inertia": [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]}, "inertia is not symmetric"),
        (ELBOW, {"parent": "nowhere"}, "joint 'elbow_joint': unknown body 'nowhere'"),
        (ELBOW, {"damping": [-1.0]}, "damping .* is negative"),
        ("", {"bodies": ()}, "bodies"),
        *(("", {"gravity": g}, "gravity: expected three finite numbers") for g in (-9.81, (0, 0, np.nan))),
    ],
)
def test_what_cannot_be_is_refused_by_replace_too(part: str, changed: dict[str, Any], says: str) -> None:
    model = mb.load("ur5")

    def parts(of: str) -> tuple[Any, ...]:
        return tuple(replace(x, **changed) if x.name == part else x for x in getattr(model, of))

    with pytest.raises(ModelError, match=says):
        replace(model, **({"bodies": parts("bodies"), "joints": parts("joints")} if part else changed))


def test_what_a_loader_took_as_written_stays_so() -> None:
    with pytest.warns(NonPhysicalWarning):
        model = mb.load("romeo_small")
    assert replace(model, name="other").nonphysical == model.nonphysical
    assert pickle.loads(pickle.dumps(model)) == model


def test_limits_stand_in_the_order_of_velocities_and_log_undoes_exp() -> None:
    """Limits of the model are those of its joints; a twist of less than half a turn is the log of its exp."""
    model = mb.load("panda", floating_base=True)
    for joint in model.independent_joints:
        own = model.layout.v[joint.name]
        assert np.array_equal(model.effort_limits[own], joint.effort_limit)
        assert np.array_equal(model.velocity_limits[own], joint.velocity_limit)
    assert np.isinf(model.effort_limits[:6]).all()
    xi = np.random.default_rng(0).uniform(-1.5, 1.5, (50, 6))
    xi[:10] *= 1e-6
    # V and its inverse amplify rounding by their norms, which are below 4 here.
    assert np.abs(mb.spatial.log_se3(*mb.spatial.exp_se3(xi)) - xi).max() < 200 * np.finfo(float).eps
    assert set(dir(mb.spatial)) == set(mb.spatial.__all__)
    assert "/site-packages" not in repr(mb.robots())


def test_a_velocity_by_the_pose_error_goes_straight_to_the_goal() -> None:
    dyn = mb.dynamics(mb.load("ur5"), "lagrangian")
    q = np.array([0.3, -1.2, 1.4, -0.6, 0.8, 0.2])
    goal = dyn.pose(q + 0.2, "tool0")
    for _ in range(8):
        step = np.linalg.solve(dyn.jacobian(q, "tool0"), mb.spatial.pose_error(dyn.pose(q, "tool0"), goal))
        q = q + step
    assert np.abs(dyn.pose(q, "tool0") - goal).max() < 1e-12
    batch = mb.spatial.pose_error(dyn.pose(np.stack([q, q]), "tool0"), goal)
    assert batch.shape == (2, 6)


def calls_with_a_scalar() -> dict[str, Callable[[], Any]]:
    """Return a call for each vector argument of a public function, with a number in its place."""
    model, X, unit = mb.load("ur5"), np.eye(4), np.array([0.0, 0.0, 0.0, 1.0])
    dyn, z = mb.dynamics(model, "lagrangian"), np.zeros(6)
    many = np.zeros((50, 6))
    out: dict[str, Callable[[], Any]] = {
        "simulate q0": lambda: mb.simulate(dyn, 0.5, z, 0.01),
        "simulate v0": lambda: mb.simulate(dyn, z, 0.5, 0.01),
        "simulate torque": lambda: mb.simulate(dyn, z, z, 0.01, torque=1.0),
        "simulate torque function": lambda: mb.simulate(dyn, z, z, 0.01, torque=lambda *_: 1.0),
        "simulate wrench": lambda: mb.simulate(dyn, z, z, 0.01, wrenches={"tool0": 5.0}),
        "simulate wrench function": lambda: mb.simulate(dyn, z, z, 0.01, wrenches={"tool0": lambda *_: 1.0}),
        "inverse_dynamics wrench": lambda: dyn.inverse_dynamics(z, z, z, wrenches={"tool0": 5.0}),
        "generalized_force": lambda: dyn.generalized_force(z, {"tool0": 5.0}),
        "forward_dynamics tau": lambda: dyn.forward_dynamics(z, z, 1.0),
        "step tau": lambda: dyn.step(z, z, 1.0, 1e-3),
        "step wrench": lambda: dyn.step(z, z, z, 1e-3, wrenches={"tool0": 1.0}),
        "integrate": lambda: model.integrate(z, 1.0),
        "difference": lambda: model.difference(z, 1.0),
        "jacobian": lambda: dyn.jacobian(1.0, "tool0"),
        "operational_space": lambda: mb.operational_space(dyn, 1.0, "tool0"),
        "equilibrium": lambda: mb.equilibrium(dyn, 1.0),
        "linearize": lambda: dyn.linearize(1.0, z, z),
        "identify weights": lambda: mb.identify(model, many, many, many, many, weights=1.0),
        "filtered_motion": lambda: mb.identify.filtered_motion(model, 1.0, 1e-3, 10.0),
        "solref": lambda: mb.dynamics(mb.catalog.slider_crank(), "mujoco", solref=0.02),
        "save": lambda: mb.simulate(dyn, z, z, 0.01, save=0.01),
        "show": lambda: mb.show(model, 1.0),
        "picture view": lambda: mb.simulate(dyn, z, z, 0.01).picture(view=1.0),
        "multiply": lambda: mb.spatial.multiply(unit, 1.0),
        "rotate": lambda: mb.spatial.rotate(unit, 1.0),
        "log_se3": lambda: mb.spatial.log_se3(np.zeros(3), 1.0),
        "pose_error": lambda: mb.spatial.pose_error(X, 1.0),
    }
    for name in ("skew", "exp_quaternion", "log_quaternion", "exp_se3", "left_jacobian", "left_jacobian_inverse"):
        out[name] = lambda name=name: getattr(mb.spatial, name)(1.0)  # type: ignore[misc]
    for name in ("conjugate", "matrix_from_quaternion", "quaternion_from_matrix", "rpy_from_matrix"):
        out[name] = lambda name=name: getattr(mb.spatial, name)(1.0)  # type: ignore[misc]
    return out


def test_a_scalar_is_a_vector_for_no_public_function():
    for name, call in calls_with_a_scalar().items():
        with pytest.raises(MbkitError, match="expected"):
            pytest.fail(f"{name}: {call()!r}")


def test_functions_of_space_take_lists_and_name_wrong_shapes():
    assert mb.spatial.skew([1, 2, 3]).tolist() == [[0, -3, 2], [3, 0, -1], [-2, 1, 0]]
    assert mb.spatial.rotate(quaternion=[0, 0, 1, 0], x=[1, 0, 0]).tolist() == [-1, 0, 0]
    for bad, words in (
        (lambda: mb.spatial.skew([[1, 2]]), r"w: expected shape \(3,\) or \(..., 3\), got \(1, 2\)"),
        (lambda: mb.spatial.rotate([0, 0, 0, 1], [1, "a", 2]), "x: expected real numbers"),
        (lambda: mb.spatial.skew([[1, 2, 3], [1]]), "w: expected an array of numbers, got rows"),
    ):
        with pytest.raises(InputError, match=words):
            bad()


# Degrees

IN_DEGREES: dict[str, Callable[[Any, Any], Any]] = {
    "mass_matrix": lambda dyn, q: dyn.mass_matrix(q),
    "forward_dynamics": lambda dyn, q: dyn.forward_dynamics(q, [0, 0], [0, 0]),
    "a batch": lambda dyn, q: dyn.nle(np.tile(q, (2, 1)), np.zeros((2, 2))),
    "pose": lambda dyn, q: dyn.pose(q, "rod1"),
    "step": lambda dyn, q: dyn.step(q, [0, 0], [0, 0], 1e-3),
    "linearize": lambda dyn, q: dyn.linearize(q, [0, 0], [0, 0]),
    "simulate": lambda dyn, q: mb.simulate(dyn, q, [0, 0], 0.01, "rk4", dt=1e-3),
    "stiffness": lambda dyn, q: mb.simulate.stiffness(dyn, q, [0, 0]),
    "integrate": lambda dyn, q: dyn.model.integrate(q, [0, 0]),
    "difference": lambda dyn, q: dyn.model.difference([0, 0], q),
    "lock": lambda dyn, q: dyn.model.lock(["theta1"], q),
    "a locked value": lambda dyn, q: dyn.model.lock({"theta1": q[0]}),
}


def hints(call: Callable[[], Any]) -> list[str]:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        call()
    assert {w.filename for w in told if "two turns" in str(w.message)} <= {__file__}
    return [str(w.message) for w in told if "two turns" in str(w.message)]


@pytest.mark.parametrize(
    ("name", "engine"),
    [*((x, "pinocchio") for x in IN_DEGREES), *((x, e) for x in ("pose", "step") for e in ("lagrangian", "mujoco"))],
)
def test_degrees_are_hinted_at_in_every_call_that_takes_q(name: str, engine: str) -> None:
    call, dyn = IN_DEGREES[name], mb.dynamics(mb.catalog.double_pendulum(), engine)
    (hint,) = hints(lambda: call(dyn, np.degrees([0.5, -0.3])))
    assert "theta1" in hint
    assert "28.6479 rad is beyond two turns; angles are in radians" in hint
    fresh = mb.dynamics(mb.catalog.double_pendulum(), engine)
    assert hints(lambda: call(fresh, np.array([4 * np.pi, -3.0]))) == []


def test_degrees_are_hinted_at_once_and_lengths_are_none() -> None:
    dyn = mb.dynamics(mb.catalog.double_pendulum())
    assert len(hints(lambda: [dyn.mass_matrix(np.array([k, 90.0])) for k in range(5)])) == 1
    cart = mb.dynamics(mb.catalog.cart_pole())
    assert hints(lambda: cart.mass_matrix([100.0, 3.0])) == []


@pytest.mark.parametrize("engine", ["pinocchio", "lagrangian", "mujoco"])
def test_runs_may_turn_many_times(engine: str) -> None:
    dyn = mb.dynamics(mb.catalog.pendulum(), engine)

    def run() -> None:
        run = mb.simulate(dyn, [0.0], [40.0], 1.0, "rk4", dt=0.005)
        assert run.q[-1, 0] > 35
        assert len(run.energy()) == len(run.power_balance()) == len(run.t)
        run.check()

    def loop() -> None:
        own, q, v = mb.dynamics(mb.catalog.pendulum(), engine), np.zeros(1), np.array([40.0])
        for _ in range(200):
            own.mass_matrix(q)
            q, v = own.step(q, v, [0.0], 0.005)
        assert q[0] > 35

    assert hints(run) == hints(loop) == []


def test_degrees_of_roll_pitch_and_yaw_are_hinted_at() -> None:
    b = mb.ModelBuilder("arm")
    b.add_body("arm", mass=1.0, inertia=I3)
    for call in (
        lambda: b.add_joint("j", "revolute", parent="world", child="arm", axis=(0, 0, 1), rpy=(0, 90, 0)),
        lambda: b.add_frame("tool", body="arm", rpy=(0, 90, 0)),
        lambda: mb.spatial.pose((0, 0, 1), rpy=(0, 90, 0)),
        lambda: mb.spatial.matrix_from_rpy(0, 90, 0),
    ):
        (hint,) = hints(call)
        assert "rpy = 90 rad is beyond two turns" in hint
    text = '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="fixed"><origin rpy="0 90 0"/>'
    text += '<parent link="a"/><child link="b"/></joint></robot>'
    with pytest.raises(ModelError, match="no mass"):
        mb.load(text, floating_base=True)
    text = text.replace(
        '<link name="a"/>',
        '<link name="a"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" '
        'iyy="1" iyz="0" izz="1"/></inertial></link>',
    )
    assert any(
        "joint 'j': origin rpy" in note and "URDF's are radians" in note
        for note in mb.load(text, floating_base=True).notes
    )
    assert hints(lambda: mb.explain(mb.load("ur5"), mb.load("ur5").without("gravity"))) == []


def test_numbers_of_velocities_and_the_model_without_jumps() -> None:
    """A follower with ratio -2 counts fourfold in armature and damping, and twofold in dry friction."""
    b = mb.ModelBuilder("follower")
    for i, mimic in enumerate((None, mb.Mimic("j0", ratio=-2.0), None)):
        b.add_body(f"b{i}", mass=1.0, com=(0, 0, 0.3), inertia=(0.1, 0.1, 0.1))
        numbers = {"armature": 1.0 + i, "damping": 0.5, "friction": 0.25} | ({"mimic": mimic} if mimic else {})
        parent = f"b{i - 1}" if i else "world"
        b.add_joint(f"j{i}", "revolute", parent=parent, child=f"b{i}", axis=(0, 1, 0), **numbers)
    model = b.build()
    assert model.velocity_joints == ("j0", "j2")
    assert model.per_velocity("armature") == pytest.approx([1.0 + 4 * 2.0, 3.0])
    assert model.per_velocity("damping") == pytest.approx([0.5 + 4 * 0.5, 0.5])
    assert model.per_velocity("friction") == pytest.approx([0.25 + 2 * 0.25, 0.25])
    assert {"T", "V", "loss", "jump", "q"} <= model.effects
    assert model.smooth == model.without("friction")
    smooth = model.smooth
    assert "jump" not in smooth.effects
    assert smooth.smooth is smooth
    for name in ("parent", "stiction", "lower", "armatur"):
        with pytest.raises(UnknownNameError, match=name):
            model.per_velocity(name)
