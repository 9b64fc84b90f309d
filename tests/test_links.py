"""The link-by-link derivation: every form of it gives the terms that derivatives of the energies give."""

from __future__ import annotations

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

import mbkit as mb
from mbkit.derivation import Equations, LinkEquations
from mbkit.derivation.kinematics import Kinematics
from mbkit.derivation.least_constraint import hard_poses
from mbkit.derivation.links import Links
from mbkit.derivation.rotations import SYMMETRIC, Matrix, Permutation, PlaneRotation, congruence, to_child, to_parent
from mbkit.model.joint_types import KINDS
from mbkit.model.parts import RESTING
from mbkit.spatial import matrix_from_quaternion, normalized
from tests.random_trees import off, random_tree, rotation, states
from tests.scenes import chain

EPS = np.finfo(float).eps
TERMS = {
    "mass_matrix": "q",
    "gravity": "q",
    "coriolis_force": "qv",
    "nle": "qv",
    "inverse_dynamics": "qva",
    "forward_dynamics": "qvt",
}


def model_of(seed: int) -> mb.model.Model:
    """Return a tree of up to 14 joints of all types, every other one with mimic joints and rotors across branches."""
    return random_tree(seed, 4 + seed % 11, mimic=bool(seed % 2), nearest=3 if seed % 3 else None)


def evaluated(equations: Equations, name: str, at: dict[str, np.ndarray]) -> np.ndarray:
    f = equations.function(name)
    return np.array([np.array(f(*(at[c][i] for c in TERMS[name]))) for i in range(len(at["q"]))])


def sample(model: mb.model.Model, n: int = 3, seed: int = 0) -> dict[str, np.ndarray]:
    return dict(zip("qvat", states(model, n, seed), strict=True))


@pytest.mark.thorough("2", "3", "4", "5", "6", "7")
@pytest.mark.parametrize("seed", range(8))
def test_every_term_is_that_of_the_energies(seed):
    model = model_of(seed)
    at, links, energies = sample(model), LinkEquations(model, elimination="links"), Equations(model)
    M = evaluated(energies, "mass_matrix", at)
    for name in TERMS:
        loss = np.linalg.cond(M).max() if name == "forward_dynamics" else 1.0
        assert off(evaluated(links, name, at), evaluated(energies, name, at)) < 1e3 * EPS * loss, name


@pytest.mark.thorough("3", "4")
@pytest.mark.parametrize("seed", range(5))
def test_any_velocities_may_be_carried_to_the_root(seed):
    model, rng = model_of(seed), np.random.default_rng(seed)
    eq, at = LinkEquations(model, elimination="links"), sample(model, 2)
    reference = evaluated(Equations(model), "forward_dynamics", at)
    loss = np.linalg.cond(evaluated(eq, "mass_matrix", at)).max()
    order = eq.elimination_order
    for share in (0.0, 0.3, 0.7, 1.0):
        carried = tuple(k for k in order if rng.random() < share)
        f = eq.named("a", ("q", "v", "tau"), [eq.q, eq.v, eq.tau], eq._reduced(eq.mechanics, carried))
        for i, expected in enumerate(reference):
            assert off(np.array(f(at["q"][i], at["v"][i], at["t"][i])), expected) < 1e3 * EPS * loss


def kinetic_energy(model: mb.model.Model, links: Links) -> ca.Function:
    """Return T of links as they stand: ½ m v·v + h·(v × ω) + ½ ω·I ω of each, and of rotors."""
    kin, total, twists = links.kin, 0.0, []
    for link in links.links:
        v, w = twists[link.parent] if link.parent >= 0 else (ca.SX(3, 1), ca.SX(3, 1))
        v = v + ca.cross(w, ca.vertcat(*link.translation))
        v, w = (ca.vertcat(*to_child(link.fixed, list(ca.vertsplit(x)))) for x in (v, w))
        v = v + ca.cross(w, ca.vertcat(*link.slide))
        v, w = (ca.vertcat(*to_child(link.turn, list(ca.vertsplit(x)))) for x in (v, w))
        v, w = v + ca.vertcat(*link.rate[:3]), w + ca.vertcat(*link.rate[3:])
        twists.append((v, w))
        m, h, I = link.inertia.mass, ca.vertcat(*link.inertia.moment), link.inertia.inertia
        inertia = ca.SX([[0.0] * 3] * 3)
        for i in range(3):
            for j in range(3):
                inertia[i, j] = I[SYMMETRIC[i][j]]
        total += 0.5 * m * ca.dot(v, v) + ca.dot(h, ca.cross(v, w)) + 0.5 * ca.dot(w, ca.mtimes(inertia, w))
    for joint in model.joints:
        rotors = zip(kin.values.of(joint).armature, kin.velocities(joint), strict=True)
        total += sum(0.5 * rotor * rate * rate for rotor, rate in rotors)
    return ca.Function("T", [kin.q, kin.v], [total])


