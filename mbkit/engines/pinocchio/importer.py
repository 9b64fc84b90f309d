"""Pinocchio's own importers of URDF and MJCF, and the models that they read, described.

The only place that knows what a parsed `pinocchio.Model` holds: links that are fixed to each other
are merged and survive as frames, bodies fixed to the world are in joint 0, a continuous joint
is (cos, sin), a planar joint's velocity is in the body's axes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from mbkit._check import Array
from mbkit.engines.imported import Imported, Parts, checked, written
from mbkit.errors import UnsupportedError
from mbkit.load.urdf import joint_kind, joint_numbers
from mbkit.load.urdf_reader import BASE_JOINT
from mbkit.model import Loop


def read(text: str, format_: str, floating_base: bool = False, files: dict[str, bytes] | None = None) -> Imported:
    """Return what Pinocchio's parser makes of a text; an MJCF says by itself that its base floats."""
    try:
        raw, held = (_urdf(text, floating_base), []) if format_ == "urdf" else _mjcf(text, files or {})
    except Exception as error:
        raise UnsupportedError(f"pinocchio: {' '.join(str(error).split())}") from None
    described = _Description(raw)
    hidden = held if isinstance(held, str) else ""
    notes = (*_beside(raw), *([hidden] if hidden else []))
    loops = () if isinstance(held, str) else described.loops(held)
    return Imported(checked("pinocchio", described.model), described.terms, notes, (), loops, hidden)


def _urdf(text: str, floating_base: bool) -> Any:
    if floating_base:
        return pin.buildModelFromXML(text, pin.JointModelFreeFlyer(), BASE_JOINT)
    return pin.buildModelFromXML(text)


def _mjcf(text: str, files: dict[str, bytes]) -> tuple[Any, list[tuple[str, Any]] | str]:
    """Return a model, and its constraints with their kinds, or why its reader of constraints refuses."""
    # Only files are read as MJCF.
    with written(text, files) as path:
        raw = pin.buildModelFromMJCF(str(path))
        try:
            _, points, frames = pin.buildModelAndConstraintsFromMJCF(str(path))
        except Exception as error:
            # One of body2="world", say: the tree is read all the same.
            return raw, f"its reader of constraints refuses: {' '.join(str(error).split())}"
    return raw, [("point", x) for x in points] + [("frame", x) for x in frames]


def _beside(raw: Any) -> list[str]:
    out = []
    if np.any(raw.rotorInertia):
        out.append("rotor inertias are read and, by themselves, in no term")
    if np.any(np.abs(np.array(raw.gravity.angular)) > 0):
        out.append(f"gravity has an angular part, {raw.gravity.angular}")
    return out


