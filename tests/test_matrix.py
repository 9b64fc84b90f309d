"""Every kind of part on every path: right to rounding, or refused by the part's name.

Each kind alone goes through each gate and along each path; models of several kinds are those of `tests.test_pairs`.
A path that forgets a part gives another acceleration, motion or energy, and fails here; a refusal has to name a part.
A kind without an example and a path without a check fail the suite.
"""

# ruff: noqa: ARG001, ARG005  # all parts and all paths are called alike
from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg

import mbkit as mb
from mbkit.errors import InputError, UnknownNameError, UnsupportedError
from mbkit.model.elements.kinds import PART_KINDS, Kind, kind, register_kind
from mbkit.model.elements.paths import PATHS as GATES
from mbkit.model.elements.paths import Path as Gate
from mbkit.model.joint_types import KINDS as JOINT_TYPES
from tests import kind_examples, kind_mutations, path_checks
from tests.kind_examples import EXAMPLES, TYPES
from tests.kind_mutations import seen
from tests.kind_studies import COLUMNS, ROWS, cell, registered
from tests.test_engine_versions import present
from validation.matrix import takes

pytestmark = pytest.mark.usefixtures("own_environments")
#: Sums of a few hundred rounded terms, and second differences of the reference's rows.
CLOSE = 1e-9


def assert_close(got: np.ndarray, wanted: np.ndarray, close: float = CLOSE) -> None:
    assert np.shape(got) == np.shape(wanted)
    assert np.abs(got - wanted).max() < close * max(1.0, np.abs(wanted).max())


# Each kind alone

WITH_DRAKE = find_spec("pydrake") is not None
for file in sorted(Path(mb.__file__).parent.rglob("*.py")):
    text = file.read_text(encoding="utf-8")
    declares = "elements.paths import" in text or "elements import paths" in text
    if declares and (WITH_DRAKE or "drake" not in file.parts):
        import_module(".".join(file.relative_to(Path(mb.__file__).parent.parent).with_suffix("").parts))


def example(name: str) -> mb.Model:
    """Return a new model, which has not yet said what acts in it."""
    return (EXAMPLES | TYPES)[name](name).model


def accelerations(dyn: mb.Dynamics, names: tuple[str, ...], closed: bool) -> np.ndarray:
    """Return the acceleration at one state, or M and h where constraints leave a state no freedom, by joint."""
    dyn = dyn.at(t=0.3) if dyn.model.time_parameter else dyn
    order = [dyn.model.velocity_names.index(n) for n in names]
    x, v, tau = np.zeros((3, dyn.model.nv))
    x[order], v[order], tau[order] = 0.1 * np.arange(1, 1 + len(x)), 0.2 + 0.1 * np.arange(len(x)), 0.3
    q = dyn.model.integrate(dyn.model.neutral(), x)
    if closed:
        return np.vstack([dyn.mass_matrix(q)[np.ix_(order, order)], dyn.nle(q, v)[order], dyn.passive(q, v)[order]])
    return dyn.forward_dynamics(q, v, tau)[order]


TERMS = {
    "mass_matrix": "q",
    "gravity": "q",
    "nle": "qv",
    "passive": "qv",
    "inverse_dynamics": "qva",
    "forward_dynamics": "qva",
    "kinetic_energy": "qv",
    "potential_energy": "q",
    "pose": "q",
    "jacobian": "q",
}


