"""MuJoCo behind the protocol: terms from its smooth dynamics, rollouts from its integrators.

Todorov, Erez, Tassa 2012, "MuJoCo: a physics engine for model-based control". The only place that knows MuJoCo's
velocity of a free joint (linear in the world's axes): v_mj = T v with T = diag(R, 1), so M = Tᵀ M_mj T, and
a_mj = T a + b with b = R (ω × v).

Native rollouts: MuJoCo's own integrators over whole trajectories and batches.
"""

from __future__ import annotations

import contextlib
import copy
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import ArrayLike

from mbkit import spatial
from mbkit._check import Array, batch_of, count, real, shown
from mbkit._child_process import cores
from mbkit._process import LOOK_SECONDS
from mbkit.engines import known_defects
from mbkit.engines.base import MappedDynamics
from mbkit.engines.closed_loops.rows_of_frames import RowsOfFrames
from mbkit.engines.constrained import off_by, softly_limited
from mbkit.engines.frames_and_momenta import TREE
from mbkit.engines.mujoco.bodies import MujocoBodies
from mbkit.engines.mujoco.constraints import ConstraintLaw, LoopEnds, Softness, friction_law, law, limit_softness
from mbkit.engines.mujoco.model import (
    CONSTRAINT_LAW,
    FRICTION_LOSS,
    MUJOCO,
    MUJOCO_RUNS,
    MujocoModel,
    build,
    full_mass_matrix,
    heard_warnings,
)
from mbkit.errors import (
    DoubtfulRunWarning,
    InputError,
    MbkitError,
    MbkitWarning,
    NumericalError,
    UnsupportedError,
    require_known,
    warn,
)
from mbkit.load.sanitized_text import strip
from mbkit.model import Model

if TYPE_CHECKING:
    from mbkit.engines.closed_loops.frame_rows import Rows
    from mbkit.show import Kind


# All but RK4 are of first order. "euler" takes damping as it is, because the description is built with MuJoCo's
# implicit damping off; the three implicit ones take it at the step's end, "discrete" springs too: stable at any
# stiffness, by damping what the step cannot resolve. "implicit" has the derivatives of all velocity terms, and damps
# whatever turns; "implicitfast" and "discrete" have them for free bodies only.
INTEGRATORS: Final = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "rk4": mujoco.mjtIntegrator.mjINT_RK4,
    "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "discrete": mujoco.mjtIntegrator.mjINT_DISCRETE,
}
_STATE: Final = mujoco.mjtState.mjSTATE_FULLPHYSICS
_SINGULAR: Final = int(mujoco.mjtWarning.mjWARN_INERTIA)
_FORCE: Final = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)


def rollout(
    description: Model,
    compiled: MujocoModel,
    integrator: str,
    q0: Array,
    v0: Array,
    dt: float,
    tau: Array | None,
    steps: int,
    progress: Callable[[float], object] | None = None,
) -> tuple[Array, Array]:
    """Integrate one state or a batch on all cores, with options of the compiled model; see `MujocoDynamics.rollout`."""
    m = compiled.model
    require_known("integrator of MuJoCo", INTEGRATORS, integrator)
    m.opt.integrator, m.opt.timestep = INTEGRATORS[integrator], dt
    single = q0.ndim == 1
    q0, v0 = np.atleast_2d(q0), np.atleast_2d(v0)
    n, end_q = len(q0), 1 + m.nq
    if steps and n:
        start = np.zeros((n, mujoco.mj_stateSize(m, _STATE)))
        qpos = start[:, 1:end_q] = q0[:, compiled.q_index]
        start[:, end_q : end_q + m.nv] = _turned(compiled, qpos, v0[:, compiled.v_index])
        control = None if tau is None else _forces(compiled, np.broadcast_to(tau, (n, steps, description.nv)))
        data = [mujoco.MjData(m) for _ in range(max(1, min(n, cores())))]
        # A divergence is read off the states themselves.
        with heard_warnings():
            states = _run(m, data, start, control, steps, progress)
        if any(d.warning.number[_SINGULAR] for d in data):
            reason = "MuJoCo met a mass matrix that is too close to singular, and went on with another one"
            warn(f"{description.name}: {reason}; compare with rk853", DoubtfulRunWarning)
        states[np.logical_not(_alive(states, dt))] = np.nan
        qpos, qvel = states[..., 1:end_q], states[..., end_q : end_q + m.nv]
        q, v = np.empty_like(qpos), np.empty_like(qvel)
        q[..., compiled.q_index], v[..., compiled.v_index] = qpos, _turned(compiled, qpos, qvel, back=True)
    else:
        # Nothing to do, and MuJoCo does not survive an empty batch.
        q, v = (np.repeat(x[:, None], steps + 1, axis=1) for x in (q0, v0))
    return (q[0], v[0]) if single else (q, v)


