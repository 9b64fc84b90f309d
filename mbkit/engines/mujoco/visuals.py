"""Sites and shapes on the bodies of a MuJoCo specification: neither has mass, and nothing collides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco

from mbkit.engines.mujoco.constraints import wxyz
from mbkit.load.xml_reader import reserved
from mbkit.model import Model
from mbkit.show import Shape


def add_shapes(spec: Any, bodies: Mapping[str, Any], description: Model, shapes: Sequence[Shape]) -> None:
    """Add a site for each frame and geoms for the shapes; those on bodies that MuJoCo does not have are left out."""
    taken = {site.name for site in spec.sites}
    for frame in description.frames:
        if frame.body in bodies:
            name = reserved(frame.name, taken)
            bodies[frame.body].add_site(name=name, pos=frame.translation, quat=wxyz(frame.rotation))
    meshes: dict[int, str] = {}
    names: set[str] = set()
    for shape in shapes:
        if shape.body not in bodies:
            continue
        look: dict[str, Any] = {"pos": shape.translation, "quat": wxyz(shape.rotation), "group": 2}
        look |= {"mass": 0.0, "contype": 0, "conaffinity": 0}
        body = bodies[shape.body]
        look["type"] = getattr(mujoco.mjtGeom, f"mjGEOM_{shape.kind.upper()}")
        if shape.kind != "mesh":
            size = [*shape.size, 0.0, 0.0][:3]
            body.add_geom(name=reserved(shape.name, names), size=size, rgba=shape.color, **look)
            continue
        for surface in shape.meshes:
            if id(surface) not in meshes:
                meshes[id(surface)] = f"mesh{len(meshes)}"
                mesh = spec.add_mesh(name=meshes[id(surface)])
                mesh.uservert, mesh.userface = surface.vertices.ravel(), surface.triangles.ravel()
                # Surfaces with holes have no volume.
                mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            name, rgba = reserved(shape.name, names), surface.color or shape.color
            body.add_geom(name=name, meshname=meshes[id(surface)], rgba=rgba, **look)
