"""Loops and prescribed motions on Pinocchio: against 34 digits, on random closed mechanisms of every kind."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import mbkit as mb
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import InputError, NumericalError, UnsupportedError
from mbkit.model.loops import LOOP_KINDS
from mbkit.model.parts import Loop, Prescribed
from tests.random_trees import SOUND, off, random_tree, rotation
from tests.scenes import chain, linkage

EPS = float(np.finfo(float).eps)
#: At which motions in time are taken, s.
T0 = 0.7
ROWS = {
    "constraint_residual": "q",
    "constraint_jacobian": "q",
    "constraint_rate": "qv",
    "constraint_bias": "qv",
}


def about_z(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def freedoms(tree: mb.Model, a: str, b: str) -> int:
    """Return how many velocities stand between two bodies."""
    carriers = {joint.child: joint for joint in tree.tree}

    def below(body: str) -> set[str]:
        out = set()
        while body != "world":
            out.add(body)
            body = carriers[body].parent
        return out

    return sum(carriers[x].type.nv for x in below(a) ^ below(b) if not carriers[x].mimic)


def closed(tree: mb.Model, q: np.ndarray, kinds: tuple[str, ...], rng, pairs=None, flat=False) -> mb.Model:
    """Return the tree with loops between random bodies that move against each other; their ends meet at q."""
    dyn = mb.dynamics(tree, "lagrangian", compile=False)
    names = ["world", *(body.name for body in tree.bodies)]
    loops = []
    for k, kind in enumerate(kinds):
        free = [(x, y) for x in names for y in names[1:] if x != y and freedoms(tree, x, y) > LOOP_KINDS[kind]]
        a, b = pairs[k] if pairs else rng.choice(free)
        X_a, X_b = (np.eye(4) if x == "world" else dyn.pose(q, str(x)) for x in (a, b))
        p, R = 0.3 * rng.standard_normal(3), np.eye(3) if flat else rotation(rng)
        if flat:
            p[2] = 0.0
        # Where end b stands, in the axes of end a: what the joint of the loop may do.
        turn, slide = np.eye(3), np.zeros(3)
        if kind in ("revolute", "cylindrical"):
            turn = about_z(0.8)
        if kind in ("cylindrical", "prismatic"):
            slide = np.array([0, 0, 0.4])
        if kind == "universal":
            turn = about_z(0.3) @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) @ about_z(1.1)
        if kind == "distance":
            slide = np.array([0.2, 0.3, 0.0 if flat else 0.4])
        at = X_a[:3, 3] + X_a[:3, :3] @ (p + R @ slide)
        turned = X_b[:3, :3].T @ X_a[:3, :3] @ R @ turn
        length = float(np.linalg.norm(slide)) if kind == "distance" else 0.0
        end_b = X_b[:3, :3].T @ (at - X_b[:3, 3])
        loops.append(Loop(f"loop{k}", kind, str(a), R, p, str(b), turned, end_b, length))
    return replace(tree, loops=tuple(loops))


def moved(model: mb.Model, q: np.ndarray, joint: str) -> mb.Model:
    """Return the model with a joint moved in time, through q at T0."""
    x = Prescribed(joint, 0.0, 0.4, 0.3, 2.0, 0.5)
    at = model.layout.q[joint].start
    offset = float(q[at]) - x.rate * T0 - x.amplitude * math.sin(x.frequency * T0 + x.phase)
    return replace(model, prescribed=(replace(x, offset=offset),))


def consistent(dyn, q: np.ndarray, rng) -> np.ndarray:
    """Return a random velocity with ḟ = 0."""
    v = rng.standard_normal(dyn.model.nv)
    return v - np.linalg.lstsq(dyn.constraint_jacobian(q), dyn.constraint_rate(q, v), rcond=1e-10)[0]


def condition(dyn, q: np.ndarray) -> float:
    """Return the condition of the equation of v̇ and λ, with unit masses and rows."""
    M, J = dyn.mass_matrix(q), dyn.constraint_jacobian(q)
    across = 1 / np.sqrt(np.diag(M))
    J = J * across
    J = J / np.linalg.norm(J, axis=1)[:, None]
    K = np.block([[across[:, None] * M * across, J.T], [J, np.zeros((len(J),) * 2)]])
    s = np.linalg.svd(K, compute_uv=False)
    # Of redundant rows only what they do not repeat counts.
    return float(s[0] / s[s > 1e-10 * s[0]][-1])


def against_34_digits(model: mb.Model, q: np.ndarray, seed: int, solver: str) -> None:
    rng = np.random.default_rng(seed)
    dyn, exact = mb.dynamics(model, "pinocchio"), mb.dynamics(model, "oracle")
    if model.time_parameter:
        dyn, exact = (x.at(**{model.time_parameter: T0}) for x in (dyn, exact))
    v, tau = consistent(exact, q, rng), rng.standard_normal(model.nv)
    assert dyn.constraint_solver == solver
    assert dyn.constraint_names == exact.constraint_names
    assert np.abs(dyn.constraint_residual(q)).max() < 1e-14
    state = {"q": q, "v": v}
    for name, arguments in ROWS.items():
        assert off(*(getattr(x, name)(*(state[k] for k in arguments)) for x in (dyn, exact))) < 1e-13, name
    close = max(1e-12, 20 * EPS * condition(exact, q))
    for name in ("forward_dynamics", "generalized_constraint_force", "constraint_forces"):
        assert off(*(getattr(x, name)(q, v, tau) for x in (dyn, exact))) < close, (name, close)
    # The other way to it, whichever was taken.
    a, forces = dyn._solved(q, v, tau)
    assert off(a, exact.forward_dynamics(q, v, tau)) < close
    assert off(forces, exact.constraint_forces(q, v, tau)) < close
    assert (dyn._iterated(q, v, tau) is not None) is (solver == "constraintDynamics")


@pytest.mark.thorough(every=3)
@pytest.mark.parametrize("kinds", [*((kind,) for kind in LOOP_KINDS), ("point", "point"), ("point", "distance")])
def test_a_random_tree_with_loops(kinds):
    seed = list(LOOP_KINDS).index(kinds[0]) + 23 * (len(kinds) - 1)
    tree = random_tree(seed, 7, tuple(k for k in SOUND if k != "fixed"), nearest=2)
    rng = np.random.default_rng(seed)
    q, _ = tree.random_state(rng)
    model = closed(tree, q, kinds, rng)
    against_34_digits(model, q, seed, "constraintDynamics" if {*kinds} <= {"point", "frame"} else "LAPACK")


@pytest.mark.thorough
@pytest.mark.parametrize("kinds", [("frame",), ("point", "revolute")])
def test_stacked_and_mimic_joints_in_loops(kinds):
    # Joints on each other as siblings, with couplings between joints that mimic others.
    tree = random_tree(3, 9, ("universal", "spherical_zyx", "planar", "revolute", "prismatic"), mimic=True)
    rng = np.random.default_rng(3)
    q, _ = tree.random_state(rng)
    assert tree.layout.reduced
    against_34_digits(closed(tree, q, kinds, rng), q, 3, "LAPACK")
    tree = random_tree(4, 6, ("universal", "spherical_zyx", "planar", "ball", "free"))
    q, _ = tree.random_state(rng)
    rigid = {*kinds} <= {"point", "frame"}
    against_34_digits(closed(tree, q, kinds, rng), q, 4, "constraintDynamics" if rigid else "LAPACK")


def planar(n: int, seed: int) -> tuple[mb.Model, np.ndarray]:
    """Return two chains in a plane, and a configuration."""
    rng, links = np.random.default_rng(seed), []
    for k in range(n):
        mass, com, at = rng.uniform(0.5, 2), 0.2 * rng.standard_normal(2), rng.uniform(0.2, 0.6, 2)
        body = {"mass": mass, "com": (*com, 0), "inertia": (0.1, 0.2, 0.2), "damping": 0.1, "translation": (*at, 0)}
        kind = {"kind": "prismatic", "axis": (1, 0, 0)} if k == 3 else {"axis": (0, 0, 1)}
        links.append(body | kind | {"parent": f"b{k - 2}" if k > 1 else "world"})
    return chain(*links, gravity=(0, -9.81, 0)).build(), rng.uniform(-1, 1, n)


@pytest.mark.thorough("kinds1-6", "kinds2-6")
@pytest.mark.parametrize(
    ("kinds", "n"), [(("point",), 4), (("frame",), 6), (("point", "point"), 6), (("revolute",), 5)]
)
def test_a_mechanism_in_a_plane_has_rows_that_say_nothing(kinds, n):
    tree, q = planar(n, n)
    rng = np.random.default_rng(n)
    pairs = [(f"b{n - 1 - k}", f"b{n - 2 - k}") for k in range(len(kinds))]
    model = closed(tree, q, kinds, rng, pairs, flat=True)
    rows = sum(LOOP_KINDS[kind] for kind in kinds)
    assert len(mb.dynamics(model).constraint_names) < rows
    against_34_digits(model, q, n, "LAPACK" if "revolute" in kinds else "constraintDynamics")


@pytest.mark.thorough("kinds1", "kinds2")
@pytest.mark.parametrize("kinds", [(), ("point",), ("prismatic",)])
def test_prescribed_motions(kinds):
    tree = random_tree(5, 7, ("revolute", "prismatic", "ball", "free", "helical"), nearest=2)
    rng = np.random.default_rng(5)
    q, _ = tree.random_state(rng)
    joint = next(j.name for j in tree.joints if j.kind == "revolute")
    model = moved(closed(tree, q, kinds, rng), q, joint)
    against_34_digits(model, q, 5, "LAPACK")
    # A drive of a joint that another mimics.
    tree = random_tree(8, 6, ("revolute", "prismatic", "helical"), mimic=True, nearest=1)
    q, _ = tree.random_state(rng)
    leader = next(j.mimic.joint for j in tree.joints if j.mimic)
    against_34_digits(moved(tree, q, leader), q, 5, "LAPACK")


def bricard() -> tuple[mb.Model, np.ndarray]:
    model = mb.catalog.bricard()
    for seed in range(20):
        q, _ = model.random_state(seed)
        if np.abs(mb.dynamics(model).constraint_residual(q)).max() < 1e-13:
            return model, q
    raise AssertionError


def test_rows_that_are_redundant_where_loops_are_closed():
    model, q = bricard()
    dyn = mb.dynamics(model)
    assert len(dyn.mobility(q).redundant) == 1
    against_34_digits(model, q, 0, "LAPACK")
    # A plane that is carried along: its third row is nothing where the loop is closed.
    governor = mb.catalog.flyball_governor()
    q, v = governor.random_state(1)
    exact = mb.dynamics(governor, "oracle")
    assert mb.dynamics(governor).constraint_solver == "LAPACK"
    assert off(*(x.forward_dynamics(q, v, 0 * v) for x in (mb.dynamics(governor), exact))) < 1e-13


@pytest.fixture(scope="module")
def four_bar():
    model = mb.catalog.four_bar()
    return model, mb.dynamics(model), *model.random_state(0)


def plain(dyn):
    """Return Pinocchio's model of the loops, and data: all that constraintDynamics takes but the state."""
    loops = pin.StdVec_RigidConstraintModel(list(dyn._held._rigid[0]))
    data = pin.StdVec_RigidConstraintData([x.createData() for x in loops])
    own = dyn.pin_model.createData()
    pin.initConstraintDynamics(dyn.pin_model, own, loops, data)
    return dyn.pin_model, own, loops, data