def _run(
    m: Any, data: list[Any], start: Array, control: Array | None, steps: int, progress: Callable[[float], object] | None
) -> Array:
    """Return the states after 0, 1, ... steps, (N, steps + 1, size)."""
    states = np.empty((len(start), steps + 1, start.shape[1]))
    states[:, 0] = start
    done, count = 0, 16
    while done < steps:
        end = min(done + count, steps)
        part = None if control is None else np.ascontiguousarray(control[:, done:end])
        first = np.ascontiguousarray(states[:, done])
        started = time.perf_counter()
        states[:, done + 1 : end + 1], _ = mujoco.rollout.rollout(
            m, data, first, part, control_spec=_FORCE, nstep=end - done, skip_checks=False
        )
        seconds = time.perf_counter() - started
        # MuJoCo's code cannot be interrupted: it is left for signals and progress. States do not depend on it.
        count = max(1, int(count * min(16.0, LOOK_SECONDS / max(seconds, 1e-6))))
        done = end
        if progress is not None:
            progress(done / steps)
    return states


def _turned(compiled: MujocoModel, qpos: Array, velocities: Array, back: bool = False) -> Array:
    """Return velocities with those of free joints turned into the world's axes, or back."""
    out = velocities.copy()
    for iq, iv in compiled.free:
        quaternion = np.roll(qpos[..., iq + 3 : iq + 7], -1, axis=-1)
        turn = spatial.conjugate(quaternion) if back else quaternion
        out[..., iv : iv + 3] = spatial.rotate(turn, out[..., iv : iv + 3])
    return out


def _forces(compiled: MujocoModel, tau: Array) -> Array:
    out = tau[..., compiled.v_index]
    if any(out[..., iv : iv + 3].any() for _, iv in compiled.free):
        raise UnsupportedError(
            "mujoco: native rollouts hold a force on a free joint in world axes, mbkit in body axes; "
            "use method='rk4' or 'semi_implicit_euler' on this engine"
        )
    return out


def _alive(states: Array, dt: float) -> Array:
    # A diverged rollout may be restarted or stand still: time must advance by one step each, and everything before must
    # have been finite.
    steps = np.arange(states.shape[1])
    good = np.isfinite(states).all(axis=-1) & (np.abs(states[..., 0] - steps * dt) < 0.5 * dt)
    return np.asarray(np.logical_and.accumulate(good, axis=1))


#: Quantities that M is part of.
_OF_MASS: Final = ("mass_matrix", "mass_matrix_inverse", "inverse_dynamics", "forward_dynamics", "kinetic_energy")

#: Models, and how soft their loops are, of which a process was warned.
_TOLD: Final[set[tuple[str, Softness]]] = set()


