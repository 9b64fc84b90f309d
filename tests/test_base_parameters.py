"""Base inertial parameters against the energies and torques of an engine, closed forms and published counts."""

from __future__ import annotations

import json
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest

import mbkit as mb
from mbkit.derivation.kinematics import Kinematics
from mbkit.derivation.links import Links
from mbkit.errors import InputError, NumericalError
from mbkit.model import KINDS, Body, JointType, Model, kind_of
from mbkit.model.base_parameters import BaseParameters, energy_regressor
from mbkit.model.model import unchecked
from tests.joint_of_ones_own import OWN
from tests.random_trees import ALL, random_tree, rotation, states
from tests.scenes import mounted


def tree_of(seed: int, n: int = 9, kinds: tuple[str, ...] = ALL, **options) -> Model:
    """Return a random tree without springs, dampers and rotors, whose energies are those of its bodies alone."""
    none = {"springs": False, "damping": False, "armature": False}
    return random_tree(seed, n, kinds, mimic=bool(seed % 2), gravity=seed % 5 != 4, **none, **options)


def with_standard(model: Model, standard: np.ndarray) -> Model:
    """Return the model with other standard parameters, (10 nb,), in the order of the tree."""
    bodies = {}
    for joint, p in zip(model.tree, standard.reshape(-1, 10), strict=True):
        mass, c = p[9], p[6:9] / p[9]
        about_origin = np.array([[p[0], p[1], p[2]], [p[1], p[3], p[4]], [p[2], p[4], p[5]]])
        bodies[joint.child] = Body(joint.child, mass, c, about_origin - mass * (c @ c * np.eye(3) - np.outer(c, c)))
    # Numbers that no matter has show as much.
    with unchecked():
        return replace(model, bodies=tuple(bodies[b.name] for b in model.bodies))


def terms(model: Model, n: int = 6) -> dict[str, np.ndarray]:
    """Return M, the torques and the energies without V's constant, at the same states for models of one shape."""
    q, v, a, _ = states(model, n)
    dyn = mb.dynamics(model, "lagrangian", compile=False)
    V = dyn.potential_energy(q)
    return {
        "M": dyn.mass_matrix(q),
        "torques": dyn.inverse_dynamics(q, v, a),
        "energy": dyn.kinetic_energy(q, v) + V - V[0],
    }


