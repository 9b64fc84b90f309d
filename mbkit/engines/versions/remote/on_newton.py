"""Newton of any version from 1.8, on a CPU: terms of a description in Newton's own coordinates, in single precision.

Newton moves a free body by the velocity of its centre of mass, and states its forces there. Here it is the velocity of
the body's origin, v_G = v + ω × R c, so that quantities are turned into it, in double precision.
"""

from __future__ import annotations

import time

import newton
import numpy as np
import warp as wp

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

wp.config.quiet = True
VERSION = newton.__version__


def _quaternion(R: Any) -> Any:
    """Return the quaternion, x, y, z, w, of a rotation matrix: an eigenvector (Bar-Itzhack 2000)."""
    K = np.array(
        [
            [R[0, 0] - R[1, 1] - R[2, 2], R[1, 0] + R[0, 1], R[2, 0] + R[0, 2], R[2, 1] - R[1, 2]],
            [R[1, 0] + R[0, 1], R[1, 1] - R[0, 0] - R[2, 2], R[2, 1] + R[1, 2], R[0, 2] - R[2, 0]],
            [R[2, 0] + R[0, 2], R[2, 1] + R[1, 2], R[2, 2] - R[0, 0] - R[1, 1], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], R[0, 0] + R[1, 1] + R[2, 2]],
        ]
    )
    return np.linalg.eigh(K)[1][:, -1]


def _rotation(x: Any) -> Any:
    """Return the rotation matrices of quaternions x, y, z, w."""
    x = np.array(x, float) / np.linalg.norm(x, axis=-1, keepdims=True)
    v, w = x[..., :3], x[..., 3, None, None]
    K = _skew(v)
    return np.eye(3) + 2 * (w * K + K @ K)


def _skew(x: Any) -> Any:
    return np.cross(np.asarray(x)[..., None, :], np.eye(3)).swapaxes(-1, -2)


def built(data: dict[str, Any]) -> Any:
    """Return the builder of a description, the joints of each of its joints, and its bodies."""
    builder = newton.ModelBuilder(gravity=tuple(data["gravity"]))
    bodies, numbers = {"world": -1}, {}
    for joint in data["joints"]:
        parent = bodies[joint["parent"]]
        at = wp.transform(joint["translation"], _quaternion(np.array(joint["rotation"])))
        numbers[joint["name"]] = own = []
        steps = joint["steps"] or [{"type": "fixed", "axes": []}]
        for k, step in enumerate(steps):
            if k < len(steps) - 1:
                child = builder.add_link(label=f"{joint['name']}.{k}")
            else:
                child = bodies[joint["child"]] = _link(builder, joint["child"], data["bodies"][joint["child"]])
            rotor = joint["armature"][k] if len(joint["armature"]) == len(steps) else 0.0
            own.append(_joint(builder, step, parent, child, at, f"{joint['name']}.{k}", rotor))
            parent, at = child, wp.transform()
        if joint["steps"] and joint["steps"][0]["type"] == "free" and joint["parent"] != "world":
            raise NotImplementedError(f"free joint {joint['name']!r} on a body; here it takes those on the world alone")
    builder.add_articulation([*range(builder.joint_count)])
    return builder, numbers, bodies


def _link(builder: Any, name: str, body: dict[str, Any]) -> int:
    inertia = wp.mat33(np.array(body["inertia"]))
    return builder.add_link(mass=body["mass"], com=tuple(body["com"]), inertia=inertia, label=name)


def _joint(builder: Any, step: dict[str, Any], parent: int, child: int, at: Any, name: str, rotor: float) -> int:
    ends, more = (parent, child), {"parent_xform": at, "label": name}
    kind = step["type"]
    if kind in ("revolute", "prismatic"):
        axis = wp.vec3(step["axes"][0])
        return getattr(builder, "add_joint_" + kind)(*ends, axis=axis, armature=rotor, **more)
    if kind == "free":
        return builder.add_joint_free(child, parent=parent, **more)
    return getattr(builder, "add_joint_" + kind)(*ends, **more)