def test_without_regularization_a_loop_in_a_plane_is_nan_in_silence(four_bar):
    _, dyn, q, v = four_bar
    m, d, loops, data = plain(dyn)
    still = np.zeros(3)

    def a(mu):
        return pin.constraintDynamics(m, d, q, v, still, loops, data, pin.ProximalSettings(1e-14, 1e-14, mu, 20)).copy()

    assert not np.isfinite(a(0.0)).any()
    assert off(a(1e-10), dyn._force(dyn.forward_dynamics(q, v, still))) < 1e-13


def test_pinocchio_s_derivative_under_a_loop_is_not_that_of_its_acceleration(four_bar):
    _, dyn, q, v = four_bar
    m, d, loops, data = plain(dyn)
    tau, settings, h = np.zeros(3), pin.ProximalSettings(1e-14, 1e-14, 1e-10, 20), 1e-6

    def a(q):
        return pin.constraintDynamics(m, d, q, v, tau, loops, data, settings).copy()

    slopes = np.transpose([(a(q + h * e) - a(q - h * e)) / (2 * h) for e in np.eye(3)])
    own = LagrangianDynamics(dyn.model, compile=False).forward_dynamics_derivatives(q, v, tau)
    damping = np.diag([j.damping[0] for j in dyn.model.joints])
    a(q)
    by_q, *_ = pin.computeConstraintDynamicsDerivatives(m, d, loops, data, settings)
    assert not damping.any()
    assert off(slopes, own.q) < 1e-7
    assert off(by_q, own.q) > 1e-3
    with pytest.raises(UnsupportedError, match="computeConstraintDynamicsDerivatives"):
        dyn.forward_dynamics_derivatives(q, v, tau)
    with pytest.raises(UnsupportedError, match="computeConstraintDynamicsDerivatives"):
        dyn.linearize(q, v, tau)


