"""Draw what one sample of inverse and forward dynamics costs, and how that grows with the number of joints.

Run ``python -m validation.terms_figure`` to draw ``validation/terms.json`` again;
``validation.bench_terms`` makes that file.
"""

from __future__ import annotations

import json

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from mbkit.studies.formatting import time_text
from validation.stamp import results

COLOURS = {"pinocchio": "#0072b2", "lagrangian": "#d55e00", "mujoco": "#009e73"}
ENGINES = {name: COLOURS[name] for name in ("lagrangian", "pinocchio")}
#: Of growth: each kind of system with its line.
LINES = {"chain": "o-", "chain in space": "^--", "tree": "s:"}
TITLES = {"inverse_dynamics": "Inverse dynamics", "forward_dynamics": "Forward dynamics"}


def bars_of(row, threads):
    """Return (label, engine, threads, summary) of what is drawn of one robot, from top to bottom."""
    out = []
    for label, ns in row["ns"].items():
        engine, what, count = label.rsplit(", ", 2)
        # The other order of the arrays is in the table: as fast, within a few per cent.
        if what == "coordinate-major" or int(count) not in (1, threads):
            continue
        shown = {"C order": "own derivation", "step by rollout": "mujoco.rollout, a step"}.get(what, what)
        shown = shown.replace(" from Python", ", from Python")
        out.append((f"{shown}, {count} thread{'s' if int(count) > 1 else ''}", engine, int(count), ns))
    return out


def draw_bars(axes, rows, threads):
    y, ticks, labels = 0.0, [], []
    for row in rows:
        axes.text(
            0.0,
            y - 0.62,
            f"{row['robot']}, {row['nv']} velocities",
            transform=axes.get_yaxis_transform(),
            weight="bold",
            fontsize=8,
        )
        for label, engine, count, ns in bars_of(row, threads):
            axes.barh(y, ns["median"], color=COLOURS[engine], alpha=1.0 if count == 1 else 0.55, height=0.8)
            axes.plot([ns["least"]], [y], "|", color="black", ms=5)
            axes.text(ns["median"] * 1.07, y, time_text(ns["median"] * 1e-9), va="center", fontsize=7)
            ticks.append(y)
            labels.append(label)
            y += 1.0
        y += 1.2
    axes.set_xscale("log")
    axes.set_yticks(ticks, labels, fontsize=7)
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(y - 1.4, -1.3)
    most = max(ns["median"] for row in rows for _, _, _, ns in bars_of(row, threads))
    axes.set_xlim(1, most * 3)
    axes.set(title=TITLES[rows[0]["quantity"]], xlabel="ns per sample (black: fastest round)")


def draw_growth(axes, rows, value, title, unit, colours):
    for kind, mark in LINES.items():
        for engine, colour in colours.items():
            points = [(r["n"], value(r, engine)) for r in rows if r["kind"] == kind]
            points = [(n, x) for n, x in points if x]
            if points:
                axes.loglog(*zip(*points, strict=True), mark, ms=4, lw=1.2, color=colour, label=f"{engine}, {kind}")
    sizes = sorted({r["n"] for r in rows})
    axes.set_xticks(sizes, [str(n) for n in sizes])
    axes.minorticks_off()
    axes.set(title=title, xlabel="joints", ylabel=unit)
    axes.legend(frameon=False, fontsize=7)


def drawn(data, tall):
    """Return the figure: wide, or as wide as a page of the book."""
    fig = plt.figure(figsize=(7.2, 21) if tall else (12, 15))
    if tall:
        upper = fig.add_gridspec(2, 1, left=0.29, right=0.97, top=0.985, bottom=0.31, hspace=0.12, height_ratios=(5, 7))
        lower = fig.add_gridspec(2, 2, left=0.09, right=0.97, top=0.275, bottom=0.025, hspace=0.32, wspace=0.25)
    else:
        upper = fig.add_gridspec(1, 2, left=0.17, right=0.985, top=0.97, bottom=0.34, wspace=0.5)
        lower = fig.add_gridspec(1, 3, left=0.06, right=0.985, top=0.275, bottom=0.04, wspace=0.28)
    for k, quantity in enumerate(TITLES):
        rows = [r for r in data["robots"] if r["quantity"] == quantity]
        draw_bars(fig.add_subplot(upper[k]), rows, data["threads"])
        grown = [r for r in data["growth"] if r["quantity"] == quantity]
        title = f"{TITLES[quantity]}, 1 thread"
        axes = fig.add_subplot(lower[k])
        draw_growth(axes, grown, lambda r, e: r["ns"][e]["median"], title, "ns per sample", ENGINES)
    axes = fig.add_subplot(lower[2])
    for quantity, colour in (("inverse_dynamics", "#cc79a7"), ("forward_dynamics", "#444444")):
        grown = [r for r in data["growth"] if r["quantity"] == quantity]
        draw_growth(
            axes, grown, lambda r, _: r["derive_and_compile_s"], "Derive and compile", "s", {TITLES[quantity]: colour}
        )
    return fig


def style():
    # Text as text, and the same bytes for the same data.
    plt.rcParams.update({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False})
    plt.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "mbkit"})


def draw(data, folder):
    """Write ``terms.png``, and ``terms.svg`` for the book, to a folder."""
    style()
    folder.mkdir(parents=True, exist_ok=True)
    drawn(data, tall=False).savefig(folder / "terms.png", dpi=110)
    drawn(data, tall=True).savefig(folder / "terms.svg", transparent=True, metadata={"Date": None})
    plt.close("all")


def main():
    draw(json.loads(results("terms.json").read_text(encoding="utf-8")), results("figures"))


if __name__ == "__main__":
    main()
