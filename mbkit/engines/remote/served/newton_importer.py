"""What Newton's own importers make of a file: the bodies and joints of its finalized model, as plain data.

A body's frame is here that of the joint that carries it, so that a joint has one placement. Validation changes masses
and inertias in the model alone, not in the builder, and says which where it is asked to.
"""

from __future__ import annotations

import re
import warnings
import xml.etree.ElementTree as ET
from collections import Counter
from typing import Any

import newton
import numpy as np
from common import rotation
from on_newton import Engine

_KINDS = {"REVOLUTE": "revolute", "PRISMATIC": "prismatic", "BALL": "ball", "FREE": "free", "FIXED": "fixed"}
#: Text of its validation about a body.
_OF_BODY = re.compile(r"for body '([^']+)'")
#: Newton's numbers of velocities, and the description's.
_NUMBERS = {
    **{name: f"joint_{name}" for name in ("armature", "damping", "stiffness", "friction")},
    **{name: f"joint_limit_{name}" for name in ("lower", "upper")},
    **{name: f"joint_{name}" for name in ("velocity_limit", "effort_limit")},
}
#: Those of joints of several velocities too.
_OF_ALL = ("armature", "damping", "friction")


class Imported(Engine):  # type: ignore[misc]  # of the file beside
    """A model that Newton's importer built from a file, with what its validation changes."""

    def __init__(self, builder: Any) -> None:
        super().__init__((builder, {}, {}))
        self._validated = True

    def joints(self) -> dict[str, Any]:
        out: dict[str, Any] = self._places
        return out

    def _mass_numbers(self, model: Any, state: Any) -> Any:
        """Return the mass matrix, of which Newton has a block for each articulation."""
        blocks = super()._mass_numbers(model, state)
        n = model.joint_dof_count // self._nv
        starts = self._builder.articulation_start
        ends = [*starts[1:], self._builder.joint_count]
        firsts = [*self._builder.joint_qd_start, self._nv]
        out, blocks = np.zeros((n, self._nv, self._nv)), blocks.reshape(n, -1, *blocks.shape[1:])
        for k, (start, end) in enumerate(zip(starts, ends, strict=True)):
            v = slice(firsts[start], firsts[end])
            out[:, v, v] = blocks[:, k, : v.stop - v.start, : v.stop - v.start]
        return out

    def described(self, heard: list[str], elements: list[Any]) -> dict[str, Any]:
        """Return the description of the model, with what validation says added to `heard`."""
        self._builder.validate_inertia_detailed = True
        m, checks = _hearing(lambda: self._builder.finalize(device="cpu"))
        found = [_OF_BODY.search(text) for text in checks]
        heard += [text for text, of_body in zip(checks, found, strict=True) if not of_body]
        if names := [*dict.fromkeys(x[1].rsplit("/", maxsplit=1)[-1] for x in found if x)]:
            heard.append(f"its validation corrected the inertia of {', '.join(names)}")
        return _Description(self, m, elements).data | {"notes": [*dict.fromkeys(heard)]}


def imported(adapter: Any, path: str, format_: str, floating: bool) -> tuple[Any, dict[str, Any]]:  # noqa: ARG001
    """Return the engine of a file that Newton reads, and the description of what it read."""
    builder = newton.ModelBuilder()
    base = {"floating": True} if floating and format_ == "urdf" else {}
    _, heard = _hearing(lambda: getattr(builder, "add_" + format_)(path, **base))
    engine = Imported(builder)
    return engine, engine.described(heard, [*ET.parse(path).getroot().iter()])


