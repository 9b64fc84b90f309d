"""A description changed: edited, locked, joined, mounted, and with numbers that are free."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mbkit as mb
from mbkit.errors import InputError, MbkitError, MbkitWarning, ModelError, UnknownNameError, UnsupportedError
from mbkit.model import Model
from tests.random_trees import SOUND, off, random_tree, states
from tests.scenes import mounted

# Sums of a few hundred rounded terms.
CLOSE = 1e-13
SEEDS = st.integers(0, 10**6)
TERMS = ("mass_matrix", "nle", "gravity", "passive")


def own(model: Model) -> mb.Dynamics:
    return mb.dynamics(model, "lagrangian")


def pendulum(name: str = "arm", mass: float = 1.0) -> mb.ModelBuilder:
    place = {"axis": (0, 1, 0), "lower": -2.0, "upper": 2.0, "damping": 0.1}
    b = mounted(name, "link", "hinge", "revolute", mass=mass, com=(0.1, 0.0, -0.5), inertia=(0.1, 0.1, 0.02), **place)
    b.add_frame("tip", body="link", translation=(0, 0, -1.0))
    return b


def assert_refused(kind: type[Exception], ask: Callable[[], object], words: list[str]) -> None:
    with pytest.raises(kind) as caught:
        ask()
    assert all(word in str(caught.value) for word in words), str(caught.value)


# Edit


def test_what_is_set_is_what_a_new_description_would_have():
    b = mb.ModelBuilder.of(pendulum().build())
    b.set_body("link", mass=3.0, com=(0, 0, -0.2), inertia=(0.3, 0.3, 0.1))
    b.set_joint(
        "hinge", damping=0.5, armature=0.2, stiffness=4.0, rest=0.1, upper=np.inf, axis=(1, 0, 0), rpy=(0, 0, 1)
    )
    b.set_frame("tip", translation=(0, 0, -2.0))
    b.set_gravity((0, 0, -1.62))
    changed = b.build()
    new = mb.ModelBuilder("arm", gravity=(0, 0, -1.62))
    new.add_body("link", mass=3.0, com=(0, 0, -0.2), inertia=(0.3, 0.3, 0.1))
    new.add_joint(
        "hinge", "revolute", parent="world", child="link", axis=(1, 0, 0), rpy=(0, 0, 1), lower=-2.0, damping=0.5,
        armature=0.2, stiffness=4.0, rest=0.1,
    )  # fmt: skip
    new.add_frame("tip", body="link", translation=(0, 0, -2.0))
    assert changed == new.build()
    told = " ".join(changed.notes)
    assert "inertia;" not in told
    assert "mass 1 to 3" in told
    assert "damping 0.1 to 0.5" in told
    assert "gravity from [0, 0, -9.81] to [0, 0, -1.62]" in told


def test_springs_loops_couplings_and_couplers_are_set_too():
    b = mb.ModelBuilder("two")
    for k in (1, 2):
        b.add_body(f"link{k}", mass=1.0, com=(0, 0, -0.5), inertia=(0.1, 0.1, 0.1))
        b.add_joint(f"j{k}", "revolute", parent="world", child=f"link{k}", axis=(0, 1, 0), translation=(k, 0, 0))
    b.add_spring("spring", body_a="link1", body_b="link2", stiffness=1.0)
    b.add_coupling("tendon", {"j1": 1.0, "j2": -1.0}, stiffness=1.0)
    b.add_coupler("gear", "j1", "j2", ratio=2.0)
    b.add_loop("rod", "distance", body_a="link1", body_b="link2", length=1.0)
    before = b.build()
    b = mb.ModelBuilder.of(before)
    b.set_spring("spring", stiffness=7.0, point_a=(0, 0, -1.0))
    b.set_coupling("tendon", damping=2.0, factors=(1.0, mb.Parameter("c", 0.5)))
    b.set_coupler("gear", offset=0.3)
    b.set_loop("rod", translation_b=(0, 0, 0.1), length=1.5)
    after = b.build()
    assert (after.springs[0].stiffness, after.springs[0].point_a.tolist()) == (7.0, [0, 0, -1.0])
    assert (after.couplings[0].stiffness, after.couplings[0].damping) == (1.0, 2.0)
    assert after.with_parameters(c=0.7).couplings[0].factors.tolist() == [1.0, 0.7]
    assert (after.couplers[0].ratio, after.couplers[0].offset) == (2.0, 0.3)
    assert (after.loops[0].length, after.loops[0].translation_b.tolist()) == (1.5, [0, 0, 0.1])
    assert (before.springs[0].stiffness, before.loops[0].length) == (1.0, 1.0)


def test_a_parameter_takes_the_place_of_a_number_and_a_number_that_of_a_parameter():
    b = mb.ModelBuilder.of(pendulum(mass=mb.Parameter("m", 2.0)).build())
    b.set_joint("hinge", damping=mb.Parameter("d", 0.3))
    assert dict(b.build().parameters) == {"m": 2.0, "d": 0.3}
    b.set_body("link", mass=5.0)
    model = b.build()
    assert dict(model.parameters) == {"d": 0.3}
    assert model.mass == 5.0


@pytest.mark.thorough
@settings(max_examples=6, deadline=None)
@given(SEEDS)
def test_a_payload_adds_its_inertia_by_the_jacobian_of_its_frame(seed):
    tree = random_tree(seed, 6, kinds=SOUND)
    b = mb.ModelBuilder.of(tree)
    inertia = np.array([[0.3, 0.02, 0.01], [0.02, 0.25, -0.03], [0.01, -0.03, 0.2]])
    b.add_payload(
        "load", at="tip", mass=0.7, com=(0.1, -0.2, 0.3), inertia=inertia, translation=(0.2, 0, 0), rpy=(1, 2, 3)
    )
    b.add_frame("center", body="load", translation=(0.1, -0.2, 0.3))
    loaded = b.build()
    (q,), (v,), *_ = states(tree, 1, seed)
    before, after = own(tree), own(loaded)
    J = np.asarray(after.jacobian(q, "center", axes="local"))
    spatial = np.block([[0.7 * np.eye(3), np.zeros((3, 3))], [np.zeros((3, 3)), inertia]])
    assert off(after.mass_matrix(q), before.mass_matrix(q) + J.T @ spatial @ J) < CLOSE
    pull = J[:3].T @ np.asarray(after.pose(q, "center"))[:3, :3].T @ (0.7 * loaded.gravity)
    assert off(after.gravity(q), before.gravity(q) - pull) < CLOSE
    assert off(after.passive(q, v), before.passive(q, v)) < CLOSE


def test_a_removed_joint_takes_all_that_it_carries():
    b = pendulum()
    for k, parent in enumerate(("link", "more0", "world")):
        b.add_body(f"more{k}", mass=1.0, com=(0, 0, 0.1), inertia=(0.1, 0.1, 0.1))
        b.add_joint(f"j{k}", "revolute", parent=parent, child=f"more{k}", axis=(1, 0, 0))
    b.add_frame("far", body="more1")
    b.add_spring("spring", body_a="more1", body_b="more2", stiffness=1.0, point_a=(1, 0, 0))
    b.add_coupling("tendon", {"j1": 1.0, "hinge": 1.0}, stiffness=1.0)
    q, v = ca.SX.sym("q"), ca.SX.sym("v")
    b.add_joint_force("motor", "j1", -q - v)
    whole = b.build()
    b = mb.ModelBuilder.of(whole)
    b.remove_joint("j0")
    left = b.build()
    assert [x.name for x in left.bodies] == ["link", "more2"]
    assert left.joint_names == ("hinge", "j2")
    assert not (left.springs)
    assert not (left.couplings)
    assert not (left.forces)
    assert [f.name for f in left.frames] == ["tip"]
    assert all(x in left.notes[-1] for x in ("more0", "more1", "spring 'spring'", "coupling 'tendon'", "force 'motor'"))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda b: b.set_body("lnk", mass=1.0), ["body 'lnk'", "did you mean 'link'"]),
        (lambda b: b.set_body("tip", mass=1.0), ["'tip'", "frame on body 'link'", "add_payload"]),
        (lambda b: b.set_joint("hing", damping=1.0), ["joint 'hing'", "did you mean 'hinge'"]),
        (lambda b: b.set_joint("hinge", damping="soft"), ["joint 'hinge': damping", "soft"]),
        (lambda b: b.set_joint("hinge", dampin=3.0), ["joint 'hinge': 'dampin'", "did you mean 'damping'"]),
        (lambda b: b.add_payload("load", at="tipp", mass=1.0), ["payload 'load'", "'tipp'", "did you mean 'tip'"]),
        (
            lambda b: b.add_payload("load", at="tip", mass=1.0, inertia=(1, 1, 5)),
            ["body 'load'", "violates A + B >= C"],
        ),
    ],
)
def test_a_faulty_change_is_told_at_build(change, words):
    model = pendulum().build()
    b = mb.ModelBuilder.of(model)
    change(b)
    assert_refused(ModelError, b.build, words)
    assert model == pendulum().build()


def test_a_robot_with_odd_inertias_is_edited_and_a_new_fault_is_told():
    with pytest.warns(mb.errors.NonPhysicalWarning):
        robot = mb.load("romeo_small")
    odd = dict(robot.nonphysical)
    b = mb.ModelBuilder.of(robot)
    sound = next(j.child for j in robot.joints if j.type.nv and j.child not in odd)
    b.set_body(sound, mass=2.0)
    assert dict(b.build().nonphysical) == odd
    b.set_body(sound, inertia=(1.0, 1.0, 5.0))
    with pytest.raises(ModelError, match=sound):
        b.build()


# Lock


def free_entries(full: Model, reduced: Model) -> list[int]:
    return [i for i, name in enumerate(full.velocity_names) if name in reduced.velocity_names]


def in_pinocchio(
    model: Model, raw: pin.Model, q: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Return a state in the order of a model of Pinocchio, and where our velocities are in it."""
    joints = [(raw.joints[raw.getJointId(j)], model.joint(j).type) for j in model.joint_names]
    at = [x.idx_q + k for x, kind in joints for k in range(kind.nq)]
    order = [x.idx_v + k for x, kind in joints for k in range(kind.nv)]
    pin_q, pin_v = np.empty(raw.nq), np.empty(raw.nv)
    pin_q[at] = q
    if len(v):
        pin_v[order] = v
    return pin_q, pin_v, order


