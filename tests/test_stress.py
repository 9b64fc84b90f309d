"""Where methods break: a crash, an endless loop and a want of memory are results, and nothing finished is lost."""

from __future__ import annotations

import csv
import io
import json
import math
import multiprocessing
import os
import pickle
import subprocess
import sys
import textwrap
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import mbkit as mb
from mbkit._child_process import WorkerDiedError, WorkerTimeoutError
from mbkit.cli import cli
from mbkit.errors import InputError, UnknownNameError
from mbkit.studies import InterruptedSweepError, StressResult
from mbkit.studies.stress import Case, CaseResult, Measurement, Problem, Row, stress
from mbkit.studies.stress.case import problem_of
from mbkit.studies.stress.measurements import (
    Limits,
    Prepared,
    condition,
    measure,
    prepare,
    reference_motion,
)
from mbkit.studies.stress.study import CaseSweep
from mbkit.studies.study_runs import OUT_OF_TIME
from tests import stress_cases as own

METHODS = ("rk4", *own.ENDS)


def spawning(workers: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))


@pytest.fixture(scope="module")
def told() -> list[tuple[float, str]]:
    """What the progress function was told."""
    return []


@pytest.fixture(scope="module")
def study(told, tmp_path_factory) -> StressResult:
    """One study in which everything goes wrong that can."""
    kept = tmp_path_factory.mktemp("kept") / "result.json"
    result = stress(
        [own.ENDING, own.FAULTY, own.MASSES, own.GLIDING],
        ["pinocchio"],
        METHODS,
        seconds=1.5,
        memory=2**30,
        budget=300,
        jobs=2,
        progress=lambda done, text: told.append((done, text)),
        checkpoint=kept,
    )
    assert kept.read_text() == result.to_json() + "\n"
    return result


def cells(result: StressResult, case: str, method: str) -> tuple[Measurement, ...]:
    (row,) = (row for row in result.case(case).rows if row.method == method)
    return row.cells


def outcomes(result: StressResult, case: str, method: str) -> list[str]:
    return [cell.outcome(result.case(case).bar) for cell in cells(result, case, method)]


# How runs end


def test_every_end_is_a_result_and_harms_no_other(study):
    found = {method: outcomes(study, "ending", method) for method in METHODS}
    assert found["rk4"] == ["held"] * 3
    # What kills a process, or its time, ends a row; others are asked twice.
    assert found["semi_implicit_euler"][1:] == ["died", "not run"]
    assert found["gauss4"] == ["held", "slow", "not run"]
    assert found["gauss6"] == ["held", "died", "not run"]
    assert found["rk853"][1:] == ["nan", "nan"]
    assert found["dop853"] == ["held", "silent", "silent"]
    assert found["radau"][1:] == ["warned", "warned"]
    assert found["bdf"][1:] == found["lsoda"][1:] == ["refused", "refused"]


def test_each_end_says_why(study):
    note = {method: cells(study, "ending", method)[1].note for method in METHODS}
    assert "SIGABRT" in note["semi_implicit_euler"]
    assert "stopped after" in note["gauss4"]
    assert "more memory than allowed" in note["gauss6"]
    assert "not finite" in note["rk853"]
    assert note["bdf"] == "pinocchio: not this one"
    assert note["lsoda"] == "RuntimeError: from C++"
    assert cells(study, "ending", "radau")[1].warnings == ("this is wrong",)
    assert cells(study, "ending", "gauss4")[2].note == "not run: slow at 2 before"


def test_what_is_held_is_measured(study):
    (cell, *_) = cells(study, "ending", "rk4")
    # RK4's own error over 0.25 s at 1 ms, relative to the swing.
    assert 1e-14 < cell.error < 1e-10
    assert cell.seconds > 0
    assert cell.steps == 250
    # The energy of a swing of 1e-9 rad is beyond what doubles can say.
    assert math.isnan(cell.energy)


def test_a_problem_that_cannot_be_made_is_nobody_elses_loss(study):
    assert outcomes(study, "faulty", "rk4")[:4] == ["held", "died", "refused", "refused"]
    notes = [cell.note for cell in cells(study, "faulty", "rk4")]
    assert "SIGABRT, making the problem" in notes[1]
    assert notes[2] == "ZeroDivisionError: no such problem"
    assert "expected make to return a Problem, got NoneType" in notes[3]
    assert study.case("faulty").truths[1] == notes[1]


