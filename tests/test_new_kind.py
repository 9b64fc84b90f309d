"""Two kinds of elements of one's own (`tests.kinds_of_ones_own`): one file makes them known to every path.

Each is a row of the matrix (`tests.test_matrix`) as long as it is registered.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path

import pytest

import mbkit as mb
from mbkit.errors import InputError, UnsupportedError
from mbkit.model.elements.formula import written
from mbkit.model.elements.kinds import PART_KINDS, register_kind
from tests.kind_examples import EXAMPLES, alone
from tests.kind_studies import COLUMNS, cell, registered
from tests.kinds_of_ones_own import OWN

pytestmark = pytest.mark.usefixtures("own_environments")
CELLS = [*product(OWN, COLUMNS)]


@contextmanager
def registered_as(prefix: str, does: str) -> Iterator[None]:
    for name, (cls, part) in OWN.items():
        kind = f"{prefix}.{name}"
        register_kind("forces", kind, "{p}", does, "", "forces", lambda _, p, cls=cls: type(p) is cls)
        EXAMPLES[kind] = alone(part)
    yield
    for name in OWN:
        del PART_KINDS[f"{prefix}.{name}"], EXAMPLES[f"{prefix}.{name}"]


@pytest.fixture
def unknown() -> Iterator[None]:
    with registered_as("first", ""):
        yield


@pytest.fixture
def known() -> Iterator[None]:
    with registered_as("own", "force.joint"):
        yield


def outcome(name: str, path: str, folder: Path) -> tuple[str, str]:
    if path in ("C", "program text in C") and shutil.which("cc") is None:
        pytest.skip("no C compiler on PATH")
    got = cell(name, path, folder)
    return got.outcome, got.text


@pytest.mark.parametrize("power", [0, -1, 0.5])
def test_a_law_with_another_power_is_refused(power) -> None:
    with pytest.raises(InputError, match="expected a whole number above zero"):
        written(lambda q: q**power, "q")


@pytest.mark.parametrize("name", OWN)
def test_one_that_no_kind_has_is_refused_on_every_path(name) -> None:
    model = alone(OWN[name][1])("one").model
    words = f"is a {OWN[name][0].__name__}, which no kind has"
    assert [path for path, gate in registered().items() if words not in gate.refuses(model)] == []
    with pytest.raises(UnsupportedError, match="which no kind has"):
        mb.convert(model, "mjcf")


@pytest.mark.usefixtures("unknown")
@pytest.mark.parametrize("name", OWN)
def test_on_its_first_day_every_gate_refuses_it_by_name(name) -> None:
    told = {"spring": "force 'x' at joint 'j0', of ", "damper": "force 'x' at joint 'j0' and 'j1', of "}
    model = EXAMPLES[f"first.{name}"](name).model
    assert [path for path, gate in registered().items() if told[name] not in gate.refuses(model)] == []


@pytest.mark.thorough(every=29)
@pytest.mark.usefixtures("unknown")
@pytest.mark.parametrize(("name", "path"), CELLS)
def test_on_its_first_day_no_path_has_it(name, path, tmp_path: Path) -> None:
    got = outcome(f"first.{name}", path, tmp_path)
    assert got[0] in ("refused", "left out", "not asked") or (path, got[0]) == ("without", "right"), got


@pytest.mark.thorough(every=23)
@pytest.mark.usefixtures("known")
@pytest.mark.parametrize(("name", "path"), CELLS)
def test_what_does_the_same_as_a_force_at_a_joint_goes_as_far(name, path, tmp_path: Path) -> None:
    got, like = (outcome(x, path, tmp_path) for x in (f"own.{name}", "force.joint"))
    assert (got[0] == "refused") == (like[0] == "refused"), (got, like)
    assert got[0] in ("right", "refused", "not asked"), got