def _hearing(make: Any) -> tuple[Any, list[str]]:
    """Return what a function gives, and its warnings."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        made = make()
    return made, [" ".join(str(w.message).split()) for w in said]


def _plain(name: str) -> str:
    return re.sub(r"\W", "_", name)


class _Description:
    """Reads a finalized model of one world joint by joint."""

    def __init__(self, engine: Imported, m: Any, elements: list[Any]) -> None:
        self._m, self._taken = m, Counter(("world",))
        #: By what Newton's labels end with.
        self._names = {_plain(x): x for x in (e.get("name") for e in elements) if x}
        self._slides = {e.get("name") for e in elements if e.tag == "joint" and e.get("type") == "slide"}
        self._labels = m.joint_label, m.body_label
        held = {k: getattr(m, x, None) for k, x in _NUMBERS.items()}
        self._of = {k: x.numpy().astype(float) for k, x in held.items() if x is not None}
        for some in (x for k, x in self._of.items() if "limit" in _NUMBERS[k]):
            # A limit beyond this is none.
            some[np.abs(some) > 1e5] *= np.inf
        sizes = ("joint_q_start", m.joint_coord_count), ("joint_qd_start", m.joint_dof_count)
        #: Where each joint's coordinates and velocities begin, and the last ones end.
        self._starts = [[*getattr(m, x).numpy().tolist()[: m.joint_count], n] for x, n in sizes]
        self._drive()
        axes, dims = m.joint_axis.numpy().astype(float), m.joint_dof_dim.numpy()
        placed = [m.joint_X_p.numpy().astype(float), m.joint_X_c.numpy().astype(float)]
        parents, children = m.joint_parent.numpy(), m.joint_child.numpy()
        masses, coms, inertias = (x.numpy().astype(float) for x in (m.body_mass, m.body_com, m.body_inertia))
        frames, names = {-1: _matrix(np.array([0, 0, 0, 0, 0, 0, 1.0]))}, {-1: "world"}
        self.data: dict[str, Any] = {"bodies": [], "joints": [], "places": {}, "mimics": []}
        self.data["holds"] = "by its solvers"
        self.data["gravity"] = m.gravity.numpy().astype(float).reshape(-1, 3)[0].tolist()
        own: dict[int, list[str]] = {}
        loops = []
        for j in range(m.joint_count):
            kind, child = newton.JointType(int(m.joint_type.numpy()[j])).name, int(children[j])
            if child in frames:
                loops.append(self._label(0, j))
                continue
            q, v = (range(s[j], s[j + 1]) for s in self._starts)
            X = np.linalg.inv(frames[int(parents[j])]) @ _matrix(placed[0][j])
            frames[child], names[child] = _matrix(placed[1][j]), self._name(self._label(1, child))
            steps = self._steps(kind, dims[j], list(q), list(v))
            parent, own[j] = names[int(parents[j])], self._own_names(self._label(0, j), steps)
            for k, ((step, at_q, at_v), name) in enumerate(zip(steps, own[j], strict=True)):
                body = names[child]
                if k < len(steps) - 1:
                    body = self._name(f"{names[child]} before {name}")
                    self.data["bodies"].append([body, 0.0, [0.0] * 3, np.zeros((3, 3)).tolist()])
                some = self._of if len(at_v) == 1 else {x: self._of[x] for x in _OF_ALL if x in self._of}
                numbers = {x: y[at_v].tolist() for x, y in some.items()}
                if not any(numbers.get("stiffness", [])):
                    numbers.pop("rest", None)
                one = {"axes": axes[at_v].tolist()} if len(at_v) == 1 else {}
                at = [name, step, parent, body, X[:3, :3].tolist(), X[:3, 3].tolist()]
                self.data["joints"].append([at, one | numbers])
                self.data["places"][name] = [at_q, at_v]
                parent, X = body, np.eye(4)
            B = np.linalg.inv(frames[child])
            com = B[:3, :3] @ coms[child] + B[:3, 3]
            I = B[:3, :3] @ inertias[child] @ B[:3, :3].T
            self.data["bodies"].append([names[child], float(masses[child]), com.tolist(), I.tolist()])
        engine._places = self.data["places"]
        self.data["loops"] = loops
        self._couple(own)

    def _drive(self) -> None:
        """Add drives at zero control to springs and dampers: they act as these in Newton's solvers."""
        m, of = self._m, self._of
        on = m.joint_target_mode.numpy() != 0
        ke, kd = (on * getattr(m, "joint_target_" + x).numpy().astype(float) for x in ("ke", "kd"))
        stiffness = of.get("stiffness", 0.0) + ke
        pull = of.get("stiffness", 0.0) * self._by_velocity("joint_rest_q") + ke * self._by_velocity("joint_target_q")
        of["damping"], of["stiffness"] = of.get("damping", 0.0) + kd, stiffness
        of["rest"] = np.divide(pull, stiffness, out=np.zeros(len(ke)), where=stiffness > 0)

    def _by_velocity(self, name: str) -> Any:
        """Return numbers that Newton has for each coordinate; joints that turn freely have none here."""
        m, out = self._m, np.zeros(self._m.joint_dof_count)
        if getattr(m, name, None) is None:
            return out
        given = getattr(m, name).numpy().astype(float)
        for j in range(m.joint_count):
            q, v = (slice(s[j], s[j + 1]) for s in self._starts)
            if len(given) == len(out):
                out[v] = given[v]
            elif q.stop - q.start == v.stop - v.start:
                out[v] = given[q]
        return out

    def _label(self, what: int, k: int) -> str:
        """Return the name in the file of a joint (0) or body (1): Newton puts the names above it before."""
        label = str(self._labels[what][k])
        parts = label.split("/")
        for n in range(len(parts)):
            if (tail := _plain("/".join(parts[n:]))) in self._names:
                return str(self._names[tail])
        return parts[-1]

    def _name(self, name: str) -> str:
        self._taken[name] += 1
        return name if self._taken[name] == 1 else f"{name}_{self._taken[name]}"

    def _steps(self, kind: str, dims: Any, q: list[int], v: list[int]) -> list[tuple[str, list[int], list[int]]]:
        """Return the description's joints in the place of one of Newton's: kind, places in joint_q and joint_qd."""
        if kind in _KINDS:
            return [(_KINDS[kind], q, v)]
        if kind != "D6":
            raise NotImplementedError(f"a joint of Newton's type {kind}, which is not compared")
        if not v:
            return [("fixed", q, v)]
        kinds = ["prismatic"] * int(dims[0]) + ["revolute"] * int(dims[1])
        return [(one, [a], [b]) for one, a, b in zip(kinds, q, v, strict=True)]

    def _own_names(self, label: str, steps: list[Any]) -> list[str]:
        """Return the file's names of joints that Newton made one, whose label joins them by "_"."""
        if len(steps) == 1:
            return [self._name(label)]
        found = self._split(_plain(label), len(steps)) or [f"{label} {k}" for k in range(len(steps))]
        # Newton has the sliding ones first.
        found.sort(key=lambda x: x not in self._slides)
        return [self._name(x) for x in found]

    def _split(self, label: str, n: int) -> list[str]:
        if n == 1:
            return [self._names[label]] if label in self._names else []
        for k in range(1, len(label)):
            if label[k] == "_" and label[:k] in self._names and (rest := self._split(label[k + 1 :], n - 1)):
                return [self._names[label[:k]], *rest]
        return []

    def _couple(self, own: dict[int, list[str]]) -> None:
        """Add the joints that mimic others."""
        m = self._m
        if getattr(m, "joint_mimic_joint", None) is not None:
            held = zip(m.joint_mimic_joint.numpy().tolist(), m.joint_mimic_coeffs.numpy().tolist(), strict=True)
            some = [(j, leader, *numbers) for j, (leader, numbers) in enumerate(held) if leader >= 0]
        elif getattr(m, "constraint_mimic_count", 0):
            ends = ("joint0", "joint1", "coef0", "coef1")
            some = [*zip(*(getattr(m, "constraint_mimic_" + x).numpy().tolist() for x in ends), strict=False)]
        else:
            some = []
        for j, leader, offset, ratio in some:
            self.data["mimics"].append(["", own[j][0], own[leader][0], ratio, offset])


def _matrix(x: Any) -> Any:
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = rotation(x[3:]), x[:3]
    return X
