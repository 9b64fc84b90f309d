"""Random and damaged files: refused with an error of mbkit's, or read as the format's own engine reads them.

``python -m validation.fuzz`` does the same for 10,000 of each.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import mbkit as mb
from mbkit.engines.mujoco import importer
from tests.random_files import errors, mujoco_terms, mutant, random_mjcf
from validation import fuzz

MUTANTS, MJCFS = 80, 15


def test_damaged_files_are_refused_or_read_as_by_the_engine_of_their_format(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # MuJoCo's log goes into the working folder.
    monkeypatch.chdir(tmp_path)
    files = fuzz.bases()
    assert len(files) == 18
    found = {seed: fuzz.mutant_outcome(seed, tmp_path, files) for seed in range(MUTANTS)}
    assert not {seed: x for seed, x in found.items() if not fuzz.is_good("mutants", x)}
    # Every kind of damage, and enough that is read: else nothing was compared.
    kinds = Counter(x.split(": ")[0] for x in found.values())
    assert len(kinds) == 10
    assert sum("agrees" in x for x in found.values()) > MUTANTS / 8
    assert sum("refused" in x for x in found.values()) > MUTANTS / 8


def test_random_mjcfs_are_those_of_mujocos_compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    found = {seed: fuzz.mjcf_outcome(seed, tmp_path) for seed in range(MJCFS)}
    assert not {seed: x for seed, x in found.items() if not fuzz.is_good("random MJCFs", x)}
    assert sum(x == "agrees" for x in found.values()) > 0.9 * MJCFS


@pytest.mark.parametrize("seed", range(6))
def test_mujocos_importer_describes_what_mujoco_computes(seed: int) -> None:
    text = random_mjcf(seed)
    reference = mujoco_terms(text, 2, seed)
    made = importer.read(text, "mjcf")
    own = made.terms(reference.q, reference.v, ())
    assert max(errors(reference, own["M"], own["nle"], own["passive"]).values()) < 10
    found = fuzz.values(made.model, reference.q, reference.v)
    assert max(errors(reference, *found).values()) < fuzz.ROUNDING


def test_the_same_seed_gives_the_same_file_and_a_small_change_is_seen(tmp_path: Path) -> None:
    text = random_mjcf(3)
    assert text == random_mjcf(3) != random_mjcf(4)
    assert mutant(text.encode(), 8) == mutant(text.encode(), 8)
    (tmp_path / "r.xml").write_text(text, encoding="utf-8")
    reference = mujoco_terms(text, 2, 0)
    M, nle, passive = fuzz.values(mb.load(tmp_path / "r.xml"), reference.q, reference.v)
    assert max(errors(reference, M, nle, passive).values()) < fuzz.ROUNDING
    for k in range(3):
        changed = [M, nle, passive]
        changed[k] = changed[k] + 1e-10 * np.abs(reference.M).max()
        assert max(errors(reference, *changed).values()) > fuzz.ROUNDING


def test_a_judge_tells_each_kind_of_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "r.xml"
    path.write_text(random_mjcf(3), encoding="utf-8")
    model = mb.load(path)
    sound = fuzz.mjcf_judged(path, "error", 0, fuzz.ROUNDING)
    assert fuzz.is_good("random MJCFs", sound)
    for wrong in (lambda *_: 1 / 0, lambda *_, **__: model.without("gravity", "damping", "springs")):
        monkeypatch.setattr(fuzz, "loaded", wrong)
        assert not fuzz.is_good("mutants", f"x: {fuzz.mjcf_judged(path, 'error', 0, fuzz.ROUNDING)}")
    monkeypatch.setattr(fuzz, "loaded", lambda *_: model)
    monkeypatch.setattr(fuzz, "values", lambda *_: "not finite")
    assert not fuzz.is_good("mutants", f"x: {fuzz.mjcf_judged(path, 'error', 0, fuzz.ROUNDING)}")
