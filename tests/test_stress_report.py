"""The page, the tables and the figures of where engines and methods break, of results that nothing had to run."""

import io
import math
import re
from dataclasses import replace

import pytest

from mbkit.errors import UnknownNameError
from mbkit.report import terminal
from mbkit.report.page import render
from mbkit.studies.measurement import Measurement
from mbkit.studies.stress.figure import SHADES, figure, shade
from mbkit.studies.stress.measurements import CaseResult, Row
from mbkit.studies.stress.result import StressResult
from tests.test_report import HOSTILE, Tags, printed

NAN, INF = math.nan, math.inf


def cells(values: tuple[float, ...], *ends: str | float | tuple[float, str]) -> tuple[Measurement, ...]:
    """One cell a value: an error, an error with a warning, or an end of which there is none."""
    out = []
    for value, end in zip(values, ends, strict=False):
        if isinstance(end, str):
            out.append(Measurement(value, end, seconds=0.5, note=f"{end} at t = 0.1 s"))
        else:
            error, warning = end if isinstance(end, tuple) else (end, "")
            out.append(Measurement(value, "finished", error, 1e-9, 0.01, 1000, (warning,) if warning else ()))
    return tuple(out)


STIFF = (1.0, 1e3, 1e6, 1e9)
SPRING = CaseResult(
    name="joint_spring",
    about="A pendulum with a spring of stiffness k.",
    family="stiffness",
    parameter="k",
    unit="N m/rad",
    measure="motion",
    bar=1e-6,
    why="plots cannot hide it",
    values=STIFF,
    truths=("closed form", "closed form", "two runs agree", "two runs agree"),
    facts=({"fastest frequency": 1.0}, {"fastest frequency": 31.6}, {}, {"condition number": 12.0}),
    rows=(
        Row("mujoco", "rk4", cells(STIFF, 1e-9, 1e-3, 0.5, 40.0), "dt 1 ms", 1e5),
        Row("lagrangian", "auto", cells(STIFF, 1e-13, 1e-12, 1e-10, 1e-8), "rtol 1e-10"),
        Row("pinocchio", "radau", cells(STIFF, 1e-9, 1e-9, 1e-8, "slow"), "rtol 1e-10"),
        Row("pinocchio", "rk4", cells(STIFF, 1e-9, 1e-5, (0.3, "dt ω is 31"), "diverged"), "dt 1 ms", 1e5),
        Row("mujoco", "mujoco_euler", cells(STIFF, 1e-3, "nan", "died", "not run"), "dt 1 ms", INF),
        Row("drake", "rk3", cells(STIFF, "refused", "refused", "refused", "refused")),
    ),
)
STEPS = (1e-3, 2e-3, 4e-3, 8e-3)
STEP = replace(
    SPRING,
    name="step_spring",
    family="step",
    parameter="dt",
    unit="s",
    bar=1.0,
    why="below the motion itself it is stable",
    values=STEPS,
    truths=("closed form",) * 4,
    facts=({"fastest frequency, 1/s": 1000.0},) * 4,
    rows=(
        Row("lagrangian", "rk4", cells(STEPS, 1e-5, 1e-3, "diverged", "diverged"), theory=2.83e-3),
        Row("mujoco", "semi_implicit_euler", cells(STEPS, 2.0, 2.0, 2.0, 2.0), theory=2e-3),
        Row("lagrangian", "gauss4", cells(STEPS, 1e-7, 1e-6, 1e-5, 1e-4), theory=INF),
    ),
)
LINKS = (2.0, 16.0, 128.0)
TERMS = replace(
    SPRING,
    name="chain",
    family="length",
    parameter="links",
    unit="",
    measure="terms",
    values=LINKS,
    truths=("34 digits",) * 3,
    facts=(),
    rows=(
        Row("pinocchio", "M", cells(LINKS, 1e-15, 1e-15, 1e-14)),
        Row("pinocchio", "forward_dynamics", cells(LINKS, 1e-14, 1e-9, 0.2)),
        Row("mujoco", "M", cells(LINKS, 1e-15, 1e-5, 1e-3)),
        Row("mujoco", "C", cells(LINKS, "refused", "refused", "refused")),
    ),
)
RESULT = StressResult(
    cases=(SPRING, STEP, TERMS),
    complete=True,
    versions={"pin": "4.1.0"},
    processor="a processor",
    seconds=61.0,
    settings={"dt": 1e-3, "engines": ["pinocchio", "mujoco"], "memory": None},
)
NASTY = replace(
    RESULT,
    cases=(
        replace(
            SPRING,
            name=HOSTILE,
            about=HOSTILE,
            family=HOSTILE,
            parameter=HOSTILE,
            unit=HOSTILE,
            why=HOSTILE,
            values=(1.0, NAN, INF),
            truths=(HOSTILE,),
            facts=({HOSTILE: NAN},),
            rows=(
                Row(
                    HOSTILE,
                    HOSTILE,
                    (Measurement(1.0, "finished", NAN, INF, INF, 0, (HOSTILE,), HOSTILE),),
                    HOSTILE,
                    NAN,
                ),
                Row(HOSTILE, "rk4", (Measurement(1.0, "finished", INF, INF, NAN, note=HOSTILE),), HOSTILE, 3.0),
                Row("mujoco", HOSTILE, (Measurement(1.0, "refused", note=HOSTILE),)),
            ),
        ),
        replace(STEP, name=HOSTILE, facts=()),
        replace(SPRING, rows=(), values=(), truths=(), facts=()),
        replace(SPRING, rows=(Row("pinocchio", "rk4", ()),)),
        replace(STEP, rows=(), values=()),
    ),
    settings={HOSTILE: HOSTILE, "list": [HOSTILE], "map": {HOSTILE: HOSTILE}},
    processor=HOSTILE,
)
NOTHING = replace(RESULT, cases=(), complete=False)