class _Description:
    """Reads a parsed model joint by joint."""

    def __init__(self, raw: Any) -> None:
        self.raw, self.data, parts = raw, raw.createData(), Parts()
        frames: dict[int, str] = {}
        for frame in list(raw.frames)[1:]:
            # A moving body is named after the first link on its joint: the one that the joint carries.
            if frame.type == pin.BODY and frame.parentJoint:
                frames.setdefault(int(frame.parentJoint), str(frame.name))
        self._bodies = bodies = ["world"]
        if raw.inertias[0].mass:
            _add_body(parts, "universe", raw.inertias[0])
            parts.joint("universe_fixed", "fixed", "world", "universe", np.eye(3), np.zeros(3))
        #: (joint of ours, Pinocchio's joint, kind) of each that moves.
        self.moving: list[tuple[str, Any, str]] = []
        for i in range(1, raw.njoints):
            name, body = str(raw.names[i]), parts.name("body", frames.get(i, f"{raw.names[i]}_body"))
            parent, X = bodies[raw.parents[i]], raw.jointPlacements[i]
            steps = self._steps(raw.joints[i])
            for k, (joint, kind, axis, inner) in enumerate(steps):
                last = k == len(steps) - 1
                child, own = (body, name) if last else (f"{body}.{k}", f"{name}.{k}")
                place, numbers = X * inner, _numbers(raw, joint, kind, axis)
                parts.joint(own, kind, parent, child, np.array(place.rotation), np.array(place.translation), **numbers)
                _add_body(parts, child, raw.inertias[i] if last else pin.Inertia.Zero())
                self.moving.append((own, joint, kind))
                parent, X = child, pin.SE3.Identity()
            bodies.append(body)
        self.model = parts.model("pinocchio", np.array(raw.gravity.linear))

    def loops(self, held: list[tuple[str, Any]]) -> tuple[Loop, ...]:
        """Return constraints of two frames, each in the axes of the joint that carries it."""
        out = []
        for kind, x in held:
            ends = (x.joint1_id, x.joint1_placement), (x.joint2_id, x.joint2_placement)
            a, b = ((self._bodies[i], np.array(X.rotation), np.array(X.translation)) for i, X in ends)
            out.append(Loop(str(x.name), kind, *a, *b))
        return tuple(out)

    def _steps(self, joint: Any) -> list[tuple[Any, str, Array | None, Any]]:
        """Return a joint as steps: Pinocchio's joint, kind, axis, and where it stands in the one before."""
        if joint.shortname() == "JointModelComposite":
            inner = joint.extract()
            return [(j, *joint_kind(j), X) for j, X in zip(inner.joints, inner.jointPlacements, strict=True)]
        return [(joint, *joint_kind(joint), pin.SE3.Identity())]

    # The engine's own values, in the description's coordinates.

    def terms(self, q: Array, v: Array, without: tuple[str, ...] = ()) -> dict[str, Array]:  # noqa: ARG002
        """Return M, g, nle and passive at a batch of states.

        passive is of the damping that Pinocchio read: its algorithms leave that to the caller.
        """
        each = [self._one(*x) for x in zip(q, v, strict=True)]
        return {name: np.array([values[name] for values in each]) for name in ("M", "g", "nle", "passive")}

    def _one(self, q: Array, v: Array) -> dict[str, Array]:
        raw, layout = self.raw, self.model.layout
        theirs, T, slip = np.empty(raw.nq), np.zeros((raw.nv, raw.nv)), np.zeros(raw.nv)
        for name, joint, kind in self.moving:
            x, w = q[layout.q[name]], layout.v[name]
            iq, iv = joint.idx_q, joint.idx_v
            T[iv : iv + joint.nv, w] = np.eye(joint.nv)
            if joint.nq == joint.nv + 1 and kind == "continuous":
                x = np.array([np.cos(x[0]), np.sin(x[0])])
            elif kind == "planar":
                c, s = np.cos(x[2]), np.sin(x[2])
                x = np.array([x[0], x[1], c, s])
                # v_pin = Rᵀ v, and v̇_pin = Rᵀ v̇ + Ṙᵀ v.
                T[iv : iv + 2, w.start : w.start + 2] = [[c, s], [-s, c]]
                a, b, turn = v[w]
                slip[iv : iv + 2] = turn * np.array([-s * a + c * b, -c * a - s * b])
            theirs[iq : iq + joint.nq] = x
        u = T @ v
        M = np.array(pin.crba(raw, self.data, theirs))
        M = np.triu(M) + np.triu(M, 1).T
        nle = np.array(pin.nonLinearEffects(raw, self.data, theirs, u))
        g = np.array(pin.computeGeneralizedGravity(raw, self.data, theirs))
        passive = -np.array(raw.damping) * u
        return {"M": T.T @ M @ T, "g": T.T @ g, "nle": T.T @ (nle + M @ slip), "passive": T.T @ passive}


def _add_body(parts: Parts, name: str, inertia: Any) -> None:
    parts.body(name, float(inertia.mass), np.array(inertia.lever), np.array(inertia.inertia))


def _numbers(raw: Any, joint: Any, kind: str, axis: Array | None) -> dict[str, Any]:
    out = joint_numbers(raw, joint) | ({} if axis is None else {"axes": np.array([axis])})
    return out | ({"pitch": float(getattr(joint, "pitch", 0.0))} if kind == "helical" else {})
