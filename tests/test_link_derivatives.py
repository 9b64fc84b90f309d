"""Derivatives from link to link: those of the energies by CasADi, on every joint type, in a count of operations."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import mbkit as mb
from mbkit.codegen.program import program
from mbkit.derivation import equations_of
from mbkit.derivation.equations import Equations
from mbkit.derivation.gauss_elimination import GaussElimination
from mbkit.derivation.link_derivatives import has_constant_columns
from mbkit.derivation.link_equations import LinkEquations
from mbkit.derivation.mass_matrix_solve import Factors, implicit
from tests.joint_of_ones_own import OWN
from tests.random_trees import ALL, off, random_tree, rotation, states
from tests.scenes import chain

EPS = np.finfo(float).eps
#: Roundings of a matrix of derivatives, on a scale of the whole matrix: two ways of computing it.
K = 100
DERIVATIVES = {"inverse_dynamics_derivatives": "a", "forward_dynamics_derivatives": "tau"}


def own_types(*kinds: str) -> mb.Model:
    """Return a chain with joint types of one's own between hinges on skew axes."""
    rng, links = np.random.default_rng(4), []
    for i, kind in enumerate(("revolute", *kinds, "revolute")):
        body = {"kind": kind, "mass": 1.0 + i, "com": rng.standard_normal(3), "inertia": np.diag([0.2, 0.3, 0.4])}
        place = {"rotation": rotation(rng), "translation": rng.standard_normal(3), "damping": 0.3}
        links.append(body | place | ({} if kind == "ball" else {"axis": rng.standard_normal(3)}))
    return chain(*links, gravity=(1.0, 2.0, -9.0)).build()


def coupled_branches() -> mb.Model:
    """Return two fingers on a floating palm, with a rotor, spring and damper that couple them, and a mimic joint."""
    palm = {"kind": "free", "mass": 1.0, "com": (0.1, 0.0, 0.2), "inertia": (0.1, 0.2, 0.25)}
    links = [palm]
    for side in (-1.0, 1.0):
        finger = {"mass": 0.3, "com": (0.1, 0.05 * side, 0.02), "inertia": (0.01, 0.02, 0.015)}
        places = [{"axis": (0.1 * k, side, 0.2), "translation": (0.2, side * 0.1 * (k == 0), 0.03)} for k in range(3)]
        links += [finger | places[0] | {"parent": "b0"}, finger | places[1], finger | places[2]]
    # b1 to b3 are the left finger, b4 to b6 the right one.
    links[6] |= {"mimic": ("j2", 0.7, 0.1)}
    b = chain(*links, gravity=(0.0, 1.0, -9.0))
    b.add_coupling(
        "tendon", {"j1": 1.0, "j5": -2.0, "j6": 0.5}, stiffness=3.0, rest_length=0.2, damping=0.4, armature=0.6
    )
    return b.build()


def parametric() -> mb.Model:
    """Return a hinge, a helical joint that follows it and a ball, with parameters in every place that takes them."""
    m, x = mb.Parameter("m", 1.3), mb.Parameter("x", 0.4)
    b = mb.ModelBuilder("parametric", gravity=(0.0, mb.Parameter("g", -9.0), 1.0))
    b.add_body("a", mass=m, com=(x, 0.1, 0.2), inertia=(0.2, 0.3, 0.4))
    b.add_body("b", mass=2.0, com=(0.3, x, 0.1), inertia=(0.2, 0.3, 0.4))
    b.add_body("c", mass=1.0, com=(0.3, 0.1, 0.1), inertia=(0.2, x, 0.4))
    b.add_joint("first", "revolute", parent="world", child="a", axis=(0, 0, 1), armature=m, damping=x)
    follows = {"pitch": 0.3, "mimic": ("first", x, 0.2)}
    b.add_joint("second", "helical", parent="a", child="b", axis=(0.0, 0.6, 0.8), translation=(x, 0.2, 0.0), **follows)
    b.add_joint("third", "ball", parent="b", child="c", translation=(0.1, x, 0.2))
    return b.build()


MODELS = {
    "all types": random_tree(20, 12),
    "a branch of all types": random_tree(22, 10, nearest=1),
    "mimic joints": random_tree(24, 12, mimic=True, nearest=2),
    "free and ball joints below others": random_tree(26, 6, ("free", "ball", "helical", "prismatic"), nearest=1),
    "slides": random_tree(27, 8, ("prismatic", "helical", "planar"), nearest=2),
    "many roots": random_tree(28, 6, ("revolute", "ball"), nearest=6),
    "coupled branches": coupled_branches(),
    "own constant columns": own_types("cylindrical", "ball"),
    "own moving columns": own_types("sliding_ball", "cylindrical"),
    "parameters": parametric(),
}
#: Where a joint's columns move in its link: CasADi differentiates the forces.
MOVING = ("own moving columns",)


