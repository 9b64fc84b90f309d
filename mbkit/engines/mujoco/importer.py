"""MuJoCo's own importer of URDF and MJCF, and the models that it reads, described.

The only place that knows how a compiled `mjModel` holds a tree: joints stand in a body's own axes and may be several,
`qpos0` is where they are drawn, and inertias are principal moments in axes of their own.

What MuJoCo simulates of an MJCF beside the terms: options, servos, force ranges, contacts, limits.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Final

import mujoco
import numpy as np

from mbkit._check import Array, by_key
from mbkit._reproducible import turned
from mbkit.engines.imported import Beside, Imported, Parts, checked
from mbkit.engines.mujoco.engine import MujocoDynamics
from mbkit.engines.mujoco.model import INERTIA, full_mass_matrix, heard_warnings, mapped
from mbkit.errors import UnsupportedError
from mbkit.load.mjcf import JOINT_NUMBERS
from mbkit.load.mjcf_attributes import Pose, matrix_of
from mbkit.load.mjcf_couplings import Acting, with_parts
from mbkit.load.mjcf_equalities import coupled
from mbkit.load.mjcf_reader import KINDS, MjcfBody, MjcfJoint
from mbkit.load.shapes import MassProperties
from mbkit.load.urdf_reader import BASE_JOINT
from mbkit.load.xml_reader import Element
from mbkit.model import Coupler, GravityCompensation, Joint, JointCoupling, Loop, Model, PointSpring
from mbkit.model.elements.kinds import EFFECTS
from mbkit.model.joint_types import kind_of
from mbkit.model.validation import listing

_TYPES, _KINDS = tuple(KINDS), tuple(KINDS.values())
#: Flags that change no smooth term, and may take long or leave a part of the tree out.
_OFF: Final = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT)
_ASLEEP: Final = int(mujoco.mjtEnableBit.mjENBL_SLEEP)
#: Takes something out of a compiled model.
_Removal = Callable[[Any], None]
_OF_TENDON: Final = ("stiffness", "stiffnesspoly", "damping", "dampingpoly", INERTIA)


def read(text: str, format_: str, floating_base: bool = False, files: dict[str, bytes] | None = None) -> Imported:
    """Return what MuJoCo's parser and compiler make of a text; an MJCF says by itself that its base floats."""
    # A singular M at the zero configuration is a warning, and no refusal.
    with heard_warnings() as heard, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            floats = floating_base and format_ == "urdf"
            m = _floating(text) if floats else mujoco.MjModel.from_xml_string(text, files or {})
        except UnsupportedError:
            raise
        except Exception as error:
            lines = " ".join(str(error).split())
            raise UnsupportedError(f"mujoco: {lines.removeprefix('XML Error: ').removeprefix('Error: ')}") from None
    described = Described("mujoco", m)
    dyn = _Read.of(checked("mujoco", described.model), m, described.numbers, described.removals)
    return described.imported(dyn.terms, [" ".join(w.split()) for w in heard])


class Described:
    """A compiled model, or what has its numbers and names, with all that acts in it."""

    def __init__(self, name: str, m: Any) -> None:
        self._description, extras = _Description(m), list(_extras(m))
        self.model, self.numbers = replace(self._description.model, name=name), self._description.numbers
        self._beside, self._constraints = [x for x, _ in extras], (*_constraints(m), *_rubbing(m))
        #: By key of `Beside`: takes it out of a compiled model.
        self.removals = {x.key: remove for x, remove in extras}

    def imported(self, terms: Callable[..., dict[str, Array]], said: Sequence[str]) -> Imported:
        """Return the reading, with the terms of the engine that holds it and what it said."""
        own = self._description
        beside = tuple(x._replace(without=own.without(x.key)) if x.key in own.parts else x for x in self._beside)
        constraints = own.constraints()
        held = "by soft equality constraints" if any(isinstance(x, Coupler) for x in constraints) else ""
        return Imported(self.model, terms, (*self._constraints, *said), beside, constraints, "", held)


