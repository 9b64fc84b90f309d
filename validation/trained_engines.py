"""The engines that robots are trained in, term by term on every robot of example-robot-data: ``trained_engines.json``.

``python -m validation.trained_engines [ENGINE ...] [ROBOT ...]`` measures Newton, MuJoCo Warp, and MJX in both
precisions on every robot, or those that are named, and keeps the rows of the others. Each engine takes the description
itself, not a file through its own importer. The reference has 34 digits. An environment that is missing is made.
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from typing import Any

import mbkit as mb
from mbkit.engines.registry import DERIVED
from mbkit.engines.remote.packages import engine
from mbkit.studies.compare.result import Comparison
from validation.robots import FEW, chosen
from validation.stamp import results, stamp

ENGINES = ("newton", "mujoco-warp", "mjx", "mjx-single")
SAMPLES = 24
#: All of them.
ROBOTS = None


def measured(model: mb.Model, name: str) -> dict[str, Any]:
    """Return one engine's digits of each term of a model, or why it has none."""
    begun = time.perf_counter()
    version = engine(name)
    try:
        result: Comparison = mb.compare(model, (DERIVED, version), samples=SAMPLES, terms_only=True)
    except mb.errors.MbkitError as error:
        return {"refused": str(error)}
    rows = [r for r in result.rows if r.engine == version.name]
    if not rows:
        return {"refused": "; ".join(r.reason for r in result.refusals if r.engine == version.name and not r.term)}
    return {
        "passed": all(r.passed for r in rows),
        "errors": {r.term: r.relative for r in rows},
        "allowed": {r.term: r.allowed for r in rows},
        "failed": {r.term: r.reason for r in rows if not r.passed},
        "seconds": round(time.perf_counter() - begun, 1),
    }


#: See `validation.smoke`.
SMOKE = {"ENGINES": ("mujoco==4.0.0",), "SAMPLES": 2, "ROBOTS": FEW}


def main() -> None:
    """Measure the robots one after the other, and write after each."""
    names = [x for x in sys.argv[1:] if x in ENGINES] or ENGINES
    wanted = [x for x in sys.argv[1:] if x not in ENGINES]
    out = results("trained_engines.json")
    held = json.loads(out.read_text(encoding="utf-8")) if out.exists() else {}
    robots = held.get("robots", {})
    for robot in chosen(ROBOTS):
        if wanted and not any(x in robot.name for x in wanted):
            continue
        rows = robots.setdefault(robot.name, {})
        try:
            with warnings.catch_warnings(action="ignore"):
                model = mb.load(robot.name)
                for name in names:
                    rows[name] = measured(model, name)
        except mb.errors.MbkitError as error:
            # Without the folder of this machine.
            rows["refused"] = str(error).replace(f"{robot.path.parent}/", "")
        versions = {name: engine(name).version for name in ENGINES}
        text = {"samples": SAMPLES, "engines": versions, "robots": robots, **stamp(__file__)}
        out.write_text(json.dumps(text, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        said = ", ".join(f"{n}: {r.get('passed', r)}" for n, r in rows.items() if isinstance(r, dict))
        print(f"{robot.name}: {said or rows}", flush=True)


if __name__ == "__main__":
    main()