def stress_page(result: StressResult, **files: str) -> str:
    return render(result.document(), **files)


def summary(result: StressResult) -> object:
    return terminal.render(result.document(full=False))


@pytest.fixture(scope="module")
def page() -> str:
    return stress_page(RESULT, data="stress.json", table="stress.csv")


def test_rows_stand_in_the_order_of_how_far_they_held():
    told = [(x.row.engine, x.row.method, x.reach, x.usable) for x in SPRING._lines]
    assert told == [
        ("lagrangian", "auto", 4, 4),
        ("pinocchio", "radau", 3, 3),
        ("pinocchio", "rk4", 1, 2),
        ("mujoco", "rk4", 1, 2),
        ("mujoco", "mujoco_euler", 0, 1),
        ("drake", "rk3", 0, 0),
    ]
    assert SPRING._lines[-1].left_out
    assert SPRING._choice is SPRING._lines[0]
    assert TERMS._choice is None


def test_an_engine_is_judged_by_its_furthest_method_but_by_the_first_of_its_terms_to_break():
    assert {e: x.row.method for e, x in SPRING._best.items()} == {
        "lagrangian": "auto",
        "pinocchio": "radau",
        "mujoco": "rk4",
        "drake": "rk3",
    }
    # A term that it does not have is none that breaks.
    first = {e: x.row.method for e, x in TERMS._best.items()}
    assert first == {"pinocchio": "forward_dynamics", "mujoco": "M"}


def test_shades_tell_digits_and_whether_it_held():
    errors = (0.0, 1e-13, 1e-10, 1e-7, 1e-4, 0.01)
    assert [shade(Measurement(1.0, "finished", x), "held") for x in errors] == ["h0", "h0", "h1", "h2", "h3", "h4"]
    assert shade(Measurement(1.0, "finished", 1e-4), "inaccurate") == "w3"
    assert {shade(Measurement(1.0, "finished", x), "silent") for x in (0.5, INF)} == {"gross"}
    assert shade(Measurement(1.0, "finished", NAN), "unjudged") == "none"
    ends = ("diverged", "refused", "slow", "nan", "died", "not run")
    assert [shade(Measurement(1.0, "nan"), e) for e in ends] == ["end"] * 3 + ["mute"] * 2 + ["none"]


