"""MuJoCo's own importer of URDF and MJCF, and the models that it reads, described.

The only place that knows how a compiled `mjModel` holds a tree: joints stand in a body's own axes
and may be several, `qpos0` is where they are drawn, inertias are principal moments in axes of
their own, and quaternions are w, x, y, z.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import mujoco
import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit.engines.imported import Beside, Imported, checked, joint_of, stacked, unused
from mbkit.engines.mujoco.model import full_mass_matrix, heard_warnings
from mbkit.errors import UnsupportedError
from mbkit.load.mjcf_couplings import with_couplings
from mbkit.load.urdf_reader import BASE_JOINT
from mbkit.model import Body, Joint, JointCoupling, Model, PointSpring
from mbkit.model.joint_types import kind_of

_KINDS: Final = {0: "free", 1: "ball", 2: "prismatic", 3: "revolute"}
#: What changes no smooth term, and may take long or leave a part of the tree out.
_OFF: Final = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT)
_ASLEEP: Final = int(mujoco.mjtEnableBit.mjENBL_SLEEP)
#: Names that a note lists.
_MAX_NAMES: Final = 6
_OF_TENDON: Final = ("stiffness", "stiffnesspoly", "damping", "dampingpoly", "armature")


def read(text: str, format_: str, floating_base: bool = False, files: dict[str, bytes] | None = None) -> Imported:
    """Return what MuJoCo's parser and compiler make of a text; an MJCF says by itself that its base floats."""
    # A singular M at the zero configuration is a warning, and no refusal.
    with heard_warnings() as heard, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            made = (
                _floating(text)
                if floating_base and format_ == "urdf"
                else mujoco.MjModel.from_xml_string(text, files or {})
            )
        except UnsupportedError:
            raise
        except Exception as error:
            lines = " ".join(str(error).split())
            raise UnsupportedError(f"mujoco: {lines.removeprefix('XML Error: ').removeprefix('Error: ')}") from None
    described = _Description(made)
    terms = _Terms(checked("mujoco", described.model), made, described.numbers)
    notes = (*_constraints(made), *(" ".join(w.split()) for w in heard))
    beside = tuple(
        x.beside._replace(without=described.without(x.beside.key)) if x.beside.key in described.parts else x.beside
        for x in terms.extras
    )
    return Imported(described.model, terms, notes, beside)


def _floating(text: str) -> Any:
    """Return a compiled URDF whose base floats: between parser and compiler, which fuses a base that does not."""
    spec = mujoco.MjSpec.from_string(text)
    tops = list(spec.worldbody.bodies)
    if len(tops) != 1:
        names = ", ".join(repr(b.name) for b in tops) or "none"
        raise UnsupportedError(f"mujoco: no single body stands in the world that could float; there are: {names}")
    tops[0].add_freejoint(name=BASE_JOINT)
    return spec.compile()


@dataclass(frozen=True)
class _Extra:
    """What may act beside bodies and joints, and how it is taken out of a compiled model."""

    beside: Beside
    remove: Callable[[Any], None]


