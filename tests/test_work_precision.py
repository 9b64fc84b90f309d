"""Error against run time: orders seen, timings told apart, and nothing finished that is lost."""

from __future__ import annotations

import csv
import dataclasses
import io
import itertools
import json
import math
import multiprocessing
import os
import pickle
import warnings
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ellipj, ellipk

import mbkit as mb
from mbkit._escape import csv_text
from mbkit.errors import InputError, MbkitWarning, UnknownNameError
from mbkit.simulate import METHODS
from mbkit.studies import InterruptedSweepError, Reference, work_precision
from mbkit.studies.measurement import Measurement
from mbkit.studies.work_precision.result import WorkPrecision
from mbkit.studies.work_precision.sweep import (
    Curve,
    CurveMeasurement,
    _without_heyoka_cache,
    gains_nothing,
    observed_order,
    plans,
    repetitions,
)
from tests.scenes import chain, hinge, slider

FIXED = [m.name for m in METHODS.values() if m.kind != "adaptive"]
STEPS = [0.1 / 2**k for k in range(6)]
ROOT = math.sqrt(9.81)


def swing(t):
    """A pendulum of 1 m let go at 1 rad: Jacobi's functions (Landau, Lifshitz 1976, Mechanics, §11)."""
    k = math.sin(0.5)
    sn, cn, _, _ = ellipj(ellipk(k**2) - ROOT * t, k**2)
    return [2 * math.asin(k * sn)], [-2 * k * ROOT * cn]


def study(*args, **more):
    """A study of few points, against the exact motion."""
    usual = {"reference": swing, "repeats": 1, "steps": STEPS, "tolerances": [1e-7, 1e-13]}
    return work_precision(mb.catalog.pendulum(), *args, **{**usual, **more})


def set_clock(monkeypatch, seconds_per_look):
    """Let the clocks of a sweep advance by so much at each look, whatever the machine does meanwhile."""
    looks = itertools.count()

    def clock():
        return seconds_per_look * next(looks)

    sweep = import_module("mbkit.studies.work_precision.sweep")
    monkeypatch.setattr(sweep, "time", SimpleNamespace(perf_counter=clock, process_time=clock))


def errors(result):
    return {(c.engine, c.method, p.value): p.error for c, p in result.rows()}


@pytest.fixture(scope="module")
def few():
    """Two curves of a fixed step, two of a tolerance."""
    return study(("pinocchio", "mujoco"), ("rk4", "dop853"))


# What a study shows


@pytest.mark.thorough("lagrangian", "mujoco")
@pytest.mark.parametrize("engine", ["pinocchio", "lagrangian", "mujoco"])
def test_every_fixed_step_method_shows_its_order(engine):
    methods = [m for m in FIXED if not METHODS[m].engines or engine in METHODS[m].engines]
    result = study([engine], methods)
    assert result.complete
    assert not result.refusals
    assert [c.method for c in result.curves] == methods
    for curve in result.curves:
        assert curve.expected == METHODS[curve.method].order
        assert curve.order == pytest.approx(curve.expected, abs=0.2), curve.method
        assert curve.order_points >= 3
        assert len(curve.points) == len(STEPS)


def test_orders_on_the_manifold_by_a_reference_of_our_own():
    model = mb.catalog.free_body().without("gravity")
    q0, v0 = model.neutral(), np.array([0.1, 0.2, -0.1, 1.0, 2.0, 0.5])
    methods = {"pinocchio": ["rk4", "gauss4"], "lagrangian": ["implicit_midpoint"], "mujoco": ["mujoco_rk4"]}
    result = work_precision(model, tuple(methods), methods, q0=q0, v0=v0, steps=[0.05, 0.025, 0.0125], repeats=1)
    assert result.floor < 1e-13
    assert result.duration == 1.0
    assert [round(c.order, 1) for c in result.curves] == pytest.approx([4.0, 4.0, 2.0, 4.0], abs=0.2)


