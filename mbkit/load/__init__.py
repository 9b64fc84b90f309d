"""URDF, MJCF, and robots by name, to a `Model`."""

from mbkit._callable import make_callable
from mbkit.load.loader import load
from mbkit.load.records import Robot, robots

__all__ = ["Robot", "load", "robots"]

make_callable(__name__, load)
