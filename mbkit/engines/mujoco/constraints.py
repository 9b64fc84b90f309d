"""Loops and dry friction in MuJoCo: the law of its soft constraints, and the rows of loops from its kinematics.

The law is that of the chapter "Computation" of MuJoCo's documentation, sections "Constraint model" and "Parameters";
the names solref and solimp are those of "Modeling", section "Solver parameters". Of one equality with rows J, residual
r and its size |r|::

    d(r) = d_0 + y(|r| / width) (d_width - d_0)     impedance, y a spline of two powers
    b = 2 / (d_width t)   k = 1 / (d_width t ζ)²    of solref = (t, ζ); of two negative numbers b and k themselves
    a_ref = -b J v - k d(r) r - J̇ v                 reference acceleration
    R = (1 - d(r)) / d(r) Â                         regularizer, with an estimate Â of the diagonal of A = J M⁻¹ Jᵀ
    (A + R) f = a_ref - J a_0                       a_0 = M⁻¹ (τ + τ_passive - C v - g)
    v̇ = a_0 + M⁻¹ Jᵀ f

The chapter's first equations have J̇ v; MuJoCo 4.0 forms it for points and frames. As d goes to 1, R goes to zero: the
acceleration of a closed loop becomes the rigid one. MuJoCo keeps d below 0.9999, so that it keeps four digits of it
or so.

Friction loss ("Computation", section "Friction loss") is a row of its joint alone, without a residual, J̇ v or k. Its
force has a bound: f minimizes ½ fᵀ (A + R) f + fᵀ (J a_0 - a_ref) with |f| <= the joint's friction, and d is d_0. So
below the bound a joint creeps, at a rate at which b J v makes up for R f.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import mujoco
import numpy as np

from mbkit import spatial
from mbkit._check import Array, real, rows
from mbkit._reproducible import DEPENDENT
from mbkit.engines.elements.jumps import forces_at_rest
from mbkit.errors import InputError, UnsupportedError
from mbkit.model import Model

if TYPE_CHECKING:
    from mbkit.engines.closed_loops.frame_rows import Rows

_DEFAULT_SOLREF: Final = (0.02, 1.0)
_DEFAULT_SOLIMP: Final = (0.9, 0.95, 0.001, 0.5, 2.0)
#: MuJoCo's equality for each kind of loop that it holds.
EQUALITIES: Final = {"point": mujoco.mjtEq.mjEQ_CONNECT, "frame": mujoco.mjtEq.mjEQ_WELD}
#: And for a coupler of one leader and one of several, which are a tendon's joints.
OF_JOINTS: Final = mujoco.mjtEq.mjEQ_JOINT
OF_TENDON: Final = mujoco.mjtEq.mjEQ_TENDON


@dataclass(frozen=True)
class Softness:
    """How soft MuJoCo's equality constraints and its friction loss are; the numbers of MJCF.

    Attributes
    ----------
    solref : (float, float)
        Time constant in s and damping ratio of the way back to a closed loop; or, of two negative numbers, minus the
        stiffness and minus the damping of the reference acceleration.
    solimp : (float, float, float, float, float)
        Impedance of a closed loop, and of one that is open by a width and more; that width; midpoint and power of the
        way between.
    """

    solref: tuple[float, float] = _DEFAULT_SOLREF
    solimp: tuple[float, float, float, float, float] = _DEFAULT_SOLIMP

    @classmethod
    def of(cls, solref: Any = None, solimp: Any = None) -> Softness:
        """Return checked settings; None is MuJoCo's default."""
        ref = _numbers("solref", _DEFAULT_SOLREF if solref is None else solref, 2)
        imp = _numbers("solimp", _DEFAULT_SOLIMP if solimp is None else solimp, 5)
        if not ((ref > 0).all() or (ref < 0).all()):
            # MuJoCo would take its default instead, after a warning.
            raise InputError(f"solref: expected two positive or two negative numbers, got {tuple(ref.tolist())}")
        bounded = imp[[0, 1, 3]]
        within = (bounded >= mujoco.mjMINIMP).all() and (bounded <= mujoco.mjMAXIMP).all()
        if not (within and imp[2] > 0 and imp[4] >= 1):
            raise InputError(
                f"solimp: expected impedances and a midpoint from {mujoco.mjMINIMP} to {mujoco.mjMAXIMP}, a width "
                f"above 0 and a power from 1 on, got {tuple(imp.tolist())}"
            )
        return cls(tuple(ref.tolist()), tuple(imp.tolist()))

    @property
    def gains(self) -> tuple[float, float]:
        """k in 1/s² and b in 1/s of the reference acceleration."""
        (first, second), most = self.solref, self.solimp[1]
        if first < 0:
            return -first / most**2, -second / most
        return 1 / (most * first * second) ** 2, 2 / (most * first)

    def impedance(self, size: float) -> float:
        """Return d(r) of an equality that is open by |r|."""
        low, high, width, midpoint, power = self.solimp
        x = min(size / width, 1.0)
        if x <= midpoint:
            y = x**power / midpoint ** (power - 1)
        else:
            y = 1 - (1 - x) ** power / (1 - midpoint) ** (power - 1)
        return float(low + y * (high - low))


