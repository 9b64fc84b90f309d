"""Three engines on one description: the same numbers, the same manners."""

from __future__ import annotations

import os
import pickle
import warnings
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np
import pytest

import mbkit as mb
from mbkit.engines import ENGINES
from mbkit.errors import InputError, NumericalError, UnknownNameError, UnsupportedError
from tests.random_trees import IN_MUJOCO, SOUND, off, random_tree, states

VECTORS = {
    "gravity": "q",
    "nle": "qv",
    "passive": "qv",
    "inverse_dynamics": "qva",
    "forward_dynamics": "qvt",
    "kinetic_energy": "qv",
    "potential_energy": "q",
    "mass_matrix": "q",
}
# Engines do a few hundred roundings per entry on these well-scaled trees.
CLOSE = 2e-13


def close(name, own, q):
    """Forward dynamics loses cond(M) in any arithmetic."""
    return CLOSE if name != "forward_dynamics" else 1e-14 * np.linalg.cond(own.mass_matrix(q)).max()


def arguments(letters, q, v, a, tau):
    return [{"q": q, "v": v, "a": a, "t": tau}[x] for x in letters]


@pytest.mark.parametrize("mimic", [False, True])
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("engine", ["pinocchio", "mujoco"])
def test_engines_agree_on_trees_of_every_joint_kind(engine, seed, mimic):
    model = random_tree(seed, 10, IN_MUJOCO if engine == "mujoco" else SOUND, mimic=mimic, armature=engine == "mujoco")
    own, other = mb.dynamics(model, "lagrangian"), mb.dynamics(model, engine)
    q, v, a, tau = states(model, 5, seed)
    for name, letters in VECTORS.items():
        args = arguments(letters, q, v, a, tau)
        assert off(getattr(other, name)(*args), getattr(own, name)(*args)) < close(name, own, q), name
    for axes in ("world", "body"):
        assert off(other.jacobian(q, "tip", axes), own.jacobian(q, "tip", axes)) < CLOSE
    assert off(other.pose(q, "tip"), own.pose(q, "tip")) < CLOSE
    assert off(other.coriolis_force(q, v), own.coriolis_force(q, v)) < CLOSE


@pytest.mark.parametrize("seed", range(4))
def test_all_joint_kinds_agree_in_pinocchio_apart_from_its_named_defects(seed):
    model = random_tree(seed, 12)
    own, other = mb.dynamics(model, "lagrangian"), mb.dynamics(model, "pinocchio")
    q, v, a, tau = states(model, 5, seed)
    for name, letters in VECTORS.items():
        if name != "kinetic_energy":
            args = arguments(letters, q, v, a, tau)
            assert off(getattr(other, name)(*args), getattr(own, name)(*args)) < close(name, own, q), name


@pytest.mark.parametrize("feature", ["armature", "damping", "springs", "gravity"])
@pytest.mark.parametrize("engine", list(ENGINES))
def test_a_feature_acts_in_every_engine_and_can_be_taken_out(engine, feature):
    model = random_tree(3, 8, tuple(k for k in SOUND if k != "helical"))
    q, v, a, _ = states(model, 3)
    with_it = mb.dynamics(model, engine).inverse_dynamics(q, v, a)
    without = mb.dynamics(model.without(feature), engine).inverse_dynamics(q, v, a)
    reference = mb.dynamics(model.without(feature), "lagrangian").inverse_dynamics(q, v, a)
    assert off(with_it, without) > 1e-3
    assert off(without, reference) < CLOSE


@cache
def floating(robot, engine):
    return mb.dynamics(mb.load(robot, floating_base=True), engine)


@pytest.mark.parametrize("engine", list(ENGINES))
@pytest.mark.parametrize("robot", ["talos", "anymal_b", "solo12"])
def test_floating_robots_agree_accelerations_included(robot, engine):
    own, other = floating(robot, "lagrangian"), floating(robot, engine)
    q, v, _, tau = states(own.model, 4)
    a = other.forward_dynamics(q, v, tau)
    condition = np.linalg.cond(own.mass_matrix(q)).max()
    assert off(a, own.forward_dynamics(q, v, tau)) < 1e-15 * condition
    assert off(other.inverse_dynamics(q, v, a), tau) < 1e-15 * condition