class _Terms:
    """MuJoCo's own terms of its own model, with all that acts in it at zero control and activation."""

    def __init__(self, model: Model, m: Any, numbers: list[int]) -> None:
        self._m = copy.copy(m)
        self._m.opt.disableflags |= _OFF
        self._m.opt.enableflags &= ~_ASLEEP
        self.extras = _extras(m)
        #: (joint's kind, start in qpos, start in qvel, slices of q and v) of each that moves.
        self._moving = [
            (
                joint.kind,
                int(m.jnt_qposadr[j]),
                int(m.jnt_dofadr[j]),
                model.layout.q[joint.name],
                model.layout.v[joint.name],
            )
            for joint, j in zip(model.joints, numbers, strict=True)
            if j >= 0
        ]

    def __call__(self, q: Array, v: Array, without: tuple[str, ...] = ()) -> dict[str, Array]:
        """Return M, g, nle and passive at a batch of states.

        passive is qfrc_passive, and qfrc_actuator where all controls and activations are zero.
        """
        m = copy.copy(self._m) if without else self._m
        for extra in self.extras:
            if extra.beside.key in without:
                extra.remove(m)
        data = mujoco.MjData(m)
        with heard_warnings():
            return stacked(self._one(m, data, *x) for x in zip(q, v, strict=True))

    def _one(self, m: Any, d: Any, q: Array, v: Array) -> dict[str, Array]:
        T, slip, qvel = np.zeros((m.nv, m.nv)), np.zeros(m.nv), np.zeros(m.nv)
        mujoco.mj_resetData(m, d)
        for kind, iq, iv, at_q, at_v in self._moving:
            x, n = q[at_q].copy(), at_v.stop - at_v.start
            T[iv : iv + n, at_v] = np.eye(n)
            if kind in ("free", "ball"):
                x[-4:] = np.roll(x[-4:], 1)
            if kind == "free":
                # Its linear velocity is in the world's axes: v_mj = R v, and v̇_mj = R (v̇ + ω × v).
                R = _matrix(x[-4:])
                T[iv : iv + 3, at_v.start : at_v.start + 3] = R
                slip[iv : iv + 3] = R @ np.cross(v[at_v][3:], v[at_v][:3])
            d.qpos[iq : iq + len(x)] = x
        qvel[:] = T @ v
        mujoco.mj_fwdPosition(m, d)
        mujoco.mj_fwdVelocity(m, d)
        g = d.qfrc_bias.copy()
        M = full_mass_matrix(m, d)
        d.qvel[:] = qvel
        mujoco.mj_fwdVelocity(m, d)
        mujoco.mj_fwdActuation(m, d)
        return {
            "M": T.T @ M @ T,
            "g": T.T @ g,
            "nle": T.T @ (d.qfrc_bias + M @ slip),
            "passive": T.T @ (d.qfrc_passive + d.qfrc_actuator),
        }


def _constraints(m: Any) -> list[str]:
    """Name the constraints, which are outside of all terms."""
    kinds: dict[str, list[str]] = {}
    for i, type_ in enumerate(m.eq_type):
        kind = mujoco.mjtEq(int(type_)).name.removeprefix("mjEQ_").lower()
        kinds.setdefault(kind, []).append(_called(m.eq(i), i))
    out = []
    for kind, names in kinds.items():
        what = "mimic joints are soft equality constraints" if kind == "joint" else f"{kind} constraints are soft"
        some = ", ".join(names[:_MAX_NAMES]) + (
            f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
        )
        out.append(f"{what} ({some}), in none of the terms")
    return out


def _extras(m: Any) -> list[_Extra]:
    """Return what may act in a compiled model beside its bodies and joints, with its numbers."""
    out = []
    for i in range(m.ntendon):
        numbers = _numbers(m, "tendon", i, _OF_TENDON)
        if numbers:
            says = f"tendon {_called(m.tendon(i), i)} has {numbers}"
            out.append(
                _Extra(Beside(f"tendon {i}", "tendon", says), _zeroed(i, *(f"tendon_{name}" for name in _OF_TENDON)))
            )
    # An actuator may have several controls, which nu counts.
    for i in range(len(m.actuator_trntype)):
        numbers = _numbers(m, "actuator", i, ("gear", "armature", "damping", "dampingpoly", "gainprm", "biasprm"))
        says = f"actuator {_called(m.actuator(i), i)}{_driven(m, i)} has {numbers or 'no numbers'}"
        out.append(_Extra(Beside(f"actuator {i}", "actuator", says), _silent(i)))
    for b in map(int, np.flatnonzero(m.body_gravcomp)):
        says = f"body {_called(m.body(b), b)} has gravity compensation {m.body_gravcomp[b]:g}"
        out.append(_Extra(Beside(f"body {b}", "gravity compensation", says), _zeroed(b, "body_gravcomp")))
    if m.opt.density or m.opt.viscosity:
        wind = " ".join(f"{x:g}" for x in m.opt.wind)
        says = f"a fluid acts (density {m.opt.density:g}, viscosity {m.opt.viscosity:g}, wind {wind})"
        out.append(_Extra(Beside("fluid", "fluid", says), _dry))
    for j in range(m.njnt):
        turning = m.jnt_type[j] <= int(mujoco.mjtJoint.mjJNT_BALL)
        names = ("jnt_stiffness", "jnt_stiffnesspoly") if turning else ("jnt_stiffnesspoly",)
        if any(np.any(getattr(m, name)[j]) for name in names):
            what = "a spring on its rotation" if turning else "a spring that is not linear"
            says = f"joint {_called(m.joint(j), j)} has {what}"
            out.append(_Extra(Beside(f"joint {j}", "spring", says), _zeroed(j, *names)))
        dofs = slice(int(m.jnt_dofadr[j]), int(m.jnt_dofadr[j]) + kind_of(_KINDS[int(m.jnt_type[j])]).nv)
        if np.any(m.dof_dampingpoly[dofs]):
            says = f"joint {_called(m.joint(j), j)} has a damper that is not linear"
            out.append(_Extra(Beside(f"damper {j}", "damping", says), _zeroed(dofs, "dof_dampingpoly")))
    return out