@pytest.fixture(params=list(MODELS))
def case(request):
    return request.param, MODELS[request.param]


def values(equations: Equations, name: str, *arguments: np.ndarray) -> list[np.ndarray]:
    parameters = list(equations.model.parameters.values())
    return [np.array(x) for x in equations.function(name).call([*arguments, *([parameters] if parameters else [])])]


@pytest.mark.thorough(every=4)
def test_they_are_those_of_the_energies(case):
    _, model = case
    links, energies = LinkEquations(model, elimination="links"), Equations(model)
    for q, v, a, tau in zip(*states(model, 2), strict=True):
        for name, third in (("inverse_dynamics_derivatives", a), ("forward_dynamics_derivatives", tau)):
            M = values(energies, "mass_matrix", q)[0]
            k = K * (1.0 if name.startswith("inverse") else np.linalg.cond(M))
            for x, y in zip(values(links, name, q, v, third), values(energies, name, q, v, third), strict=True):
                assert np.linalg.norm(x - y) <= k * EPS * np.linalg.norm(y)
        C, other = (values(equations, "coriolis_matrix", q, v)[0] for equations in (links, energies))
        assert np.linalg.norm(C - other) <= K * EPS * np.linalg.norm(other)


def test_casadi_differentiates_where_columns_move(case):
    name, model = case
    assert has_constant_columns(LinkEquations(model).mechanics.tree) == (name not in MOVING)
    assert {"cylindrical", "sliding_ball"} == set(OWN)


@pytest.mark.parametrize("elimination", ["links", "least constraint"])
def test_both_eliminations_solve_for_them(elimination):
    model = random_tree(30, 7, ALL[:4], nearest=2)
    q, v, _, tau = (x[0] for x in states(model, 1))
    oracle = mb.dynamics(model, "oracle").forward_dynamics_derivatives(q, v, tau)
    own = values(LinkEquations(model, elimination=elimination), "forward_dynamics_derivatives", q, v, tau)
    condition = np.linalg.cond(mb.dynamics(model, "oracle").mass_matrix(q))
    for x, y in zip(own, oracle, strict=True):
        assert off(x, y) < condition * EPS


def test_the_inverse_of_the_mass_matrix_is_exactly_symmetric():
    model = MODELS["coupled branches"]
    q, v, _, tau = (x[0] for x in states(model, 1))
    inverse = values(equations_of(model), "forward_dynamics_derivatives", q, v, tau)[2]
    assert np.array_equal(inverse, inverse.T)


def test_a_uniform_motion_changes_nothing_that_hangs_below():
    """Galileo: to the last digit, since no velocity of an origin enters."""
    model = random_tree(31, 8, ("revolute", "prismatic", "ball"), nearest=2, springs=False, damping=False)
    matter = {"mass": 3.0, "com": (0.1, 0.2, 0.3), "inertia": (1.0, 1.1, 1.2)}
    hull = chain(matter | {"body": "hull", "joint": "sea", "kind": "free"}).build()
    hung = (replace(j, parent="hull") if j.parent == "world" else j for j in model.joints)
    bodies, joints = (*hull.bodies, *model.bodies), (*hull.joints, *hung)
    ship = replace(hull, gravity=model.gravity, bodies=bodies, joints=joints)
    equations = LinkEquations(ship)
    q, v, a, _ = (x[0] for x in states(ship, 1))
    part = ship.layout.v["sea"]
    # It does not turn, whose product with the velocity would be a force.
    v[part] = 0.0
    slow = values(equations, "inverse_dynamics_derivatives", q, v, a)
    v[part][:3] = 1e9
    fast = values(equations, "inverse_dynamics_derivatives", q, v, a)
    below = np.setdiff1d(np.arange(ship.nv), np.arange(part.start, part.stop))
    for x, y in zip(fast, slow, strict=True):
        assert np.abs(y[np.ix_(below, below)]).max() > 0.1
        assert np.array_equal(x[np.ix_(below, below)], y[np.ix_(below, below)])


def operations(equations: Equations, results: tuple[ca.SX, ...]) -> int:
    given = [equations.q, equations.v, equations.a, equations.tau]
    return program(ca.Function("f", given, [ca.densify(x) for x in results])).arithmetic


@pytest.mark.thorough("all types")
@pytest.mark.parametrize("kinds", [("revolute",), ALL], ids=["hinges", "all types"])
def test_they_take_fewer_operations_than_the_forces_differentiated(kinds):
    model = random_tree(32, 12, kinds, nearest=2, springs=False, damping=False)
    own, other = LinkEquations(model), LinkEquations(model)
    by_casadi = Equations.inverse_dynamics_derivatives.func(other)
    assert operations(own, own.inverse_dynamics_derivatives[:2]) < 0.6 * operations(other, by_casadi[:2])