@pytest.mark.parametrize("engine", list(ENGINES))
def test_declaration_order_of_joints_does_not_matter_to_the_physics(engine):
    # Breadth first, siblings against the alphabet, a child declared before its
    # parent: Pinocchio wants depth first and MuJoCo nests bodies.
    b = mb.ModelBuilder("shuffled")
    inertia = np.diag([0.1, 0.2, 0.25])
    for name in ("trunk", "a1", "z1", "a2", "z2"):
        b.add_body(name, mass=1.0, com=(0.1, 0.2, -0.3), inertia=inertia)
    b.add_joint("z2", "revolute", parent="z1", child="z2", axis=(1, 1, 0), translation=(0, 0, -1))
    b.add_joint("trunk", "ball", parent="world", child="trunk")
    b.add_joint("z1", "prismatic", parent="trunk", child="z1", axis=(1, 0, 0), translation=(1, 0, 0))
    b.add_joint("a1", "revolute", parent="trunk", child="a1", axis=(0, 1, 0), translation=(-1, 0, 0))
    b.add_joint("a2", "planar", parent="a1", child="a2", translation=(0, 0, -1))
    model = b.build()
    assert model.joint_names == ("z2", "trunk", "z1", "a1", "a2")
    q, v, _, tau = states(model, 3)
    own = mb.dynamics(model, "lagrangian").forward_dynamics(q, v, tau)
    assert off(mb.dynamics(model, engine).forward_dynamics(q, v, tau), own) < CLOSE
    # And the reference itself, by moving one joint alone: a slide of z1 carries z1 and z2.
    M = mb.dynamics(model, engine).mass_matrix(q[0])
    assert M[model.layout.v["z1"].start, model.layout.v["z1"].start] == pytest.approx(2.0)


@pytest.mark.parametrize("engine", list(ENGINES))
def test_bodies_fixed_to_the_world_count_in_the_energy_and_nowhere_else(engine):
    def made(mass):
        b = mb.ModelBuilder("with_base")
        b.add_body("base", mass=mass, com=(0, 0, 0.7))
        b.add_joint("mount", "fixed", parent="world", child="base", translation=(0, 0, 0.3), rpy=(0, 0, 0.4))
        b.add_body("arm", mass=1.0, com=(0.2, 0, 0), inertia=(0.1, 0.1, 0.1))
        b.add_joint("j", "revolute", parent="base", child="arm", axis=(0, 1, 0))
        return mb.dynamics(b.build(), engine)

    heavy, light = made(5.0), made(0.0)
    assert heavy.potential_energy([0.3]) - light.potential_energy([0.3]) == pytest.approx(5 * 9.81 * 1.0)
    assert np.array_equal(heavy.mass_matrix([0.3]), light.mass_matrix([0.3]))


@pytest.mark.parametrize("engine", list(ENGINES))
def test_jacobians_and_poses_are_those_of_the_motion(engine):
    model = random_tree(2, 6, ("ball", "free", "revolute", "planar", "spherical_zyx", "prismatic"))
    dyn = mb.dynamics(model, engine)
    q, v, _, _ = (x[0] for x in states(model, 1))
    h = 1e-6
    ahead, behind = (dyn.pose(model.integrate(q, s * h * v), "tip") for s in (1, -1))
    rate, R = (ahead - behind) / (2 * h), dyn.pose(q, "tip")[:3, :3]
    spin = rate[:3, :3] @ R.T
    twist = np.array([*rate[:3, 3], spin[2, 1], spin[0, 2], spin[1, 0]])
    # The difference quotient is good to h² and eps/h.
    assert np.allclose(dyn.jacobian(q, "tip") @ v, twist, atol=1e-8)
    turned = np.concatenate([R.T @ twist[:3], R.T @ twist[3:]])
    assert np.allclose(dyn.jacobian(q, "tip", "body") @ v, turned, atol=1e-8)


