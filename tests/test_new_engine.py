"""An engine of one's own (`tests.engine_of_ones_own`) in simulation, studies, tests, figures and worker processes."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from importlib.metadata import EntryPoint

import numpy as np
import pytest
from click.testing import CliRunner

import mbkit as mb
from mbkit.cli import cli
from mbkit.engines import ENGINES, EngineInfo, register_engine, registry
from mbkit.errors import InputError, UnknownNameError, UnsupportedError
from mbkit.testing import assert_engines_agree
from tests.engine_of_ones_own import INFO, ClosedForm

PENDULUM = mb.catalog.pendulum()


@pytest.fixture
def engine():
    """Register the engine for one test."""
    yield register_engine(INFO).name
    ENGINES.pop(INFO.name, None)


def test_it_evaluates_and_simulates(engine):
    dyn = mb.dynamics(PENDULUM, engine)
    assert isinstance(dyn, ClosedForm)
    assert dyn.mass_matrix([0.3]) == pytest.approx(mb.dynamics(PENDULUM, "oracle").mass_matrix([0.3]), rel=1e-15)
    run = mb.simulate(dyn, [0.3], [0.0], 1.0, method="dop853")
    other = mb.simulate(mb.dynamics(PENDULUM, "lagrangian"), [0.3], [0.0], 1.0, method="dop853")
    assert run.engine == engine
    assert run.q[-1] == pytest.approx(other.q[-1], rel=1e-9)


def test_it_is_compared_and_shown(engine, monkeypatch):
    monkeypatch.setattr(import_module("mbkit.studies.compare.study"), "_MAX_EVALUATIONS", 1_000)
    result = mb.compare(PENDULUM, ("lagrangian", engine), 2)
    assert result.passed
    assert {r.engine for r in result.rows} >= {engine}
    assert any(c.engine == engine and c.method == "rk4" for c in result.precision.curves)
    assert engine in result.to_markdown()
    assert engine in result._repr_html_()
    assert assert_engines_agree(PENDULUM, ("pinocchio", engine), samples=2).passed


def test_a_baseline_of_an_engine_that_nobody_registered_is_skipped(engine, tmp_path):
    path = tmp_path / "pendulum.toml"
    mb.baseline.record(PENDULUM, path, [engine])
    assert mb.baseline.check(PENDULUM, path).status == "same"
    del ENGINES[engine]
    result = mb.baseline.check(PENDULUM, path)
    assert result.status == "skipped"
    assert "not registered" in result.skipped[0].reason


def test_a_wrong_value_is_seen(engine, monkeypatch):
    monkeypatch.setattr(ClosedForm, "_mass_matrix", lambda self, q: np.full((*q.shape[:-1], 1, 1), 2 * self._inertia))
    with pytest.raises(AssertionError, match=rf"M, {engine}: differs"):
        assert_engines_agree(PENDULUM, ("pinocchio", engine), samples=2)


def test_it_is_measured_and_drawn(engine):
    result = mb.work_precision(PENDULUM, [engine], ["rk4"], steps=[0.02, 0.01, 0.005], repeats=1, duration=0.2)
    assert [c.engine for c in result.curves] == [engine]
    result.plot()


@pytest.mark.thorough
def test_it_breaks_like_others_in_a_worker_process(engine):
    result = mb.stress("joint_spring", [engine], ["rk4"], values=[1.0], jobs=1)
    (row,) = result.cases[0].rows
    assert row.engine == engine
    (cell,) = row.cells
    assert cell.end == "finished"
    assert cell.error < 1e-9


def test_it_is_recorded_in_a_baseline(engine, tmp_path):
    path = tmp_path / "pendulum.toml"
    mb.baseline.record(PENDULUM, path, [engine])
    assert mb.baseline.check(PENDULUM, path).passed
    del ENGINES[engine]
    result = mb.baseline.check(PENDULUM, path)
    assert not result.passed
    assert engine in result.text("")


def test_what_it_cannot_hold_is_refused_by_name(engine):
    with pytest.raises(UnsupportedError, match="closed_form: double_pendulum is no pendulum"):
        mb.dynamics(mb.catalog.double_pendulum(), engine)


@pytest.mark.thorough
def test_the_command_knows_it_by_its_entry_point(monkeypatch):
    point = EntryPoint(INFO.name, "tests.engine_of_ones_own:INFO", registry.ENTRY_POINTS)
    monkeypatch.setattr(registry, "entry_points", lambda group: [point] if group == registry.ENTRY_POINTS else [])
    registry.load_entry_points.cache_clear()
    try:
        done = CliRunner().invoke(cli, ["check", "pendulum", "--engines", f"lagrangian,{INFO.name}", "--no-rollouts"])
        assert done.exit_code == 0, done.output
        assert INFO.name in done.output
    finally:
        ENGINES.pop(INFO.name, None)
        registry.load_entry_points.cache_clear()


def test_names_of_no_engine_are_refused():
    with pytest.raises(UnknownNameError, match="closed_form"):
        mb.dynamics(PENDULUM, "closed_form")


@pytest.mark.parametrize(
    ("info", "reason"),
    [
        (ClosedForm, "expected an EngineInfo"),
        (replace(INFO, name="closed form"), "expected a word"),
        (replace(INFO, name="other"), "closed_form'; expected the same name"),
        (replace(INFO, name="pinocchio", adapter=type("P", (ClosedForm,), {"engine": "pinocchio"})), "name is in use"),
        (replace(INFO, adapter=None), "expected an adapter"),
        (replace(INFO, adapter=int), "expected a subclass of Dynamics"),
        (replace(INFO, reference=True), "reference and derived"),
    ],
)
def test_what_is_no_engine_is_refused(info, reason):
    with pytest.raises(InputError, match=reason):
        register_engine(info)
    assert "closed_form" not in ENGINES


def test_a_module_that_is_not_installed_is_said_to_be_so():
    info = register_engine(
        EngineInfo("absent", module="no_such_engine", class_name="Dynamics", package="absent-engine")
    )
    try:
        with pytest.raises(UnsupportedError, match=r"absent is not installed.*pip install absent-engine"):
            mb.dynamics(PENDULUM, info.name)
    finally:
        del ENGINES["absent"]