def assert_same_as(raw: pin.Model, dyn: mb.Dynamics, q: np.ndarray, v: np.ndarray) -> None:
    pin_q, pin_v, order = in_pinocchio(dyn.model, raw, q, v)
    data = raw.createData()
    M = np.triu(pin.crba(raw, data, pin_q))
    M = M + np.triu(M, 1).T
    assert off(dyn.mass_matrix(q), M[np.ix_(order, order)]) < CLOSE
    assert off(dyn.nle(q, v), pin.nonLinearEffects(raw, data, pin_q, pin_v)[order]) < CLOSE


@settings(max_examples=4, deadline=None)
@given(SEEDS, st.data())
def test_a_locked_model_has_the_rows_and_columns_that_are_left(seed, data):
    tree = random_tree(seed, 6, mimic=True)
    names = data.draw(st.lists(st.sampled_from(tree.joint_names), min_size=1, unique=True))
    q0, _ = tree.random_state(seed + 1)
    reduced = tree.lock(names, q0) if len(names) < len(tree.joint_names) else tree.lock(names[1:], q0)
    (q,), (v,), (a,), (tau,) = states(reduced, 1, seed)
    whole_q, whole_v = reduced.full_state(q, v)
    kept = free_entries(tree, reduced)
    assert all(np.array_equal(x, y) for x, y in zip(reduced.reduced_state(whole_q, whole_v), (q, v), strict=True))
    full, small = own(tree), own(reduced)
    assert off(small.mass_matrix(q), full.mass_matrix(whole_q)[np.ix_(kept, kept)]) < CLOSE
    for term in ("nle", "passive"):
        assert off(getattr(small, term)(q, v), getattr(full, term)(whole_q, whole_v)[kept]) < CLOSE
    assert off(small.gravity(q), full.gravity(whole_q)[kept]) < CLOSE
    energies = [float(x) for x in (small.potential_energy(q), full.potential_energy(whole_q))]
    assert energies[0] == pytest.approx(energies[1], rel=1e-12, abs=1e-10)
    assert off(small.pose(q, "tip"), full.pose(whole_q, "tip")) < CLOSE
    rates = small.mass_matrix(q) @ small.forward_dynamics(q, v, tau) - tau
    assert off(rates, small.passive(q, v) - small.nle(q, v)) < 1e-10
    assert a.shape == v.shape


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio", "mujoco"])
def test_what_is_locked_keeps_its_energy_and_loses_its_friction(engine):
    """½ 20 (0.4 - 0.1)² + ½ 5 (3 0.4 - 0.5)² + 2 0.4⁴ J, beside ½ 7 q² of the other joints."""
    b = mb.ModelBuilder("held", gravity=(0, 0, 0))
    rubs = {"friction": 1.0, "stiction": 2.0, "stribeck_velocity": 0.1, "damping": 0.3, "armature": 0.2}
    for k, parent in enumerate(("world", "b0", "b1")):
        b.add_body(f"b{k}", mass=1.0, com=(0.3, 0, 0), inertia=(0.1, 0.1, 0.1))
        own = (
            {"stiffness": mb.Parameter("k", 20.0), "rest": mb.Parameter("rest", 0.1)} if k == 1 else {"stiffness": 7.0}
        )
        place = {"axis": (0, 0, 1), "translation": (mb.Parameter("l", 0.5) if k else 0.0, 0, 0)}
        b.add_joint(f"j{k}", "revolute", parent=parent, child=f"b{k}", **place, **own, **rubs)
    b.add_coupling("wire", {"j1": mb.Parameter("ratio", 3.0)}, stiffness=mb.Parameter("pull", 5.0), rest_length=0.5)
    b.add_joint_force("hardens", "j1", potential=lambda q: 2.0 * q**4)
    full = b.build()
    reduced = full.lock({"j1": 0.4})
    assert reduced.joint("j1").stiction is None
    dyn, whole = mb.dynamics(reduced, engine), mb.dynamics(full, engine)
    q, v, tau = np.array([0.2, -0.7]), np.array([0.5, 0.0]), np.array([1.0, 9.0])
    expected = 3.5 * (q @ q) + 10 * 0.3**2 + 2.5 * 0.7**2 + 2 * 0.4**4
    assert dyn.potential_energy(q) == pytest.approx(expected, rel=1e-14)
    assert off(dyn.passive(q, v), whole.passive([0.2, 0.4, -0.7], [0.5, 0, 0])[[0, 2]]) < 1e-14
    # The joint is held by a torque instead.
    M, h = dyn.mass_matrix(q), dyn.passive(q, v) + tau - dyn.nle(q, v)
    slides = np.array([0.0, 1 + (2 - 1)])
    assert off(dyn.forward_dynamics(q, v, tau), np.linalg.solve(M, h - slides)) < 1e-13
    numbers = {"k": 30.0, "rest": -0.2, "ratio": 1.0, "pull": 4.0, "l": 0.9}
    other = mb.dynamics(reduced.with_parameters(**numbers), engine)
    expected = 3.5 * (q @ q) + 15 * 0.6**2 + 2 * 0.1**2 + 2 * 0.4**4
    assert other.potential_energy(q) == pytest.approx(expected, rel=1e-14)


