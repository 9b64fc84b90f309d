"""Ten numbers of which all values are bodies that can be: beside the direct numbers, and beside a sum over points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mbkit as mb
from mbkit.errors import InputError, ModelError
from mbkit.model.changes.freeing import TEN, body_of_log_cholesky
from tests.random_trees import off, random_tree

CLOSE = 1e-12
NUMBERS = st.lists(st.floats(-3, 3), min_size=10, max_size=10)


def matrix(inertia: dict[tuple[int, int], float]) -> np.ndarray:
    I = np.zeros((3, 3))
    for (i, k), x in inertia.items():
        I[i, k] = I[k, i] = x
    return I


@settings(max_examples=30, deadline=None)
@given(NUMBERS)
def test_any_ten_numbers_are_a_cloud_of_points(ten):
    """U's columns are points: J = U Uᵀ sums a point of weight w² at (x, y, z) = column / w."""
    own = body_of_log_cholesky(ten)
    a, d1, d2, d3, s12, s23, s13, *t = ten
    # Six points about t, which is their centre; each pair has half of a second moment on each side.
    V = np.array([[np.exp(d1), s12, s13], [0, np.exp(d2), s23], [0, 0, np.exp(d3)]])
    places = [np.array(t) + sign * np.sqrt(3) * V[:, k] for k in range(3) for sign in (1, -1)]
    weight = np.exp(2 * a) / 6
    away = [x - np.array(t) for x in places]
    inertia = sum(weight * (x @ x * np.eye(3) - np.outer(x, x)) for x in away)
    assert abs(own["mass"] - 6 * weight) < CLOSE * own["mass"]
    assert own["com"] == t
    assert np.abs(matrix(own["inertia"]) - inertia).max() <= CLOSE * np.trace(inertia)
    second = np.linalg.eigvalsh(0.5 * np.trace(inertia) * np.eye(3) - matrix(own["inertia"]))
    assert second.min() > -CLOSE * np.trace(inertia)


@settings(max_examples=6, deadline=None)
@given(st.integers(0, 10**6), NUMBERS)
def test_a_model_at_these_numbers_is_the_one_with_the_direct_ones(seed, ten):
    model = random_tree(seed, 3)
    body = model.joints[-1].child
    free = model.with_free(f"{body}.log_cholesky")
    names = [f"{body}.log_cholesky.{x}" for x in TEN]
    assert set(free.parameters) == {*names}
    q, v = model.random_state(seed)
    for quantity, arguments in (("mass_matrix", (q,)), ("nle", (q, v))):
        nominal = getattr(mb.dynamics(free, "lagrangian"), quantity)(*arguments)
        assert off(nominal, getattr(mb.dynamics(model, "lagrangian"), quantity)(*arguments)) < CLOSE
    own = body_of_log_cholesky(ten)
    b = mb.ModelBuilder.of(model)
    b.set_body(body, mass=own["mass"], com=own["com"], inertia=matrix(own["inertia"]))
    # Moments that cancel may end a rounding beside what can be, which the builder judges of direct numbers.
    try:
        other = mb.dynamics(b.build(), "lagrangian")
    except ModelError:
        return
    there = mb.dynamics(free, "lagrangian").at(**dict(zip(names, ten, strict=True)))
    assert off(there.mass_matrix(q), other.mass_matrix(q)) < CLOSE
    assert off(there.nle(q, v), other.nle(q, v)) < CLOSE
    plain = free.with_parameters(**dict(zip(names, ten, strict=True)))
    assert not plain.parameters
    assert plain.body(body).mass == pytest.approx(own["mass"], rel=1e-14)


def test_its_derivatives_are_those_of_the_direct_numbers():
    """A torque's change with alpha is twice that of all ten, since all of them grow like the mass."""
    robot = mb.load("ur5")
    free = mb.dynamics(robot.with_free("forearm_link.log_cholesky"), "lagrangian")
    q, v = robot.random_state(0)
    alpha, h = free.model.parameters["forearm_link.log_cholesky.alpha"], 1e-4
    ends = [free.at(**{"forearm_link.log_cholesky.alpha": alpha + x}).nle(q, v) for x in (h, -h)]
    b = mb.ModelBuilder.of(robot)
    body = robot.body("forearm_link")
    b.set_body("forearm_link", mass=2 * body.mass, inertia=2 * body.inertia)
    twice = mb.dynamics(b.build(), "lagrangian").nle(q, v) - mb.dynamics(robot, "lagrangian").nle(q, v)
    assert np.abs((ends[0] - ends[1]) / (2 * h) - 2 * twice).max() < 1e-6 * np.abs(twice).max()


def test_a_batch_takes_them():
    model = mb.catalog.pendulum()
    b = mb.ModelBuilder.of(model)
    b.set_body(model.bodies[0].name, inertia=(0.02, 0.03, 0.04))
    free = b.build().with_free(f"{model.bodies[0].name}.log_cholesky")
    batch = mb.dynamics(free, "lagrangian").at(**{f"{model.bodies[0].name}.log_cholesky.d1": [-1.0, 0.0, 1.0]})
    M = batch.mass_matrix([0.3])[:, 0, 0]
    for k, d in enumerate((-1.0, 0.0, 1.0)):
        one = free.with_parameters(**{f"{model.bodies[0].name}.log_cholesky.d1": d})
        assert abs(mb.dynamics(one, "pinocchio").mass_matrix([0.3])[0, 0] - M[k]) < CLOSE * M[k]


def test_variants_draw_them():
    many = mb.variants(mb.load("ur5"), {"forearm_link.log_cholesky": 0.5, "wrist_1_link.mass": 0.1}, size=50, seed=3)
    assert len(many.values) == 11
    for k in range(50):
        I = many[k].body("forearm_link").inertia
        assert np.linalg.eigvalsh(0.5 * np.trace(I) * np.eye(3) - I)[0] > 0
    assert np.std([np.log(x.body("forearm_link").mass) for x in many]) == pytest.approx(1.0, rel=0.3)


@pytest.mark.parametrize(
    ("paths", "words"),
    [
        (("forarm_link.log_cholesky",), "did you mean 'forearm_link.mass'"),
        (("forearm_link.log_cholesky", "forearm_link.mass"), "'forearm_link' are parameters already"),
        (("rod.log_cholesky",), "body 'rod' has no log-Cholesky factor"),
    ],
)
def test_what_has_no_factor_is_told(paths, words):
    b = mb.ModelBuilder.of(mb.load("ur5"))
    b.add_body("rod", mass=1.0, inertia=(0.1, 0.1, 0.0))
    b.add_joint("swing", "revolute", parent="wrist_3_link", child="rod", axis=(0, 1, 0))
    with pytest.raises(InputError, match=words):
        b.build().with_free(*paths)
