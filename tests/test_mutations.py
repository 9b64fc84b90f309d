"""Each path asks its gate, each refusal is needed, and each check sees the part: `tests.kind_mutations`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests import kind_mutations as mutations
from tests.kind_paths import COLUMNS, ROWS, registered

mutations.checks()
pytestmark = pytest.mark.usefixtures("own_environments")
GATES = sorted({*registered()} - {*mutations.ELSEWHERE})
RECORDED = json.loads((Path(__file__).parent.parent / "validation" / "matrix.json").read_text(encoding="utf-8"))
RIGHT = {(r["kind"], path) for r in RECORDED["rows"] for path, cell in r["cells"].items() if cell[0] == "right"}


def survivors(mutation: str, path: str, folder: Path, most: int | None = None) -> list[str]:
    """Return the kinds whose mutation nothing notices, among all or the first ones from a place of the path's own."""
    names = [name for name in ROWS if mutation != "removed" or (name, path) in RIGHT]
    names = [name for name in names if mutation != "admitted" or name not in mutations.NEEDLESS.get(path, ())]
    start, out = 7 * sorted([*GATES, *COLUMNS]).index(path), []
    for k in range(len(names)):
        name = names[(start + k) % len(names)]
        if (got := getattr(mutations, mutation)(name, path, folder)) is not None:
            out += [name] * (got.outcome == "survives")
            if most and (most := most - 1) == 0:
                break
    return out


@pytest.mark.thorough(every=11)
@pytest.mark.parametrize("mutation", ["dropped", "admitted"])
@pytest.mark.parametrize("gate", GATES)
def test_a_gate_that_forgets_a_kind_or_lets_one_pass_is_noticed(gate: str, mutation: str, tmp_path: Path) -> None:
    assert survivors(mutation, gate, tmp_path, most=1) == []


@pytest.mark.thorough(every=19)
@pytest.mark.parametrize("path", COLUMNS)
def test_a_path_without_a_part_is_not_right(path: str, tmp_path: Path) -> None:
    assert survivors("removed", path, tmp_path, most=1) == []


@pytest.mark.thorough
@pytest.mark.parametrize("mutation", ["dropped", "admitted"])
@pytest.mark.parametrize("gate", GATES)
def test_no_mutation_of_a_gate_survives(gate: str, mutation: str, tmp_path: Path) -> None:
    assert survivors(mutation, gate, tmp_path) == []


@pytest.mark.thorough
@pytest.mark.parametrize("path", COLUMNS)
def test_no_column_is_right_without_the_part(path: str, tmp_path: Path) -> None:
    assert survivors("removed", path, tmp_path) == []