def test_couplings_couplers_and_formulas_hold_the_locked_numbers():
    b = mb.ModelBuilder("three")
    for k in range(3):
        b.add_body(f"b{k}", mass=1.0, com=(0, 0, -0.5), inertia=(0.1, 0.1, 0.1))
        b.add_joint(f"j{k}", "revolute", parent="world", child=f"b{k}", axis=(0, 1, 0), translation=(k, 0, 0))
    b.add_coupling("tendon", {"j0": 2.0, "j1": -1.0}, stiffness=3.0, rest_length=0.2, damping=0.5)
    b.add_coupling("alone", {"j0": 1.0}, stiffness=3.0)
    q, j0, rate = ca.SX.sym("q"), ca.SX.sym("j0"), ca.SX.sym("j0_dot")
    b.add_joint_force("servo", "j2", 5.0 * (j0 - q) - rate)
    b.add_joint_force("lost", "j0", -q)
    full = b.build()
    reduced = full.lock({"j0": 0.7})
    q, v = np.array([0.3, -0.2]), np.array([1.0, 2.0])
    assert off(own(reduced).passive(q, v), own(full).passive([0.7, *q], [0.0, *v])[1:]) < 1e-15
    assert [x.name for x in reduced.couplings] == ["tendon"]
    assert [x.name for x in reduced.forces] == ["servo"]
    told = " ".join(reduced.notes)
    assert "coupling 'alone'" in told
    assert "force 'lost'" in told


