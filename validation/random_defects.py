"""Defects drawn at random: a sign, a factor or a dropped branch of any function; how many does the suite notice?

Run ``python -m validation.random_defects [SEED [COUNT]] [--covered FILE]``: the seed draws the defects, nobody chooses
them. Each goes alone into a copy (`validation.planted`). The tests that run are those of the whole suite, hours for 40
defects; with ``--covered``, a JSON of {"mbkit/file.py": {line: [tests]}} as a coverage run measures it, only those that
reach the line. Exit status 1 if fewer than 36 of 40 are noticed.
"""

from __future__ import annotations

import argparse
import ast
import json
import random
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from validation.planted import TOP, Defect, copied, planted

#: Of the defects drawn, the least share that has to be noticed.
NOTICED = 0.9


def _functions(tree: ast.Module) -> Iterator[ast.AST]:
    """Yield the nodes of all functions' bodies, without annotations."""
    for function in (x for x in ast.walk(tree) if isinstance(x, ast.FunctionDef)):
        for statement in function.body:
            yield from ast.walk(statement)


def _segment(source: str, node: ast.AST) -> str:
    return ast.get_source_segment(source, node) or ""


def _changes(source: str) -> Iterator[tuple[str, ast.AST, str]]:
    """Yield kind, node and what takes its place, of everything that may go wrong in a file."""
    for node in _functions(ast.parse(source)):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub):
            other = "-" if isinstance(node.op, ast.Add) else "+"
            sides = _segment(source, node.left), _segment(source, node.right)
            if not any(
                isinstance(x, ast.Constant | ast.JoinedStr | ast.List | ast.Tuple) for x in (node.left, node.right)
            ):
                yield "sign", node, f"({sides[0]}) {other} ({sides[1]})"
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            yield "sign", node, _segment(source, node.operand)
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult | ast.Div):
            yield "factor", node, f"2 * ({_segment(source, node)})"
        elif isinstance(node, ast.If):
            yield "branch", node.test, "False"
        elif isinstance(node, ast.IfExp):
            yield "branch", node, f"({_segment(source, node.orelse)})"


def _defect(file: str, source: str, node: ast.AST, wrong: str) -> Defect:
    """Return the defect as whole lines, with as many before it as make them unique."""
    lines = source.splitlines(keepends=True)
    first, last = node.lineno - 1, node.end_lineno  # type: ignore[attr-defined]
    encoded = [lines[first].encode(), lines[last - 1].encode()]
    head, tail = encoded[0][: node.col_offset].decode(), encoded[1][node.end_col_offset :].decode()  # type: ignore[attr-defined]
    text, changed = "".join(lines[first:last]), head + wrong + tail
    while source.count(text) != 1:
        first -= 1
        text, changed = lines[first] + text, lines[first] + changed
    return Defect(file, text, changed, ())


def drawn(seed: int, count: int) -> list[tuple[str, int, Defect]]:
    """Return kind, line and defect: the kinds in turn, each anywhere with equal chance."""
    found: dict[str, list[tuple[str, ast.AST, str]]] = {"sign": [], "factor": [], "branch": []}
    sources = {str(p.relative_to(TOP / "mbkit")): p.read_text("utf-8") for p in sorted((TOP / "mbkit").rglob("*.py"))}
    for file, source in sources.items():
        for kind, node, wrong in _changes(source):
            found[kind].append((file, node, wrong))
    rng, out = random.Random(seed), []
    while len(out) < count:
        kind = list(found)[len(out) % 3]
        file, node, wrong = rng.choice(found[kind])
        out.append((kind, node.lineno, _defect(file, sources[file], node, wrong)))  # type: ignore[attr-defined]
    return out


def main() -> int:
    """Draw, plant and count."""
    parser = argparse.ArgumentParser()
    parser.add_argument("seed", type=int, nargs="?", default=0)
    parser.add_argument("count", type=int, nargs="?", default=40)
    parser.add_argument("--covered", type=Path)
    args = parser.parse_args()
    covered = json.loads(args.covered.read_text("utf-8")) if args.covered else None
    noticed = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = copied(Path(folder) / "copy")
        for k, (kind, line, defect) in enumerate(drawn(args.seed, args.count)):
            tests = ["tests"] if covered is None else covered.get(defect.path, {}).get(str(line), [])
            caught, seconds = planted(defect, copy, tests) if tests else ("", 0.0)
            noticed += bool(caught)
            print(f"{k + 1:3} {kind:6} {defect.path}:{line}  {caught or 'NOTHING'}  {seconds:.0f} s", flush=True)
            if not caught:
                print(f"    {defect.text.strip()}\n -> {defect.wrong.strip()}", flush=True)
    print(f"{noticed} of {args.count} defects were noticed")
    return int(noticed < NOTICED * args.count)


if __name__ == "__main__":
    sys.exit(main())
