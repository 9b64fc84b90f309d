"""What a URDF says of links that a parser merges, because they are fixed to each other.

A `Model` has one body for them, whose numbers all follow from any of theirs. So that an edit is told by
the name of the link or joint that was edited, their own numbers are recorded too, where it is known
which file a model came from.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from mbkit.errors import MbkitError, MbkitWarning
from mbkit.load import load
from mbkit.load.names import find
from mbkit.load.urdf_links import read_links
from mbkit.model import Model
from mbkit.studies.baseline.changes import Change
from mbkit.studies.baseline.description import Description, described
from mbkit.studies.baseline.target import resolved

__all__ = ["SECTIONS", "links_of", "without_consequences"]

SECTIONS: Final = ("links", "places")
_PLACE: Final = ("translation", "rotation")


def links_of(model: Model, target: str, options: Mapping[str, Any], baseline: Path) -> Description:
    """Return the sections "links" and "places"; nothing where the target is no URDF that makes this very model."""
    path = _urdf(target, baseline)
    if path is None:
        return {}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MbkitWarning)
            # By the name it was asked for by, whose bad bodies are taken as written.
            if load(resolved(target, baseline), **options).digest != model.digest:
                return {}
            return _merged(read_links(path))
    except (MbkitError, TypeError):
        # It only sharpens what is told; whoever loads the target tells what is wrong with it.
        return {}


def _urdf(target: str, baseline: Path) -> Path | None:
    if not target:
        return None
    if target.lower().endswith(".urdf"):
        return Path(resolved(target, baseline))
    try:
        robot = find(target)
    except MbkitError:
        return None
    return robot.path if robot else None


def _merged(whole: Model) -> Description:
    """Return the links that share a body with others, and the places of the joints upon these."""
    host: dict[str, str] = {}
    for joint in whole.tree:
        fixed = joint.kind == "fixed" and joint.parent != "world"
        host[joint.child] = host[joint.parent] if fixed else joint.child
    size = Counter(host.values())
    shared = [link for link, body in host.items() if size[body] > 1]
    parts = described(whole)
    bodies, joints = parts["bodies"], parts["joints"]
    return {
        "links": {link: bodies[link] for link in shared},
        "places": {n: {f: p[f] for f in _PLACE if f in p} for n, p in joints.items() if p["parent"] in shared},
    }


def without_consequences(found: tuple[Change, ...], old: Description) -> tuple[Change, ...]:
    """Return the changes without those of merged bodies and frames that follow from a link's."""
    if not any(c.section in SECTIONS for c in found):
        return found
    hosts = {frame["body"] for frame in old.get("frames", {}).values() if "body" in frame}
    return tuple(c for c in found if not _follows(c, old, hosts))


def _follows(change: Change, old: Description, hosts: set[str]) -> bool:
    if change.section == "frames":
        return change.field in _PLACE
    if change.section == "joints":
        return change.field in _PLACE and change.part in old.get("places", {})
    return change.section == "bodies" and change.part in hosts and change.field != ""
