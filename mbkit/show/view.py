"""`show` and `animate`: a model at a configuration or along a motion, in a notebook, a browser or a file."""

from __future__ import annotations

import html as _html
import os
import re
import sys
import tempfile
import webbrowser
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, count, real, shown
from mbkit._escape import one_line
from mbkit.errors import InputError, writing
from mbkit.load import load
from mbkit.model import Model
from mbkit.model.elements.formula import NUMPY
from mbkit.model.elements.motion_laws import motions_of, position
from mbkit.show import movie, page
from mbkit.show.scene import PICTURE, Kind, Scene

#: Frames that a page and a film hold at most.
_MAX_PAGE_FRAMES: Final = 2000
_MAX_FILM_FRAMES: Final = 20_000
_PAGE_FRAMES_PER_SECOND: Final = 60.0
_SUFFIXES: Final = (".html", *movie.PICTURES, *movie.FILMS)


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
        return page.html(self.scene)

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
    filmed = path is not None and Path(path).suffix.lower() in movie.FILMS
    rate = real("fps", fps, positive=True) if filmed else _PAGE_FRAMES_PER_SECOND
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
    scene = Scene.of(model, q, t, shapes, min(most, movie.MAX_FILM_TRIANGLES) if drawn else most)
    if file is not None and drawn:
        movie.write(scene, file, fps)
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
