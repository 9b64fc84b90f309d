"""Pinocchio's geometry model of the shapes of a description."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import coal
import numpy as np
import pinocchio as pin

from mbkit.engines.pinocchio.model import PinModel
from mbkit.load.xml_reader import reserved
from mbkit.show import Shape

#: Kind -> coal's solid; boxes and heights are whole lengths there.
_SOLIDS: Final[dict[str, Callable[..., Any]]] = {
    "box": lambda a, b, c: coal.Box(2 * a, 2 * b, 2 * c),
    "sphere": coal.Sphere,
    "cylinder": lambda r, half: coal.Cylinder(r, 2 * half),
    "capsule": lambda r, half: coal.Capsule(r, 2 * half),
    "ellipsoid": coal.Ellipsoid,
}


def geometry(maps: PinModel, shapes: Sequence[Shape]) -> Any:
    """Return the geometry model; a mesh of several colours is as many objects."""
    out = pin.GeometryModel()
    names: set[str] = set()
    meshes: dict[int, Any] = {}
    for shape in shapes:
        carrier, R, p = maps.bodies[shape.body]
        place = pin.SE3(R @ shape.rotation, p + R @ shape.translation)
        frame = maps.model.getFrameId(shape.body) if shape.body != "world" else 0
        if shape.kind != "mesh":
            solids = [(_SOLIDS[shape.kind](*shape.size), shape.color)]
        else:
            for surface in shape.meshes:
                if id(surface) not in meshes:
                    meshes[id(surface)] = _mesh(surface.vertices, surface.triangles)
            solids = [(meshes[id(surface)], surface.color or shape.color) for surface in shape.meshes]
        for solid, color in solids:
            one = pin.GeometryObject(reserved(shape.name, names), carrier, frame, place, solid)
            one.meshColor, one.overrideMaterial = np.array(color), True
            out.addGeometryObject(one)
    return out


def _mesh(vertices: Any, triangles: Any) -> Any:
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(len(triangles), len(vertices))
    mesh.addVertices(vertices)
    mesh.addTriangles(triangles)
    mesh.endModel()
    return mesh