def test_a_truth_that_is_not_good_enough_judges_nobody(study):
    # Known to half of the motion: no error below it means anything.
    assert outcomes(study, "faulty", "rk4")[4] == "unjudged"
    assert cells(study, "faulty", "rk4")[4].floor == pytest.approx(0.5)
    told = study.case("faulty").truths
    assert "known to 5.0e-10" in told[4]
    assert "it is of another motion" in told[5]
    # A right energy does not speak for a motion, and a wrong one speaks against it.
    assert outcomes(study, "faulty", "rk4")[5] == "unjudged"
    assert outcomes(study, "faulty", "dop853")[5] == "unjudged"
    assert outcomes(study, "faulty", "semi_implicit_euler")[5] == "inaccurate"
    for cell in (cells(study, "faulty", m)[5] for m in ("rk4", "semi_implicit_euler")):
        assert math.isnan(cell.error)
        assert math.isfinite(cell.energy)


def test_terms_are_measured_against_34_digits(study):
    case = study.case("masses")
    assert [row.method for row in case.rows] == ["mass_matrix", "inverse_dynamics", "forward_dynamics"]
    assert outcomes(study, "masses", "inverse_dynamics") == ["held", "held"]
    for row in case.rows:
        assert row.cells[0].error < 1e-14
        assert row.cells[0].seconds > 0
    # Pinocchio 4.1.0 adds up inertias as if no mass were below eps.
    assert outcomes(study, "masses", "mass_matrix")[1] == "warned"
    assert "known defect of pinocchio" in study.case("masses").rows[0].cells[1].warnings[0]
    assert case.facts[1]["cond(M)"] == pytest.approx(1e20, rel=1e-3)


def test_a_prescribed_step_is_taken_and_the_energy_is_a_measure(study):
    case = study.case("gliding")
    (row,) = case.rows
    assert (row.method, row.setting, case.bar) == ("rk4", "dt of the case", 1e-11)
    assert [cell.steps for cell in row.cells] == [100, 100]
    assert [cell.outcome(case.bar) for cell in row.cells] == ["held", "inaccurate"]
    assert all(cell.error == cell.energy for cell in row.cells)


def test_progress_never_goes_back(study, told):
    done = [fraction for fraction, _ in told]
    assert done == sorted(done)
    assert done[-1] == 1.0
    assert study.complete
    assert any(text.startswith("ending: ") for _, text in told)


# What is read from a result


def test_the_result_tells_what_breaks(study):
    (broken,) = (b for b in study.breaking() if (b.case, b.method) == ("ending", "dop853"))
    assert (broken.held, broken.failed, broken.how) == (1, 2, "silent")
    assert "error 1.0e+00" in broken.note
    assert {(s.case, s.method) for s in study.silent()} >= {("ending", "dop853")}
    assert [row.method for row in study.best("ending")] == ["rk4"]
    # By a looser bar the prescribed steps all hold.
    assert next(b for b in study.breaking(1.0) if b.case == "gliding").failed is None
    with pytest.raises(UnknownNameError, match="ending"):
        study.case("endin")
    with pytest.raises(InputError, match="bar"):
        study.breaking(-1.0)


def test_nothing_is_lost_on_the_way_to_json_and_back(study):
    again = StressResult.from_json(study.to_json())
    assert again.to_json() == study.to_json()
    assert again.breaking() == study.breaking()
    row = replace(study.case("gliding").rows[0], theory=math.inf)
    boundless = replace(study, cases=(replace(study.case("gliding"), rows=(row,)),))
    assert StressResult.from_json(boundless.to_json()) == boundless
    assert pickle.loads(pickle.dumps(study)).to_json() == study.to_json()
    rows = list(csv.DictReader(io.StringIO(study.to_csv())))
    assert len(rows) == sum(len(row.cells) for _, row in study.rows())
    assert {r["outcome"] for r in rows} >= {"held", "died", "slow", "silent", "nan", "refused", "unjudged"}
    assert "| pinocchio | rk4 | dt 0.001 s | 3 | | |" in study.to_markdown()
    assert "<td>died</td>" in study._repr_html_()
    assert "4 cases" in repr(study)
    # A study that left something out says so first.
    assert study.left_out == ""
    late = Measurement(2.0, "not run", note=OUT_OF_TIME)
    row = replace(study.case("gliding").rows[0], cells=(late,))
    partial = replace(study, cases=(replace(study.case("gliding"), rows=(row,)),))
    assert partial.left_out == "the time allowed was used up: 1 of 1 cells were not run"
    assert partial.to_markdown().startswith(f"**stress**: {partial.left_out}; ")
    assert partial.headline.endswith("nothing was run")
    assert not partial.document().good
    assert replace(partial, complete=False).headline.startswith("interrupted")
    for text in ("{}", "no JSON", '{"cases": [1]}', "[" * 100_000):
        with pytest.raises(InputError, match="StressResult"):
            StressResult.from_json(text)