def geared(ratio: float = -2.0, curve: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Model:
    b = mb.ModelBuilder("geared")
    for k in range(3):
        b.add_body(f"b{k}", mass=1.0, com=(0, 0, -0.5), inertia=(0.1, 0.1, 0.1))
        b.add_joint(f"j{k}", "revolute", parent="world", child=f"b{k}", axis=(0, 1, 0), translation=(k, 0, 0))
    b.add_coupler("gear", "j0", "j1", ratio=ratio, offset=0.1, curve=curve)
    return b.build()


@pytest.mark.parametrize("given", [{"j1": 0.3}, {"j0": -0.5}, {"j0": -0.5, "j1": 0.3}])
def test_what_a_coupler_ties_is_locked_with_it(given):
    reduced = geared().lock(given)
    assert reduced.joint_names == ("j2",)
    assert not reduced.couplers
    assert np.allclose(reduced.full_state([0.2])[0], [-0.5, 0.3, 0.2], rtol=0, atol=1e-15)


def test_a_loop_stays_and_one_that_nothing_moves_is_gone():
    crank = mb.catalog.four_bar()
    dyn = own(crank)
    q, _ = dyn.project([0.5, 0.0, 1.0], [0.0] * 3)
    locked = crank.lock({name: q[k] for k, name in enumerate(crank.joint_names)})
    assert not locked.loops
    assert "is closed by the locked joints" in " ".join(locked.notes)
    with pytest.raises(InputError, match="is open by"):
        crank.lock(dict.fromkeys(crank.joint_names, 0.3))
    one = crank.lock({crank.joint_names[0]: q[0]})
    assert len(one.loops) == 1
    assert np.abs(own(one).constraint_residual(q[1:])).max() < 1e-14


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda m: m.lock({"hing": 0.0}), ["'hing'", "hinge"]),
        (lambda m: m.lock({"hinge": 2.5}), ["'hinge' at 2.5", "-2 to 2"]),
        (lambda m: m.lock({"hinge": 0.1}, m.neutral()), ["q:"]),
        (lambda m: m.full_state([0.0]), ["no locked joints"]),
        (lambda _: mb.load("panda").lock({"panda_finger_joint2": 0.0}), ["follows 'panda_finger_joint1'"]),
        (lambda _: geared(curve=(1.0, 0, 0)).lock({"j0": 0.2}), ["gear", "lock 'j1'"]),
        (lambda _: geared().lock({"j0": 0.4, "j1": 0.4}), ["gear", "locked at"]),
        (lambda _: mb.catalog.rolling_disc().lock({"move": [0, 0, 0, 0, 0, 0, 2.0]}), ["move"]),
    ],
)  # fmt: skip
def test_what_cannot_be_locked_is_refused(ask, words):
    assert_refused(MbkitError, lambda: ask(pendulum().build()), words)


