"""Every robot of example-robot-data through Pinocchio's, MuJoCo's and Drake's own importers.

Run ``python -m validation.importers``; it writes ``validation/importers.json``, with the base held still, and
``validation/importers_floating.json``, with a floating base, in about a minute.

``python -m validation.importers newton mujoco-warp`` measures importers in environments of their own, with the base
held still, and keeps the columns of the others in ``validation/importers_trained.json``: some minutes each.

For each robot and importer: whether it moves as the file says, why not, and the lines of the file
that make the difference, so that each cause can be checked by eye. With a floating base the reasons
alone, of those that do not agree.
"""

from __future__ import annotations

import json
import re
import sys
from typing import Any

from mbkit.engines.imported import IMPORTERS
from mbkit.load import xml_reader
from mbkit.load.xml_reader import Element
from mbkit.studies.explain.result import Cause, effect, grouped
from mbkit.studies.importers import Parsed, compare_parsers
from mbkit.studies.results import to_plain
from validation.robots import FEW, chosen
from validation.stamp import results, stamp

#: All of them.
ROBOTS = None
QUOTED = re.compile(r"'([^']+)'")


def excerpt(root: Element, lines: list[str], text: str) -> str:
    """Return the lines of the first link or joint that a sentence names, with its numbers."""
    for name in QUOTED.findall(text):
        for element in root.all("link") + root.all("joint"):
            if element.attributes.get("name") == name:
                part = element.first("inertial") or element.first("mimic")
                if part is not None:
                    end = max(e.line for e in part.walk())
                    told = " ".join(x.strip() for x in lines[part.line - 1 : end])
                    return f"line {part.line}: {' '.join(told.split())}"
    return ""


def told(p: Parsed, root: Element, lines: list[str]) -> dict[str, Any]:
    """Return one importer's reading as a row."""
    out: dict[str, Any] = {"version": p.version}
    if p.refused:
        return out | {"status": "refuses", "why": p.refused, "excerpt": excerpt(root, lines, p.refused)}
    assert p.explanation is not None
    acting = [cause(c, root, lines) for c in p.explanation.causes if c.acts]
    silent = [says for _, says, _ in grouped(c for c in p.explanation.causes if not c.acts)]
    worst = {s.name: s.worst for s in p.stages if s.name in ("M", "g", "nle")}
    status = "agrees" if p.agrees else "differs"
    return out | {
        "status": status,
        "worst": worst,
        "causes": acting,
        "data": silent,
        "notes": list(p.notes),
        "explained": p.explanation.explained,
    }


def cause(c: Cause, root: Element, lines: list[str]) -> dict[str, str]:
    """Return a cause with the lines that it stems from."""
    # "body 'A': mujoco leaves out link 'B'": B is the culprit.
    culprit = c.says.split(": ", 1)[1] if "link '" in c.says.split(": ", 1)[-1] else c.says
    return {"kind": c.kind, "says": c.says, "effect": effect(c), "excerpt": excerpt(root, lines, culprit)}


def briefly(p: Parsed) -> dict[str, Any]:
    """Return one importer's reading of a robot whose base floats."""
    if p.refused:
        return {"status": "refuses", "why": p.refused}
    if p.agrees or p.explanation is None:
        return {"status": "agrees"}
    worst = max(s.worst for s in p.stages if s.name in ("M", "g", "nle"))
    says = [f"{kind}: {says} ({what})" for kind, says, what in grouped(p.explanation.acting)]
    return {"status": "differs", "worst": worst, "causes": says, "explained": p.explanation.explained}


def trained(names: list[str]) -> None:
    """Measure importers in environments of their own, and write after each robot."""
    path = results("importers_trained.json")
    held = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    table: dict[str, Any] = held.get("robots", {})
    for robot in chosen(ROBOTS):
        result = compare_parsers(robot.path, names)
        root, lines = xml_reader.read(robot.path), robot.path.read_text(encoding="utf-8").splitlines()
        row = {p.engine.partition("==")[0]: told(p, root, lines) for p in result.importers if p.stages or p.refused}
        table[robot.name] = table.get(robot.name, {}) | row
        path.write_text(json.dumps(stamp(__file__) | {"robots": to_plain(table)}, indent=1) + "\n", encoding="utf-8")
        print(f"{robot.name}: {result.verdict}", flush=True)


#: See `validation.smoke`.
SMOKE = {"ROBOTS": FEW}


def main() -> None:
    """Run and write."""
    if sys.argv[1:]:
        trained(sys.argv[1:])
        return
    table: dict[str, Any] = {}
    floating: dict[str, Any] = {}
    for robot in chosen(ROBOTS):
        result = compare_parsers(robot.path, floating_base=True)
        floating[robot.name] = {p.engine: briefly(p) for p in result.importers}
        result = compare_parsers(robot.path)
        root, lines = xml_reader.read(robot.path), robot.path.read_text(encoding="utf-8").splitlines()
        table[robot.name] = {p.engine: told(p, root, lines) for p in result.importers}
        print(f"{robot.name}: {result.verdict}", flush=True)
    for name, told_of in (("importers", table), ("importers_floating", floating)):
        text = json.dumps(stamp(__file__) | {"robots": to_plain(told_of)}, indent=1) + "\n"
        results(f"{name}.json").write_text(text, encoding="utf-8")
    for engine in IMPORTERS:
        agree = [sum(row[engine]["status"] == "agrees" for row in x.values()) for x in (table, floating)]
        print(f"{engine} agrees on {agree[0]}, and on {agree[1]} with a floating base")


if __name__ == "__main__":
    main()
