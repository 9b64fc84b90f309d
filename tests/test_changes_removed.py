"""Parts of a model removed, and mimic joints that follow another or none."""

from __future__ import annotations

import re

import numpy as np
import pytest

import mbkit as mb
from mbkit.errors import ModelError
from tests.random_trees import off

CLOSE = 1e-13
TERMS = ("mass_matrix", "nle", "gravity", "passive")


def plain() -> mb.ModelBuilder:
    b = mb.ModelBuilder("two links")
    for k, parent in enumerate(("world", "link0", "link1")):
        b.add_body(f"link{k}", mass=1.0 + k, com=(0.1, 0, -0.3), inertia=(0.1, 0.1, 0.02))
        b.add_joint(f"hinge{k}", "revolute", parent=parent, child=f"link{k}", axis=(0, 1, 0), translation=(0, 0, -0.5))
    return b


#: Every kind of part that can be removed, under the name "x" where it has one of its own.
ADDED = {
    "frame": lambda b: b.add_frame("x", body="link1"),
    "spring": lambda b: b.add_spring(
        "x", body_a="world", body_b="link1", point_a=(1, 0, 0), stiffness=mb.Parameter("k", 3.0)
    ),
    "coupling": lambda b: b.add_coupling("x", {"hinge0": 1.0, "hinge1": 2.0}, stiffness=2.0, damping=1.0, armature=0.3),
    "loop": lambda b: b.add_loop("x", "distance", body_a="world", body_b="link2", translation_a=(2, 0, 0), length=2.0),
    "coupler": lambda b: b.add_coupler("x", "hinge1", "hinge0", ratio=2.0),
    "prescribed": lambda b: b.prescribe("hinge0", rate=1.0),
    "force": lambda b: b.add_joint_force("x", "hinge1", lambda _t, q, _v: -(q**3)),
    "no slip": lambda b: b.add_blade("x", body_a="link2", axis_a=(1, 0, 0)),
}


@pytest.mark.parametrize("kind", ADDED)
def test_what_was_added_and_removed_leaves_the_model_as_it_was(kind):
    b = plain()
    ADDED[kind](b)
    b = mb.ModelBuilder.of(b.build())
    name = "hinge0" if kind == "prescribed" else "x"
    b.remove(name)
    removed, model = b.build(), plain().build()
    assert removed.digest == model.digest
    assert not removed.parameters
    assert removed.notes[-1] == f"removed {kind} {name!r}"


def test_of_several_kinds_one_is_named():
    b = plain()
    for kind in ("frame", "spring", "loop"):
        ADDED[kind](b)
    both = b.build()
    b = mb.ModelBuilder.of(both)
    b.remove("x", "spring")
    assert not b.build().springs
    assert len(b.build().loops) == len(b.build().frames) == 1
    b.remove("x")
    with pytest.raises(ModelError, match="one of 'frame', 'loop', which all have this name"):
        b.build()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda b: b.remove("nothing"), "'nothing': there is none of this name"),
        (lambda b: b.remove("sprnig"), "did you mean 'spring'"),
        (lambda b: b.remove("hinge1"), "remove_joint('hinge1')"),
        (lambda b: b.remove("link1"), "remove_joint('hinge1')"),
        (lambda b: b.remove("spring", "rope"), "unknown kind 'rope'; there are 'frame', 'spring'"),
        (lambda b: b.remove("spring", "loop"), "none of this name"),
        (lambda b: b.remove(3), "remove: name: expected a name, got 3"),
        (lambda b: b.remove("spring", 3), "unknown kind 3"),
        (lambda b: b.remove("tip"), "force 'push' acts there"),
    ],
)
def test_what_cannot_be_removed_is_told(change, words):
    b = plain()
    b.add_spring("spring", body_a="world", body_b="link1", point_a=(1, 0, 0), stiffness=3.0)
    b.add_frame("tip", body="link2", translation=(0, 0, -1))
    b.add_force("push", "tip", force=(1.0, 0.0, 0.0))
    before = b.build()
    b = mb.ModelBuilder.of(before)
    change(b)
    with pytest.raises(ModelError, match=re.escape(words)):
        b.build()


def followed(*mimics: tuple[str, tuple[str, float, float]]) -> mb.model.Model:
    b = plain()
    for joint, mimic in mimics:
        b.set_joint(joint, mimic=mimic)
    return b.build()


def reduced(model: mb.model.Model, ratios: np.ndarray, offsets: np.ndarray, q: float, v: float) -> list[np.ndarray]:
    """Return M, nle, gravity and passive of one coordinate, of the terms of all three."""
    dyn = mb.dynamics(model, "pinocchio")
    at, rate = ratios * q + offsets, ratios * v
    M, h, g, p = dyn.mass_matrix(at), dyn.nle(at, rate), dyn.gravity(at), dyn.passive(at, rate)
    return [ratios @ M @ ratios, ratios @ h, ratios @ g, ratios @ p]


def test_a_mimic_joint_follows_with_other_numbers_through_a_chain():
    chain = followed(("hinge1", ("hinge0", 2.0, 0.1)), ("hinge2", ("hinge1", -0.5, 0.3)))
    b = mb.ModelBuilder.of(chain)
    # The leader follows another joint, so that this one follows that.
    b.set_joint("hinge2", mimic=("hinge1", 3.0, -0.2))
    changed = b.build()
    assert changed.nv == 1
    assert (changed.joint("hinge2").mimic.joint, changed.joint("hinge2").mimic.ratio) == ("hinge0", 6.0)
    own = mb.dynamics(changed, "lagrangian")
    values = own.mass_matrix([0.4])[0, 0], own.nle([0.4], [0.7])[0], own.gravity([0.4])[0], own.passive([0.4], [0.7])[0]
    expected = reduced(plain().build(), np.array([1.0, 2.0, 6.0]), np.array([0.0, 0.1, 0.1]), 0.4, 0.7)
    assert np.abs(np.subtract(values, expected)).max() < CLOSE * np.abs(expected).max()


def test_a_mimic_joint_is_independent_again():
    b = mb.ModelBuilder.of(followed(("hinge1", ("hinge0", 2.0, 0.1)), ("hinge2", ("hinge1", -0.5, 0.3))))
    b.set_joint("hinge1", damping=0.3)
    assert b.build().joint("hinge1").mimic is not None
    b.set_joint("hinge1", mimic=None)
    one = b.build()
    # What followed it follows the first joint, as the model says.
    assert one.nv == 2
    assert one.joint("hinge2").mimic.joint == "hinge0"
    b.set_joint("hinge2", mimic=None)
    b.set_joint("hinge1", damping=0.0)
    free = b.build()
    q, v = free.random_state(0)
    for term in TERMS:
        arguments = (q,) if term in ("mass_matrix", "gravity") else (q, v)
        a, c = (getattr(mb.dynamics(x, "lagrangian"), term)(*arguments) for x in (free, plain().build()))
        assert off(a, c) < CLOSE


@pytest.mark.parametrize(
    ("mimic", "words"),
    [
        (("hing0", 1.0, 0.0), "mimics unknown joint 'hing0'; near: 'hinge0'"),
        (("hinge1", 1.0, 0.0), "mimics in a circle"),
        (("hinge0", "two", 0.0), "mimic ratio"),
        (("hinge0", 1.0), "expected (joint, ratio, offset)"),
        (False, "expected (joint, ratio, offset)"),
    ],
)
def test_a_mimic_that_cannot_be_is_told(mimic, words):
    b = mb.ModelBuilder.of(plain().build())
    b.set_joint("hinge1", mimic=mimic)
    with pytest.raises(ModelError, match=re.escape(words)):
        b.build()