# Join and mount


@pytest.mark.parametrize(("name", "floating", "at"), [("anymal", True, "base"), ("ur5", False, "tool0")])
def test_a_joined_robot_is_that_of_pinocchio_and_of_mujoco(name, floating, at):
    base, arm = mb.load(name, floating_base=floating), mb.load("ur5")
    place = mb.spatial.pose((0.1, 0.0, 0.2), rpy=(0.1, 0.2, 0.3))
    whole = mb.join(base, arm, at=at, pose=place, prefix="arm_")
    free = (pin.JointModelFreeFlyer(), "root_joint") if floating else ()
    a = pin.buildModelFromUrdf(base.source, *free)
    b = pin.buildModelFromUrdf(arm.source)
    for k in range(1, b.njoints):
        b.names[k] = "arm_" + b.names[k]
    for f in list(b.frames)[1:]:
        f.name = "arm_" + f.name
    raw = pin.appendModel(a, b, a.getFrameId(at), pin.SE3(place))
    q, v = whole.random_state(np.random.default_rng(1))
    for engine in ("lagrangian", "pinocchio", "mujoco"):
        assert_same_as(raw, mb.dynamics(whole, engine), q, v)


def test_what_hangs_on_the_ground_hangs_on_the_frame():
    arm = pendulum("arm")
    arm.add_spring("spring", body_a="world", body_b="link", point_a=(1.0, 0, 0), point_b=(0, 0, -1), stiffness=9.0)
    arm = arm.build()
    pose = mb.spatial.pose((0.3, 0.2, 0.1), rpy=(0.4, 0.5, 0.6))
    alone = mounted("block", "block", "weld", "fixed", mass=1.0, inertia=(1, 1, 1))
    joined = mb.join(alone.build(), arm, at="block", pose=pose)
    assert not any("gravity is that of" in x for x in joined.notes)
    light = mb.join(mb.load("ur5", gravity=(0, 0, -1.62)), arm, at="tool0")
    assert "gravity is that of ur5, [0.0, 0.0, -1.62]; arm had [0.0, 0.0, -9.81]" in light.notes
    # Its springs see the same distances; its weight hangs another way.
    for q in ([0.3], [-1.1]):
        assert off(own(joined).passive(q, [0.7]), own(arm).passive(q, [0.7])) < 1e-14
    tilted = mb.join(alone.build(), arm, at="world", pose=pose)
    assert off(own(tilted).gravity([0.3]), own(joined).gravity([0.3])) < 1e-14


def test_a_mount_turns_gravity_the_other_way_round():
    R = mb.spatial.matrix_from_rpy(0.3, -0.4, 0.5)
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R, (1, 2, 3)
    mounted = mb.load("ur5", mount=X)
    turned = mb.load("ur5", gravity=R.T @ [0, 0, -9.81])
    q, v = turned.random_state(4)
    for term in TERMS[1:3]:
        arguments = (q,) if term == "gravity" else (q, v)
        assert off(getattr(own(mounted), term)(*arguments), getattr(own(turned), term)(*arguments)) < CLOSE
    assert off(own(mounted).pose(q, "tool0"), X @ own(turned).pose(q, "tool0")) < 1e-14
    assert "mounted at [1.0, 2.0, 3.0] m" in mounted.notes[-1] or any("mounted" in x for x in mounted.notes)


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda a: mb.join(a, a, at="tip"), ["prefix", "bodies", "'link'"]),
        (lambda a: mb.join(a, a, at="top", prefix="b_"), ["'top'", "tip"]),
        (lambda a: mb.join(a, a, at="tip", prefix="b_", pose=2 * np.eye(4)), ["pose", "homogeneous"]),
        (lambda _: mb.load("ur5", floating_base=True, mount=np.eye(4)), ["mount", "root_joint"]),
        (lambda a: mb.join(a, mb.load("ur5", floating_base=True), at="tip"), ["floats", "root_joint"]),
    ],
)
def test_what_cannot_be_joined_is_refused(ask, words):
    assert_refused(MbkitError, lambda: ask(pendulum().build()), words)


# Free numbers and variants


