"""Joint couplings: the same terms in every engine, and MJCF tendons and actuators as MuJoCo compiles them."""

# ruff: noqa: E501 -- a description is easier to read on one line
from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import mbkit as mb
from mbkit.derivation import Equations
from mbkit.derivation.mass_matrix_solve import elimination_order, elimination_size
from mbkit.errors import KnownDefectWarning, ModelError, UnsupportedError
from mbkit.model import JointCoupling, Model, ModelBuilder
from mbkit.model.validation import sample_mass_matrix
from tests.random_trees import ALL, SOUND, random_tree

EPS = np.finfo(float).eps


def number(x: float) -> str:
    return repr(float(x))


# MJCF against MuJoCo's compiler.


def mjcf_tree(rng: np.random.Generator, count: int) -> tuple[str, list[list[str]]]:
    """Return bodies on hinges and slides, and the joints from the ground to each joint."""
    children: dict[int, list[int]] = {}
    parents = [-1, *(int(rng.integers(-1, k)) for k in range(1, count))]
    for k, parent in enumerate(parents):
        children.setdefault(parent, []).append(k)

    def body(k: int) -> str:
        pos, axis, com = (" ".join(map(number, rng.normal(size=3))) for _ in range(3))
        kind = rng.choice(["hinge", "slide"])
        joint = f'name="j{k}" type="{kind}" axis="{axis}" ref="{number(rng.normal())}"'
        for name in ("armature", "stiffness", "damping", "springref"):
            if rng.random() < 0.4:
                joint += f' {name}="{number(rng.uniform(0.1, 2))}"'
        inside = f'<site name="s{k}" pos="{com}"/>' + "".join(body(c) for c in children.get(k, []))
        inertial = f'<inertial pos="{com}" mass="{number(rng.uniform(0.5, 2))}" diaginertia=".3 .4 .5"/>'
        return f'<body pos="{pos}"><joint {joint}/>{inertial}{inside}</body>'

    chains: list[list[str]] = []
    for k, parent in enumerate(parents):
        chains.append([*(chains[parent] if parent >= 0 else []), f"j{k}"])
    return "".join(body(k) for k in children[-1]), chains


def random_attributes(rng: np.random.Generator, tag: str, *, in_class: bool) -> str:
    """Return an actuator's numbers: few, so that defaults show."""
    u = [number(x) for x in rng.uniform(0.1, 3, 4)]
    some = {
        "gear": number(rng.choice([-2.0, 0.5, 3.0])),
        "armature": u[0],
        "damping": u[1],
        **{
            "general": {"gainprm": u[2], "biastype": str(rng.choice(["none", "affine"])), "biasprm": f"{u[0]} -{u[1]}"},
            "pid": {"kp": u[2], "kv": u[3]},
            "position": {"kp": u[2], **({"kv": u[3]} if in_class or rng.random() < 0.5 else {"dampratio": u[3]})},
            "intvelocity": {"kp": u[2], "kv": u[3], "actrange": "-1 1"},
            "velocity": {"kv": u[2]},
            "damper": {"kv": u[2], "ctrlrange": "0 1"},
            "cylinder": {"area": u[2], "bias": f"{u[0]} -{u[1]} -{u[3]}"},
        }.get(tag, {}),
    }
    needed = {"intvelocity": ("actrange",), "damper": ("ctrlrange",)}.get(tag, ())
    return "".join(f' {k}="{v}"' for k, v in some.items() if k in needed or rng.random() < 0.5)


