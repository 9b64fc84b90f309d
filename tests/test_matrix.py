"""Every kind of part on every path: right to rounding, or refused by the part's name.

Each kind alone goes through each gate and along each path; models of several kinds are those of `tests.test_pairs`.
A path that forgets a part gives another acceleration, motion or energy, and fails here; a refusal has to name a part.
A kind without an example and a path without a check fail the suite.
"""

# ruff: noqa: ARG001  # fixtures
from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from itertools import product
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

import mbkit as mb
from mbkit.errors import InputError, UnknownNameError, UnsupportedError
from mbkit.model.elements.kinds import PART_KINDS, Kind, kind, register_kind
from mbkit.model.elements.paths import PATHS as GATES
from mbkit.model.elements.paths import Path as Gate
from mbkit.model.joint_types import KINDS as JOINT_TYPES
from mbkit.studies.compare.beyond_terms import findings
from mbkit.studies.compare.terms import LIMITS
from tests import kind_examples, kind_mutations
from tests.kind_examples import EXAMPLES, TYPES, Example
from tests.kind_mutations import seen
from tests.kind_paths import NotAskedError
from tests.kind_studies import COLUMNS, ROWS, cell, registered, resting
from tests.test_engine_versions import present
from validation.matrix import takes

pytestmark = pytest.mark.usefixtures("own_environments")
#: Sums of a few hundred rounded terms, and second differences of the reference's rows.
CLOSE = 1e-9


def assert_close(got: np.ndarray, wanted: np.ndarray) -> None:
    assert np.shape(got) == np.shape(wanted)
    assert np.abs(got - wanted).max() < CLOSE * max(1.0, np.abs(wanted).max())


# Each kind alone


def example(name: str) -> mb.Model:
    """Return a new model, which has not yet said what acts in it."""
    return (EXAMPLES | TYPES)[name](name).model


class OwnEngine(mb.engines.Dynamics):
    """An engine of one's own, whose terms know no forces by functions and no friction."""

    engine = "own"

    def __init__(self, model: mb.Model) -> None:
        super().__init__(model)
        bare = replace(model.without("friction"), forces=())
        own = mb.dynamics(bare, "lagrangian", compile=False)
        for name in ("mass_matrix", "gravity", "nle", "passive", "inverse_dynamics", "forward_dynamics"):
            vars(self)[f"_{name}"] = getattr(own.at(t=0.3) if own.model.time_parameter else own, f"_{name}")


def on_ones_own(x: Example) -> None:
    dyn, a = OwnEngine(x.model), 0.3 * x.v + 0.1
    dyn = dyn.at(**{x.model.time_parameter: x.t}) if x.model.time_parameter else dyn
    assert_close(dyn.forward_dynamics(x.q, x.v, x.tau), x.accelerated())
    assert_close(dyn.inverse_dynamics(x.q, x.v, a), x.force(a))


def by_a_run_of_joints(x: Example) -> None:
    """Pinocchio's algorithms have springs of joints alone, as Newton's; it has no run that could be compared."""
    dyn = mb.dynamics(x.model, present("pinocchio", "4.1.0"))
    with pytest.raises(UnsupportedError) as told:
        dyn.rollout(x.model.neutral(), np.zeros(x.model.nv), 1e-3, 2)
    if "no rollout of its own" not in str(told.value):
        raise told.value


def by_phases_beside_soft_constraints(x: Example) -> None:
    dyn = mb.dynamics(x.model, "mujoco")
    GATES["friction beside soft constraints"].admit(x.model)
    if not x.model.needs.friction:
        raise NotAskedError("nothing jumps")
    for start in (x, resting(x)):
        q, v = start.state(start.flow([5e-3])[-1])
        run = mb.simulate(dyn, x.q, start.v, 5e-3, "rk4", 1e-3, torque=start.tau, t0=x.t)
        assert_close(run.q[-1], q)
        assert_close(run.v[-1], v)


