"""Draw the front page's figure: how many digits of each engine are right, robot by robot.

Run ``python -m validation.readme_figure``; it compares every robot again and writes ``validation/check_all.json``
and ``validation/figures/digits_{light,dark}.svg``. With ``--draw`` it only draws what the file has.
"""

from __future__ import annotations

import argparse
import json
import math
from collections import Counter

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from mbkit.studies.compare.all_robots import all_robots
from validation.robots import FEW
from validation.stamp import results, stamp

#: All of them.
ROBOTS, SAMPLES = None, 64
ENGINES = {"lagrangian": "mbkit's own\nderivation", "pinocchio": "Pinocchio", "mujoco": "MuJoCo"}
NAMES = ("ink", "faint", *ENGINES)
COLOURS = {
    "light": dict(zip(NAMES, ("#1f2328", "#6e7781", "#b84a00", "#0067a5", "#00795a"), strict=True)),
    "dark": dict(zip(NAMES, ("#e6edf3", "#8b949e", "#ff9e57", "#58b3f0", "#3fcf9d"), strict=True)),
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


def draw(rows, theme):
    """Return the figure: a row for each engine, a dot for each robot."""
    colours = COLOURS[theme]
    compared = [r for r in rows if "worst" in r]
    plt.rcParams.update({"font.size": 12, "svg.hashsalt": "mbkit", "text.color": colours["ink"]})
    fig, ax = plt.subplots(figsize=(8.6, 3.9), layout="constrained")
    fig.patch.set_alpha(0)
    ax.patch.set_alpha(0)
    for row, engine in enumerate(reversed(ENGINES)):
        # Dots of nearly the same number stand above each other.
        column: Counter[int] = Counter()
        places = []
        for r in sorted((r for r in compared if engine in r["worst"]), key=lambda r: r["worst"][engine][0]):
            x = digits(r["worst"][engine][0])
            place = round(x * 10)
            places.append((place / 10, row - 0.25 + 0.05 * column[place]))
            column[place] += 1
        ax.plot(*zip(*places, strict=True), "o", ms=5, color=colours[engine], mew=0)
    worst = min(compared, key=lambda r: digits(max(e for e, _ in r["worst"].values())))
    engine, (error, term) = max(worst["worst"].items(), key=lambda item: item[1][0])
    ax.annotate(
        f"{worst['robot'].split('/')[-1]}: {term}",
        (digits(error), list(reversed(ENGINES)).index(engine) - 0.25),
        (digits(error) - 0.05, list(reversed(ENGINES)).index(engine) + 0.2),
        color=colours["faint"],
        fontsize=10,
        arrowprops={"arrowstyle": "-", "color": colours["faint"]},
        ha="center",
    )
    ax.axvline(-math.log10(2**-53), color=colours["faint"], lw=1, ls="--")
    ax.text(-math.log10(2**-53) + 0.04, 2.72, "all that a\ndouble holds", color=colours["faint"], fontsize=10, va="top")
    ax.set_yticks(range(len(ENGINES)), [ENGINES[e] for e in reversed(ENGINES)], color=colours["ink"])
    ax.set(xlim=(10.8, 16.6), ylim=(-0.45, 2.75))
    ax.set_xticks(range(11, 17), [str(n) for n in range(11, 17)], color=colours["ink"])
    ax.set_xlabel("digits that are right, in the worst term at the worst state", color=colours["ink"])
    ax.tick_params(color=colours["faint"], length=0)
    for side in ("top", "left", "right"):
        ax.spines[side].set_visible(False)
    ax.spines["bottom"].set_color(colours["faint"])
    ax.grid(axis="x", color=colours["faint"], alpha=0.25, lw=0.6)
    ax.set_axisbelow(True)
    ax.set_title(f"{len(compared)} robots, one dot each", loc="left", fontsize=13, color=colours["ink"])
    return fig


#: See `validation.smoke`.
SMOKE = {"ROBOTS": FEW, "SAMPLES": 2}


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--draw", action="store_true", help="draw what check_all.json has")
    kept = results("check_all.json")
    if not parser.parse_args().draw:
        rows = summary(sorted(all_robots(ROBOTS, samples=SAMPLES), key=lambda o: o.robot))
        stamped = {**stamp(__file__), "robots": rows}
        kept.write_text(json.dumps(stamped, indent=1) + "\n", encoding="utf-8")
    rows = json.loads(kept.read_text(encoding="utf-8"))["robots"]
    for theme in COLOURS:
        fig = draw(rows, theme)
        path = results("figures") / f"digits_{theme}.svg"
        fig.savefig(path, metadata={"Date": None})
        # matplotlib leaves spaces at the ends of lines.
        path.write_text("\n".join(x.rstrip() for x in path.read_text(encoding="utf-8").splitlines()) + "\n")


if __name__ == "__main__":
    main()
