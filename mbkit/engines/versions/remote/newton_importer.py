"""What Newton's own importers make of a file: the bodies and joints of its finalized model, as plain data.

A body's frame is here that of the joint that carries it, so that a joint has one placement. Validation changes masses
and inertias in the model alone, not in the builder, and says which where it is asked to.
"""

from __future__ import annotations

import os
import re
import warnings
import xml.etree.ElementTree as ET
from collections import Counter

import newton
import numpy as np
import warp as wp
from common import rotation
from on_newton import Engine

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

_KINDS = {"REVOLUTE": "revolute", "PRISMATIC": "prismatic", "BALL": "ball", "FREE": "free", "FIXED": "fixed"}
#: What its validation says of a body.
_OF_BODY = re.compile(r"for body '([^']+)'")
#: Newton's numbers of velocities, and the description's.
_NUMBERS = {
    **{name: "joint_" + name for name in ("armature", "damping", "friction", "stiffness")},
    **{"rest": "joint_rest_q", "lower": "joint_limit_lower", "upper": "joint_limit_upper"},
    **{"velocity_limit": "joint_velocity_limit", "effort_limit": "joint_effort_limit"},
}
_LIMITS = ("lower", "upper", "velocity_limit", "effort_limit")


class Imported(Engine):
    """A model that Newton's importer built from a file, with what its validation changes."""

    def __init__(self, builder: Any) -> None:
        super().__init__((builder, {}, {}))
        self._validated = True

    def joints(self) -> dict[str, Any]:
        return self._places

    def described(self, heard: list[str], elements: list[Any]) -> dict[str, Any]:
        """Return the description of the model, with what validation says added to `heard`."""
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            m = self._model(1, True)[0]
        checks = [" ".join(str(w.message).split()) for w in said]
        found = [_OF_BODY.search(text) for text in checks]
        heard += [text for text, of_body in zip(checks, found) if not of_body]
        if names := [*dict.fromkeys(x[1].rsplit("/", maxsplit=1)[-1] for x in found if x)]:
            heard.append(f"its validation corrected the inertia of {', '.join(names)}")
        return _Description(self, m, elements).data | {"notes": [*dict.fromkeys(heard)]}


def imported(adapter: Any, path: str, format_: str, floating: bool) -> tuple[Any, dict[str, Any]]:  # noqa: ARG001
    """Return the engine of a file that Newton reads, and the description of what it read."""
    builder, heard = newton.ModelBuilder(), []
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        if format_ == "urdf":
            builder.add_urdf(path, **({"floating": True} if floating else {}))
        else:
            builder.add_mjcf(path)
    heard += [" ".join(str(w.message).split()) for w in said]
    engine = Imported(builder)
    return engine, engine.described(heard, [*ET.parse(path).getroot().iter()])


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
        self._of = {k: getattr(m, x).numpy().astype(float) for k, x in _NUMBERS.items() if getattr(m, x) is not None}
        self._drive()
        axes, dims = m.joint_axis.numpy().astype(float), m.joint_dof_dim.numpy()
        starts = m.joint_q_start.numpy().tolist(), m.joint_qd_start.numpy().tolist()
        placed = [m.joint_X_p.numpy().astype(float), m.joint_X_c.numpy().astype(float)]
        parents, children = m.joint_parent.numpy(), m.joint_child.numpy()
        masses, coms, inertias = (
            x.numpy().astype(float) for x in (m.body_mass, m.body_com, m.body_inertia)
        )
        frames, names = {-1: _matrix(np.array([0, 0, 0, 0, 0, 0, 1.0]))}, {-1: "world"}
        self.data: dict[str, Any] = {"bodies": [], "joints": [], "places": {}, "couplers": [], "holds": "by its solvers"}
        self.data["gravity"] = m.gravity.numpy().astype(float).reshape(-1, 3)[0].tolist()
        own: dict[int, list[str]] = {}
        loops = []
        for j in range(m.joint_count):
            kind, child = newton.JointType(int(m.joint_type.numpy()[j])).name, int(children[j])
            if child in frames:
                loops.append(self._label(0, j))
                continue
            q, v = (range(s[j], s[j + 1]) if j + 1 < len(s) else range(0) for s in starts)
            X = np.linalg.inv(frames[int(parents[j])]) @ _matrix(placed[0][j])
            frames[child], names[child] = _matrix(placed[1][j]), self._name(self._label(1, child))
            steps = self._steps(kind, dims[j], list(q), list(v))
            parent, own[j] = names[int(parents[j])], self._own_names(self._label(0, j), steps)
            for k, ((step, at_q, at_v), name) in enumerate(zip(steps, own[j])):
                body = names[child]
                if k < len(steps) - 1:
                    body = self._name(f"{names[child]} before {name}")
                    self.data["bodies"].append([body, 0.0, [0.0] * 3, np.zeros((3, 3)).tolist()])
                numbers = {x: y[at_v].tolist() for x, y in self._of.items()} if len(at_v) == 1 else {}
                numbers |= {x: [None if abs(y) > 1e5 else y for y in numbers[x]] for x in _LIMITS if x in numbers}
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
        stiffness = of["stiffness"] + on * m.joint_target_ke.numpy()
        pull = of["stiffness"] * of["rest"] + (on * m.joint_target_ke.numpy() * _targets(m))
        of["damping"] = of["damping"] + on * m.joint_target_kd.numpy()
        of["rest"] = np.where(stiffness > 0, pull / np.where(stiffness > 0, stiffness, 1.0), 0.0)
        of["stiffness"] = stiffness

    def _label(self, what: int, k: int) -> str:
        """Return the name in the file of a joint (0) or body (1): Newton puts the names above it before."""
        label = self._labels[what][k]
        parts = label.split("/")
        for n in range(len(parts)):
            if (tail := _plain("/".join(parts[n:]))) in self._names:
                return self._names[tail]
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
        return [(one, [a], [b]) for one, a, b in zip(kinds, q, v)]

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
            held = zip(m.joint_mimic_joint.numpy().tolist(), m.joint_mimic_coeffs.numpy().tolist())
            some = [(j, leader, *numbers) for j, (leader, numbers) in enumerate(held) if leader >= 0]
        elif getattr(m, "constraint_mimic_count", 0):
            ends = ("joint0", "joint1", "coef0", "coef1")
            some = [*zip(*(getattr(m, "constraint_mimic_" + x).numpy().tolist() for x in ends))]
        else:
            some = []
        for j, leader, offset, ratio in some:
            self.data["couplers"].append(["", own[j][0], own[leader][0], ratio, offset])


def _targets(m: Any) -> Any:
    """Return the target of each velocity's drive; joints that turn freely have none."""
    q, at = m.joint_target_q.numpy().astype(float), np.zeros(m.joint_dof_count)
    starts = m.joint_target_q_start.numpy() if m.joint_target_q_start is not None else m.joint_qd_start.numpy()
    first, ends = m.joint_qd_start.numpy(), [*m.joint_qd_start.numpy()[1:], m.joint_dof_count]
    for j in range(m.joint_count):
        n = ends[j] - first[j]
        if n <= len(q) - starts[j]:
            at[first[j] : ends[j]] = q[starts[j] : starts[j] + n]
    return at


def _matrix(x: Any) -> Any:
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = rotation(x[3:]), x[:3]
    return X