def test_a_singular_pose_is_refused():
    dyn = mb.dynamics(linkage((1.0, 2.0, 1.0), ground=2.0, density=1.0).build())
    assert dyn.constraint_solver == "constraintDynamics"
    zero = np.zeros(3)
    for v in ([0.0, 0, 0], [1.0, -1, 1]):
        with pytest.raises(NumericalError, match=r"singular pose, where rows depend on each other .*loop 'pin'"):
            dyn.forward_dynamics(zero, v, zero)
        with pytest.raises(NumericalError, match="singular pose"):
            dyn.constraint_forces(zero, v, zero)
    # Beside it one freedom is left.
    q = np.array([0.3, -0.3, 0.3])
    exact = mb.dynamics(dyn.model, "oracle")
    assert off(*(x.forward_dynamics(q, [1.0, -1, 1], [0.1, 0, 0]) for x in (dyn, exact))) < 1e-12


def of_masses(b: float, c: float) -> mb.Model:
    links = []
    for parent, x, m in (("world", 0.0, 1.0), ("b0", 0.3, b), ("world", 1.0, c)):
        body = {"mass": m, "com": (0.2, 0, 0), "inertia": (0, m / 50, m / 50), "axis": (0, 0, 1)}
        links.append(body | {"parent": parent, "translation": (x, 0, 0)})
    out = chain(*links, gravity=(0, -9.81, 0))
    out.add_loop("pin", "point", body_a="b1", translation_a=(0.9, 0, 0), body_b="b2", translation_b=(0.7, 0, 0))
    return out.build()