def random_transmissions(seed: int) -> str:
    rng = np.random.default_rng(seed)
    bodies, chains = mjcf_tree(rng, 6)
    tags = ("general", "motor", "position", "velocity", "cylinder", "pid", "intvelocity", "damper")

    def default(name: str, depth: int) -> str:
        tendon = f'<tendon damping="{number(rng.uniform(0, 2))}"/>' if rng.random() < 0.5 else ""
        own = "".join(
            f"<{t}{random_attributes(rng, t, in_class=True)}/>" for t in rng.choice(tags[:5], 2, replace=False)
        )
        inner = default("inner", depth + 1) if not depth else ""
        return f'<default class="{name}">{tendon}{own}{inner}</default>'

    def class_() -> str:
        return str(rng.choice(["", ' class="outer"', ' class="inner"']))

    tendons = actuators = ""
    for k in range(3):
        # MuJoCo leaves a rotor between branches out of M, so rotors here are within a branch.
        chain = chains[int(rng.integers(len(chains)))]
        joints = list(rng.choice(chain, size=min(len(chain), 3), replace=False))
        given = f' armature="{number(rng.uniform(0.1, 2))}"'
        given += f' stiffness="{number(rng.uniform(0.1, 5))}"' if rng.random() < 0.7 else ""
        given += rng.choice(["", ' springlength="-1"', ' springlength=".3"', ' springlength="-.4 -.4"'])
        inside = "".join(f'<joint joint="{j}" coef="{number(rng.normal())}"/>' for j in joints)
        tendons += f'<fixed name="t{k}"{given}{class_()}>{inside}</fixed>'
    for _ in range(5):
        tag = str(rng.choice(tags))
        at = f'tendon="t{rng.integers(3)}"' if rng.random() < 0.5 else f'joint="j{rng.integers(6)}"'
        actuators += f"<{tag} {at}{class_()}{random_attributes(rng, tag, in_class=False)}/>"
    a, b = rng.choice(6, 2, replace=False)
    tendons += f'<spatial name="line" stiffness="2" damping=".3" springlength=".7"><site site="s{a}"/><site site="s{b}"/></spatial>'
    tendons += f'<spatial stiffness="3" springlength="0"><site site="ground"/><site site="s{a}"/></spatial>'
    ground = '<frame pos="1 2 3"><site name="ground" pos="0 0 1"/></frame>'
    flags = "".join(f' {name}="disable"' for name in ("spring", "damper", "actuation") if rng.random() < 0.15)
    return (
        f'<mujoco><compiler angle="{rng.choice(["degree", "radian"])}"/>'
        f'<option><flag constraint="disable"{flags}/></option>'
        f"<default>{default('outer', 0)}</default><worldbody>{ground}{bodies}</worldbody><tendon>{tendons}</tendon>"
        f"<actuator>{actuators}</actuator></mujoco>"
    )


def mujoco_terms(text: str, q: Any, v: Any) -> tuple[Any, Any, Any]:
    """Return M, the passive force with that of actuators at zero control, and the accelerations, as MuJoCo has them."""
    m = mujoco.MjModel.from_xml_string(text)
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:] = q, v
    d.ctrl[:] = 0.0
    mujoco.mj_forward(m, d)
    M = np.zeros((m.nv, m.nv))
    mujoco.mj_fullM(m, d, M)
    return M, d.qfrc_passive + d.qfrc_actuator, np.array(d.qacc)


@pytest.mark.parametrize("seed", range(8))
def test_random_tendons_and_actuators_are_what_mujoco_makes_of_them(seed, tmp_path):
    text = random_transmissions(seed)
    (tmp_path / "robot.xml").write_text(text)
    model = mb.load(tmp_path / "robot.xml", actuators=True)
    q, v = model.random_state(np.random.default_rng(seed))
    M, force, a = mujoco_terms(text, q, v)
    dyn = mb.dynamics(model, "pinocchio")
    np.testing.assert_allclose(dyn.mass_matrix(q), M, rtol=0, atol=1e4 * EPS * np.abs(M).max())
    np.testing.assert_allclose(dyn.passive(q, v), force, rtol=0, atol=1e4 * EPS * max(1, np.abs(force).max()))
    np.testing.assert_allclose(
        dyn.forward_dynamics(q, v, np.zeros(model.nv)), a, rtol=0, atol=1e3 * EPS * np.linalg.cond(M) * np.abs(a).max()
    )


def loaded(folder: Path, text: str) -> Model:
    path = folder / "robot.xml"
    path.write_text(text)
    return mb.load(path, actuators=True)


