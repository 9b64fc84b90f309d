"""`python -m validation`: every part runs, with little of everything, and a file of results tells its code."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mbkit.codegen import jit
from validation import matrix, smoke, stamp, thresholds
from validation.__main__ import PARTS
from validation.pages import LEVELS, SIMD, lanes, origin

KEPT = Path(stamp.__file__).parent
STAMP = {"date", "versions", "processor", "simd", "code"}
#: Written into a file by whoever measured.
BY_HAND = {"gpu.json": {"left out", "remarks"}, "derivation.json": {"python"}}


@pytest.mark.thorough("bench_terms", "friction", "flexible", "importers", "identification", "auto")
@pytest.mark.parametrize("name", PARTS)
def test_a_part_runs_and_writes_what_is_kept(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for file, data in smoke.run(name, tmp_path).items():
        wanted = set(json.loads((KEPT / file).read_text(encoding="utf-8"))) - STAMP - BY_HAND.get(file, set())
        assert wanted <= set(data), file
        assert stamp.changed(data.get("made", data)) == ""
    assert all((tmp_path / x).is_file() for x in PARTS[name].writes)


def test_the_matrix_counts_mutations(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in matrix.SMOKE.items():
        monkeypatch.setattr(matrix, name, value)
    found = matrix.mutations()
    assert [*found] == ["dropped", "admitted", "removed"]
    assert all(x["mutants"] and not x["survive"] for x in found.values())


SCRIPT = '''"""Says what it does."""
from validation.other import value
# Why.
print(value)
'''


def test_the_code_of_a_script_is_what_it_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "validation"
    folder.mkdir()
    monkeypatch.setattr(stamp, "HERE", folder)

    def digest(script: str = SCRIPT, other: str = "value = 1\n") -> str:
        (folder / "one.py").write_text(script, encoding="utf-8")
        (folder / "other.py").write_text(other, encoding="utf-8")
        stamp.script_code.cache_clear()
        return stamp.script_code("one")

    try:
        first = digest()
        assert digest(SCRIPT.replace("Says", "Tells").replace("# Why.", "# For a reason.\n")) == first
        assert digest(SCRIPT.replace("print", "repr")) != first
        assert digest(other="value = 2\n") != first
        assert digest(other='value = 1\n\n\ndef f():\n    """Text."""\n') != first
    finally:
        stamp.script_code.cache_clear()


def test_a_caption_says_that_other_code_made_a_file() -> None:
    data = {"date": "2026-01-01", **stamp.stamp(stamp.__file__)}
    assert "code" not in origin(data, "accuracy").data
    old = {k: x for k, x in data.items() if k != "code"}
    assert "made before the code was kept with it" in origin(old, "accuracy").data
    for part, words in (("script", "made by other code"), ("mbkit", "mbkit's code has changed since")):
        assert words in origin(data | {"code": data["code"] | {part: "another"}}, "accuracy").data


def test_ratios_of_batches_stand_with_the_level_of_simd() -> None:
    assert set(PARTS) >= SIMD
    told = stamp.stamp("accuracy.py")
    assert lanes(told) == f"SIMD of {jit.host().width} doubles ({LEVELS[jit.host().width]})"
    assert lanes({"simd": {"doubles": 4}}) == "SIMD of 4 doubles (AVX2)"
    for part in SIMD:
        assert lanes(told) in origin(told, part).data
        assert "the level of SIMD was not kept" in origin({"date": "2026-01-01"}, part).data


def test_thresholds_are_told_from_constants_and_found_in_tests(tmp_path: Path) -> None:
    package, tests = tmp_path / "mbkit", tmp_path / "tests"
    package.mkdir()
    tests.mkdir()
    (package / "a.py").write_text(
        "EPS = 2.0**-52\n_MAX_STEPS = 20\nG: float = 9.81\nON, NAME = True, 'a'\n"
        "def f(x):\n    return G * x if x < 8 * _MAX_STEPS else scipy.rank(x, rcond=EPS)\n"
    )
    (package / "b.py").write_text("from mbkit.a import EPS\n_ERROR_RATIO = 8 * EPS\ny = min(x, z[:_ERROR_RATIO])\n")
    (tests / "test_a.py").write_text("monkeypatch.setattr(a, '_MAX_STEPS', 2)\n")
    found = {c.name: (c.value, c.threshold, c.tests) for c in thresholds.constants(package, tests)}
    assert found == {
        "EPS": (2.0**-52, True, ()),
        "_MAX_STEPS": (20, True, ("test_a.py",)),
        "G": (9.81, False, ()),
        "_ERROR_RATIO": (2.0**-49, True, ()),
    }