def far(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> float:
    """Return the largest difference of any term, relative to the largest number of that term."""
    return max(float(np.abs(a[k] - b[k]).max() / max(np.abs(b[k]).max(), 1.0)) for k in a)


def leading(base: BaseParameters) -> list[int]:
    return [base.standard_names.index(name) for name in base.names]


@pytest.mark.parametrize("seed", range(5))
def test_base_parameters_give_the_energies(seed):
    """T and V - V(q0) of the leading columns times the base parameters are those of the engine."""
    model = tree_of(seed)
    base, (q, v, _, _) = model.base_parameters(), states(model, 30)
    T, V = energy_regressor(model, q, v, model.gravity)
    dyn = mb.dynamics(model, "lagrangian", compile=False)
    kinetic, potential = dyn.kinetic_energy(q, v), dyn.potential_energy(q)
    kept = leading(base)
    np.testing.assert_allclose(T[:, kept] @ base.values, kinetic, rtol=0, atol=1e-11 * np.abs(kinetic).max())
    lost = (V - V[0])[:, kept] @ base.values - (potential - potential[0])
    assert np.abs(lost).max() <= 1e-11 * max(np.abs(potential).max(), 1.0)


@pytest.mark.thorough("2", "3")
@pytest.mark.parametrize("seed", range(4))
def test_what_the_matrix_does_not_show_moves_nothing(seed):
    model = tree_of(seed, 6) if seed else behind_a_floating_base("cylindrical")
    base, rng = model.base_parameters(), np.random.default_rng(seed)
    null = np.linalg.svd(base.matrix)[2][base.count :]
    change = rng.standard_normal(len(null)) @ null
    other = with_standard(model, base.standard + 0.3 * change / np.abs(change).max())
    assert far(terms(other), terms(model)) < 1e-11
    np.testing.assert_allclose(other.base_parameters().values, base.values, rtol=0, atol=1e-12)


@pytest.mark.thorough("1")
@pytest.mark.parametrize("seed", range(2))
def test_torques_tell_all_base_parameters_apart(seed):
    """The torques' regressor, by differences of the engine's torques, has full rank: none can be dropped."""
    model = tree_of(seed, 4)
    base, before = model.base_parameters(), terms(model, 40)["torques"]
    columns = []
    for k in leading(base):
        other = base.standard.copy()
        other[k] += 0.1
        change = terms(with_standard(model, other), 40)["torques"] - before
        columns.append(change.ravel() / np.linalg.norm(change))
        assert np.abs(change).max() > 1e-3, base.standard_names[k]
    sizes = np.linalg.svd(np.array(columns), compute_uv=False)
    assert sizes[base.count - 1] > 1e-4 * sizes[0]


@pytest.mark.parametrize("seed", range(2))
def test_the_form_of_the_result(seed):
    base = tree_of(seed).base_parameters()
    np.testing.assert_array_equal(base.matrix[:, leading(base)], np.eye(base.count))
    np.testing.assert_array_equal(base.values, base.matrix @ base.standard)
    # Kept columns lead: bodies stand in the tree's order, and what a row adds to its leader is led by nothing.
    assert leading(base) == sorted(leading(base))


# Counts


def chain(axes: str, *, gravity: tuple[float, float, float] = (0, 0, -9.81), seed: int = 0) -> Model:
    """Return a serial robot of turns R, slides P and screws h along random axes; r and p along z before."""
    rng = np.random.default_rng(seed)
    b = mb.ModelBuilder(axes, gravity=gravity)
    for k, letter in enumerate(axes):
        b.add_body(f"b{k}", mass=1.0 + k, com=rng.standard_normal(3), inertia=(2.0, 3.0, 4.0))
        own = {} if letter in "rp" else {"rotation": rotation(rng)}
        own |= {"pitch": 0.3} if letter == "h" else {}
        kind = {"R": "revolute", "r": "revolute", "P": "prismatic", "p": "prismatic", "h": "helical"}[letter]
        place = rng.standard_normal(3) if k else np.zeros(3)
        b.add_joint(
            f"j{k}", kind, parent=f"b{k - 1}" if k else "world", child=f"b{k}", axis=(0, 0, 1), translation=place, **own
        )
    return b.build()


@pytest.mark.thorough("6", "7")
@pytest.mark.parametrize("n", [1, 2, 3, 4, 6, 7])
def test_revolute_chains_have_seven_a_joint_less_four(n):
    """Mayeda, Yoshida and Osuka 1990: 7N - 4β, two less with the first axis upright; β axes parallel to the first."""
    for beta in range(1, n + 1):
        axes = "r" * (beta - 1) + "R" * (n - beta)
        assert chain("R" + axes).base_parameters().count == 7 * n - 4 * beta
        assert chain("r" + axes).base_parameters().count == 7 * n - 4 * beta - 2
        assert chain("r" + axes, gravity=(0, 0, 0)).base_parameters().count == 7 * n - 4 * beta - 2


def test_slides_have_four_behind_two_turns_and_less_before():
    """Khalil and Dombre 2002, ch. 9.4.2: a slide keeps m and h; before and behind the first axis of turns some fall."""
    assert chain("RRP").base_parameters().count == 14 - 4 + 4
    assert chain("rRPRRR").base_parameters().count == 7 * 5 + 4 - 6
    # Behind one turn the first moment along its axis is not seen; before any turn nothing but the mass is.
    assert chain("RPR").base_parameters().count == 3 + 3 + 7
    # Of a slide along that axis the first moment is the parent's.
    assert chain("RpR").base_parameters().count == 3 + 1 + 7
    assert chain("P").base_parameters().names == ("b0.m",)
    assert chain("PP").base_parameters().count == 2
    assert chain("PR").base_parameters().count == 1 + 3


def denavit_hartenberg(name: str, rows: list[tuple[str, float, float, float]]) -> Model:
    """Return a robot from joint, alpha/right angles, d and r of Khalil and Kleinfinger 1986; bodies are general."""
    rng = np.random.default_rng(0)
    b = mb.ModelBuilder(name)
    for k, (kind, alpha, d, r) in enumerate(rows):
        c, s = np.round(np.cos(alpha * np.pi / 2)), np.round(np.sin(alpha * np.pi / 2))
        R = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
        b.add_body(f"link{k + 1}", mass=1.0 + k, com=rng.standard_normal(3), inertia=(2.0, 3.0, 4.0))
        b.add_joint(
            f"joint{k + 1}",
            "revolute" if kind == "R" else "prismatic",
            parent=f"link{k}" if k else "world",
            child=f"link{k + 1}",
            axis=(0, 0, 1),
            rotation=R,
            translation=np.array([d, 0, 0]) + R @ [0, 0, r],
        )
    return b.build()


RX90 = [("R", 0, 0, 0), ("R", 1, 0, 0), ("R", 0, 0.45, 0), ("R", -1, 0, 0.45), ("R", 1, 0, 0), ("R", -1, 0, 0)]
PUMA = [
    ("R", 0, 0, 0),
    ("R", -1, 0, 0),
    ("R", 0, 0.4318, 0.15005),
    ("R", -1, 0.0203, 0.4318),
    ("R", 1, 0, 0),
    ("R", -1, 0, 0),
]
STANFORD = [("R", 0, 0, 0), ("R", -1, 0, 0.15), ("P", 1, 0, 0.5), ("R", 0, 0, 0), ("R", -1, 0, 0), ("R", 1, 0, 0)]


def test_counts_of_known_robots():
    """Bodies alone, without friction and rotors.

    Axes of the arms are parallel or at right angles, the first one upright, and no second one parallel to it, so
    Mayeda, Yoshida and Osuka's 7N - 4β - 2 is 36 of six turns and 43 of seven. The slide of the Stanford arm adds four.
    """
    assert denavit_hartenberg("RX90", RX90).base_parameters().count == 36
    assert denavit_hartenberg("Puma 560", PUMA).base_parameters().count == 36
    assert denavit_hartenberg("Stanford arm", STANFORD).base_parameters().count == 7 * 5 + 4 - 6
    assert mb.load("ur5").base_parameters().count == mb.load("ur10").base_parameters().count == 36
    # Gaz et al. 2019, Dynamic identification of the Franka Emika Panda robot, identify the arm. Its two fingers slide
    # along one axis: both masses, and the difference of their first moments. Their sum moves as the hand's.
    panda = mb.load("panda").base_parameters()
    assert panda.count - sum("finger" in name for name in panda.names) == 43
    assert sum("finger" in name for name in panda.names) == 5


def test_the_regrouped_numbers_of_the_rx90():
    """Khalil and Dombre 2002, ch. 9.4, the example of the Stäubli RX-90, with D3 = RL4 = 0.45 m and without rotors."""
    base = denavit_hartenberg("RX90", RX90).base_parameters()
    sums = {name: text for name, text in zip(base.names, base.combinations, strict=True) if name != text}

    def masses(first: int, factor: str) -> str:
        return "".join(f" {factor} link{k}.m" for k in range(first, 7))

    assert sums == {
        "link1.Izz": f"link1.Izz + link2.Iyy + link3.Iyy{masses(3, '+ 0.2025')}",
        "link2.Ixx": f"link2.Ixx - link2.Iyy{masses(3, '- 0.2025')}",
        "link2.Ixz": "link2.Ixz - 0.45 link3.hz",
        "link2.Izz": f"link2.Izz{masses(3, '+ 0.2025')}",
        "link2.hx": f"link2.hx{masses(3, '+ 0.45')}",
        "link3.Ixx": f"link3.Ixx - link3.Iyy + link4.Iyy + 0.9 link4.hz{masses(4, '+ 0.2025')}",
        "link3.Izz": f"link3.Izz + link4.Iyy + 0.9 link4.hz{masses(4, '+ 0.2025')}",
        "link3.hy": f"link3.hy + link4.hz{masses(4, '+ 0.45')}",
        "link4.Ixx": "link4.Ixx - link4.Iyy + link5.Iyy",
        "link4.Izz": "link4.Izz + link5.Iyy",
        "link4.hy": "link4.hy - link5.hz",
        "link5.Ixx": "link5.Ixx - link5.Iyy + link6.Iyy",
        "link5.Izz": "link5.Izz + link6.Iyy",
        "link5.hy": "link5.hy + link6.hz",
        "link6.Ixx": "link6.Ixx - link6.Iyy",
    }


def test_a_planar_arm_of_two_links():
    """In gravity: two inertias about the axes and the first moments; without it those of the first link fall."""
    b = mb.ModelBuilder("arm", gravity=(0, -9.81, 0))
    for name, parent, at in (("upper", "world", 0.0), ("lower", "upper", 0.7)):
        b.add_body(name, mass=2.0, com=(0.3, 0.1, 0.05), inertia=(0.1, 0.2, 0.25))
        b.add_joint(f"to_{name}", "revolute", parent=parent, child=name, axis=(0, 0, 1), translation=(at, 0, 0))
    arm = b.build()
    assert arm.base_parameters().combinations == (
        "upper.Izz + 0.49 lower.m",
        "upper.hx + 0.7 lower.m",
        "upper.hy",
        "lower.Izz",
        "lower.hx",
        "lower.hy",
    )
    assert arm.without("gravity").base_parameters().names == ("upper.Izz", "lower.Izz", "lower.hx", "lower.hy")


@pytest.mark.parametrize("seed", range(3))
def test_as_many_numbers_as_the_derivation_keeps(seed):
    """Behind a floating base nothing but regrouping counts; the derivation does it on its own, in its own frames."""
    tree = tree_of(seed, 8, ("revolute", "prismatic", "helical", "ball"))
    model = floating(tree)
    links = Links(Kinematics(model)).links
    numbers = {link.joint.child: [link.inertia.mass, *link.inertia.moment, *link.inertia.inertia] for link in links}
    names = model.base_parameters().names
    for body, own in numbers.items():
        assert sum(name.startswith(f"{body}.") for name in names) == sum(float(x) != 0.0 for x in own)


def floating(model: Model) -> Model:
    """Return the model with a free joint in the place of all joints on the world."""
    given = {"com": (0.1, 0.2, 0.3), "inertia": (2.0, 3.0, 4.0)}
    b = mounted("floating", "base", "float", "free", gravity=model.gravity, mass=3.0, **given)
    for body in model.bodies:
        b.add_body(body.name, mass=body.mass, com=body.com, inertia=body.inertia)
    for j in model.joints:
        parent = "base" if j.parent == "world" else j.parent
        own = {"axis": j.axes[0]} if len(j.axes) else {}
        own |= {"pitch": j.pitch} if j.pitch else {}
        b.add_joint(j.name, j.kind, parent=parent, child=j.child, rotation=j.rotation, translation=j.translation, **own)
    return b.build()


# Kinds of joints, one by one


@pytest.mark.parametrize(
    ("kind", "count"),
    [
        ("fixed", 0),
        ("revolute", 7),
        ("continuous", 7),
        ("prismatic", 4),
        ("helical", 9),
        ("universal", 9),
        ("spherical_zyx", 9),
        ("ball", 9),
        ("planar", 9),
        ("free", 10),
        *zip(OWN, (9, 10), strict=True),
    ],
)
def test_what_a_joint_of_each_type_leaves(kind, count):
    names = behind_a_floating_base(kind).base_parameters().names
    assert len(names) == 10 + count
    assert sum(name.startswith("tip.") for name in names) == count


def behind_a_floating_base(kind: str) -> Model:
    b = mb.ModelBuilder(kind)
    b.add_body("base", mass=3.0, com=(0.1, 0.2, 0.3), inertia=(2.0, 3.0, 4.0))
    b.add_body("tip", mass=2.0, com=(0.3, 0.1, 0.2), inertia=(2.0, 3.0, 4.0))
    b.add_joint("float", "free", parent="world", child="base")
    axes = {"axis": (0.6, 0.64, 0.48)} if kind_of(kind).n_axes == 1 else {}
    axes |= {"axis": (1, 0, 0), "axis2": (0, 1, 0)} if kind_of(kind).n_axes == 2 else {}
    axes |= {"pitch": 0.3} if kind_of(kind).pitched else {}
    b.add_joint("joint", kind, parent="base", child="tip", translation=(0.1, 0.2, 0.3), **axes)
    return b.build()


def test_an_axis_that_is_almost_along_a_frames_axis_gives_no_large_factors():
    """The inertia about z cannot be expressed by others where the axis is almost z."""
    for tilt in (1e-3, 1e-5):
        base = leaning(tilt).base_parameters()
        assert np.abs(base.matrix).max() < 20
        assert {n for n in base.names if n.startswith("tip.")} >= {"tip.Izz", "tip.hx", "tip.hy"}


def leaning(tilt: float) -> Model:
    b = mb.ModelBuilder("leaning")
    for name in ("base", "tip"):
        b.add_body(name, mass=3.0, com=(0.1, 0.2, 0.3), inertia=(2.0, 3.0, 4.0))
    b.add_joint("float", "free", parent="world", child="base")
    b.add_joint("joint", "revolute", parent="base", child="tip", axis=(tilt, tilt, 1))
    return b.build()


def tilted(angle: float) -> Model:
    """Return two turns whose axes are parallel up to an angle."""
    b = mb.ModelBuilder("tilted")
    for k, R in enumerate((np.eye(3), np.array([[1, 0, 0], [0, 1, -angle], [0, angle, 1]]))):
        b.add_body(f"b{k}", mass=3.0, com=(0.1, 0.2, 0.3), inertia=(2.0, 3.0, 4.0))
        place = {"rotation": np.linalg.qr(R)[0] * np.sign(np.diag(np.linalg.qr(R)[1])), "translation": (1.0, 0, 0)}
        b.add_joint(f"j{k}", "revolute", parent=f"b{k - 1}" if k else "world", child=f"b{k}", axis=(0, 0, 1), **place)
    return b.build()


def test_axes_that_a_file_has_rounded_count_as_parallel():
    """Two upright axes show four combinations; one tilted by as much as π to nine digits too."""
    assert tilted(0.0).base_parameters().count == 4
    assert tilted(1e-9).base_parameters().count == 4
    assert tilted(0.3).base_parameters().count == 8
    with pytest.raises(NumericalError, match="no clear gap"):
        tilted(0.3).base_parameters(tolerance=0.3)


@pytest.mark.parametrize("seed", range(3))
def test_the_result_does_not_depend_on_the_world(seed):
    """A robot that is turned with its gravity, by any rotation, and stands elsewhere is the same robot."""
    R, upright = rotation(np.random.default_rng(seed)), chain("rRRP")
    first, *others = upright.joints
    joints = (replace(first, rotation=R @ first.rotation, translation=(0, 4e5, 3e5)), *others)
    turned = replace(upright, joints=joints, gravity=R @ upright.gravity).base_parameters()
    assert turned.names == upright.base_parameters().names
    np.testing.assert_allclose(turned.matrix, upright.base_parameters().matrix, rtol=0, atol=1e-9)


class Eccentric(JointType):
    """A turn about an axis along z that stands beside the frames."""

    name, nq, nv, angular = "eccentric", 1, 1, (0,)
    at = 0.3

    def placement(self, m, joint, q):  # noqa: ARG002
        c, s, r = m.cos(q[0]), m.sin(q[0]), self.at
        return [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], [r - c * r, -s * r, 0.0]

    def twist(self, m, joint, q, v):  # noqa: ARG002
        return [0.0, -self.at * v[0], 0.0], [0.0, 0.0, v[0]]


class Rolling(JointType):
    """A wheel of radius one that rolls along x: at each pose another of its points is at rest."""

    name, nq, nv, angular, screws = "rolling", 1, 1, (0,), (0,)

    def placement(self, m, joint, q):  # noqa: ARG002
        c, s = m.cos(q[0]), m.sin(q[0])
        return [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]], [q[0], 0.0, 0.0]

    def twist(self, m, joint, q, v):  # noqa: ARG002
        return [m.cos(q[0]) * v[0], 0.0, m.sin(q[0]) * v[0]], [0.0, v[0], 0.0]