BODY = '<inertial pos="0 0 -.5" mass="1" diaginertia=".1 .1 .1"/>'
PLAIN = (
    f'<worldbody><body><joint name="a" axis="0 1 0" damping=".5"/>{BODY}<body pos="0 0 -1"><joint name="b" axis="0 1 0"/>'
    f'{BODY}<site name="s"/></body></body><body><joint name="c" type="ball"/>{BODY}<site name="t"/></body></worldbody>'
)


@pytest.mark.parametrize("seed", range(3))
def test_by_default_the_servos_of_a_file_do_not_act(seed, tmp_path):
    """As in MuJoCo where the flag of actuation is off: rotors and the damping of transmissions are left."""
    text = random_transmissions(seed).replace(' actuation="disable"', "")
    path = tmp_path / "robot.xml"
    path.write_text(text)
    model = mb.load(path)
    q, v = model.random_state(np.random.default_rng(seed))
    M, force, _ = mujoco_terms(text.replace("<flag ", '<flag actuation="disable" '), q, v)
    dyn = mb.dynamics(model, "pinocchio")
    np.testing.assert_allclose(dyn.mass_matrix(q), M, rtol=0, atol=1e4 * EPS * np.abs(M).max())
    np.testing.assert_allclose(dyn.passive(q, v), force, rtol=0, atol=1e4 * EPS * max(1, np.abs(force).max()))


def test_the_repr_and_check_say_whether_servos_act(tmp_path):
    servo = '<actuator><position name="servo" joint="b" kp="5" kv="2"/><motor name="drive" joint="a"/></actuator>'
    path = tmp_path / "robot.xml"
    path.write_text(f"<mujoco>{PLAIN}{servo}</mujoco>")
    without, acting = mb.load(path), mb.load(path, actuators=True)
    assert "servos left out" in repr(without)
    assert "servos act at zero control" in repr(acting)
    assert (without.joint("b").stiffness, acting.joint("b").stiffness, acting.joint("b").damping) == (0, 5, 2)
    note = next(n for n in without.notes if n.startswith("servos"))
    assert note.endswith("with actuators=True they act at zero control: 'servo' on b: stiffness 5, damping 2")
    found = mb.compare(without, ["pinocchio", "lagrangian"], samples=2, terms_only=True).findings
    assert [x.says for x in found if x.kind == "actuators"] == [note]
    path.write_text(f'<mujoco>{PLAIN}<actuator><motor joint="a"/></actuator></mujoco>')
    assert "servos" not in repr(mb.load(path))
    with pytest.raises(mb.errors.InputError, match="actuators: expected True or False, got 'yes'"):
        mb.load(path, actuators="yes")


