"""The contract of engines: each quantity, of each kind of model, is right against the oracle or refused by name."""

from __future__ import annotations

import inspect
import warnings

import numpy as np
import pytest

import mbkit as mb
from mbkit.engines import ENGINES, Dynamics
from mbkit.engines.frames_and_momenta import AXES
from mbkit.errors import KnownDefectWarning, UnsupportedError
from mbkit.model.quantities import QUANTITIES, of_groups
from tests import quantities
from tests.joint_of_ones_own import OWN
from tests.quantities import BUILT_IN, DERIVATIVES, MODELS, NOTHING, TERMS, of_joint, scene, value
from tests.random_trees import off, random_tree, states
from tests.scenes import mounted

EPS = np.finfo(float).eps
#: Normwise: what large terms leave of their rounding where they cancel.
CLOSE = 500 * EPS


OF_ROWS = [x for x in of_groups("row") if x.startswith(("constraint_r", "constraint_j", "constraint_b"))]


@pytest.mark.thorough(
    *("revolute", "continuous", "prismatic", "spherical_zyx", "ball", "planar", "cylindrical", "without springs"),
    *("free", "universal", "loop.revolute", "loop.prismatic", "loop.cylindrical", "loop.distance", "planar_3rrr"),
    *("loop.universal", "loop.point", "solo12", "flyball_governor"),
)
@pytest.mark.parametrize("name", MODELS)
def test_each_quantity_is_right_or_refused(name):
    of = scene(name)
    at, refused, held = of.row(0), {}, of.model.constrained
    wanted = [x for x in TERMS if x in of.oracle.supports | {*DERIVATIVES} and not (held and x in quantities.OF_TREES)]
    assert set(wanted) | quantities.OF_TREES >= of.oracle.supports - {"reduced_inertia"}
    right = {x: value(of.oracle, x, at) for x in wanted}
    for engine in (x for x in ENGINES if x != "oracle"):
        try:
            dyn = mb.dynamics(of.model, engine)
        except UnsupportedError as error:
            refused[engine] = str(error)
            continue
        soft = quantities.OF_FORCES if dyn._soft_constraints and held else ()
        for quantity in (x for x in wanted if x not in soft):
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", KnownDefectWarning)
                try:
                    found = value(dyn, quantity, at)
                except UnsupportedError as error:
                    refused[engine, quantity] = str(error)
                    assert quantity not in dyn.supports
                    continue
            if any(issubclass(w.category, KnownDefectWarning) for w in caught):
                continue
            factor = of.condition if quantity in quantities.SOLVED else 1.0
            assert found.shape == right[quantity].shape, (engine, quantity)
            assert off(found.ravel(), right[quantity].ravel()) < CLOSE * factor, (engine, quantity)
        # Rows are there where they do not hold, too.
        for quantity in (x for x in OF_ROWS if held and x in dyn.supports):
            assert off(*(value(x, quantity, of.opened(0)) for x in (dyn, of.oracle))) < CLOSE, (engine, quantity)
        if soft and engine == "mujoco":
            said = dyn.constraint_law(at["q"], at["v"], at["tau"])
            assert off(dyn.forward_dynamics(at["q"], at["v"], at["tau"]), said.acceleration) < 1e-11
            assert off(said.rigid, right["forward_dynamics"][..., 0]) < 1e-11
    assert not {"lagrangian", "oracle"} & {*refused}
    kind = name.removeprefix("loop.")
    assert all(kind in text or name not in BUILT_IN for key, text in refused.items() if isinstance(key, str)), refused
    assert all(key[0] in text.lower() for key, text in refused.items() if not isinstance(key, str)), refused