def _floating(text: str) -> Any:
    """Return a compiled URDF whose base floats: between parser and compiler, which fuses a base that does not."""
    spec = mujoco.MjSpec.from_string(text)
    tops = list(spec.worldbody.bodies)
    if len(tops) != 1:
        names = ", ".join(repr(b.name) for b in tops) or "none"
        raise UnsupportedError(f"mujoco: no single body stands in the world that could float; there are: {names}")
    tops[0].add_freejoint(name=BASE_JOINT)
    return spec.compile()


class _Read(MujocoDynamics):
    """MuJoCo on its own model, with all that acts in it at zero control and activation."""

    _has_force_elements = True

    @classmethod
    def of(cls, model: Model, m: Any, numbers: dict[str, int], removals: dict[str, _Removal]) -> _Read:
        m = copy.copy(m)
        m.opt.disableflags |= _OFF
        m.opt.enableflags &= ~_ASLEEP
        out = cls.holding(model, mapped(m, model, {name: [j] for name, j in numbers.items()}))
        out._removals = removals
        return out

    _removals: dict[str, _Removal]

    def terms(self, q: Array, v: Array, without: tuple[str, ...] = ()) -> dict[str, Array]:
        """Return M, g, nle and passive at a batch of states, without some of what acts beside bodies and joints.

        passive is qfrc_passive, and qfrc_actuator where all controls and activations are zero.
        """
        m = copy.copy(self._m)
        for key in without:
            self._removals[key](m)
        own = _Read.holding(self.model, replace(self._maps, model=m))
        with self._lock, heard_warnings():
            methods = {"M": own._mass_matrix, "g": own._gravity}
            out = {name: np.array([method(x) for x in q]) for name, method in methods.items()}
            pairs = {"nle": own._nle, "passive": own._passive}
            return out | {k: np.array([method(*x) for x in zip(q, v, strict=True)]) for k, method in pairs.items()}

    def _mass_matrix(self, q: Array) -> Array:
        # With the transmission: actuators have rotors.
        self._set(q)
        mujoco.mj_fwdPosition(self._m, self._d)
        return self._columns(self._columns(full_mass_matrix(self._m, self._d)).T)

    def _passive(self, q: Array, v: Array) -> Array:
        self._set(q, v)
        self._velocities()
        mujoco.mj_fwdActuation(self._m, self._d)
        return self._force(self._d.qfrc_passive + self._d.qfrc_actuator)


def _constraints(m: Any) -> list[str]:
    """Name the constraints, which are outside of all terms."""
    types = (mujoco.mjtEq(int(type_)).name.removeprefix("mjEQ_").lower() for type_ in m.eq_type)
    kinds, out = by_key((kind, _called(m.eq(i), i)) for i, kind in enumerate(types)), []
    for kind, names in kinds.items():
        what = "mimic joints are soft equality constraints" if kind == "joint" else f"{kind} constraints are soft"
        out.append(f"{what} ({listing(names)}), in none of the terms")
    return out


def _rubbing(m: Any) -> Iterator[str]:
    """Name the joints with jumps that no description holds: their velocities are along moving axes."""
    for j in range(m.njnt):
        type_ = kind_of(kind := _KINDS[int(m.jnt_type[j])])
        first = int(m.jnt_dofadr[j])
        if m.dof_frictionloss[first : first + type_.nv].any() and not type_.coordinate_velocities:
            yield f"{EFFECTS['jump']} of {kind} joint {_called(m.joint(j), j)} is left out"