def test_masses_that_differ_by_decades():
    for mass in (1e-2, 1e2):
        model = of_masses(mass, 1 / mass)
        against_34_digits(model, model.random_state(0)[0], 0, "constraintDynamics")
    model = of_masses(1e4, 1e-4)
    q, v = model.random_state(0)
    v, tau = 0 * v, np.zeros(3)
    dyn, right = mb.dynamics(model), mb.dynamics(model, "oracle").forward_dynamics(q, v, tau)
    m, d, loops, data = plain(dyn)
    settings = pin.ProximalSettings(1e-14, 1e-14, dyn._held._mu, 20)
    # What constraintDynamics loses is seen in the ends' accelerations, and LAPACK takes over.
    bare = pin.constraintDynamics(m, d, q, v, tau, loops, data, settings).copy()
    assert dyn._iterated(q, v, tau) is None
    a = dyn.forward_dynamics(q, v, tau)
    left = [np.abs(dyn.constraint_jacobian(q) @ x + dyn.constraint_bias(q, v)).max() for x in (bare, a)]
    assert left[1] < 1e-13
    assert left[0] > 100 * left[1]
    # The condition is 6e7: of factors alone nine digits would be right.
    assert off(a, right) < 1e-12
    assert off(bare, right) > 1e-10


def test_bodies_without_mass():
    crank = mb.catalog.slider_crank(crank_mass=0.0, rod_mass=0.0, piston_mass=1.3)
    q, v = crank.random_state(0)
    dyn, tau = mb.dynamics(crank), np.array([0.1, 0, 0])
    a, J = dyn.forward_dynamics(q, v, tau), dyn.constraint_jacobian(q)
    assert np.abs(J @ a + dyn.constraint_bias(q, v)).max() < 1e-14
    # The equation along the one freedom.
    along = np.linalg.svd(J)[2][-1]
    assert abs(along @ (dyn.inverse_dynamics(q, v, a) - tau)) < 1e-14