def test_what_acts_and_what_is_left_out_is_named(tmp_path):
    text = (
        f'<mujoco><option actuatorgroupdisable="3"/>{PLAIN}<tendon><fixed name="sum" stiffness="7" range="-1 2">'
        '<joint joint="a" coef="1"/><joint joint="b" coef="-2"/></fixed>'
        '<fixed name="slack" stiffness="8" springlength="0 1"><joint joint="a" coef="1"/></fixed>'
        '<fixed stiffness="1 2" frictionloss="9"><joint joint="a" coef="1"/></fixed>'
        '<spatial name="string" stiffness="6"><site site="s"/><site site="t"/></spatial></tendon>'
        '<actuator><position name="servo" joint="b" kp="5" forcerange="-4 4"/><motor name="drive" joint="a"/>'
        '<position name="off" joint="a" kp="11" group="3"/><position name="spherical" joint="c" kp="12"/>'
        '<muscle name="biceps" joint="a"/><general name="runaway" joint="a" biastype="affine" biasprm="0 13 14"/>'
        '<general name="weight" joint="a" biastype="affine" biasprm="15"/>'
        '<general name="soft" joint="a" biastype="affine" biasprm="1e30 -1e-300"/></actuator>'
        '<equality><joint name="tie" joint1="a" joint2="b"/><connect body1="world" body2="world" anchor="0 0 0"/></equality>'
        "</mujoco>"
    )
    model = loaded(tmp_path, text)
    assert [(c.name, c.joints, c.stiffness) for c in model.couplings] == [("sum", ("a", "b"), 7.0)]
    assert (model.joint("b").stiffness, model.joint("a").stiffness) == (5.0, 0.0)
    notes = {note.split(":")[0]: note for note in model.notes}

    def note(start: str) -> str:
        return next(text for head, text in notes.items() if head.startswith(start))

    for name, words in {"sum": "range -1 2", "3 (fixed, line 1)": "9"}.items():
        assert name in note("left out of the motion of tendons")
        assert words in note("left out of the motion of tendons")
    assert "'sum' on a - 2 b: stiffness 7" in note("tendons that act")
    assert "'string' between" in note("tendons that act")
    assert "'slack': stiffness 8 0 0, rest length 0 to 1" in note("springs of tendons")
    assert "'servo' on b: stiffness 5" in note("actuators that act")
    for name, words in {
        "servo": "forcerange -4 4",
        "spherical": "stiffness 12",
        "biceps": "muscle",
        "runaway": "stiffness -13",
        "weight": "15",
        "soft": "constant force 1e+30",
    }.items():
        assert f"'{name}': " in note("left out of the motion of actuators")
        assert words in note("left out of the motion of actuators")
    assert "14" in note("left out of the motion of actuators")
    for words in ("'drive' (motor, gain 1) on a", "'off' (position, gain 11) on a", "'biceps' (muscle, muscle gain"):
        assert words in note("controls")
    assert [(x.name, x.joint, x.leader) for x in model.couplers] == [("tie", "a", "b")]
    assert "connect" in note("left out of the motion of equality")


@pytest.mark.parametrize(
    ("inside", "words"),
    [
        ('<tendon><fixed name="t"><joint joint="x" coef="1"/></fixed></tendon>', "'x' is not in the file"),
        ('<tendon><fixed name="t"><joint joint="c" coef="1"/></fixed></tendon>', "'c' is a ball joint"),
        ('<tendon><fixed name="t" armature="nan"><joint joint="a" coef="1"/></fixed></tendon>', "'nan'"),
        ('<actuator><motor joint="x"/></actuator>', "'x' is not in the file"),
        ('<actuator><motor tendon="x"/></actuator>', "'x' is not in the file"),
        ('<actuator><position joint="a" kp="1e400"/></actuator>', "kp"),
    ],
)
def test_faults_of_tendons_and_actuators(inside, words, tmp_path):
    with pytest.raises(ModelError, match=words):
        loaded(tmp_path, f"<mujoco>{PLAIN}{inside}</mujoco>")


# Every engine.


def coupled_tree(seed: int, kinds: tuple[str, ...], *, deep: bool = False, mimic: bool = False) -> tuple[Model, Model]:
    """Return a random tree with three couplings, and without them."""
    plain = random_tree(seed, 8, kinds, mimic=mimic, nearest=1 if deep else None)
    rng = np.random.default_rng(seed)
    one = [j.name for j in plain.joints if j.type.nv == 1]
    some = [rng.choice(one, size=min(len(one), 2 + k % 2), replace=False) for k in range(3)]
    couplings = tuple(
        JointCoupling(f"c{k}", tuple(map(str, x)), rng.normal(size=len(x)), *rng.uniform(0.1, 2, 4))
        for k, x in enumerate(some)
    )
    # A length of -1 is MuJoCo's word for a default.
    return replace(plain, couplings=(replace(couplings[0], rest_length=-1.0), *couplings[1:])), plain