def _extras(m: Any) -> Iterator[tuple[Beside, _Removal]]:
    """Yield what may act in a compiled model beside its bodies and joints, with its numbers, and its removal."""
    for i in range(m.ntendon):
        if numbers := _numbers(m, "tendon", i, _OF_TENDON):
            text = f"tendon {_called(m.tendon(i), i)} has {numbers}"
            yield Beside(f"tendon {i}", "tendon", text), _zeroed(i, *(f"tendon_{name}" for name in _OF_TENDON))
    # An actuator may have several controls, which nu counts.
    for i in range(len(m.actuator_trntype)):
        numbers = _numbers(m, "actuator", i, ("gear", INERTIA, "damping", "dampingpoly", "gainprm", "biasprm"))
        text = f"actuator {_called(m.actuator(i), i)}{_driven(m, i)} has {numbers or 'no numbers'}"
        zeros = dict.fromkeys(("actuator_armature", "actuator_damping", "actuator_dampingpoly"), 0.0)
        silent = _assigned(i, actuator_forcelimited=1, actuator_forcerange=0.0, **zeros)
        yield Beside(f"actuator {i}", "actuator", text), silent
    for b in map(int, np.flatnonzero(m.body_gravcomp * np.any(m.body_gravcomp > 0))):
        text = f"body {_called(m.body(b), b)} has gravity compensation {m.body_gravcomp[b]:g}"
        yield Beside(f"body {b}", "gravity compensation", text), _zeroed(b, "body_gravcomp")
    if m.opt.density or m.opt.viscosity:
        wind = " ".join(f"{x:g}" for x in m.opt.wind)
        text = f"a fluid acts (density {m.opt.density:g}, viscosity {m.opt.viscosity:g}, wind {wind})"
        yield Beside("fluid", "fluid", text), _dry
    for j in range(m.njnt):
        called = f"joint {_called(m.joint(j), j)} has"
        turning = m.jnt_type[j] <= int(mujoco.mjtJoint.mjJNT_BALL)
        names = ("jnt_stiffness", "jnt_stiffnesspoly") if turning else ("jnt_stiffnesspoly",)
        if any(np.any(getattr(m, name)[j]) for name in names):
            what = "a spring on its rotation" if turning else "a spring that is not linear"
            yield Beside(f"joint {j}", "spring", f"{called} {what}"), _zeroed(j, *names)
        dofs = slice(int(m.jnt_dofadr[j]), int(m.jnt_dofadr[j]) + kind_of(_KINDS[int(m.jnt_type[j])]).nv)
        if np.any(m.dof_dampingpoly[dofs]):
            text = f"{called} a damper that is not linear"
            yield Beside(f"damper {j}", "damping", text), _zeroed(dofs, "dof_dampingpoly")


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


def _assigned(at: Any, **values: float) -> _Removal:
    def remove(m: Any) -> None:
        for name, value in values.items():
            getattr(m, name)[at] = value

    return remove


def _zeroed(at: Any, *names: str) -> _Removal:
    return _assigned(at, **dict.fromkeys(names, 0.0))


def _dry(m: Any) -> None:
    m.opt.density = m.opt.viscosity = 0.0