@pytest.mark.parametrize(("joint_type", "count"), [(Eccentric(), 7), (Rolling(), 9)], ids=["eccentric", "rolling"])
def test_points_at_rest_beside_the_frame(monkeypatch, joint_type, count):
    """A turn about any axis keeps seven; of a wheel that rolls only the direction of its axis is at rest."""
    monkeypatch.setitem(KINDS, joint_type.name, joint_type)
    model = behind_a_floating_base(joint_type.name)
    base = model.base_parameters()
    assert sum(name.startswith("tip.") for name in base.names) == count
    null = np.linalg.svd(base.matrix)[2][base.count :]
    change = np.random.default_rng(0).standard_normal(len(null)) @ null
    assert far(terms(with_standard(model, base.standard + 0.1 * change)), terms(model)) < 1e-11


@pytest.mark.parametrize("size", [1e-9, 1e-4, 1e4])
def test_the_result_does_not_depend_on_the_unit_of_length(size):
    """Nor on how strong gravity is, which stays as it is."""
    for large in (chain("RRPR"), behind_a_floating_base("helical"), chain("RhR"), chain("h")):
        joints = (replace(j, translation=size * j.translation, pitch=size * j.pitch) for j in large.joints)
        a, b = large.base_parameters(), replace(large, joints=tuple(joints)).base_parameters()
        assert a.names == b.names
        power = size ** np.tile([0.0] * 6 + [1.0] * 3 + [2.0], len(large.bodies))
        np.testing.assert_allclose(b.matrix, a.matrix / power[leading(a), None] * power, rtol=1e-9, atol=0)