@pytest.mark.parametrize("engine", list(ENGINES))
@pytest.mark.parametrize("floating", [False, True])
def test_a_batch_is_its_states_one_by_one(engine, floating):
    model = mb.load("solo12", floating_base=floating)
    dyn = mb.dynamics(model, engine)
    q, v, a, tau = states(model, 3)
    for name, letters in VECTORS.items():
        args = arguments(letters, q, v, a, tau)
        whole = getattr(dyn, name)(*args)
        alone = np.array([getattr(dyn, name)(*(x[i] for x in args)) for i in range(3)])
        assert whole.shape == alone.shape, name
        assert off(whole, alone) < 1e-14, name
        assert getattr(dyn, name)(*(x[:0] for x in args)).shape == (0, *whole.shape[1:]), name
        if len(args) > 1:
            mixed = getattr(dyn, name)(args[0][0], *args[1:])
            assert mixed.shape == whole.shape, name


@pytest.mark.parametrize("engine", list(ENGINES))
@pytest.mark.parametrize("n", [1, 2])
def test_shapes_are_as_documented_for_one_velocity_too(engine, n):
    model = mb.catalog.chain(n=n)
    dyn = mb.dynamics(model, engine)
    q, v = np.full(n, 0.3), np.full(n, 0.2)
    shapes = {"mass_matrix": (n, n), "kinetic_energy": (), "potential_energy": ()}
    for name, letters in VECTORS.items():
        args = arguments(letters, q, v, v, v)
        assert np.shape(getattr(dyn, name)(*args)) == shapes.get(name, (n,)), name
        batch = [np.stack([x] * 4) for x in args]
        assert np.shape(getattr(dyn, name)(*batch)) == (4, *shapes.get(name, (n,))), name
    assert dyn.jacobian(q, model.bodies[-1].name).shape == (6, n)
    assert dyn.pose(q, model.bodies[-1].name).shape == (4, 4)
    if "coriolis_matrix" in dyn.supports:
        assert dyn.coriolis_matrix(q, v).shape == (n, n)


@pytest.mark.parametrize("engine", list(ENGINES))
def test_a_model_without_velocities_has_empty_terms_and_poses(engine):
    b = mb.ModelBuilder("rock")
    b.add_body("a", mass=1.0, com=(0, 0, 0.3))
    b.add_joint("f", "fixed", parent="world", child="a", translation=(1, 0, 0))
    b.add_frame("top", body="a", translation=(0, 0, 1))
    dyn, none = mb.dynamics(b.build(), engine), np.zeros(0)
    assert dyn.mass_matrix(none).shape == (0, 0)
    assert dyn.mass_matrix(np.zeros((3, 0))).shape == (3, 0, 0)
    assert dyn.forward_dynamics(none, none, none).shape == (0,)
    assert dyn.potential_energy(none) == pytest.approx(0.3 * 9.81)
    assert dyn.pose(none, "top")[:3, 3] == pytest.approx([1, 0, 1])
    assert dyn.jacobian(none, "top").shape == (6, 0)


@pytest.mark.parametrize("engine", list(ENGINES))
def test_results_are_not_views_of_the_next_call(engine):
    model = mb.load("ur5")
    dyn = mb.dynamics(model, engine)
    q, v, a, tau = states(model, 2)
    for name, letters in VECTORS.items():
        first = getattr(dyn, name)(*(x[0] for x in arguments(letters, q, v, a, tau)))
        kept = np.array(first)
        getattr(dyn, name)(*(x[1] for x in arguments(letters, q, v, a, tau)))
        assert np.array_equal(first, kept), name


@pytest.mark.parametrize("engine", list(ENGINES))
def test_unusual_arrays_are_taken_for_what_they_say(engine):
    model = mb.load("ur5")
    dyn = mb.dynamics(model, engine)
    q, v, _, _ = (x[0] for x in states(model, 1))
    expected = dyn.nle(q, v)
    frozen = q.copy()
    frozen.setflags(write=False)
    strided = np.repeat(q, 2)[::2]
    for same in (frozen, strided, q.tolist(), tuple(q)):
        assert off(dyn.nle(same, v), expected) < 1e-15
    assert off(dyn.nle(q.astype(np.float32), v), dyn.nle(q.astype(np.float32).astype(float), v)) < 1e-15
    whole = np.arange(6)
    assert off(dyn.nle(whole, whole), dyn.nle(whole.astype(float), whole.astype(float))) < 1e-15
    transposed = np.asfortranarray(np.stack([q, q]))
    assert off(dyn.nle(transposed, v), np.stack([expected, expected])) < 1e-15


