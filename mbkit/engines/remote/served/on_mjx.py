"""MJX, MuJoCo in JAX, of any version from 3.2: terms of a model of MJCF or URDF in MuJoCo's own coordinates.

The parser and the compiler are MuJoCo's. JAX computes in double precision where its process has ``JAX_ENABLE_X64=1``.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from mujoco import mjx
from on_mujoco import OfMujoco, body_of, built, integrator, smooth

__all__ = ["Engine", "built"]
#: The smallest stack that is compiled, beside one state alone; larger ones have twice as many, and so on.
_MIN_STACK = 16


def put(m: Any) -> Any:
    """Return a model as MJX holds it."""
    return mjx.put_model(m)


class Engine(OfMujoco):  # type: ignore[misc]  # of the file beside
    """A model on JAX, with all off that its smooth dynamics do not need. Each method takes a stack of states."""

    STACKED = True

    def __init__(self, m: Any, acting: bool = False) -> None:
        self._m, self._acting = smooth(m, acting), acting
        self._mx = put(m)
        self._d = mjx.make_data(self._mx)
        self._gravity = np.array(m.opt.gravity)
        self._compiled: dict[Any, Any] = {}

    def _over(self, key: Any, function: Any, *states: Any, shared: tuple[Any, ...] = ()) -> Any:
        """Return a function of one state at each of a stack, compiled once for each size of a stack."""
        if key not in self._compiled:
            axes = (0,) * len(states) + (None,) * len(shared)
            self._compiled[key] = jax.jit(jax.vmap(function, in_axes=axes))
        n = len(states[0])
        size = n if n == 1 else max(_MIN_STACK, 1 << (n - 1).bit_length())
        # A stack of another size would be compiled again.
        full = [np.concatenate([x, np.repeat(x[-1:], size - n, axis=0)]) for x in states]
        out = self._compiled[key](*full, *shared)
        return jax.tree.map(lambda x: np.asarray(x)[:n], out)

    def _terms(self, q: Any, v: Any = None, gravity: Any = None) -> Any:
        """Return all that position and velocity decide, since each function takes seconds to trace."""

        def terms(q: Any, v: Any, gravity: Any) -> Any:
            mx = self._mx.replace(opt=self._mx.opt.replace(gravity=gravity))
            d = mjx.fwd_velocity(mx, mjx.fwd_position(mx, self._d.replace(qpos=q, qvel=v)))
            passive = d.qfrc_passive
            if self._acting:
                passive += mjx.fwd_actuation(mx, d).qfrc_actuator
            return mjx.full_m(mx, d), d.qfrc_bias, passive, d.xipos

        v = np.zeros((len(q), self._m.nv)) if v is None else v
        return self._over("terms", terms, q, v, shared=(self._gravity if gravity is None else gravity,))

    def inverse_dynamics(self, q: Any, v: Any, a: Any) -> Any:
        def inverse(q: Any, v: Any, a: Any) -> Any:
            return mjx.inverse(self._mx, self._d.replace(qpos=q, qvel=v, qacc=a)).qfrc_inverse

        return self._over("inverse", inverse, q, v, a)

    def forward_dynamics(self, q: Any, v: Any, tau: Any) -> Any:
        def forward(q: Any, v: Any, tau: Any) -> Any:
            return mjx.forward(self._mx, self._d.replace(qpos=q, qvel=v, qfrc_applied=tau)).qacc

        return self._over("forward", forward, q, v, tau)

    def frame(self, q: Any, body: str) -> Any:
        """Return R_WB, p_WB, and the Jacobians of the body's origin and turning in world axes."""

        def frame(q: Any, k: Any) -> Any:
            d = mjx.com_pos(self._mx, mjx.kinematics(self._mx, self._d.replace(qpos=q)))
            linear, angular = mjx.jac(self._mx, d, d.xpos[k], k)
            return d.xmat[k], d.xpos[k], linear.T, angular.T

        return self._over("frame", frame, q, shared=(body_of(self._m, body),))

    def rollout(self, q: Any, v: Any, tau: Any = None, *, method: str, dt: float, steps: int) -> Any:
        """Return qpos and qvel after each of so many steps; tau is held over each, (n, steps, nv)."""
        number = integrator(method)

        def run(q: Any, v: Any, tau: Any, dt: Any) -> Any:
            mx = self._mx.replace(opt=self._mx.opt.replace(timestep=dt, integrator=number))

            def step(d: Any, tau: Any) -> Any:
                d = mjx.step(mx, d.replace(qfrc_applied=tau))
                return d, (d.qpos, d.qvel)

            return jax.lax.scan(step, self._d.replace(qpos=q, qvel=v), tau)[1]

        # A run of another length would be compiled again.
        length = steps if steps == 1 else _MIN_STACK * -(-steps // _MIN_STACK)
        parts = [(q[:, None], v[:, None])]
        held = np.zeros((len(q), length, self._m.nv))
        held[:, :steps] = 0.0 if tau is None else tau
        for part in np.split(held, max(1, length // _MIN_STACK), axis=1):
            start = [x[:, -1] for x in parts[-1]]
            parts.append(self._over(("rollout", method), run, *start, part, shared=(dt,)))
        return [np.concatenate(x, axis=1)[:, : steps + 1] for x in zip(*parts, strict=True)]
