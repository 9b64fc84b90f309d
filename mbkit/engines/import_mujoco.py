"""MuJoCo's own importer of URDF and MJCF, and what it made of a file.

The only place that knows how a compiled `mjModel` holds a tree: joints stand in a body's own axes
and may be several, `qpos0` is where they are drawn, inertias are principal moments in axes of
their own, and quaternions are w, x, y, z.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Final

import mujoco
import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit.engines.base import Dynamics
from mbkit.engines.imported import Imported, checked, unused
from mbkit.engines.mujoco import MujocoDynamics
from mbkit.engines.mujoco_api import heard_warnings
from mbkit.engines.mujoco_model import MujocoModel
from mbkit.errors import UnsupportedError
from mbkit.load.floating import BASE_JOINT
from mbkit.load.mjcf_couplings import coupled
from mbkit.model import Body, Joint, JointCoupling, Model, PointSpring
from mbkit.model.kinds import kind_of

__all__ = ["ImportedMujoco", "read"]

_KINDS: Final = {0: "free", 1: "ball", 2: "prismatic", 3: "revolute"}


def read(text: str, format_: str, floating_base: bool = False) -> Imported:
    """Return what MuJoCo's parser and compiler make of a text; an MJCF says by itself that its base floats."""
    # A singular M at the zero configuration is a warning, and no refusal.
    with heard_warnings() as heard, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            made = _floating(text) if floating_base and format_ == "urdf" else mujoco.MjModel.from_xml_string(text)
        except UnsupportedError:
            raise
        except Exception as error:
            lines = " ".join(str(error).split())
            raise UnsupportedError(f"mujoco: {lines.removeprefix('XML Error: ').removeprefix('Error: ')}") from None
    described = _Description(made)
    dyn = ImportedMujoco(checked("mujoco", described.model), described.made)
    return Imported(described.model, dyn.terms, (*_beside(made), *(" ".join(w.split()) for w in heard)))


def _floating(text: str) -> Any:
    """Return a compiled URDF whose base floats: between parser and compiler, which fuses a base that does not."""
    spec = mujoco.MjSpec.from_string(text)
    tops = list(spec.worldbody.bodies)
    if len(tops) != 1:
        told = ", ".join(repr(b.name) for b in tops) or "none"
        raise UnsupportedError(f"mujoco: no single body stands in the world that could float; there are: {told}")
    tops[0].add_freejoint(name=BASE_JOINT)
    return spec.compile()


class ImportedMujoco(MujocoDynamics):
    """MuJoCo on its own model."""

    def __init__(self, model: Model, made: MujocoModel) -> None:
        Dynamics.__init__(self, model)
        self._made = made
        self.mj_model = self._m = made.model
        self.disabled = ()
        self._d = mujoco.MjData(self._m)
        self._reduced = model.layout.reduced
        self._lock = threading.RLock()

    def terms(self, q: Array, v: Array) -> dict[str, Array]:
        """Return M, g and nle at a batch of states."""
        return {"M": self.mass_matrix(q), "g": self.gravity(q), "nle": self.nle(q, v)}


def _beside(m: Any) -> list[str]:
    """Say what acts in the model beside its bodies and joints."""
    out = []
    kinds = [mujoco.mjtEq(int(t)).name.removeprefix("mjEQ_").lower() for t in m.eq_type]
    for kind in dict.fromkeys(kinds):
        what = "mimic joints are soft equality constraints" if kind == "joint" else f"{kind} constraints are soft"
        out.append(f"{what} ({kinds.count(kind)}), outside M and nle")
    for count, what in ((m.ntendon, "tendons"), (len(m.actuator_trntype), "actuators")):
        if count:
            out.append(f"{count} {what}: their armature is part of M, their springs and dampers are outside M and nle")
    if np.any(m.body_gravcomp):
        out.append(f"gravity compensation on {int(np.count_nonzero(m.body_gravcomp))} bodies, outside nle")
    return out


