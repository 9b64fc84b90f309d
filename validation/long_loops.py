"""A million steps of mechanisms with loops: how far loops open, and how the energy error grows.

Run ``python -m validation.long_loops``; it writes ``validation/long_loops.json`` and the figure. States are those that
the steps left: the projection of kept states behind a run is switched off. The gap is the residual of the oracle, in
34 digits, at these doubles, beside the rounding of the coordinates themselves.
"""

from __future__ import annotations

import json
import sys
from itertools import pairwise

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import mbkit as mb
from mbkit.simulate import integrate
from validation.stamp import results, stamp

STEPS, WINDOWS, KEPT = 1_000_000, 20, 2_000
EPS = float(np.finfo(float).eps)
METHODS = ("rk4", "implicit_midpoint")


def scenes():
    """Return each mechanism with a start and a step, s."""
    planar, spatial = mb.catalog.four_bar(), mb.catalog.bricard()
    fast = mb.dynamics(planar, "lagrangian").project(planar.neutral(), np.array([5.0, 0.0, 0.0]))
    return {
        "four_bar": (planar, *fast, 1e-3),
        "bricard": (spatial, spatial.neutral(), np.zeros(spatial.nv), 1e-3),
    }


def measured(model, q, v, dt, method):
    """Return the largest gap and energy error of each window of a run, and its time."""
    dyn, oracle = mb.dynamics(model, "lagrangian", threads=1), mb.dynamics(model, "oracle")
    kept, integrate.along_constraints = integrate.along_constraints, lambda _, outcome: outcome
    try:
        run = mb.simulate(dyn, q, v, STEPS * dt, method, dt=dt, save=KEPT, doubt=False)
    finally:
        integrate.along_constraints = kept
    assert run.stats.finished
    assert run.stats.steps == STEPS
    gap = np.abs(np.asarray(oracle.constraint_residual(run.q), dtype=float)).max(axis=1)
    # A coordinate that has turned far is rounded by its size: that moves ends by as much.
    rounded = EPS / 2 * np.abs(run.q).max(axis=1) * np.abs(dyn.constraint_jacobian(run.q)).sum(axis=2).max(axis=1)
    kinetic = dyn.kinetic_energy(run.q, run.v)
    energy = kinetic + dyn.potential_energy(run.q)
    error = np.abs(energy - energy[0]) / kinetic.max()
    rate = np.abs(dyn.constraint_rate(run.q, run.v)).max(axis=1) / np.abs(run.v).max()
    ends = np.linspace(1, len(run.t), WINDOWS + 1).astype(int)
    parts = [slice(a, b) for a, b in pairwise(ends)]

    def largest(x):
        return [float(x[part].max()) for part in parts]

    windows = {"gap": largest(gap), "rounding": largest(rounded), "rate": largest(rate), "energy": largest(error)}
    return {"steps": STEPS, **windows, "ns_a_step": run.stats.seconds / STEPS * 1e9}


def draw(result):
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    plt.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "mbkit"})
    fig, panels = plt.subplots(2, len(result["scenes"]), figsize=(10, 5.6), sharex=True, sharey="row")
    looks = {"rk4": ("#c44e52", "RK4"), "implicit_midpoint": ("#4c72b0", "implicit midpoint")}
    x = np.linspace(STEPS / WINDOWS, STEPS, WINDOWS)
    for (gaps, energies), (name, scene) in zip(panels.T, result["scenes"].items(), strict=True):
        for method, row in scene["methods"].items():
            color, label = looks[method]
            gaps.semilogy(x, row["gap"], color=color, label=label)
            gaps.semilogy(x, row["rounding"], color=color, ls=":", lw=1)
            energies.semilogy(x, row["energy"], color=color, label=label)
        gaps.axhline(1e-14, color="grey", lw=0.8)
        gaps.set_title(f"{name.replace('_', ' ')}, step {1e3 * scene['dt']:g} ms", fontsize=9.5, loc="left")
        energies.set_xlabel("steps")
    panels[0, 0].set(ylabel="largest gap, m or rad", ylim=(1e-17, 1e-11))
    panels[1, 0].set_ylabel("energy error / largest kinetic energy")
    panels[0, 0].legend(frameon=False, fontsize=8)
    fig.tight_layout()
    fig.savefig(results("figures") / "long_loops.svg", transparent=True, metadata={"Date": None})
    plt.close(fig)


#: See `validation.smoke`.
SMOKE = {"STEPS": 40, "KEPT": 2}


def main():
    path = results("long_loops.json")
    if "--figure" not in sys.argv[1:]:
        found = {}
        for name, (model, q, v, dt) in scenes().items():
            found[name] = {"dt": dt, "methods": {method: measured(model, q, v, dt, method) for method in METHODS}}
        result = {**stamp(__file__), "steps": STEPS, "window": STEPS // WINDOWS, "scenes": found}
        path.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    result = json.loads(path.read_text(encoding="utf-8"))
    draw(result)
    for name, scene in result["scenes"].items():
        for method, row in scene["methods"].items():
            first, last = ({k: f"{row[k][i]:.1e}" for k in ("gap", "rounding", "rate", "energy")} for i in (0, -1))
            print(f"{name:10} {method:18} first {first} last {last} {row['ns_a_step']:.0f} ns a step")


if __name__ == "__main__":
    main()
