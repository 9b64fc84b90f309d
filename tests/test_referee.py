"""Public names and their signatures are a contract: scripts outside this repository call them."""

from __future__ import annotations

import json
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
