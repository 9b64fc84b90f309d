"""Tables, figures and pages of results that no engine had to compute."""

import json
import math
import re
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import pytest
from rich.console import Console

from mbkit._escape import one_line, terminal
from mbkit.errors import OutputError
from mbkit.report import page as pages
from mbkit.report import terminal as tables
from mbkit.report.output_folder import check_writable, file_stem, write
from mbkit.simulate.progress import Bar
from mbkit.studies.compare import figure
from mbkit.studies.compare.all_robots import RobotOutcome, Sweep
from mbkit.studies.compare.body_terms import BODY_TERMS, MECHANISM_TERMS
from mbkit.studies.compare.result import MEANINGS, Comparison
from mbkit.studies.compare.terms import CONSTRAINT_TERMS, TERMS, Finding, Omission, RolloutRow, Row
from mbkit.studies.formatting import count_text, error_text, time_text
from mbkit.studies.measurement import Measurement
from mbkit.studies.results import Refusal
from mbkit.studies.work_precision import result as curves
from mbkit.studies.work_precision.result import WorkPrecision
from mbkit.studies.work_precision.sweep import Curve

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
    judged = math.isfinite(tolerance)
    ends = (1000, 0.1, 0.2, passed if judged else None, note, judged)
    return RolloutRow("rk4", "pinocchio", "mujoco_rk4", 1e-3, 1.0, error, 5.0, tolerance, *ends)


def point(value: float, error: float, seconds: float, *, energy: float = 1e-9, note: str = "") -> Measurement:
    cost = {"evaluations": 400, "spread": 1e-4, "repeats": 5}
    return Measurement(value, "finished", error, energy, seconds, 100, note=note, setting="dt", **cost)


def curve(engine: str, method: str, seconds: float, order: float, expected: float = 4.0, first: float = 0.5) -> Curve:
    points = tuple(point(0.1 / 2**k, 1e-3 / 16**k, seconds * 2**k, energy=1e-4 / 16**k) for k in range(5))
    return Curve(engine, method, points, order, 4, expected, first)