def test_the_last_parameters_of_a_link_are_those_that_move_to_the_parent():
    """As in Khalil and Dombre's rules, also for an axis that is along none of the frame's."""
    names = [name for name in behind_a_floating_base("revolute").base_parameters().names if name.startswith("tip.")]
    assert names == [f"tip.{kind}" for kind in ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "hx", "hy")]


def test_rounding_shows_in_no_combination():
    """Neither that of products nor that of π in Talos's file, with twelve digits."""
    for name in ("ur5", "panda", "talos_full_v2"):
        matrix = np.abs(mb.load(name).base_parameters().matrix)
        assert matrix[matrix > 0].min() > 1e-6


# The result, and what is refused


def test_text_and_data():
    model = mb.catalog.acrobot()
    base = model.base_parameters()
    assert str(base) == base.text
    assert f"{base.count} base parameters of 20" in str(base)
    assert all(text in str(base) for text in base.combinations)
    assert f"<td>{base.names[0]}</td>" in base._repr_html_()
    assert str(base.count) in repr(base)
    again = pickle.loads(pickle.dumps(base))
    assert again == base
    assert not again.matrix.flags.writeable
    data = json.loads(json.dumps(base.to_dict()))
    assert (data["values"], data["names"]) == (base.values.tolist(), list(base.names))


