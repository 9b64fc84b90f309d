"""What the checks after a run cost: `simulate` beside itself with ``doubt=False``, and `Trajectory.check`.

Run ``python -m validation.checks_cost``; it takes about three minutes. Compiled runs of 0.3 to 20 ms, in turns in one
process; processor times, and the median of the rounds' ratios. The budget: 1.1 with the checks that `simulate` makes.
"""

from __future__ import annotations

import json
import statistics
import time
import warnings

import numpy as np

import mbkit as mb
from validation.stamp import results, stamp

ROUNDS, BATCH = 75, 16
MODELS = {
    "double_pendulum": mb.catalog.double_pendulum,
    "ur5": lambda: mb.load("ur5"),
    "panda": lambda: mb.load("panda"),
}
#: Method, setting, durations in s.
WAYS = (
    ("rk4", {"dt": 1e-3}, (0.01, 0.1, 1.0)),
    ("semi_implicit_euler", {"dt": 1e-3}, (0.01, 0.1, 1.0)),
    ("rk853", {"rtol": 1e-8}, (0.1, 1.0, 10.0)),
)


def seconds(call):
    start = time.process_time()
    call()
    return time.process_time() - start


def row(name, dyn, q, v, method, setting, duration):
    setting = {**setting, "save": np.linspace(0.0, duration, 11)}

    def run(**more):
        return mb.simulate(dyn, q, v, duration, method, **setting, **more)

    checked = run()
    run(doubt=False), checked.check()
    plain, ratios, checks = [], [], []
    for k in range(ROUNDS):
        # The second of two runs finds its memory warm.
        pair = [seconds(lambda doubt=doubt: run(doubt=doubt)) for doubt in ((True, False) if k % 2 else (False, True))]
        with_checks, without = pair if k % 2 else pair[::-1]
        plain.append(without)
        ratios.append(with_checks / without)
        checks.append(seconds(checked.check) / without)
    return {
        "model": name,
        "method": method,
        "trajectories": 1 if q.ndim == 1 else len(q),
        "duration": duration,
        "evaluations": checked.stats.evaluations,
        "run_ms": 1e3 * statistics.median(plain),
        "ratio": statistics.median(ratios),
        "all_checks": statistics.median(checks),
    }


#: See `validation.smoke`.
SMOKE = {
    "MODELS": {"two links": mb.catalog.double_pendulum},
    "ROUNDS": 2,
    "BATCH": 2,
    "WAYS": (("rk4", {"dt": 1e-3}, (0.01,)), ("rk853", {"rtol": 1e-8}, (0.01,))),
}


def main():
    rows = []
    warnings.simplefilter("ignore")
    for name, make in MODELS.items():
        model = make()
        dyn = mb.dynamics(model, "lagrangian")
        q, v = (0.3 * x for x in model.random_state(np.random.default_rng(0), BATCH))
        for method, setting, durations in WAYS:
            for state in ((q[0], v[0]), (q, v)):
                for duration in durations:
                    rows.append(row(name, dyn, *state, method, setting, duration))
                    print(
                        "{model:16} {method:20} {trajectories:3} {run_ms:8.2f} ms  × {ratio:.3f}"
                        "   check() {all_checks:.2f}".format(**rows[-1])
                    )
    print(f"median {statistics.median(r['ratio'] for r in rows):.3f}, largest {max(r['ratio'] for r in rows):.3f}")
    with results("checks_cost.json").open("w", encoding="utf-8") as f:
        json.dump({"rows": rows, **stamp(__file__)}, f, indent=1)


if __name__ == "__main__":
    main()
