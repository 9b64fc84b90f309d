"""`show` and `animate`: a model at a configuration or along a motion, in a notebook, a browser or a file.

A scene as one HTML file, with its viewer in it: nothing is loaded, and only the page's own script may run.

A scene as a picture or a film, drawn with Matplotlib: triangles from far to near, with the page's light and camera.

Sorting by depth (Newell, Newell and Sancha 1972, A solution to the hidden surface problem) is right for all but long
triangles and those that pass through each other.
"""

from __future__ import annotations

import base64
import hashlib
import html as _html
import json
import os
import re
import sys
import tempfile
import webbrowser
import zlib
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from subprocess import CalledProcessError
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit import _escape
from mbkit._check import Array, count, needed, real, shown
from mbkit._escape import one_line
from mbkit.errors import InputError, OutputError, UnsupportedError, writing
from mbkit.load import load
from mbkit.model import Model
from mbkit.model.elements.formula import NUMPY
from mbkit.model.elements.motion_laws import motions_of, position
from mbkit.show.meshes import Surface
from mbkit.show.scene import HALF_ANGLE_DEGREES, PICTURE, Kind, Scene, camera_axes

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


#: Frames that a page and a film hold at most.
_MAX_PAGE_FRAMES: Final = 2000
_MAX_FILM_FRAMES: Final = 20_000
_SUFFIXES: Final = (".html", *PICTURES, *FILMS)


