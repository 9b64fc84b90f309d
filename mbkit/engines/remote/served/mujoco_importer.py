"""What `put_model` of MuJoCo Warp or MJX makes of a file: the numbers of MuJoCo's model, as far as it holds them.

The parser and the compiler are MuJoCo's. A number is that of the engine's own model where it has one of that name.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

#: How numbers of MuJoCo's model begin that describe bodies and joints, and what acts on them.
_PARTS = ("body_", "jnt_", "dof_", "qpos", "eq_", "tendon_", "wrap_", "actuator_", "site_")
_SIZES = ("nbody", "njnt", "nq", "nv", "neq", "nu", "ntendon")
_OPTIONS = ("gravity", "wind", "density", "viscosity", "disableflags", "enableflags")
#: Fields that act in smooth terms: the engine is to hold them, or to refuse them.
_ACTING = (
    *("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat", "body_gravcomp"),
    *("jnt_axis", "jnt_pos", "jnt_stiffness", "jnt_stiffnesspoly", "jnt_actgravcomp", "dof_armature", "dof_damping"),
    *("dof_dampingpoly", "qpos0", "qpos_spring", "tendon_stiffness", "tendon_stiffnesspoly", "tendon_damping"),
    *("tendon_dampingpoly", "tendon_armature", "tendon_lengthspring", "actuator_gear", "actuator_armature"),
    *("actuator_damping", "actuator_dampingpoly", "actuator_biasprm", "actuator_gainprm"),
)
#: Names of what a field's rows belong to, by how the field begins.
_OF = {"body": "body", "jnt": "joint", "dof": "joint", "tendon": "tendon", "actuator": "actuator"}
_FREE = "root_joint"


def imported(adapter: Any, path: str, format_: str, floating: bool, changes: dict[str, Any]) -> Any:
    """Return the engine of a file, and the numbers of its model; `changes` are numbers to set before."""
    spec = mujoco.MjSpec.from_file(path)
    if floating and format_ == "urdf":
        tops = list(spec.worldbody.bodies)
        if len(tops) != 1:
            raise NotImplementedError(f"{len(tops)} bodies stand in the world; one alone could float")
        tops[0].add_freejoint(name=_FREE)
    m = spec.compile()
    if not m.nv:
        raise NotImplementedError("nothing moves in the model that it built from the file (nv = 0)")
    for name, values in changes.items():
        if name in _OPTIONS:
            setattr(m.opt, name, values)
        else:
            getattr(m, name)[:] = np.reshape(values, np.shape(getattr(m, name)))
    # As users call it: what it lacks is refused here, contacts and sensors too.
    held = adapter.put(m)
    labels = {
        kind: [mujoco.mj_id2name(m, getattr(mujoco.mjtObj, "mjOBJ_" + of), i) or "" for i in range(n)]
        for kind, of, n in (
            *(("body", "BODY", m.nbody), ("joint", "JOINT", m.njnt), ("eq", "EQUALITY", m.neq)),
            *(("tendon", "TENDON", m.ntendon), ("actuator", "ACTUATOR", len(m.actuator_trntype))),
        )
    }
    fields, notes = {}, []
    for name in dir(m):
        if name in _SIZES or (name.startswith(_PARTS) and isinstance(getattr(m, name), np.ndarray)):
            whole = np.array(getattr(m, name))
            own = _own(held, name, whole)
            if name in _ACTING and len(rows := _lost(whole, own)):
                kind = name.split("_", maxsplit=1)[0]
                names = labels.get(_OF.get(kind, ""))
                some = m.dof_jntid[rows[:6]] if kind == "dof" else rows[:6]
                unnamed = "coordinate" if names is None else "number"
                which = (repr(names[k]) if names and names[k] else f"{unnamed} {k}" for k in some)
                says = "is not in its model" if own is None else "is another number in its model"
                notes.append(f"put_model: {name} of {', '.join(which)} {says}")
            fields[name] = (whole if own is None else own).tolist()
    opt = {name: np.array(getattr(m.opt, name)).tolist() for name in _OPTIONS}
    engine = adapter.Engine(m, acting=True)
    return engine, {"fields": fields, "opt": opt, "labels": labels, "places": engine.joints(), "notes": notes}


def _own(held: Any, name: str, whole: Any) -> Any:
    """Return the engine's own values of a field; None where it has no field of that name and size."""
    try:
        own = getattr(held, name)
        own = np.asarray(own.numpy() if hasattr(own, "numpy") else own)
    except Exception:  # an engine may refuse a name in any way
        return None
    return own.reshape(whole.shape) if own.size == whole.size and own.dtype != object else None


def _lost(whole: Any, own: Any) -> Any:
    """Return the rows of a field that the engine does not hold, or holds otherwise, beyond single precision."""
    lost = np.array(whole, bool)
    if own is not None:
        own, whole = own.astype(float), whole.astype(float)
        lost = np.abs(own - whole) > 1e-6 * np.maximum(np.abs(whole), 1e-6)
    return np.flatnonzero(lost.reshape(len(lost), -1).any(axis=1)) if lost.size else []
