"""What holds to where: the study of stiff and extreme cases, its breaking points, and the README's table.

``python -m validation.stress [--quick]`` runs it and writes ``validation/stress.json``: half an hour, quick
a few minutes, on two free cores.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mbkit as mb
from mbkit.studies.stress import Breaking, CaseResult, StressResult
from validation.stamp import results, stamp

#: All of them, at all values, with every method.
CASES = METHODS = VALUES = None
OURS = ("lagrangian", "pinocchio")
#: Seconds that no busy machine uses up, so that a record has every cell; each run is limited by its processor time.
BUDGET = 4 * 3600.0


#: See `validation.smoke`.
SMOKE = {"CASES": ("joint_spring",), "METHODS": ("rk4",), "VALUES": (1e2, 1e4)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--data", type=Path, help="what mbkit stress wrote, instead of a study now")
    asked = parser.parse_args()
    if asked.data is not None:
        result = StressResult.from_json(asked.data.read_text(encoding="utf-8"))
    else:
        result = mb.stress(CASES, methods=METHODS, values=VALUES, quick=asked.quick, budget=BUDGET)
    rows = list(result.breaking())
    told: dict[str, Any] = {
        **({} if asked.data else {name: stamp(__file__)[name] for name in ("date", "code")}),
        "processor": result.processor,
        "versions": result.versions,
        "seconds": result.seconds,
        "settings": result.settings,
        "silent": len(result.silent()),
        "cases": [
            {
                "name": case.name,
                "parameter": case.parameter,
                "unit": case.unit,
                "measure": case.measure,
                "values": case.values,
                "breaking": [_plain(b) for b in rows if b.case == case.name],
            }
            for case in result.cases
        ],
    }
    results("stress.json").write_text(json.dumps(told, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    print("\n".join(table(result.cases, rows)))


def _plain(b: Breaking) -> dict[str, Any]:
    return {name: getattr(b, name) for name in ("engine", "method", "held", "failed", "how")}


def table(cases: Iterable[CaseResult], rows: list[Breaking]) -> list[str]:
    """Return a line of Markdown for each case in which something moves."""
    out = [
        "| case | swept | `auto` holds to | best fixed choice | to | MuJoCo's own, best | to |",
        "|---|---|---:|---|---:|---|---:|",
    ]
    for case in cases:
        if case.measure != "motion" or case.family == "step":
            continue
        own = [b for b in rows if b.case == case.name]
        auto = _best(case, [b for b in own if b.method == "auto" and b.engine in OURS])
        hand = _best(case, [b for b in own if b.method != "auto" and not b.method.startswith("mujoco_")])
        native = _best(case, [b for b in own if b.method.startswith("mujoco_")])
        cells = [f"{case.parameter}, {case.unit or '1'}: {case.values[0]:g} … {case.values[-1]:g}", _to(case, auto)]
        cells += [_name(hand), _to(case, hand), _name(native), _to(case, native)]
        out.append(f"| {case.name} | {' | '.join(cells)} |")
    return out


def _place(case: CaseResult, b: Breaking) -> int:
    return -1 if b.held is None else case.values.index(b.held)


def _best(case: CaseResult, rows: list[Breaking]) -> Breaking | None:
    return max(rows, key=lambda b: _place(case, b), default=None)


def _name(b: Breaking | None) -> str:
    if b is None or b.held is None:
        return ""
    return f"`{b.method}`" if b.method.startswith("mujoco") else f"`{b.method}`, {b.engine}"


def _to(case: CaseResult, b: Breaking | None) -> str:
    if b is None:
        return "–"
    if b.held is None:
        return "none"
    return "all" if math.isclose(b.held, case.values[-1]) else f"{b.held:g}"


if __name__ == "__main__":
    main()
