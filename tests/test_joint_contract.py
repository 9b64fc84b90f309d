"""Every joint type on every engine: each quantity is right against the oracle, or refused by name."""

from __future__ import annotations

import inspect
import warnings

import numpy as np
import pytest

import mbkit as mb
from mbkit.engines import ENGINES, QUANTITIES, closed_loops, constrained
from mbkit.engines.frames_and_momenta import AXES, CLASSICAL, SPATIAL
from mbkit.errors import KnownDefectWarning, UnsupportedError
from mbkit.model import KINDS, Model, kind_of
from tests.joint_of_ones_own import OWN
from tests.random_trees import off, random_tree, states

BUILT_IN = tuple(name for name, joint_type in KINDS.items() if joint_type.built_in and joint_type.nv)
DERIVATIVES = ("inverse_dynamics_derivatives", "forward_dynamics_derivatives")
EPS = np.finfo(float).eps


def model_of(kind: str) -> Model:
    """Return two bodies with a joint of this type each, all features that it can have, and a hinge between."""
    joint_type, rng = kind_of(kind), np.random.default_rng(5)
    b = mb.ModelBuilder(kind, gravity=(1.0, -2.0, -9.0))
    options: dict = {f"axis{k or ''}": x for k, x in ((0, (0.6, 0.0, 0.8)), (2, (0.0, 1.0, 0.0)))[: joint_type.n_axes]}
    options["damping"] = 0.4
    if joint_type.pitched:
        options["pitch"] = 0.3
    if joint_type.coordinate_velocities and not joint_type.pitched:
        options |= {"stiffness": 2.0, "rest": 0.1}
    if joint_type.nv == 1:
        options["armature"] = 0.2
    parent = "world"
    for k, (name, more) in enumerate(((kind, options), ("revolute", {"axis": (0, 0, 1)}), (kind, options))):
        inertia = np.diag(rng.uniform(0.4, 0.6, 3))
        b.add_body(f"b{k}", mass=1.0 + k, com=rng.uniform(-0.2, 0.2, 3), inertia=inertia)
        place = {"translation": rng.uniform(-0.3, 0.3, 3), "rpy": rng.uniform(-1, 1, 3)}
        b.add_joint(f"j{k}", name, parent=parent, child=f"b{k}", **place, **more)
        parent = f"b{k}"
    return b.build()


def state(model: Model) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(8)
    q, v = model.random_state(rng)
    a, tau = rng.standard_normal((2, model.nv))
    return {"q": q, "v": v, "a": a, "t": tau}


WRENCH = (1.0, -2.0, 3.0, 0.5, 0.1, -0.4)


def value(dyn, quantity: str, at: dict[str, np.ndarray], axes: tuple[str, ...] = AXES) -> np.ndarray:
    """Return a quantity of the last body in these axes and of all kinds, on a last axis."""
    method, frame = getattr(dyn, quantity), dyn.model.bodies[-1].name
    takes = inspect.signature(method).parameters
    more = {"frame": frame} if "frame" in takes else {}
    more |= {"wrenches": {frame: WRENCH}} if "wrenches" in takes else {}
    options = [{"axes": x} for x in axes] if "axes" in takes else [{}]
    options = [x | {"kind": kind} for x in options for kind in (SPATIAL, CLASSICAL)] if "kind" in takes else options
    # Loads take a or τ; here they take a.
    needed = (name for name, x in takes.items() if x.default is x.empty or name == "a")
    given = [at[name[0]] for name in needed if name in ("q", "v", "a", "tau")]
    return np.stack([np.asarray(method(*given, **more, **x)) for x in options], axis=-1)


@pytest.mark.thorough("revolute", "continuous", "prismatic", "spherical_zyx", "ball", "planar", "cylindrical")
@pytest.mark.parametrize("kind", [*BUILT_IN, *OWN])
def test_each_quantity_is_right_or_refused(kind):
    model = model_of(kind)
    at, oracle = state(model), mb.dynamics(model, "oracle")
    M = oracle.mass_matrix(at["q"])
    condition = np.linalg.cond(M)
    # Forces at play: what is left of large terms has their rounding.
    size = 1.0 + np.abs(M).max() * max(1.0, float(at["v"] @ at["v"])) + np.abs(oracle.nle(at["q"], at["v"])).max()
    tolerance = 2000 * EPS * size
    refused: dict = {}
    others = {"function", "coriolis_matrix", *constrained.QUANTITIES, *closed_loops.QUANTITIES}
    quantities = [x for x in (*QUANTITIES, *DERIVATIVES) if x not in others]
    right = {quantity: value(oracle, quantity, at) for quantity in quantities}
    for engine in ENGINES:
        try:
            dyn = mb.dynamics(model, engine)
        except UnsupportedError as error:
            refused[engine] = str(error)
            continue
        for quantity in quantities:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", KnownDefectWarning)
                try:
                    found = value(dyn, quantity, at)
                except UnsupportedError as error:
                    refused[engine, quantity] = str(error)
                    continue
            if any(issubclass(w.category, KnownDefectWarning) for w in caught):
                continue
            factor = condition if quantity.startswith("forward") else 1.0
            off = np.abs(found - right[quantity]).max()
            assert off < tolerance * factor, (engine, quantity, off)
    assert not {"lagrangian", "oracle"} & {*refused}
    assert all(kind in text for key, text in refused.items() if isinstance(key, str)), refused
    assert all(key[0] in text for key, text in refused.items() if not isinstance(key, str)), refused