def limit_softness(m: Any, joints: Iterable[str]) -> dict[str, Softness]:
    """Return how soft the limits of these joints are in a compiled file, of those that have some there."""
    own = (m.joint(int(j)) for j in np.flatnonzero(m.jnt_limited))
    return {x.name: Softness(tuple(x.solref.tolist()), tuple(x.solimp.tolist())) for x in own if x.name in joints}


def _numbers(name: str, x: Any, size: int) -> Array:
    out = rows(name, x, size, "MuJoCo", "numbers")
    if out.ndim != 1:
        raise InputError(f"{name}: expected {size} numbers, got shape {out.shape}")
    return out


def stiffest(dt: float) -> dict[str, tuple[float, ...]]:
    """Return the options of the stiffest constraints that MuJoCo holds with a step of `dt` seconds.

    A time constant of two steps is the least one that its documentation allows ("Modeling", section "Solver
    parameters"), and 0.9999 the greatest impedance.

    Examples
    --------
    >>> import mbkit as mb
    >>> from mbkit.engines.mujoco.constraints import stiffest
    >>> dyn = mb.dynamics(mb.catalog.slider_crank(), "mujoco", **stiffest(1e-3))
    >>> dyn.softness.solref
    (0.002, 1.0)
    """
    return {
        "solref": (2 * real("dt", dt, positive=True), 1.0),
        "solimp": (mujoco.mjMAXIMP, mujoco.mjMAXIMP, *_DEFAULT_SOLIMP[2:]),
    }


@dataclass(frozen=True, eq=False)
class ConstraintLaw:
    """What MuJoCo's documentation says of one state, by formulas of mbkit's own: `constraints.py` in this folder.

    Rows are MuJoCo's: of each loop the gap in world axes, and of a frame the imaginary part of the turn's quaternion.
    Of each coupler it is the excess of its joint's coordinate; each velocity with friction has a row of its own.

    Attributes
    ----------
    softness : Softness
    acceleration, rigid : (nv,) arrays
        v̇ of the soft law, and that of rigid loops, R = 0 and a_ref = -J̇ v; of friction, the exact one of
        `mbkit.Joint.friction`.
    jacobian : (m, nv) array
    residual, rate, bias : (m,) arrays
        r, J v and J̇ v.
    impedance, regularizer, reference, force : (m,) arrays
        d(r), R, a_ref and f.
    """

    softness: Softness
    acceleration: Array
    rigid: Array
    jacobian: Array
    residual: Array
    rate: Array
    bias: Array
    impedance: Array
    regularizer: Array
    reference: Array
    force: Array

    @property
    def error(self) -> float:
        """|v̇ - v̇_rigid| / |v̇_rigid|, the part of the rigid acceleration that softness costs."""
        size = float(np.linalg.norm(self.rigid))
        off = float(np.linalg.norm(self.acceleration - self.rigid))
        return off / size if size else off

    @property
    def digits(self) -> float:
        """Decimal digits that the soft acceleration keeps of the rigid one; infinite where they are equal."""
        return float(-np.log10(self.error)) if self.error else float("inf")

    def __str__(self) -> str:
        return (
            f"{len(self.residual)} rows, solref {self.softness.solref}, solimp {self.softness.solimp}: "
            f"{self.digits:.1f} digits of the exact acceleration"
        )


