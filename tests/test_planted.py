"""The list of planted defects stays true: every text still stands once in its file, and its tests exist.

And the marks of thorough cases leave out what they name, and no more.
"""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from tests.conftest import is_thorough
from validation.planted import TOP, defects


def test_every_defect_can_be_planted() -> None:
    listed = defects()
    assert len(listed) >= 80
    assert len({(d.file, d.text) for d in listed}) == len(listed)
    for defect in listed:
        sound = (TOP / defect.path).read_text(encoding="utf-8")
        assert sound.count(defect.text) == 1, (defect.file, defect.text)
        assert defect.wrong != defect.text
        assert defect.tests
        assert all((TOP / f"tests/{name}.py").is_file() for name in defect.tests), defect.tests


def test_they_are_of_every_package() -> None:
    packages = {path.name for path in (TOP / "mbkit").iterdir() if (path / "__init__.py").is_file()}
    assert packages <= {d.file.split("/")[0] for d in defects()}


@pytest.mark.parametrize(
    ("mark", "left_out"),
    [
        (None, [False, False, False, False]),
        (pytest.mark.thorough, [True, True, True, True]),
        (pytest.mark.thorough("b", "x-d"), [False, True, False, True]),
        (pytest.mark.thorough(every=2), [False, True, True, False]),
    ],
)
def test_thorough_marks_leave_out_what_they_name(mark: pytest.MarkDecorator | None, left_out: list[bool]) -> None:
    found = None if mark is None else mark.mark
    cases = [
        SimpleNamespace(name=f"test[{x}]", get_closest_marker=lambda _name: found) for x in ("a", "b", "bb", "x-d")
    ]
    assert [is_thorough(case, k) for k, case in enumerate(cases)] == left_out
