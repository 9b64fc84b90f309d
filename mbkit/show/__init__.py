"""Models and motions to look at: pages with a viewer in them, pictures and films."""

from mbkit._imports import make_callable
from mbkit.show.scene import Kind as Kind
from mbkit.show.scene import Scene, shapes_of
from mbkit.show.view import View, show
from mbkit.show.visuals import Shape

__all__ = ["Scene", "Shape", "View", "shapes_of", "show"]

make_callable(__name__, show)