def terms(dyn: mb.Dynamics, names: tuple[str, ...], closed: bool) -> dict[str, np.ndarray]:
    """Return the terms at one state, by joint; accelerations only where no constraint holds the motion."""
    model = dyn.model
    dyn = dyn.at(t=0.3) if model.time_parameter else dyn
    order = [model.velocity_names.index(n) for n in names]
    x, v, a = np.zeros((3, model.nv))
    x[order], v[order], a[order] = 0.1 * np.arange(1, 1 + len(x)), 0.2 + 0.1 * np.arange(len(x)), 0.3
    at = {"q": model.integrate(model.neutral(), x), "v": v, "a": a}
    out = {}
    for name, arguments in TERMS.items():
        frames = ["b0"] if name in ("pose", "jacobian") else []
        if (closed and name == "forward_dynamics") or (frames and not model.has_bodies):
            continue
        if name == "kinetic_energy" and "joint.armature" in model.acts and dyn.engine.startswith("pinocchio"):
            # Pinocchio leaves armature out, a known defect.
            continue
        value = np.asarray(getattr(dyn, name)(*(at[k] for k in arguments), *frames))
        if name == "potential_energy":
            value = value - dyn.potential_energy(model.neutral())
        by_joint = (slice(None), order) if frames else np.ix_(order, order) if name == "mass_matrix" else order
        out[name] = value[by_joint] if value.ndim and name != "pose" else value
    return out


def as_derived(model: mb.Model, *others: mb.Dynamics) -> None:
    own = mb.dynamics(model, "lagrangian", compile=False)
    wanted = terms(own, model.velocity_names, model.constrained)
    for other in others:
        for name, value in terms(other, model.velocity_names, model.constrained).items():
            assert_close(value, wanted[name])


def through_file(to: str) -> Callable[[mb.Model, Path], None]:
    def check(model: mb.Model, folder: Path) -> None:
        path = mb.convert(model, to).write(folder / f"x.{'xml' if to == 'mjcf' else 'urdf'}")
        back = mb.load(path, **({"gravity": model.gravity} if to == "urdf" else {}))
        if to == "mjcf" and model.layout.reduced:
            # MJCF keeps the joint, as one that a coupler holds.
            assert [x.joint for x in back.couplers] == ["x"]
            return
        as_derived(model, mb.dynamics(back, "lagrangian", compile=False))
        # An MJCF has a planar joint as three.
        if set(back.joint_names) == set(model.joint_names):
            assert mb.explain(model, back).agree
            # Limits are no dynamics.
            assert {k for k in model.acts if "limit" in k} <= {*back.acts, *GATES[to].notes}

    return check


def by_base_parameters(model: mb.Model, folder: Path) -> None:
    """Torques of the bodies alone are linear in them."""
    parts = ("damping", "friction", "springs", "armature", "forces")
    names = model.base_parameters().names
    bare = model.without(*(x for x in parts if getattr(model.needs, x)))
    dyn, (q, v) = mb.dynamics(bare, "lagrangian", compile=False), bare.random_state(3)
    Y = dyn.regressor(q, v, 0.3 * v, "base")
    assert_close(Y @ bare.base_parameters().values, dyn.inverse_dynamics(q, v, 0.3 * v))
    assert bare.base_parameters().names == names
    # And motions tell all of them apart, which those that rows leave do not, at the latest where little else moves.
    for m in (bare, *([bare.lock({"j0": 0.3})] if model.constrained else [])):
        assert np.linalg.matrix_rank(motions_tell(m)) == m.base_parameters().count


def motions_tell(model: mb.Model) -> np.ndarray:
    """Return what base parameters change of the torques that rows let act, at random states."""
    dyn, out = mb.dynamics(model, "lagrangian", compile=False), []
    for q, v in (model.random_state(k) for k in range(12)):
        N = scipy.linalg.null_space(dyn.constraint_jacobian(q)) if model.constrained else np.eye(model.nv)
        out.append(N.T @ dyn.regressor(q, v, np.cos(np.arange(model.nv) + q.sum()), "base"))
    return np.vstack(out)


class OwnEngine(mb.engines.Dynamics):
    """An engine of one's own, whose terms know no forces by functions and no friction."""

    engine = "own"

    def __init__(self, model: mb.Model) -> None:
        super().__init__(model)
        bare = replace(model.without("friction"), forces=())
        own = mb.dynamics(bare, "lagrangian", compile=False)
        for name in TERMS:
            vars(self)[f"_{name}"] = getattr(own.at(t=0.3) if own.model.time_parameter else own, f"_{name}")


#: The one is sent as data, the other as MJCF.
SENT_TO = (("pinocchio", "4.1.0"), ("mujoco", "4.0.0"))


