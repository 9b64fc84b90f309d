"""Each pair of kinds together in a model, on runs and files: right, or refused by the part's name."""

from __future__ import annotations

import os
import subprocess
import sys
from itertools import combinations
from pathlib import Path

import pytest

from mbkit.model.elements.kinds import PART_KINDS
from mbkit.model.elements.paths import PATHS as GATES
from tests.kind_examples import TYPES, example
from tests.kind_pairs import (
    JOINT_KINDS,
    NAMES,
    PATHS,
    SOUND,
    WRITTEN,
    acts,
    array,
    kind_of,
    names,
    on_one_joint,
    pair_cell,
    paths,
    reason,
)

#: Models of the suite; ``--thorough`` has all of them.
FEW, SLICES = 4, 20
#: Cells that end otherwise: the kinds of the model and the path.
FAULTY: dict[tuple[str, str], str] = {}


def pairs(kinds: frozenset[str]) -> set[frozenset[str]]:
    return {frozenset(x) for x in combinations(kinds, 2)}


def test_each_pair_of_kinds_stands_together_or_is_told_apart() -> None:
    found = array()
    assert {*NAMES, *WRITTEN} == {*PART_KINDS, *TYPES} - {"written.stop"}
    together = set().union(*(pairs(x.acts) for x in found.plans))
    told = {frozenset(x) for two in found.apart.values() for x in two}
    assert together | told == pairs(frozenset({*NAMES, *WRITTEN}))
    assert not together & told
    on_joints = set().union(*(pairs(s.acts) for x in found.plans for s in x.whole.spots))
    told = {frozenset(x) for two in found.apart_on_joints.values() for x in two}
    assert on_joints | told == pairs(frozenset(JOINT_KINDS))
    assert not on_joints & told


def test_what_a_path_takes_two_by_two_it_takes_in_a_model() -> None:
    """But for finer kinds of one joint, which it refuses."""
    for name in {g for gates in PATHS.values() for g in gates}:
        gate = GATES[name]
        taken = [x for x in NAMES if gate.takes(kind_of(x))]
        plans = [x for x in array().plans if all(gate.takes(kind_of(k)) for k in x.acts) and not x.paper]
        together = set().union(*(pairs(x.acts) for x in plans))
        left = [two for two in combinations(taken, 2) if frozenset(two) not in together and not reason(*two)]
        has = {two: {*two}.union(*(kind_of(k).does for k in two)) for two in left}
        assert [two for two in left if not any({*x[:2]} <= has[two] for x in gate.apart)] == []


def test_kinds_that_do_not_stand_on_one_joint_are_told_by_a_sentence() -> None:
    assert "moved 2 times" in on_one_joint("motion.spline", "motion.prescribed")
    assert "mimics none" in on_one_joint("mimic", "motion.formula")
    assert "one type" in on_one_joint("joint_type.ball", "joint_type.free")
    assert "beside joints that mimic others" in reason("mimic", "force.compensation.partial")


def check(name: str, folder: Path) -> None:
    x, k = example(name), int(name.removeprefix("pairs."))
    assert acts(x.model) == array().plans[k].acts
    cells = {path: pair_cell(name, path, folder) for path in paths(name)}
    assert {path: c for path, c in cells.items() if c.outcome not in SOUND and (name, path) not in FAULTY} == {}


@pytest.mark.parametrize("part", range(FEW))
def test_a_model_of_several_kinds_is_right_on_its_paths(part: int, tmp_path: Path) -> None:
    check(names()[7 + part * (len(names()) // FEW)], tmp_path)


@pytest.mark.thorough
@pytest.mark.parametrize("part", range(SLICES))
def test_each_pair_of_kinds_is_right_on_runs_and_files(part: int, tmp_path: Path) -> None:
    for name in names()[part::SLICES]:
        check(name, tmp_path)


@pytest.mark.thorough
def test_the_array_does_not_depend_on_the_order_of_sets() -> None:
    code = "from tests.kind_pairs import array; print(array())"
    ways = (
        subprocess.run(
            [sys.executable, "-c", code], env=os.environ | {"PYTHONHASHSEED": seed}, capture_output=True, check=True
        )
        for seed in "12"
    )
    one, other = (x.stdout for x in ways)
    assert one == other