def assert_near(actual: Any, expected: Any, factor: float = 1e4) -> None:
    np.testing.assert_allclose(
        actual, expected, rtol=0, atol=factor * EPS * max(1.0, np.abs(expected).max(initial=0.0))
    )


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize(
    ("engine", "kinds", "deep", "mimic"),
    [
        ("lagrangian", ALL, False, True),
        ("pinocchio", SOUND, False, False),
        # MuJoCo has rotors within a branch only.
        ("mujoco", ("revolute", "prismatic", "planar", "continuous"), True, False),
        ("oracle", ("revolute", "helical", "ball"), False, False),
    ],
)
@pytest.mark.parametrize("seed", range(1))
def test_terms_are_those_of_the_definition(engine, kinds, deep, mimic, seed):
    model, plain = coupled_tree(seed, kinds, deep=deep, mimic=mimic)
    options = {"compile": False} if engine == "lagrangian" else {}
    dyn, bare = (mb.dynamics(m, engine, **options) for m in (model, plain))
    rng = np.random.default_rng(seed)
    q, v = model.random_state(rng)
    tau, a = rng.normal(size=(2, model.nv))
    layout = model.layout
    G = np.array([layout.coupling_row(c) @ layout.G for c in model.couplings])
    # What a coupling's joints have as coordinates stands in the full ones, mimic joints included.
    x = [
        sum(f * layout.expand_q(q)[layout.full_q[j]][0] for f, j in zip(c.factors, c.joints, strict=True))
        for c in model.couplings
    ]
    k, rest, d, rotor = np.array([(c.stiffness, c.rest_length, c.damping, c.armature) for c in model.couplings]).T
    passive = -G.T @ (k * (x - rest) + d * (G @ v))
    M = bare.mass_matrix(q) + G.T @ np.diag(rotor) @ G
    assert_near(dyn.mass_matrix(q), M)
    assert_near(sample_mass_matrix(model, q), M)
    assert_near(dyn.passive(q, v), bare.passive(q, v) + passive)
    assert_near(dyn.nle(q, v), bare.nle(q, v))
    assert_near(dyn.inverse_dynamics(q, v, a), M @ a + bare.nle(q, v) - bare.passive(q, v) - passive)
    assert_near(M @ dyn.forward_dynamics(q, v, tau), tau + bare.passive(q, v) + passive - bare.nle(q, v), 1e5)
    assert_near(dyn.potential_energy(q), bare.potential_energy(q) + 0.5 * np.sum(k * (x - rest) ** 2))
    with warnings.catch_warnings():
        # Pinocchio leaves the armature of some joints out of its kinetic energy, with and without couplings.
        warnings.simplefilter("ignore", KnownDefectWarning)
        assert_near(dyn.kinetic_energy(q, v), bare.kinetic_energy(q, v) + 0.5 * np.sum(rotor * (G @ v) ** 2))


APART = f'<worldbody><body><joint name="a" axis="0 1 0"/>{BODY}</body><body><joint name="b" axis="0 1 0"/>{BODY}</body></worldbody>'
SUM = '<joint joint="a" coef="1"/><joint joint="b" coef="1"/>'


def two_pendulums(joint: str = "j", **numbers: Any) -> ModelBuilder:
    b = mb.ModelBuilder("pair")
    for k in range(2):
        b.add_body(f"b{k}", mass=1.0 + k, com=(0, 0, -0.5), inertia=(0.1, 0.1, 0.1))
        b.add_joint(f"{joint}{k}", "revolute", parent="world", child=f"b{k}", axis=(0, 1, 0))
    b.add_coupling("c", {f"{joint}0": 1.0, f"{joint}1": -2.0}, **numbers)
    return b


def test_mujoco_loses_a_rotor_between_branches_and_says_so(tmp_path):
    model = two_pendulums(armature=0.5).build()
    with pytest.warns(KnownDefectWarning, match="'c'"):
        M = mb.dynamics(model, "mujoco").mass_matrix(model.neutral())
    assert M[0, 1] == 0.0
    assert mb.dynamics(model, "pinocchio").mass_matrix(model.neutral())[0, 1] == -1.0
    with pytest.raises(UnsupportedError, match="'c'"):
        mb.convert(model, "mjcf")
    text = f'<mujoco>{APART}<tendon><fixed name="c" armature="1">{SUM}</fixed></tendon></mujoco>'
    read = loaded(tmp_path, text)
    assert read.branched(read.couplings[0])
    assert any("armature of 'c'" in note for note in read.notes)