@dataclass(frozen=True, eq=False)
class View:
    """A scene on a page of its own, which a notebook displays.

    Attributes
    ----------
    scene : Scene
    path : pathlib.Path or None
        The file that was written.
    height : int
        Of the frame in a notebook, pixels.
    """

    scene: Scene
    path: Path | None = None
    height: int = field(default=460, repr=False)

    @property
    def html(self) -> str:
        """The page, one HTML text that loads nothing."""
        return html(self.scene)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the page, and return where; OutputError where it cannot be written."""
        path = Path(path)
        with writing(path):
            path.write_text(self.html, encoding="utf-8")
        return path

    def __repr__(self) -> str:
        at = f", {one_line(str(self.path))}" if self.path else ""
        frames = f"{len(self.scene.t)} frames" if len(self.scene.t) > 1 else "one frame"
        return f"<View of {one_line(self.scene.name)}: {len(self.scene.shapes)} shapes, {frames}{at}>"

    def _repr_html_(self) -> str:
        if self.path is not None and self.path.suffix != ".html":
            return f"<p>{_html.escape(repr(self))}</p>"
        style = f"width:100%;height:{self.height}px;border:0;border-radius:8px"
        return (
            f'<iframe srcdoc="{_html.escape(self.html)}" style="{style}" title="{_html.escape(repr(self))}"></iframe>'
        )


def show(
    model: Model | str | os.PathLike[str],
    q: ArrayLike | None = None,
    path: str | os.PathLike[str] | None = None,
    *,
    shapes: Kind = "visual",
    triangles: int = 250_000,
) -> View:
    """Show a model at a configuration, in a notebook, a browser window or a file.

    The page has a turntable camera (drag, wheel, right button), names of bodies under the pointer, and for several
    configurations a slider with one a second. It is one HTML file that loads nothing.

    Parameters
    ----------
    model : Model, str or path
        Or an argument of `mbkit.load`, such as a path; inertias that no body has bring a warning, and are drawn.
    q : (nq,) or (K, nq) array_like, optional
        By default the neutral configuration.
    path : str or path, optional
        A file to write: ``.html``, ``.png`` (the first configuration), ``.gif`` or ``.mp4``. Without one a notebook
        displays the result; elsewhere a page is written to a temporary file, its path is printed, and a browser opens
        where there is a display.
    shapes : {"visual", "collision", "sticks"}
        Shapes of the URDF or MJCF that the model was loaded from, or capsules from joint to joint and boxes with the
        bodies' inertia. Models without shapes, and links whose mesh is missing, are drawn so in any case.
    triangles : int
        About so many at most; meshes with more are made coarser. Pictures and films have 6,000 at most.

    Returns
    -------
    View

    Raises
    ------
    InputError
        A wrong configuration, or a path of another kind.
    UnsupportedError
        A model written as energies, or a format whose writer is not installed.
    OutputError
        The file cannot be written.

    Warns
    -----
    MbkitWarning
        Meshes that cannot be read.

    Examples
    --------
    >>> import mbkit as mb
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     view = mb.show(mb.catalog.double_pendulum(), [0.5, -0.3], f"{folder}/pendulum.html")
    >>> len(view.scene.shapes), view.scene.bodies
    (6, ('world', 'rod1', 'rod2'))
    """
    if isinstance(model, (str, os.PathLike)):
        model = load(model, nonphysical="warn")
    if not isinstance(model, Model):
        raise InputError(f"model: expected a Model or a path, got {shown(model)}; a trajectory has animate()")
    PICTURE.admit(model)
    configurations = np.atleast_2d(model.neutral() if q is None else model.check_q(q))
    if len(configurations) > _MAX_PAGE_FRAMES:
        raise InputError(f"q: expected at most {_MAX_PAGE_FRAMES} configurations, got {len(configurations)}")
    return view_of(model, configurations, np.arange(float(len(configurations))), path, shapes, triangles)


def animate(
    model: Model, q: Array, t: Array, path: str | os.PathLike[str] | None, *, shapes: Kind, triangles: int, fps: float
) -> View:
    """Show a motion: configurations (K, nq) at times (K,) in s; for the arguments see `Trajectory.animate`."""
    if not isinstance(model, Model):
        raise InputError(f"model: expected a Model, got {shown(model)}")
    PICTURE.admit(model)
    good = np.flatnonzero(np.isfinite(q).all(axis=1))
    if not len(good):
        raise InputError(f"{model.name}: the trajectory has no state with finite numbers, so nothing can be shown")
    t, q = t[good], model.check_q(_with_motions(model, q[good], t[good]))
    filmed = path is not None and Path(path).suffix.lower() in FILMS
    rate = real("fps", fps, positive=True) if filmed else 60.0
    most = _MAX_FILM_FRAMES if filmed else _MAX_PAGE_FRAMES
    frames = int(min((t[-1] - t[0]) * rate, most)) + 1
    if filmed and frames > most:
        raise InputError(f"fps: expected a film of at most {most} frames, got {rate:g} a second for {t[-1] - t[0]:g} s")
    times = t[0] + np.arange(frames) / rate if filmed else np.linspace(t[0], t[-1], max(frames, 2))
    # Saved states only: the nearest in time.
    after = np.clip(np.searchsorted(t, times), 1, max(len(t) - 1, 1)) if len(t) > 1 else np.zeros(1, int)
    which = np.where(times - t[after - 1] <= t[after] - times, after - 1, after) if len(t) > 1 else after
    if not filmed:
        which = np.unique(which)
    return view_of(model, q[which], t[which], path, shapes, triangles, fps=rate)


def _with_motions(model: Model, q: Array, t: Array) -> Array:
    """Return coordinates with those that move in time, where only the others are given."""
    moved = {model.layout.q[x.joint].start: x for x in motions_of(model)}
    if q.shape[1] != model.nq - len(moved):
        return q
    out = np.empty((len(q), model.nq))
    out[:, [i for i in range(model.nq) if i not in moved]] = q
    for i, x in moved.items():
        model.require_times("show", float(t.min(initial=np.inf)), float(t.max(initial=-np.inf)))
        out[:, i] = position(x, t, NUMPY)
    return out


def view_of(
    model: Model,
    q: Array,
    t: Array,
    path: str | os.PathLike[str] | None,
    shapes: Kind,
    triangles: int,
    fps: float = 1.0,
) -> View:
    """Return the view of checked configurations, written to the path or shown where a person is."""
    most = count("triangles", triangles, least=1)
    file = None if path is None else Path(path)
    if file is not None and file.suffix.lower() not in _SUFFIXES:
        raise InputError(f"path: expected a name that ends in {', '.join(_SUFFIXES)}, got {shown(str(path))}")
    drawn = file is not None and file.suffix.lower() != ".html"
    scene = Scene.of(model, q, t, shapes, min(most, MAX_FILM_TRIANGLES) if drawn else most)
    if file is not None and drawn:
        write(scene, file, fps)
        return View(scene, file)
    view = View(scene)
    if file is not None:
        return View(scene, view.save(file))
    return view if _in_notebook() else View(scene, _opened(view))


def _in_notebook() -> bool:
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return getattr(shell, "kernel", None) is not None


def _opened(view: View) -> Path:
    """Write the page to a temporary file, open it where there is a display, and print its path."""
    stem = re.sub(r"\W+", "_", view.scene.name, flags=re.ASCII)[:40]
    with tempfile.NamedTemporaryFile(prefix=f"mbkit_{stem}_", suffix=".html", delete=False) as file:
        path = Path(file.name)
    view.save(path)
    # Without a display a browser on the terminal would take its place.
    displayed = sys.platform in ("win32", "darwin") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if not (displayed and webbrowser.open(path.as_uri())):
        print(f"{one_line(view.scene.name)}: no display; open {path} in a browser", file=sys.stderr)
    return path
