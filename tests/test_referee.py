"""Public names and their signatures are a contract: scripts outside this repository call them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from tests import referee

NAMES = Path(__file__).parent / "public_names.json"


def test_public_names_and_signatures_are_those_recorded():
    """After a wanted change, record them again: ``python -m tests.referee names``."""
    recorded = json.loads(NAMES.read_text(encoding="utf-8"))
    assert list(referee.differences(recorded, json.loads(json.dumps(referee.public_names())))) == []


def test_the_referee_sees_what_changes():
    before = {"a": {"b": [1, 2]}, "c": "x"}
    assert list(referee.differences(before, {"a": {"b": [1, 2]}, "c": "x"})) == []
    assert list(referee.differences(before, {"a": {"b": [1, 3]}, "d": 1})) == ["/a/b/1: 2 -> 3", "/c: gone", "/d: new"]


def test_each_part_of_the_package_is_there_without_an_import_of_its_own():
    code = (
        "import mbkit; print(*(type(getattr(mbkit, n)).__name__ for n in ('engines', 'model', 'spatial', 'studies')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["module"] * 4
