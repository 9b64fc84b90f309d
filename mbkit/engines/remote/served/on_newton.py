"""Newton of any version from 1.5, on a CPU: terms of a description in Newton's own coordinates, in single precision.

Newton moves a free body by the velocity of its centre of mass, and states its forces there. Here it is the velocity of
the body's origin, v_G = v + ω × R c, so that quantities are turned into it, in double precision.
"""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import warp as wp
from common import apply, center_of, rotation, run, skew

wp.config.quiet = True
_OF_MUJOCO = ("euler", "implicitfast", "rk4")
#: Numbers of a joint with one velocity, as Newton calls them.
NUMBERS = {"rotors": "armature", "damping": "damping", "stiffness": "stiffness", "rest": "rest_q"}


def built(data: dict[str, Any]) -> Any:
    """Return the builder of a description, the joints of each of its joints, and its bodies."""
    builder = newton.ModelBuilder(gravity=tuple(data["gravity"]))
    bodies: dict[str, int] = {"world": -1}
    numbers: dict[str, list[Any]] = {}
    for joint in data["joints"]:
        parent, steps = bodies[joint["parent"]], joint["steps"] or [{"type": "fixed", "axes": []}]
        if steps[0]["type"] == "free" and parent >= 0:
            raise NotImplementedError(f"free joint {joint['name']!r} on a body; here it takes those on the world alone")
        turn = wp.quat_from_matrix(wp.mat33(np.array(joint["rotation"])))
        numbers[joint["name"]], at = [], wp.transform(joint["translation"], turn)
        for k, step in enumerate(steps):
            if k < len(steps) - 1:
                child = builder.add_link()
            else:
                child = bodies[joint["child"]] = _link(builder, joint["child"], data["bodies"][joint["child"]])
            own = {name: joint[name][k] for name in NUMBERS if step["type"] in ("revolute", "prismatic")}
            numbers[joint["name"]].append(_joint(builder, step, parent, child, at, own))
            parent, at = child, wp.transform()
    builder.add_articulation([*range(builder.joint_count)])
    return builder, numbers, bodies


def _link(builder: Any, name: str, body: dict[str, Any]) -> Any:
    inertia = wp.mat33(np.array(body["inertia"]))
    return builder.add_link(mass=body["mass"], com=tuple(body["com"]), inertia=inertia, label=name)


def _joint(builder: Any, step: dict[str, Any], parent: int, child: int, at: Any, own: dict[str, Any]) -> Any:
    kind = step["type"]
    if kind in ("revolute", "prismatic"):
        # Versions before 1.8 have no springs of joints.
        own = {NUMBERS[name]: value for name, value in own.items() if value and (name != "rest" or own["stiffness"])}
        own["axis"] = wp.vec3(step["axes"][0])
    if kind == "free":
        return builder.add_joint_free(child, parent=parent, parent_xform=at)
    return getattr(builder, "add_joint_" + kind)(parent, child, parent_xform=at, **own)


