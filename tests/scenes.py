"""Small mechanisms of a few calls: one body on a joint, and bodies one after the other."""

from __future__ import annotations

from typing import Any

from mbkit.engines.registry import ENGINES
from mbkit.model import Model, ModelBuilder
from mbkit.simulate import METHODS as ALL_METHODS

BODY = ("mass", "com", "inertia")
#: Methods but those of engines that have an environment of their own, which no test makes.
METHODS = {name: m for name, m in ALL_METHODS.items() if not m.engines or {*m.engines} & {*ENGINES}}


def chain(*links: dict[str, Any], name: str = "chain", **options: Any) -> ModelBuilder:
    """Return bodies b0, b1, … on hinges j0, j1, …, each on the one before it, where a link does not say otherwise.

    A link holds the arguments of `add_body` and `add_joint`, its names as "body" and "joint".
    """
    b, before = ModelBuilder(name, **options), "world"
    for k, link in enumerate(links):
        given = {"body": f"b{k}", "joint": f"j{k}", "kind": "revolute", "parent": before} | link
        before, joint, kind = (given.pop(x) for x in ("body", "joint", "kind"))
        b.add_body(before, **{x: given.pop(x) for x in BODY if x in given})
        b.add_joint(joint, kind, child=before, **given)
    return b


def slider(name: str = "slider", gravity: Any = (0, 0, -9.81), **given: Any) -> ModelBuilder:
    """Return a point of 1 kg that slides along x."""
    own = {"body": "mass", "joint": "x", "kind": "prismatic", "mass": 1.0, "axis": (1, 0, 0)}
    return chain(own | given, name=name, gravity=gravity)


def hinge(name: str = "hinge", gravity: Any = (0, 0, -9.81), **given: Any) -> ModelBuilder:
    """Return a body a that hangs on a hinge j, turning about y."""
    own = {"body": "a", "joint": "j", "mass": 1.0, "com": (0, 0, -1), "inertia": (0.1, 0.1, 0.1), "axis": (0, 1, 0)}
    return chain(own | given, name=name, gravity=gravity)


def damped_arm() -> Model:
    """Return two rods on hinges across each other, with dampers and a spring."""
    upper = {"mass": 1.0, "com": (0, 0, -0.5), "inertia": (0.1, 0.1, 0.01), "axis": (0, 1, 0)}
    lower = {"mass": 0.5, "com": (0, 0, -0.3), "inertia": (0.03, 0.03, 0.01), "axis": (1, 0, 0)}
    upper |= {"damping": 0.7, "stiffness": 3.0, "rest": 0.2}
    return chain(upper, lower | {"translation": (0, 0, -1), "damping": 0.1}, name="damped").build()


def linkage(
    lengths: tuple[float, float, float] = (0.3, 0.9, 0.7),
    ground: float = 1.0,
    density: float = 2.0,
    name: str = "four_bar",
    **loop: Any,
) -> ModelBuilder:
    """Return crank, coupler and rocker in the plane of x and z, thin rods, with a pin or another loop; kg/m."""
    crank, coupler, rocker = lengths
    links = []
    places = ("crank", "world", 0.0, crank), ("coupler", "crank", crank, coupler), ("rocker", "world", ground, rocker)
    for body, parent, at, length in places:
        thin = density * length**3 / 12
        rod = {"mass": density * length, "com": (length / 2, 0, 0), "inertia": (0.0, thin, thin), "axis": (0, -1, 0)}
        links.append(rod | {"body": body, "joint": f"at_{body}", "parent": parent, "translation": (at, 0, 0)})
    b = chain(*links, name=name)
    ends = {"body_a": "coupler", "translation_a": (coupler, 0, 0), "body_b": "rocker", "translation_b": (rocker, 0, 0)}
    b.add_loop("pin", **({"kind": "point"} | ends | loop))
    return b


def mounted(
    name: str, body: str, joint: str, kind: str = "revolute", gravity: Any = (0, 0, -9.81), **given: Any
) -> ModelBuilder:
    """Return one body on a joint that stands on the ground."""
    return chain({"body": body, "joint": joint, "kind": kind} | given, name=name, gravity=gravity)