def _driven(m: Any, i: int) -> str:
    """Return the joint or tendon that an actuator drives, for a message; empty where it drives neither."""
    kind, target = mujoco.mjtTrn(int(m.actuator_trntype[i])), int(np.ravel(m.actuator_trnid[i])[0])
    if kind in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT):
        return f" on joint {_called(m.joint(target), target)}"
    return f" on tendon {_called(m.tendon(target), target)}" if kind == mujoco.mjtTrn.mjTRN_TENDON else ""


def _called(element: Any, index: int) -> str:
    return repr(element.name) if element.name else f"number {index}"


def _numbers(m: Any, what: str, i: int, names: tuple[str, ...]) -> str:
    texts = []
    for name in names:
        values = np.ravel(getattr(m, f"{what}_{name}")[i])
        if np.any(values):
            last = int(np.flatnonzero(values)[-1]) + 1
            texts.append(f"{name} {' '.join(f'{x:g}' for x in values[:last])}")
    return ", ".join(texts)


def _zeroed(at: Any, *names: str) -> Callable[[Any], None]:
    def remove(m: Any) -> None:
        for name in names:
            getattr(m, name)[at] = 0.0

    return remove


def _silent(i: int) -> Callable[[Any], None]:
    def remove(m: Any) -> None:
        _zeroed(i, "actuator_armature", "actuator_damping", "actuator_dampingpoly")(m)
        m.actuator_forcelimited[i] = 1
        m.actuator_forcerange[i] = 0.0

    return remove


