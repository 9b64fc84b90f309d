"""Regressors against torques, momenta and energies, Pinocchio's, and their exact rank in 34 digits."""

from __future__ import annotations

from dataclasses import replace

import mpmath
import numpy as np
import pytest

import mbkit as mb
from mbkit.errors import InputError, UnsupportedError
from mbkit.model import Model
from mbkit.model.base_parameters import energy_regressor
from tests.joint_of_ones_own import OWN
from tests.random_trees import ALL, random_tree, states

EPS = float(np.finfo(float).eps)
#: Terms in a sum of a torque, and roundings in each.
ROUNDINGS = 1000


def tree_of(seed: int, n: int = 8, **options) -> Model:
    # A damper between points has no parameter of a joint.
    return replace(random_tree(seed, n, mimic=bool(seed % 2), **options), springs=())


def derived(model: Model):
    return mb.dynamics(model, "lagrangian", compile=False, elimination="mass matrix")


def losses(model: Model, field: str) -> np.ndarray:
    """Return damping, friction or armature of every velocity, the joints that mimic among them."""
    full = np.concatenate([np.zeros(0), *(getattr(j, field) for j in model.joints)])
    G = np.abs(model.layout.G)
    return full @ (G if field == "friction" else G**2)


def close(a: np.ndarray, b: np.ndarray, scale: np.ndarray) -> bool:
    return bool((np.abs(a - b) <= ROUNDINGS * EPS * scale.max(initial=1e-300)).all())


@pytest.mark.thorough("0", "1", "2", "3")
@pytest.mark.parametrize("seed", range(8))
def test_torques_are_linear_in_the_parameters(seed: int) -> None:
    model = tree_of(seed, springs=False)
    q, v, a, _ = states(model, 4)
    dyn, base = derived(model), model.base_parameters()
    rotors = [i for i, name in enumerate(model.velocity_names) if f"{name}.armature" in names(model)]
    rest = np.concatenate([losses(model, "damping"), np.zeros(model.nv), losses(model, "armature")[rotors]])
    tau = dyn.inverse_dynamics(q, v, a)
    for parameters, values in (("standard", base.standard), ("base", base.values)):
        Y = dyn.regressor(q, v, a, parameters, friction=True, armature=True)
        pi = np.concatenate([values, rest])
        assert Y.shape == (4, model.nv, len(model.regressor_columns(parameters, friction=True, armature=True)))
        assert close(Y @ pi, tau, np.abs(Y) @ np.abs(pi))
    dry = dyn.regressor(q, v, a, friction=True)[..., -model.nv :]
    assert np.array_equal(dry, np.sign(v)[:, :, None] * np.eye(model.nv))


def names(model: Model) -> tuple[str, ...]:
    return model.regressor_columns(armature=True)


@pytest.mark.thorough("2", "4", "6", "7")
@pytest.mark.parametrize("seed", range(8))
def test_momenta_and_energies_are_linear_in_the_parameters(seed: int) -> None:
    model = tree_of(seed, springs=False, armature=False)
    q, v, _, _ = states(model, 4)
    dyn, base = derived(model), model.base_parameters()
    p = dyn.momentum_regressor(q, v)
    assert close(p @ base.standard, (dyn.mass_matrix(q) @ v[..., None])[..., 0], np.abs(p) @ np.abs(base.standard))
    E = dyn.energy_regressor(q, v)
    own = np.stack([dyn.kinetic_energy(q, v), dyn.potential_energy(q)], axis=-1)
    assert close(E @ base.standard, own, np.abs(E) @ np.abs(base.standard))
    # Written down apart, by pseudo-inertias.
    assert close(E, np.stack(energy_regressor(model, q, v, model.gravity), axis=1), np.abs(E))
    few = dyn.energy_regressor(q, v, "base") @ base.values
    assert close(few[:, 0], own[:, 0], np.abs(E) @ np.abs(base.standard))
    assert close(few[:, 1] - few[0, 1], own[:, 1] - own[0, 1], np.abs(E) @ np.abs(base.standard))


def test_rotors_have_momentum_and_energy() -> None:
    b = mb.ModelBuilder("rotor")
    b.add_body("rod", mass=1.0, com=(0, 0, -1), inertia=np.eye(3))
    b.add_joint("hinge", "revolute", parent="world", child="rod", axis=(0, 1, 0), armature=0.5)
    model = b.build()
    dyn = derived(model)
    pi = np.append(model.base_parameters().standard, 0.5)
    assert dyn.momentum_regressor([0.3], [2.0], armature=True) @ pi == pytest.approx(dyn.mass_matrix([0.3])[0] * 2.0)
    kinetic, potential = dyn.energy_regressor([0.3], [2.0], armature=True) @ pi
    assert (kinetic, potential) == pytest.approx((dyn.kinetic_energy([0.3], [2.0]), dyn.potential_energy([0.3])))


@pytest.mark.thorough(every=2)
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("parameters", ["standard", "base"])
def test_pinocchio_has_the_same(seed: int, parameters: str) -> None:
    model = tree_of(seed)
    q, v, a, _ = states(model, 2)
    own, pin = derived(model), mb.dynamics(model, "pinocchio")
    for x, y in (
        (d.regressor(q, v, a, parameters, friction=True, armature=True) for d in (own, pin)),
        (d.momentum_regressor(q, v, parameters, armature=True) for d in (own, pin)),
        (d.energy_regressor(q, v, parameters, armature=True) for d in (own, pin)),
    ):
        assert close(x, y, np.abs(x))


def test_pinocchio_with_one_velocity() -> None:
    model, state = mb.catalog.pendulum(), ([0.4], [0.5], [0.6])
    assert np.allclose(mb.dynamics(model).regressor(*state), derived(model).regressor(*state), rtol=0, atol=1e-15)