@pytest.mark.parametrize("engine", list(ENGINES))
@pytest.mark.parametrize(
    "bad",
    [
        np.zeros(5),
        np.zeros(7),
        np.zeros((6, 1)),
        np.zeros((1, 5)),
        np.zeros((2, 2, 6)),
        0.0,
        None,
        "abc",
        np.zeros(6, complex),
        [1, [2]],
        {},
    ],
)
@pytest.mark.parametrize("call", ["nle", "inverse_dynamics", "forward_dynamics", "mass_matrix"])
def test_wrong_shapes_and_types_are_explained(engine, bad, call):
    dyn = mb.dynamics(mb.load("ur5"), engine)
    others = {"nle": 1, "mass_matrix": 0}.get(call, 2)
    with pytest.raises(InputError, match=r"^q: expected"):
        getattr(dyn, call)(bad, *[np.zeros(6)] * others)
    if others:
        with pytest.raises(InputError, match=r"^v: expected"):
            getattr(dyn, call)(np.zeros(6), bad, *[np.zeros(6)] * (others - 1))


@pytest.mark.parametrize("engine", list(ENGINES))
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_no_entry_that_is_not_finite_passes_unseen(engine, value):
    # A slide at the root and a floating base have coordinates that nothing reads.
    b = mb.ModelBuilder("slide")
    b.add_body("a", mass=1.0)
    b.add_joint("x", "prismatic", parent="world", child="a", axis=(1, 0, 0))
    b.add_body("b", mass=1.0, com=(0, 0, 1), inertia=(1, 1, 1))
    b.add_joint("y", "revolute", parent="a", child="b", axis=(0, 1, 0))
    alone = mb.ModelBuilder("alone")
    alone.add_body("a", mass=1.0)
    alone.add_joint("x", "prismatic", parent="world", child="a", axis=(0, 0, 1))
    for model in (b.build(), alone.build(), mb.load("solo12", floating_base=True)):
        dyn = mb.dynamics(model, engine)
        for name, letters in VECTORS.items():
            good = [model.neutral() if x == "q" else np.zeros(model.nv) for x in letters]
            getattr(dyn, name)(*good)
            for k, x in enumerate(good):
                for i in range(x.size):
                    spoiled = [y.copy() for y in good]
                    spoiled[k][i] = value
                    with pytest.raises(InputError, match="finite"):
                        getattr(dyn, name)(*spoiled)


@pytest.mark.parametrize("engine", list(ENGINES))
def test_quaternions_must_be_of_unit_length(engine):
    model = mb.load("solo12", floating_base=True)
    dyn = mb.dynamics(model, engine)
    q, v = model.neutral(), np.zeros(model.nv)
    q[3:7] *= 1 + 1e-6
    for call in (lambda: dyn.nle(q, v), lambda: dyn.forward_dynamics(q, v, v), lambda: dyn.mass_matrix(q[None])):
        with pytest.raises(InputError, match=r"root_joint.*norm 1\.000001"):
            call()


@pytest.mark.parametrize("engine", list(ENGINES))
def test_batches_must_be_of_one_size(engine):
    dyn = mb.dynamics(mb.load("ur5"), engine)
    with pytest.raises(InputError, match="q has 2, v has 3"):
        dyn.nle(np.zeros((2, 6)), np.zeros((3, 6)))


def test_unknown_names_suggest_near_ones():
    model = mb.load("ur5")
    with pytest.raises(UnknownNameError, match="pinocchio"):
        mb.dynamics(model, "pinochio")
    with pytest.raises(UnknownNameError, match="wrist_3_link"):
        mb.dynamics(model).pose(model.neutral(), "wrist3_link")
    with pytest.raises(InputError, match="frame: expected a name"):
        mb.dynamics(model).pose(model.neutral(), 3)
    for engine in ENGINES:
        assert np.array_equal(mb.dynamics(model, engine).pose(model.neutral(), "world"), np.eye(4))
    with pytest.raises(InputError, match="axes"):
        mb.dynamics(model).jacobian(model.neutral(), "wrist_3_link", "local")
    with pytest.raises(InputError, match="Model"):
        mb.dynamics("ur5")