class Engine:
    """A description in Newton. Each method takes a stack of states, each of which is a world of its own."""

    STACKED = True

    def __init__(self, parts: Any) -> None:
        self._builder, self._numbers, self._bodies = parts
        b = self._builder
        self._nv, self._masses = b.joint_dof_count, np.array(b.body_mass)
        self._coms = np.array([tuple(x) for x in b.body_com], float).reshape(-1, 3)
        #: First velocity, first coordinate and body of each free joint.
        self._free, self._world = [], np.eye(self._nv)
        for j in range(b.joint_count):
            if b.joint_type[j] == newton.JointType.FREE:
                at, frame = b.joint_qd_start[j], rotation(np.array(tuple(b.joint_X_p[j]))[3:])
                self._world[at : at + 6, at : at + 6] = np.kron(np.eye(2), frame)
                self._free.append((at, b.joint_q_start[j], b.joint_child[j]))
        self._models: dict[tuple[int, bool], Any] = {}
        self._solvers: dict[tuple[int, str], Any] = {}
        self._validated = False

    def joints(self) -> dict[str, Any]:
        """Return the places of each joint's numbers in joint_q and joint_qd."""
        b = self._builder
        starts = [*b.joint_q_start, b.joint_coord_count], [*b.joint_qd_start, b.joint_dof_count]
        held = [[[*range(start[j], start[j + 1])] for j in range(b.joint_count)] for start in starts]
        return {name: [[k for j in own for k in of[j]] for of in held] for name, own in self._numbers.items()}

    def _model(self, n: int, passive: bool) -> Any:
        """Return the model with as many worlds, and a state; `passive` springs and dampers act in its solvers alone."""
        if (n, passive) not in self._models:
            worlds = newton.ModelBuilder(gravity=tuple(self._builder.gravity))
            worlds.replicate(self._builder, n)
            # By name, where it is asked what it changes.
            worlds.validate_inertia_detailed = self._validated
            model = worlds.finalize(device="cpu")
            if not self._validated:
                # What a description says is judged, not what a validation makes of it.
                for name in ("body_mass", "body_inv_mass", "body_inertia", "body_inv_inertia"):
                    held, values = getattr(model, name), np.array(getattr(self._builder, name) * n, dtype=np.float32)
                    held.assign(values.reshape(held.numpy().shape))
            if not passive:
                for name in ("joint_damping", "joint_stiffness"):
                    if hasattr(model, name):
                        getattr(model, name).zero_()
            self._models[n, passive] = model, model.state()
        return self._models[n, passive]

    def _set(self, q: Any, v: Any = None, passive: bool = False) -> Any:
        """Return the model and its state, S with v_newton = S v, and its change Ṡ v."""
        model, state = self._model(len(q), passive)
        v = np.zeros((len(q), self._nv)) if v is None else v
        S = self._centre(q)
        own, change = apply(S, v), np.zeros(v.shape)
        for at, *_ in self._free:
            linear, angular = slice(at, at + 3), slice(at + 3, at + 6)
            change[:, linear] = np.cross(v[:, angular], (own - v)[:, linear])
        state.joint_q.assign(q.ravel())
        state.joint_qd.assign(own.ravel())
        newton.eval_fk(model, state.joint_q, state.joint_qd, state)
        return model, state, S, change

    def _centre(self, q: Any) -> Any:
        """Return S."""
        S = np.broadcast_to(np.eye(self._nv), (len(q), self._nv, self._nv)).copy()
        for at, at_q, body in self._free:
            arm = rotation(q[:, at_q + 3 : at_q + 7]) @ self._coms[body]
            S[:, at : at + 3, at + 3 : at + 6] = -skew(arm)
        return S

    def _mass(self, model: Any, state: Any) -> Any:
        # By Jacobians of each body, as `eval_inverse_dynamics_passive` has it; without J it sums inertias about the
        # root's origin, and a light finger loses two more digits (version 1.8).
        return newton.eval_mass_matrix(model, state, J=newton.eval_jacobian(model, state))

    def _mass_numbers(self, model: Any, state: Any) -> Any:
        return self._mass(model, state).numpy().astype(float)

    def mass_matrix(self, q: Any) -> Any:
        model, state, S, _ = self._set(q)
        return S.mT @ self._mass_numbers(model, state) @ S

    def _force(self, f: Any, S: Any) -> Any:
        """Return forces; those of a free joint are given in world axes, about the centre of mass."""
        return apply((self._world @ S).mT, f.numpy().astype(float).reshape(len(S), -1))

    def _passive(self, model: Any, state: Any, name: str) -> Any:
        out = wp.zeros(model.joint_dof_count, dtype=float, device="cpu")
        newton.eval_inverse_dynamics_passive(model, state, **{name: out})
        return out

    def gravity(self, q: Any) -> Any:
        model, state, S, _ = self._set(q)
        return self._force(self._passive(model, state, "gravity_force"), S)

    def coriolis_force(self, q: Any, v: Any) -> Any:
        model, state, S, change = self._set(q, v)
        M = self._mass_numbers(model, state)
        return self._force(self._passive(model, state, "coriolis_force"), S) + apply(S.mT @ M, change)

    def nle(self, q: Any, v: Any) -> Any:
        return self.coriolis_force(q, v) + self.gravity(q)

    def inverse_dynamics(self, q: Any, v: Any, a: Any) -> Any:
        model, state, S, change = self._set(q, v)
        rates = wp.array((apply(S, a) + change).ravel(), dtype=float, device="cpu")
        out = wp.zeros(model.joint_dof_count, dtype=float, device="cpu")
        forces = {name: self._passive(model, state, name) for name in ("coriolis_force", "gravity_force")}
        newton.eval_inverse_dynamics_force(
            model, state, mass_matrix=self._mass(model, state), joint_qdd=rates, joint_f=out, **forces
        )
        return self._force(out, S)

    def forward_dynamics(self, q: Any, v: Any, tau: Any) -> Any:
        """Return the accelerations of `SolverFeatherstone`."""
        model, state, S, _ = self._set(q, v)
        control = model.control()
        control.joint_f.assign(apply(np.linalg.inv((self._world @ S).mT), tau).ravel())
        solver = newton.solvers.SolverFeatherstone(model, angular_damping=0.0)
        solver.step(state, model.state(), control, None, 1e-3)
        out = solver.joint_qdd.numpy().astype(float).reshape(len(q), -1)
        for at, at_q, _ in self._free:
            # The spatial acceleration at the fixed frame's origin becomes that of the body's own.
            linear, angular = slice(at, at + 3), slice(at + 3, at + 6)
            out[:, linear] += np.cross(out[:, angular], q[:, at_q : at_q + 3]) + np.cross(v[:, angular], v[:, linear])
        return out

    def _solver(self, model: Any, n: int, method: str) -> Any:
        if (n, method) not in self._solvers:
            if method == "featherstone":
                solver = newton.solvers.SolverFeatherstone(model, angular_damping=0.0)
            elif method in _OF_MUJOCO:
                solver = newton.solvers.SolverMuJoCo(model, integrator=method, disable_contacts=True)
            else:
                raise NotImplementedError(f"no integrator {method!r}; there are featherstone, {', '.join(_OF_MUJOCO)}")
            self._solvers[n, method] = solver
        return self._solvers[n, method]

    def rollout(self, q: Any, v: Any, tau: Any = None, *, method: str, dt: float, steps: int) -> Any:
        """Return coordinates and velocities after each of so many steps of one of Newton's solvers.

        tau, (n, steps, nv), is held over each; not on free joints, whose forces Newton turns.
        """
        model, state, *_ = self._set(q, v, passive=True)
        solver = self._solver(model, len(q), method)
        both, control = [state, model.state()], model.control()

        def step(k: int) -> Any:
            if tau is not None:
                control.joint_f.assign(tau[:, k].ravel())
            solver.step(*both, control, None, dt)
            both.reverse()
            x, u = (np.array(y.numpy(), float).reshape(len(q), -1) for y in (both[0].joint_q, both[0].joint_qd))
            return x, apply(np.linalg.inv(self._centre(x)), u)

        return run(q, v, steps, step)

    def frame(self, q: Any, body: str) -> Any:
        """Return R_WB, p_WB, and the Jacobians of the body's origin and turning in world axes."""
        model, state, S, _ = self._set(q)
        k, n = self._bodies[body], len(q)
        if k < 0:
            return [np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3)), *np.zeros((2, n, 3, self._nv))]
        X = state.body_q.numpy().astype(float).reshape(n, -1, 7)[:, k]
        R, joint = rotation(X[:, 3:]), self._builder.joint_child.index(k)
        J = newton.eval_jacobian(model, state).numpy().astype(float)[:, 6 * joint : 6 * joint + 6] @ S
        return [R, X[:, :3], J[:, :3] + skew(R @ self._coms[k]) @ J[:, 3:], J[:, 3:]]

    def matter(self, q: Any) -> Any:
        """Return the mass of what moves and stands, kg, and its centre of mass, m."""
        X = self._set(q)[1].body_q.numpy().astype(float).reshape(len(q), -1, 7)
        return center_of(self._masses, X[..., :3] + apply(rotation(X[..., 3:]), self._coms))