def test_points_tell_what_they_cost_and_a_tolerance_is_reached_in_proportion(few):
    for curve, point in few.rows():
        assert point.seconds > 0
        assert point.repeats == 1
        assert math.isnan(point.spread)
        assert not point.note
        assert curve.compile >= 0
        if point.setting == "dt":
            assert point.steps == round(1.0 / point.value)
        # The energy's error is of the size of the motion's.
        assert point.energy < 10 * point.error + 1e-13
    for curve in (c for c in few.curves if c.method == "dop853"):
        assert math.isnan(curve.order)
        assert math.isnan(curve.expected)
        loose, tight = curve.points
        assert tight.error < min(0.1 * loose.error, 1e-11)
        assert tight.evaluations > loose.evaluations > 0
    assert few.reference == "an exact function, to rounding"
    assert few.q0 == (1.0,)
    assert few.settings["timing"] == "interleaved in one process"


def test_repetitions_give_a_spread():
    result = study(["pinocchio"], ["rk4"], repeats=3, steps=[0.1, 0.05])
    assert [p.repeats for _, p in result.rows()] == [3, 3]
    assert all(p.spread >= 0 for _, p in result.rows())


def test_the_grids_of_our_own_end_where_finer_ones_bring_nothing():
    # Long enough for the sweep to end by itself.
    result = study(["pinocchio"], ["gauss6", "rk853"], steps=None, tolerances=None, seconds=1e4)
    for curve in result.curves:
        found = [p.error for p in curve.points]
        assert min(found) < 1e-13
        assert found.index(min(found)) >= len(found) - 4
        assert len(found) > 5
    assert not result.shortened


@pytest.mark.thorough
def test_a_grid_ends_where_an_engines_own_law_keeps_the_error():
    result = work_precision(mb.catalog.four_bar(), ["mujoco"], ["dop853"], repeats=1)
    (curve,) = result.curves
    *_, before, last = (p.error for p in curve.points)
    # Loops are soft there: the law's error stays at any tolerance, of which the grid has 13.
    assert last > 1e-6
    assert abs(last - before) < 0.01 * last
    assert len(curve.points) <= 6


def test_coarse_tolerances_that_bind_no_step_do_not_end_a_grid():
    # Steps end on the saved times, 0.1 s apart: of a gentle motion the first tolerances ask for no shorter ones.
    gentle = [(0.3 * math.cos(4 * t), -1.2 * math.sin(4 * t)) for t in np.linspace(0, 1, 11)]
    model, exact = slider(stiffness=16.0).build(), lambda t: tuple([x] for x in gentle[round(10 * t)])
    result = work_precision(model, ["pinocchio"], ["dop853"], reference=exact, repeats=1, seconds=60.0)
    (curve,) = result.curves
    # Tolerances that take the same steps are one point.
    first, second = curve.points[:2]
    assert first.value == 1e-3
    assert second.value < 1e-5
    assert first.error < 1e-6
    assert min(p.error for p in curve.points) < 1e-3 * first.error
    for a, b in itertools.pairwise(curve.points):
        assert (a.steps, a.evaluations) != (b.steps, b.evaluations)


def test_the_same_seed_gives_the_same_errors_to_the_bit_and_another_starts_elsewhere():
    for name in ("pinocchio", "lagrangian", "mujoco"):
        one, two = (study([name], ["rk4", "rk853"], steps=[0.05, 0.025], seed=3) for _ in range(2))
        assert errors(one) == errors(two)
    a, b = (study(["pinocchio"], ["rk4"], reference=None, steps=[0.1], seed=s) for s in (0, 1))
    assert a.q0 != b.q0
    assert a.floor < 1e-15


@pytest.fixture
def compiled(monkeypatch):
    """One entry for each compilation to machine code."""
    from mbkit.codegen import jit

    monkeypatch.setenv("MBKIT_COMPILE", "1")
    object_code, calls = jit.object_code, []

    def counted(*arguments, **options):
        calls.append("compile")
        return object_code(*arguments, **options)

    monkeypatch.setattr(jit, "object_code", counted)
    return calls


