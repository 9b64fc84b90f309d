"""Thresholds of machine code, of steps and of pictures, as in `test_thresholds`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest
import sympy as sp

import mbkit as mb
from mbkit._check import EPS
from mbkit.codegen import compiled, extended_precision, jit
from mbkit.derivation import least_constraint
from mbkit.derivation.steps import midpoint
from mbkit.identify.result import Identification
from mbkit.lagrangian.trig import simplify
from mbkit.simulate import checks, singular_poses
from mbkit.simulate.plotting import motion_strip
from mbkit.simulate.solvers import compiled_fixed_step
from mbkit.simulate.solvers.in_phases import fixed
from mbkit.studies.baseline.result import BaselineResult
from mbkit.studies.compare import beyond_terms
from mbkit.studies.explain import hypotheses
from mbkit.studies.explain.merged_model import Tolerances, merge
from mbkit.studies.work_precision import sweep
from tests.scenes import chain, hinge
from tests.test_thresholds import Stub, accepts, told_apart, twice_the_step_differs, two_sliders


def arrays(number: int) -> bool:
    with pytest.MonkeyPatch.context() as there:
        there.setattr(jit, "vector_code", lambda *_: ("", 0))
        there.setattr(jit, "object_code", lambda _: b"")
        program: Any = Stub(inputs=range(number), outputs=())
        try:
            jit.program_object(program)
        except ValueError:
            return False
    return True


def threads(samples: int) -> bool:
    parts: list[tuple[int, int]] = []

    def part(_: Any, __: Any, first: int, last: int) -> bool:
        parts.append((first, last))
        return True

    code: Any = Stub(operations=1, _part=part)
    compiled.Compiled.run(code, [Stub(shape=(samples,))], [], threads=2)
    return len(parts) > 1


def finite_power(exponent: int) -> bool:
    power = extended_precision._mpmath().functions["pow"]
    return str(power(2, exponent)) != "+inf"


def last_correction(change: float, h: float, w: float) -> bool:
    return bool(midpoint.is_last(ca.DM([change]), ca.DM([w]), ca.DM([0.0]), h))


def loses_digits(model: mb.Model) -> bool:
    return least_constraint.loses_digits.__wrapped__(model)


def is_zero(value: float) -> bool:
    x = sp.Symbol("x")
    return simplify.is_zero(sp.Float(value, 60) * (sp.sin(x) ** 2 + sp.cos(x) ** 2))


def geom(mass: float) -> bool:
    """Return whether a light geom counts beside none."""
    body = f'<body><joint/><geom size="1" mass="{mass}"/></body>'
    return accepts(mb.load, f"<mujoco><worldbody>{body}</worldbody></mujoco>")


def fastest(samples: int) -> bool:
    v = np.zeros((samples, 1))
    v[1] = 1.0
    return bool(checks._fastest(v)[0])


def window(share: float, members: int) -> int:
    run: Any = Stub(_compiled=lambda _: True, _phase=Stub(dyn=None), _ends=(share, 10**9))
    return fixed._Members._window(run, members)


def widest(numbers: int) -> int:
    return compiled_fixed_step._widest(Stub(sizes={"q": numbers}))


def strip(tall: float) -> bool:
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.1, tall]]) - 0.5
    return bool(motion_strip._widest(points, np.array([0, 0, -9.81]))[1][2])


def axis(aslant: float) -> bool:
    """Return whether points beside the x axis, by an angle, are seen along it."""
    points = np.array([[np.cos(aslant), np.sin(aslant), 0.0]]) * np.linspace(-1, 1, 5)[:, None]
    return bool(motion_strip._spread(points, np.array([0.0, 0.0, 1.0]))[0] == 1.0)


def rollout(steps: int, condition: float = 1.0) -> Any:
    model = Stub(difference=lambda a, b: b - a, constrained=False)
    run = Stub(t=np.arange(steps + 1.0), q=np.zeros((steps + 1, 1)), method="m", engine="e", stats=Stub(seconds=1.0))
    with pytest.MonkeyPatch.context() as there:
        there.setattr(beyond_terms, "stiff_joints", lambda *_: [])
        dyn: Any = Stub(model=model, mass_matrix=lambda _: np.eye(1))
        return beyond_terms._row(dyn, run, run, np.full(steps + 1, condition), False, 1.0, "")


def rounded(bodies: int, by: float) -> bool:
    def arms(factor: float) -> mb.Model:
        return chain(*({"mass": 1.0 + k, "com": (0, 0, factor), "axis": (0, 1, 0)} for k in range(bodies))).build()

    one, other = merge(arms(1.0)), merge(arms(1.0 + by))
    found = hypotheses.summarized_differences(one, other, Tolerances.of(one.model, 1e-9))
    return any(x.kind == "rounding" for x in found)


def coefficients(offset: float) -> int:
    first = {"mass": 1.0, "com": (1, 0, 0), "inertia": (0.1, 0.2, 0.25), "axis": (0, 0, 1)}
    b = chain(first, first | {"translation": (1, offset, 0), "axis": (0, 1, 0)})
    return int(np.count_nonzero(b.build().base_parameters().matrix))


def order_is_known(points: int) -> bool:
    steps = 0.5 ** np.arange(points)
    try:
        return sweep.observed_order(steps.tolist(), (1e-3 * steps).tolist(), floor=0.0, motion=1.0).points > 0
    except ValueError:
        return False


def later_poses(count: int) -> bool:
    poses: Any = {0: Stub(times=range(count), rows=["a"])}
    return "and later" in singular_poses.describe_poses(poses, None, tolerance=False)


def rows_shown(count: int) -> bool:
    moved = [Stub(engine="e", error=1.0, cause="", term="M")] * count
    nothing = dict.fromkeys(("effect", "changes", "versions", "skipped", "notes"), ())
    lines = BaselineResult.lines(Stub(moved=moved, processors=("", ""), **nothing))  # type: ignore[arg-type]
    return any("more" in text for _, text in lines)


def is_no_friction(deviations: float) -> bool:
    estimate = Stub(name="j.damping", value=-deviations, deviation=1.0, determined=True)
    (joint,) = Identification._joints(Stub(parameters=[estimate]), hinge(damping=1.0).build())  # type: ignore[arg-type]
    return not joint.damping.any()


def simplified(operations: int) -> bool:
    simplify.tidy.cache_clear()
    with pytest.MonkeyPatch.context() as there:
        there.setattr(simplify, "forms", lambda _: [sp.Integer(1)])
        return bool(simplify.tidy(sp.Add(*sp.symbols(f"a:{operations + 1}"))) == 1)


#: As in `test_thresholds`.
DECIDES: dict[str, tuple[Callable[[Any], object], Any, Any]] = {
    "codegen.jit:MAX_ARRAYS": (arrays, 16, 17),
    "codegen.compiled:_MIN_THREAD_OPERATIONS": (threads, 3_999_999, 4_000_000),
    "codegen.extended_precision:_MAX_EXPONENT": (finite_power, 16_000, 17_000),
    "derivation.least_constraint:_MAX_RATIO": (lambda x: loses_digits(two_sliders(x)), 5e-6, 5e-5),
    "derivation.steps.midpoint:MAX_LAST_CORRECTION": (lambda x: last_correction(x, 1e9, 1.0), 5e-9, 5e-8),
    "derivation.steps.midpoint:MAX_LAST_MOVE": (lambda x: last_correction(x, 1.0, 0.0), 5e-13, 5e-12),
    "identify.result:SIGNIFICANT_DEVIATIONS": (is_no_friction, 2.0, 4.0),
    "lagrangian.trig.simplify:MAX_SIMPLIFIED_OPERATIONS": (simplified, 2000, 2001),
    "lagrangian.trig.simplify:_ZERO_VALUE": (is_zero, 5e-51, 5e-50),
    "load.mjcf_reader:_MIN_GEOM_MASS": (geom, 5e-15, 5e-14),
    "model.base_parameters:_COEFFICIENT_ROUNDING": (coefficients, 3e-11, 3e-10),
    "simulate.checks:_SAMPLED_VELOCITIES": (fastest, 63, 64),
    "simulate.plotting.motion_strip:_FLAT": (strip, 0.01, 0.05),
    "simulate.plotting.motion_strip:_NEARLY": (axis, 0.3, 0.6),
    "simulate.singular_poses:MAX_NAMES": (later_poses, 3, 4),
    "simulate.trajectory:_MAX_VELOCITY_RATIO": (lambda x: twice_the_step_differs(x, 6 * x), 0.9, 1.1),
    "simulate.solvers.compiled_fixed_step:CACHE": (lambda x: widest(100) > x, 600, 700),
    "simulate.solvers.compiled_fixed_step:LANES": (lambda x: widest(10**6) > x, 60, 80),
    "simulate.solvers.compiled_fixed_step:_MAX_CHUNK_STATES": (lambda x: widest(1) > x, 900, 1100),
    "simulate.solvers.in_phases.fixed:_BLOCK": (lambda x: window(1e9, 1) > x, 25, 40),
    "simulate.solvers.in_phases.fixed:SIDE_BY_SIDE": (lambda x: window(0.01, 1) == window(0.01, x), 6, 12),
    "studies.baseline.result:MAX_LINES": (rows_shown, 8, 9),
    "studies.work_precision.sweep:_MIN_POINTS": (order_is_known, 2, 3),
    "studies.compare.beyond_terms:_MAX_ROUNDINGS": (lambda x: rollout(100, 1e6).tolerance > x * 1e6 * EPS, 200, 300),
    "studies.compare.beyond_terms:_MIN_JUDGED_STEPS": (lambda x: rollout(x).judged, 49, 50),
    "studies.explain.hypotheses:_ROUNDED_DIFFERENCE": (lambda x: rounded(6, x), 1e-5, 1e-4),
    "studies.explain.hypotheses:_MAX_LISTED_ALONE": (lambda x: rounded(x, 1e-5), 4, 5),
}


@pytest.mark.parametrize("constant", DECIDES)
def test_threshold_decides_between_its_two_sides(constant: str) -> None:
    told_apart(constant, *DECIDES[constant])
