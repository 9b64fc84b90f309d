"""Tables, figures and pages of results that no engine had to compute."""

import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
from rich.console import Console

from mbkit.errors import OutputError
from mbkit.report import figures, tables
from mbkit.report.folder import check_writable, file_stem, write
from mbkit.report.numbers import count_text, error_text, inline, plain, time_text
from mbkit.report.page import check_page, sweep_page
from mbkit.report.progress import Bar
from mbkit.report.reading import failures, headline, notices, omission_state, reached
from mbkit.studies.all_robots import RobotOutcome, Sweep
from mbkit.studies.result import Comparison, CostPoint, Omission, Refusal, RolloutRow, Row

NAN = math.nan
HOSTILE = '<script>alert("x")</script>[red]x[/red]\x1b[31m\u202e$x$</style>'
TOLERANCE = 1e-12


def row(
    term: str, engine: str, error: float, reason: str = "", *, passed: bool | None = None, joint: str = "j1"
) -> Row:
    return Row(
        term=term,
        engine=engine,
        reference="oracle",
        joint=joint,
        max_abs=error,
        relative=error,
        per_joint=error,
        median=error / 3,
        samples=70,
        worst_kind="random",
        worst_q=(0.5,),
        worst_v=(1.5,),
        ns=1234.0,
        ns_spread=10.0,
        passed=error <= TOLERANCE if passed is None else passed,
        reason=reason,
        allowed=TOLERANCE,
    )


def rollout(error: float, tolerance: float, *, passed: bool = True, note: str = "") -> RolloutRow:
    return RolloutRow("rk4", "pinocchio", "mujoco_rk4", 1e-3, 1.0, error, 5.0, tolerance, 1000, 0.1, 0.2, passed, note)


AGREEING = Comparison(
    model="arm",
    facts={
        "nq": 1,
        "nv": 1,
        "mass": 2.0,
        "digest": "ab" * 32,
        "needs": {"gravity": True, "loops": False},
        "joints": ["j1"],
        "notes": ["mimic joints reduced"],
        "nonphysical": ["link: negative"],
    },
    engines=("pinocchio", "lagrangian", "mujoco"),
    reference="oracle",
    samples=64,
    seed=7,
    tolerance=TOLERANCE,
    rows=(
        row("M", "pinocchio", 1e-15),
        row("M", "mujoco", 3e-14),
        row("M", "lagrangian", 0.0),
        row("g", "pinocchio", 0.0),
        row("g", "lagrangian", 0.0),
    ),
    rollouts=(rollout(1e-13, 1e-12), rollout(0.5, math.inf, note="for information")),
    costs=(
        CostPoint("pinocchio", "rk4", "dt 0.01", 1e-4, 0.01, 1e-4, 100),
        CostPoint("pinocchio", "rk4", "dt 0.001", 1e-8, 0.1, 1e-4, 1000),
        CostPoint("mujoco", "mujoco_rk4", "dt 0.01", 1e-5, 0.02, 1e-4, 0),
    ),
    reference_floor=1e-13,
    omissions=(
        Omission("contacts", False, "collision detection", 1200.0, NAN, 0.0, True, "± 3 ns"),
        Omission("gravity", True, "needed, so it is on", NAN, NAN, NAN, True),
        Omission("dry friction", True, "dry friction", 20.0, NAN, 0.7, True, "off in every engine"),
    ),
    refusals=(
        Refusal("mujoco", "g", "cannot"),
        Refusal("mujoco", "nle", "cannot"),
        Refusal("drake", "", "not installed"),
    ),
    setup={"pinocchio": 0.01},
    versions={"pin": "4.1.0"},
    processor="a processor",
    seconds=3.0,
)
DIFFERING = replace(
    AGREEING,
    rows=(*AGREEING.rows, row("kinetic energy", "pinocchio", 0.3, "differs by 3.0e-01; pinocchio#2053", joint="")),
    rollouts=(rollout(1e-6, 1e-12, passed=False),),
    omissions=(Omission("limits", False, "limits", 1.0, NAN, 0.1, False),),
)
NASTY = replace(
    DIFFERING,
    model=HOSTILE,
    facts=AGREEING.facts | {"notes": [HOSTILE], "nonphysical": [HOSTILE], "joints": [HOSTILE]},
    rows=(
        row("M", "mujoco", NAN, HOSTILE, joint=HOSTILE),
        row(HOSTILE, "pinocchio", math.inf, HOSTILE, joint=HOSTILE),
        row("M", "lagrangian", 0.0, joint=HOSTILE),
    ),
    rollouts=(rollout(NAN, 1e-12, passed=False, note=HOSTILE), rollout(NAN, math.inf, note=HOSTILE)),
    costs=(
        CostPoint("pinocchio", HOSTILE, HOSTILE, 0.0, 0.1, NAN, 1),
        CostPoint("lagrangian", "rk4", "dt", NAN, NAN, NAN, 1),
        CostPoint("mujoco", "rk4", "dt", 1e-3, 0.1, NAN, 1),
    ),
    reference_floor=NAN,
    omissions=(Omission(HOSTILE, True, HOSTILE, NAN, NAN, math.inf, False, HOSTILE),),
    refusals=(Refusal("drake", HOSTILE, HOSTILE),),
    processor=HOSTILE,
)
EMPTY = Comparison(
    "arm", {"nq": 1, "nv": 1}, ("pinocchio",), "", 1, 0, TOLERANCE, (), refusals=(Refusal("mujoco", "", "no"),)
)
ALL = Sweep(
    outcomes=(
        RobotOutcome("a/one", "agree", "", AGREEING),
        RobotOutcome("b/two", "differ", "kinetic energy", DIFFERING),
        RobotOutcome("c/three", "refused", "no joints"),
        RobotOutcome("d/four", "failed", HOSTILE),
    ),
    expected=5,
    engines=("pinocchio", "lagrangian", "mujoco"),
    samples=64,
    seed=0,
    seconds=1.0,
)