def test_what_is_compiled_once_is_no_run_time_and_is_compiled_again_each_time(monkeypatch, compiled):
    solve, in_runs = CurveMeasurement._solve, []

    def counted(self, dyn, value, save, *args):
        before = len(compiled)
        run = solve(self, dyn, value, save, *args)
        # The first steps are of no run.
        in_runs.extend([len(compiled) - before] if save is self.truth.times else [])
        return run

    monkeypatch.setattr(CurveMeasurement, "_solve", counted)
    for _ in range(2):
        compiled.clear()
        (curve,) = study(["lagrangian"], ["rk4"], steps=[0.05]).curves
        assert curve.compile > 0
        assert compiled
    assert in_runs == [0] * len(in_runs)
    assert len(in_runs) >= 4


def test_a_step_too_large_is_noted_and_does_not_end_the_sweep():
    given = {"q0": [0.1], "v0": [0.0], "duration": 2.0, "steps": [0.2, 1e-2, 5e-3, 2.5e-3], "repeats": 1}
    (curve,) = work_precision(hinge(stiffness=4e3).build(), ["pinocchio"], ["rk4"], **given).curves
    assert [p.value for p in curve.points] == pytest.approx([0.2, 1e-2, 5e-3, 2.5e-3])
    assert math.isnan(curve.points[0].error) or curve.points[0].error > 1
    assert all(p.error < 0.1 for p in curve.points[1:])


def test_steps_are_shortened_to_end_on_saved_times():
    (curve,) = study(["pinocchio"], ["rk4"], steps=[0.3, 0.07, 0.05, 0.0501, 0.001]).curves
    assert [p.value for p in curve.points] == pytest.approx([0.1, 0.05, 0.001])


def test_the_energy_of_a_damped_scene_is_not_made_up():
    given = {"q0": [1.0], "v0": [0.0], "steps": [0.05, 0.025], "repeats": 1}
    result = work_precision(hinge(damping=0.3).build(), ["pinocchio"], ["rk4"], **given)
    assert all(math.isnan(p.energy) and p.error < 1e-3 for _, p in result.rows())


def test_mimic_joints_are_free_where_mujocos_own_integrators_run():
    rod = {"mass": 1.0, "com": (0, 0, -0.5), "inertia": (0.1, 0.1, 0.1), "parent": "world", "axis": (0, 1, 0)}
    model = chain(rod, rod | {"mimic": mb.Mimic("j0", 1.0, 0.0)}).build()
    native = work_precision(model, ["mujoco"], ["mujoco_rk4"], steps=[0.05], repeats=1)
    assert native.facts["nq"] == 2
    assert "mimic joints free" in native.facts["notes"]
    rubbed = chain(rod | {"friction": 0.1}, rod | {"mimic": mb.Mimic("j0", 1.0, 0.0)}).build()
    reduced = work_precision(rubbed, ["pinocchio"], ["rk4"], steps=[0.05, 0.025], repeats=1)
    assert reduced.facts["nq"] == 1
    assert "without dry friction" in reduced.facts["notes"]
    assert "mimic joints free" not in reduced.facts["notes"]
    other = work_precision(model, ["mujoco"], ["rk4"], steps=[0.05], repeats=1)
    assert other.facts["nq"] == 1


# References


def test_a_reference_gives_start_times_and_horizon():
    t = np.linspace(0, 0.6, 7)
    states = [swing(x) for x in t]
    q, v = (np.array([s[i] for s in states]) for i in (0, 1))
    given = Reference(t, q, v, 0 * q, 0 * v, np.full(7, 2e-15), 14.7, (1.0, 3.0), 0.6, "by hand, and cut at 0.6 s")
    result = study(["pinocchio"], ["rk4"], reference=given, steps=[0.05, 0.025, 0.0125])
    assert (result.duration, result.asked) == (0.6, 1.0)
    assert result.reference == "by hand, and cut at 0.6 s"
    assert result.floor == 2e-15
    assert result.curves[0].order == pytest.approx(4, abs=0.2)
    assert study(["pinocchio"], ["rk4"], reference=given, duration=0.3).duration == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"reference": lambda _t: ([1.0, 2.0], [0.0])}, "reference's q"),
        ({"reference": lambda _t: ([math.nan], [0.0])}, "reference's q"),
        ({"reference": lambda _t: 1.0}, r"expected the function to return \(q, v\)"),
        ({"reference": lambda t: 1 / t}, "reference: the function raised ZeroDivisionError at t = 0 s"),
        ({"reference": 3.0}, "expected a Reference or a function"),
        ({"q0": [0.5]}, "does not start"),
        ({"v0": [0.5]}, "does not start"),
    ],
)
def test_a_reference_that_is_none_or_of_another_motion_is_refused(wrong, message):
    with pytest.raises(InputError, match=message):
        study(["pinocchio"], ["rk4"], **wrong)