#: Gates that no column goes through.
CHECKS: dict[str, Callable[[Example], None]] = {
    "own engine": on_ones_own,
    "remote runs of joints": by_a_run_of_joints,
    "friction beside soft constraints": by_phases_beside_soft_constraints,
}
#: Gates that a path goes through before its own.
BELOW = {"remote runs of joints": ("sent",), "friction beside soft constraints": ("mujoco",)}


def test_every_kind_has_an_example_and_every_path_a_check() -> None:
    assert set(EXAMPLES) == set(PART_KINDS)
    assert set(TYPES) == {f"joint_type.{x}" for x, type_ in JOINT_TYPES.items() if type_.built_in} | {"joint_type.beam"}


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_kind_acts_alone_and_is_taken_out(name: str) -> None:
    model = example(name)
    finer = name.rpartition(".")[0]
    also = {"force.of_time": "force.joint", "joint.limit.several": "joint.limit", "joint.stiction": "joint.friction"}
    also |= {"joint.stop": "joint.limit"}
    also |= dict.fromkeys(("written.row", "written.speed", "written.t", "written.stop"), "energies")
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
            # Limits stay where they stop nothing.
            gone = {name} if feature == "stops" else wanted - {"mimic"}
            assert model.without(feature).digest == model.without(*gone).digest
    else:
        assert name in ("mimic", "energies", "written.row", "written.speed", "written.t", "written.stop")


@pytest.mark.parametrize("gate", sorted(registered()))
def test_a_gate_names_each_part_that_it_refuses(gate: str) -> None:
    own = GATES[gate]
    # A beam is one part, and many joints.
    for model in (kind_examples.example(name).model for name in (*EXAMPLES, *TYPES) if "beam" not in name):
        if text := own.refuses(model):
            lost, numbers = [kind(k) for k in model.acts if not own.takes(kind(k))], list(own.also(model))
            # Of several kinds of one part the finest is told.
            for p in (p for k in lost for p in k.parts(model)):
                assert any(k.words.format(p=p) in text for k in lost if k.at(model, p))
            assert all(x in text for x in numbers)
            assert lost or numbers or own.asks[1] in text
            assert all(repr(k.features[-1]) in text for k in lost if k.features)


@pytest.mark.thorough(every=10)
@pytest.mark.parametrize(("name", "path"), [*product(EXAMPLES, CHECKS)])
def test_a_gate_without_a_column_refuses_a_kind_or_its_path_is_right(name: str, path: str) -> None:
    x = kind_examples.example(name)
    refused = any(GATES[g].refuses(x.model) for g in (path, *BELOW.get(path, ())))
    with pytest.raises(UnsupportedError) if refused else suppress(NotAskedError):
        CHECKS[path](x)


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
def test_a_new_kind_is_refused_by_name_without_a_column(path: str, hook: Kind) -> None:
    with pytest.raises(UnsupportedError, match="joint 'j0' has a hook"):
        CHECKS[path](EXAMPLES["gravity"]("gravity"))


def test_a_limit_of_a_new_kind_is_told_with_the_others(hook: Kind) -> None:
    """They are data: what says that no engine has them must not forget one."""
    bound = replace(hook, does=frozenset(["bound"]), features=("limits",))
    with patch.dict(PART_KINDS, {hook.name: bound}):
        model = example("joint.limit")
        (told,) = (x for x in findings(model, np.zeros((1, model.nv)), np.eye(model.nv)[None]) if x.kind == LIMITS)
    assert told.says.endswith("limits at 1 joint; a hook at 1 joint")
    assert told.joints == ("x", "j0")


#: Paths that ask for a loop.
ASKING = ("loads of loops", "reduced inertia", "rows of constraints", "mujoco: law of constraints")
ASKING += ("independent coordinates", "forces of actuators")


@pytest.mark.parametrize("path", [name for name, c in COLUMNS.items() if c.gates])
def test_a_new_kind_is_refused_by_name_in_a_column(path: str, hook: Kind, tmp_path: Path) -> None:
    name = "joint.damping" if "number" in path else "loop.point" if path in ASKING else "gravity"
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