class _Description:
    """Reads a compiled model body by body."""

    def __init__(self, m: Any) -> None:
        self.m = m
        self.names = ["world"]
        self.taken = {"joint": set[str](), "body": {"world"}}
        for i in range(1, m.nbody):
            self.names.append(self._new("body", m.body(i).name or f"body{i}"))
        self.anchors: list[Array] = [np.zeros(3)]
        self.bodies: list[Body] = []
        self.joints: list[Joint] = []
        self.numbers: list[int] = []
        for i in range(1, m.nbody):
            self._body(i)
        self.model = Model(
            name="mujoco", gravity=np.array(m.opt.gravity), bodies=tuple(self.bodies), joints=tuple(self.joints)
        )
        self.model = coupled(replace(self.model, springs=tuple(self._point_springs())), self._couplings())
        self.made = self._mapped()

    def _new(self, what: str, name: str) -> str:
        made = unused(name, self.taken[what])
        self.taken[what].add(made)
        return made

    def _body(self, i: int) -> None:
        m = self.m
        first, count = int(m.body_jntadr[i]), int(m.body_jntnum[i])
        mine = range(first, first + count) if count else range(0)
        kinds = [_KINDS[int(m.jnt_type[j])] for j in mine]
        # A body's frame is its last joint's, so it stands where that is anchored.
        last = np.array(m.jnt_pos[mine[-1]]) if count and kinds[-1] != "free" else np.zeros(3)
        self.anchors.append(last)
        parent_index = int(m.body_parentid[i])
        R = _matrix(m.body_quat[i])
        p = np.array(m.body_pos[i]) - self.anchors[parent_index]
        parent, before = self.names[parent_index], np.zeros(3)
        if not count:
            self._joint(self._new("joint", f"{self.names[i]}_fixed"), "fixed", parent, self.names[i], R, p, -1)
        for k, j in enumerate(mine):
            name = self._new("joint", m.joint(j).name or f"{self.names[i]}_joint{k or ''}")
            child = self.names[i] if k == count - 1 else self._new("body", f"{self.names[i]}_{name}")
            if kinds[k] == "free":
                # Its coordinates are the pose in the world, wherever it is drawn.
                R, p = np.eye(3), np.zeros(3)
            else:
                anchor = np.array(m.jnt_pos[j])
                p = p + R @ (anchor - before)
                before = anchor
            self._joint(name, kinds[k], parent, child, R, p, j)
            if k < count - 1:
                self.bodies.append(Body(child, 0.0, np.zeros(3), np.zeros((3, 3))))
            R, p, parent = np.eye(3), np.zeros(3), child
        axes = _matrix(m.body_iquat[i])
        inertia = axes @ np.diag(m.body_inertia[i]) @ axes.T
        com = np.array(m.body_ipos[i]) - last
        self.bodies.append(Body(self.names[i], float(m.body_mass[i]), com, 0.5 * (inertia + inertia.T)))

    def _joint(self, name: str, kind: str, parent: str, child: str, R: Array, p: Array, j: int) -> None:
        m, type_ = self.m, kind_of(kind)
        v = slice(int(m.jnt_dofadr[j]), int(m.jnt_dofadr[j]) + type_.nv) if j >= 0 else slice(0, 0)
        lower, upper = np.full(type_.nq, -np.inf), np.full(type_.nq, np.inf)
        stiffness, rest, effort = np.zeros(type_.nv), np.zeros(type_.nv), np.full(type_.nv, np.inf)
        axes = np.empty((0, 3))
        if type_.nv == 1:
            axis, ref = np.array(m.jnt_axis[j]), float(m.qpos0[m.jnt_qposadr[j]])
            axes = axis[None, :]
            # At q = ref the body is where it is drawn.
            if ref and kind == "revolute":
                R = R @ spatial.matrix_from_quaternion(spatial.exp_quaternion(-ref * axis))
            elif ref:
                p = p - R @ (ref * axis)
            if m.jnt_limited[j]:
                lower, upper = np.split(np.array(m.jnt_range[j]), 2)
            elif kind == "revolute":
                kind = "continuous"
            if m.jnt_actfrclimited[j]:
                effort = np.array([np.abs(m.jnt_actfrcrange[j]).max()])
            stiffness = np.array([float(np.ravel(m.jnt_stiffness[j])[0])])
            rest = np.array([m.qpos_spring[m.jnt_qposadr[j]]]) if stiffness.any() else rest
        self.numbers.append(j)
        self.joints.append(
            Joint(
                name=name,
                kind=kind,
                parent=parent,
                child=child,
                rotation=R,
                translation=p,
                axes=axes,
                pitch=0.0,
                lower=lower,
                upper=upper,
                velocity_limit=np.full(type_.nv, np.inf),
                effort_limit=effort,
                armature=np.array(m.dof_armature[v]),
                damping=np.array(m.dof_damping[v]),
                friction=np.array(m.dof_frictionloss[v]),
                stiffness=stiffness,
                rest=rest,
            )
        )

    def _on(self, part: str) -> bool:
        """Return whether no option flag switches springs, dampers or actuation off."""
        return not self.m.opt.disableflags & int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{part}"))

    def _spring(self, t: int) -> tuple[float, float, float]:
        """Return a tendon's stiffness, rest length and damping; a spring with a range of rest lengths is left out."""
        m, (low, high) = self.m, self.m.tendon_lengthspring[t].tolist()
        stiffness = float(np.ravel(m.tendon_stiffness[t])[0]) if low == high and self._on("SPRING") else 0.0
        return max(stiffness, 0.0), low, float(np.ravel(m.tendon_damping[t])[0]) * self._on("DAMPER")

    def _point_springs(self) -> Iterator[PointSpring]:
        """Yield the tendons that are springs between two sites."""
        m = self.m
        for t in range(m.ntendon):
            wraps = range(int(m.tendon_adr[t]), int(m.tendon_adr[t]) + int(m.tendon_num[t]))
            if [int(m.wrap_type[w]) for w in wraps] == [int(mujoco.mjtWrap.mjWRAP_SITE)] * 2:
                sites = [int(m.wrap_objid[w]) for w in wraps]
                bodies = [int(m.site_bodyid[k]) for k in sites]
                (a, at_a), (b, at_b) = (
                    (self.names[i], m.site_pos[k] - self.anchors[i]) for i, k in zip(bodies, sites, strict=True)
                )
                stiffness, rest, damping = self._spring(t)
                if a != b and (stiffness or damping):
                    name = m.tendon(t).name or f"tendon{t + 1}"
                    yield PointSpring(name, a, at_a, b, at_b, stiffness, rest, damping)

    def _couplings(self) -> Iterator[JointCoupling]:
        """Yield what tendons and actuators do as springs, dampers and rotors on sums of joint coordinates."""
        m, taken = self.m, set[str]()
        names = {j: joint.name for j, joint in zip(self.numbers, self.joints, strict=True)}

        def made(name: str, row: dict[int, float], *numbers: float) -> Iterator[JointCoupling]:
            taken.add(name := unused(name, taken))
            row = {j: x for j, x in row.items() if x}
            if row and (numbers[0] or any(numbers[2:])):
                yield JointCoupling(name, tuple(names[j] for j in row), np.array([*row.values()]), *numbers)

        tendons: dict[int, dict[int, float]] = {}
        for t in range(m.ntendon):
            wraps = range(int(m.tendon_adr[t]), int(m.tendon_adr[t]) + int(m.tendon_num[t]))
            row = dict.fromkeys((int(m.wrap_objid[w]) for w in wraps), 0.0)
            if all(m.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT for w in wraps):
                for w in wraps:
                    row[int(m.wrap_objid[w])] += float(m.wrap_prm[w])
                tendons[t] = row
                yield from made(
                    m.tendon(t).name or f"tendon{t + 1}", row, *self._spring(t), float(m.tendon_armature[t])
                )
        of_joint = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
        # An actuator may have several controls, which nu counts.
        for i in range(len(m.actuator_trntype)):
            target, row = int(m.actuator_trnid[i, 0]), {}
            if int(m.actuator_trntype[i]) in of_joint and _KINDS[int(m.jnt_type[target])] in ("prismatic", "revolute"):
                row = {target: 1.0}
            elif m.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_TENDON:
                row = tendons.get(target, {})
            row = {j: float(m.actuator_gear[i, 0]) * x for j, x in row.items()}
            affine = m.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE and self._on("ACTUATION")
            b0, b1, b2 = m.actuator_biasprm[i, :3].tolist() if affine else (0.0, 0.0, 0.0)
            rest = -b0 / b1 if b1 else 0.0
            damping = float(np.ravel(m.actuator_damping[i])[0]) * self._on("DAMPER") - min(b2, 0.0)
            name = m.actuator(i).name or f"actuator{i + 1}"
            yield from made(name, row, max(-b1, 0.0), rest, max(damping, 0.0), float(m.actuator_armature[i]))

    def _mapped(self) -> MujocoModel:
        m, layout = self.m, self.model.layout
        q_index, v_index = np.zeros(m.nq, int), np.zeros(m.nv, int)
        free = []
        for joint, j in zip(self.joints, self.numbers, strict=True):
            if j < 0:
                continue
            q, v = int(m.jnt_qposadr[j]), int(m.jnt_dofadr[j])
            ours_q, ours_v = layout.q[joint.name], layout.v[joint.name]
            order = list(range(ours_q.start, ours_q.stop))
            if joint.type.quaternion is not None:
                k = joint.type.quaternion
                order[k:] = [order[-1], *order[k:-1]]
            q_index[q : q + joint.type.nq], v_index[v : v + joint.type.nv] = order, range(ours_v.start, ours_v.stop)
            if joint.kind == "free":
                free.append((q, v))
        bodies = {name: i for i, name in enumerate(self.names)}
        return MujocoModel(m, q_index, v_index, tuple(free), bodies, frozenset(), ())


def _matrix(wxyz: Array) -> Array:
    w, x, y, z = (float(c) for c in wxyz)
    return spatial.matrix_from_quaternion(np.array([x, y, z, w]))