# What cannot be done


def push(t, _q, _v):
    return [0.1 * math.cos(t)]


def test_methods_that_cannot_call_back_are_refused_by_name():
    methods = ("rk4", "taylor", "mujoco_rk4", "rk853")
    given = {"torque": push, "reference": None, "steps": [0.05], "tolerances": [1e-6]}
    result = study(("lagrangian", "mujoco"), methods, **given)
    refused = {("lagrangian", "taylor"), ("mujoco", "mujoco_rk4")}
    assert {(r.engine, r.term) for r in result.refusals} == refused
    assert all("torque" in r.reason for r in result.refusals)
    found = {(e, m) for e in ("lagrangian", "mujoco") for m in ("rk4", "rk853")}
    assert {(c.engine, c.method) for c in result.curves} == found
    assert all(math.isnan(p.energy) for _, p in result.rows())


def test_an_engine_that_breaks_loses_no_other(monkeypatch):
    from mbkit.engines.mujoco.engine import MujocoDynamics

    def broken(*_args, **_kwargs):
        raise RuntimeError("out of order")

    monkeypatch.setattr(MujocoDynamics, "rollout", broken)
    result = study(("pinocchio", "mujoco"), ("rk4", "mujoco_rk4"))
    assert [(r.engine, r.term, r.reason) for r in result.refusals] == [
        ("mujoco", "mujoco_rk4", "RuntimeError: out of order")
    ]
    assert [(c.engine, c.method) for c in result.curves] == [("pinocchio", "rk4"), ("mujoco", "rk4")]


def test_what_there_was_no_time_for_is_said(monkeypatch):
    set_clock(monkeypatch, seconds_per_look=1e-3)
    result = study(["pinocchio"], ["rk4"], steps=[0.1, 1e-6], seconds=0.5)
    coarse, fine = result.curves[0].points
    assert coarse.error < 1e-3
    assert math.isnan(fine.error)
    assert "time allowed was used up" in fine.note
    assert result.complete
    early = study(("pinocchio", "lagrangian"), ["rk853", "rk4"], steps=None, tolerances=None, seconds=1e-3)
    assert early.shortened
    assert early.shortened[0] in repr(early)


def test_a_tolerance_that_no_run_takes_is_said():
    result = study(["pinocchio"], ["dop853", "rk853"], tolerances=[1e-15])
    assert [(r.term, "takes no tolerance below" in r.reason) for r in result.refusals] == [("dop853", True)]
    assert [c.method for c in result.curves] == ["rk853"]


@pytest.mark.parametrize(
    ("more", "error", "message"),
    [
        ({"engines": ()}, InputError, "engines: expected at least one"),
        ({"engines": (1,)}, InputError, "expected names"),
        ({"methods": ()}, InputError, "methods: expected at least one"),
        ({"methods": ("rk5",)}, UnknownNameError, "'rk4'"),
        ({"methods": {"drake": ("rk4",)}}, InputError, "not among the engines"),
        ({"engines": ("pinocchio",), "methods": ("taylor",)}, InputError, "taylor is not on pinocchio"),
        ({"methods": {"pinocchio": ("taylor",)}}, InputError, r"methods\['pinocchio'\]: taylor is not on pinocchio"),
        ({"q0": [0.0], "v0": [0.0], "reference": None}, InputError, "q0, v0: .*something moves"),
        ({"steps": [0.1, -0.1]}, InputError, r"steps\[1\]: expected a number above 0"),
        ({"steps": 0.1}, InputError, "steps: expected several numbers"),
        ({"duration": 0.0}, InputError, "duration: expected a number above 0"),
        ({"q0": [[1.0], [2.0]]}, InputError, "expected one state"),
        ({"torque": [[1.0], [2.0]]}, InputError, r"torque: expected shape \(1,\)"),
        ({"repeats": 0}, InputError, "repeats"),
        ({"seed": -1}, InputError, "seed"),
        ({"seconds": 0.0}, InputError, "seconds"),
        ({"progress": 1}, InputError, "progress"),
        ({"checkpoint": 7}, InputError, "checkpoint: expected a path or a function"),
        ({"checkpoint": "/nowhere/at/all/x.json"}, InputError, "checkpoint: there is no folder"),
        ({"model": "pendulum"}, InputError, "expected a Model"),
    ],
)
def test_misuse_is_explained(more, error, message):
    with pytest.raises(error, match=message):
        work_precision(**{"model": mb.catalog.pendulum(), "repeats": 1, "seconds": 1.0, **more})