def test_dark_text_reads_on_every_shade_of_paper():
    def luminance(colour: str) -> float:
        parts = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
        linear = [x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4 for x in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    style = re.findall(r"--(\w+): (#[0-9a-f]{6})", stress_page(NOTHING))
    light, dark = dict(reversed(style)), dict(style)
    # WCAG 2.1: 4.5 for small text.
    for paper in (light, dark):
        for name in set(SHADES) - {"none"}:
            a, b = sorted((luminance(paper[name]), luminance(paper["ink"])))
            assert (b + 0.05) / (a + 0.05) >= 4.5, name
    # A figure on white paper has the page's own shades.
    assert {name: light[name] for name in set(SHADES) - {"none"}} == {n: c for n, c in SHADES.items() if n != "none"}
    held, broken = ([luminance(light[f"{kind}{k}"]) for k in range(5)] for kind in "hw")
    # In grey, fewer digits are darker.
    assert held == sorted(held, reverse=True)
    assert [*broken, luminance(light["gross"])] == sorted([*broken, luminance(light["gross"])], reverse=True)


def test_the_headline_says_who_held_furthest_and_how_much_was_silent():
    # Neither terms nor stable steps make a method the best.
    assert re.search("lagrangian auto held furthest.* in 1 of 1 case; 7 silent failures in 3 cases", RESULT.headline)
    twice = replace(RESULT, cases=(SPRING, replace(SPRING, rows=SPRING.rows[2:3])))
    assert twice.headline.startswith("lagrangian auto and pinocchio radau held furthest")
    quiet = replace(RESULT, cases=(replace(SPRING, rows=SPRING.rows[1:3]),))
    assert quiet.headline.endswith("in 1 of 1 case; no silent failures")
    assert NOTHING.headline == "interrupted; what was finished: nothing was run"
    lost = replace(RESULT, cases=(replace(SPRING, rows=SPRING.rows[4:]),))
    assert lost.headline == "nothing held in 1 case; no silent failures"
    # Without a run, terms are told of by engine.
    assert replace(RESULT, cases=(TERMS,)).headline.startswith("pinocchio held furthest")


def test_what_was_wrong_in_silence_is_told_by_method_with_where_it_begins():
    told = [b.line for b in RESULT.document().sections[2].blocks[0].bullets]
    assert told == [
        "✗ rk4: joint_spring at k = 1e6 N m/rad",
        "✗ semi_implicit_euler: step_spring at dt = 0.001 s",
        "✗ pinocchio forward_dynamics: chain at links = 128",
    ]


def test_where_another_holds_further_than_auto_is_told():
    assert not RESULT.document().sections[1].blocks[0].bullets
    worse = Row("lagrangian", "auto", cells(STIFF, 1e-9, 1e-9, "slow", "slow"))
    result = replace(RESULT, cases=(replace(SPRING, rows=(worse, *SPRING.rows[2:])),))
    page = " ".join(Tags(stress_page(result)).text.split())
    assert "! joint_spring: auto held to 1000 N m/rad, pinocchio radau held to 1e6 N m/rad" in page
    assert "behind" in printed(summary(result))


def marked(page: str, case: str, *row: str) -> list[tuple[str, str]]:
    """The class and text of each cell of a row of a page's map."""
    section = page.split(f"<h2>{case}</h2>")[1]
    (line,) = (x for x in section.split("<tr>") if all(f">{word}</td>" in x for word in row))
    return [(style, text) for style, text in re.findall(r'<td class="nowrap ([a-z].*?)">(.*?)</td>', line)]


def test_the_map_marks_where_it_breaks(page):
    told = marked(page, "joint_spring", "pinocchio", "rk4")
    assert told == [("h1", "1e-9"), ("w3 brk", "1e-5"), ("gross", "! 0.3"), ("end", "diverged")]
    told = marked(page, "joint_spring", "mujoco", "rk4")
    assert [style for style, _ in told] == ["h1", "w3 brk", "gross sil", "gross sil"]
    assert [text for _, text in marked(page, "joint_spring", "mujoco_euler")] == ["1e-3", "NaN", "died", ""]
    assert "dt ω is 31" not in page.split("<h2>step_spring</h2>")[1]


def test_an_interrupted_row_is_filled_with_empty_cells():
    cut = replace(SPRING, rows=(replace(SPRING.rows[1], cells=SPRING.rows[1].cells[:2]),))
    page = stress_page(replace(RESULT, cases=(cut,), complete=False))
    assert marked(page, "joint_spring", "auto") == [("h0", "1e-13"), ("h0", "1e-12"), ("none", ""), ("none", "")]
    assert "interrupted" in page


def test_a_page_holds_every_cell_and_how_it_is_known(page):
    text = " ".join(Tags(page).text.split())
    wanted = ("7 silent failures in 3 cases", "✗ rk4: joint_spring at k = 1e6 N m/rad", "0.00283", "no limit")
    wanted += ("A pendulum with a spring", "truth at 1 … 1000closed form truth at 1e6 … 1e9two runs agree")
    wanted += ("fastest frequency1, 31.6, –, –", "refused at t = 0.1 s", "error 1.0e-05", "slow at t = 0.1 s")
    wanted += ("plots cannot hide it", "Held: error ≤ 1e-06", "pin 4.1.0", "a processor", "stress.json", "stress.csv")
    assert [x for x in wanted if x not in text] == []


def test_a_page_needs_nothing_from_elsewhere_and_is_whole(page):
    for text in (page, stress_page(NASTY, data=HOSTILE, table=HOSTILE)):
        tags = Tags(text)
        assert tags.open == []
        assert not {tag for tag, _ in tags.tags} & {"link", "img", "iframe", "object"}
        assert [tag for tag, _ in tags.tags].count("script") == 1
        assert not any(name.startswith("on") for _, attributes in tags.tags for name in attributes)
        assert not re.search(r"#0[1-5]0[1-5]0[1-6]", text)
        assert "default-src 'none'" in text
        assert "\x1b" not in text
        assert "\u202e" not in text
    assert '<script>alert("x")</script>[red]x[/red]' in Tags(stress_page(NASTY)).text
    for text in (NASTY.to_markdown(), NASTY.to_csv()):
        assert all(c.isprintable() or c == "\n" for c in text)
    assert "<" not in NASTY.to_markdown()


def test_what_was_interrupted_before_any_run_is_praised_nowhere():
    case = NASTY.cases[0]
    cells = tuple(Measurement(value=1.0, end="not run") for _ in case.values)
    rows = tuple(
        replace(row, method=method, engine="lagrangian", cells=cells)
        for row, method in zip(case.rows, ("auto", "rk4"), strict=False)
    )
    result = replace(NASTY, complete=False, cases=(replace(case, rows=rows),))
    text = printed(summary(result))
    assert "✓" not in text
    assert "0 runs" in text
    assert "nothing was run" in text
    assert "nothing was run" in stress_page(result)


def test_a_result_of_nothing_still_has_a_page_a_table_and_a_figure():
    for empty in (NOTHING, replace(NOTHING, cases=NASTY.cases[2:])):
        for text in (Tags(stress_page(empty)).text, printed(summary(empty))):
            assert "interrupted; what was finished: nothing" in text
        assert figure(empty.cases).axes


@pytest.mark.parametrize("width", [80, 120])
def test_the_table_is_a_line_a_case_that_fits_the_terminal(width):
    many = replace(RESULT, cases=RESULT.cases * 3)
    text = printed(summary(many), width)
    assert max(map(len, text.splitlines())) <= width
    assert sum(x.startswith("joint_spring ") for x in text.splitlines()) == 3
    for wanted in ("lagrangian auto", "pinocchio (terms)", "1000 NaN", "✗ rk4: joint_spring"):
        assert wanted in text, wanted
    hostile = printed(summary(NASTY), width)
    assert "\x1b" not in hostile
    assert "[red]x[/red]" in hostile
    assert max(map(len, hostile.splitlines())) <= width


def test_figures_draw_a_case_or_all_and_refuse_what_there_is_not():
    drawn = figure(RESULT.cases, "joint_spring").axes[0]
    assert [t.get_text() for t in drawn.get_xticklabels()] == ["1", "1000", "1e6", "1e9"]
    assert "✗ 0.5" in [t.get_text() for t in drawn.texts]
    every = figure(RESULT.cases).axes[0]
    assert [t.get_text() for t in every.get_yticklabels()] == ["joint_spring", "step_spring", "chain"]
    # One case alone is drawn as its map.
    assert figure((TERMS,)).texts[0].get_text().startswith("chain: ")
    with pytest.raises(UnknownNameError, match="joint_spring"):
        figure(RESULT.cases, "joint_sprin")
    for case in NASTY.cases[:4]:
        figure((case,)).savefig(io.BytesIO(), format="png", dpi=20)