def test_batches_copies_and_wrenches(four_bar):
    model, dyn, *_ = four_bar
    q, v = model.random_state(2, 3)
    tau = np.random.default_rng(0).standard_normal((3, 3))
    many, one = dyn.forward_dynamics(q, v, tau), [dyn.forward_dynamics(*x) for x in zip(q, v, tau, strict=True)]
    assert np.array_equal(many, one)
    assert dyn.constraint_jacobian(q).shape == (3, 2, 3)
    assert dyn.constraint_forces(q, v, tau).shape == (3, 2)
    assert dyn.constraint_forces(q[:0], v[:0], tau[:0]).shape == (0, 2)
    again = pickle.loads(pickle.dumps(dyn))
    assert np.array_equal(again.forward_dynamics(q, v, tau), many)
    body = model.bodies[0].name
    push = {body: np.array([1.0, 2, 0, 0, 0, 0.5])}
    exact = mb.dynamics(model, "oracle")
    assert off(*(x.forward_dynamics(q, v, tau, push) for x in (dyn, exact))) < 1e-12
    driven = replace(model, prescribed=(Prescribed(model.joint_names[0], rate=2.0),))
    dyn, exact = mb.dynamics(driven), mb.dynamics(driven, "oracle")
    for t in (0.0, 0.4):
        later = dyn.at(t=t)
        assert later.model.time == t
        for x in (later, pickle.loads(pickle.dumps(later))):
            assert off(x.constraint_residual(q), exact.at(t=t).constraint_residual(q)) < 1e-14
        assert off(*(x.forward_dynamics(q, v, tau) for x in (later, exact.at(t=t)))) < 1e-11
    assert dyn.model.time == 0.0


def test_what_would_be_false_with_loops_is_refused(four_bar):
    model, dyn, q, v = four_bar
    with pytest.raises(InputError, match="forces in its loops"):
        dyn.joint_wrenches(q, v, v)
    assert {"joint_wrenches", "newton_euler_residual", "loop_wrenches", "constraint_forces"} <= dyn.supports
    tree = mb.dynamics(model.without("loops"))
    assert "joint_wrenches" in tree.supports
    assert not tree.supports & {"constraint_forces", "loop_wrenches", "actuator_forces"}
    # A term of the tree, whatever closes it.
    assert np.array_equal(dyn.inverse_dynamics(q, v, v), tree.inverse_dynamics(q, v, v))
    with pytest.raises(UnsupportedError, match="no loops"):
        tree.constraint_solver  # noqa: B018  # raises


def test_a_run_is_that_of_the_own_derivation(four_bar):
    model, dyn, q, v = four_bar
    own = LagrangianDynamics(model, compile=False)
    runs = [mb.simulate(x, q, v, 0.2, "rk4", dt=0.01, save=[0.2], doubt=False) for x in (dyn, own)]
    assert off(runs[0].q, runs[1].q) < 1e-12