@pytest.mark.parametrize("short", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_moved_matter_keeps_the_kinetic_energy(seed, short):
    model = model_of(seed)
    links = Links(Kinematics(model), short=short)
    T, dyn, at = kinetic_energy(model, links), mb.dynamics(model, "lagrangian", compile=False), sample(model, 4)
    for q, v in zip(at["q"], at["v"], strict=True):
        assert float(T(q, v)) == pytest.approx(dyn.kinetic_energy(q, v), rel=1e-12)
    for link in links.links if short else ():
        own = link.inertia
        if link.motion is not None and link.motion.turns and link.motion.advance == 0.0:
            assert (own.mass, own.moment[2], own.inertia[3]) == (0.0, 0.0, 0.0)
        if link.motion is not None and not link.motion.turns:
            assert own.inertia == [0.0] * 6


def arm(masses: tuple[float, ...]) -> mb.model.Model:
    links = []
    for i, m in enumerate(masses):
        body = {"mass": m, "com": (0.5, 0, 0.1), "inertia": tuple(0.01 * m * x for x in (1, 2, 2.5))}
        links.append(body | {"axis": np.eye(3)[(2, 1, 2)[i]], "translation": (float(i > 0), 0, 0)})
    return chain(*links, name="arm").build()


def error(equations: Equations, model: mb.model.Model, name: str) -> float:
    """Return the worst relative error at 20 states, and with all links in line."""
    at = sample(model, 20)
    at["q"][0] = 0.0
    exact = getattr(mb.dynamics(model, "oracle"), name)(*(at[c] for c in TERMS[name]))
    return off(evaluated(equations, name, at).reshape(exact.shape), exact)


@pytest.mark.thorough("masses2", "masses3", "masses4")
@pytest.mark.parametrize("masses", [(1, 1, 1e9), (1, 1, 1e6), (1, 1e6, 1), (1, 1, 1e-9), (1e-9, 1, 1), (1e-9, 1e-9, 1)])
def test_heavy_and_light_links_cost_no_more_digits_than_the_factors_of_M(masses):
    model = arm(masses)
    own, factors = mb.dynamics(model, "lagrangian").equations, Equations(model)
    for name in ("inverse_dynamics", "forward_dynamics"):
        assert error(own, model, name) < max(1.2 * error(factors, model, name), 8 * EPS)


@pytest.mark.parametrize("name", ["anymal-kinova", "kinova"])
def test_short_forms_are_left_where_digits_would_go(name):
    """Near parallel axes moments about distant origins cancel, and constants that are rounded again show."""
    model = mb.load(name)
    eq = LinkEquations(model, elimination="links")
    exact = eq._reduced(eq.plain, ())
    assert ca.n_nodes(eq.forward_dynamics) == ca.n_nodes(exact)
    assert eq._error(eq._shortest(), exact) > 1.4
    # A robot whose axes are square takes the short form.
    eq = LinkEquations(mb.load("ur5"), elimination="links")
    assert ca.n_nodes(eq.forward_dynamics) < 0.8 * ca.n_nodes(eq._reduced(eq.plain, ()))


@pytest.mark.thorough("0", "1", "3")
@pytest.mark.parametrize("seed", range(4))
def test_axes_that_lie_anyhow_take_the_short_form(seed):
    """The plain frames round as much, and say nothing against the short ones: trees took twice the operations."""
    model = random_tree(seed, 8, ("revolute",), nearest=3, armature=False)
    eq, factors = LinkEquations(model, elimination="links"), Equations(model)
    assert ca.n_nodes(eq.forward_dynamics) < 0.6 * ca.n_nodes(eq._reduced(eq.plain, ()))
    assert error(eq, model, "forward_dynamics") < max(2 * error(factors, model, "forward_dynamics"), 8 * EPS)


@pytest.mark.thorough("talos_reduced")
@pytest.mark.parametrize("name", ["kinova", "so101", "talos_reduced"])
def test_the_mass_matrix_keeps_its_digits_where_an_arm_lies_in_its_axis(name):
    """Composite bodies about origins lose a hundred eps there, of √(M_ii M_jj)."""
    model = mb.load(name)
    rng = np.random.default_rng(0)
    q = np.concatenate([hard_poses(model, rng), [model.neutral()]])
    exact = mb.dynamics(model, "oracle").mass_matrix(q)
    M = evaluated(LinkEquations(model, elimination="links"), "mass_matrix", {"q": q})
    root = np.sqrt(np.einsum("nii->ni", exact))
    assert (np.abs(M - exact) / (root[:, :, None] * root[:, None, :])).max() < 12 * EPS


def operations(equations: Equations, expression: ca.SX) -> int:
    return ca.Function("f", [equations.q, equations.v, equations.tau], [expression], {"cse": True}).n_nodes()


@pytest.mark.thorough("panda", "anymal")
@pytest.mark.parametrize("name", ["ur5", "panda", "anymal"])
def test_the_form_with_the_fewest_operations_is_taken(name):
    model = mb.load(name, mimic="free", floating_base=name == "anymal").without("damping")
    eq = LinkEquations(model, elimination="links")
    chosen = operations(eq, eq.forward_dynamics)
    for depth in eq._carried():
        assert chosen <= 1.001 * operations(eq, eq._reduced(eq.mechanics, depth))


def test_rotors_that_hold_take_the_short_form_and_fixed_joints_are_no_other():
    """What rests by friction has a rotor that is a parameter; of UR5 the plain frames take half as much again."""
    bare = mb.load("ur5").without("friction").without("damping")
    b = mb.ModelBuilder.of(bare)
    for name in bare.joint_names:
        b.set_joint(name, armature=mb.Parameter(f"rotor of {name}", 0.0))
    eq = LinkEquations(b.build(), elimination="links")
    assert ca.n_nodes(eq.forward_dynamics) < 1.1 * ca.n_nodes(LinkEquations(bare, elimination="links").forward_dynamics)
    at, rng, rows = sample(bare, 20), np.random.default_rng(0), range(20)
    held = rng.random((20, bare.nv)) < 0.5
    robot = pin.buildModelFromUrdf(bare.source)
    data, force = robot.createData(), at["t"]
    for i in rows:
        pin.crba(robot, data, at["q"][i])
        M = np.triu(data.M) + np.triu(data.M, 1).T
        free, pull = ~held[i], force[i] - pin.rnea(robot, data, at["q"][i], at["v"][i], 0 * force[i])
        a = np.zeros(bare.nv)
        a[free] = np.linalg.solve(M[np.ix_(free, free)], pull[free])
        own = np.array(eq.function("forward_dynamics")(at["q"][i], at["v"][i], force[i], RESTING * held[i]))[:, 0]
        assert np.abs(own - a).max() < 64 * EPS * np.linalg.cond(M) * np.abs(a).max()


def test_a_parameter_that_moves_matter_leaves_the_plain_frames():
    """Its values are not known where the form is chosen."""
    b = mb.ModelBuilder.of(mb.load("ur5"))
    b.set_body("forearm_link", mass=mb.Parameter("mass", 2.0))
    eq = LinkEquations(b.build(), elimination="links")
    assert ca.n_nodes(eq.forward_dynamics) == ca.n_nodes(eq._reduced(eq.plain, ()))


@pytest.mark.thorough
def test_work_grows_with_the_number_of_links():
    sizes, counts = (32, 64, 128), []
    for n in sizes:
        eq = LinkEquations(mb.catalog.chain(n=n), elimination="links")
        counts.append([ca.n_nodes(x) for x in (eq.inverse_dynamics, eq.forward_dynamics)])
    small, large = np.diff(counts, axis=0)
    assert (large <= 2.02 * small).all()


def test_constant_turns_about_an_axis_become_part_of_its_angle():
    """The Panda's hand is turned by 45 degrees about the last axis, behind which both fingers slide."""
    links = Links(Kinematics(mb.load("panda", mimic="free"))).links
    assert all(isinstance(factor, Permutation) for link in links for factor in link.fixed)


# Rotations and joints


def factors(rng: np.random.Generator) -> list:
    angle = rng.uniform(-3, 3)
    planes = [PlaneRotation(axis, np.cos(angle), np.sin(angle)) for axis in range(3)]
    turns = [Permutation((1, 2, 0), (1.0, -1.0, -1.0)), Permutation((1, 0, 2), (1.0, 1.0, -1.0))]
    return [*planes, *turns, Matrix(rotation(rng).tolist())]


@pytest.mark.parametrize("seed", range(3))
def test_each_factor_of_a_rotation_is_a_matrix(seed):
    rng = np.random.default_rng(seed)
    chosen = factors(rng)
    for R in ([], *([factor] for factor in chosen), chosen):
        dense = np.array([to_parent(R, row) for row in np.eye(3).tolist()]).T
        assert off(dense @ dense.T, np.eye(3)) < 1e-14
        x, H = rng.standard_normal(3), rng.standard_normal((3, 3))
        np.testing.assert_allclose(to_parent(R, x.tolist()), dense @ x, atol=1e-14)
        np.testing.assert_allclose(to_child(R, x.tolist()), dense.T @ x, atol=1e-14)
        A = H + H.T
        turned = congruence(R, [A[i, j] for i in range(3) for j in range(i, 3)])
        full = np.array([[turned[SYMMETRIC[i][j]] for j in range(3)] for i in range(3)])
        np.testing.assert_allclose(full, dense @ A @ dense.T, atol=1e-13)
        for factor in R:
            own = np.array([factor.apply(row) for row in np.eye(3).tolist()]).T
            np.testing.assert_allclose(factor.two_sided(H.tolist()), own @ H @ own.T, atol=1e-13)


@pytest.mark.parametrize("name", sorted(name for name, kind in KINDS.items() if kind.built_in))
def test_the_single_motions_of_a_joint_make_its_placement(name):
    kind, rng = KINDS[name], np.random.default_rng(0)
    axes = rng.standard_normal((max(kind.n_axes, 1), 3))
    joint = SimpleNamespace(axes=(axes / np.linalg.norm(axes, axis=1)[:, None]).tolist(), pitch=0.3)
    motions = kind.motions(joint)
    if motions is None:
        assert kind.quaternion is not None
        return
    q, R, p = rng.uniform(-1, 1, kind.nq), np.eye(3), np.zeros(3)
    for x, motion in zip(q, motions, strict=True):
        axis = np.array(motion.axis)
        p = p + R @ axis * motion.advance * x
        if motion.turns:
            half = np.array([*np.sin(x / 2) * axis, np.cos(x / 2)])
            R = R @ matrix_from_quaternion(normalized(half))
    expected = kind.placement(np, joint, q.tolist())
    np.testing.assert_allclose(R, np.array(expected[0], dtype=float), atol=1e-14)
    np.testing.assert_allclose(p, np.array(expected[1], dtype=float), atol=1e-14)


def test_constants_of_a_long_chain_keep_their_digits():
    """Rounding of a rotation would double from link to link."""
    eq = LinkEquations(random_tree(0, 100, ("revolute",), nearest=1, armature=False), elimination="links")
    short, plain = (ca.vertcat(*m.forces(eq._scalars(eq.a))) for m in (eq.mechanics, eq.plain))
    assert eq._force_error(short, plain) < 1000


def test_forces_come_from_the_plain_frames_where_short_ones_lose_digits():
    eq = LinkEquations(mb.load("hextilt"), elimination="links")
    assert eq.sound is eq.plain
    eq = LinkEquations(mb.load("panda"), elimination="links")
    assert eq.sound is eq.mechanics