def test_names_from_files_are_shown_as_text():
    b = mounted(
        "<b>", "<i>\x1b[2J", "j", "revolute", mass=1.0, com=(0.1, 0.2, 0.3), inertia=(2.0, 3.0, 4.0), axis=(0, 1, 0)
    )
    base = b.build().base_parameters()
    assert "\x1b" not in str(base) + repr(base) + base._repr_html_()
    assert not {"<i>", "<b>"} & set(re.findall("<.*?>", base._repr_html_()))


def test_what_does_not_move_has_none():
    b = mounted("still", "rock", "foot", "fixed", mass=1.0, com=(0.1, 0.2, 0.3), inertia=(2.0, 3.0, 4.0))
    base = b.build().base_parameters()
    assert (base.count, base.matrix.shape, base.values.shape) == (0, (0, 10), (0,))
    assert "0 base parameters of 10" in str(base)


def test_bodies_on_fixed_joints_are_one():
    b = mb.ModelBuilder("welded")
    for name in ("arm", "tool"):
        b.add_body(name, mass=1.0, com=(0.1, 0.2, 0.3), inertia=(2.0, 3.0, 4.0))
    b.add_joint("hinge", "revolute", parent="world", child="arm", axis=(0, 1, 0))
    b.add_joint("weld", "fixed", parent="arm", child="tool", translation=(0.5, 0, 0))
    assert b.build().base_parameters().combinations == (
        "arm.Iyy + tool.Iyy + tool.hx + 0.25 tool.m",
        "arm.hx + tool.hx + 0.5 tool.m",
        "arm.hz + tool.hz",
    )