class Engine:
    """A description in Newton. Each method takes a stack of states, each of which is a world of its own."""

    STACKED = True

    def __init__(self, parts: Any) -> None:
        self._builder, self._numbers, self._bodies = parts
        b = self._builder
        self._nv, self._masses = b.joint_dof_count, np.array(b.body_mass)
        self._coms = np.array([tuple(x) for x in b.body_com], float).reshape(-1, 3)
        #: Of each free joint its first velocity, its first coordinate, its body, and the axes of its fixed frame.
        self._free = []
        for j in range(b.joint_count):
            if b.joint_type[j] == newton.JointType.FREE:
                frame = _rotation(np.array(tuple(b.joint_X_p[j]))[3:])
                self._free.append((b.joint_qd_start[j], b.joint_q_start[j], b.joint_child[j], frame))
        self._models: dict[int, Any] = {}

    def joints(self) -> dict[str, Any]:
        """Return the places of each joint's numbers in joint_q and joint_qd."""
        b = self._builder
        starts = [*b.joint_q_start, b.joint_coord_count], [*b.joint_qd_start, b.joint_dof_count]
        return {
            name: [[k for j in own for k in range(start[j], start[j + 1])] for start in starts]
            for name, own in self._numbers.items()
        }

    def _set(self, q: Any, v: Any = None) -> Any:
        """Return the model with as many worlds and its state, and S with v_newton = S v, and its change Ṡ v."""
        n = len(q)
        if n not in self._models:
            worlds = newton.ModelBuilder(gravity=tuple(self._builder.gravity))
            worlds.replicate(self._builder, n)
            # What a description says is judged, not what a validation makes of it.
            model = worlds.finalize(device="cpu", skip_validation_inertia=True)
            self._models[n] = model, model.state()
        model, state = self._models[n]
        v = np.zeros((n, self._nv)) if v is None else v
        S, change = np.broadcast_to(np.eye(self._nv), (n, self._nv, self._nv)).copy(), np.zeros((n, self._nv))
        for at, at_q, body, _ in self._free:
            arm = _rotation(q[:, at_q + 3 : at_q + 7]) @ self._coms[body]
            S[:, at : at + 3, at + 3 : at + 6] = -_skew(arm)
            w = v[:, at + 3 : at + 6]
            change[:, at : at + 3] = np.cross(w, np.cross(w, arm))
        state.joint_q.assign(q.ravel())
        state.joint_qd.assign(np.einsum("nij,nj->ni", S, v).ravel())
        newton.eval_fk(model, state.joint_q, state.joint_qd, state)
        return model, state, S, change

    def _mass(self, model: Any, state: Any) -> Any:
        # By Jacobians of each body, as `eval_inverse_dynamics_passive` has it; without J it sums inertias about the
        # root's origin, and a light finger loses two more digits (version 1.8).
        return newton.eval_mass_matrix(model, state, J=newton.eval_jacobian(model, state))

    def mass_matrix(self, q: Any) -> Any:
        model, state, S, _ = self._set(q)
        return S.mT @ self._mass(model, state).numpy().astype(float) @ S

    def _force(self, f: Any, S: Any) -> Any:
        """Return forces in double precision; those of a free joint are given in world axes, about the centre."""
        f = f.numpy().astype(float).reshape(len(S), -1)
        for at, _, _, frame in self._free:
            for part in (slice(at, at + 3), slice(at + 3, at + 6)):
                f[:, part] = f[:, part] @ frame
        return np.einsum("nji,nj->ni", S, f)

    def _passive(self, model: Any, state: Any, name: str) -> Any:
        out = wp.zeros(model.joint_dof_count, dtype=float, device="cpu")
        newton.eval_inverse_dynamics_passive(model, state, **{name: out})
        return out

    def gravity(self, q: Any) -> Any:
        model, state, S, _ = self._set(q)
        return self._force(self._passive(model, state, "gravity_force"), S)

    def coriolis_force(self, q: Any, v: Any) -> Any:
        model, state, S, change = self._set(q, v)
        own = self._force(self._passive(model, state, "coriolis_force"), S)
        if not change.any():
            return own
        return own + np.einsum("nji,njk,nk->ni", S, self._mass(model, state).numpy().astype(float), change)

    def nle(self, q: Any, v: Any) -> Any:
        return self.coriolis_force(q, v) + self.gravity(q)

    def inverse_dynamics(self, q: Any, v: Any, a: Any) -> Any:
        model, state, S, change = self._set(q, v)
        rates = wp.array((np.einsum("nij,nj->ni", S, a) + change).ravel(), dtype=float, device="cpu")
        out = wp.zeros(model.joint_dof_count, dtype=float, device="cpu")
        forces = {name: self._passive(model, state, name) for name in ("coriolis_force", "gravity_force")}
        newton.eval_inverse_dynamics_force(
            model, state, mass_matrix=self._mass(model, state), joint_qdd=rates, joint_f=out, **forces
        )
        return self._force(out, S)

    def frame(self, q: Any, body: str) -> Any:
        """Return R_WB, p_WB, and the Jacobians of the body's origin and turning in world axes."""
        model, state, S, _ = self._set(q)
        k, n = self._bodies[body], len(q)
        if k < 0:
            return [np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3)), *np.zeros((2, n, 3, self._nv))]
        X = state.body_q.numpy().astype(float).reshape(n, -1, 7)[:, k]
        R, joint = _rotation(X[:, 3:]), self._builder.joint_child.index(k)
        J = newton.eval_jacobian(model, state).numpy().astype(float)[:, 6 * joint : 6 * joint + 6] @ S
        return [R, X[:, :3], J[:, :3] + _skew(R @ self._coms[k]) @ J[:, 3:], J[:, 3:]]

    def matter(self, q: Any) -> Any:
        """Return the mass of what moves and stands, kg, and its centre of mass, m."""
        X = self._set(q)[1].body_q.numpy().astype(float).reshape(len(q), -1, 7)
        at = X[..., :3] + (_rotation(X[..., 3:]) @ self._coms[..., None])[..., 0]
        return [np.full(len(q), self._masses.sum()), np.einsum("b,nbi->ni", self._masses, at) / self._masses.sum()]

    def seconds(self, q: Any, v: Any, repeats: int) -> Any:
        """Return the shortest time of one inverse dynamics of the stack, s, of rounds of so many calls."""
        best = float("inf")
        for _ in range(5):
            start = time.perf_counter()
            for _ in range(repeats):
                self.inverse_dynamics(q, v, np.zeros_like(v))
            best = min(best, (time.perf_counter() - start) / repeats)
        return np.full(len(q), best)
