"""A model as plain data: names, numbers and lists, for programs that know no mbkit."""

from __future__ import annotations

from typing import Any


def plain(model: Any) -> dict[str, Any]:
    """Return the description as JSON would hold it; joints with every parent before its children."""
    layout = model.layout
    joints = []
    for j in model.tree:
        mimic = j.mimic and {"joint": j.mimic.joint, "ratio": j.mimic.ratio, "offset": j.mimic.offset}
        q, v = (None, None) if mimic else (layout.q[j.name].start, layout.v[j.name].start)
        entry = {"name": j.name, "kind": j.kind, "parent": j.parent, "child": j.child, "q": q, "v": v, "mimic": mimic}
        entry |= {"pitch": j.pitch, "rotation": j.rotation.tolist(), "translation": j.translation.tolist()}
        entry |= {n: getattr(j, n).tolist() for n in ("axes", "armature", "damping", "stiffness", "rest", "friction")}
        joints.append(entry)
    return {
        "name": model.name,
        "nq": model.nq,
        "nv": model.nv,
        "gravity": model.gravity.tolist(),
        "bodies": {
            b.name: {"mass": b.mass, "com": b.com.tolist(), "inertia": b.inertia.tolist()} for b in model.bodies
        },
        "joints": joints,
        "springs": [
            {
                "body_a": s.body_a,
                "point_a": s.point_a.tolist(),
                "body_b": s.body_b,
                "point_b": s.point_b.tolist(),
                "stiffness": s.stiffness,
                "rest_length": s.rest_length,
                "damping": s.damping,
            }
            for s in model.springs
        ],
    }