class MujocoDynamics(MujocoBodies, RowsOfFrames, MappedDynamics):
    """MuJoCo on a description.

    Attributes
    ----------
    mj_model : mujoco.MjModel
        The compiled model; free to read.
    disabled : tuple of str
        Features that are off, because the smooth terms do not need them.
    softness : Softness
        Of its equality constraints, which hold the loops, and of its friction loss.
    soft_friction : bool
        Whether dry friction is MuJoCo's own.
    limit_softness : dict of Softness, optional
        Of each joint with limits, where they are MuJoCo's own.

    Notes
    -----
    MuJoCo holds loops by soft equality constraints: `forward_dynamics` is its own answer, `qacc` of `mj_forward`, which
    lets the loops open a little, and `constraint_law` tells by how much. The options `solref` and `solimp` are
    MuJoCo's; ``**mbkit.engines.mujoco.constraints.stiffest(dt)`` are the stiffest ones for a step. Runs by MuJoCo's
    and by mbkit's methods follow these accelerations: no state is projected, and what a loop opens is MuJoCo's. All
    other terms are those of the tree.

    Dry friction of joints is exact, by mbkit, beside MuJoCo's terms. With ``soft_friction=True`` it is MuJoCo's own
    friction loss in accelerations and runs, a soft constraint too: joints at rest creep. `constraint_law` tells how
    far that is from exact friction; other terms have exact friction at speed.

    Limits of joints are off. With ``limits="soft"`` they are MuJoCo's own, soft constraints too, in accelerations and
    runs; rigid stops of the model give way to them, so that `model` is here without. They are as soft as the MJCF says
    that the model was loaded from, or as MuJoCo's default; `limit_solref` is for all joints, and `limits` may be a dict
    of `Softness` by joint. `mbkit.soft_stops` measures how far they are from rigid stops.
    """

    engine = "mujoco"
    _soft_constraints = True
    _takes_wrenches = ("forward_dynamics",)
    # mj_comPos and mj_crb
    _inertias_about: ClassVar[dict[str, str]] = {"": TREE}
    _why_no_derivatives = (
        "MuJoCo differentiates by finite differences alone (mjd_inverseFD, mjd_transitionFD), which lose half of the "
        "digits; mbkit.dynamics(model, 'lagrangian') has exact ones"
    )
    _refuses: ClassVar[dict[str, str]] = {
        "coriolis_matrix": "MuJoCo forms C v + g without the matrix; nle(q, v) - gravity(q) is C v",
        "constraint_rate_gradient": "its derivatives are finite differences; the lagrangian engine has this one",
        "constraint_forces": "its soft constraints have rows of their own; constraint_law(q, v, tau).force is theirs, "
        "and generalized_constraint_force(q, v, tau) is Jᵀ λ",
    }
    softness = Softness()
    limit_softness: Mapping[str, Softness] | None = None
    _soft_jump_options: ClassVar[dict[str, Any]] = {"soft_friction": True}

    def __init__(
        self,
        model: Model,
        *,
        solref: ArrayLike | None = None,
        solimp: ArrayLike | None = None,
        soft_friction: bool = False,
        limits: str | Mapping[str, Softness] | None = None,
        limit_solref: ArrayLike | None = None,
    ) -> None:
        if not isinstance(soft_friction, (bool, np.bool_)):
            raise InputError(f"soft_friction: expected True or False, got {shown(soft_friction)}")
        own = dict(limits) if isinstance(limits, Mapping) else {}
        model, limited = softly_limited(self.engine, model, "soft" if own else limits)
        require_known("joint with limits", limited, *own)
        # Without friction there is nothing to hold.
        self._soft_jumps = bool(soft_friction) and "jump" in model.effects
        self._path = FRICTION_LOSS if self._soft_jumps else MUJOCO
        super().__init__(model)
        self.softness = Softness.of(solref, solimp)
        if limit_solref is not None and not limits:
            raise InputError("limit_solref: is of soft limits; give limits='soft' too")
        if limited:
            if "jump" in model.effects and not self._soft_jumps:
                raise UnsupportedError(f"limits: not beside exact friction of {model.name}; give soft_friction=True")
            held = {joint: Softness() for joint in limited} | _of_file(model, limited)
            if limit_solref is not None:
                ref = Softness.of(limit_solref).solref
                held = {joint: replace(x, solref=ref) for joint, x in held.items()}
            self._soft_limits, self.limit_softness = True, held | own
        self._hold(build(model, softness=self.softness, soft_friction=self._soft_jumps, limits=self.limit_softness))

    def __reduce__(self) -> tuple[Any, ...]:
        own: Any = vars(self.softness) | {"soft_friction": self._soft_jumps, "limits": self.limit_softness}
        return partial(type(self), **own), (self.model,)

    def _hold(self, compiled: MujocoModel) -> None:
        self._maps = compiled
        self._v_index = compiled.v_index
        self._own_forces = compiled.model.body_gravcomp.copy(), compiled.model.jnt_stiffness.copy()
        if not self._has_force_elements:
            # Among the terms these forces are mbkit's own; MuJoCo's steps get them back.
            compiled.model.body_gravcomp[:] = 0.0
            compiled.model.jnt_stiffness[compiled.model.jnt_type <= int(mujoco.mjtJoint.mjJNT_BALL)] = 0.0
        self.mj_model = self._m = compiled.model
        self.disabled = compiled.disabled
        self._d = mujoco.MjData(self._m)
        # Model and data with what is soft; all terms but the accelerations are those of the tree.
        self._closed = self._m, self._d
        if self.model.needs.loops or self._soft_jumps or self._soft_limits:
            self._m = copy.copy(self._m)
            self._m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
            self._d = mujoco.MjData(self._m)
        self._reduced = self.model.layout.reduced

    def _evaluate(self, quantity: str, *more: Any, **arguments: ArrayLike) -> Array:
        if quantity.removesuffix("_with_wrenches") in _OF_MASS and self.model.couplings and self._torn_couplings:
            names = ", ".join(repr(name) for name in self._torn_couplings)
            known_defects.announce(known_defects.TENDON_ARMATURE, f"coupling {names}")
        # One MjData and one handler of warnings: two threads in here end the process.
        with self._lock, heard_warnings() as heard:
            # MuJoCo gives each kind of warning once, unless its count is put back.
            self._d.warning.number.fill(0)
            out = super()._evaluate(quantity, *more, **arguments)
        if heard:
            raise NumericalError(f"mujoco: {quantity} of {self.model.name}: {heard[0].strip()}{self._suspects()}")
        return out

    @cached_property
    def _torn_couplings(self) -> tuple[str, ...]:
        """Names of the couplings whose rotor MuJoCo leaves out of M between branches, from an evaluation of M."""
        layout, q = self.model.layout, self.model.neutral()
        own = {c: c.rotors for c in self.model.couplings if c.rotors}
        rows = {c.name: x**0.5 * layout.coupling_row(c) @ layout.G for c, x in own.items()}
        if not rows:
            return ()
        with self._lock:
            M = self._mass_matrix(q)
        bare = MujocoDynamics(replace(self.model, couplings=()))._mass_matrix(q)
        missing = np.abs(bare + sum(np.outer(x, x) for x in rows.values()) - M)
        root = np.sqrt(np.abs(np.diag(M)))
        lost = missing > 1e-9 * np.outer(root, root)
        return tuple(name for name, x in rows.items() if lost[np.ix_(x != 0, x != 0)].any())

    def visual_model(self, shapes: Kind = "visual") -> mujoco.MjModel:
        """Return `mj_model` with sites of the frames and shapes to draw: geoms of group 2, massless and contact-free.

        Frames and shapes on massless bodies between the joints of a stack are left out, since MuJoCo has no body
        there. `mj_model` has neither sites nor geoms, which take a few per cent of its time.
        """
        # Imported late: few scripts draw.
        from mbkit.show import shapes_of

        return build(self.model, shapes=shapes_of(self.model, shapes)).model

    # Loops.

    def _require_loops_that_meet(self) -> None:
        """Raise `InputError` for loops that never meet or that no joint moves."""
        if self.model.needs.loops:
            _ = self._row_choice

    @contextlib.contextmanager
    def _with_loops(self) -> Iterator[None]:
        """Evaluate with MuJoCo's equality constraints, on data of their own."""
        self._require_loops_that_meet()
        tree = self._m, self._d
        self._m, self._d = self._closed
        if self._d is not tree[1]:
            self._d.warning.number.fill(0)
        try:
            yield
        finally:
            self._m, self._d = tree

    def constraint_law(self, q: ArrayLike, v: ArrayLike, tau: ArrayLike) -> ConstraintLaw:
        """Return the law of MuJoCo's soft constraints at one state, by formulas of mbkit's own.

        Parameters
        ----------
        q : (nq,) array_like
        v, tau : (nv,) array_like

        Returns
        -------
        ConstraintLaw
            With the `acceleration` that MuJoCo's documentation asks for, which its solver reaches but for rounding, the
            `rigid` one, the `digits` that softness leaves of it, and the law's terms row by row.

        Raises
        ------
        UnsupportedError
            A model without loops, on an engine without `soft_friction`.

        Examples
        --------
        >>> import mbkit as mb
        >>> model = mb.catalog.slider_crank()
        >>> dyn = mb.dynamics(model, "mujoco")
        >>> q, v = dyn.project([0.5, -0.2, -0.1], [1.0, 0.0, 0.0])
        >>> said, done = dyn.constraint_law(q, v, [0.0] * 3), dyn.forward_dynamics(q, v, [0.0] * 3)
        >>> bool(abs(said.acceleration - done).max() < 1e-12 * abs(done).max())
        True
        >>> 0 < said.digits < 3
        True
        """
        if not self._soft_jumps:
            CONSTRAINT_LAW.admit(self.model)
        q, v, tau = self.model.check_q(q), self.model.check_v(v), self.model.check_v(tau, "tau")
        if q.ndim > 1 or v.ndim > 1 or tau.ndim > 1:
            raise InputError(f"constraint_law: expected one state, got shapes {q.shape}, {v.shape}, {tau.shape}")
        pushed: Array = tau + self._elements.force(self, q, v) if self.model.forces else tau

        def held(q: Array, v: Array, tau: Array) -> ConstraintLaw:
            with self._with_loops():
                b = self._set(q, v)
                self._accelerated(tau)
                return self._law(b, q, v, tau)

        with self._lock, heard_warnings():
            if "jump" not in self.model.effects or self._soft_jumps:
                return held(q, v, pushed)
            # What rests between rigid loops is held by other forces.
            rigid, _ = self._exact_friction(q, v, pushed, lambda *state: held(*state).rigid)
            _, pushed = self._exact_friction(q, v, pushed, self._forward_dynamics)
            return replace(held(q, v, pushed), rigid=rigid)

    def _exact_friction(self, q: Array, v: Array, tau: Array, own: Callable[..., Array]) -> tuple[Array, Array]:
        """Return the accelerations of exact dry friction beside those of `own`, and τ with its forces."""
        forces: list[Array] = []

        def method(q: Array, v: Array, tau: Array) -> Array:
            forces.append(tau)
            return own(q, v, tau)

        out = self._jumps.beside("forward_dynamics", method, self)(q, v, tau)
        return np.asarray(out), forces[-1]

    def _jumps_beside_passive(self, q: Array, v: Array, tau: Array) -> Array:
        if not (self._soft_jumps or self._soft_limits):
            return super()._jumps_beside_passive(q, v, tau)
        with self._lock, heard_warnings():
            forces = [self._generalized_constraint_force(*state) for state in zip(q, v, tau, strict=True)]
        return np.array(forces) - self._jumps.law.force(v)

    def _smooth_acceleration(self, q: Array, v: Array, tau: Array) -> Array:
        """Return the accelerations without any constraint."""
        b = self._set(q, v)
        self._accelerated(tau)
        return self._force(self._d.qacc_smooth - b)

    @cached_property
    def _loop_ends(self) -> LoopEnds:
        return LoopEnds(self.mj_model, self.model, self._maps.bodies)

    def _every_row(self, q: Array, v: Array) -> Rows:
        b = self._place(q, v)
        return self._loop_ends.rows(self._m, self._d, self._columns, b, (q, v))

    def _generalized_constraint_force(self, q: Array, v: Array, tau: Array) -> Array:
        with self._with_loops():
            self._set(q, v)
            self._accelerated(tau)
            return self._force(self._d.qfrc_constraint)

    # Between the description's numbers and MuJoCo's.

    def _set(self, q: Array, v: Array | None = None) -> Array:
        """Put a state into MuJoCo; return b of a_mj = T a + b."""
        layout, d = self.model.layout, self._d
        d.qpos[:] = layout.expand_q(q)[self._maps.q_index]
        self._turned = [(self._rotation(iq), slice(iv, iv + 3)) for iq, iv in self._maps.free]
        b = np.zeros(self._m.nv)
        if v is None:
            d.qvel[:] = 0.0
            return b
        d.qvel[:] = self._to_engine(v)
        own = layout.expand_v(v)[self._v_index] if self._turned else b
        for R, part in self._turned:
            mujoco.mju_cross(b[part], own[part.stop : part.stop + 3], own[part])
            b[part] = R @ b[part]
        return b

    def _rotation(self, start_q: int) -> Array:
        R = np.empty(9)
        mujoco.mju_quat2Mat(R, self._d.qpos[start_q + 3 : start_q + 7])
        return R.reshape(3, 3)

    @cached_property
    def _lines(self) -> list[int]:
        """Tendons of the point springs that need a direction; springs are the first tendons."""
        return [k for k, spring in enumerate(self.model.springs) if spring.needs_direction]

    def _directed(self, x: np.ndarray) -> Array:
        """Return forces or accelerations; NaN where a spring that needs a direction has no length.

        MuJoCo takes the x axis for the direction of a shorter line than mjMINVAL.
        """
        lengths = self._d.ten_length[self._lines]
        return np.full_like(x, np.nan) if (lengths < mujoco.mjMINVAL).any() else np.asarray(x)

    def _velocities(self) -> None:
        mujoco.mj_fwdPosition(self._m, self._d)
        mujoco.mj_fwdVelocity(self._m, self._d)

    # The protocol.

    def _mass_matrix(self, q: Array) -> Array:
        self._set(q)
        mujoco.mj_kinematics(self._m, self._d)
        mujoco.mj_comPos(self._m, self._d)
        if self._m.ntendon:
            # Their rotor is part of M.
            mujoco.mj_tendon(self._m, self._d)
        mujoco.mj_makeM(self._m, self._d)
        return self._columns(self._columns(full_mass_matrix(self._m, self._d)).T)

    def _gravity(self, q: Array) -> Array:
        self._set(q)
        self._velocities()
        return self._force(self._d.qfrc_bias)

    def _nle(self, q: Array, v: Array) -> Array:
        b = self._set(q, v)
        self._velocities()
        return self._force(self._d.qfrc_bias + self._times_mass(b))

    def _coriolis_force(self, q: Array, v: Array) -> Array:
        # With gravity off, so that nothing cancels.
        with self._without_forces():
            return self._nle(q, v)

    def _times_mass(self, x: Array) -> Array:
        out = np.zeros(self._m.nv)
        if self._maps.free:
            mujoco.mj_mulM(self._m, self._d, out, x)
        return out

    def _passive(self, q: Array, v: Array) -> Array:
        self._set(q, v)
        self._velocities()
        return self._directed(self._force(self._d.qfrc_passive))

    def _inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array:
        b = self._set(q, v)
        self._d.qacc[:] = self._to_engine(a) + b
        mujoco.mj_inverse(self._m, self._d)
        return self._directed(self._force(self._d.qfrc_inverse))

    def _forward_dynamics(self, q: Array, v: Array, tau: Array, *acting: Any) -> Array:
        if self._reduced:
            # A mimic joint inside MuJoCo would be a soft equality: reduce instead.
            return self._solved_motion(q, v, tau, *acting)
        with self._with_loops(), self._applied(q, *acting) if acting else contextlib.nullcontext():
            b = self._set(q, v)
            self._accelerated(tau)
            out = self._directed(self._force(self._d.qacc - b))
            if self.model.needs.loops or self._soft_jumps:
                self._warn_of_softness(b, q, v, tau)
            return out

    def _warn_of_softness(self, b: Array, q: Array, v: Array, tau: Array) -> None:
        """Warn, once for each model, how far the soft law is from the exact one at a state."""
        key = self.model.form_digest, self.softness
        if key in _TOLD:
            return
        # A singular M has an error of its own.
        with contextlib.suppress(np.linalg.LinAlgError):
            error = self._law(b, q, v, tau).error
            _TOLD.add(key)
            what, rigid = ("dry friction", "exact friction") if self._soft_jumps else ("loops", "rigid loops")
            warn(
                f"{self.model.name}: MuJoCo holds {what} by soft constraints: its accelerations are "
                f"{off_by(error, f'those of {rigid}')} at this state; constraint_law(q, v, tau).digits tells it of any "
                "state, and stiffer solref and solimp leave less",
                MbkitWarning,
            )

    def _law(self, b: Array, q: Array, v: Array, tau: Array) -> ConstraintLaw:
        """Return the law at the state that is in, where τ acts; what that is matters to exact friction alone."""
        M = full_mass_matrix(self._m, self._d)
        own = friction_law if self._soft_jumps else law
        out = own(self._m, self._d, M, self.softness, lambda a: self._force(a - b), self._columns)
        if not self._soft_jumps:
            return out
        return replace(out, rigid=self._exact_friction(q, v, tau, self._smooth_acceleration)[0])

    def _accelerated(self, tau: Array) -> None:
        """Have MuJoCo compute its accelerations at the state in its data."""
        self._d.qfrc_applied[:] = self._to_engine(tau)
        mujoco.mj_forward(self._m, self._d)
        self._d.qfrc_applied[:] = 0.0

    def _kinetic_energy(self, q: Array, v: Array) -> Any:
        self._set(q, v)
        self._velocities()
        mujoco.mj_energyVel(self._m, self._d)
        return self._d.energy[1]

    def _potential_energy(self, q: Array) -> Any:
        self._set(q)
        mujoco.mj_fwdPosition(self._m, self._d)
        mujoco.mj_energyPos(self._m, self._d)
        return self._d.energy[0]

    # Native integration.

    def rollout(
        self,
        integrator: str,
        q0: Array,
        v0: Array,
        dt: float,
        tau: Array | None,
        steps: int,
        *,
        euler_damping: bool = False,
        progress: Callable[[float], object] | None = None,
    ) -> tuple[Array, Array]:
        """Integrate one state or a batch with MuJoCo's own steps of `dt` seconds.

        Parameters
        ----------
        integrator : {"euler", "rk4", "implicit", "implicitfast", "discrete"}
        tau : (steps, nv) or (N, steps, nv) array, optional
            Held over each step.
        euler_damping : bool
            Whether Euler treats joint damping implicitly, MuJoCo's default; it then solves (M + h D) a = f.
        progress : callable, optional
            Gets the finished fraction, about ten times a second; an exception of its ends the run.

        Returns
        -------
        q, v : (steps + 1, n) or (N, steps + 1, n) arrays
            NaN from the step at which MuJoCo reports divergence.

        Raises
        ------
        UnsupportedError
            For what MuJoCo does not hold: mimic joints, forces by functions and exact dry friction, and forces on a
            free joint's translation, which MuJoCo holds in world axes.
        """
        MUJOCO_RUNS.admit(self.model.smooth if self._soft_jumps else self.model)
        q0, v0 = self.model.check_q(q0, "q0"), self.model.check_v(v0, "v0")
        size = batch_of(q0=q0, v0=v0)
        if size is not None:
            q0, v0 = (np.broadcast_to(x, (size, x.shape[-1])) for x in (q0, v0))
        real("dt", dt, positive=True)
        count("steps", steps)
        if tau is not None and np.shape(tau) not in ((steps, self.model.nv), (size, steps, self.model.nv)):
            raise InputError(f"tau: expected shape ({steps}, {self.model.nv}), one row a step, got {np.shape(tau)}")
        if self._lines:
            self.passive(q0, v0)  # raises where a spring has no direction to start in
        self._require_loops_that_meet()
        model = copy.copy(self.mj_model)
        model.body_gravcomp[:], model.jnt_stiffness[:] = self._own_forces
        used = [self.softness] if self.model.needs.loops or self._soft_jumps else []
        short = [x.solref[0] for x in (*used, *(self.limit_softness or {}).values()) if 0 < x.solref[0] < 2 * dt]
        if short:
            warn(
                f"{self.model.name}: MuJoCo raises the time constant of its constraints from "
                f"{min(short):g} s to two steps, {2 * dt:g} s",
                DoubtfulRunWarning,
            )
        if euler_damping:
            model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
        return rollout(self.model, replace(self._maps, model=model), integrator, q0, v0, dt, tau, steps, progress)