@pytest.mark.thorough
def test_their_number_grows_with_the_pairs_of_joints_on_a_branch():
    counts = []
    for n in (6, 12, 24):
        model = random_tree(33, n, ("revolute",), nearest=1, springs=False, damping=False)
        equations = LinkEquations(model)
        counts.append(operations(equations, equations.inverse_dynamics_derivatives))
    # A chain's pairs; of a star each joint takes as many.
    assert counts[2] - counts[1] < 4 * (counts[1] - counts[0])
    ray = {"parent": "world", "mass": 1.0, "com": (0.1, 0.2, 0.3), "inertia": (0.1, 0.2, 0.25), "axis": (0, 1, 0)}
    equations = LinkEquations(chain(*[ray] * 16, gravity=(1.0, 2.0, 3.0)).build())
    assert operations(equations, equations.inverse_dynamics_derivatives) < 16 * 40


def hands() -> mb.Model:
    """Return two hands of six links on one wrist."""
    link = {"mass": 1.0, "com": (0.1, 0.2, 0.3), "inertia": (0.1, 0.2, 0.25)}
    fingers = [link | {"axis": np.eye(3)[k % 3], "translation": (0.1, 0.3, 0.2)} for k in range(6)]
    hand = [fingers[0] | {"parent": "b0"}, *fingers[1:]]
    return chain(link | {"axis": (0, 0, 1)}, *hand, *hand, gravity=(1.0, 2.0, 3.0)).build()


def test_branches_share_only_what_they_hang_on():
    """M⁻¹ of many columns takes fewer operations than a substitution through each hand for the other."""
    equations = LinkEquations(hands())
    n = equations.model.nv
    by_q, by_v, M = equations.inverse_dynamics_derivatives
    inverse, entries = GaussElimination(equations.plain).inverse_factors()
    # Rows 1 to 6 are one hand, 7 to 12 the other.
    assert not any(1 <= min(key) <= 6 < max(key) for key in entries)
    rows, columns = zip(*entries, strict=True)
    L = ca.SX.triplet(rows, columns, ca.vertcat(*entries.values()), n, n)
    D = ca.vertcat(*inverse)
    factors = Factors(M, equations.elimination_order)
    known = [ca.vertcat(*(x for row in factors.factors for x in row.values())), ca.vertcat(*factors.inverse)]
    right = ca.horzcat(-by_q, -by_v, ca.SX.eye(n))
    substituted = [M, by_q, by_v, *known, factors.solve(right)]
    by_substitution = operations(equations, substituted) - operations(equations, substituted[:-1])
    products = operations(equations, (by_q, by_v, L, D, *implicit(D, L, by_q, by_v)))
    assert products - operations(equations, (by_q, by_v, L, D)) < 0.75 * by_substitution


@pytest.mark.thorough("all types", "a branch of all types", "mimic joints", "free and ball joints below others")
@pytest.mark.parametrize("name", [name for name in MODELS if name not in MOVING])
def test_the_links_give_inverse_factors_of_the_mass_matrix(name):
    equations = LinkEquations(MODELS[name], elimination="links")
    n = equations.model.nv
    inverse, entries = GaussElimination(equations.plain).inverse_factors()
    q = states(equations.model, 1)[0][0]
    results = [ca.vertcat(ca.SX(0, 1), *(ca.SX(x) for x in part)) for part in (inverse, entries.values())]
    f = ca.Function("f", [equations.q, equations.parameters], [*results, ca.densify(equations.mass_matrix)])
    inverse, values_, M = (np.array(x) for x in f(q, list(equations.model.parameters.values())))
    L = np.zeros((n, n))
    L[tuple(zip(*entries, strict=True))] = values_.ravel()
    assert np.array_equal(L.diagonal(), np.ones(n))
    assert off(L @ (inverse * L.T) @ M, np.eye(n)) < 10 * np.linalg.cond(M) * EPS


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [1])
def test_they_have_the_digits_of_the_accelerations(seed):
    """Factors of a formed mass matrix would lose up to a hundred times as many."""
    model = random_tree(seed, 12, nearest=2, mimic=True, springs=False, damping=False)
    q, v, _, tau = states(model, 12)
    oracle, links = mb.dynamics(model, "oracle"), LinkEquations(model, elimination="links")
    names = ("forward_dynamics", "forward_dynamics_derivatives")
    accelerations, derivatives = (links.function(name).map(len(q)) for name in names)
    exact = oracle.forward_dynamics(q, v, tau), oracle.mass_matrix_inverse(q)
    own = np.array(accelerations(q.T, v.T, tau.T)).T, np.array(derivatives(q.T, v.T, tau.T)[2])
    inverses = own[1].reshape(model.nv, len(q), model.nv).swapaxes(0, 1)
    errors = [
        (off(x, y), off(M.ravel(), N.ravel())) for x, y, M, N in zip(own[0], exact[0], inverses, exact[1], strict=True)
    ]
    worst = np.max(errors, axis=0)
    assert worst[1] < 3 * worst[0]