@pytest.mark.parametrize(("rounding", "known"), [(3e-10, True), (3e-9, False)])
def test_an_energy_that_is_only_rounding_is_no_energy(rounding, known):
    """A mass falls from so high that 16 roundings of m g z are this part of what the energy changes by."""
    b = mb.ModelBuilder("stone")
    b.add_body("stone", mass=1.0)
    b.add_joint("z", "prismatic", parent="world", child="stone", axis=(0.0, 0.0, 1.0))
    model = b.build()
    changed = 9.81**2 / 2
    height = rounding * changed / (16 * np.finfo(float).eps * 9.81)
    problem, dyn = Problem(model, np.array([height]), np.zeros(1)), mb.dynamics(model, "pinocchio")
    times = np.array([0.0, 0.5, 1.0])
    run = mb.simulate(dyn, problem.q, problem.v, 1.0, "rk4", 0.1, save=times)
    cell = problem.measured(0.1, None, times, dyn, run)
    assert (0 <= cell.energy < 1e-9) if known else math.isnan(cell.energy)


def test_outcomes_by_error_floor_and_warning():
    assert Measurement(1.0, "finished", 1e-7).outcome(1e-6) == "held"
    assert Measurement(1.0, "finished", 1e-7, floor=9.5e-7).outcome(1e-6) == "unjudged"
    # Up to a hundredth of the motion it is inaccurate, beyond it wrong.
    assert Measurement(1.0, "finished", 0.005).outcome(1e-6) == "inaccurate"
    assert Measurement(1.0, "finished", 0.02, floor=9.5e-7).outcome(1e-6) == "silent"
    assert Measurement(1.0, "finished", 0.5, warnings=("beware",)).outcome(1e-6) == "warned"
    assert Measurement(1.0, "finished").outcome(1e-6) == "unjudged"
    assert Measurement(1.0, "finished", energy=1e-9).outcome(1e-6) == "unjudged"
    assert Measurement(1.0, "finished", energy=0.5).outcome(1e-6) == "silent"
    row = Row(
        "pinocchio", "rk4", (Measurement(1.0, "finished", 0.0), Measurement(2.0, "not run"), Measurement(3.0, "died"))
    )
    assert (row.breaking(1e-6).held, row.breaking(1e-6).failed, row.reach(1e-6)) == (1.0, None, 1)


# What is asked next


class FakeWorker:
    """Answers as told: by (stage "case" or method, value), a result, or the stage and the exception."""

    def __init__(self, answers=()):
        self.answers, self.stage, self.generation, self._runs = dict(answers), "", 0, False

    def end(self):
        self._runs = False

    def call(self, function, _case, value, *args, **_limits):
        self.generation, self._runs = self.generation + (not self._runs), True
        key = "case" if function is prepare else args[1]
        default = Prepared("known") if key == "case" else Measurement(value, "finished", 0.0)
        found = self.answers.get((key, value), default)
        self.stage = "run" if function is measure else ""
        if isinstance(found, tuple):
            self.stage, error, *later = found
            if later and self.generation > 1:
                return later[0]
            self._runs = False
            raise error
        return found


def fake_sweep(values, methods, deadline=math.inf) -> tuple[CaseSweep, list[float]]:
    """A sweep, and the time on its clock."""
    now = [0.0]
    case = Case("fake", "None.", "step", "x", "", values, (), own.swing)
    rows = [("pinocchio", m) for m in methods]
    return CaseSweep(case, values, rows, 1e-6, Limits(1.0, 1e-3, 1e-8), str, deadline, lambda: now[0]), now


def swept(answers, values=(1, 2, 3, 4), methods=("rk4", "rk853")) -> CaseResult:
    """A case whose worker answers as told."""
    sweep, _ = fake_sweep(values, methods)
    worker = FakeWorker(answers)
    assert sweep.prepare(worker, 10.0)
    assert sweep.run("pinocchio", worker, 10.0)
    assert sweep.done == sweep.size
    return sweep.result()


def ends(result: CaseResult) -> dict[str, list[str]]:
    return {row.method: [cell.end for cell in row.cells] for row in result.rows}