# Interruptions


class Stop:
    """A progress function that is Ctrl-C after so many calls."""

    def __init__(self, calls):
        self.left = calls

    def __call__(self, _fraction, _text):
        self.left -= 1
        if not self.left:
            raise KeyboardInterrupt


@pytest.mark.parametrize("calls", [5, 12, 20])
def test_what_was_finished_is_kept_upon_an_interruption(calls, tmp_path, few):
    path = tmp_path / "so_far.json"
    with pytest.raises(KeyboardInterrupt) as stopped:
        study(("pinocchio", "mujoco"), ("rk4", "dop853"), progress=Stop(calls), checkpoint=path)
    part = stopped.value.result
    assert isinstance(stopped.value, InterruptedSweepError)
    assert not part.complete
    assert errors(part).items() <= errors(few).items()
    assert len(errors(part)) < len(errors(few)) or calls > 15
    assert bool(part.curves) == (calls > 5)
    assert WorkPrecision.from_json(path.read_text()).to_json() == part.to_json()
    assert [p.name for p in tmp_path.iterdir()] == ["so_far.json"]
    assert pickle.loads(pickle.dumps(stopped.value)).result.to_json() == part.to_json()


def test_a_checkpoint_gets_results_on_the_way_and_the_last(monkeypatch):
    monkeypatch.setattr("mbkit.studies.study_runs._SECONDS_BETWEEN_RESULTS", 0.0)
    got = []
    result = study(["pinocchio"], ["rk4"], checkpoint=got.append)
    assert [r.complete for r in got] == [False] * (len(got) - 1) + [True]
    assert got[-1] is result
    counts = [len(errors(r)) for r in got]
    assert counts == sorted(counts)
    assert set(counts) == set(range(len(STEPS) + 1))


def test_a_checkpoint_that_fails_loses_no_result(tmp_path):
    folder = tmp_path / "taken.json"
    folder.mkdir()
    for checkpoint, said in ((folder, "cannot write"), (lambda _: {}["x"], "checkpoint: the function raised KeyError")):
        with pytest.warns(MbkitWarning, match=f"{said}.*the study goes on"):
            assert study(["pinocchio"], ["rk4"], checkpoint=checkpoint).complete
    assert list(tmp_path.iterdir()) == [folder]
    assert not list(folder.iterdir())


def test_what_was_finished_is_kept_where_progress_fails():
    def stop(fraction, _text):
        if fraction > 0.7:
            raise RuntimeError("enough")

    got = []
    with pytest.raises(RuntimeError, match="enough"):
        study(["pinocchio"], ["rk4"], progress=stop, checkpoint=got.append, repeats=5)
    assert not got[-1].complete
    assert len(errors(got[-1])) == len(STEPS)


def test_progress_is_told_and_grows():
    told = []
    study(["pinocchio"], ["rk4"], progress=lambda fraction, text: told.append((fraction, text)))
    fractions = [f for f, _ in told]
    assert fractions == sorted(fractions)
    assert (fractions[0], fractions[-1]) == (0.0, 1.0)
    assert any("rk4 on pinocchio" in text for _, text in told)


# Executors


def spawning(workers):
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))


