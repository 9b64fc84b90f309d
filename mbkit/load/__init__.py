"""URDF, MJCF, and robots by name, to a `Model`."""

from mbkit._imports import make_callable
from mbkit.load.loader import Robot, load, robots

__all__ = ["Robot", "load", "robots"]

make_callable(__name__, load)
