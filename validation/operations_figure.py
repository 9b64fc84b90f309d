"""Draw the operations of each form of the dynamics, what they cost, and how both grow with the number of joints.

Run ``python -m validation.operations_figure`` to draw ``validation/operations.json`` again; ``validation.operations``
makes that file.
"""

from __future__ import annotations

import json

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from validation.stamp import results
from validation.terms_figure import COLOURS, draw_growth, style

TITLES = {"inverse_dynamics": "Inverse dynamics", "mass_matrix": "M", "forward_dynamics": "Forward dynamics"}
GROWN = {"inverse_dynamics": "#cc79a7", "forward_dynamics": "#444444"}
#: Form or engine -> colour and mark.
MARKS = {
    "energies": ("#7f7f7f", "o"),
    "links": ("#56b4e9", "v"),
    "regrouped": ("#009e73", "s"),
    "M and factors": ("#cc79a7", "D"),
    "chosen": (COLOURS["lagrangian"], "|"),
    "pinocchio": (COLOURS["pinocchio"], "x"),
}


def draw_dots(axes, robots, values, title):
    """Draw a line for each robot; `values` gives its number by label."""
    for y, row in enumerate(robots):
        numbers = values(row)
        axes.plot([min(numbers.values()), max(numbers.values())], [y, y], color="#d9dde2", lw=1, zorder=0)
        for label, x in numbers.items():
            colour, mark = MARKS[label]
            size = 11 if mark == "|" else 5
            axes.plot(x, y, mark, color=colour, ms=size, mfc="none", mew=2 if mark == "|" else 1.2, label=label)
    axes.set_xscale("log")
    axes.set_yticks(range(len(robots)), [f"{r['robot'].replace('_', ' ')}\n{r['nv']} velocities" for r in robots])
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(len(robots) - 0.5, -0.5)
    axes.set_title(title)


def operations_of(row, quantity):
    return {form: sum(x.values()) for form, x in row["quantities"][quantity]["operations"].items()}


def times_of(row, quantity):
    return {label.split(",")[0]: ns["median"] for label, ns in row["quantities"][quantity]["ns"].items()}


def drawn(data):
    fig = plt.figure(figsize=(7.2, 9.6))
    dots = fig.add_gridspec(2, 3, left=0.195, right=0.985, top=0.935, bottom=0.41, hspace=0.3, wspace=0.08)
    lines = fig.add_gridspec(1, 3, left=0.075, right=0.985, top=0.27, bottom=0.05, wspace=0.36)
    handles = {}
    for i, (values, unit) in enumerate(((operations_of, "operations"), (times_of, "ns per sample, 1 thread"))):
        for k, (quantity, title) in enumerate(TITLES.items()):
            axes = fig.add_subplot(dots[i, k])
            draw_dots(axes, data["robots"], lambda r, q=quantity, f=values: f(r, q), "" if i else title)
            axes.set_xlabel(unit)
            if k:
                axes.set_yticklabels([])
            found = zip(*axes.get_legend_handles_labels(), strict=True)
            handles.update({label: handle for handle, label in found if label not in handles})
    fig.legend(handles.values(), handles, ncols=len(MARKS), frameon=False, loc="upper center")
    kinds = (
        ("Operations", "operations", lambda r, _: r["operations"]),
        ("Time, 1 thread", "ns per sample", lambda r, _: r["ns"]["lagrangian, coordinate-major"]["median"]),
        ("Derive and compile", "s", lambda r, _: r["derive_and_compile_s"]),
    )
    for k, (title, unit, value) in enumerate(kinds):
        axes = fig.add_subplot(lines[k])
        for quantity, colour in GROWN.items():
            grown = [r for r in data["growth"] if r["quantity"] == quantity]
            draw_growth(axes, grown, value, title, unit, {quantity.split("_")[0]: colour})
        axes.tick_params(axis="x", labelsize=6)
        axes.get_legend().remove()
    fig.legend(*axes.get_legend_handles_labels(), ncols=2, frameon=False, loc="center", bbox_to_anchor=(0.53, 0.325))
    return fig


def draw(data, folder):
    """Write ``operations.svg`` to a folder."""
    style()
    folder.mkdir(parents=True, exist_ok=True)
    drawn(data).savefig(folder / "operations.svg", transparent=True, bbox_inches="tight", metadata={"Date": None})
    plt.close("all")


def main():
    draw(json.loads(results("operations.json").read_text(encoding="utf-8")), results("figures"))


if __name__ == "__main__":
    main()