FLOATING = ("free", "ball", "revolute", "prismatic")
#: Two bodies have no point spring; with more of them, random trees have two.
FEATURES = {
    "nothing": lambda: random_tree(3, 4, FLOATING, **NOTHING),
    "dampers": lambda: random_tree(4, 2, ("free", "revolute"), **NOTHING | {"damping": True}),
    "dampers of hinges": lambda: random_tree(4, 2, ("revolute", "universal"), **NOTHING | {"damping": True}),
    "joint springs": lambda: random_tree(5, 2, ("free", "prismatic"), **NOTHING | {"springs": True}),
    "point springs": lambda: random_tree(6, 4, FLOATING, **NOTHING | {"springs": True, "damping": True}),
    "armature": lambda: random_tree(7, 4, ("revolute", "prismatic", "ball"), **NOTHING | {"armature": True}),
    "mimic": lambda: random_tree(8, 5, ("free", "revolute", "prismatic"), **NOTHING, mimic=True),
    "all": lambda: random_tree(9, 6, FLOATING, mimic=True),
    "one velocity": mb.catalog.pendulum,
    "loop": mb.catalog.four_bar,
}


@pytest.mark.thorough(every=6)
@pytest.mark.parametrize(
    ("engine", "feature"),
    [
        *((engine, feature) for engine in ENGINES for feature in FEATURES if engine != "oracle"),
        # To the oracle one state is a batch of one.
        ("oracle", "all"),
        # What a feature adds is derived as for interpreting; code differs where a quantity is constant, or lacks v.
        *(("compiled", feature) for feature in ("nothing", "dampers", "joint springs", "all", "loop")),
    ],
)
@pytest.mark.filterwarnings("ignore::mbkit.errors.KnownDefectWarning")
def test_one_state_has_the_values_of_its_row_in_a_batch(engine, feature):
    """Single states have calls of their own, with other code than batches; and a batch of none has the same shape."""
    model = FEATURES[feature]()
    compiled = engine == "compiled"
    dyn = mb.dynamics(model, "lagrangian", compile=True) if compiled else mb.dynamics(model, engine)
    batch = dict(zip(("q", "v", "a", "tau"), states(model, 3), strict=True))
    if model.constrained:
        batch["a"] = mb.dynamics(model, "lagrangian").forward_dynamics(batch["q"], batch["v"], batch["tau"])
    M = dyn.mass_matrix(batch["q"])
    # Derivatives as machine code are compiled for seconds, and tests/test_derivatives.py has their batches.
    for quantity in (*TERMS[: -len(DERIVATIVES)], *DERIVATIVES[: 0 if compiled else 2]):
        if quantity in of_groups("actuator", "loop", "motion"):
            continue
        try:
            whole = value(dyn, quantity, batch, AXES[:1])
        except UnsupportedError:
            continue
        none = value(dyn, quantity, {name: x[:0] for name, x in batch.items()}, AXES[:1])
        rows = [value(dyn, quantity, {name: x[i] for name, x in batch.items()}, AXES[:1]) for i in range(3)]
        assert whole.shape == (3, *np.shape(rows[0])), quantity
        assert none.shape == (0, *whole.shape[1:]) or quantity in DERIVATIVES, quantity
        tolerance = 1e-13 * (np.linalg.cond(M).max() if quantity.startswith("forward") else 1.0)
        assert off(rows, whole) < tolerance, quantity