def test_a_scale_is_one_factor_beside_free_numbers():
    tree = random_tree(2, 4)
    free = tree.with_free("b0.mass", mb.scale("*.mass", "*.inertia", name="size"))
    assert dict(free.parameters) == {"b0.mass": tree.body("b0").mass, "size": 1.0}
    other = free.with_parameters(size=2.0, **{"b0.mass": 3.0})
    assert other.body("b0").mass == 6.0
    assert other.body("b1").mass == 2 * tree.body("b1").mass
    assert np.allclose(other.body("b2").inertia, 2 * tree.body("b2").inertia, rtol=1e-15)


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("lnk.mass", ["'lnk.mass'", "did you mean 'link.mass'"]),
        ("tip.mass", ["'tip' is a frame on body 'link'", "link.mass"]),
        ("*.armature", ["'*.armature'", "did you mean 'hinge.armature'"]),
    ],
)
def test_a_path_that_fits_nothing_is_refused(path, words):
    assert_refused(InputError, lambda: pendulum().build().with_free(path), words)


def test_variants_are_robots_of_their_own():
    robot = mb.load("ur5")
    spread = {"*.mass": 0.2, "forearm_link.inertia": 0.3, "wrist_1_link.com": 0.01, mb.scale("gravity"): (0.9, 1.1)}
    many = mb.variants(robot, spread, size=20, seed=3)
    q, v = robot.random_state(0, 20)
    tau = np.ones((20, 6))
    together = many.dynamics().forward_dynamics(q, v, tau)
    for k in (0, 7, 19):
        for engine in ("pinocchio", "mujoco"):
            one = mb.dynamics(many[k], engine).forward_dynamics(q[k], v[k], tau[k])
            assert off(one, together[k]) < 1e-12
    assert len({float(x) for x in many.values["forearm_link.mass"]}) == 20
    assert repr(many) == "<Variants of 'ur5': 20 of 16 numbers, seed 3>"
    assert "forearm_link.mass" in str(many)


def test_variants_are_cut_as_a_list_is():
    many = mb.variants(mb.load("ur5"), {"*.mass": 0.2}, size=6, seed=3)
    some = many[1:6:2]
    assert len(some) == 3
    assert [x.mass for x in some] == [many[k].mass for k in (1, 3, 5)]
    assert some.dynamics("lagrangian").mass_matrix(np.zeros(6)).shape == (3, 6, 6)
    with pytest.raises(InputError, match="whole number from 0 to 5"):
        many[6:]
    with pytest.raises(UnsupportedError, match=r"pinocchio takes them one by one, as mbkit.dynamics\(many\[k\]"):
        many.dynamics("pinocchio")
    with pytest.raises(UnknownNameError, match="pinocchio"):
        many.dynamics("pinochio")


@pytest.mark.parametrize("path", ["*.mass", "upper_arm_link.inertial", "forearm_link.log_cholesky", mb.scale("*.mass")])
def test_a_spread_in_per_cent_is_hinted_at(path):
    robot = mb.load("ur5")
    with pytest.warns(MbkitWarning, match="10 is the standard deviation of the logarithm.* 0.1 is about 10 %") as told:
        mb.variants(robot, {path: 10}, size=20)
    assert len(told) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error", MbkitWarning)
        mb.variants(robot, {path: 1.0, "wrist_1_link.com": 10.0, "gravity.z": (-20, -1)}, size=20)


def test_the_same_seed_draws_the_same_whatever_else_varies(tmp_path):
    robot = mb.load("ur5")
    one = mb.variants(robot, {"*.mass": 0.1}, size=5, seed=1)
    two = mb.variants(robot, {"forearm_link.inertia": 0.1, "*.mass": 0.1}, size=5, seed=1)
    assert all(np.array_equal(x, two.values[name]) for name, x in one.values.items())
    assert not np.array_equal(
        one.values["forearm_link.mass"], mb.variants(robot, {"*.mass": 0.1}, size=5).values["forearm_link.mass"]
    )
    one.to_csv(tmp_path / "drawn.csv")
    rows = (tmp_path / "drawn.csv").read_text().splitlines()
    assert len(rows) == 6
    assert float(rows[1].split(",")[1]) == next(iter(one.values.values()))[0]
    assert pickle.loads(pickle.dumps(two))[3] == two[3]


@settings(max_examples=4, deadline=None)
@given(SEEDS, st.floats(0.01, 2.0))
def test_every_drawn_body_can_be(seed, spread):
    tree = random_tree(seed, 3)
    many = mb.variants(tree, {"*.inertial": spread}, size=50, seed=seed)
    for k in range(0, 50, 7):
        # The builder refuses any other.
        for body in many[k].bodies:
            second = 0.5 * np.trace(body.inertia) * np.eye(3) - body.inertia
            assert body.mass > 0
            assert np.linalg.eigvalsh(second)[0] > 0
    small = mb.variants(tree, {"*.inertial": 1e-9}, size=3, seed=seed)
    (q,), (v,), (a,), _ = states(tree, 1, seed)
    assert off(own(small[1]).inverse_dynamics(q, v, a), own(tree).inverse_dynamics(q, v, a)) < 1e-6