def printed(what: object, width: int = 100) -> str:
    console = Console(width=width, force_terminal=False, color_system=None)
    with console.capture() as capture:
        console.print(what)
    return capture.get()


class Tags(HTMLParser):
    """Every tag with its attributes, and the text."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (1234e-9, "1.23 µs"),
        (999.6e-9, "1.00 µs"),
        (18e-6, "18.0 µs"),
        (0.0999, "99.9 ms"),
        (1.0, "1.00 s"),
        (250, "250 s"),
    ],
)
def test_a_time_has_three_digits_and_a_unit(seconds, text):
    assert time_text(seconds) == text


def test_numbers_that_are_none_are_told():
    assert (time_text(NAN), error_text(NAN), error_text(math.inf), error_text(0.0)) == ("", "NaN", "∞", "0")
    assert (count_text(NAN), count_text(358.2), count_text(12345.0)) == ("", "358", "1.2e+04")
    assert time_text(-50e-9) == "-50.0 ns"


def test_text_from_files_cannot_command_a_terminal():
    assert plain("a\x1b[31m\x07\u202eb\nc") == "a\\x1b[31m\\x07\\u202eb\nc"
    assert inline("a\n  b   c", 4) == "a b…"


def test_headline_names_the_engines_and_who_is_left_out():
    # No row gives nle here: what nobody compared is not called agreement.
    told = "pinocchio, lagrangian, mujoco agree to 13.5 digits; not compared: nle; drake left out, see the notes"
    assert headline(AGREEING) == told
    told = headline(DIFFERING)
    assert "1 of 6 comparisons of terms" in told
    assert "1 of 1 rollouts" in told
    assert "nothing compared" in headline(EMPTY)


def test_failures_hold_terms_rollouts_and_omissions_with_reasons():
    found = {f.what: f.reason for f in failures(DIFFERING)}
    assert found["kinetic energy, pinocchio"] == "differs by 3.0e-01; pinocchio#2053"
    assert "1e-12 expected" in found["rollout rk4, pinocchio"]
    assert "leaving out limits" in found
    assert not failures(AGREEING)


def test_refusals_of_one_reason_are_one_notice():
    assert [(n.engine, n.terms) for n in notices(AGREEING.refusals)] == [("mujoco", ("g", "nle")), ("drake", ())]


def test_an_omission_by_choice_is_not_called_unchanged():
    assert [omission_state(o) for o in AGREEING.omissions] == ["same", "on", "chosen"]


def test_fastest_run_that_reaches_an_error():
    points = [p for p in AGREEING.costs if p.engine == "pinocchio"]
    assert reached(points, 1e-3) is points[0]
    assert reached(points, 1e-6) is points[1]
    assert reached(points, 1e-9) is None


@pytest.mark.parametrize("width", [80, 100, 140])
def test_the_verdict_comes_first_and_nothing_is_wider_than_the_terminal(width):
    for result in (AGREEING, DIFFERING):
        text = printed(tables.comparison(result), width)
        assert text.startswith("✓ arm" if result.passed else "✗ arm")
        assert max(map(len, text.splitlines())) <= width
        assert "3.0e-14" in text
        assert "1.23 µs" in text
        assert "semi" not in text
    lines = printed(tables.sweep(ALL), width).splitlines()
    assert max(map(len, lines)) <= width


def test_the_table_shows_failures_and_their_cause():
    text = printed(tables.comparison(DIFFERING, "my:arm"))
    assert "✗ arm (my:arm)" in text
    assert "✗ kinetic energy, pinocchio: differs by 3.0e-01; pinocchio#2053" in text
    assert "✗ 3.0e-01" in text
    assert "refused" in text


def test_a_term_allowed_above_the_tolerance_is_marked_and_explained():
    allowed = replace(AGREEING, rows=(row("M", "mujoco", 5e-12, "within its own rounding", passed=True),))
    text = printed(tables.comparison(allowed))
    assert "! 5.0e-12" in text
    assert "within its own rounding" in text
    assert "within its own rounding" in Tags(check_page(allowed)).text


def test_many_failures_do_not_bury_the_table():
    many = replace(DIFFERING, rows=tuple(row(f"t{k}", "pinocchio", 1.0, "differs") for k in range(40)))
    assert "and 30 more" in printed(tables.comparison(many))


def test_hostile_names_are_only_text():
    for text in (printed(tables.comparison(NASTY)), check_page(NASTY, asked=HOSTILE), sweep_page(ALL)):
        assert "\x1b" not in text
        assert "\u202e" not in text
    page = Tags(check_page(NASTY, asked=HOSTILE))
    assert not {tag for tag, _ in page.tags} & {"script", "iframe", "object", "img", "link"}
    assert '<script>alert("x")</script>[red]x[/red]' in page.text
    assert "[red]x[/red]" in printed(tables.comparison(NASTY))


def test_nan_and_infinity_are_shown_and_fail():
    assert not NASTY.passed
    page = Tags(check_page(NASTY)).text
    assert "NaN" in page
    assert "∞" in page
    assert "NaN" in printed(tables.comparison(NASTY))


@pytest.mark.parametrize("page", [check_page(AGREEING, data="arm.json"), sweep_page(ALL, data="all.json")])
def test_a_page_needs_nothing_from_elsewhere(page):
    tags = Tags(page).tags
    for tag, attributes in tags:
        assert tag not in ("script", "link", "img", "iframe")
        for name, value in attributes.items():
            if name in ("src", "href", "xlink:href"):
                assert tag == "a" or str(value).startswith("#")
            assert not name.startswith("on")
    assert "@import" not in page
    assert not re.search(r"url\((?!#)", page)
    assert "default-src 'none'" in page
    assert "prefers-color-scheme: dark" in page
    # Stand-in colours are all replaced.
    assert not re.search(r"#0[1-5]0[1-5]0[1-6]", page)


def test_a_page_holds_what_an_expert_asks_for():
    text = " ".join(Tags(check_page(AGREEING, data="arm.json")).text.split())
    for wanted in (
        "agree to 13.5 digits",
        "nq = 1",
        "2 kg",
        "ab" * 32,
        "mimic joints reduced",
        "link: negative",
        "seed 7",
        "pin 4.1.0",
        "a processor",
        "arm.json",
        "1.23 µs",
        "for information",
        "collision detection",
        "not installed",
        "‖e‖ / max(‖x‖, ‖M‖‖v‖²)",
        "cond(M)",
        "reference known to 1.0e-13",
        "digits of agreement",
    ):
        assert wanted in text, wanted
    failed = Tags(check_page(DIFFERING)).text
    assert "q = [0.5]" in failed


def test_a_comparison_of_nothing_still_has_a_page_and_a_table():
    assert "nothing compared" in Tags(check_page(EMPTY)).text
    assert "mujoco" in printed(tables.comparison(EMPTY))


def test_figures_are_the_same_every_time_and_scale():
    for draw in (figures.digits, lambda r: figures.error_against_time(r, 0.5)):
        one, two = draw(AGREEING), draw(AGREEING)
        assert one == two
        assert "viewBox" in one
        assert not re.match(r"<svg[^>]* width=", one)
        assert "var(--series1)" in one
    assert "mujoco against oracle" in figures.digits(AGREEING)
    assert "var(--bad)" in figures.digits(DIFFERING)
    assert "var(--bad)" not in figures.digits(AGREEING)


def test_a_sweep_counts_and_passes_only_when_all_agree_or_are_refused():
    assert ALL.counts == {"agree": 1, "differ": 1, "refused": 1, "failed": 1}
    assert "1 not reached" in ALL.verdict
    assert not ALL.passed
    good = replace(ALL, outcomes=(ALL.outcomes[0], ALL.outcomes[2]), expected=2)
    assert good.passed
    assert not replace(good, expected=3).passed
    data = json.loads(ALL.to_json())
    assert [r["status"] for r in data["robots"]] == ["agree", "differ", "refused", "failed"]
    assert "no joints" in printed(tables.sweep(ALL))
    assert "no joints" in Tags(sweep_page(ALL)).text


@pytest.mark.parametrize(
    ("name", "stem"),
    [("panda", "panda"), ("../../etc/passwd", "etc_passwd"), ("a b<c>", "a_b_c"), ("", "model"), ("..", "model")],
)
def test_a_name_cannot_leave_the_folder(name, stem):
    assert file_stem(name) == stem
    assert len(file_stem("x" * 500)) == 100


def test_a_folder_below_a_file_is_refused_before_and_after(tmp_path: Path):
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "deep" / "deeper"):
        with pytest.raises(OutputError, match="not a folder"):
            check_writable(folder)
        with pytest.raises(OutputError, match="cannot write"):
            write(folder, "a.json", "{}")


def test_asking_creates_nothing_and_writing_leaves_nothing_else(tmp_path: Path):
    folder = tmp_path / "new" / "folder"
    check_writable(folder)
    assert not folder.parent.exists()
    for text in ("one", "two ✓ \udc80"):
        assert write(folder, "a.json", text) == folder / "a.json"
    assert (folder / "a.json").read_text(encoding="utf-8") == "two ✓ \\udc80"
    assert [p.name for p in folder.iterdir()] == ["a.json"]
    assert (folder / "a.json").stat().st_mode & 0o444 == 0o444


def test_a_failed_write_leaves_no_part(tmp_path: Path):
    (tmp_path / "a.json").mkdir()
    with pytest.raises(OutputError, match=r"a\.json"):
        write(tmp_path, "a.json", "{}")
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_no_bar_where_there_is_no_terminal(capsys):
    with Bar("work") as bar:
        bar(0.5, "half")
    assert capsys.readouterr() == ("", "")
