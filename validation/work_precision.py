"""Error against run time for ten scenes: every engine, every method; one figure and one table.

Run ``python -m validation.work_precision [SCENE ...]``, about fifteen minutes; it writes
``validation/work_precision.json``, ``validation/figures/work_precision.png`` and
``.svg``, and prints the table. With names of scenes, only these are run anew and the
others kept. ``--draw`` draws what was measured before.
"""

from __future__ import annotations

import json
import math
import sys
import time

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

import mbkit as mb
from validation.scenes import SCENES
from validation.stamp import results, stamp

COLOURS = {"pinocchio": "#0072b2", "lagrangian": "#d55e00", "mujoco": "#009e73"}
LABELS = {"pinocchio": "on Pinocchio", "lagrangian": "on the own derivation", "mujoco": "on MuJoCo"}
#: Seconds that a scene may take; some have slow methods that would leave others too few settings for an order.
BUDGET = 75.0
MORE = {"anymal_b": 150.0, "dzhanibekov_box": 110.0, "heavy_top": 110.0}
LEVELS = (1e-3, 1e-6, 1e-9, 1e-11)


def measured(scene):
    """Return one scene's result as plain data, without what is the same for all."""
    result = mb.work_precision(
        scene.model(),
        duration=scene.duration,
        q0=scene.q0,
        v0=scene.v0,
        reference=scene.exact,
        seconds=MORE.get(scene.name, BUDGET),
    )
    out = json.loads(result.to_json())
    for name in ("versions", "processor"):
        del out[name]
    out["date"] = stamp(__file__)["date"]
    out["fastest"] = {f"{level:g}": fastest(result, level) for level in LEVELS}
    return {"scene": scene.name, "about": scene.about, **out}


def fastest(result, level):
    """Return which methods reach an error in the least time: of all, and of each engine."""
    best = {}
    for curve, point in result.rows():
        if point.error <= level and (curve.engine not in best or point.seconds < best[curve.engine][1].seconds):
            best[curve.engine] = curve, point
    return {
        engine: {"method": c.method, p.setting: p.value, "seconds": p.seconds, "first_run": c.compile + p.seconds}
        for engine, (c, p) in best.items()
    }


def envelope(curves, engine):
    """Return the points of one engine that no other of its own beats."""
    points = [p for c in curves if c["engine"] == engine for p in c["points"] if p["error"]]
    out = []
    for p in sorted(points, key=lambda p: p["seconds"]):
        if not out or p["error"] < out[-1]["error"]:
            out.append(p)
    return out


def draw(scenes):
    """Draw the wide PNG, and the SVG as wide as a page of the book."""
    plt.rcParams.update({"font.size": 8.5, "axes.spines.top": False, "axes.spines.right": False})
    plt.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "mbkit"})
    drawn(scenes, 5, (13, 5.6)).savefig(results("figures") / "work_precision.png", dpi=130)
    tall = drawn(scenes, 2, (7.2, 13))
    tall.savefig(results("figures") / "work_precision.svg", transparent=True, metadata={"Date": None})


def drawn(scenes, columns, size):
    fig, axes = plt.subplots(10 // columns, columns, figsize=size, sharey=True, layout="constrained")
    for ax, scene in zip(axes.flat, scenes, strict=False):
        for curve in scene["curves"]:
            points = [p for p in curve["points"] if p["error"]]
            xs, ys = [p["seconds"] for p in points], [p["error"] for p in points]
            ax.plot(xs, ys, color=COLOURS[curve["engine"]], lw=0.6, alpha=0.35)
        for engine in COLOURS:
            best = envelope(scene["curves"], engine)
            if best:
                xs, ys = [p["seconds"] for p in best], [p["error"] for p in best]
                ax.plot(xs, ys, "o-", color=COLOURS[engine], lw=1.8, ms=3, label=LABELS[engine])
        if scene["floor"]:
            ax.axhline(scene["floor"], color="grey", ls=":", lw=0.9)
        ax.set_xscale("log")
        ax.set_yscale("log")
        ax.set_ylim(1e-15, 10)
        ax.set_title(f"{scene['scene'].replace('_', ' ')}, {scene['duration']:g} s", fontsize=9)
        ax.grid(which="major", alpha=0.3)
    for ax in axes[-1]:
        ax.set_xlabel("run time, s")
    for ax in axes[:, 0]:
        ax.set_ylabel("largest error of q, rad or m")
    handles, labels = axes.flat[0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    return fig


def table(scenes):
    """Print, for each scene and error, the fastest of all and how many times the next engine takes."""
    print("| scene | " + " | ".join(f"≤ {level:g}" for level in LEVELS) + " |")
    print("|---|" + "---|" * len(LEVELS))
    for scene in scenes:
        cells = []
        for level in LEVELS:
            found = sorted(scene["fastest"][f"{level:g}"].items(), key=lambda item: item[1]["seconds"])
            if not found:
                cells.append("none")
                continue
            told = ", ".join(f"{e} {f['method']} {f['seconds'] * 1e3:.3g} ms" for e, f in found[:2])
            ratio = f" (× {found[1][1]['seconds'] / found[0][1]['seconds']:.1f})" if len(found) > 1 else ""
            cells.append(told + ratio)
        print(f"| {scene['scene']} | " + " | ".join(cells) + " |")


def orders(scenes):
    """Print every observed order of a fixed step that is off by more than 0.2."""
    for scene in scenes:
        for c in scene["curves"]:
            if c["order"] is None or c["expected"] is None:
                continue
            if abs(c["order"] - c["expected"]) > 0.2:
                told = f"{c['engine']} {c['method']}: order {c['order']:.2f}, expected {c['expected']:g}"
                print(f"{scene['scene']}: {told}, of {c['order_points']} points")


#: See `validation.smoke`.
SMOKE = {"SCENES": SCENES[:1], "BUDGET": 1.0}


def main():
    arguments = sys.argv[1:]
    known = (
        {s["scene"]: s for s in json.loads(results("work_precision.json").read_text())["scenes"]}
        if results("work_precision.json").exists()
        else {}
    )
    names = [a for a in arguments if not a.startswith("-")]
    for scene in SCENES:
        if "--draw" in arguments or (names and scene.name not in names):
            continue
        start = time.perf_counter()
        known[scene.name] = measured(scene)
        print(f"{scene.name}: {time.perf_counter() - start:.0f} s", file=sys.stderr)
        # Kept at once: what follows may be interrupted.
        done = [known[s.name] for s in SCENES if s.name in known]
        told = {**stamp(__file__), "scenes": done}
        results("work_precision.json").write_text(json.dumps(told) + "\n", encoding="utf-8")
    done = [known[s.name] for s in SCENES if s.name in known]
    draw(done)
    table(done)
    orders(done)
    assert all(math.isfinite(s["floor"] or 0.0) for s in done)


if __name__ == "__main__":
    main()