@pytest.mark.parametrize(
    ("spread", "words"),
    [
        ({"link.mass": (-1.0, 1.0)}, ["'link.mass' is zero or negative", "variants"]),
        ({"link.inertia.zz": (0.5, 0.6)}, ["'link' has an inertia that no matter has", "link.inertia"]),
        ({"hinge.damping": (1.0, 0.0)}, ["hinge.damping", "lower end first"]),
        ({"link.mass": lambda rng, n: rng.random(n - 1)}, ["link.mass", "(10,)"]),
        ({"link.mass": 0.1, "*.mass": 0.2}, ["link.mass", "two entries"]),
        ({"link.inertial": (0, 1)}, ["link.inertial", "one number"]),
        ({"link.mass": 1e4}, ["link.mass", "double's range"]),
    ],
)
def test_a_spread_that_is_none_is_refused(spread, words):
    assert_refused(InputError, lambda: mb.variants(pendulum().build(), spread, size=10), words)


def test_one_name_is_one_number():
    shared = pendulum(mass=mb.Parameter("m", 2.0)).build()
    with pytest.raises(InputError, match=r"'link\.mass' is a parameter already, m"):
        shared.with_free("link.mass")
    with pytest.raises(InputError, match="parameter 'm', which stands elsewhere"):
        shared.with_free(mb.scale("*.damping", name="m"))
    with pytest.raises(InputError, match="is the path of a number"):
        shared.with_free(mb.scale("*.damping", name="hinge.damping"))
    # A scale multiplies what is a parameter already.
    scaled = shared.with_free("*.mass", mb.scale("*.mass", name="s"))
    assert scaled.with_parameters(m=3.0, s=2.0).mass == 6.0
    # The name stands for the arm's mass already, in another part.
    arm = pendulum().build().with_free("link.mass")
    joined = mb.join(pendulum("base", mass=2.0).build(), arm, at="tip", prefix="a_")
    with pytest.raises(InputError, match="which stands elsewhere"):
        joined.with_free("link.mass")
    with pytest.raises(InputError, match="which stands elsewhere"):
        mb.variants(joined, {"link.mass": 0.1}, size=2)
    with pytest.raises(InputError, match="is a parameter already"):
        mb.variants(shared, {"link.mass": 0.1}, size=2)


def test_a_frame_with_a_parameter_carries_what_hangs_on_it():
    b = pendulum("base")
    b.add_frame("far", body="link", translation=(mb.Parameter("L", 1.0), 0, 0), rpy=(0.1, 0.2, 0.3))
    base = b.build()
    arm = mounted("arm", "second", "elbow", "revolute", mass=1.0, inertia=(0.1, 0.1, 0.1), axis=(0, 1, 0))
    whole = mb.join(base, arm.build(), at="far", pose=mb.spatial.pose((0.1, 0.2, 0.3)))
    b = mb.ModelBuilder.of(whole)
    b.add_payload("load", at="far", mass=1.0, translation=(0.1, 0.2, 0.3))
    dyn = own(b.build()).at(L=3.0)
    q = [0.3, 0.0]
    assert np.allclose(dyn.pose(q, "second")[:3, 3], dyn.pose(q, "load")[:3, 3], rtol=0, atol=1e-14)
    assert np.allclose(np.linalg.norm(dyn.pose(q, "far")[:3, 3]), 3.0, rtol=1e-15)
    assert off(dyn.pose(q, "load"), dyn.pose(q, "far") @ mb.spatial.pose((0.1, 0.2, 0.3))) < 1e-14


def test_what_locked_places_depend_on_is_a_number():
    b = mb.ModelBuilder.of(geared())
    b.set_coupler("gear", ratio=mb.Parameter("r", -2.0))
    free = b.build()
    with pytest.raises(InputError, match="coupler 'gear' has a parameter, r"):
        free.lock({"j1": 0.3})
    assert free.with_parameters(r=3.0).lock({"j1": 0.3}).full_state([0.0])[0] == pytest.approx(
        [1.0, 0.3, 0.0], rel=1e-15
    )


def test_a_builder_keeps_what_is_locked_the_time_and_what_was_used_as_written():
    b = pendulum()
    b.add_body("empty")
    b.add_joint("idle", "revolute", parent="link", child="empty", axis=(0, 1, 0))
    with pytest.warns(mb.errors.NonPhysicalWarning):
        odd = b.build(nonphysical="warn")
    b = mb.ModelBuilder.of(odd)
    b.add_prefix("a_")
    assert [name for name, _ in b.build().nonphysical] == ["a_empty"]
    assert mb.join(pendulum("base").build(), odd, at="tip", prefix="a_").nv == 3
    arm = mb.load("panda").lock({"panda_finger_joint1": 0.02})
    b = mb.ModelBuilder.of(arm)
    b.add_prefix("a_")
    assert b.build().full_state(arm.neutral())[0][-1] == 0.02
    b = mb.ModelBuilder.of(pendulum().build())
    b.prescribe("hinge", rate=1.0)
    assert mb.ModelBuilder.of(b.build().with_nominal({"t": 2.0})).build().time == 2.0