def law(
    m: Any, d: Any, M: Array, softness: Softness, turned: Callable[[Array], Array], columns: Callable[[Array], Array]
) -> ConstraintLaw:
    """Return the law at the state that `mj_forward` was called with.

    MuJoCo's are M, J, r, the smooth force and the estimates of the inverse weights; nothing of its solver is.
    `turned` and `columns` turn an acceleration and a Jacobian into the description's coordinates.
    """
    # Rows of soft limits stand beside them.
    loops = d.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    J, r = np.array(d.efc_J).reshape(-1, m.nv)[loops], np.array(d.efc_pos)[loops]
    rate, bias = J @ d.qvel, np.concatenate([_bias(m, d, i) for i in range(m.neq)])
    stiffness, damping = softness.gains
    impedance, estimate = np.empty(len(r)), np.empty(len(r))
    for i in range(m.neq):
        own = np.flatnonzero(d.efc_id[loops] == i)
        impedance[own] = softness.impedance(float(np.linalg.norm(r[own])))
        if m.eq_type[i] == OF_JOINTS:
            estimate[own] = sum(m.dof_invweight0[m.jnt_dofadr[j]] for j in (m.eq_obj1id[i], m.eq_obj2id[i]))
            continue
        if m.eq_type[i] == OF_TENDON:
            estimate[own] = m.tendon_invweight0[m.eq_obj1id[i]]
            continue
        weights = sum(m.body_invweight0[m.site_bodyid[s]] for s in (m.eq_obj1id[i], m.eq_obj2id[i]))
        estimate[own] = np.repeat(weights, 3)[: len(own)]
    R = np.maximum((1 - impedance) / impedance * estimate, mujoco.mjMINVAL)
    reference = -damping * rate - stiffness * impedance * r - bias
    # In coordinates in which M is the identity.
    L = np.linalg.cholesky(M)
    B = np.linalg.solve(L, J.T).T
    free = np.linalg.solve(L, d.qfrc_smooth)
    f = np.linalg.solve(B @ B.T + np.diag(R), reference - B @ free)
    # Rows that say nothing new, as those of a frame's loop in a plane, are left out.
    rigid = free + np.linalg.lstsq(B, -bias - B @ free, rcond=DEPENDENT)[0]
    soft, rigid = (turned(np.linalg.solve(L.T, x)) for x in (free + B.T @ f, rigid))
    return ConstraintLaw(softness, soft, rigid, columns(J), r, rate, bias, impedance, R, reference, f)


def friction_law(
    m: Any, d: Any, M: Array, softness: Softness, turned: Callable[[Array], Array], columns: Callable[[Array], Array]
) -> ConstraintLaw:
    """Return the law of friction loss at the state that `mj_forward` was called with, beside no loops.

    Arguments are those of `law`. `rigid` is the acceleration without friction, until the caller puts the exact one in.
    """
    which = np.flatnonzero(m.dof_frictionloss)
    J, rate, none = np.eye(m.nv)[which], d.qvel[which], np.zeros(len(which))
    impedance = none + softness.impedance(0.0)
    R = np.maximum((1 - impedance) / impedance * m.dof_invweight0[which], mujoco.mjMINVAL)
    reference = -softness.gains[1] * rate
    responses, free = np.linalg.solve(M, J.T), np.linalg.solve(M, d.qfrc_smooth)
    f = forces_at_rest(
        np.asarray(responses[which] + np.diag(R), dtype=np.float64), free[which] - reference, m.dof_frictionloss[which]
    )
    soft, free = turned(free + responses @ f), turned(free)
    return ConstraintLaw(softness, soft, free, columns(J), none, rate, none, impedance, R, reference, f)


