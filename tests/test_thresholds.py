"""Each threshold tells two numbers apart, one on either side; a tenth and ten times of it tell them apart no more.

`python -m validation.thresholds` lists all thresholds; those that need a longer scene have tests of their own.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace as Stub
from typing import Any

import mpmath
import numpy as np
import pytest
import sympy as sp
from numpy.polynomial import Polynomial

import mbkit as mb
from mbkit import _check
from mbkit._check import EPS
from mbkit.catalog import _system
from mbkit.derivation import constraints
from mbkit.derivation.steps import onto_constraints
from mbkit.engines.applications import random_states
from mbkit.engines.constrained import singular_pose
from mbkit.engines.constraint_manifold import Manifold
from mbkit.engines.elements import jumps
from mbkit.engines.elements.stop_impacts import after_impacts
from mbkit.errors import InputError, MbkitError, ModelError, NumericalError, nearest
from mbkit.lagrangian import printer
from mbkit.lagrangian.continua import integrals, ritz
from mbkit.lagrangian.continua.beam import clamped_free
from mbkit.lagrangian.energies import sympy_to_casadi
from mbkit.lagrangian.statics import steady_motion
from mbkit.lagrangian.trig import shortest_form, simplify
from mbkit.load import loader, urdf_reader, xml_reader
from mbkit.methods import METHODS, one_step
from mbkit.model import base_parameters, manifold, validation
from mbkit.model.builder import ArgumentReader
from mbkit.model.elements import beams, editing, motion_laws
from mbkit.model.quaternions import FLOATS
from mbkit.model.stops import StopLaw
from mbkit.show import meshes
from mbkit.simulate import checks, stiffness_measure, time_grid
from mbkit.simulate.solvers import auto, step_attempts, trajectory_record, vector_field
from mbkit.simulate.solvers.in_phases import moreau, phases
from mbkit.studies import formatting, lint
from mbkit.studies.baseline import description, file
from mbkit.studies.baseline import study as baseline
from mbkit.studies.baseline.result import BaselineResult
from mbkit.studies.compare.result import omission_state
from mbkit.studies.explain import hypotheses
from mbkit.studies.measurement import Measurement
from mbkit.studies.stress import measurements
from mbkit.studies.stress.study import _Row
from mbkit.studies.work_precision import result, sweep
from tests.scenes import chain, hinge, slider


def accepts(call: Callable[..., Any], *arguments: Any, **named: Any) -> bool:
    try:
        call(*arguments, **named)
    except MbkitError:
        return False
    return True


# Descriptions


def two_sliders(light: float) -> mb.Model:
    links = ({"mass": m, "kind": "prismatic", "axis": (1, 0, 0)} for m in (light, 1.0))
    return chain(*links, gravity=(0, 0, 0)).build()


def two_carts() -> mb.Model:
    """Return two sliders that a loop keeps together: f = q₀ - q₁."""
    cart = {"mass": 1.0, "kind": "prismatic", "axis": (1, 0, 0), "parent": "world"}
    b = chain(cart, cart, gravity=(0, 0, 0))
    b.add_loop("pin", kind="point", body_a="b0", body_b="b1")
    return b.build()


def turned_frames(count: int, angle: float) -> mb.Model:
    """Return hinges whose bodies are welded to the ground at an angle: half of all starts end half a turn away."""
    hinges = [{"mass": 1.0, "inertia": (0.1,) * 3, "axis": (0, 0, 1), "parent": "world"}] * count
    b = chain(*hinges, {"mass": 1.0, "kind": "prismatic", "axis": (1, 0, 0), "parent": "world"})
    turned = mb.spatial.matrix_from_rpy(0, 0, angle)
    for k in range(count):
        b.add_loop(f"weld {k}", kind="frame", body_a=f"b{k}", body_b="world", rotation_b=turned)
    return b.build()


def small_wheel(inertia: float) -> mb.Model:
    wheel = {"mass": 1.0, "inertia": (inertia,) * 3, "axis": (0, 1, 0), "translation": (1, 0, 0)}
    return chain({"kind": "prismatic", "mass": 1.0, "axis": (1, 0, 0)}, wheel).build()


def place(length: float) -> bool:
    reader = ArgumentReader()
    reader.place("translation", (length, 0, 0))
    return not reader.faults


def quaternion(off: float) -> bool:
    model = mb.catalog.free_body()
    return accepts(model.check_q, model.neutral() + np.eye(7)[6] * off)


def warns(call: Callable[..., Any], *arguments: Any) -> bool:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        call(*arguments)
    return bool(caught)


def names_bodies(count: int) -> bool:
    b = hinge()
    for k in range(count):
        b.add_body(f"b{k}", mass=1.0)
    b.add_joint("k", "revolute", parent="a", child="zzz")
    try:
        b.build()
    except ModelError as error:
        return "there are:" in str(error)
    raise AssertionError


def too_many(velocities: int) -> bool:
    class Rest(Stub):
        def __getattr__(self, name: str) -> Any:
            raise InputError(name)

    joints = (Stub(type=Stub(nv=velocities)),)
    return accepts(lambda: next(validation.structure_faults(Rest(bodies=(Rest(),), joints=joints))))


def few_knots(count: int) -> bool:
    part = Stub(knots=np.arange(float(count)), coefficients=np.zeros((4, count - 1)))
    return "up to" not in next(motion_laws._spline_faults("t", part), "")


# Files


def toml(size: int) -> bool:
    Path("loops.toml").write_text("#" * (size - 1) + "\n")
    try:
        loader.read_loops("loops.toml")
    except MbkitError as error:
        return "no table" in str(error)
    raise AssertionError


def listed(count: int) -> bool:
    folder = Path(f"of{count}")
    folder.mkdir(exist_ok=True)
    for k in range(count):
        (folder / f"{k}.urdf").touch()
    return "and more" in xml_reader._descriptions(folder)


def long_name(size: int) -> bool:
    reader = xml_reader.Reader.__new__(xml_reader.Reader)
    reader.faults = []
    reader.name(xml_reader.Element("link", {"name": "n" * size}, 1), "name", "link")
    return not reader.faults


def few_joints(count: int) -> bool:
    reader = xml_reader.Reader.__new__(xml_reader.Reader)
    reader.faults = []
    names = [f"l{k}" for k in range(count + 1)]
    joints: Any = [Stub(name=f"j{k}", parent=a, child=b, kind="free") for k, (a, b) in enumerate(pairwise(names))]
    urdf_reader._check_tree(names, joints, False, reader)
    return not reader.faults


def materials(count: int) -> bool:
    text = "".join(f"usemtl m{k}\n" for k in range(count))
    try:
        meshes._wavefront(text, Path(), lambda _: None)
    except ValueError as error:
        return "materials" not in str(error)
    return True


# Expressions


def readable(terms: int) -> bool:
    with pytest.MonkeyPatch.context() as there:
        there.setattr(simplify, "shortest_form", lambda *_, **__: sp.Integer(1))
        writer = Stub(_back=lambda x: x, _decimals=None)
        return accepts(simplify._Reading._written, writer, Stub(terms=range(terms)))


def combined(terms: int) -> bool:
    writer = Stub(_known={1: 1}, sum=Stub(terms=range(terms)), _over_one=lambda *_: sp.Integer(1))
    return bool(simplify._Reading.over_one_denominator(writer))


def split_off(angles: int) -> bool:
    key = (None, (1,) * angles)
    return bool(shortest_form._split_off(Stub(space=Stub(angles=range(angles)), terms={key: 1})))


def is_definite(part: float) -> bool:
    with mpmath.workdps(200):
        return ritz._cholesky(mpmath.matrix([[1, 1], [1, 1 + mpmath.mpf(10) ** part]])) is not None


def turns_about_two_axes(apart: float) -> bool:
    M = np.array([[1.0, 1 - 2 * apart], [1 - 2 * apart, 1.0]])
    reduced: Any = Stub(cyclic=[Stub(name="a"), Stub(name="b")], system=Stub(name="s"))
    return accepts(steady_motion._refuse_pole, M[None], reduced, np.zeros(1))


def condition_of_rates(condition: float) -> bool:
    equations: Any = Stub(linear=lambda *_: (None, np.ones((1, 1, 1)), np.full((1, 1, 1), condition)))
    return accepts(sympy_to_casadi.VelocityMap.check_start, equations, np.zeros(1), np.zeros(1))


def sum_of(count: int) -> sp.Expr:
    return sp.Add(*sp.symbols(f"a:{count}"))


def abbreviated(operations: int, occurrences: int) -> bool:
    base = sum_of(operations + 1)
    return bool(printer.Abbreviations([sp.sqrt(base)] * occurrences, []).roots)


def power_is_one(exponent: int) -> bool:
    simplify.tidy.cache_clear()
    x = sp.Symbol("x")
    return bool(simplify.tidy(sp.Pow(sp.sin(x) ** 2 + sp.cos(x) ** 2, exponent)) == 1)


def tidied(operations: int) -> bool:
    simplify.tidy.cache_clear()
    x = sp.Symbol("x")
    return not simplify.tidy_short(sp.sin(x) ** 2 + sp.cos(x) ** 2 + sum_of(operations - 4)).has(sp.sin)


# Runs

ROWS = ["row a", "row b", "row c"]
SPRING = slider(stiffness=1.0).build()


def still_and_moved(speed: float, way: float) -> bool:
    q, v = np.array([[[0.0], [way]]]), np.array([[[speed], [speed]]])
    return not any(checks.travel(q, v, checks.Tolerances(1e-9, 1e-9)))


def decaying(time: float) -> bool:
    return checks.lost([np.exp(-1e-3 / time) * 1.01], 1e-3, np.array([-1 / time]), 1.0)[0] > 0


def follows(method: str, h: float, duration: float) -> bool:
    dyn, q = mb.dynamics(SPRING, "lagrangian", compile=False), np.ones((1, 1))
    return not any(checks.step_size(dyn, METHODS[method], h, duration, q, np.zeros((1, 1))))


def rushes(h: float) -> bool:
    dyn, q = mb.dynamics(SPRING, "lagrangian", compile=False), np.ones((1, 1, 1))
    return checks._rushes(dyn, METHODS["semi_implicit_euler"], h, q, q)


def moves_mass(least: float) -> bool:
    model = two_sliders(1.0)
    dyn: Any = Stub(model=model, _samples=None, mass_matrix=lambda q: np.diag([1.0, 1.0 if q.any() else least]))
    return not checks.massless_joints(dyn, np.zeros(2))


def twice_the_step_differs(h: float, duration: float = 2.0) -> bool:
    dyn = mb.dynamics(SPRING, "lagrangian", compile=False)
    run = mb.simulate(dyn, [1.0], [0.0], duration, "semi_implicit_euler", h)
    return "first order" in str(run.check())


# Constraints


class OpenRows(constraints._Numbers):
    """Rows q and a gap that nothing closes."""

    def __init__(self, gap: float) -> None:
        self.gap, self.model, self._parameters = gap, SPRING, []

    def __call__(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.array([q[0], self.gap]), np.array([[1.0], [0.0]])

    def _call(self, *_: Any) -> list[Any]:
        return [None] * 3 + [1.0]


def equations(model: mb.Model) -> Any:
    return mb.dynamics(model, "lagrangian", compile=False).equations


def has_closed(of: tuple[int, float]) -> bool:
    return constraints._chosen_rows(turned_frames(*of)).closed is not None


def projected(residual: float) -> bool:
    _, _, moved, _ = onto_constraints.projection(equations(two_carts()))([0, residual], [0, 0], [0, 0])
    return bool(np.array(moved).any())


def far_in_one(aside: float) -> bool:
    return bool(onto_constraints.quick_projection(equations(two_carts()))([0, 1e-8], [0, 0], [aside, aside])[2])


def far_in_some(aside: float) -> bool:
    model = mb.catalog.four_bar()
    q, v = model.random_state(0)
    return bool(onto_constraints.thorough_projection(equations(model))(q + aside * np.eye(3)[1], v)[2])


def draws(refused: int) -> list[np.ndarray] | None:
    """Return the configurations that were tried, None where the search gave up before the last one."""
    tried: list[np.ndarray] = []

    def flowed(_: Any, q: np.ndarray, v: np.ndarray, __: float) -> Any:
        tried.append(q)
        return (q, v) if len(tried) > refused else None

    def give_up(*_: Any) -> None:
        raise InputError

    states = object.__new__(random_states.ConsistentStates)
    dyn = Stub(model=slider().build())
    states.manifold = Stub(dyn=dyn, equations=Stub(row_choice=Stub(closed=None)))
    with pytest.MonkeyPatch.context() as there:
        there.setattr(random_states, "flowed", flowed)
        there.setattr(random_states, "require_independent", lambda *_: None)
        there.setattr(random_states, "refuse_unreachable", give_up)
        return tried if accepts(states.random, np.random.default_rng(0), None) else None


def drawn_anywhere(k: int) -> bool:
    rng, model = np.random.default_rng(0), slider().build()
    return (draws(k) or [])[-1:] == [manifold.random_state(model, rng, None)[0] for _ in range(k + 1)][-1:]


def hit_in_a_row(*speeds: float) -> np.ndarray:
    """Return the relative velocities of balls in a row, of which each comes towards the next with one of the speeds."""
    own = {"kind": "prismatic", "mass": 1.0, "axis": (1, 0, 0)}
    stopped = own | {"lower": 0.0, "stops": True, "restitution": 1.0}
    dyn = mb.dynamics(chain(own, *(stopped for _ in speeds), gravity=(0, 0, 0)).build(), "pinocchio")
    v = np.array([[speeds[0], *(-x for x in speeds)]])
    return after_impacts(dyn._jumps, dyn, np.zeros(v.shape), v).v[0]


def bounces(height: float) -> bool:
    model = slider(gravity=(-9.81, 0, 0), lower=0.0, stops=True, restitution=1.0).build()
    run = mb.simulate(mb.dynamics(model, "pinocchio"), [height], [0.0], 1e-5, method="rk4", dt=1e-5)
    return all("hits" in x.name for x in run.events)


def hit_at_once(apart: float) -> bool:
    """Return whether two sliders that reach their stops so many seconds apart do so at one time."""
    own = {"kind": "prismatic", "mass": 1.0, "axis": (0, 0, 1), "parent": "world", "stops": True}
    links = [own | {"lower": -0.5 * 9.81 * t**2} for t in (0.3, 0.3 + apart)]
    dyn = mb.dynamics(chain(*links).build(), "pinocchio")
    run = mb.simulate(dyn, [0.0, 0.0], [0.0, 0.0], 0.4, method="dop853", rtol=1e-12)
    return len({x.t for x in run.events}) == 1


def compiles_moreau(responses: int) -> bool:
    needs = Stub(friction=True, stops=False)
    model = Stub(effects={"jump"}, needs=needs, constrained=True, nv=responses)
    dyn = Stub(_derived=True, _compiles_steps=True, model=model, _jumps=Stub(law=Stub(which=[0])))
    return moreau._compiles(Stub(dyn=dyn, torque=Stub(callable=False)))


def compiles_rounds(joints: int) -> bool:
    dyn = Stub(_derived=True, _compiles_steps=True, _code=lambda *_, **__: None)
    return jumps.Jumps._rounds(Stub(law=Stub(which=range(joints), stops=None)), dyn) is not None


def blames_the_engine(size: float) -> bool:
    def refuse(*_: Any) -> None:
        raise NumericalError("the engine's reason")

    field = object.__new__(vector_field.Field)
    field._space, field._timed, field._forward, field.evaluations = None, False, refuse, 0
    with pytest.raises(vector_field.DivergenceError) as caught:
        field(0.0, np.array([size]), np.zeros(1), np.zeros(1))
    return "engine" in str(caught.value)


def ends_at(power: float) -> bool:
    """Return whether damped Newton leaves 1, from which it reaches zero of |q|^power by short steps alone."""
    return bool(closest(power)[0] != 1.0)


def closest(power: float) -> np.ndarray:
    def rows(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        size = abs(q[0]) ** power
        return np.array([size]), np.array([[power * size / q[0]]])

    return manifold.closest_configuration(SPRING, np.ones(1), np.eye(1), rows)[0]


def sampled(place: float) -> bool:
    arm = {"kind": "prismatic", "mass": 1.0, "axis": (1, 0, 0)}
    model = chain({"axis": (0, 0, 1)}, arm).build()
    return bool(np.isclose(validation.sample_mass_matrix(model, np.array([0.0, place]))[0, 0], place**2))


def crawls(steps: int, covered: float) -> bool:
    record: Any = Stub(steps=steps, rejected=0, _look=(0, 0.0), reached=covered, problem=Stub(duration=1.0))
    record.stop = lambda *_: None
    return trajectory_record.TrajectoryRecord.crawls(record)


def stops_the_other(speed: float) -> bool:
    rests, rubs = np.array([True, False]), np.array([False, False])
    return bool(phases.stopped(np.ones((2, 1)), np.array([speed, 1.0]), rests, rubs)[1] != 1.0)


def has_eigenvalues(rows: int) -> bool:
    return len(stiffness_measure.stiffness_of(-np.eye(rows), np.inf, exact=True).eigenvalues) > 0


# Studies


def points(errors: list[float], floor: float = 0.0, motion: float = 1e6) -> bool:
    steps = [0.1 / 4**k for k in range(len(errors))]
    return sweep.observed_order(steps, errors, floor=floor, motion=motion).points == 4


def slopes(*of: float) -> list[float]:
    return np.exp(-np.cumsum([0.0, *of]) * np.log(4)).tolist()


def settled(*cells: tuple[float, int]) -> bool:
    return sweep.gains_nothing([Measurement(1.0, error=e, steps=n) for e, n in cells], 0.0)


def turned(ratio: float) -> bool:
    cells = (Measurement(0.1, error=1.0, setting="dt"), Measurement(0.05, error=ratio, setting="dt"))
    return sweep.Curve.turn.fget(Stub(points=cells)) is not None


def preparation(seconds: float) -> float:
    return measurements.Limits.preparation.fget(Stub(seconds=seconds))


def unexpected(order: float) -> bool:
    curve = Stub(points=(), order=order, expected=0.0)
    return result.curve_lines(Stub(front=(), floor=0.0, curves=[curve]))[0][2]


def stops_after(failures: int) -> bool:
    row = _Row("e", "m", "dt", None)
    for k in range(failures):
        row.add(k, Measurement(float(k), end="diverged"))
    return bool(row.stopped)


def changes_shown(count: int) -> bool:
    checked: Any = Stub(
        changes=[Stub(text="t")] * count, effect="", moved=(), versions=(), processors=("", ""), skipped=(), notes=()
    )
    return ("description", "and 1 more") in list(BaselineResult.lines(checked))


def rollout_steps(steps: int) -> bool:
    texts = dict.fromkeys(("model", "digest", "target", "processor"), "x")
    b: Any = Stub(**texts, states=Stub(kinds=()), versions={}, errors={}, seed=0, rollout=Stub(steps=steps))
    try:
        file._check(b)
    except ValueError as error:
        return "steps" not in str(error)
    return True


def copied(count: int) -> bool:
    links = [{"mass": 1.0 + k, "inertia": (0.1, 0.2, 0.25), "axis": (0, 1, 0)} for k in range(count)]
    return any(f.check == "copied inertia" for f in mb.lint(chain(*links).build()).rows)


def turn(angle: float) -> bool:
    return bool(description._turn(np.eye(3).ravel(), mb.spatial.matrix_from_rpy(angle, 0.0, 0.0).ravel()))


#: Module and name -> what decides, and a number on either side of the threshold.
DECIDES: dict[str, tuple[Callable[[Any], object], Any, Any]] = {
    "catalog._system:_MAX_COUNT": (lambda x: accepts(_system.count, "n", x), 2000, 2001),
    "derivation.constraints:_SINGULAR": (lambda x: constraints.singular_mass_matrix(two_sliders(x)), 1e-9, 8e-9),
    "derivation.constraints:_CLOSED": (lambda x: OpenRows(x).closed(np.ones(1), [0, 1]) is None, 5e-14, 5e-13),
    "derivation.constraints:_LOOKS": (has_closed, (3, 2.6), (4, 2.0)),
    "derivation.constraints:_STARTS": (has_closed, (3, 2.6), (4, 2.0)),
    "derivation.steps.onto_constraints:_MAX_RESIDUAL": (projected, 3e-16, 2e-15),
    "derivation.steps.onto_constraints:_MAX_ERROR": (far_in_one, 4e-9, 4e-8),
    "derivation.steps.onto_constraints:_ITERATIONS": (far_in_some, 1e-4, 2e-2),
    "derivation.steps.onto_constraints:STEPS_TO_POSE": (
        lambda x: bool(onto_constraints.nears_singular(1.0, x)),
        1.4,
        1.8,
    ),
    "engines.applications.random_states:_DRAWS": (lambda x: draws(x) is None, 49, 50),
    "engines.applications.random_states:_ANYWHERE": (drawn_anywhere, 9, 11),
    "engines.constrained:TAKES_PART": (
        lambda x: (
            "row b"
            in str(singular_pose("", "", ["row a", "row b", "row c"], np.array([[1.0, 0.0], [0.0, 1.0], [1.0, x]])))
        ),
        0.05,
        0.2,
    ),
    "engines.constraint_manifold:AT_POSE": (
        lambda x: Manifold.at_pose(Stub(jacobian=lambda _: np.diag([1.0, x])), None),
        5e-9,
        5e-8,
    ),
    "engines.elements.jumps:_MAX_COMPILED": (compiles_rounds, 18, 19),
    "errors:_MAX_FAULTS": (lambda x: ".faults holds all" in str(ModelError("m", ["f"] * x)), 100, 101),
    "errors:_LONGEST_NAME": (lambda x: bool(nearest("x" * x, ["x" * x + "y"])), 200, 201),
    "lagrangian.continua.integrals:_INTEGRAL_ERROR_RATIO": (
        lambda x: integrals.number(sp.Rational(1, 3) + sp.Rational(x)).is_Float,
        "1e-23",
        "1e-22",
    ),
    "lagrangian.continua.ritz:_ZERO_PIVOT_RATIO": (is_definite, -100.5, -99.5),
    "lagrangian.statics.steady_motion:_SINGULAR_CONDITION": (turns_about_two_axes, 5e-6, 5e-5),
    "lagrangian.trig.shortest_form:_MAX_PRODUCT_ANGLES": (split_off, 4, 5),
    "lagrangian.trig.simplify:MAX_READABLE_TERMS": (readable, 400, 401),
    "lagrangian.trig.simplify:MAX_COMBINED_TERMS": (combined, 60, 61),
    "lagrangian.continua.beam:MAX_MODES": (lambda x: accepts(clamped_free, x, sp.Symbol("x"), 1), 20, 21),
    "lagrangian.energies.sympy_to_casadi:MAX_SHOWN_LETTERS": (
        lambda x: sympy_to_casadi._short("x" * x).endswith("..."),
        200,
        201,
    ),
    "lagrangian.energies.sympy_to_casadi:_SINGULAR_CONDITION": (condition_of_rates, 3e11, 3e12),
    "lagrangian.printer:MAX_DENOMINATOR": (lambda x: "/" in printer._number(sp.Rational(1, x)), 10_000, 10_001),
    "lagrangian.printer:_MIN_ROOT_OPERATIONS": (lambda x: abbreviated(x, 5), 3, 4),
    "lagrangian.printer:_MIN_ROOT_OCCURRENCES": (lambda x: abbreviated(5, x), 2, 3),
    "lagrangian.trig.simplify:_MAX_EXPONENT": (power_is_one, 12, 13),
    "lagrangian.trig.simplify:_MAX_TIDIED_OPERATIONS": (tidied, 145, 155),
    "load.loader:_MAX_TOML_BYTES": (toml, 1_000_000, 1_000_001),
    "load.urdf_reader:_MAX_JOINTS": (few_joints, 2000, 2001),
    "load.xml_reader:MAX_DEPTH": (lambda x: accepts(xml_reader.parse, b"<a>" * x + b"</a>" * x, "x"), 250, 251),
    "load.xml_reader:_MAX_LISTED_FILES": (listed, 10, 11),
    "load.xml_reader:MAX_NAME_LENGTH": (long_name, 1000, 1001),
    "methods.one_step:MAX_GROWTH": (lambda x: one_step.elementary_factors(FLOATS, 1e-30, 1.0)[0] > x, 9.0, 11.0),
    "methods.one_step:_SAFETY": (lambda x: one_step.elementary_factors(FLOATS, 1.0, 1.0)[0] > x, 0.7, 0.9),
    "methods.one_step:_MIN_SHRINK": (
        lambda x: one_step.next_step(FLOATS, (1.0, 1e-9, 1.0), False, 1.0, 1.0, 1.0, 1.0)[0] > x,
        0.15,
        0.25,
    ),
    "model.base_parameters:_PIVOT_RATIO": (
        lambda x: base_parameters.eliminated(np.array([[1.0, x]]))[0] == [1],
        0.05,
        0.2,
    ),
    "model.builder:MAX_LENGTH": (place, 5e149, 5e150),
    "model.elements.beams:_MAX_MODES": (
        lambda x: accepts(beams.modes_of, x, None, string=True),
        10,
        11,
    ),
    "model.elements.beams:_MAX_POLYNOMIAL_DEGREE": (
        lambda x: accepts(beams.modes_of, None, Polynomial(np.eye(x + 1)[x]), string=False),
        20,
        21,
    ),
    "model.elements.motion_laws:MAX_KNOTS": (few_knots, 2000, 2001),
    "model.manifold:NEAR_UNIT": (quaternion, 4e-10, 4e-9),
    "model.manifold:_LEAST_STEP_PART": (ends_at, 2e-7, 2e-6),
    "model.manifold:_MAX_SEARCH_STEPS": (lambda x: abs(closest(x)[0]) < 1e-9, 0.55, 0.9),
    "model.manifold:_COMMON_SIZE": (lambda x: manifold.magnitude(np.array([x])) > 1, 9.0, 11.0),
    "_check:TWO_TURNS": (lambda x: warns(_check.hint_at_degrees, "q", x), 10.0, 15.0),
    "model.model:_MAX_TURN_IN_A_STEP": (
        lambda x: warns(hinge().build().check_q, [4 * np.pi + x]),
        0.5,
        2.0,
    ),
    "model.validation:MAX_LISTED": (names_bodies, 30, 50),
    "model.elements.editing:_MAX_NOTED_NUMBERS": (
        lambda x: list(editing._changes(Stub(a=np.zeros(x)), {"a": np.ones(x)}, set(), set())) == ["a"],
        3,
        4,
    ),
    "model.validation:_MAX_SAMPLED_COORDINATE": (sampled, 5e5, 5e6),
    "model.validation:_MAX_VELOCITIES": (too_many, 5000, 5001),
    "model.validation:_MIN_MASS_OR_MOMENT": (
        lambda x: bool(validation.scale_doubts(slider(mass=x).build())),
        5e-15,
        5e-14,
    ),
    "model.validation:_MAX_SIZE_RATIO": (lambda x: bool(validation.scale_doubts(small_wheel(x))), 5e-12, 5e-11),
    "show.meshes:_MAX_MATERIALS": (materials, 4999, 5000),
    "show.meshes:_MIN_CLUSTERED_TRIANGLES": (lambda x: len(clustered(x)) < x, 140, 160),
    "simulate.checks:_MAX_ROUNDING": (
        lambda x: any(checks.condition([np.array([[1.0, 1 - x], [1 - x, 1.0]])])),
        2e-13,
        2e-12,
    ),
    "simulate.checks:_MAX_POSITION_ERROR": (
        lambda x: any(checks.coordinate_magnitude(np.array([[x]]), None)),
        2e9,
        2e10,
    ),
    "simulate.checks:_MIN_MOTION": (lambda x: still_and_moved(1.0, x), 5e-8, 2e-7),
    "simulate.checks:_MAX_REST_VELOCITY": (lambda x: still_and_moved(x, 0.0), 1e-13, 1e-12),
    "simulate.checks:_MAX_ERROR_SUM": (
        lambda x: any(checks.accumulated_error("m", checks.Tolerances(1e-9, 1e-9), 1, x)),
        5e5,
        2e6,
    ),
    "simulate.checks:_TRANSIENT_SHARE": (decaying, 5e-3, 2e-2),
    "simulate.checks:_MAX_MODE_LOSS": (lambda x: follows("implicit_midpoint", x, 10.0), 0.1, 0.25),
    "simulate.checks:_MAX_FOLLOWED_STEP": (lambda x: follows("semi_implicit_euler", x, 1e8), 5e-4, 2e-3),
    "simulate.checks:_MAX_HALVING_DIFFERENCE": (rushes, 2.0, 3.0),
    "simulate.checks:_MAX_EIGENVALUE_RATIO": (moves_mass, 5e-8, 5e-7),
    "simulate.trajectory:_MAX_GAP": (twice_the_step_differs, 5e-3, 5e-2),
    "simulate.solvers.auto:MIN_RTOL": (
        lambda x: auto.loosest("rk853", checks.Tolerances(2e-13, 1.0)).rtol > x,
        7e-14,
        1.5e-13,
    ),
    "simulate.solvers.auto:_RK853_SHARE": (
        lambda x: auto.loosest("rk853", checks.Tolerances(1e-6, 1.0)).rtol > x,
        5e-8,
        2e-7,
    ),
    "engines.elements.stop_impacts:_FIRST": (lambda x: hit_in_a_row(1.0, x)[0] < -0.1, 5e-7, 5e-6),
    "engines.elements.stop_impacts:_MAX_IMPACTS": (
        lambda x: hit_in_a_row(1.0, *np.zeros(x)).sum() > 0.999,
        150,
        210,
    ),
    "model.stops:TOUCHING": (
        lambda x: bool(StopLaw(slider(lower=0.0, stops=True).build()).against(np.array([x]))),
        32 * EPS,
        128 * EPS,
    ),
    "simulate.solvers.in_phases.phases:_LOWEST_BOUNCE": (bounces, 5e-12, 5e-11),
    "simulate.solvers.in_phases.phases:_SIMULTANEOUS": (hit_at_once, 5e-13, 5e-12),
    "simulate.solvers.in_phases.moreau:_MAX_RESPONSES": (compiles_moreau, 200, 201),
    "simulate.solvers.in_phases.phases:POSE_ROUNDING": (lambda x: phases.slow(np.ones(1))[0] > x, 5e-10, 5e-9),
    "simulate.solvers.in_phases.phases:_FADED": (
        lambda x: phases.fades(np.zeros((1, 1)), np.ones(1), np.full(1, x))[0],
        5e-8,
        5e-7,
    ),
    "simulate.solvers.in_phases.phases:_LEFT": (stops_the_other, 5e-4, 5e-3),
    "simulate.solvers.step_attempts:LOOSEST": (
        lambda x: step_attempts.RungeKuttaAttempts._reach.fget(Stub(_tolerances=checks.Tolerances(x, x), grows=8)) > 1,
        5e-11,
        5e-10,
    ),
    "simulate.solvers.trajectory_record:_ATTEMPTS_PER_LOOK": (lambda x: crawls(x, 0.0), 19_999, 20_000),
    "simulate.solvers.trajectory_record:_MIN_SHARE_COVERED": (lambda x: crawls(10**6, x), 5e-7, 5e-6),
    "simulate.solvers.vector_field:BLAMELESS": (blames_the_engine, 5e49, 5e50),
    "simulate.stiffness_measure:_MAX_SMALL_ROWS": (has_eigenvalues, 20, 21),
    "simulate.time_grid:MAX_NUMBERS": (lambda x: accepts(time_grid.check_room, x, 2), 2**29, 2**29 + 1),
    "simulate.solvers.vector_field:BOUND": (lambda x: bool(vector_field.is_bounded(np.array([x]))), 5e99, 5e100),
    "simulate.stiffness_measure:_MIN_GROWTH_SHARE": (
        lambda x: stiffness_measure.Stiffness(np.array([complex(x, 1.0)]), 1.0).stable > 0,
        0.05,
        0.2,
    ),
    "studies.baseline.description:_MAX_ROUNDINGS": (
        lambda x: description._only_rounding("mass", np.ones(1), np.ones(1) + x * EPS),
        32,
        128,
    ),
    "studies.baseline.description:_LEAST_TURN_RAD": (turn, 5e-8, 5e-7),
    "studies.baseline.file:_MAX_ROLLOUT_STEPS": (rollout_steps, 10_000, 10_001),
    "studies.baseline.result:_MAX_CHANGES_SHOWN": (changes_shown, 20, 21),
    "studies.baseline.study:FINE": (
        lambda x: baseline._allowed(Stub(own={}, errors={"e": {"M": 0.0}}), "e", "M") > x * EPS,
        100,
        200,
    ),
    "studies.compare.result:_MIN_VISIBLE_CHANGE": (
        lambda x: omission_state(Stub(change=x, fault="", present=True)),
        5e-7,
        5e-6,
    ),
    "studies.explain.hypotheses:_MAX_NUMBERS_SHOWN": (
        lambda x: hypotheses._changed("f", np.zeros(x), np.ones(x), None).startswith("another"),
        9,
        10,
    ),
    "studies.formatting:_MAX_LISTED_LETTERS": (lambda x: len(formatting.missing_text(["a:" + "b" * x])) > 9, 78, 79),
    "studies.lint.checks:LIKELY_FROM": (lambda x: lint.checks._confidence(x) == lint.checks.LOOK, 2.0, 4.0),
    "studies.lint.checks:SURE_FROM": (lambda x: lint.checks._confidence(x) == lint.checks.SURE, 20.0, 40.0),
    "studies.lint.checks:MIN_COPIES": (copied, 2, 3),
    "studies.soft_stops:_TOUCHES": (
        lambda x: bool(mb.soft_stops(slider(gravity=(0, 0, 0), upper=0.0).build(), [-x], [0.0], duration=0.01).rows),
        5e-7,
        5e-6,
    ),
    "studies.measurement:GROSS": (lambda x: Measurement(1.0, error=x).outcome(1e-6), 5e-3, 5e-2),
    "studies.stress.study:_MAX_FAILURES_IN_A_ROW": (stops_after, 1, 2),
    "studies.stress.measurements:_MIN_PREPARATION_SECONDS": (lambda x: preparation(0.0) > x, 5.0, 7.0),
    "studies.stress.measurements:_PREPARATION_PER_RUN_TIME": (lambda x: preparation(10.0) > x, 140.0, 160.0),
    "studies.work_precision.result:MAX_ORDER_ERROR": (unexpected, 0.15, 0.25),
    "studies.work_precision.result:MAX_USEFUL_ERROR": (
        lambda x: result.front_names(Stub(front=[(Stub(name="a"), Stub(error=x))])),
        0.05,
        0.2,
    ),
    "studies.work_precision.sweep:_COARSEST_STEP_SECONDS": (
        lambda x: sweep._steps(METHODS["rk4"], 10.0)[0] > x,
        0.04,
        0.06,
    ),
    "studies.work_precision.sweep:_MAX_ERROR_PER_MOTION": (
        lambda x: points([x, x / 16, x / 256, x / 4096], motion=1.0),
        0.02,
        0.05,
    ),
    "studies.work_precision.sweep:_MIN_ERROR_PER_FLOOR": (
        lambda x: points([1.0, 0.1, 1e-2, 1e-3], floor=1e-3 / x),
        50,
        200,
    ),
    "studies.work_precision.sweep:_MAX_SLOPE_SPREAD": (lambda x: points(slopes(2, 2, 2 + x)), 0.2, 0.5),
    "studies.work_precision.sweep:_MIN_TURNED_ERROR_RATIO": (turned, 1.2, 2.0),
    "studies.work_precision.sweep:_MAX_SETTINGS_WITHOUT_GAIN": (
        lambda x: settled(*[(1e-9, 100 * 2**k) for k in range(x + 1)]),
        1,
        2,
    ),
    "studies.work_precision.sweep:_MAX_CONVERGED_ERROR": (
        lambda x: settled((x, 100), (0.95 * x, 200), (0.9 * x, 400)),
        5e-7,
        5e-6,
    ),
    "studies.work_precision.sweep:_MAX_SETTLED_SPREAD": (
        lambda x: settled((1e-3, 100), (1e-3 * (1 - x / 2), 200), (1e-3 * (1 - x), 400)),
        5e-3,
        5e-2,
    ),
    "studies.work_precision.sweep:_MIN_STEPS_RATIO": (
        lambda x: settled((1e-9, 1000), (1e-9, round(1000 * x)), (1e-9, round(1000 * x**2))),
        1.15,
        1.3,
    ),
}


def clustered(count: int) -> np.ndarray:
    angles = np.linspace(0, 2 * np.pi, count + 1)
    vertices = np.array([(0, 0, 0), *zip(np.cos(angles), np.sin(angles), 0 * angles, strict=True)], dtype=float)
    triangles = np.array([(0, k + 1, k + 2) for k in range(count)])
    return meshes.thinned([meshes.Surface(vertices, triangles, None)], 20)[0].triangles


def told_apart(constant: str, decide: Callable[[Any], object], below: Any, above: Any) -> None:
    place, name = constant.split(":")
    module = import_module(f"mbkit.{place}")
    assert decide(below) != decide(above)
    value = getattr(module, name)
    for changed in (max(value // 10, 1) if isinstance(value, int) else value / 10, value * 10):
        with pytest.MonkeyPatch.context() as there:
            there.setattr(module, name, changed)
            assert decide(below) == decide(above), changed


@pytest.mark.parametrize("constant", DECIDES)
def test_threshold_decides_between_its_two_sides(
    constant: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    told_apart(constant, *DECIDES[constant])
