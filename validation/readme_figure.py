"""Draw the README's figure: right digits of every robot, and error against run time.

Run ``python -m validation.readme_figure``; it compares everything anew and writes
``validation/figures/overview.png`` and ``validation/check_all.json`` beside it.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

import mbkit as mb
from mbkit.studies.compare.all_robots import all_robots
from mbkit.studies.results import processor, versions

HERE = Path(__file__).parent
COLOURS = {"pinocchio": "#0072b2", "lagrangian": "#d55e00", "mujoco": "#009e73"}
LABELS = {"pinocchio": "Pinocchio", "lagrangian": "own derivation, in double", "mujoco": "MuJoCo"}
MARKS = {
    "rk4": "o",
    "mujoco_rk4": "o",
    "dop853": "D",
    "rk853": "^",
    "mujoco_euler": "s",
    "mujoco_implicitfast": "^",
    "semi_implicit_euler": "s",
}


def digits(error):
    return -math.log10(max(error, 1e-17))


def summary(outcomes):
    """Return, per robot, the worst error of each engine against the oracle."""
    rows = []
    for o in outcomes:
        row = {"robot": o.robot, "status": o.status, "reason": o.reason}
        if o.comparison is not None:
            row["nv"] = o.comparison.facts["nv"]
            row["worst"] = {
                e: max((r.relative, r.term) for r in o.comparison.rows if r.engine == e) for e in o.comparison.engines
            }
        rows.append(row)
    return rows


def draw(rows, result, path):
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    fig, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), width_ratios=(1.15, 1))
    compared = sorted((r for r in rows if "worst" in r), key=lambda r: r["nv"])
    for engine, mark in (("lagrangian", "s"), ("pinocchio", "o"), ("mujoco", "D")):
        at = [(k, digits(r["worst"][engine][0])) for k, r in enumerate(compared) if engine in r["worst"]]
        left.plot(*zip(*at, strict=True), mark, ms=4, color=COLOURS[engine], label=LABELS[engine])
    left.axhline(12, color="grey", lw=0.8, ls="--")
    left.text(0, 11.85, "tolerance", va="top", color="grey", fontsize=8)
    ticks = [*range(0, len(compared) - 8, 8), len(compared) - 1]
    left.set_xticks(ticks, [str(compared[k]["nv"]) for k in ticks])
    left.set(
        xlabel="robots of example-robot-data, by degrees of freedom",
        ylabel="digits that are right, worst term and state",
    )
    left.set_ylim(10.5, 17)
    left.legend(frameon=False, loc="upper right", fontsize=8)
    study = result.precision
    for curve in study.curves:
        engine, method, points = curve.engine, curve.method, curve.points
        right.loglog(
            [p.seconds * 1e3 for p in points],
            [p.error for p in points],
            MARKS[method] + ("-" if "rk4" in method or method.endswith("853") else ":"),
            ms=4,
            lw=1.2,
            color=COLOURS[engine],
            label=f"{method}, {engine}" if not method.startswith(engine) else method,
        )
    low = study.floor
    right.axhline(low, color="grey", lw=0.8, ls="--")
    right.text(
        0.02, low * 1.3, "reference known to here", color="grey", fontsize=8, transform=right.get_yaxis_transform()
    )
    right.set_ylim(low / 4, 1e6)
    right.set(xlabel=f"run time of 0.5 s of {result.model}, ms", ylabel="largest error of q, rad")
    right.legend(frameon=False, fontsize=7, loc="upper right", bbox_to_anchor=(1.02, 1.02))
    fig.tight_layout()
    path.parent.mkdir(exist_ok=True)
    fig.savefig(path, dpi=110)


def main():
    outcomes = sorted(all_robots(samples=64), key=lambda o: o.robot)
    rows = summary(outcomes)
    result = mb.compare(mb.load("ur5"))
    draw(rows, result, HERE / "figures" / "overview.png")
    stamped = {"versions": versions(), "processor": processor(), "robots": rows}
    (HERE / "check_all.json").write_text(json.dumps(stamped, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
