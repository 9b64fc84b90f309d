"""Numbers of an MJCF that MuJoCo's compiler infers: the inertia of meshes and shells, and ``springdamper``.

The compiler reads a shortened description. mbkit opens the meshes that give a body its inertia, and passes
their bytes; no other file is opened.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np

from mbkit._reproducible import turned
from mbkit.load.mjcf_attributes import asset_name, compiled_model, matrix_of, mesh_assets, read_mesh
from mbkit.load.mjcf_reader import Scene
from mbkit.load.shapes import MassProperties
from mbkit.load.xml_reader import Element, element_text
from mbkit.model.validation import listing

_BODIES: Final = ("default", "asset", "worldbody")
_BODIES_AND_FORCES: Final = (*_BODIES, "tendon", "actuator")
# Elements without effect on masses, springs and damping.
_UNUSED: Final = frozenset({"camera", "light", "texture", "material", "hfield", "skin", "model"})
# Settings that name files, or that would rename or move bodies.
_UNUSED_SETTINGS: Final = frozenset(
    {"meshdir", "texturedir", "assetdir", "strippath", "discardvisual", "fusestatic", "coordinate"}
)


def infer_inertias(mujoco: Element, path: Path, scene: Scene) -> str:
    """Give the bodies of ``scene.inferred`` their inertia, and return a note about it."""
    if not scene.inferred or scene.read.faults:
        return ""
    item = f"the inertia of {name_list(scene.inferred)}"
    text = _Text(mujoco, path, scene)
    compiled = text.compiled(_BODIES, item, scaled=False)
    if compiled is None:
        return ""
    for body in scene.bodies:
        if body.name in scene.inferred:
            body.mass_properties = _mass_properties(compiled.body(body.name))
    bounds = [s for s in ("boundmass", "boundinertia", "balanceinertia") if s in text.settings]
    within = f", within {' and '.join(bounds)}" if bounds else ""
    files = f"; mesh files read: {name_list(text.opened)}" if text.opened else ""
    return f"{item} was inferred from meshes or shells by MuJoCo's compiler{within}{files}"


def infer_springs(mujoco: Element, path: Path, scene: Scene) -> dict[str, tuple[float, float]]:
    """Return the stiffness and damping of each joint that has a ``springdamper``.

    They follow from the mass matrix of the whole system in the pose of the file.
    """
    joints = []
    for joint in (j for b in scene.bodies for j in b.joints):
        item = f"joint {joint.name!r}"
        values = scene.read.numbers(joint.element, "springdamper", item, count=2, default=(0.0, 0.0))
        joints += [joint.name] if any(values) else []
        if any(values) and min(values) <= 0:
            expected = "expected a time constant and a damping ratio above 0"
            scene.read.fault(f"{item}: springdamper: {expected}", joint.element)
    if not joints or scene.read.faults:
        return {}
    item = f"springdamper of {name_list(joints)}"
    compiled = _Text(mujoco, path, scene).compiled(_BODIES_AND_FORCES, item, scaled=True)
    if compiled is None:
        return {}
    views = {name: compiled.joint(name) for name in joints}
    return {n: (float(np.ravel(j.stiffness)[0]), float(np.ravel(j.damping)[0])) for n, j in views.items()}


class _Text:
    """A description as the compiler reads it, with the meshes that it needs."""

    def __init__(self, mujoco: Element, path: Path, scene: Scene) -> None:
        self.mujoco, self.path, self.scene = mujoco, path, scene
        self.settings = scene.compiler.attributes
        self.counted = {id(geom) for geoms in scene.inferred.values() for geom, _ in geoms}
        self.meshes = mesh_assets(mujoco)
        self.needed: dict[int, dict[str, str]] = {}
        self.opened: list[str] = []
        self.assets: dict[str, bytes] = {}

    def compiled(self, sections: Iterable[str], item: str, *, scaled: bool) -> Any:
        """Return the compiled model, or None after a fault; `scaled` says whether settotalmass applies."""
        read = self.scene.read
        before = len(read.faults)
        for body, geoms in self.scene.inferred.items():
            for geom, mesh in geoms:
                if mesh:
                    self._need(mesh, f"body {body!r}: mesh {mesh!r}", geom)
        if len(read.faults) > before:
            return None
        unused = _UNUSED_SETTINGS if scaled else _UNUSED_SETTINGS | {"settotalmass"}
        settings = {k: v for k, v in self.settings.items() if k not in unused}
        # Plugins may make meshes.
        has_plugin_mesh = any(mesh.first("plugin") for mesh in self.meshes.values() if id(mesh) in self.needed)
        sections = (*sections, "extension") if has_plugin_mesh else sections
        inside = "".join(self._written(e, None) for e in self.mujoco.children if e.tag in sections)
        try:
            return compiled_model(settings, inside, self.assets)
        except ValueError as error:
            read.fault(f"{item}: MuJoCo's compiler refuses: {error}")
            return None

    def _need(self, name: str, item: str, geom: Element) -> None:
        """Read the file of a mesh, once."""
        read = self.scene.read
        mesh = self.meshes.get(name)
        if mesh is None:
            read.fault(f"{item}: no such <mesh> in <asset>", geom)
            return
        if id(mesh) in self.needed:
            return
        attributes = {**mesh.attributes, "name": name}
        self.needed[id(mesh)] = attributes
        if "file" not in attributes:
            return
        folder = self.path.parent
        path = folder / self.scene.compiler.mesh_path(attributes["file"])
        content, why = read_mesh(path)
        if why:
            read.fault(f"{item}: {path}: {why}", mesh)
            return
        self.opened.append(str(path.relative_to(folder) if path.is_relative_to(folder) else path))
        attributes["file"] = asset_name(content, path)
        self.assets[attributes["file"]] = content

    def _written(self, element: Element, childclass: str | None) -> str:
        """Return an element of the enclosing class and its children, without those that the compiler does not need."""
        tag, own = element.tag, {k: v for k, v in element.attributes.items() if k not in ("material", "texture")}
        if tag == "worldbody":
            childclass = "main"
        if tag == "geom" and childclass and id(element) not in self.counted:
            full = self.scene.defaults.filled(element, childclass).attributes
            if "mesh" in full or full.get("type") in ("mesh", "sdf", "hfield"):
                return ""
        if id(element) in self.counted:
            # A geom that does not collide needs no convex hull.
            own |= {"contype": "0", "conaffinity": "0"}
        childclass = own.get("childclass", own.get("class", childclass) if tag == "frame" else childclass)
        own |= self.needed.get(id(element), {})
        if id(element) in self.scene.names_of_elements:
            own["name"] = self.scene.names_of_elements[id(element)]
        shaped = tag == "extension" or id(element) in self.needed or id(element) in self.counted
        children = [e for e in element.children if e.tag not in _UNUSED and (shaped or e.tag != "plugin")]
        if tag == "asset":
            children = [e for e in children if e.tag != "mesh" or id(e) in self.needed]
        return element_text(tag, own, "".join(self._written(e, childclass) for e in children))


def _mass_properties(body: Any) -> MassProperties:
    """Return the inertia of a compiled body in its own axes."""
    inertia = turned(matrix_of(body.iquat), np.diag(body.inertia))
    return MassProperties(float(body.mass[0]), np.array(body.ipos), inertia)


def name_list(names: Iterable[str]) -> str:
    """Return the first names, and how many more there are."""
    return listing([repr(name) for name in names])