def light_cart(factor: float) -> Model:
    b = mb.ModelBuilder("cart")
    b.add_body("cart", mass=1e-9)
    b.add_body("pole", mass=1.0, com=(0, 0, 1.0))
    b.add_joint("slide", "prismatic", parent="world", child="cart", axis=(1, 0, 0))
    b.add_joint("hinge", "revolute", parent="cart", child="pole", axis=(0, 1, 0))
    b.add_coupling("c", {"slide": 2 * factor, "hinge": 3 * factor}, armature=1.0, stiffness=2.0, damping=0.3)
    return b.build()


def test_a_badly_scaled_model_keeps_its_digits():
    model = light_cart(1e-6)
    dyn, oracle = mb.dynamics(model, "lagrangian", compile=False), mb.dynamics(model, "oracle")
    assert dyn.elimination == "least constraint"
    q, v = np.array([0.2, 1e-3]), np.array([0.3, 0.4])
    exact = oracle.forward_dynamics(q, v, np.zeros(2))
    np.testing.assert_allclose(dyn.forward_dynamics(q, v, np.zeros(2)), exact, rtol=1e-13)
    # A large rotor leaves enough of M.
    assert mb.dynamics(light_cart(1.0), "lagrangian", compile=False).elimination == "links"


@pytest.mark.parametrize("deep", [False, True])
def test_the_size_of_an_elimination_counts_what_couplings_fill_in(deep):
    model, _ = coupled_tree(1, ("revolute", "ball", "prismatic"))
    if deep:
        leaves = two_pendulums()
        for k in range(2):
            leaves.add_body(f"leaf{k}", mass=1.0, com=(0.1, 0, 0.1), inertia=(0.1, 0.1, 0.1))
            leaves.add_joint(f"leaf{k}", "revolute", parent=f"b{k}", child=f"leaf{k}", axis=(0, 1, 0))
        leaves.add_coupling("leaves", {"leaf0": 1.0, "leaf1": 1.0}, armature=1.0)
        model = leaves.build()
    order = elimination_order(model)
    filled = np.array(Equations(model).mass_matrix.sparsity().get_triplet()).T
    pattern = np.zeros((model.nv, model.nv), bool)
    pattern[tuple(filled.T)] = True
    pattern = pattern[np.ix_(order, order)]
    count = 0
    for k in reversed(range(model.nv)):
        row = pattern[k, : k + 1]
        count += int(row.sum()) ** 2
        pattern[: k + 1, : k + 1] |= np.outer(row, row)
    assert elimination_size(model) == count


def test_a_rotor_may_be_all_that_a_joint_moves():
    b = two_pendulums(armature=0.5)
    b.add_body("idle")
    b.add_joint("j2", "revolute", parent="b1", child="idle", axis=(1, 0, 0))
    b.add_coupling("d", {"j1": 1.0, "j2": 1.0}, armature=0.5)
    assert not b.build().nonphysical


# The description.


def test_faults_of_a_coupling():
    b = two_pendulums(stiffness=-1.0)
    b.add_joint("ball", "ball", parent="b1", child="b2")
    b.add_body("b2", mass=1.0, inertia=(1, 1, 1))
    b.add_coupling("d", {"j9": 1.0, "ball": 1.0}, damping=float("nan"))
    b.add_coupling("d", {"j0": 0.0}, armature=1.0)
    b.add_coupling("e", ["j0"], armature=1.0)
    with pytest.raises(ModelError) as error:
        b.build()
    faults = "\n".join(error.value.faults)
    for words in ("stiffness", "'j9'", "'ball'", "damping", "declared 2 times", "factor other than zero", "mapping"):
        assert words in faults


def test_couplings_of_renamed_joints_are_the_same():
    model, other = (two_pendulums(joint=name, stiffness=2.0, armature=0.5).build() for name in ("j", "hinge"))
    found = mb.explain(model, other)
    assert found.agree
    assert not found.acting


def test_a_rotor_that_an_engine_loses_is_named():
    model = two_pendulums(stiffness=3.0, damping=0.1, armature=0.5).build()
    found = mb.explain(mb.dynamics(model, "lagrangian", compile=False), mb.dynamics(model, "mujoco"))
    (cause,) = found.causes
    assert cause.kind == "joint coupling"
    assert "branches" in str(cause)
