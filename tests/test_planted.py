"""The list of planted defects stays true: every text still stands once in its file, and its tests exist."""

from __future__ import annotations

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
