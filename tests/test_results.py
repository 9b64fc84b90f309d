"""What all results of studies share: JSON and back, CSV, Markdown and HTML."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import replace

import pytest

from mbkit._escape import html, markdown
from mbkit.errors import InputError, OutputError
from mbkit.studies.baseline.description import Change
from mbkit.studies.baseline.result import BaselineResult, ChangedNumber, VersionChange
from mbkit.studies.compare.result import Comparison
from mbkit.studies.document import Column, Items, Paragraph, Table, block_html, block_markdown, plain, to_html
from mbkit.studies.explain.joint_matching import Match
from mbkit.studies.explain.result import Cause, Explanation
from mbkit.studies.explain.terms import Gap
from mbkit.studies.importers.result import Parsed, ParserComparison, Stage
from mbkit.studies.lint.result import LintFinding, LintResult
from mbkit.studies.results import Refusal, from_plain, to_plain
from tests.test_report import AGREEING, DIFFERING, EMPTY, STUDY
from tests.test_stress_report import RESULT

IMPORTED = ParserComparison(
    source="arm.urdf",
    format="urdf",
    floating_base=False,
    reference="file",
    faults="",
    importers=(
        Parsed("pinocchio", "4.1.0", stages=(Stage("masses", True, 0.0, "", ""), Stage("M", False, 0.5, "a", "M|"))),
        Parsed("mujoco", "4.0.0", refused="no <mesh>"),
    ),
    notes=("meshes left out",),
    samples=3,
    seed=0,
    tolerance=1e-9,
    versions={"mbkit": "1"},
    processor="x",
    seconds=math.nan,
)
CHECKED = BaselineResult(
    question="check",
    model="arm",
    path="arm.toml",
    status="numbers",
    engines=("pinocchio",),
    changes=(Change("bodies", "a", "mass", 1.0, 2.0, "mass of a: 1 → 2"),),
    moved=(ChangedNumber("M", "pinocchio", "a", "neutral", 1.0, 2.0, 0.5, 1e-15),),
    versions=(VersionChange("pin", "4.0.0", "4.1.0"),),
    processors=("x", "y"),
    skipped=(Refusal("drake", "", "not installed"),),
)
EXPLAINED = Explanation(
    a="one",
    b="other",
    agree=False,
    gaps=(Gap("M", 0.5, "j"),),
    comparable=True,
    matches=(Match("j", "j", "name"),),
    only_a=(),
    only_b=("k",),
    causes=(Cause("mass", "body", "other has mass 2 for 1", 1.0, 2.0, {"M": 0.5}, acts=True),),
    notes=("frames",),
    explained=True,
    left=(),
    subtree=(),
    samples=3,
    seed=0,
    tolerance=1e-9,
)
RESULTS = {
    "explained": EXPLAINED,
    "agreeing": AGREEING,
    "differing": DIFFERING,
    "empty": EMPTY,
    "importers": IMPORTED,
    "baseline": CHECKED,
}


@pytest.mark.parametrize("name", [*RESULTS, "study", "stress"])
def test_json_holds_all_of_a_result(name, tmp_path):
    result = {**RESULTS, "study": STUDY, "stress": RESULT}[name]
    text = result.to_json(tmp_path / "r.json")
    again = type(result).from_json((tmp_path / "r.json").read_text())
    assert again.to_json() == text
    assert repr(again) == repr(result)
    assert again.to_markdown() == result.to_markdown()


def test_infinite_numbers_come_back_from_json_and_old_files_stay_readable():
    shown = replace(AGREEING.rollouts[0], tolerance=math.inf, condition=math.nan)
    study = replace(AGREEING, rollouts=(*AGREEING.rollouts, shown))
    text = study.to_json()
    again = Comparison.from_json(text).rollouts[-1]
    assert again.tolerance == math.inf
    assert math.isnan(again.condition)
    apart = replace(EXPLAINED, causes=(replace(EXPLAINED.causes[0], effects={"M": math.inf, "g": 0.5}),))
    assert Explanation.from_json(apart.to_json()) == apart
    old = json.loads(text)
    del old["infinite"]
    assert old["rollouts"][-1]["tolerance"] is None
    assert math.isnan(Comparison.from_json(json.dumps(old)).rollouts[-1].tolerance)
    assert "infinite" not in json.loads(EXPLAINED.to_json())


@pytest.mark.parametrize("text", ["", "[]", "3", "{}", '{"model": 1}', "[" * 100_000])
def test_json_of_something_else_is_refused(text):
    with pytest.raises(InputError, match="Comparison"):
        type(AGREEING).from_json(text)


@pytest.mark.parametrize("name", RESULTS)
def test_csv_has_a_line_for_each_row_and_all_digits(name, tmp_path):
    result = RESULTS[name]
    text = result.to_csv(tmp_path / "r.csv")
    assert (tmp_path / "r.csv").read_text() == text
    rows = list(csv.DictReader(io.StringIO(text)))
    table = {"explained": EXPLAINED.causes, "importers": IMPORTED.importers[0].stages, "baseline": CHECKED.moved}.get(
        name
    )
    wanted = list(getattr(result, "rows", table))
    assert len(rows) == len(wanted)
    for row, of in zip(rows, wanted, strict=True):
        for field in ("relative", "worst", "error"):
            if field in row:
                x = getattr(of, field)
                assert float(row[field]) == x if not math.isnan(x) else row[field] == ""


def test_nothing_is_lost_where_a_file_cannot_be_written(tmp_path):
    for write in (AGREEING.to_json, AGREEING.to_csv):
        with pytest.raises(OutputError, match="missing"):
            write(tmp_path / "missing" / "r")


def test_markdown_and_html_escape_texts_and_write_numbers_as_asked():
    table = Table((Column("a|b", lambda r: r[0]), Column("x", lambda r: f"{r[1]:.1e}", right=True)), [("<b>|", 0.5)])
    assert block_markdown(table) == "| a\\|b | x |\n|---|---:|\n| &lt;b&gt;\\| | 5.0e-01 |"
    assert (
        block_html(table)
        == "<table><tr><th>a|b</th><th>x</th></tr><tr><td>&lt;b&gt;|</td><td>5.0e-01</td></tr></table>"
    )
    for result in RESULTS.values():
        assert "<mesh>" not in result._repr_html_() + result.to_markdown()


def test_markdown_has_every_difference_and_a_terminal_the_gravest():
    changes = tuple(replace(CHECKED.changes[0], text=f"change {k}") for k in range(30))
    moved = tuple(replace(CHECKED.moved[0], term=f"term {k}", error=1.0 / (k + 1)) for k in range(9))
    many = replace(CHECKED, changes=changes, moved=moved)
    for shown, (described, numbers) in ((many.to_markdown(), (30, 9)), (to_html(many.document(full=False)), (20, 8))):
        assert (shown.count("description: change"), shown.count("off by")) == (described, numbers)
    links = tuple(LintFinding(f"link{k}", "density", 1.0, "2", "likely", "too light") for k in range(9))
    linted = LintResult("arm", links, 9, 8, 0)
    for shown, named in ((linted.to_markdown(), 9), (to_html(linted.document(full=False)), 3)):
        assert sum(f"link{k}" in shown for k in range(9)) == named


@pytest.mark.parametrize("name", [*RESULTS, "study", "stress"])
def test_markdown_shows_what_a_page_shows_and_a_notebook_what_a_terminal_shows(name):
    result = {**RESULTS, "study": STUDY, "stress": RESULT}[name]
    whole = result.document()
    for where, text, escape in (("page", result.to_markdown(), markdown), ("terminal", result._repr_html_(), html)):
        assert escape(whole.verdict) in text
        for section, blocks in whole.shown(where):
            shown = [section.title]
            for block in blocks:
                if isinstance(block, Items):
                    shown += [bullet.line for bullet in block.bullets]
                elif isinstance(block, Paragraph):
                    shown.append(plain(block.text))
                elif isinstance(block, Table):
                    shown += [plain(c.head) for c in block.shown(where)]
                    shown += [plain(cell) for group in block.groups(where) for row in group for cell in row]
            assert not [part for part in shown if escape(part) not in text]


def test_plain_data_has_no_number_that_json_has_not():
    assert json.dumps(to_plain({"a": (math.nan, 1.0), "b": [math.inf]}), allow_nan=False) == (
        '{"a": [null, 1.0], "b": [null]}'
    )
    assert from_plain(tuple[float, ...], [1.0, "no limit"]) == (1.0, math.inf)
    assert math.isnan(from_plain(float, None))
    assert from_plain(float | None, None) is None
