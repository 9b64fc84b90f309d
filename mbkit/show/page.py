"""A scene as one HTML file, with its viewer in it: nothing is loaded, and only the page's own script may run."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import zlib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from mbkit import _escape
from mbkit.show.scene import Scene
from mbkit.show.surfaces import Surface


def html(scene: Scene) -> str:
    """Return the page."""
    script = _text("viewer.js")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    # A name that holds </script> would end the element.
    data = json.dumps(content(scene), separators=(",", ":")).replace("<", "\\u003c")
    title = _escape.html(_escape.one_line(scene.name))
    parts = {"digest": f"sha256-{digest}", "title": title, "scene": data, "script": script}
    return re.sub("@(digest|title|scene|script)@", lambda match: parts[match[1]], _text("page.html"))


@cache
def _text(name: str) -> str:
    return (Path(__file__).parent / name).read_text(encoding="utf-8")


def content(scene: Scene) -> dict[str, Any]:
    """Return what the viewer reads.

    ``data`` is one block of bytes, compressed, in base64: of each geometry vertices in 65,535 steps of its extent and
    triangles as differences of indices; of each frame and body position (m) and quaternion (x, y, z, w).
    """
    from scipy.spatial.transform import Rotation

    block = bytearray()

    def put(array: np.ndarray) -> int:
        at = len(block)
        block.extend(array.tobytes())
        block.extend(bytes(-len(block) % 4))
        return at

    geometries: list[dict[str, Any]] = []
    numbers: dict[int, int] = {}
    shapes = []
    for shape in scene.shapes:
        rotation = Rotation.from_matrix(shape.rotation).as_quat()
        for surface in shape.surfaces:
            if id(surface) not in numbers:
                numbers[id(surface)] = len(geometries)
                geometries.append(_packed(surface, put))
            color = surface.color or shape.color
            shapes.append(
                {
                    "body": scene.bodies.index(shape.body),
                    "geometry": numbers[id(surface)],
                    "pose": [round(float(x), 7) for x in (*shape.translation, *rotation)],
                    "color": [round(min(max(x, 0.0), 1.0), 4) for x in color],
                }
            )
    turned = Rotation.from_matrix(scene.rotations.reshape(-1, 3, 3)).as_quat().reshape(*scene.rotations.shape[:2], 4)
    poses = put(np.concatenate([scene.translations, turned], axis=-1).astype("<f4"))
    return {
        "name": _escape.one_line(scene.name),
        "bodies": [_escape.one_line(name) for name in scene.bodies],
        "shapes": shapes,
        "geometries": geometries,
        "t": [round(float(t), 9) for t in scene.t],
        "poses": poses,
        "ground": scene.ground,
        "camera": scene.camera,
        "data": base64.b64encode(zlib.compress(bytes(block))).decode(),
    }


def _packed(surface: Surface, put: Any) -> dict[str, Any]:
    low = surface.vertices.min(axis=0)
    step = np.maximum(np.ptp(surface.vertices, axis=0), 1e-30) / 65535
    grid = np.rint((surface.vertices - low) / step).astype("<u2")
    jumps = np.diff(surface.triangles.ravel(), prepend=0).astype("<i4")
    return {
        "vertices": [put(grid), len(surface.vertices)],
        "triangles": [put(jumps), len(surface.triangles)],
        "low": low.tolist(),
        "step": step.tolist(),
    }