@pytest.mark.thorough("processes")
@pytest.mark.parametrize("make", [lambda: ThreadPoolExecutor(2), lambda: spawning(2)], ids=["threads", "processes"])
def test_executors_find_the_same_errors(make, few):
    with make() as executor:
        result = study(("pinocchio", "mujoco"), ("rk4", "dop853"), executor=executor, seconds=1e4)
    assert errors(result) == errors(few)
    assert [c.order for c in result.curves] == pytest.approx([c.order for c in few.curves], nan_ok=True)
    assert result.settings["executor"] == type(executor).__name__
    assert "share the cores" in result.settings["timing"]


def die_elsewhere(_t, _q, _v):
    """A torque that ends any process but the first."""
    if multiprocessing.parent_process() is not None:
        os._exit(1)
    return [0.0]


@pytest.mark.thorough
def test_threads_leave_warnings_and_caches_as_they_were():
    filters = list(warnings.filters)
    with ThreadPoolExecutor(4) as pool:
        study(["lagrangian", "mujoco"], ["rk4", "dop853", "gauss4", "taylor"], executor=pool)
    assert warnings.filters == filters


def test_overlapping_first_runs_leave_heyokas_cache_as_it_was():
    heyoka = pytest.importorskip("heyoka")
    state = heyoka.llvm_state
    if not hasattr(state, "set_diskcache_enabled"):
        pytest.skip("this heyoka has no cache on disk")
    before = state.get_diskcache_enabled()
    first, second = _without_heyoka_cache(), _without_heyoka_cache()
    for step in (first.__enter__, second.__enter__, lambda: first.__exit__(None, None, None)):
        step()
        assert not state.get_diskcache_enabled()
    second.__exit__(None, None, None)
    assert state.get_diskcache_enabled() == before


def test_a_worker_that_dies_is_told():
    with spawning(1) as executor:
        result = study(["pinocchio"], ["rk4"], torque=die_elsewhere, executor=executor)
    assert not result.curves
    assert [(r.engine, r.term) for r in result.refusals] == [("pinocchio", "rk4")]
    assert "ended without an answer" in result.refusals[0].reason


def test_an_executor_that_is_shut_down_and_a_torque_that_cannot_be_sent_are_told():
    executor = ThreadPoolExecutor(1)
    executor.shutdown()
    result = study(["pinocchio"], ["rk4"], executor=executor)
    assert "takes no more calls" in result.refusals[0].reason
    with spawning(1) as executor, pytest.raises(InputError, match="cannot be sent to other processes"):
        study(["pinocchio"], ["rk4"], torque=lambda *_: [0.0], executor=executor)


def test_an_interruption_cancels_what_has_not_begun():
    with ThreadPoolExecutor(1) as executor, pytest.raises(InterruptedSweepError) as stopped:
        study(("pinocchio", "mujoco"), ("rk4", "dop853"), executor=executor, progress=Stop(3))
    # The reference, the start of the sweep, the first curve.
    assert len(stopped.value.result.curves) == 1


# The order, and the front


def test_the_order_is_taken_between_coarse_steps_and_rounding():
    h = 0.1 / 2.0 ** np.arange(12)
    clean = 1e-2 * h**4
    e = clean + 1e-14
    e[:2] = [0.5, 0.4]
    found = observed_order(h, e, floor=1e-15, motion=1.0)
    assert found.order == pytest.approx(4, abs=0.05)
    # 1e-12 is a hundred times the rounding: h up to 0.1 / 2^4 are above it.
    assert found.points == 3
    assert math.isnan(observed_order(h, np.full(12, np.nan), floor=0, motion=1).order)
    assert observed_order(h[:2], clean[:2], floor=0, motion=1.0).points == 0
    assert observed_order(h[::-1], clean[::-1], floor=0, motion=1.0).order == pytest.approx(4)