STUDY = WorkPrecision(
    model="arm",
    facts={"nq": 1, "nv": 1, "mass": 2.0, "digest": "ab" * 32, "needs": {"gravity": True}, "notes": ["a note"]},
    duration=0.5,
    asked=1.0,
    reference="two engines at 1e-13",
    floor=1e-13,
    q0=(0.25,),
    v0=(0.75,),
    curves=(
        curve("pinocchio", "rk4", 0.03, 4.02),
        curve("lagrangian", "rk4", 0.01, 3.55),
        curve("mujoco", "mujoco_rk4", 0.02, 4.0, first=NAN),
        curve("mujoco", "rk4", 0.05, NAN, NAN),
    ),
    refusals=(Refusal("pinocchio", "taylor", "needs the own derivation"),),
    complete=True,
    versions={"pin": "4.1.0"},
    processor="a processor",
    seconds=9.0,
    settings={"seed": 7, "steps": None, "saved": [0.0, 0.5], "timing": "interleaved"},
)
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
    precision=STUDY,
    omissions=(
        Omission("contacts", False, "collision detection", 1200.0, 3.0, NAN, 0.0, True),
        Omission("damping", False, "dampers", -25.6, 40.0, NAN, 0.0, True),
        Omission("gravity", True, "needed, so it is on", NAN, NAN, NAN, NAN, True),
        Omission("dry friction", True, "dry friction", 20.0, 3.0, NAN, 0.7, True, "off in every engine"),
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
    omissions=(Omission("limits", False, "limits", 1.0, 0.1, NAN, 0.1, False),),
)
NASTY_STUDY = replace(
    STUDY,
    model=HOSTILE,
    facts=STUDY.facts | {"notes": [HOSTILE], "digest": HOSTILE},
    reference=HOSTILE,
    floor=NAN,
    curves=(
        Curve("pinocchio", HOSTILE, (point(0.1, 0.0, 0.1, note=HOSTILE), point(NAN, 1e-3, 0.2)), NAN, 0, 4.0, NAN),
        Curve("lagrangian", "rk4", (point(0.1, NAN, 0.1, note=HOSTILE), point(0.05, math.inf, NAN)), NAN, 0, 4.0, 0.1),
        Curve(HOSTILE, "rk4", (point(0.1, 1e-3, 0.1, energy=NAN), point(0.1, 1e9, 0.1)), NAN, 0, 4.0, 0.1),
        Curve("mujoco", "empty", (), NAN, 0, NAN, NAN),
    ),
    refusals=(Refusal(HOSTILE, HOSTILE, HOSTILE),),
    settings={HOSTILE: HOSTILE, "saved": [HOSTILE]},
    processor=HOSTILE,
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
    precision=NASTY_STUDY,
    omissions=(Omission(HOSTILE, True, HOSTILE, NAN, NAN, NAN, math.inf, False, HOSTILE),),
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


def check_page(result: Comparison, asked: str = "", data: str = "") -> str:
    return pages.render(result.document(asked), data=data)


def bench_page(result: WorkPrecision, asked: str = "", data: str = "", table: str = "") -> str:
    return pages.render(result.document(asked), data=data, table=table)


def sweep_page(result: Sweep, data: str = "") -> str:
    return pages.render(result.document(), data=data)


def digits(result: Comparison) -> str:
    return figure.digits(result.rows, result.engines, result.reference, result.tolerance)


def term_costs(result: Comparison) -> str:
    return figure.term_costs(result.rows, result.engines, result.tolerance)


def check_table(result: Comparison, asked: str = "", *, full: bool = True) -> object:
    return tables.render(result.document(asked, full=full))


def bench_table(result: WorkPrecision, asked: str = "") -> object:
    return tables.render(result.document(asked))


def printed(what: object, width: int = 100) -> str:
    console = Console(width=width, force_terminal=False, color_system=None)
    with console.capture() as capture:
        console.print(what)
    return capture.get()


class Tags(HTMLParser):
    """Every tag with its attributes, those still open, and the text; ends have to fit."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "br"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def test_a_time_has_three_digits_and_a_unit_and_numbers_that_are_none_are_told():
    times = {1234e-9: "1.23 µs", 999.6e-9: "1.00 µs", 18e-6: "18.0 µs", 0.0999: "99.9 ms", 1.0: "1.00 s", 250: "250 s"}
    for seconds, text in (times | {-50e-9: "-50.0 ns", NAN: ""}).items():
        assert time_text(seconds) == text
    assert [error_text(x) for x in (NAN, math.inf, 0.0)] == ["NaN", "∞", "0"]
    assert (count_text(NAN), count_text(358.2), count_text(12345.0)) == ("", "358", "1.2e+04")


def test_text_from_files_cannot_command_a_terminal():
    assert terminal("a\x1b[31m\x07\u202eb\nc") == "a\\x1b[31m\\x07\\u202eb\nc"
    assert one_line("a\n  b   c", 4) == "a b…"


def test_what_a_study_left_out_is_said_first():
    cut = replace(AGREEING, rollouts=(replace(rollout(1e-13, 1e-12), duration=0.25, asked=1.0),))
    heads = [STUDY._repr_html_().split("<table>")[0]]
    tables_of = {bench_table: (STUDY,), check_table: (AGREEING, DIFFERING)}
    for table, result in ((x, y) for x, results in tables_of.items() for y in results):
        heads += [repr(result), *(x.splitlines()[0] for x in (printed(table(result), 400), result.to_markdown()))]
    heads += [text[: text.index("The model")] for text in (Tags(check_page(x)).text for x in (AGREEING, DIFFERING))]
    for head in heads:
        assert "1 curve left out: pinocchio taylor" in head
        assert "horizon cut from 1 s to 0.5 s" in head
    assert "1 of 1 rollouts cut, to 0.25 s" in cut.headline
    unjudged = replace(AGREEING, rollouts=(replace(rollout(1e-13, 1e-12), judged=False, passed=None),))
    assert unjudged.passed
    assert "; the rollout not judged" in unjudged.headline
    assert "no rollouts" in replace(AGREEING, rollouts=(), refusals=(Refusal("", "rollouts", "it fell"),)).headline
    early = replace(STUDY, curves=(replace(STUDY.curves[0], ended="time"),), refusals=(), asked=0.5)
    assert early.shortened == ("1 curve ended by time: pinocchio rk4",)
    assert replace(early, curves=STUDY.curves).shortened == ()
    assert WorkPrecision.from_json(early.to_json()).shortened == early.shortened


def test_the_first_screen_has_the_verdict_what_acts_nowhere_and_the_worst_rows():
    found = (Finding("dry friction", "3 N m at j1", ("j1",), 5.0),)
    for result in (replace(AGREEING, findings=found), replace(DIFFERING, findings=found)):
        lines = printed(check_table(result, full=False), 160).splitlines()
        assert len(lines) <= 24
        text, page = (" ".join(x.split()) for x in ("\n".join(lines), Tags(check_page(result)).text))
        first = page[: page.index("The model")]
        for told in (
            "rollouts and error against run time are without dry friction (5 times the other forces)",
            "dry friction: 3 N m at j1",
            "no curve of pinocchio taylor: needs the own derivation",
            "drake: not installed",
            "worst row of",
            "3.0e-14",
        ):
            assert told in text, told
            assert told in first, told
        assert "--full" in text
        assert "--full" not in page
        assert "Rollouts against" not in text
        assert "Rollouts against" in page
        assert Comparison.from_json(result.to_json()).findings == found
        assert "3 N m at j1" in result.to_markdown()


def test_many_stiff_joints_do_not_fill_the_first_screen():
    found = tuple(Finding("stiff joint", f"j{k}: too fast", (f"j{k}",), 1e-6 * (k + 1)) for k in range(9))
    text = " ".join(printed(check_table(replace(AGREEING, findings=found), full=False), 160).split())
    assert [f"j{k}: too fast" in text for k in range(9)] == [True] * 3 + [False] * 6
    assert "stiff joints: 6 more, less stiff: j3, j4, j5, j6, j7, j8" in text
    assert all(f"j{k}: too fast" in replace(AGREEING, findings=found).to_markdown() for k in range(9))


def test_every_term_of_the_table_has_a_line_on_the_page():
    every = {t.name for t in (*TERMS, *CONSTRAINT_TERMS, *BODY_TERMS, *MECHANISM_TERMS)} | {"power balance"}
    assert every == set(MEANINGS)
    words = Tags(check_page(replace(AGREEING, rows=(*AGREEING.rows, row("A_G", "mujoco", 0.0))))).text
    assert "A_G v is the momentum of all bodies" in words
    assert "as if every joint were locked" not in words


def test_a_method_of_which_no_run_came_to_an_end_is_named_with_its_reason():
    """A curve all of whose runs failed has points, and no error: it is no curve."""
    broken = Curve("lagrangian", "rk853", (point(0.1, NAN, NAN, note="order 7 condition"),), NAN, 0, NAN, 0.1)
    study = replace(STUDY, curves=(*STUDY.curves, broken))
    assert study.failed[-1] == Refusal("lagrangian", "rk853", "order 7 condition")
    assert "2 curves left out: pinocchio taylor, lagrangian rk853" in repr(study)
    assert json.loads(study.to_json())["failed"][-1]["reason"] == "order 7 condition"
    whole = replace(AGREEING, precision=study)
    shown = [study.to_markdown(), printed(bench_table(study)), Tags(bench_page(study)).text]
    shown += [Tags(check_page(whole)).text, *(printed(check_table(whole, full=full), 200) for full in (False, True))]
    for text in shown:
        assert "lagrangian rk853: order 7 condition" in " ".join(text.replace("\\", "").split())
    assert json.loads(whole.to_json())["precision"]["failed"][-1]["method"] == "rk853"


def test_a_run_that_is_the_fastest_for_several_errors_is_one_row():
    # lagrangian rk4 at 0.1 / 2^k has errors of 1e-3 / 16^k, and nobody is faster.
    found = curves.leads(STUDY)
    assert [x.errors for x in found] == [[1e-2], [1e-4], [1e-6]]
    far = replace(
        STUDY, curves=tuple(replace(c, points=(point(0.1, 1e-9, c.points[0].seconds),)) for c in STUDY.curves)
    )
    (one,) = curves.leads(far)
    assert one.errors == pytest.approx([1e-2, 1e-4, 1e-6, 1e-8])
    assert one.next_engines == "mujoco × 2"
    rows = [line for line in printed(bench_table(far), 120).splitlines() if line.startswith("1e-")]
    assert [" ".join(r.split()[:3]) for r in rows] == ["1e-02 to 1e-08"]
    assert Tags(check_page(replace(AGREEING, precision=far))).text.count("1e-02 to 1e-08") == 1
    assert far.to_markdown().count("lagrangian | rk4 | dt") == 1


@pytest.mark.parametrize("width", [80, 140])
def test_the_verdict_comes_first_and_nothing_is_wider_than_the_terminal(width):
    for result in (AGREEING, DIFFERING):
        text = printed(check_table(result), width)
        assert text.startswith("✓ arm" if result.passed else "✗ arm")
        assert max(map(len, text.splitlines())) <= width
        assert "3.0e-14" in text
        assert "1.23 µs" in text
        assert "semi" not in text
    for table in (tables.render(ALL.document()), bench_table(STUDY)):
        assert max(map(len, printed(table, width).splitlines())) <= width


def test_the_table_shows_failures_and_their_cause():
    text = printed(check_table(DIFFERING, "my:arm"))
    cause = "✗ kinetic energy, pinocchio: differs by 3.0e-01; pinocchio#2053"
    assert all(told in text for told in ("✗ arm (my:arm)", cause, "✗ 3.0e-01", "refused"))
    # What is allowed above the tolerance is marked and explained.
    allowed = replace(AGREEING, rows=(row("M", "mujoco", 5e-12, "within its own rounding", passed=True),))
    assert "! 5.0e-12" in printed(check_table(allowed))
    for text in (printed(check_table(allowed)), Tags(check_page(allowed)).text):
        assert "within its own rounding" in text
    many = replace(DIFFERING, rows=tuple(row(f"t{k}", "pinocchio", 1.0, "differs") for k in range(40)))
    assert "and 34 more" in printed(check_table(many))


def test_hostile_names_are_only_text():
    both = check_page(NASTY, asked=HOSTILE), bench_page(NASTY_STUDY, asked=HOSTILE, data=HOSTILE, table=HOSTILE)
    told = printed(check_table(NASTY)), printed(bench_table(NASTY_STUDY, HOSTILE))
    for text in (*told, *both, sweep_page(ALL)):
        assert "\x1b" not in text
        assert "\u202e" not in text
    for page in map(Tags, both):
        assert not {tag for tag, _ in page.tags} & {"iframe", "object", "img", "link"}
        assert [tag for tag, _ in page.tags].count("script") == 1
        assert '<script>alert("x")</script>[red]x[/red]' in page.text
    assert all("[red]x[/red]" in text for text in told)


def test_nan_and_infinity_are_shown_and_fail_and_nothing_has_a_page_too():
    assert not NASTY.passed
    page = Tags(check_page(NASTY)).text
    assert "NaN" in page
    assert "∞" in page
    assert "NaN" in printed(check_table(NASTY))
    assert "nothing compared" in Tags(check_page(EMPTY)).text
    assert "mujoco" in printed(check_table(EMPTY))


PAGES = {
    "check": cache(lambda: check_page(AGREEING, data="arm.json")),
    "sweep": cache(lambda: sweep_page(ALL, data="all.json")),
    "bench": cache(lambda: bench_page(STUDY, data="arm-bench.json", table="arm-bench.csv")),
}


@pytest.mark.thorough("check")
@pytest.mark.parametrize("kind", PAGES)
def test_a_page_needs_nothing_from_elsewhere(kind):
    page = PAGES[kind]()
    tags = Tags(page).tags
    for tag, attributes in tags:
        assert tag not in ("link", "img", "iframe")
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


def test_a_run_that_is_no_answer_is_on_no_front_and_the_headline_tells_where_the_lead_changes():
    wild = Curve("pinocchio", "semi_implicit_euler", (point(0.5, 8.0, 1e-4),), NAN, 0, 1.0, 0.1)
    result = replace(STUDY, curves=(wild, *STUDY.curves))
    assert result.front[0][0] is wild
    assert curves.front_names(result) == ["lagrangian rk4"]
    assert not curves.curve_lines(result)[0].on_front
    late = Curve("mujoco", "rk853", (point(0.1, 1e-9, 0.012),), NAN, 0, NAN, 0.1)
    told = replace(STUDY, curves=(*STUDY.curves, late)).headline
    leads = "lagrangian rk4 for an error of 1e-02, mujoco rk853 for an error of 1e-04 to 1e-08"
    assert told.startswith(f"fastest of 5 curves: {leads}")


def test_an_order_that_is_off_is_flagged_and_one_that_was_not_seen_is_not():
    assert [line.off for line in curves.curve_lines(STUDY)] == [False, True, False, False]
    page, text = bench_page(STUDY), printed(bench_table(STUDY))
    assert "! 3.55" in page
    assert "! 4.02" not in page
    assert "! 3.55" in text
    assert "not the method's own" in text
    # The least error is the fastest of those that the reference can tell.
    line = curves.curve_lines(replace(STUDY, floor=1e-5))[0]
    assert line.point is STUDY.curves[0].points[2]


def test_terms_that_were_not_timed_are_not_drawn():
    untimed = replace(AGREEING, rows=tuple(replace(r, ns=NAN) for r in AGREEING.rows))
    assert term_costs(untimed) == ""
    assert [("var(--bad)" in digits(result)) for result in (AGREEING, DIFFERING)] == [False, True]
    assert "nle" not in term_costs(AGREEING)
    ElementTree.fromstring(term_costs(NASTY))
    assert "var(--bad)" in term_costs(DIFFERING)
    assert "var(--bad)" not in term_costs(AGREEING)


def test_a_sweep_counts_and_passes_only_when_all_agree_or_are_refused():
    assert ALL.counts == {"agree": 1, "differ": 1, "refused": 1, "failed": 1}
    assert "1 not reached" in ALL.verdict
    assert not ALL.passed
    good = replace(ALL, outcomes=(ALL.outcomes[0], ALL.outcomes[2]), expected=2)
    assert good.passed
    assert not replace(good, expected=3).passed
    data = json.loads(ALL.to_json())
    assert [r["status"] for r in data["robots"]] == ["agree", "differ", "refused", "failed"]
    assert "no joints" in printed(tables.render(ALL.document()))
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
        assert write(folder, "a.json", text, force=True) == folder / "a.json"
    assert (folder / "a.json").read_text(encoding="utf-8") == "two ✓ \\udc80"
    assert (folder / "a.json").stat().st_mode & 0o444 == 0o444
    (folder / "b.json").mkdir()
    with pytest.raises(OutputError, match=r"b\.json"):
        write(folder, "b.json", "{}")
    assert sorted(p.name for p in folder.iterdir()) == ["a.json", "b.json"]


def test_no_bar_where_there_is_no_terminal(capsys):
    with Bar("work") as bar:
        bar(0.5, "half")
    assert capsys.readouterr() == ("", "")