def truth(model: mb.Model) -> kind_examples.Example:
    names = {name.replace(".", "_"): name for name in EXAMPLES | TYPES} | {"pendulum": "energies"}
    return kind_examples.example(names[model.name])


def as_in_numpy(model: mb.Model, *others: mb.Dynamics) -> None:
    """Compare all terms with the derivation's, and accelerations with the example's, but where they are soft."""
    as_derived(model, *others)
    x = truth(model)
    for dyn in others:
        dyn = dyn.at(**{model.time_parameter: x.t}) if model.time_parameter else dyn
        if not (model.constrained and dyn._soft_constraints):
            assert_close(dyn.forward_dynamics(x.q, x.v, x.tau), x.accelerated())
        elif hasattr(dyn, "constraint_law"):
            assert_close(dyn.constraint_law(x.q, x.v, x.tau).rigid, x.accelerated())


def on(engine: str) -> Callable[[mb.Model, Path], None]:
    return lambda model, folder: as_in_numpy(model, mb.dynamics(model, engine))


def runs(
    model: mb.Model, own_run: Callable[..., Sequence[np.ndarray]], end: float, close: float, tau: Any = None
) -> None:
    """Compare steps by an engine's own integrator with the example's motion, or mbkit's where MuJoCo is soft."""
    x = truth(model)
    got = own_run(x.q, x.v)
    if model.constrained and close < 1e-9:
        run = mb.simulate(mb.dynamics(model, "mujoco"), x.q, x.v, end, "rk4", dt=end / 5)
        wanted = run.q[-1], run.v[-1]
    else:
        wanted = [
            y[-1] for y in x.motion(np.array([0.0, end]), lambda t, q, v: np.zeros(model.nv) if tau is None else tau)
        ]
    for y, z in zip(got, wanted, strict=True):
        assert_close(y, z, close)


def by_mujoco(model: mb.Model, folder: Path) -> None:
    dyn = mb.dynamics(model, "mujoco")
    runs(model, lambda q, v: [x[-1] for x in dyn.rollout("rk4", q, v, 1e-3, None, 5)], 5e-3, 1e-11)


def by_another_mujoco(model: mb.Model, folder: Path) -> None:
    dyn = mb.dynamics(model, present("mujoco", "4.0.0"))
    runs(model, lambda q, v: [x[-1] for x in dyn.rollout(q, v, 1e-3, 5)], 5e-3, 1e-11)


