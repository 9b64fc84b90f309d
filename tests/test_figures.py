"""Figures: no text is cut or lies on another, a user's axes are taken, and colours differ for everybody."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text

import mbkit as mb
from mbkit import catalog, dynamics, simulate
from mbkit.errors import InputError
from mbkit.simulate import Event, Trajectory
from mbkit.simulate.plotting.style import PLAIN
from mbkit.simulate.plotting.time_series import plot_csv
from mbkit.studies.compare.result import Comparison
from tests.scenes import mounted
from tests.test_report import AGREEING, DIFFERING, STUDY
from tests.test_stress_report import NASTY, RESULT


def texts(figure: Figure) -> dict[str, Any]:
    """Return the boxes of all texts that are drawn, in pixels, by text."""
    FigureCanvasAgg(figure)
    # As savefig does: the layout first, by what a first drawing measures.
    figure.draw_without_rendering()
    figure.draw_without_rendering()
    shown = [t for t in figure.findobj(Text) if t.get_visible() and t.get_text().strip()]
    # Ticks outside of the limits exist, and are not drawn.
    hidden = set()
    for ax in figure.findobj(lambda a: hasattr(a, "xaxis")):
        for axis, limits in ((ax.xaxis, ax.get_xlim()), (ax.yaxis, ax.get_ylim())):
            drawn = {id(label) for tick in axis._update_ticks() for label in (tick.label1, tick.label2)}
            whole = axis.get_visible() and ax.axison and limits is not None
            hidden |= {
                id(label)
                for tick in [*axis.majorTicks, *axis.minorTicks]
                for label in (tick.label1, tick.label2)
                if id(label) not in drawn or not whole
            }
            if not ax.axison:
                hidden |= {id(axis.label), id(axis.offsetText)}
    boxes = [(t, t.get_window_extent()) for t in shown if id(t) not in hidden]
    return {f"{k} {t.get_text()}": box for k, (t, box) in enumerate(boxes) if box.width and box.height}


def faults(figure: Figure) -> list[str]:
    """Return which texts are outside of the figure, and which lie on each other."""
    boxes, (width, height) = texts(figure), figure.get_size_inches() * figure.dpi
    out = [
        f"{name} is cut"
        for name, box in boxes.items()
        if min(box.x0, box.y0) < -1 or box.x1 > width + 1 or box.y1 > height + 1
    ]
    for (one, a), (two, b) in itertools.combinations(boxes.items(), 2):
        wide, tall = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
        # A box has room above and below its letters.
        if wide > 1 and tall > 0.25 * min(a.height, b.height):
            out.append(f"{one} lies on {two}")
    return out


def events() -> Trajectory:
    """A run with many events of several names, some at nearly the same time."""
    dyn = dynamics(catalog.double_pendulum())
    hits = [
        Event(lambda t, *_, k=k: t - 0.1 * k - 0.05, f"a crossing with the name {k}", terminal=False)
        for k in range(1, 6)
    ]
    return simulate(dyn, [1.5, 1.0], [0.0, 0.0], 1.0, "dop853", events=hits)


def diverged() -> Trajectory:
    b = mounted("stiff", "mass", "a_joint_with_a_long_name", "prismatic", mass=1.0, stiffness=1e8, axis=(0, 0, 1))
    with pytest.warns(mb.errors.MbkitWarning):
        return simulate(dynamics(b.build()), [0.1], [0.0], 1.0)


def robot(name: str, **options: Any) -> Trajectory:
    model = mb.load(name, **options)
    q, v = model.random_state(0)
    return simulate(dynamics(model), q, 0.3 * v, 0.1, dt=0.005)


def batch() -> Trajectory:
    return simulate(dynamics(catalog.double_pendulum()), np.arange(24.0).reshape(12, 2), np.zeros(2), 0.1)


RUNS = {
    "double pendulum": lambda: simulate(dynamics(catalog.double_pendulum()), [1.5, 1.0], [0.0, 0.0], 1.0),
    "panda": lambda: robot("panda"),
    "anymal": lambda: robot("anymal", floating_base=True),
    "events": events,
    "diverged": diverged,
    "batch": batch,
}
CASES = replace(RESULT, cases=RESULT.cases * 8)
STUDIES: dict[str, Any] = {
    "precision": lambda: STUDY.plot(),
    "stress": lambda: RESULT.plot(),
    "a case": lambda: RESULT.plot("joint_spring"),
    "many cases": lambda: CASES.plot(),
    "comparison": lambda: AGREEING.plot(),
    "failing comparison": lambda: DIFFERING.plot(),
}


@pytest.mark.thorough("double pendulum", "panda", "anymal", "batch", "diverged")
@pytest.mark.parametrize("name", RUNS)
def test_no_text_of_a_run_is_cut_or_lies_on_another(name: str) -> None:
    run = RUNS[name]()
    assert faults(run.plot()) == []
    for count in (1, 13):
        assert faults(run.picture(count)) == [], count


@pytest.mark.thorough("precision", "a case", "many cases")
@pytest.mark.parametrize("name", STUDIES)
def test_no_text_of_a_study_is_cut_or_lies_on_another(name: str) -> None:
    assert faults(STUDIES[name]()) == []


def test_the_check_sees_what_is_cut_and_what_overlaps() -> None:
    figure = Figure()
    figure.text(0.9, 0.5, "longer than the figure is")
    figure.text(0.1, 0.1, "one")
    figure.text(0.1, 0.1, "another")
    assert [fault[2:] for fault in faults(figure)] == ["longer than the figure is is cut", "one lies on 2 another"]


def test_up_to_24_coordinates_are_told_apart_and_named() -> None:
    lines = catalog.chain(n=24)
    run = simulate(dynamics(lines), np.zeros(24), np.ones(24), 0.01, dt=0.005)
    left, right, *_ = run.plot().axes
    looks = {(line.get_color(), str(line._dash_pattern)) for line in left.lines}  # type: ignore[attr-defined]
    assert len(looks) == len(left.lines) == 24
    legend = right.get_legend()
    assert legend is not None
    assert [t.get_text() for t in legend.get_texts()] == list(lines.velocity_names)


# Viénot, Brettel and Mollon (1999): what is left of a colour, in linear RGB, for who lacks a cone.
SIGHT = {
    "protan": [[0.11238, 0.88762, 0], [0.11238, 0.88762, 0], [0.00401, -0.00401, 1]],
    "deutan": [[0.29275, 0.70725, 0], [0.29275, 0.70725, 0], [-0.02234, 0.02234, 1]],
}


@pytest.mark.parametrize("sight", SIGHT)
def test_the_colours_of_the_standard_engines_differ_for_the_colour_blind(sight: str) -> None:
    """Engines have markers of their own besides."""
    seen = [np.clip(SIGHT[sight] @ np.array(to_rgb(colour)) ** 2.2, 0, 1) ** (1 / 2.2) for colour in PLAIN.series[:3]]
    for one, two in itertools.combinations(seen, 2):
        assert np.abs(one - two).max() > 0.2


# A user's axes


def test_plots_draw_into_a_users_axes_and_nowhere_else() -> None:
    run = RUNS["double pendulum"]()
    plots = (
        lambda ax: run.picture(ax=ax),
        lambda ax: STUDY.plot(ax=ax),
        lambda ax: AGREEING.plot(ax=ax),
        lambda ax: RESULT.plot(ax=ax),
        lambda ax: RESULT.plot("joint_spring", ax=ax),
    )
    for plot in plots:
        figure = Figure(figsize=(9, 6), layout="constrained")
        ax, other = figure.subplots(1, 2, width_ratios=(5, 1))
        assert plot(ax) is figure
        assert ax.has_data() or ax.patches or ax.texts
        assert figure.axes == [ax, other]
        assert not other.has_data()
        assert not figure.legends
        figure.canvas.draw()


def test_coordinates_of_a_system_on_paper_are_not_called_lengths() -> None:
    run = simulate(mb.lagrangian.systems.pendulum().dynamics(), [0.5], [0.0], 0.1)
    labels = [ax.get_ylabel() or ax.get_title(loc="left") or ax.get_title() for ax in run.plot().axes]
    assert any("coordinates (SI)" in label for label in labels), labels
    assert not any("lengths" in label for label in labels)


# Comparisons, and tables of runs


def test_a_comparison_shows_each_term_and_crosses_out_what_failed() -> None:
    ax = DIFFERING.plot().axes[0]
    assert [t.get_text() for t in ax.get_yticklabels()] == list(dict.fromkeys(r.term for r in DIFFERING.rows))
    crosses = [line for line in ax.lines if line.get_marker() == "x"]
    assert len(crosses) == sum(not row.passed for row in DIFFERING.rows) > 0
    nothing: Comparison = replace(AGREEING, rows=())
    nothing.plot().savefig("/dev/null", format="png")


def test_the_table_of_a_run_is_drawn_again() -> None:
    run = RUNS["double pendulum"]()
    figure = plot_csv(run.to_csv(), "a title")
    q, v = figure.axes
    assert np.array_equal([line.get_ydata() for line in q.lines], run.q.T)
    assert np.array_equal([line.get_ydata() for line in v.lines], run.v.T)
    assert np.array_equal(q.lines[0].get_xdata(), run.t)
    assert [t.get_text() for t in q.get_legend().get_texts()] == list(run.model.coordinate_names)
    assert faults(figure) == []
    many = batch()
    assert len(plot_csv(many.to_csv(), "").axes[0].lines) == 2 * 10
    for text in ("", "a,b\n1,2\n", "t,q.a,v.a\n", "t,q.a,v.a\n1,2\n", "t,q.a,v.a\n1,x,3\n", "t,q.a\n1,2\n"):
        with pytest.raises(InputError, match="expected the table of a trajectory"):
            plot_csv(text, "")


def test_hostile_cases_are_drawn() -> None:
    for case in NASTY.cases:
        NASTY.plot(case.name).canvas.draw()
