"""Digits of accelerations beside the condition of the rows: random loops that are redundant, or nearly so.

Run ``python -m validation.near_redundant``; it writes ``validation/near_redundant.json`` and the figure. Mechanisms and
their accelerations in 40 digits are those of ``tests/test_redundant_rows.py``, which know nothing of mbkit. The error
is that of v̇ in the worst coordinate, over the norm of L⁻¹ f: the acceleration without the loops, with M = L Lᵀ.
"""

from __future__ import annotations

import json
import sys
import warnings

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import mpmath as mp
import numpy as np

import mbkit as mb
from mbkit.errors import MbkitError
from tests.test_redundant_rows import Mechanism
from validation.stamp import results, stamp

EPS = float(np.finfo(float).eps)
SEEDS = 120
ENGINES = {
    "lagrangian": "own derivation",
    "oracle": "oracle",
    "pinocchio": "Pinocchio",
    "mujoco": "MuJoCo, soft",
}


def measured(seed):
    """Return κ of a mechanism, and the error of each engine's accelerations; None where one refuses."""
    with mp.workdps(40):
        mechanism = Mechanism(seed)
        v, exact, condition, free = mechanism.exact(moving=True)
    model = mechanism.model()
    errors = {}
    for engine in ENGINES:
        # The compiled form is the same expression.
        plain = {"compile": False} if engine == "lagrangian" else {}
        try:
            dyn = mb.dynamics(model, engine, **plain)
            a = dyn.forward_dynamics(mechanism.q, v, mechanism.tau)
        except MbkitError:
            errors[engine] = None
            continue
        errors[engine] = float(np.abs(a - exact).max() / free)
    return {"condition": condition, "errors": errors}


def worst(rows, engine):
    """Return the largest error over eps κ, and how many mechanisms an engine refuses."""
    known = [(r["errors"][engine], r["condition"]) for r in rows]
    return max(e / (EPS * k) for e, k in known if e is not None), sum(e is None for e, _ in known)


def draw(result):
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    plt.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "mbkit"})
    fig, ax = plt.subplots(figsize=(7, 3.8), layout="constrained")
    looks = {"lagrangian": ("o", "#4c72b0"), "oracle": ("x", "#55a868"), "pinocchio": ("+", "#c44e52")}
    looks["mujoco"] = (".", "#8c8c8c")
    for engine, label in ENGINES.items():
        known = [(r["condition"], r["errors"][engine]) for r in result["rows"] if r["errors"][engine] is not None]
        x, errors = np.array(known).T
        marker, color = looks[engine]
        face = {"facecolors": "none", "edgecolors": color} if marker == "o" else {"color": color}
        ax.scatter(x, -np.log10(np.clip(errors, 1e-18, 10)), s=22, marker=marker, lw=0.9, label=label, **face)
    x = np.array([1.0, max(r["condition"] for r in result["rows"])])
    ax.plot(x, -np.log10(EPS * x), color="black", lw=0.8, label="eps κ")
    ax.set(xscale="log", xlabel="condition κ of L⁻¹ Jᵀ", ylabel="digits of the acceleration", ylim=(-1.2, 18.5))
    ax.legend(frameon=False, fontsize=8)
    fig.savefig(results("figures") / "near_redundant.svg", transparent=True, metadata={"Date": None})
    plt.close(fig)


#: See `validation.smoke`.
SMOKE = {"SEEDS": 3}


def main():
    path = results("near_redundant.json")
    if "--figure" not in sys.argv[1:]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", mb.errors.MbkitWarning)
            rows = [measured(seed) for seed in range(SEEDS)]
        path.write_text(json.dumps({**stamp(__file__), "rows": rows}, indent=1) + "\n", encoding="utf-8")
    result = json.loads(path.read_text(encoding="utf-8"))
    draw(result)
    for engine in ENGINES:
        error, refused = worst(result["rows"], engine)
        print(f"{engine:12} worst error {error:.2g} eps κ, refuses {refused} of {len(result['rows'])}")


if __name__ == "__main__":
    main()