def by_drake(model: mb.Model, folder: Path) -> None:
    from mbkit.engines.drake.rollout import DrakeRun

    dyn, tau = mb.dynamics(model, "drake"), truth(model).tau

    def own(q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        run = DrakeRun(dyn, "runge_kutta5", 1e-10, 0.0, q, v, lambda _: None)
        run.push(tau)
        return run.over(5e-3)

    runs(model, own, 5e-3, 1e-9, tau)


def by_drake_sap(model: mb.Model, folder: Path) -> None:
    """Its error is of first order in the step."""
    from mbkit.engines.drake.rollout import DiscreteRun

    run = DiscreteRun(mb.dynamics(model, "drake"), 1e-5)

    def own(q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        for _ in range(50):
            q, v = run.step(q, v, np.zeros(model.nv))
        return q, v

    # Rows are met to its regularization.
    runs(model, own, 5e-4, 1e-4 if model.constrained else 1e-7)


def on_newton(model: mb.Model, folder: Path) -> None:
    """It is judged where its environment is, in `tests.test_trained_engines`."""
    version = mb.engine("newton")
    assert version.package.path is GATES["newton"]
    if GATES["newton"].refuses(model):
        mb.dynamics(model, version)


def by_a_run_of_joints(model: mb.Model, folder: Path) -> None:
    """Pinocchio's algorithms have springs of joints alone, as Newton's; it has no run that could be compared."""
    dyn = mb.dynamics(model, present("pinocchio", "4.1.0"))
    with pytest.raises(UnsupportedError) as told:
        dyn.rollout(model.neutral(), np.zeros(model.nv), 1e-3, 2)
    if "no rollout of its own" not in str(told.value):
        raise told.value


def with_friction_loss(model: mb.Model, folder: Path) -> None:
    """Its terms are those of the derivation; its friction is that of sliding where it is rigid."""
    soft, x = mb.dynamics(model, "mujoco", soft_friction=True), truth(model)
    own = mb.dynamics(model, "lagrangian", compile=False)
    soft = soft.at(**{model.time_parameter: x.t}) if model.time_parameter else soft
    held = model.constrained or model.needs.friction
    a = soft.constraint_law(x.q, x.v, x.tau).rigid if held else soft.forward_dynamics(x.q, x.v, x.tau)
    assert_close(a, x.accelerated())
    if model.needs.friction:
        x = path_checks.resting(x)
        assert_close(soft.constraint_law(x.q, x.v, x.tau).rigid, x.accelerated())
        # It creeps where it holds.
        free = replace(x, plain=replace(x.plain, parts=[])).accelerated()
        assert abs(soft.forward_dynamics(x.q, x.v, x.tau)[-1]) < 0.2 * abs(free[-1])
    assert_close(*(accelerations(x, model.velocity_names, closed=True)[:-1] for x in (soft, own)))


def by_explaining(model: mb.Model, folder: Path) -> None:
    """A model is itself; `tests.test_causes` takes out each kind, and changes each field."""
    assert mb.explain(model, model).agree


def by_pinocchio_derivatives(model: mb.Model, folder: Path) -> None:
    x, dyn = truth(model), mb.dynamics(model, "pinocchio")
    wanted, dyn = (
        d.at(**{model.time_parameter: x.t}) if model.time_parameter else d for d in (mb.dynamics(model, "oracle"), dyn)
    )
    for got, exact in zip(*(d.inverse_dynamics_derivatives(x.q, x.v, x.tau) for d in (dyn, wanted)), strict=True):
        assert_close(got, exact)


CHECKS: dict[str, Callable[[mb.Model, Path], None]] = {
    "urdf": through_file("urdf"),
    "mjcf": through_file("mjcf"),
    "derivation": on("oracle"),
    "own engine": lambda model, folder: as_in_numpy(model, OwnEngine(model)),
    "pinocchio": on("pinocchio"),
    "pinocchio derivatives": by_pinocchio_derivatives,
    "drake": on("drake"),
    "drake runs": by_drake,
    "drake sap": by_drake_sap,
    "mujoco": on("mujoco"),
    "mujoco friction loss": with_friction_loss,
    "mujoco runs": by_mujoco,
    "sent": lambda model, folder: as_in_numpy(model, *(mb.dynamics(model, present(*x)) for x in SENT_TO)),
    "newton": on_newton,
    "remote runs": by_another_mujoco,
    "remote runs of joints": by_a_run_of_joints,
    "base parameters": by_base_parameters,
    "explain": by_explaining,
    **path_checks.CHECKS,
}


if not WITH_DRAKE:
    CHECKS = {name: check for name, check in CHECKS.items() if "drake" not in name}


ON_ENGINES = ("derivation", "own engine", "pinocchio", "pinocchio derivatives")
ON_ENGINES += ("drake", "drake runs", "drake sap", "mujoco", "mujoco runs")
#: A run begins with its engine, whose gate is the first.
BELOW = {"pinocchio derivatives": "pinocchio", "drake runs": "drake", "drake sap": "drake", "mujoco runs": "mujoco"}
BELOW |= {
    "constraint law": "mujoco",
    "python module": "paper",
    "embedded": "paper",
    "remote runs": "sent",
    "remote runs of joints": "sent",
    "runs without phases": "mujoco runs",
}


def test_every_kind_has_an_example_and_every_path_a_check() -> None:
    assert set(EXAMPLES) == set(PART_KINDS)
    assert set(TYPES) == {f"joint_type.{x}" for x, type_ in JOINT_TYPES.items() if type_.built_in} | {"joint_type.beam"}


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_kind_acts_alone_and_is_taken_out(name: str) -> None:
    model = example(name)
    finer = name.rpartition(".")[0]
    also = {"force.of_time": "force.joint", "joint.limit.several": "joint.limit", "joint.stiction": "joint.friction"}
    also |= dict.fromkeys(("written.row", "written.speed", "written.t"), "energies")
    wanted = {name, also.get(name, ""), finer} & {*PART_KINDS}
    # What holds a weight has one.
    weighs = {"gravity"} & {*model.acts}
    assert not weighs or name == "gravity" or name.startswith(("body.rotor", "force.compensation"))
    assert {k for k in model.acts if k in PART_KINDS} == wanted | weighs
    types = {k.removeprefix("joint_type."): x for k, x in model.acts.items() if k.startswith("joint_type.")}
    assert types == {t: tuple(j.name for j in model.joints if j.kind == t) for t in {j.kind for j in model.joints}}
    if PART_KINDS[name].features:
        assert name not in model.without(name).acts
        for feature in PART_KINDS[name].features:
            assert model.without(feature).digest == model.without(*wanted - {"mimic"}).digest
    else:
        assert name in ("mimic", "energies", "written.row", "written.speed", "written.t")


#: Beams have tests of their own.
OF_TYPES = [(name, path) for name in TYPES if name != "joint_type.beam" for path in CHECKS if path in ON_ENGINES]


@pytest.mark.thorough(every=60)
@pytest.mark.parametrize(("name", "path"), [*product(EXAMPLES, CHECKS), *OF_TYPES])
def test_a_gate_refuses_a_kind_by_name_or_the_path_is_right(name: str, path: str, tmp_path: Path) -> None:
    gate, model = GATES[BELOW.get(path, path)], example(name)
    gate = gate if gate.refuses(model) else GATES[path]
    refused = [kind(k) for k in model.acts if not gate.takes(kind(k))]
    numbers, refusal = list(gate.also(model)), gate.refuses(model)
    if not refusal:
        with suppress(path_checks.NotAskedError):
            CHECKS[path](model, tmp_path)
        return
    with pytest.raises(UnsupportedError) as told:
        CHECKS[path](model, tmp_path)
    text = str(told.value)
    # Of several kinds of one part the finest is told.
    assert all(
        any(k.words.format(p=p) in text for k in refused if k.at(model, p)) for k in refused for p in k.parts(model)
    )
    assert all(x in text for x in numbers)
    assert refused or numbers or gate.asks[1] in text
    assert all(repr(k.features[-1]) in text for k in refused if k.features)


# Each kind on each path: `tests.kind_paths`

SOUND = ("right", "refused", "left out", "not asked")


def test_every_gate_has_a_check_or_a_column() -> None:
    assert set(registered()) == {gate for c in COLUMNS.values() for gate in c.gates} | set(CHECKS)


def test_what_each_path_takes_is_as_recorded() -> None:
    """A kind that a path carries no more is told: ``python -m validation.matrix takes`` records anew."""
    recorded = json.loads((Path(__file__).parent.parent / "validation" / "matrix.json").read_text(encoding="utf-8"))
    now = takes()
    lost = {name: sorted({*kinds} - {*now.get(name, ())}) for name, kinds in recorded["takes"].items()}
    assert {name: kinds for name, kinds in lost.items() if kinds} == {}


@pytest.mark.parametrize("path", COLUMNS)
def test_a_cell_of_the_matrix_is_right_or_refused_by_name(path: str, tmp_path: Path) -> None:
    if path in ("C", "program text in C") and shutil.which("cc") is None:
        pytest.skip("no C compiler on PATH")
    name = ROWS[7 * list(COLUMNS).index(path) % len(ROWS)]
    got = cell(name, path, tmp_path)
    assert got.outcome in SOUND, (name, got)


@pytest.mark.thorough
@pytest.mark.parametrize("path", COLUMNS)
def test_no_cell_of_the_matrix_is_silent(path: str, tmp_path: Path) -> None:
    cells = {name: cell(name, path, tmp_path) for name in ROWS}
    assert {name: got for name, got in cells.items() if got.outcome not in SOUND} == {}


# The registry and its readers


def test_without_springs_of_joints_a_bushing_keeps_its_parameter() -> None:
    b = mb.ModelBuilder.of(example("joint.spring"))
    b.add_bushing("rubber", body_a="world", body_b="b2", stiffness=[mb.Parameter("k", 3.0)] * 6)
    model = b.build()
    less = model.without("springs")
    assert dict(less.parameters) == {"k": 3.0}
    assert less.forces == model.forces
    assert not less.needs.springs
    assert less.with_parameters(k=5.0).forces[0].stiffness[0, 0] == 5.0


def test_of_friction_and_loops_one_kind_is_taken_out() -> None:
    b = mb.ModelBuilder.of(example("joint.friction"))
    b.add_loop("ring", "point", body_a="world", body_b="b2")
    b.add_loop("rod", "distance", body_a="world", body_b="b1", length=0.4)
    model = b.build()
    assert [x.name for x in model.without("loop.distance").loops] == ["ring"]
    assert model.without("joint.stiction") == model
    assert model.acts["joint.friction"] == ("x",)
    with pytest.raises(UnknownNameError, match=r"did you mean 'joint\.friction'"):
        model.without("joint.frictoin")


def test_base_parameters_refuse_a_coupler_by_name() -> None:
    """It binds two joints, whose torques are those of the tree only with its multiplier."""
    model = example("coupler")
    q = np.zeros((20, 3))
    for call in (
        model.base_parameters,
        lambda: model.regressor_columns("base"),
        lambda: mb.identify(model, q, q, q, q),
    ):
        with pytest.raises(UnsupportedError, match=r"coupler 'x'.*without\('couplers'\)"):
            call()


def test_derivatives_are_refused_with_every_part_at_once() -> None:
    """Of forward dynamics also with what those of inverse dynamics carry."""
    b = mb.ModelBuilder.of(example("point.spring"))
    b.add_coupler("gear", "j0", "j1", ratio=0.5)
    dyn = mb.dynamics(b.build(), "pinocchio")
    zero = np.zeros(3)
    with pytest.raises(UnsupportedError, match=r"spring 'x'.*coupler 'gear'"):
        dyn.forward_dynamics_derivatives(zero, zero, zero)
    with pytest.raises(UnsupportedError, match="spring 'x'"):
        dyn.inverse_dynamics_derivatives(zero, zero, zero)


@pytest.fixture
def hook():
    yield register_kind("joints", "joint.hook", "joint {p.name!r} has a hook", at=lambda _, j: j.name == "j0")
    del PART_KINDS["joint.hook"]


@pytest.mark.parametrize("path", CHECKS)
def test_a_new_kind_is_refused_by_name_on_every_path(path: str, hook: Kind, tmp_path: Path) -> None:
    with pytest.raises(UnsupportedError, match="joint 'j0' has a hook"):
        CHECKS[path](example("gravity"), tmp_path)


@pytest.mark.parametrize("path", [name for name, c in COLUMNS.items() if not {*c.gates} <= {*CHECKS}])
def test_a_new_kind_is_refused_by_name_in_a_column(path: str, hook: Kind, tmp_path: Path) -> None:
    name = "joint.damping" if "number" in path else "gravity"
    with seen(kind_mutations.new(name)):
        got = cell(name, path, tmp_path)
    assert (got.outcome, "joint 'j0' has a hook" in got.text) == ("refused", True), got


def test_kinds_and_paths_are_checked_where_they_are_made() -> None:
    for section, name, does in (("joints", "mimic", "q"), ("wings", "wing", "V"), ("joints", "joint.x", "lift")):
        with pytest.raises(InputError, match=f"kind '{name}'"):
            register_kind(section, name, "", does)
    with pytest.raises(InputError, match="path 'urdf'"):
        Gate("urdf", "", frozenset())
    with pytest.raises(UnknownNameError, match="did you mean 'gravity'"):
        Gate("x", "", frozenset(["grvity"]))
    assert "x" not in GATES