@pytest.mark.parametrize("way", [*ENGINES, "compiled"])
def test_a_model_without_velocities_has_empty_terms_poses_and_loads(way):
    b = mounted("rock", "a", "f", "fixed", mass=2.0, com=(1, 2, 3), inertia=(1, 1, 1))
    b.add_frame("top", body="a", translation=(0, 0, 1))
    model, none = b.build(), np.zeros(0)
    dyn = mb.dynamics(model, "lagrangian", compile=True) if way == "compiled" else mb.dynamics(model, way)
    empty = dict.fromkeys(("q", "v", "a", "tau"), none)
    for quantity in dyn.supports - {"function", "joint_wrenches"}:
        found = value(dyn, quantity, empty, AXES[:1])[..., 0]
        if quantity.endswith(("jacobian", "matrix", "inverse", "force", "nle", "gravity", "passive", "dynamics")):
            assert found.shape[-1] == 0, quantity
    assert dyn.mass_matrix(np.zeros((3, 0))).shape == (3, 0, 0)
    assert dyn.potential_energy(none) == pytest.approx(2 * 3 * 9.81)
    assert dyn.pose(none, "top")[:3, 3] == pytest.approx([0, 0, 1])
    if "locked_inertia" in dyn.supports:
        assert np.array_equal(dyn.center_of_mass(none), [1, 2, 3])
        assert np.array_equal(dyn.centroidal_momentum(none, none), np.zeros(6))
        assert dyn.locked_inertia(none) == pytest.approx(np.diag([2, 2, 2, 1, 1, 1]), abs=1e-14)
    if "joint_wrenches" in dyn.supports:
        weight = 2.0 * 9.81
        load = dyn.joint_wrenches(none, none, none, joints=["f"])[0]
        assert load == pytest.approx([0, 0, weight, 2 * weight, -weight, 0])


@pytest.mark.thorough("spherical_zyx", "ball", "planar", "free", "sliding_ball")
@pytest.mark.parametrize("kind", [*BUILT_IN, *OWN])
def test_coriolis_matrices_give_the_force_and_a_skew_difference(kind):
    model, at = of_joint(kind), scene(kind).row(0)
    for engine in ("lagrangian", "oracle"):
        dyn = mb.dynamics(model, engine)
        C = dyn.coriolis_matrix(at["q"], at["v"])
        h = 1e-6
        ahead, behind = (dyn.mass_matrix(model.integrate(at["q"], s * h * at["v"])) for s in (1, -1))
        skew = (ahead - behind) / (2 * h) - 2 * C
        assert np.abs(C @ at["v"] - dyn.coriolis_force(at["q"], at["v"])).max() < 1e-13 * (1 + np.abs(C).max())
        assert np.abs(skew + skew.T).max() < 1e-8 * (1 + np.abs(C).max())


@pytest.mark.parametrize("kind", [*BUILT_IN, *OWN])
def test_a_run_keeps_the_energy_and_the_manifold(kind):
    model = of_joint(kind).without("damping")
    q, v = model.random_state(np.random.default_rng(3))
    dyn = mb.dynamics(model, "lagrangian", compile=False)
    run = mb.simulate(dyn, q, 0.5 * v, 0.2, method="rk853", rtol=1e-10)
    assert np.abs(run.energy() - run.energy()[0]).max() < 1e-8 * (1 + np.abs(run.energy()[0]))
    step = model.difference(run.q[0], run.q[-1])
    assert np.abs(model.integrate(run.q[0], step) - run.q[-1]).max() < 1e-13


@pytest.mark.parametrize("engine", ["lagrangian", "oracle", "pinocchio"])
def test_methods_take_and_return_what_the_table_of_quantities_says(engine):
    tree, closed = (mb.dynamics(make(), engine) for make in (mb.catalog.double_pendulum, mb.catalog.four_bar))
    for name, row in QUANTITIES.items():
        takes = inspect.signature(getattr(Dynamics, name)).parameters if row.listed else row.arguments
        assert tuple(x for x in takes if x in (*"qva", "tau", "wrenches"))[: len(row.arguments)] == row.arguments, name
        dyn = closed if row.group == "row" else tree
        if not row.listed or not row.shape or name not in dyn.supports:
            continue
        n = dyn.model.nv
        given = {x: np.full(n, 0.5) for x in (*"qva", "tau")} | {"wrenches": {"rod2": np.ones(6)}}
        sizes = {"nv": n, "rows": 2, "columns": 20, "bodies": 2, "joints": 2, "frames": 3}
        frames = [["rod1", "rod2", "world"]] if row.shape[0] == "frames" else []
        value = getattr(dyn, name)(*(given[x] for x in row.arguments), *frames)
        assert value.shape == tuple(int(sizes.get(x, x)) for x in row.shape), name