def _bias(m: Any, d: Any, i: int) -> Array:
    """Return J̇ v of an equality's rows; ratios of coordinates have none."""
    if m.eq_objtype[i] != mujoco.mjtObj.mjOBJ_SITE:
        return np.zeros(1)
    (rate_a, a), (rate_b, b) = (_motion(m, d, s) for s in (m.eq_obj1id[i], m.eq_obj2id[i]))
    gap = a[:3] - b[:3]
    if m.eq_type[i] == EQUALITIES["point"]:
        return np.asarray(gap)
    # r is the imaginary part of p = q̄_b q_a, times a scale: ṗ = ½ q̄_b Δω q_a, of quaternions in the world's axes.
    Q = [_quaternion(m, d, s) for s in (m.eq_obj1id[i], m.eq_obj2id[i])]
    wa, wb = (np.append(x[3:], 0.0) for x in (rate_a, rate_b))
    turning = np.append(a[3:] - b[3:], 0.0) + 0.5 * (spatial.multiply(wa - wb, wa) - spatial.multiply(wb, wa - wb))
    p = 0.5 * spatial.multiply(spatial.conjugate(Q[1]), spatial.multiply(turning, Q[0]))
    return np.concatenate([gap, m.eq_data[i, 10] * p[:3]])


def _motion(m: Any, d: Any, site: int) -> tuple[Array, Array]:
    """Return J v and J̇ v of a site, (6,) each, in world axes, linear first."""
    at = d.site_xpos[site], m.site_bodyid[site]
    return _jacobian(mujoco.mj_jac, m, d, *at) @ d.qvel, _jacobian(mujoco.mj_jacDot, m, d, *at) @ d.qvel


def _quaternion(m: Any, d: Any, site: int) -> Array:
    """Return a site's quaternion with MuJoCo's sign, which decides that of the rows."""
    return spatial.multiply(*(np.roll(x, -1) for x in (d.xquat[m.site_bodyid[site]], m.site_quat[site])))


# The rows of the contract, from the motion of sites


class LoopEnds:
    """Which sites are the ends of each loop, and which body carries both."""

    def __init__(self, m: Any, description: Model, bodies: Mapping[str, int]) -> None:
        self._model, self._placed = description, []
        for k, loop in enumerate(description.loops):
            carrier = description.carrier(loop)
            if carrier not in bodies:
                raise UnsupportedError(
                    f"mujoco: loop {loop.name!r} has its rows in the axes of {carrier!r}, a body without mass between "
                    "two joints, which MuJoCo holds as two joints of one body"
                )
            self._placed.append((*(m.site(f"loop{k}.{end}").id for end in "ab"), bodies[carrier]))

    def rows(self, m: Any, d: Any, columns: Callable[[Array], Array], b0: Array, given: tuple[Array, Array]) -> Rows:
        """Return all rows at the state that is in, where MuJoCo's accelerations are b0.

        `columns` turns a Jacobian into the description's coordinates; `given` are q and v of the description.
        """
        # The import loads CasADi, which trees never need here.
        from mbkit.engines.closed_loops.frame_rows import MovingFrame, Rows, coordinate_rows, loop_rows

        def frame(p: Array, R: Array, body: int) -> MovingFrame:
            J, dJ = _jacobian(mujoco.mj_jac, m, d, p, body), _jacobian(mujoco.mj_jacDot, m, d, p, body)
            return MovingFrame(R.reshape(3, 3), p, columns(J), J @ d.qvel, dJ @ d.qvel + J @ b0)

        parts = []
        for loop, (*ends, carrier) in zip(self._model.loops, self._placed, strict=True):
            a, b = (frame(d.site_xpos[s], d.site_xmat[s], m.site_bodyid[s]) for s in ends)
            parts.append(loop_rows(loop, a, b, frame(d.xpos[carrier], d.xmat[carrier], carrier)))
        return Rows.stacked([*parts, *coordinate_rows(self._model, *given, {}, 0.0)])


def _jacobian(of: Callable[..., None], m: Any, d: Any, p: Array, body: int) -> Array:
    """Return the Jacobian of a point's velocity, or its rate, (6, nv) in world axes, linear first."""
    J = np.zeros((6, m.nv))
    of(m, d, J[:3], J[3:], p, body)
    return J


def wxyz(R: Array) -> Array:
    """Return a rotation as a quaternion in MuJoCo's order."""
    return np.roll(spatial.quaternion_from_matrix(R), 1)