def test_a_row_ends_where_more_would_only_cost():
    found = ends(swept({("rk4", 2): ("run", WorkerTimeoutError(1.0)), ("rk853", 1): Measurement(1, "diverged")}))
    assert found["rk4"] == ["finished", "slow", "not run", "not run"]
    assert found["rk853"] == ["diverged", "finished", "finished", "finished"]
    twice = {("rk4", 1): Measurement(1, "refused"), ("rk4", 2): Measurement(2, "diverged")}
    assert ends(swept(twice))["rk4"] == ["refused", "diverged", "not run", "not run"]


def test_a_call_that_ran_out_of_memory_in_an_old_process_is_made_in_a_new_one():
    """Its outcome does not hang on what was measured before it."""
    for error in (MemoryError(), WorkerDiedError("killed")):
        found = swept({("rk4", 2): ("engine", error, Measurement(2, "finished", 0.0))})
        assert ends(found)["rk4"] == ["finished"] * 4


def test_an_engine_that_cannot_be_made_is_asked_once():
    found = swept({("rk4", 2): ("engine", WorkerDiedError("crash"))})
    assert ends(found)["rk4"] == ends(found)["rk853"] == ["finished", "died", "not run", "not run"]


def test_a_problem_that_takes_for_ever_is_asked_once():
    found = swept({("case", 2): ("", WorkerTimeoutError(1.0))})
    assert ends(found)["rk4"] == ends(found)["rk853"] == ["finished", "slow", "finished", "finished"]


def test_when_the_time_is_used_up_it_says_so_and_goes_on_with_more():
    sweep, now = fake_sweep((1,), ("rk4",), deadline=10.0)
    # Not before the truth is there.
    assert not sweep.run("pinocchio", FakeWorker(), 10.0)
    assert sweep.prepare(FakeWorker(), 10.0)
    now[0] = 5.0
    assert not sweep.run("pinocchio", FakeWorker(), 5.0)
    assert sweep.result().rows[0].cells[0].note == OUT_OF_TIME
    assert sweep.run("pinocchio", FakeWorker(), 10.0)
    assert sweep.result().rows[0].reach(1e-6) == 1


def test_a_cell_that_is_stopped_by_the_end_of_the_study_is_not_slow():
    sweep, now = fake_sweep((1,), ("rk4",), deadline=10.0)
    assert sweep.prepare(FakeWorker(), 10.0)

    class Late(FakeWorker):
        def call(self, *args, **limits):
            now[0] = 10.0
            return super().call(*args, **limits)

    assert sweep.run("pinocchio", Late({("rk4", 1): ("run", WorkerTimeoutError(1.0))}), 10.0)
    cell = sweep.result().rows[0].cells[0]
    assert (cell.end, cell.note) == ("not run", OUT_OF_TIME)


# Truths


def test_two_runs_that_agree_are_a_truth_and_where_none_do_there_is_none(monkeypatch):
    problem, times = own.sprung(100.0), np.linspace(0, 0.5, 11)
    truth, told = reference_motion(problem, times, 1e-7, 5.0)
    assert truth.floor < 1e-10
    assert "rk853 on lagrangian" in told
    # At 50 µs its own error is 1e-13.
    other = mb.simulate(mb.dynamics(problem.model, "mujoco"), problem.q, problem.v, 0.5, "mujoco_rk4", 5e-5, save=times)
    assert np.abs(truth.q - other.q).max() < 1e-12
    # 1e5 swings cannot be followed in the time, and series would take longer to compile than is left.
    series = []
    search = import_module("mbkit.studies.reference_motions")
    monkeypatch.setattr(search, "taylor_pair", lambda *x: series.append(x))
    truth, told = reference_motion(own.sprung(1e12), times, 1e-7, 0.5)
    assert truth is None
    assert told.startswith("no truth: ")
    assert not series


def test_a_stiff_motion_is_known_by_methods_for_it():
    """x of ẍ + c ẋ + k x = 0 from rest, whose rates of 1 and 2e7 per second no explicit method can follow."""
    k = c = 2e7
    b = mb.ModelBuilder("cart", gravity=(0, 0, 0))
    b.add_body("cart", mass=1.0)
    b.add_joint("x", "prismatic", parent="world", child="cart", axis=(1, 0, 0), stiffness=k, damping=c)
    times = np.linspace(0, 0.5, 11)
    problem = Problem(b.build(), np.ones(1), np.zeros(1), duration=0.5)
    truth, told = reference_motion(problem, times, 1e-7, 10.0)
    fast = (c + math.sqrt(c * c - 4 * k)) / 2
    slow = k / fast
    exact = (fast * np.exp(-slow * times) - slow * np.exp(-fast * times)) / (fast - slow)
    assert np.abs(truth.q[:, 0] - exact).max() <= truth.floor < 1e-10
    assert told.startswith("rodas5 on lagrangian and radau on pinocchio")