def test_what_is_asymptotic_is_what_the_page_says():
    """Errors from 100 floors to 3 % of the motion, and slopes within 0.3 of each other, no more and no fewer."""
    h = 0.1 / 2.0 ** np.arange(8)
    # Errors 2^-4 apart: the least is 150 floors, the next below it would be 9.
    e = 0.02 * 16.0 ** -np.arange(8.0)
    assert observed_order(h, e, floor=e[-1] / 150, motion=1.0).points == 8
    assert observed_order(h, e, floor=e[-1] / 80, motion=1.0).points == 7
    # Of a motion of 0.5 m an error of 0.02 is more than 3 %, and one of 0.125 is of another order.
    assert observed_order(h, e, floor=0.0, motion=0.5).points == 7
    assert observed_order(h, e * np.where(h == h[0], 5, 1), floor=0.0, motion=1.0) == pytest.approx((4, 7))
    # Every other step has a larger error: slopes differ by twice log2 of the factor.
    for factor, points in ((1.08, 8), (1.3, 0)):
        found = observed_order(h, e * np.where(np.arange(8) % 2, factor, 1.0), floor=0.0, motion=1.0)
        assert found.points == points, factor


@pytest.mark.parametrize(
    ("errors", "steps", "ends"),
    [
        # Two settings at rounding end a grid, and one does not.
        ((1e-8, 0.9e-8, 1.1e-8), (100, 200, 400), True),
        ((1e-8, 0.9e-8), (100, 200), False),
        # Settings that hardly add a step tell nothing.
        ((1e-8, 0.9e-8, 1.1e-8), (100, 105, 110), False),
        # Errors of 3e-7 are at rounding; those of 3e-6 may still fall, unless they are all the same within 1 %.
        ((3e-7, 3.3e-7, 2.9e-7), (100, 200, 400), True),
        ((3e-6, 4e-6, 2.9e-6), (100, 200, 400), False),
        ((1e-3, 1.004e-3, 0.999e-3), (100, 200, 400), True),
        ((1e-3, 1.05e-3, 0.98e-3), (100, 200, 400), False),
        # Below the reference's floor nothing is told, whatever the steps.
        ((1e-9, 0.9e-13, 0.8e-13), (100, 101, 102), True),
        ((1e-9, 1e-10, 1e-11), (100, 200, 400), False),
        ((math.nan,), (0,), False),
    ],
)
def test_a_grid_ends_where_the_last_settings_gain_nothing(errors, steps, ends):
    cells = [Measurement(0.1 / 2**k, error=e, steps=n) for k, (e, n) in enumerate(zip(errors, steps, strict=True))]
    assert gains_nothing(cells, 1e-13) is ends


@pytest.mark.parametrize(("factor", "turned"), [(0.9, False), (1.3, False), (1.7, True), (5.0, True)])
def test_rounding_that_grows_by_half_turns_a_curve(factor, turned):
    points = tuple(
        Measurement(h, error=e, setting="dt") for h, e in ((0.1, 1e-3), (0.05, 1e-6), (0.025, factor * 1e-6))
    )
    curve = Curve("newton", "rk4", points, 4.0, 3, 4.0, 0.0)
    assert curve.turn == (points[1] if turned else None)
    assert dataclasses.replace(curve, points=points[:2]).turn is None
    by_tolerance = tuple(dataclasses.replace(p, setting="rtol") for p in points)
    assert dataclasses.replace(curve, points=by_tolerance).turn is None


@given(order=st.integers(1, 8), size=st.floats(1e-6, 1e-2), lost=st.integers(0, 4))
def test_a_pure_power_shows_itself_whatever_is_missing(order, size, lost):
    h = 0.1 / 2.0 ** np.arange(8)
    e = size * (h / h[0]) ** order
    e[:lost] = np.nan
    found = observed_order(h, e, floor=0.0, motion=1.0)
    assert found.points >= 3
    assert found.order == pytest.approx(order, abs=1e-6)


@given(st.lists(st.integers(1, 10_000), min_size=0, max_size=20), st.integers(1, 9), st.floats(0, 1e4))
def test_repetitions_fit_into_the_time_there_is(milliseconds, most, budget):
    seconds = [m / 1000 for m in milliseconds]
    counts = repetitions(seconds, most, budget)
    assert all(0 <= c <= most for c in counts)
    assert sum(c * s for c, s in zip(counts, seconds, strict=True)) <= budget * (1 + 1e-6)


NUMBERS = st.one_of(st.just(math.nan), st.floats(1e-18, 1e3))
THREE = st.tuples(NUMBERS, NUMBERS, NUMBERS)