FLOATING = ("free", "ball", "revolute", "prismatic")
NOTHING = {"springs": False, "damping": False, "armature": False}
#: Two bodies have no point spring; with more of them, random trees have two.
FEATURES = {
    "nothing": random_tree(3, 4, FLOATING, **NOTHING),
    "dampers": random_tree(4, 2, ("free", "revolute"), **NOTHING | {"damping": True}),
    "dampers of hinges": random_tree(4, 2, ("revolute", "universal"), **NOTHING | {"damping": True}),
    "joint springs": random_tree(5, 2, ("free", "prismatic"), **NOTHING | {"springs": True}),
    "point springs": random_tree(6, 4, FLOATING, **NOTHING | {"springs": True, "damping": True}),
    "armature": random_tree(7, 4, ("revolute", "prismatic", "ball"), **NOTHING | {"armature": True}),
    "mimic": random_tree(8, 5, ("free", "revolute", "prismatic"), **NOTHING, mimic=True),
    "all": random_tree(9, 6, FLOATING, mimic=True),
}


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize(
    ("engine", "feature"),
    [
        *((engine, feature) for engine in ENGINES for feature in FEATURES if engine != "oracle"),
        # To the oracle one state is a batch of one.
        ("oracle", "all"),
        # What a feature adds is derived as for interpreting; code differs where a quantity is constant, or lacks v.
        *(("compiled", feature) for feature in ("nothing", "dampers", "joint springs", "all")),
    ],
)
@pytest.mark.filterwarnings("ignore::mbkit.errors.KnownDefectWarning")
def test_one_state_has_the_values_of_its_row_in_a_batch(engine, feature):
    """Single states have calls of their own, with other code than batches."""
    model = FEATURES[feature]
    compiled = engine == "compiled"
    dyn = mb.dynamics(model, "lagrangian", compile=True) if compiled else mb.dynamics(model, engine)
    batch = dict(zip("qvat", states(model, 3), strict=True))
    M = dyn.mass_matrix(batch["q"])
    # Derivatives as machine code are compiled for seconds, and tests/test_derivatives.py has their batches.
    for quantity in (*QUANTITIES, *DERIVATIVES[: 0 if compiled else 2]):
        if quantity in ("function", *closed_loops.QUANTITIES):
            continue
        try:
            whole = value(dyn, quantity, batch, AXES[:1])
        except UnsupportedError:
            continue
        rows = [value(dyn, quantity, {name: x[i] for name, x in batch.items()}, AXES[:1]) for i in range(3)]
        if quantity in DERIVATIVES:
            whole = np.moveaxis(whole, 1, 0)
        tolerance = 1e-13 * (np.linalg.cond(M).max() if quantity.startswith("forward") else 1.0)
        assert off(rows, whole) < tolerance, quantity


@pytest.mark.thorough("spherical_zyx", "ball", "planar", "free", "sliding_ball")
@pytest.mark.parametrize("kind", [*BUILT_IN, *OWN])
def test_coriolis_matrices_give_the_force_and_a_skew_difference(kind):
    model = model_of(kind)
    at = state(model)
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
    model = model_of(kind).without("damping")
    q, v = model.random_state(np.random.default_rng(3))
    dyn = mb.dynamics(model, "lagrangian", compile=False)
    run = mb.simulate(dyn, q, 0.5 * v, 0.2, method="rk853", rtol=1e-10)
    assert np.abs(run.energy() - run.energy()[0]).max() < 1e-8 * (1 + np.abs(run.energy()[0]))
    step = model.difference(run.q[0], run.q[-1])
    assert np.abs(model.integrate(run.q[0], step) - run.q[-1]).max() < 1e-13