def test_what_an_engine_cannot_do_has_a_reason():
    model = random_tree(0, 4, ("revolute", "prismatic"))
    mujoco = mb.dynamics(model, "mujoco")
    assert "coriolis_matrix" not in mujoco.supports
    with pytest.raises(UnsupportedError, match="without the matrix"):
        mujoco.coriolis_matrix(model.neutral(), np.zeros(model.nv))
    with pytest.raises(UnsupportedError, match="lagrangian"):
        mb.dynamics(model).function("nle")
    with pytest.raises(UnsupportedError, match="'j0' is helical"):
        mb.dynamics(random_tree(0, 1, ("helical",)), "mujoco")


@pytest.mark.parametrize("engine", list(ENGINES))
def test_loops_and_prescribed_motions_are_refused_and_not_ignored(engine):
    b = mb.ModelBuilder("loop")
    b.add_body("a", mass=1.0, com=(0, 0, 1))
    b.add_joint("j", "revolute", parent="world", child="a", axis=(0, 1, 0))
    b.add_loop("closed", "point", body_a="a", body_b="world")
    model = b.build()
    with pytest.raises(UnsupportedError, match="loop closures"):
        mb.dynamics(model, engine)
    mb.dynamics(model.without("loops"), engine)


@pytest.mark.parametrize("engine", list(ENGINES))
def test_dynamics_can_be_pickled(engine):
    model = mb.load("panda")
    dyn = mb.dynamics(model, engine)
    q, v, _, _ = (x[0] for x in states(model, 1))
    assert np.array_equal(pickle.loads(pickle.dumps(dyn)).nle(q, v), dyn.nle(q, v))


@pytest.mark.parametrize("engine", list(ENGINES))
def test_threads_that_share_an_engine_get_right_numbers_or_are_told(engine):
    """MuJoCo's and CasADi's engines lock; Pinocchio's calls hold the interpreter's own lock."""
    model = mb.load("panda")
    dyn = mb.dynamics(model, engine)
    q, v, _, tau = states(model, 40)
    expected = [dyn.forward_dynamics(*x) for x in zip(q, v, tau, strict=True)]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(5):
            got = list(pool.map(dyn.forward_dynamics, q, v, tau))
            assert np.array_equal(got, expected)


def test_mujoco_writes_no_log_and_gives_no_number_where_there_is_none(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    b = mb.ModelBuilder("twice")
    b.add_body("a", mass=1.0, com=(0, 0, -1), inertia=(1, 1, 1))
    b.add_joint("j", "universal", parent="world", child="a", axis=(1, 0, 0), axis2=(1, 0, 0))
    with pytest.warns(mb.errors.NonPhysicalWarning):
        model = b.build(nonphysical="warn")
    dyn = mb.dynamics(model, "mujoco")
    with pytest.raises(NumericalError):
        dyn.forward_dynamics(np.zeros(2), np.ones(2), np.ones(2))
    assert os.listdir(tmp_path) == []
    assert "WARNING" not in capfd.readouterr().err


def test_a_singular_mass_matrix_is_named_and_never_nan():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = mb.load("romeo", mimic="free")
    q, v, _, tau = (x[0] for x in states(model, 1))
    for engine in ("pinocchio", "lagrangian"):
        with pytest.raises(NumericalError, match="no mass moves"):
            mb.dynamics(model, engine).forward_dynamics(q, v, tau)


def test_a_point_spring_of_no_length_pulls_and_does_not_divide_by_zero():
    b = mb.ModelBuilder("tether", gravity=(0, 0, 0))
    b.add_body("a", mass=1.0)
    b.add_joint("j", "prismatic", parent="world", child="a", axis=(1, 0, 0))
    b.add_spring("s", body_a="world", body_b="a", stiffness=7.0)
    model = b.build()
    for engine in ENGINES:
        dyn = mb.dynamics(model, engine)
        assert dyn.passive([0.0], [0.0]) == pytest.approx([0.0])
        assert dyn.passive([0.5], [0.0]) == pytest.approx([-3.5])
        assert dyn.potential_energy([0.5]) == pytest.approx(7 * 0.125)