def test_named_parameters_are_taken_at_their_values():
    model = mb.catalog.pendulum(mass=mb.Parameter("m", 2.0))
    assert model.base_parameters() == mb.catalog.pendulum(mass=2.0).base_parameters()
    with pytest.raises(InputError, match="no value for parameter 'm'"):
        mb.catalog.pendulum(mass=mb.Parameter("m")).base_parameters()


def test_a_follower_that_stands_still_shows_nothing():
    b = mb.ModelBuilder("stuck")
    for name, parent in (("leader", "world"), ("follower", "world")):
        b.add_body(name, mass=1.0, com=(0.1, 0.2, 0.3), inertia=(2.0, 3.0, 4.0))
        mimic = {"mimic": ("to_leader", 0.0, 0.3)} if name == "follower" else {}
        b.add_joint(f"to_{name}", "revolute", parent=parent, child=name, axis=(0.6, 0, 0.8), **mimic)
    model = b.build()
    assert {name.partition(".")[0] for name in model.base_parameters().names} == {"leader"}
    assert model.base_parameters().count == 3


def test_limits_armature_and_springs_do_not_count():
    model = random_tree(3, 6)
    bare = model.without("limits", "armature", "springs", "damping").base_parameters()
    np.testing.assert_array_equal(model.base_parameters().matrix, bare.matrix)


@pytest.mark.parametrize("tolerance", [1.0, "small"])
def test_tolerances_out_of_range(tolerance):
    with pytest.raises(InputError, match="tolerance"):
        mb.catalog.pendulum().base_parameters(tolerance=tolerance)