def _of_file(model: Model, joints: Iterable[str]) -> dict[str, Softness]:
    """Return how soft the limits of joints are in the MJCF that a model was loaded from, where there is one to read."""
    if model.source.lower().endswith((".xml", ".mjcf")):
        with contextlib.suppress(MbkitError, OSError, ValueError), heard_warnings():
            file = strip(Path(model.source))
            return limit_softness(mujoco.MjModel.from_xml_string(file.text, file.meshes), joints)
    return {}


class Variant:
    """The same MuJoCo model with features on that mbkit leaves out, to measure them.

    `enable` names MuJoCo's disable bits to clear, such as ``"CONTACT"``. With `spheres` every body carries a sphere of
    1 µm at its centre of mass, which costs what geometry costs and touches nothing.
    """

    def __init__(self, dyn: MujocoDynamics, enable: Iterable[str] = (), *, spheres: bool = False) -> None:
        maps = build(dyn.model, softness=dyn.softness, spheres=spheres)
        self._m = maps.model
        flags = int(self._m.opt.disableflags)
        for name in enable:
            flags &= ~int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"))
        self._m.opt.disableflags = flags
        self._d = mujoco.MjData(self._m)
        self._maps, self._layout = maps, dyn.model.layout

    def set(self, q: Array, v: Array) -> None:
        """Put a state in; the velocities' frame does not matter for these quantities."""
        self._d.qpos[:] = self._layout.expand_q(q)[self._maps.q_index]
        self._d.qvel[:] = self._layout.expand_v(v)[self._maps.v_index]

    def forward(self) -> Any:
        """Run the forward dynamics once."""
        mujoco.mj_forward(self._m, self._d)

    def accelerations(self, q: Array, v: Array) -> Array:
        """Return MuJoCo's qacc at a state."""
        self.set(q, v)
        self.forward()
        return np.array(self._d.qacc)