@pytest.mark.parametrize("tau", [[2.0], lambda _t, _q, _v: [2.0]], ids=["constant", "function"])
def test_a_force_of_the_problem_acts_along_its_runs(tau):
    b = mb.ModelBuilder("cart", gravity=(0, 0, 0))
    b.add_body("cart", mass=1.0)
    b.add_joint("x", "prismatic", parent="world", child="cart", axis=(1, 0, 0))

    def pushed(value):
        return Problem(b.build(), np.zeros(1), np.zeros(1), tau, duration=value, exact=lambda t: t[:, None] ** 2)

    case = replace(own.GLIDING, name="pushed", make=pushed, measure="motion")
    known = prepare(case, 1.0, 1e-6, 1.0)
    cell = measure(case, 1.0, "pinocchio", "rk4", Limits(5.0, 1e-2, 1e-8), known.truth)
    assert cell.error < 1e-14
    # Its work is not known well enough.
    assert math.isnan(cell.energy)
    searched, _ = reference_motion(replace(pushed(1.0), exact=None), known.truth.times, 1e-7, 10.0)
    assert np.abs(searched.q - known.truth.q).max() < 1e-12
    with pytest.raises(InputError, match="tau"):
        problem_of(replace(case, make=lambda value: replace(pushed(value), tau=np.ones(2))), 1.0)


def test_an_engines_own_run_that_would_take_too_long_is_not_begun():
    """It does not stop when it is asked to: 1e8 steps take a minute."""
    case = replace(own.GLIDING, make=lambda value: own.gliding(value / 100), methods=("mujoco_rk4",))

    def long(value):
        return replace(own.gliding(value), duration=1e8 * value)

    cell = measure(replace(case, make=long), 1e-7, "mujoco", "mujoco_rk4", Limits(0.5, 1e-3, 1e-8), None)
    assert cell.end == "slow"
    assert "100000000 steps would take" in cell.note
    assert math.isnan(cell.seconds)


def test_conditions_beyond_double_are_known():
    oracle = mb.dynamics(mb.catalog.double_pendulum(mass2=1e-25), "oracle")
    # Straight: M = [[1 + 4 m, 2 m], [2 m, m]], whose eigenvalues are 1 and m to within m.
    assert condition(oracle, np.zeros(2)) == pytest.approx(1e25, rel=1e-9)
    assert condition(mb.dynamics(mb.catalog.pendulum(), "oracle"), np.zeros((3, 1))) == 1.0


# How it is asked


@pytest.mark.thorough("processes")
@pytest.mark.parametrize("pool", [ThreadPoolExecutor, spawning], ids=["threads", "processes"])
def test_an_executor_finds_the_same_errors(pool):
    given = {"engines": ["pinocchio"], "methods": ["rk4"], "values": (1e-3, 1e-2)}
    told = []
    with pool(1) as executor:
        result = stress(own.GLIDING, **given, executor=executor, progress=lambda *x: told.append(x))
    alone = stress(own.GLIDING, **given, jobs=1)
    assert [c.error for c in cells(result, "gliding", "rk4")] == [c.error for c in cells(alone, "gliding", "rk4")]
    assert result.case("gliding").truths == alone.case("gliding").truths
    assert (result.settings["executor"], result.settings["jobs"]) == (type(executor).__name__, None)
    assert told == [(1.0, "gliding"), (1.0, "done")]
    # It was shut down above.
    late = stress(own.GLIDING, **given, executor=executor)
    assert {c.end for c in cells(late, "gliding", "rk4")} == {"not run"}
    assert "the executor takes no more calls" in cells(late, "gliding", "rk4")[0].note


def test_ctrl_c_keeps_what_was_finished(tmp_path):
    def interrupt(done, _text):
        if done > 0.4:
            raise KeyboardInterrupt

    path = tmp_path / "kept.json"
    with pytest.raises(InterruptedSweepError) as caught:
        stress(own.GLIDING, ["pinocchio"], values=(1e-3, 1e-2, 1e1), progress=interrupt, checkpoint=path, jobs=1)
    result = caught.value.result
    assert result.cases[0].facts[0]["cond(M)"] > 1
    # Where it was quicker than the next look, the interruption came when all was done.
    assert json.loads(path.read_text())["complete"] is result.complete
    assert ("interrupted" in result.to_markdown()) is not result.complete