class _Description:
    """Reads a compiled model body by body."""

    def __init__(self, m: Any) -> None:
        self.m, self._parts = m, Parts()
        names = (self._parts.name("body", m.body(i).name or f"body{i}") for i in range(1, m.nbody))
        self.names = ["world", *names]
        self.anchors: list[Array] = [np.zeros(3)]
        #: MuJoCo's number of each joint that moves.
        self.numbers: dict[str, int] = {}
        for i in range(1, m.nbody):
            self._body(i)
        #: Their names, in MuJoCo's order.
        self.joints = [*self.numbers]
        self._tree = self._parts.model("mujoco", np.zeros(3) if self._off("GRAVITY") else np.array(m.opt.gravity))
        #: By key of `Beside`: the descriptions of tendons, actuators and gravity compensation.
        self.parts: dict[str, PointSpring | JointCoupling | GravityCompensation] = {
            **{key: x.part() for key, x in self._acting() if x.acts and (x.factors or x.ends)},
            **dict(self._held()),
        }
        self.model = self.without("")

    def without(self, key: str) -> Model:
        """Return the description less what it has of one tendon, actuator, or held body."""
        return with_parts(self._tree, [part for name, part in self.parts.items() if name != key])

    def constraints(self) -> tuple[Loop | Coupler, ...]:
        """Return the active equalities of bodies and sites, in the bodies' axes, and those of joints and tendons."""
        off = self._off("EQUALITY") or self._off("CONSTRAINT")
        active = [i for i in range(self.m.neq) if self.m.eq_active0[i] and not off]
        return tuple(x for i in active if (x := self._loop(i) or self._coupler(i)))

    def _loop(self, i: int) -> Loop | None:
        m, kinds = self.m, {int(mujoco.mjtEq.mjEQ_CONNECT): "point", int(mujoco.mjtEq.mjEQ_WELD): "frame"}
        kind = kinds.get(int(m.eq_type[i]))
        if kind is None:
            return None
        objects, data, still = (int(m.eq_obj1id[i]), int(m.eq_obj2id[i])), np.array(m.eq_data[i]), np.eye(3)
        if m.eq_objtype[i] == mujoco.mjtObj.mjOBJ_SITE:
            ends = [(int(m.site_bodyid[s]), matrix_of(m.site_quat[s]), np.array(m.site_pos[s])) for s in objects]
        elif kind == "point":
            ends = [(objects[0], still, data[:3]), (objects[1], still, data[3:6])]
        else:
            # The relative pose is of the second body's axes, at its anchor.
            ends = [(objects[0], matrix_of(data[6:10]), data[3:6]), (objects[1], still, data[:3])]
        a, b = ((self.names[k], R, p - self.anchors[k]) for k, R, p in ends)
        return Loop(m.eq(i).name, kind, *a, *b)

    def _coupler(self, i: int) -> Coupler | None:
        m = self.m
        refs = {name: float(m.qpos0[m.jnt_qposadr[j]]) for name, j in self.numbers.items()}
        kinds = {
            int(mujoco.mjtEq.mjEQ_JOINT): lambda j: {self.joints[j]: 1.0},
            int(mujoco.mjtEq.mjEQ_TENDON): self._factors,
        }
        of = kinds.get(int(m.eq_type[i]))
        if of is None:
            return None
        sides = [of(k) for k in (int(m.eq_obj1id[i]), int(m.eq_obj2id[i])) if k >= 0]
        held = coupled(sides, m.eq_data[i][:5].tolist(), refs) if all(sides) else ""
        if isinstance(held, str):
            return None
        joint, leaders, ratios, offset, curve = held
        return Coupler(m.eq(i).name, joint, tuple(leaders), np.array(ratios), offset, np.array(curve))

    def _off(self, flag: str) -> bool:
        return bool(self.m.opt.disableflags & int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}")))

    def _body(self, i: int) -> None:
        m, parts, name, parent = self.m, self._parts, self.names[i], int(self.m.body_parentid[i])
        joints: list[MjcfJoint] = []
        for k in range(int(m.body_jntnum[i])):
            j = len(self.numbers)
            own = parts.name("joint", m.joint(j).name or f"{name}_joint{k or ''}")
            self.numbers[own] = j
            joints.append(joint := MjcfJoint(own, Element("joint", {}, 0), _TYPES[int(m.jnt_type[j])]))
            if joint.kind != "free":
                joint.anchor = np.array(m.jnt_pos[j])
            if joint.scalar:
                joint.axis, joint.ref = np.array(m.jnt_axis[j]), float(m.qpos0[m.jnt_qposadr[j]])
        axes = matrix_of(m.body_iquat[i])
        matter = MassProperties(
            float(m.body_mass[i]), np.array(m.body_ipos[i]), turned(axes, np.diag(m.body_inertia[i]))
        )
        body = MjcfBody(
            name, self.names[parent], Pose(matrix_of(m.body_quat[i]), np.array(m.body_pos[i])), joints, matter
        )
        for one, above, child, R, p in body.chain(self.anchors[parent], parts.name):
            if one is None:
                parts.joint(parts.name("joint", f"{name}_fixed"), "fixed", above, child, R, p)
                continue
            self._joint(one, above, child, R, p)
            if child != name:
                parts.body(child)
        self.anchors.append(body.anchor)
        parts.body(name, matter.mass, matter.com - body.anchor, matter.inertia)

    def _joint(self, joint: MjcfJoint, parent: str, child: str, R: Array, p: Array) -> None:
        m, name, kind, j = self.m, joint.name, KINDS[joint.kind], self.numbers[joint.name]
        nv = kind_of(kind).nv
        v = slice(int(m.jnt_dofadr[j]), int(m.jnt_dofadr[j]) + nv)
        effects = ["T", *["jump"] * kind_of(kind).coordinate_velocities, *["loss"] * (not self._off("DAMPER"))]
        fields = [x for effect in effects for x in Joint.adding_to(effect)]
        numbers: dict[str, Any] = {x: np.array(getattr(m, f"dof_{JOINT_NUMBERS[x]}")[v]) for x in fields}
        turning = Joint.adding_to("T")
        if kind == "free" and any(numbers[x].any() for x in turning):
            words = " and ".join(turning)
            raise UnsupportedError(
                f"joint {name!r} is free and has {words}, which mbkit.load reads as a body without weight; MuJoCo's "
                f"model has no such body to compare. Set the {words} to 0; mbkit check compares the engines with it"
            )
        if nv == 1:
            numbers["axes"] = joint.axis[None, :]
            R, p = joint.at_zero(R, p, joint.axis)
            if m.jnt_limited[j]:
                numbers["lower"], numbers["upper"] = np.split(np.array(m.jnt_range[j]), 2)
            elif kind == "revolute":
                kind = "continuous"
            if m.jnt_actfrclimited[j]:
                numbers["effort_limit"] = np.array([np.abs(m.jnt_actfrcrange[j]).max()])
            stiffness = float(np.ravel(m.jnt_stiffness[j])[0])
            if stiffness and not self._off("SPRING"):
                numbers["stiffness"], numbers["rest"] = np.array([stiffness]), m.qpos_spring[[m.jnt_qposadr[j]]]
        self._parts.joint(name, kind, parent, child, R, p, **numbers)

    def _spring(self, t: int) -> tuple[float, float, float]:
        """Return a tendon's stiffness, rest length and damping; a spring with a range of rest lengths is left out."""
        m, (low, high) = self.m, self.m.tendon_lengthspring[t].tolist()
        stiffness = float(np.ravel(m.tendon_stiffness[t])[0]) if low == high and not self._off("SPRING") else 0.0
        damping = float(np.ravel(m.tendon_damping[t])[0]) * (not self._off("DAMPER"))
        return max(stiffness, 0.0), low, max(damping, 0.0)

    def _wraps(self, t: int) -> tuple[set[int], slice]:
        """Return the types of the parts that a tendon is wrapped on, and their place in the model's tables."""
        wraps = slice(int(self.m.tendon_adr[t]), int(self.m.tendon_adr[t]) + int(self.m.tendon_num[t]))
        return set(self.m.wrap_type[wraps].tolist()), wraps

    def _factors(self, t: int) -> dict[str, float]:
        """Return the factors of a tendon's length by joint; nothing where it is no sum of coordinates."""
        types, wraps = self._wraps(t)
        out: dict[str, float] = {}
        if types <= {int(mujoco.mjtWrap.mjWRAP_JOINT)}:
            for j, factor in zip(self.m.wrap_objid[wraps].tolist(), self.m.wrap_prm[wraps].tolist(), strict=True):
                out[self.joints[j]] = out.get(self.joints[j], 0.0) + factor
        return {name: x for name, x in out.items() if x}

    def _held(self) -> Iterator[tuple[str, GravityCompensation]]:
        """Yield gravity compensation; actuators hold their part where they act."""
        m = self.m
        if self._off("SPRING") and self._off("DAMPER"):
            return
        acting = m.nu and not self._off("ACTUATION")
        names = [name for name, j in self.numbers.items() if m.jnt_actgravcomp[j] and not acting]
        for b in map(int, np.flatnonzero(m.body_gravcomp * np.any(m.body_gravcomp > 0))):
            moving = self._tree.moving(self.names[b])
            without = tuple(x for x in names if x in moving)
            yield f"body {b}", GravityCompensation(self.names[b], float(m.body_gravcomp[b]), without)

    def _acting(self) -> Iterator[tuple[str, Acting]]:
        """Yield the springs, dampers and rotors of tendons and actuators, with their keys."""
        m = self.m
        tendons: dict[int, dict[str, float]] = {}
        for t in range(m.ntendon):
            types, wraps = self._wraps(t)
            out = self._named("tendon", m.tendon(t).name, t, self._factors(t))
            tendons[t] = out.factors
            if types == {int(mujoco.mjtWrap.mjWRAP_SITE)}:
                sites = [(int(m.site_bodyid[k]), m.site_pos[k]) for k in m.wrap_objid[wraps]]
                out.path = ((1.0, tuple((self.names[b], p - self.anchors[b]) for b, p in sites)),)
            out.stiffness, out.rest_length, out.damping = self._spring(t)
            out.armature = float(m.tendon_armature[t]) if out.factors else 0.0
            yield f"tendon {t}", out
        of_joint = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
        for i in range(len(m.actuator_trntype)):
            target, driven = int(m.actuator_trnid[i, 0]), dict[str, float]()
            if int(m.actuator_trntype[i]) in of_joint and _KINDS[int(m.jnt_type[target])] in ("prismatic", "revolute"):
                driven = {self.joints[target]: 1.0}
            elif m.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_TENDON:
                driven = tendons.get(target, {})
            gear = float(m.actuator_gear[i, 0])
            out = self._named("actuator", m.actuator(i).name, i, {j: gear * x for j, x in driven.items() if gear * x})
            affine = m.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE and not self._off("ACTUATION")
            b0, b1, b2 = m.actuator_biasprm[i, :3].tolist() if affine else (0.0, 0.0, 0.0)
            damping = float(np.ravel(m.actuator_damping[i])[0]) * (not self._off("DAMPER")) - min(b2, 0.0)
            out.stiffness, out.rest_length, out.damping = max(-b1, 0.0), -b0 / b1 if b1 else 0.0, max(damping, 0.0)
            out.armature = float(m.actuator_armature[i])
            yield f"actuator {i}", out

    def _named(self, what: str, name: str, number: int, factors: dict[str, float]) -> Acting:
        return Acting("", self._parts.name("coupling", name or f"{what}{number + 1}"), factors)