def exact_parameters(model: Model) -> list[mpmath.mpf]:
    """Return the standard parameters in 34 digits."""
    out = []
    for body in (model.body(j.child) for j in model.tree):
        m, c = mpmath.mpf(body.mass), [mpmath.mpf(x) for x in body.com.tolist()]
        square = sum(x * x for x in c)
        inertia = [[mpmath.mpf(x) for x in row] for row in ((body.inertia + body.inertia.T) / 2).tolist()]
        for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            out.append(inertia[i][j] + m * ((square if i == j else 0) - c[i] * c[j]))
        out += [*(m * x for x in c), m]
    return out


@pytest.mark.parametrize("seed", [1, 2])
def test_the_oracle_has_it_in_34_digits(seed: int) -> None:
    tree = tree_of(seed, len(ALL), springs=False, damping=False, armature=False)
    # Virtual work and energies say the same of rotations and unit axes alone, and these are so to rounding.
    square = {"rotation": np.eye(3)[[2, 0, 1]]}
    model = replace(tree, joints=tuple(replace(j, axes=np.eye(3)[: len(j.axes)], **square) for j in tree.joints))
    q, v, a, _ = states(model, 1)
    oracle = mb.dynamics(model, "oracle")
    with mpmath.workdps(36):
        Y = oracle.digits("regressor", q[0], v[0], a[0])
        tau = oracle.digits("inverse_dynamics", q[0], v[0], a[0])
        pi = exact_parameters(model)
        for row, x in zip(Y, tau, strict=True):
            terms = [y * p for y, p in zip(row, pi, strict=True)]
            assert abs(sum(terms) - x) <= mpmath.mpf(10) ** -31 * max(map(abs, [*terms, mpmath.mpf(1)]))


def square_arm() -> Model:
    """Return an arm with parallel, crossing and sliding axes whose numbers are exact in binary."""
    b = mb.ModelBuilder("square_arm", gravity=(0, 0, -8))
    axes = [("revolute", (0, 0, 1)), ("revolute", (0, 1, 0)), ("revolute", (0, 1, 0)), ("prismatic", (1, 0, 0))]
    parent = "world"
    for k, (kind, axis) in enumerate([*axes, ("revolute", (1, 0, 0))]):
        b.add_body(f"link{k}", mass=1.0, com=(0.25, 0.5, 0.125), inertia=np.diag([1.0, 1.5, 2.0]))
        b.add_joint(f"j{k}", kind, parent=parent, child=f"link{k}", axis=axis, translation=(0.5, 0.25 * (k == 2), 0.0))
        parent = f"link{k}"
    return b.build()


@pytest.mark.parametrize("model", [mb.catalog.double_pendulum(), square_arm()], ids=lambda m: m.name)
def test_base_columns_are_independent_and_all_in_34_digits(model: Model) -> None:
    """Of standard columns the base ones alone are left by elimination, and the rest vanishes to all digits."""
    base = model.base_parameters()
    n = -(-base.standard.size // model.nv) + 2
    q, v, a, _ = states(model, n)
    oracle = mb.dynamics(model, "oracle")
    with mpmath.workdps(36):
        Y = oracle.digits("regressor", q, v, a).reshape(n * model.nv, -1)
        kept = [base.standard_names.index(name) for name in base.names]
        left = Y.copy()
        for k in kept:
            column = left[:, k].copy()
            size = column @ column
            # What is left of a column that others span would have some 1e-66.
            assert size > mpmath.mpf(10) ** -6
            left = left - np.outer(column, (column @ left) / size)
        others = [k for k in range(base.standard.size) if k not in kept]
        assert max(abs(x) for x in left[:, others].ravel()) < mpmath.mpf(10) ** -29


def test_at_other_values_of_parameters() -> None:
    model = mb.catalog.double_pendulum(length1=mb.Parameter("l", 1.0))
    state = [0.3, 0.2], [1.0, -0.5], [0.4, 0.6]
    longer = mb.dynamics(model, "lagrangian").at(l=2.0).regressor(*state)
    assert np.allclose(longer, derived(mb.catalog.double_pendulum(length1=2.0)).regressor(*state), rtol=0, atol=1e-14)


def test_with_a_joint_type_of_ones_own() -> None:
    b = mb.ModelBuilder("own")
    for k, kind in enumerate(OWN):
        b.add_body(f"b{k}", mass=1.0 + k, com=(0.1, 0.2, 0.3), inertia=np.diag([1.0, 1.5, 2.0]))
        b.add_joint(f"j{k}", kind, parent=f"b{k - 1}" if k else "world", child=f"b{k}", axis=(0.6, 0.0, 0.8))
    model = b.build()
    q, v, a, _ = states(model, 2)
    dyn = derived(model)
    Y, pi = dyn.regressor(q, v, a), model.base_parameters().standard
    assert close(Y @ pi, dyn.inverse_dynamics(q, v, a), np.abs(Y) @ np.abs(pi))


def test_bad_arguments() -> None:
    model = mb.catalog.pendulum()
    dyn = mb.dynamics(model, "lagrangian")
    with pytest.raises(InputError, match="parameters"):
        dyn.regressor([0.1], [0.1], [0.1], "few")
    with pytest.raises(InputError, match="a:"):
        dyn.regressor([0.1], [0.1], [0.1, 0.2])
    with pytest.raises(InputError, match="finite"):
        dyn.energy_regressor([np.nan], [0.1])
    with pytest.raises(UnsupportedError, match="lagrangian"):
        mb.dynamics(model, "mujoco").regressor([0.1], [0.1], [0.1])
    with pytest.raises(UnsupportedError, match="no bodies"):
        mb.lagrangian.systems.pendulum().model.regressor_columns()