@st.composite
def results(draw):
    curves = []
    for k in range(draw(st.integers(0, 4))):
        points = tuple(
            Measurement(0.1 / (i + 1), "finished", *draw(THREE), i, (), "é\n,", 0.0, "dt", 4 * i, math.nan, 1)
            for i in range(draw(st.integers(0, 5)))
        )
        curves.append(Curve("mujoco", f"mujoco_{k}", points, draw(NUMBERS), 3, 4.0, draw(NUMBERS)))
    floor = draw(st.sampled_from([0.0, 1e-14, 1e-6]))
    return WorkPrecision(
        "m", {"nq": 1}, 1.0, 1.0, "r", floor, (0.5,), (0.0,), tuple(curves), (), True, {"mbkit": "0"}, "cpu", 1.0
    )


@given(results())
def test_the_front_is_a_pareto_front(result):
    floor = result.floor
    known = [(c, p) for c, p in result.rows() if not math.isnan(p.error) and not math.isnan(p.seconds)]
    front = result.front
    assert bool(front) == bool(known)
    for (_, a), (_, b) in itertools.pairwise(front):
        assert a.seconds <= b.seconds
        assert max(a.error, floor) > max(b.error, floor)
    for _, p in known:
        # Something on the front is at least as good in both.
        assert any(f.seconds <= p.seconds and max(f.error, floor) <= max(p.error, floor) for _, f in front)
    for _, f in front:
        own = f.seconds, max(f.error, floor)
        others = [(p.seconds, max(p.error, floor)) for _, p in known]
        assert not any(a <= own[0] and b <= own[1] and (a, b) != own for a, b in others)


@given(results())
def test_results_survive_json_and_csv(result):
    again = WorkPrecision.from_json(result.to_json())
    assert again.to_json() == result.to_json()
    assert again.to_csv() == result.to_csv()
    assert pickle.loads(pickle.dumps(result)).to_json() == result.to_json()
    rows = list(csv.DictReader(io.StringIO(result.to_csv())))
    assert len(rows) == len(list(result.rows()))
    for row, (curve, point) in zip(rows, result.rows(), strict=True):
        said = tuple(map(csv_text, (curve.engine, curve.method, point.note)))
        assert (row["engine"], row["method"], row["note"]) == said
        assert row["error"] == ("" if math.isnan(point.error) else repr(point.error))
    assert sum(int(r["front"]) for r in rows) == len(result.front)


@pytest.mark.parametrize("error", [math.nan, 20.0])
def test_a_result_without_a_useful_point_has_a_figure_too(error, few):
    curve = dataclasses.replace(few.curves[0], points=(dataclasses.replace(few.curves[0].points[0], error=error),))
    result = dataclasses.replace(few, curves=(curve,))
    result.plot().canvas.draw()
    assert result.to_markdown()
    assert result._repr_html_()


def test_a_result_reads_well(few, tmp_path):
    text = few.to_markdown()
    assert "| pinocchio | rk4 | 4.0" in text
    assert "| error ≤ | engine | method |" in text
    assert json.loads(few.to_json(tmp_path / "r.json")) == json.loads((tmp_path / "r.json").read_text())
    few.to_csv(tmp_path / "r.csv")
    assert (tmp_path / "r.csv").read_text() == few.to_csv()
    assert "on the front" in few._repr_html_()
    c, p = few.fastest(1e-6)
    assert p.error <= 1e-6
    assert c.reach(1e-6) == p
    assert few.fastest(1e-30) is None
    assert len({c.name for c in study(["mujoco"], ["rk4", "mujoco_rk4"], steps=[0.1]).curves}) == 2


def test_steps_divide_the_saved_intervals_and_get_finer():
    (plan,) = plans({"pinocchio": ["rk4"]}, 0.1, [0.1, 0.05], None)
    assert plan.required
    assert plan.values == pytest.approx((0.1, 0.05))
    (own,) = plans({"pinocchio": ["rk4"]}, 0.1, None, None)
    assert own.values[0] == 0.05
    for a, b in itertools.pairwise(own.values):
        assert (0.1 / b) == pytest.approx(round(0.1 / b))
        assert b < a