def test_forces_that_read_a_removed_joint_go_with_it():
    b = pendulum()
    b.add_body("second", mass=1.0, com=(0, 0, -0.5), inertia=(0.1, 0.1, 0.1))
    b.add_joint("elbow", "revolute", parent="link", child="second", axis=(0, 1, 0))
    elbow, q = ca.SX.sym("elbow"), ca.SX.sym("q")
    b.add_joint_force("servo", "hinge", elbow - q)
    b.add_gravity_compensation("link", 0.5, without=["elbow"])
    b = mb.ModelBuilder.of(b.build())
    b.remove_joint("elbow")
    left = b.build()
    assert [x.name for x in left.forces] == ["gravity compensation of link"]
    assert left.forces[0].without == ()
    assert "force 'servo'" in left.notes[-1]


def test_shapes_on_the_ground_move_with_it(tmp_path):
    from mbkit.show.scene import shapes_of

    file = tmp_path / "arm.xml"
    file.write_text(
        "<mujoco><worldbody><geom name='table' type='box' size='1 1 1' pos='0 0 -1'/>"
        "<body name='link'><joint name='j'/><geom name='rod' size='0.1'/></body></worldbody></mujoco>"
    )
    X = mb.spatial.pose((0, 0, 2.0), rpy=(np.pi / 2, 0, 0))
    (table,) = (x for x in shapes_of(mb.load(file, mount=X)) if x.name == "table")
    assert table.body == "world"
    assert np.allclose(table.translation, (0, 1, 2), atol=1e-15)
    base = pendulum("base")
    base.add_frame("turned", body="link", translation=(0.1, 0.2, 0.3), rpy=(0.3, 0.4, 0.5))
    whole = mb.join(base.build(), mb.load(file, mount=X), at="turned", pose=X, prefix="a_")
    (table,) = (x for x in shapes_of(whole) if x.name == "a_table")
    pose = mb.spatial.pose((0.1, 0.2, 0.3), rpy=(0.3, 0.4, 0.5)) @ X @ X @ mb.spatial.pose((0, 0, -1))
    assert table.body == "link"
    assert np.allclose(table.translation, pose[:3, 3], atol=1e-15)
    assert np.allclose(table.rotation, pose[:3, :3], atol=1e-15)


@pytest.mark.parametrize(
    "ask",
    [
        lambda _: mb.ModelBuilder.of("ur5"),
        lambda m: m.lock({"hinge": [[1], [1, 2]]}),
        lambda m: mb.variants(m, {"*.mass": 0.1}, size=2).dynamics(foo=1),
        lambda m: mb.variants(m, {"hinge.armature": 0.3}, size=2),
        lambda m: mb.variants(m, {mb.scale("*.mass"): (-1.0, -0.5)}, size=3),
        lambda m: mb.join(m, m, at="tip", prefix="\ud800"),
        lambda _: mb.load("ur5", mount=mb.spatial.pose((1e200, 0, 0))),
    ],
)
def test_bad_input_is_told_by_an_error_of_ours(ask):
    with pytest.raises(MbkitError):
        ask(pendulum().build())


# Texts and macros


def test_the_text_of_a_file_is_the_robot_of_the_file():
    robot = mb.load("ur5")
    text = Path(robot.source).read_text()
    assert mb.load(text) == robot
    assert not mb.load(text).source
    arm = "<mujoco><worldbody><body><joint name='j'/><geom size='0.1'/></body></worldbody></mujoco>"
    assert mb.load(f"\n{arm}").joint_names == ("j",)
    with pytest.raises(mb.errors.LoadError, match="the text given"):
        mb.load("<robot name='x'><link></robot>")


MACRO = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="arm">
  <xacro:arg name="prefix" default=""/><xacro:arg name="mass" default="2"/>
  <link name="base"/>
  <link name="$(arg prefix)link"><inertial><origin xyz="0 0 0.1"/><mass value="${2 * $(arg mass)}"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="$(arg prefix)hinge" type="continuous"><parent link="base"/><child link="$(arg prefix)link"/></joint>
</robot>"""


def test_a_xacro_file_is_expanded_with_its_arguments(tmp_path):
    file = tmp_path / "arm.urdf.xacro"
    file.write_text(MACRO)
    robot = mb.load(file, xacro={"prefix": "left_", "mass": "3"})
    assert robot.joint_names == ("left_hinge",)
    assert robot.mass == 6.0
    assert mb.load(str(file)).mass == 4.0
    file.write_text(MACRO.replace("$(arg prefix)link", "$(find nowhere)"))
    with pytest.raises(mb.errors.LoadError, match="xacro cannot expand it"):
        mb.load(file)
    with pytest.raises(InputError, match="xacro: expected a mapping"):
        mb.load(file, xacro={"mass": 3})
    with pytest.raises(InputError, match="which is no"):
        mb.load("ur5", xacro={"mass": "3"})
