"""A million steps of the implicit midpoint rule: does the energy drift? Beside RK4 and MuJoCo's own steps.

Run ``python -m validation.energy_drift``; it writes ``validation/energy_drift.json`` and
``validation/figures/energy_drift.png`` and ``.svg`` in about a minute.
``python -m validation.energy_drift --figure`` draws the figure again.

The largest energy error in each window of 1e5 steps is fitted with a power of the time,
by regression on logarithms over the ten windows: 0 is no drift, 1 is an error that grows
like the time. Energies of all methods are the own derivation's.
"""

from __future__ import annotations

import json
import sys
import time
import warnings

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import mbkit as mb
from mbkit import catalog
from mbkit.errors import MbkitWarning
from validation.stamp import results, stamp

STEPS, WINDOWS = 1_000_000, 10
# Of what is drawn; beyond the kinetic energy itself no error means anything.
LOWEST, HIGHEST = 1e-8, 1e1
METHODS = {
    "implicit_midpoint": "lagrangian",
    "rk4": "lagrangian",
    "mujoco_rk4": "mujoco",
    "mujoco_euler": "mujoco",
    "mujoco_implicitfast": "mujoco",
}
LOOKS = {
    "implicit_midpoint": {"color": "#d55e00", "lw": 2.2, "label": "implicit midpoint"},
    "rk4": {"color": "#0072b2", "lw": 2.2, "label": "RK4"},
    "mujoco_rk4": {"color": "#7cf0bd", "lw": 1.3, "ls": (0, (2, 2)), "label": "MuJoCo RK4"},
    "mujoco_euler": {"color": "#009e73", "lw": 1.4, "alpha": 0.55, "label": "MuJoCo Euler"},
    "mujoco_implicitfast": {"color": "#333333", "lw": 1.2, "ls": (0, (1, 3)), "label": "MuJoCo implicitfast"},
}


def scenes():
    """Return name -> model, q0, v0, step in s, and what the reader is told of it."""
    dp, top = catalog.double_pendulum(), catalog.heavy_top()
    return {
        "double_pendulum": (dp, [2.0, 1.0], [0.0, 0.0], 1e-2, "Double pendulum from (2, 1) rad at rest (chaotic)"),
        "heavy_top": (
            top,
            top.neutral(),
            [0.0, 150.0, -4.61538],
            1e-3,
            "Heavy top at 150 rad/s (Terze and others 2016)",
        ),
    }


def measured(model, q, v, dt):
    """Return a row for each method."""
    own = mb.dynamics(model, "lagrangian")
    engines = {"lagrangian": own, "mujoco": mb.dynamics(model, "mujoco")}
    rows, scale = {}, 0.0
    for method, engine in METHODS.items():
        # The first run compiles.
        mb.simulate(engines[engine], q, v, 10 * dt, method, dt=dt)
        started = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MbkitWarning)  # a run that diverges says so in its row
            run = mb.simulate(engines[engine], q, v, STEPS * dt, method, dt=dt)
        seconds = time.process_time() - started
        kinetic = own.kinetic_energy(run.q, run.v)
        # The midpoint rule's run comes first; the others are measured by the same rod.
        scale = scale or float(kinetic.max())
        error = np.abs(kinetic + own.potential_energy(run.q) - kinetic[0] - own.potential_energy(run.q[0])) / scale
        rows[method] = {
            "engine": engine,
            "ended": run.stats.ended,
            "steps": len(error) - 1,
            "cpu_seconds": round(seconds, 3),
            **growth(error),
            "curve": curve(error),
        }
    return {"kinetic_energy": scale, "methods": rows}


def growth(error):
    """Return the windows' largest errors, and the exponent of time that they grow with."""
    if len(error) <= STEPS:
        return {"windows": None, "exponent": None, "exponent_standard_error": None}
    largest = error[1:].reshape(WINDOWS, -1).max(axis=1)
    # A window's largest error stands for its end.
    x, y = np.log(np.arange(1, WINDOWS + 1)), np.log(largest)
    (slope, _), covariance = np.polyfit(x, y, 1, cov=True)
    return {
        "windows": largest.tolist(),
        "exponent": float(slope),
        "exponent_standard_error": float(np.sqrt(covariance[0, 0])),
    }


def curve(error):
    """Return (last step, largest error) of windows that are equally wide on a logarithmic axis."""
    ends = np.unique(np.geomspace(30, STEPS, 60).astype(int))
    ends = ends[ends < len(error)]
    starts = [1, *(ends[:-1] + 1)]
    points = [[int(b), float(error[a : b + 1].max())] for a, b in zip(starts, ends, strict=True)]
    if len(error) <= STEPS:
        points.append([len(error) - 1, float(error[-1])])
    return points


def draw(result):
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    plt.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "mbkit"})
    fig, panels = plt.subplots(1, 2, figsize=(11, 5.0))
    for axes, scene in zip(panels, result["scenes"].values(), strict=True):
        axes.axvspan(1e5, STEPS, color="#eeeeee", lw=0, zorder=0)
        axes.text(3.16e5, 1.6 * HIGHEST, "fitted", ha="center", color="grey", fontsize=8)
        for method, row in scene["methods"].items():
            x, y = np.array(row["curve"]).T
            look = dict(LOOKS[method])
            if row["windows"] is not None and min(row["windows"]) > 0.5:
                look["label"] += ":  error as large as the energy"
            elif row["exponent"] is not None:
                # A minus before zeros tells nothing.
                look["label"] += f":  grows as $t^{{{abs(round(row['exponent'], 2)):.2f}}}$"
            else:
                look["label"] += f":  diverges at step {row['steps'] + 1:,}"
            axes.loglog(x, y, **look)
        axes.set_title(f"{scene['about']}, step {scene['dt'] * 1e3:g} ms", fontsize=9.5, loc="left", pad=16)
        axes.set(xlabel="steps", xlim=(30, STEPS), ylim=(LOWEST, HIGHEST))
        axes.legend(frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=2)
    panels[0].set_ylabel("energy error / largest kinetic energy")
    fig.tight_layout()
    results("figures").mkdir(exist_ok=True)
    fig.savefig(results("figures") / "energy_drift.png", dpi=110)
    fig.savefig(results("figures") / "energy_drift.svg", transparent=True, metadata={"Date": None})
    plt.close(fig)


#: See `validation.smoke`.
SMOKE = {"STEPS": 400}


def main():
    path = results("energy_drift.json")
    if "--figure" not in sys.argv[1:]:
        result = {**stamp(__file__), "steps": STEPS, "window": STEPS // WINDOWS}
        result["scenes"] = {}
        for name, (model, q, v, dt, about) in scenes().items():
            result["scenes"][name] = {"about": about, "dt": dt, **measured(model, q, v, dt)}
        path.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    result = json.loads(path.read_text(encoding="utf-8"))
    draw(result)
    for name, scene in result["scenes"].items():
        for method, row in scene["methods"].items():
            fitted = (
                "diverged"
                if row["exponent"] is None
                else f"{row['exponent']:+.4f} ± {row['exponent_standard_error']:.4f}"
            )
            print(f"{name:16} {method:20} exponent {fitted:20} {row['cpu_seconds']:7.2f} s for {row['steps']} steps")


if __name__ == "__main__":
    main()
