"""A scene as a picture or a film, drawn with Matplotlib: triangles from far to near, with the page's light and camera.

Sorting by depth (Newell, Newell and Sancha 1972, A solution to the hidden surface problem) is right for all but long
triangles and those that pass through each other.
"""

from __future__ import annotations

from pathlib import Path
from subprocess import CalledProcessError
from typing import Any, Final

import numpy as np

from mbkit._check import Array, needed
from mbkit.errors import OutputError, UnsupportedError
from mbkit.show.scene import HALF_ANGLE_DEGREES, Scene, camera_axes

#: Suffix -> Matplotlib's writer, and what to install where it is missing.
FILMS: Final = {".gif": ("pillow", "pip install pillow"), ".mp4": ("ffmpeg", "install ffmpeg")}
PICTURES: Final = (".png",)
#: Triangles of a frame, which Matplotlib draws in about a tenth of a second.
MAX_FILM_TRIANGLES: Final = 6_000
_INCHES: Final = (6.4, 4.8)
_KEY: Final = np.array([0.35, -0.45, 0.82]) / np.linalg.norm([0.35, -0.45, 0.82])


def write(scene: Scene, path: Path, fps: float) -> None:
    """Write a picture of the first frame, or a film of all, by the suffix of the path."""
    suffix = path.suffix.lower()
    with needed("matplotlib", suffix[1:].upper()):
        from matplotlib.animation import writers
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    fig = Figure(figsize=_INCHES, dpi=100, facecolor="#e6ebf1")
    FigureCanvasAgg(fig)
    axis = fig.add_axes((0, 0, 1, 1))
    drawing = _Drawing(scene, axis)
    try:
        if suffix in PICTURES:
            drawing.frame(0)
            fig.savefig(path)
            return
        name, install = FILMS[suffix]
        if not writers.is_available(name):
            raise UnsupportedError(f"{suffix[1:].upper()} needs {name}, which is not installed; {install}")
        writer = writers[name](fps=fps)  # type: ignore[arg-type]  # any number does
        with writer.saving(fig, str(path), fig.dpi):
            for k in range(len(scene.t)):
                drawing.frame(k)
                writer.grab_frame()
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}; choose a folder that exists") from error
    except CalledProcessError as error:
        raise OutputError(f"cannot write {path}: the film's writer ended with code {error.returncode}") from error


class _Drawing:
    """The axes of a figure, and the triangles of all shapes in their own axes."""

    def __init__(self, scene: Scene, axis: Any) -> None:
        from matplotlib.collections import PolyCollection

        self.scene, camera = scene, scene.camera
        self.axes = camera_axes(camera["azimuth"], camera["elevation"])
        self.target, self.distance = np.array(camera["target"]), float(camera["distance"])
        self.owner, self.corners, colors = [], [], []
        for k, shape in enumerate(scene.shapes):
            for surface in shape.surfaces:
                self.corners.append(surface.vertices[surface.triangles])
                self.owner.append(np.full(len(surface.triangles), k))
                colors.append(np.tile(surface.color or shape.color, (len(surface.triangles), 1)))
        self.colors = np.clip(np.concatenate(colors), 0, 1) ** [2.2, 2.2, 2.2, 1]
        self.which = np.concatenate(self.owner)
        self.local = np.concatenate(self.corners)
        axis.set_axis_off()
        reach, wide = np.tan(np.deg2rad(HALF_ANGLE_DEGREES)), _INCHES[0] / _INCHES[1]
        axis.set_xlim(-reach * wide, reach * wide)
        axis.set_ylim(-reach, reach)
        self._grid(axis, float(camera["reach"]))
        self.shadow = axis.add_collection(
            PolyCollection([], facecolors="#c9ced6", edgecolors="#c9ced6", linewidths=0.4, zorder=1)
        )
        self.solids = axis.add_collection(PolyCollection([], linewidths=0.4, zorder=2))
        self.clock = axis.text(0.02, 0.03, "", transform=axis.transAxes, color="#1b1f24", parse_math=False)

    def _grid(self, axis: Any, reach: float) -> None:
        from matplotlib.collections import LineCollection

        x, y = self.target[:2]
        ends = np.linspace(-2 * reach, 2 * reach, 17)
        edge = np.full_like(ends, 2 * reach)
        level = np.full_like(ends, self.scene.ground)
        along = np.stack([np.stack([x + ends, y + s * edge, level], axis=-1) for s in (-1, 1)], axis=1)
        across = np.stack([np.stack([x + s * edge, y + ends, level], axis=-1) for s in (-1, 1)], axis=1)
        axis.add_collection(
            LineCollection(
                list(self._seen(np.concatenate([along, across]))[0]), colors="#c3cad3", linewidths=0.6, zorder=0
            )
        )

    def _seen(self, points: Array) -> tuple[Array, Array]:
        """Return points (..., 3) on the picture, (..., 2), and their depth, near ones with the larger number."""
        x = (points - self.target) @ self.axes.T
        depth = np.minimum(x[..., 2] - self.distance, -0.05 * self.distance)
        return -x[..., :2] / depth[..., None], depth

    def frame(self, k: int) -> None:
        """Draw frame k."""
        R, p = self.scene.placements(k)
        X = np.einsum("tij,tcj->tci", R[self.which], self.local) + p[self.which, None]
        flat = X - (X[..., 2:] - self.scene.ground) * (_KEY / _KEY[2])
        self.shadow.set_verts(self._seen(flat)[0])
        projected, depth = self._seen(X)
        normals = np.cross(X[:, 1] - X[:, 0], X[:, 2] - X[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        away = self.target + self.distance * self.axes[2] - X.mean(axis=1)
        normals *= np.sign(np.sum(normals * away, axis=1, keepdims=True))
        light = 0.24 + 0.12 * normals[:, 2:] + 0.75 * np.maximum(normals @ _KEY, 0)[:, None]
        colors = np.concatenate([np.clip(self.colors[:, :3] * light, 0, 1) ** (1 / 2.2), self.colors[:, 3:]], axis=1)
        order = np.argsort(depth.mean(axis=1))
        self.solids.set_verts(projected[order])
        self.solids.set_facecolor(colors[order])
        # The edge closes the gap between neighbours, and would show on transparent ones.
        self.solids.set_edgecolor(colors[order] * np.where(colors[order, 3:] < 1, [1, 1, 1, 0], 1))
        if len(self.scene.t) > 1:
            self.clock.set_text(f"{self.scene.t[k]:.2f} s")