#: Options that are numbers of a list.
_NAMED: Final = {"integrator": mujoco.mjtIntegrator, "cone": mujoco.mjtCone, "solver": mujoco.mjtSolver}
#: Kind of object -> how many there are, and what of it acts in runs alone.
_FIELDS: Final = {
    "actuator": (
        "nu",
        "trntype dyntype gaintype biastype dynprm gainprm biasprm gear ctrllimited ctrlrange forcelimited forcerange "
        "actlimited actrange delay",
    ),
    "jnt": ("njnt", "limited range margin solref solimp actfrclimited actfrcrange"),
    "tendon": ("ntendon", "limited range margin solref_lim solimp_lim frictionloss actfrclimited actfrcrange"),
    "geom": ("ngeom", "type size pos quat contype conaffinity condim priority friction solref solimp margin gap"),
    "eq": ("neq", "active0 solref solimp"),
}


def _settings(text: str, files: dict[str, bytes]) -> dict[str, Any]:
    """Return the numbers by what they are of."""
    m = mujoco.MjModel.from_xml_string(text, files)
    names = {x: getattr(m.opt, x) for x in dir(m.opt) if not x.startswith("_") and x != "gravity"}
    out = {x: _NAMED[x](y).name.split("_")[1].lower() if x in _NAMED else _number_text(y) for x, y in names.items()}
    for kind, (count, fields) in _FIELDS.items():
        for k in range(getattr(m, count)):
            if kind != "geom" or m.geom_contype[k] or m.geom_conaffinity[k]:
                label = f"{kind} {getattr(m, kind)(k).name or k}"
                out |= {f"{x} of {label}": _number_text(getattr(m, f"{kind}_{x}")[k]) for x in fields.split()}
    return out


def _number_text(x: Any) -> str:
    return " ".join(f"{y:.6g}" for y in np.trim_zeros(np.atleast_1d(x).astype(float), "b")) or "0"


def differences(files: Iterable[tuple[str, dict[str, bytes]]]) -> Iterator[str]:
    """Yield what differs between two texts with their files; raises what MuJoCo does over one that it cannot read."""
    a, b = (_settings(*file) for file in files)
    for what in dict.fromkeys([*a, *b]):
        if a.get(what) != b.get(what):
            yield f"{what} {a.get(what, 'none')} → {b.get(what, 'none')}"