@pytest.mark.thorough
def test_a_case_of_a_script_is_found_there(tmp_path):
    script = tmp_path / "mine.py"
    script.write_text(
        textwrap.dedent("""
        import numpy as np, mbkit as mb
        from mbkit.studies.stress import Case, Problem

        def make(value):
            return Problem(mb.catalog.pendulum(), np.ones((1, 1)), np.ones((1, 1)) * value)

        case = Case("mine", "My own.", "spin", "speed", "rad/s", (1.0,), (), make, "terms")
        if __name__ == "__main__":
            print(mb.stress(case, ["pinocchio"], jobs=1))
        """)
    )
    there = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=120, check=False, env=there)
    assert done.stdout.strip() == "<StressResult of 1 case: 3 held>", done.stderr


def bad(match, *args, **more):
    with pytest.raises((InputError, UnknownNameError), match=match):
        stress(*args, **more)


def test_bad_input_is_named_before_anything_starts():
    bad("expected names or Case objects, got 3", [3])
    bad("there twice", [own.GLIDING, own.GLIDING])
    bad("at least one", [])
    bad("engine", own.GLIDING, ["nosuch"])
    bad("oracle", own.GLIDING, ["oracle"])
    bad("method", own.GLIDING, methods=["nosuch"])
    bad("values: expected different numbers", own.GLIDING, values=[1.0, 1.0])
    bad("values", own.GLIDING, values=[math.nan])
    bad("not among the cases: gliding", own.GLIDING, values={"other": [1.0]})
    bad("quick", own.GLIDING, quick=1)
    bad("memory", own.GLIDING, memory=1000)
    for name in ("dt", "rtol", "bar", "seconds", "budget"):
        bad(name, own.GLIDING, **{name: -1.0})
    bad("jobs", own.GLIDING, jobs=0)
    bad("executor: expected a concurrent.futures.Executor, got int", own.GLIDING, executor=4)
    bad("jobs: expected none beside an executor", own.GLIDING, jobs=1, executor=ThreadPoolExecutor(1))
    bad("cannot be sent to other processes", replace(own.GLIDING, make=lambda _: None))


# The command


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A working folder of the test's own."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def call(*arguments):
    return CliRunner().invoke(cli, ["stress", *arguments])


def test_the_command_prints_and_writes(study, here, monkeypatch):
    asked = {}
    monkeypatch.setattr(
        import_module("mbkit.studies.stress.study"), "stress", lambda *a, **k: asked.update(k, a=a) or study
    )
    result = call("joint_spring", "chain", "--quick", "--methods", "rk4", "--bar", "1e-3", "--budget", "50")
    assert result.exit_code == 0, result.output
    assert asked.pop("a") == (("joint_spring", "chain"), ("lagrangian", "pinocchio", "mujoco"), ("rk4",))
    assert (asked["quick"], asked["bar"], asked["budget"]) == (True, 1e-3, 50.0)
    folder = here / "mbkit-report"
    assert {p.name for p in folder.iterdir()} == {"stress.html", "stress.json", "stress.csv"}
    assert StressResult.from_json((folder / "stress.json").read_text()).breaking() == study.breaking()
    page = (folder / "stress.html").read_text(encoding="utf-8")
    assert 'href="stress.csv"' in page
    assert "<h1>Stiff and extreme" in page
    assert "how to read the tables" in page
    one = replace(study, cases=study.cases[:1], complete=False)

    def stopped(*_: object, **__: object) -> None:
        raise InterruptedSweepError(one)

    monkeypatch.setattr(import_module("mbkit.studies.stress.study"), "stress", stopped)
    result = call("--json", "--out", "out")
    assert result.exit_code == 130
    assert json.loads(result.stdout)["complete"] is False
    assert "interrupted: " in result.stderr
    assert Path("out/stress.html").exists()


@pytest.mark.usefixtures("here")
def test_the_command_lists_the_cases_and_names_near_ones():
    listed = call("--list")
    assert listed.exit_code == 0
    assert "joint_spring" in listed.stdout
    assert json.loads(call("--list", "--json").stdout)[0]["name"] == "joint_spring"
    wrong = call("joint_sprin")
    assert wrong.exit_code == 2
    assert "did you mean 'joint_spring'" in wrong.stderr
    assert call("--engines", "nosuch").exit_code == 2
    assert not list(Path().iterdir())