def _dry(m: Any) -> None:
    m.opt.density = m.opt.viscosity = 0.0


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
        gravity = np.zeros(3) if self._off("GRAVITY") else np.array(m.opt.gravity)
        self._tree = Model(name="mujoco", gravity=gravity, bodies=tuple(self.bodies), joints=tuple(self.joints))
        #: By key of `Beside`: what is described of tendons and actuators.
        self.parts: dict[str, PointSpring | JointCoupling] = {**dict(self._point_springs()), **dict(self._couplings())}
        self.model = self.without("")

    def without(self, key: str) -> Model:
        """Return the description less what it has of one tendon or actuator."""
        kept = [part for name, part in self.parts.items() if name != key]
        springs = tuple(x for x in kept if isinstance(x, PointSpring))
        return with_couplings(replace(self._tree, springs=springs), [x for x in kept if isinstance(x, JointCoupling)])

    def _off(self, flag: str) -> bool:
        return bool(self.m.opt.disableflags & int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}")))

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
        numbers: dict[str, Any] = {"armature": np.array(m.dof_armature[v]), "friction": np.array(m.dof_frictionloss[v])}
        if not self._off("DAMPER"):
            numbers["damping"] = np.array(m.dof_damping[v])
        if type_.nv == 1:
            axis, ref = np.array(m.jnt_axis[j]), float(m.qpos0[m.jnt_qposadr[j]])
            numbers["axes"] = axis[None, :]
            # At q = ref the body is where it is drawn.
            if ref and kind == "revolute":
                R = R @ spatial.matrix_from_quaternion(spatial.exp_quaternion(-ref * axis))
            elif ref:
                p = p - R @ (ref * axis)
            if m.jnt_limited[j]:
                numbers["lower"], numbers["upper"] = np.split(np.array(m.jnt_range[j]), 2)
            elif kind == "revolute":
                kind = "continuous"
            if m.jnt_actfrclimited[j]:
                numbers["effort_limit"] = np.array([np.abs(m.jnt_actfrcrange[j]).max()])
            stiffness = float(np.ravel(m.jnt_stiffness[j])[0])
            if stiffness and not self._off("SPRING"):
                numbers["stiffness"], numbers["rest"] = np.array([stiffness]), m.qpos_spring[[m.jnt_qposadr[j]]]
        self.numbers.append(j)
        self.joints.append(joint_of(name, kind, parent, child, R, p, **numbers))

    def _spring(self, t: int) -> tuple[float, float, float]:
        """Return a tendon's stiffness, rest length and damping; a spring with a range of rest lengths is left out."""
        m, (low, high) = self.m, self.m.tendon_lengthspring[t].tolist()
        stiffness = float(np.ravel(m.tendon_stiffness[t])[0]) if low == high and not self._off("SPRING") else 0.0
        return max(stiffness, 0.0), low, float(np.ravel(m.tendon_damping[t])[0]) * (not self._off("DAMPER"))

    def _point_springs(self) -> Iterator[tuple[str, PointSpring]]:
        """Yield the tendons that are springs between two sites, with their keys."""
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
                    yield f"tendon {t}", PointSpring(name, a, at_a, b, at_b, stiffness, rest, damping)

    def _couplings(self) -> Iterator[tuple[str, JointCoupling]]:
        """Yield what tendons and actuators do as springs, dampers and rotors on sums of joint coordinates."""
        m, taken = self.m, set[str]()
        names = {j: joint.name for j, joint in zip(self.numbers, self.joints, strict=True)}

        def made(key: str, name: str, row: dict[int, float], *numbers: float) -> Iterator[tuple[str, JointCoupling]]:
            taken.add(name := unused(name, taken))
            row = {j: x for j, x in row.items() if x}
            if row and (numbers[0] or any(numbers[2:])):
                factors = np.array([*row.values()])
                yield key, JointCoupling(name, tuple(names[j] for j in row), factors, *numbers)

        tendons: dict[int, dict[int, float]] = {}
        for t in range(m.ntendon):
            wraps = range(int(m.tendon_adr[t]), int(m.tendon_adr[t]) + int(m.tendon_num[t]))
            row = dict.fromkeys((int(m.wrap_objid[w]) for w in wraps), 0.0)
            if all(m.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT for w in wraps):
                for w in wraps:
                    row[int(m.wrap_objid[w])] += float(m.wrap_prm[w])
                tendons[t] = row
                name = m.tendon(t).name or f"tendon{t + 1}"
                yield from made(f"tendon {t}", name, row, *self._spring(t), float(m.tendon_armature[t]))
        of_joint = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
        for i in range(len(m.actuator_trntype)):
            target, row = int(m.actuator_trnid[i, 0]), {}
            if int(m.actuator_trntype[i]) in of_joint and _KINDS[int(m.jnt_type[target])] in ("prismatic", "revolute"):
                row = {target: 1.0}
            elif m.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_TENDON:
                row = tendons.get(target, {})
            row = {j: float(m.actuator_gear[i, 0]) * x for j, x in row.items()}
            affine = m.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE and not self._off("ACTUATION")
            b0, b1, b2 = m.actuator_biasprm[i, :3].tolist() if affine else (0.0, 0.0, 0.0)
            rest = -b0 / b1 if b1 else 0.0
            damping = float(np.ravel(m.actuator_damping[i])[0]) * (not self._off("DAMPER")) - min(b2, 0.0)
            name = m.actuator(i).name or f"actuator{i + 1}"
            yield from made(
                f"actuator {i}", name, row, max(-b1, 0.0), rest, max(damping, 0.0), float(m.actuator_armature[i])
            )


def _matrix(wxyz: Array) -> Array:
    w, x, y, z = (float(c) for c in wxyz)
    return spatial.matrix_from_quaternion(np.array([x, y, z, w]))
