"""Closed forms of classical systems, written apart from mbkit.

Nothing here imports mbkit, and only NumPy computes. First the terms of catalog systems, each a `System` as in
``closed_forms`` (where pendulum, double pendulum, cart-pole, spherical pendulum, chain, heavy top and free body
are), those with springs a `Sprung`; then the systems of one coordinate, driven or in a plane of
their own, that no description of bodies and joints has. Motions along time are in ``elliptic`` and ``motions``.

Each function names its source. "Derived here" means: from positions and velocities, as its docstring or comment
says. As in ``closed_forms`` energies are written apart from the matrices, so that T = ½ vᵀ M v is a check
and no definition. Conventions: angles from the downward vertical unless said, quaternions x, y, z, w,
velocities of rotations in body axes, SI units.
"""

# One signature serves every system, whether a term depends on q or not.
# ruff: noqa: ARG001, ARG005

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from validation.closed_forms import Array, System, chain


@dataclass(frozen=True)
class Sprung(System):
    """A system with springs, whose potential energy includes theirs; `gravity` does not hold their force."""

    passive: Callable[[Array], Array]

    def forward_dynamics(self, q: Array, v: Array, tau: Array) -> Array:
        """Return v̇."""
        return super().forward_dynamics(q, v, tau + self.passive(q))


# --------------------------------------------------------------------------------------
# Pendulums


def elastic_pendulum(length: float = 1.0, mass: float = 1.0, stiffness: float = 100.0, g: float = 9.81) -> Sprung:
    """Return the elastic pendulum in θ and the stretch s of its spring.

    m (l + s)² θ̈ + 2 m (l + s) ṡ θ̇ + m g (l + s) sin θ = 0,
    m s̈ - m (l + s) θ̇² - m g cos θ + k s = 0: polar coordinates (Landau, Lifshitz 1976, §4).
    """

    def kinetic_energy(q: Array, v: Array) -> float:
        (angle, stretch), (turn, slide) = q, v
        along, across = np.array([np.sin(angle), -np.cos(angle)]), np.array([np.cos(angle), np.sin(angle)])
        velocity = slide * along + (length + stretch) * turn * across
        return float(mass * velocity @ velocity / 2)

    return Sprung(
        mass_matrix=lambda q: mass * np.diag([(length + q[1]) ** 2, 1.0]),
        velocity_force=lambda q, v: mass * (length + q[1]) * np.array([2 * v[0] * v[1], -(v[0] ** 2)]),
        gravity=lambda q: mass * g * np.array([(length + q[1]) * np.sin(q[0]), -np.cos(q[0])]),
        kinetic_energy=kinetic_energy,
        potential_energy=lambda q: float(-mass * g * (length + q[1]) * np.cos(q[0]) + stiffness * q[1] ** 2 / 2),
        passive=lambda q: np.array([0.0, -stiffness * q[1]]),
    )


def acrobot(
    length1: float = 1.0,
    mass1: float = 1.0,
    mass2: float = 1.0,
    com1: float = 0.5,
    com2: float = 1.0,
    inertia1: float = 0.083,
    inertia2: float = 0.33,
    g: float = 9.8,
) -> System:
    """Return the acrobot (Spong 1995, with angles from down: Tedrake, Underactuated Robotics, ch. 3.1)."""
    l1, m1, m2, c1, c2 = length1, mass1, mass2, com1, com2
    I1, I2 = inertia1 + m1 * c1**2, inertia2 + m2 * c2**2  # about the hinges

    def mass_matrix(q: Array) -> Array:
        reach = m2 * l1 * c2 * np.cos(q[1])
        return np.array([[I1 + I2 + m2 * l1**2 + 2 * reach, I2 + reach], [I2 + reach, I2]])

    def velocity_force(q: Array, v: Array) -> Array:
        h = m2 * l1 * c2 * np.sin(q[1])
        return np.array([-2 * h * v[0] * v[1] - h * v[1] ** 2, h * v[0] ** 2])

    def gravity(q: Array) -> Array:
        second = m2 * g * c2 * np.sin(q[0] + q[1])
        return np.array([g * (m1 * c1 + m2 * l1) * np.sin(q[0]) + second, second])

    def kinetic_energy(q: Array, v: Array) -> float:
        a, b, turn = q[0], q[0] + q[1], v[0] + v[1]
        elbow = l1 * v[0] * np.array([np.cos(a), np.sin(a)])
        centre = elbow + c2 * turn * np.array([np.cos(b), np.sin(b)])
        moving = m1 * (c1 * v[0]) ** 2 + m2 * centre @ centre
        return float((moving + inertia1 * v[0] ** 2 + inertia2 * turn**2) / 2)

    def potential_energy(q: Array) -> float:
        elbow = -l1 * np.cos(q[0])
        return float(g * (-m1 * c1 * np.cos(q[0]) + m2 * (elbow - c2 * np.cos(q[0] + q[1]))))

    return System(mass_matrix, velocity_force, gravity, kinetic_energy, potential_energy)


def furuta_pendulum(
    arm_length: float = 0.25,
    arm_mass: float = 0.2,
    arm_com: float = 0.125,
    arm_inertia: float = 1e-3,
    pendulum_mass: float = 0.1,
    pendulum_com: float = 0.15,
    pendulum_inertia: tuple[float, float, float] = (7.5e-4, 7.5e-4, 1.25e-6),
    g: float = 9.81,
) -> System:
    """Return the Furuta pendulum with all its moments of inertia; Cazzolato, Prime 2011 have the same form.

    Derived here. In axes that turn with the arm by α the pendulum's centre is (L, l sin β, -l cos β), so its
    velocity there is (-α̇ l sin β, α̇ L + β̇ l cos β, β̇ l sin β), and in the pendulum's axes its angular velocity is
    (β̇, α̇ sin β, α̇ cos β).
    """
    m1, L, m2, ell = arm_mass, arm_length, pendulum_mass, pendulum_com
    Jx, Jy, Jz = pendulum_inertia
    coupling = m2 * L * ell
    about = arm_inertia + m1 * arm_com**2 + m2 * L**2

    def mass_matrix(q: Array) -> Array:
        s, c = np.sin(q[1]), np.cos(q[1])
        first = about + (Jy + m2 * ell**2) * s**2 + Jz * c**2
        return np.array([[first, coupling * c], [coupling * c, Jx + m2 * ell**2]])

    def velocity_force(q: Array, v: Array) -> Array:
        s, c = np.sin(q[1]), np.cos(q[1])
        h = (Jy + m2 * ell**2 - Jz) * s * c
        return np.array([2 * h * v[0] * v[1] - coupling * s * v[1] ** 2, -h * v[0] ** 2])

    def kinetic_energy(q: Array, v: Array) -> float:
        s, c, (turn, swing) = np.sin(q[1]), np.cos(q[1]), v
        velocity = np.array([-turn * ell * s, turn * L + swing * ell * c, swing * ell * s])
        w = np.array([swing, turn * s, turn * c])
        arm = (arm_inertia + m1 * arm_com**2) * turn**2
        return float((arm + m2 * velocity @ velocity + w**2 @ np.array(pendulum_inertia)) / 2)

    return System(
        mass_matrix,
        velocity_force,
        gravity=lambda q: np.array([0.0, m2 * g * ell * np.sin(q[1])]),
        kinetic_energy=kinetic_energy,
        potential_energy=lambda q: float(-m2 * g * ell * np.cos(q[1])),
    )


# --------------------------------------------------------------------------------------
# Gyroscope


@dataclass(frozen=True)
class Gyroscope:
    """A symmetric rotor in two gimbals, in precession α, nutation β (elevation of the rotor's axis) and spin γ.

    Derived here. In the inner gimbal's axes (hinge, rotor's axis, across) that gimbal turns with
    (β̇, α̇ sin β, α̇ cos β) and the rotor with the same plus γ̇ about its axis, so with A across and C along for
    the rotor about the gimbals' centre, a, b, c for the inner gimbal and O for the outer one

        2 T = (O + (A + c) cos² β + b sin² β) α̇² + (A + a) β̇² + C (γ̇ + α̇ sin β)²,    V = m g r sin β.
    """

    rotor_mass: float = 1.0
    rotor_axial: float = 2e-3
    rotor_across: float = 1.2e-3
    offset: float = 0.02
    inner_inertia: tuple[float, float, float] = (5e-4, 5e-4, 1e-3)
    outer_inertia: float = 8e-4
    g: float = 9.81

    @property
    def across(self) -> float:
        """A, about the gimbals' centre."""
        return self.rotor_across + self.rotor_mass * self.offset**2

    @property
    def moment(self) -> float:
        """Return m g r."""
        return self.rotor_mass * self.g * self.offset

    def system(self) -> System:
        A, C, (a, b, c) = self.across, self.rotor_axial, self.inner_inertia

        def mass_matrix(q: Array) -> Array:
            s, k = np.sin(q[1]), np.cos(q[1])
            first = self.outer_inertia + (A + c) * k**2 + (b + C) * s**2
            return np.array([[first, 0.0, C * s], [0.0, A + a, 0.0], [C * s, 0.0, C]])

        def velocity_force(q: Array, v: Array) -> Array:
            s, k = np.sin(q[1]), np.cos(q[1])
            h = (b + C - A - c) * s * k
            return np.array(
                [
                    2 * h * v[0] * v[1] + C * k * v[1] * v[2],
                    -h * v[0] ** 2 - C * k * v[0] * v[2],
                    C * k * v[0] * v[1],
                ]
            )

        def kinetic_energy(q: Array, v: Array) -> float:
            inner = np.array([v[1], v[0] * np.sin(q[1]), v[0] * np.cos(q[1])])
            rotor = inner + np.array([0.0, v[2], 0.0])
            velocity = np.cross(inner, [0.0, self.offset, 0.0])
            own = np.array([self.rotor_across, self.rotor_axial, self.rotor_across])
            rotating = rotor**2 @ own + inner**2 @ np.array(self.inner_inertia) + self.outer_inertia * v[0] ** 2
            return float((rotating + self.rotor_mass * velocity @ velocity) / 2)

        return System(
            mass_matrix,
            velocity_force,
            gravity=lambda q: np.array([0.0, self.moment * np.cos(q[1]), 0.0]),
            kinetic_energy=kinetic_energy,
            potential_energy=lambda q: float(self.moment * np.sin(q[1])),
        )

    def steady_precession(self, nutation: float, spin: float) -> Array:
        """Return the two α̇, the slow one first, at which β stays, for a rate γ̇ in the gimbal.

        β's equation with β̇ = β̈ = 0 and cos β ≠ 0:
        (b + C - A - c) sin β α̇² + C γ̇ α̇ - m g r = 0. At β = 0 there is but one: the other lies at infinity.
        """
        _, b, c = self.inner_inertia
        square = (b + self.rotor_axial - self.across - c) * np.sin(nutation)
        linear = self.rotor_axial * spin
        root = np.sqrt(linear**2 + 4 * square * self.moment)
        # The form of the quadratic's solution that cancels nothing, for either sign of the spin.
        larger = -(linear + np.copysign(root, linear)) / 2
        slow = -self.moment / larger
        return np.array([slow, larger / square if square else np.copysign(np.inf, linear)])

    def nutation_rate(self, spin: float) -> float:
        """Return the circular frequency of small nutations about β = 0 without weight, C γ̇/√(M₁₁ M₂₂).

        Of (O + A + c) α̈ + C γ̇ β̇ = 0 and (A + a) β̈ - C γ̇ α̇ = 0, which are the equations there to first order.
        """
        a, _, c = self.inner_inertia
        outer, inner = self.outer_inertia + self.across + c, self.across + a
        return float(self.rotor_axial * abs(spin) / np.sqrt(outer * inner))


# --------------------------------------------------------------------------------------
# Spacecraft with wheels


@dataclass(frozen=True)
class WheeledSpacecraft:
    """A free hub with equal thin wheels of moment J about unit axes a_i through its centre, Ω_i their rates in it.

    Hughes 1986, Spacecraft Attitude Dynamics, on gyrostats: the wheels' symmetry keeps mass, centre of mass c and
    inertia I_O constant in body axes. With P = m (v + ω × c), the momentum, and
    L = m c × v + I_O ω + Σ J Ω_i a_i, the angular momentum about the hub's centre, Kirchhoff's equations are
    Ṗ + ω × P = F, L̇ + ω × L + v × P = N; and each wheel's own is J (a_i · ω̇ + Ω̇_i) = u_i, as no
    component of ω × L_wheel lies along its axis.
    """

    hub_mass: float = 50.0
    hub_inertia: tuple[float, float, float] = (4.0, 5.0, 3.0)
    wheel_axes: ArrayLike = ((1.0, 0.0, 1.0), (0.0, 1.0, 1.0), (-1.0, 0.0, 1.0), (0.0, -1.0, 1.0))
    wheel_mass: float = 1.0
    wheel_inertia: float = 0.01
    wheel_distance: float = 0.2

    @cached_property
    def axes(self) -> Array:
        """Unit vectors, (n, 3)."""
        axes = np.array(self.wheel_axes, dtype=float)
        return np.asarray(axes / np.linalg.norm(axes, axis=1, keepdims=True))

    @property
    def mass(self) -> float:
        return self.hub_mass + len(self.axes) * self.wheel_mass

    @property
    def com(self) -> Array:
        return np.asarray(self.wheel_mass * self.wheel_distance * self.axes.sum(axis=0) / self.mass)

    @property
    def inertia(self) -> Array:
        """Of the whole about the hub's centre, with the wheels locked."""
        turned = [self._disc(a) + self.wheel_mass * self.wheel_distance**2 * _steiner(a) for a in self.axes]
        return np.asarray(np.diag(self.hub_inertia) + sum(turned))

    @property
    def central_inertia(self) -> Array:
        """Of the whole about its centre of mass."""
        return np.asarray(self.inertia - self.mass * _steiner(self.com))

    def _disc(self, axis: Array) -> Array:
        return np.asarray(self.wheel_inertia / 2 * (np.eye(3) + np.outer(axis, axis)))

    def system(self) -> System:
        n, m, J, c = len(self.axes), self.mass, self.wheel_inertia, self.com
        M = np.zeros((6 + n, 6 + n))
        M[:3, :3] = m * np.eye(3)
        M[:3, 3:6] = -m * _cross_matrix(c)
        M[3:6, :3] = m * _cross_matrix(c)
        M[3:6, 3:6] = self.inertia
        M[3:6, 6:] = J * self.axes.T
        M[6:, 3:6] = J * self.axes
        M[6:, 6:] = J * np.eye(n)

        def velocity_force(q: Array, v: Array) -> Array:
            w, P, L = v[3:6], M[:3] @ v, M[3:6] @ v
            return np.concatenate([np.cross(w, P), np.cross(w, L) + np.cross(v[:3], P), np.zeros(n)])

        def kinetic_energy(q: Array, v: Array) -> float:
            w = v[3:6]
            twice = self.hub_mass * v[:3] @ v[:3] + w**2 @ np.array(self.hub_inertia)
            for axis, rate in zip(self.axes, v[6:], strict=True):
                velocity, turning = v[:3] + np.cross(w, self.wheel_distance * axis), w + rate * axis
                twice += self.wheel_mass * velocity @ velocity + turning @ self._disc(axis) @ turning
            return float(twice / 2)

        return System(
            mass_matrix=lambda q: M,
            velocity_force=velocity_force,
            gravity=lambda q: np.zeros(6 + n),
            kinetic_energy=kinetic_energy,
            potential_energy=lambda q: 0.0,
        )

    def attitude_rates(self, w: Array, speeds: Array, torques: Array) -> tuple[Array, Array]:
        """Return ω̇ and the wheels' Ω̇ by Euler's equation I ω̇ + ω × (I ω + h) = -ḣ about the centre of mass.

        h = Σ J Ω_i a_i is the wheels' momentum relative to the body, and the motors give
        J Ω̇_i = u_i - J a_i · ω̇.
        """
        J, inertia = self.wheel_inertia, self.central_inertia
        h = J * speeds @ self.axes
        without = inertia - J * self.axes.T @ self.axes
        turning = np.linalg.solve(without, -np.cross(w, inertia @ w + h) - torques @ self.axes)
        return turning, torques / J - self.axes @ turning


def _cross_matrix(x: Array) -> Array:
    return np.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])


def _steiner(x: Array) -> Array:
    return np.asarray(x @ x * np.eye(3) - np.outer(x, x))


# --------------------------------------------------------------------------------------
# Beams

#: Length of the stub before the first hinge in lengths of a segment.
#
# Derived here. n rods of length h behind a stub a h: h = L/(n + a). Rods that carry a wave of wave number k have
# the inertia of linear interpolation, μ h (2 + cos kh)/3 = μ h (1 - (kh)²/6 + ...), and the springs EI/h give
# (EI/h³) (2 - 2 cos kh)² = EI k⁴ h (1 - (kh)²/6 + ...): their quotient errs by (kh)⁴ only. At the wall, where the
# beam bends as w = c x²/2 + d x³/6, the rods go through smooth values w₀ + s x + w. With X = a h, the first
# hinge does not move, w₀ + s X + c X²/2 + d X³/6 = 0, and its spring κ EI/h stands for what a hinge within the beam
# would feel from a rod on the other side, w(X - h) = (κ - 1) w(X + h). The term c asks for κ = 2/(2 a + 1); then
# w₀ = -c X²/2 and s = d (3 X² - h²)/6 to this order. A displaced and turned clamp changes an eigenvalue by
# (EI/∫μ w²) (d w₀ - c s) = (EI c d/∫μ w²) (h²/6 - X²), which vanishes for a = 1/√6.
STUB = 1 / np.sqrt(6)


def clamped_beam(
    segments: int = 8, length: float = 10.0, mass: float = 20.0, bending_stiffness: float = 1500.0
) -> Sprung:
    """Return the lumped cantilever: a chain of thin rods without weight, springs at its hinges."""
    h, share = length / (segments + STUB), mass / (segments + STUB)
    k = _hinges(segments, h, bending_stiffness)
    rods = chain(segments, h, share, 0.0)
    return Sprung(
        rods.mass_matrix,
        rods.velocity_force,
        rods.gravity,
        rods.kinetic_energy,
        potential_energy=lambda q: float(k @ q**2 / 2),
        passive=lambda q: -k * q,
    )


def _hinges(segments: int, h: float, bending_stiffness: float) -> Array:
    k = np.full(segments, bending_stiffness / h)
    k[0] = bending_stiffness / ((STUB + 0.5) * h)
    return k


def flexible_spacecraft(
    segments: int = 8,
    hub_mass: float = 500.0,
    hub_inertia: float = 300.0,
    hub_radius: float = 1.0,
    length: float = 10.0,
    mass: float = 20.0,
    bending_stiffness: float = 1500.0,
) -> Sprung:
    """Return the planar hub with two lumped cantilevers, q = (x, y, θ, right, left).

    Derived here, as ``closed_forms.chain``: in angles φ from the x-axis (φ₀ = θ for the hub) every
    segment's centre is p + Σ_j F_kj e(φ_j), e = (cos, sin), so with b_j = m Σ_k F_kj and a = m FᵀF plus
    the moments about the centres, n = (-sin, cos),
    2 T = m_all ṗ² + 2 ṗ · Σ b_j n(φ_j) φ̇_j + Σ a_ij cos(φ_i - φ_j) φ̇_i φ̇_j.
    """
    n, h, share = segments, length / (segments + STUB), mass / (segments + STUB)
    stub, stub_mass = STUB * h, STUB * share
    centre = hub_mass + 2 * stub_mass
    about = hub_inertia + 2 * stub_mass * (stub**2 / 12 + (hub_radius + stub / 2) ** 2)
    F = np.zeros((2 * n, 1 + 2 * n))
    for side, sign in enumerate((1, -1)):
        rows, columns = slice(side * n, side * n + n), slice(1 + side * n, 1 + side * n + n)
        F[rows, 0] = sign * (hub_radius + stub)
        F[rows, columns] = sign * h * (np.tril(np.ones((n, n)), -1) + np.eye(n) / 2)
    a = share * F.T @ F + np.diag([about] + [share * h**2 / 12] * (2 * n))
    b = share * F.sum(axis=0)
    whole = centre + 2 * n * share
    S = np.zeros((1 + 2 * n, 1 + 2 * n))  # φ = S (θ, right, left)
    S[:, 0] = 1.0
    S[1 : 1 + n, 1 : 1 + n] = S[1 + n :, 1 + n :] = np.tril(np.ones((n, n)))
    k = np.concatenate([np.zeros(3), *[_hinges(n, h, bending_stiffness)] * 2])

    def mass_matrix(q: Array) -> Array:
        phi = S @ q[2:]
        M = np.zeros((3 + 2 * n, 3 + 2 * n))
        M[:2, :2] = whole * np.eye(2)
        M[:2, 2:] = b * np.array([-np.sin(phi), np.cos(phi)]) @ S
        M[2:, :2] = M[:2, 2:].T
        M[2:, 2:] = S.T @ (a * np.cos(np.subtract.outer(phi, phi))) @ S
        return M

    def velocity_force(q: Array, v: Array) -> Array:
        phi, rate = S @ q[2:], S @ v[2:]
        pushed = -np.array([np.cos(phi), np.sin(phi)]) @ (b * rate**2)
        return np.concatenate([pushed, S.T @ ((a * np.sin(np.subtract.outer(phi, phi))) @ rate**2)])

    def kinetic_energy(q: Array, v: Array) -> float:
        phi, rate = S @ q[2:], S @ v[2:]
        twice = centre * v[:2] @ v[:2] + about * v[2] ** 2
        for side, sign in enumerate((1, -1)):
            joint = v[:2] + sign * (hub_radius + stub) * rate[0] * np.array([-np.sin(phi[0]), np.cos(phi[0])])
            for j in range(1 + side * n, 1 + side * n + n):
                across = sign * h * rate[j] * np.array([-np.sin(phi[j]), np.cos(phi[j])])
                middle = joint + across / 2
                twice += share * (middle @ middle + h**2 / 12 * rate[j] ** 2)
                joint = joint + across
        return float(twice / 2)

    return Sprung(
        mass_matrix,
        velocity_force,
        gravity=lambda q: np.zeros(3 + 2 * n),
        kinetic_energy=kinetic_energy,
        potential_energy=lambda q: float(k @ q**2 / 2),
        passive=lambda q: -k * q,
    )


def cantilever_roots(count: int) -> Array:
    """Return the first β L of the cantilever, cos βL cosh βL = -1 (Timoshenko, Young, Weaver 1974, ch. 5).

    Newton on cos x + 1/cosh x, which stays of order one, from (k - ½) π.
    """
    x = (np.arange(1, count + 1) - 0.5) * np.pi
    for _ in range(8):
        x = x + (np.cos(x) + 1 / np.cosh(x)) / (np.sin(x) + np.sinh(x) / np.cosh(x) ** 2)
    return np.asarray(x)


def spacecraft_roots(
    count: int, mode: str, hub: float, length: float = 10.0, mass: float = 20.0, radius: float = 1.0
) -> Array:
    """Return the first β L of a free hub with two cantilevers: ω = (β L)² √(EI length/mass)/length².

    `mode` "swaying" moves the hub, of mass `hub`, across the beams; "turning" turns it, of moment `hub`.
    Derived here: w = w₀ K₁ + (s/β) K₂ + (c/β²) K₃ + (d/β³) K₄ of βx in Krylov's functions, w'' = w''' = 0 at the
    tip. The beams push the hub with -2 EI d and turn it with 2 EI (c - r d), so with μ = mass/length
    hub β⁴ w₀ = 2 μ d and s = 0, or hub β⁴ s = -2 μ (c - r d) and w₀ = r s.
    """
    density = mass / length

    def mismatch(x: Array) -> Array:
        k1, k2 = (np.cosh(x) + np.cos(x)) / 2, (np.sinh(x) + np.sin(x)) / 2
        k3, k4 = (np.cosh(x) - np.cos(x)) / 2, (np.sinh(x) - np.sin(x)) / 2
        beta = x / length
        if mode == "swaying":
            # Unknowns w₀ and c/β²; d/β³ follows.
            d = hub * beta / (2 * density)
            rows = (k3 + d * k2, k1), (k2 + d * k1, k4)
        else:
            # Unknowns s/β and d/β³; w₀ = (r β) s/β and c/β² = r β d/β³ - hub β³/(2 μ) s/β.
            arm, c = radius * beta, hub * beta**3 / (2 * density)
            rows = (arm * k3 + k4 - c * k1, k2 + arm * k1), (arm * k2 + k3 - c * k4, k1 + arm * k4)
        return np.asarray((rows[0][0] * rows[1][1] - rows[0][1] * rows[1][0]) / np.cosh(x) ** 2)

    grid = np.linspace(0.3, (count + 1) * np.pi, 400 * (count + 1))
    values = mismatch(grid)
    at = np.flatnonzero(values[:-1] * values[1:] < 0)[:count]
    low, high = grid[at], grid[at + 1]
    for _ in range(60):
        middle = (low + high) / 2
        left = mismatch(low) * mismatch(middle) <= 0
        low, high = np.where(left, low, middle), np.where(left, middle, high)
    return np.asarray((low + high) / 2)


# --------------------------------------------------------------------------------------
# Slider-cranks


@dataclass(frozen=True)
class SliderCrank:
    """Massless crank r and rod l > r, and a piston of mass m on the line through the shaft.

    The classic text's: J(θ) = m r² sin²(θ + φ)/cos² φ with sin φ = (r/l) sin θ, and J θ̈ + ½ J' θ̇² = Q. θ = 0 is the
    outer dead centre. Derived here: the piston is at s = r cos θ + l cos φ, and φ' = (r/l) cos θ/cos φ, so
    s' = -r sin(θ + φ)/cos φ and, as cos(θ + φ) cos φ + sin(θ + φ) sin φ = cos θ,
    s'' = -r (cos(θ + φ)/cos φ + (r/l) cos² θ/cos³ φ). All take complex angles, too.
    """

    crank: float = 0.1
    rod: float = 0.3
    mass: float = 0.4

    def lean(self, theta: Any) -> Any:
        """Return φ."""
        return np.arcsin(self.crank / self.rod * np.sin(theta))

    def position(self, theta: Any) -> Any:
        """Return s, from the shaft outwards."""
        return self.crank * np.cos(theta) + self.rod * np.cos(self.lean(theta))

    def slope(self, theta: Any) -> Any:
        """Return s' = ds/dθ."""
        phi = self.lean(theta)
        return -self.crank * np.sin(theta + phi) / np.cos(phi)

    def bend(self, theta: Any) -> Any:
        """Return s''."""
        phi = self.lean(theta)
        c = np.cos(phi)
        return -self.crank * (np.cos(theta + phi) / c + self.crank / self.rod * np.cos(theta) ** 2 / c**3)

    def velocity(self, theta: Any, speed: Any) -> Any:
        """Return the piston's."""
        return self.slope(theta) * speed

    def acceleration(self, theta: Any, speed: Any, angular: Any) -> Any:
        """Return the piston's, from θ, θ̇ and θ̈."""
        return self.slope(theta) * angular + self.bend(theta) * speed**2

    def inertia(self, theta: Any) -> Any:
        """Return J."""
        phi = self.lean(theta)
        return self.mass * self.crank**2 * np.sin(theta + phi) ** 2 / np.cos(phi) ** 2

    def inertia_slope(self, theta: Any) -> Any:
        """Return J' = 2 m r² sin(θ + φ) (cos(θ + φ) cos² φ + (r/l) cos² θ)/cos⁴ φ."""
        phi = self.lean(theta)
        c = np.cos(phi)
        bracket = np.cos(theta + phi) * c**2 + self.crank / self.rod * np.cos(theta) ** 2
        return 2 * self.mass * self.crank**2 * np.sin(theta + phi) * bracket / c**4

    def force(self, theta: Any, torque: Any, push: Any) -> Any:
        """Return Q of a torque on the crank and a force on the piston outwards: τ δθ + F δs."""
        return torque + push * self.slope(theta)

    def angular(self, theta: Any, speed: Any, torque: Any, push: Any) -> Any:
        """Return θ̈. At a dead centre J = J' = 0 and F drops out: nothing there balances a torque."""
        rest = self.force(theta, torque, push) - self.inertia_slope(theta) * speed**2 / 2
        return rest / self.inertia(theta)

    def dead_centres(self) -> tuple[tuple[float, float, float], ...]:
        """Return θ, s and s'' = ∓r (1 ± r/l) of the two, where s' = J = J' = 0 and J'' = 2 m s''²."""
        ratio = self.crank / self.rod
        return (
            (0.0, self.rod + self.crank, -self.crank * (1 + ratio)),
            (np.pi, self.rod - self.crank, self.crank * (1 - ratio)),
        )


@dataclass(frozen=True)
class MassiveSliderCrank:
    """The slider-crank of ``published.json``, "rigid_slider_crank": crank and rod are thin and homogeneous.

    J as it stands there, with the names of its derivatives kept: x' is dx/dθ. The second derivatives are derived
    here from it: q = √(1 - λ² sin² θ), q' = -λ² sin θ cos θ/q.
    """

    crank: float = 0.1
    rod: float = 0.3
    crank_mass: float = 0.2
    rod_mass: float = 0.2
    piston_mass: float = 0.4

    def _slopes(self, theta: Any) -> tuple[tuple[Any, Any], ...]:
        """Return first and second derivative by θ of x₂, y₂, ψ and x₃."""
        s, c, ratio, r = np.sin(theta), np.cos(theta), self.crank / self.rod, self.crank
        q = np.sqrt(1 - ratio**2 * s**2)
        tilt, tilt_slope = s * c / q, (c**2 - s**2) / q + ratio**2 * s**2 * c**2 / q**3
        return (
            (-r * s - r * ratio * tilt / 2, -r * c - r * ratio * tilt_slope / 2),
            (r * c / 2, -r * s / 2),
            (-ratio * c / q, ratio * s / q - ratio**3 * s * c**2 / q**3),
            (-r * s - r * ratio * tilt, -r * c - r * ratio * tilt_slope),
        )

    @property
    def _masses(self) -> tuple[float, ...]:
        return self.rod_mass, self.rod_mass, self.rod_mass * self.rod**2 / 12, self.piston_mass

    def inertia(self, theta: Any) -> Any:
        """Return J."""
        moving = sum(m * first**2 for m, (first, _) in zip(self._masses, self._slopes(theta), strict=True))
        return self.crank_mass * self.crank**2 / 3 + moving

    def inertia_slope(self, theta: Any) -> Any:
        """Return J'."""
        return 2 * sum(m * first * second for m, (first, second) in zip(self._masses, self._slopes(theta), strict=True))

    def from_rest(self, t: float, torque: float) -> tuple[float, float]:
        """Return θ and θ̇ at t under a constant torque, from rest at θ = 0.

        Derived here: ½ J θ̇² = M θ, and with θ = y² the time is ∫ √(2 J(y²)/M) dy, which Newton's method inverts.
        """
        y = t / np.sqrt(2 * self.inertia(np.pi / 4) / torque)
        for _ in range(50):
            step = (t - self._time(y, torque)) / np.sqrt(2 * self.inertia(y**2) / torque)
            y += step
            if abs(step) <= 4 * np.finfo(float).eps * y:
                break
        return float(y**2), float(y * np.sqrt(2 * torque / self.inertia(y**2)))

    def _time(self, y: float, torque: float) -> float:
        # A panel holds a tenth of a turn of θ at most, on which 12 nodes leave nothing above rounding.
        nodes, weights = np.polynomial.legendre.leggauss(12)
        edges = np.linspace(0, y, 2 + int(4 * y * y))
        half = np.diff(edges) / 2
        at = edges[:-1, None] + half[:, None] * (1 + nodes)
        return float(half @ (np.sqrt(2 * self.inertia(at**2) / torque) @ weights))


# --------------------------------------------------------------------------------------
# Kepler


@dataclass(frozen=True)
class Kepler:
    """An ellipse about a fixed centre, V = -k m/r: semi-major axis a, eccentricity e < 1, apse and its time.

    Landau, Lifshitz 1976, §15: r = a (1 - e cos E), t - t₀ = √(a³/k) (E - e sin E), and from the apse
    tan(ν/2) = √((1 + e)/(1 - e)) tan(E/2).
    """

    k: float
    semi_major: float
    eccentricity: float
    apse: float = 0.0
    passage: float = 0.0

    @classmethod
    def of(cls, k: float, r: float, phi: float, radial: float, turning: float) -> Kepler:
        """Take r, φ, ṙ and φ̇ > 0 at t = 0.

        e cos ν = l²/(k r) - 1 and e sin ν = l ṙ/k with l = r² φ̇; 1/a = 2/r - v²/k.
        """
        momentum = r**2 * turning
        if momentum <= 0:
            raise ValueError(f"turning: expected a positive angular velocity, got {turning}")
        inverse = 2 / r - (radial**2 + (r * turning) ** 2) / k
        if inverse <= 0:
            raise ValueError("expected a bound orbit, got one of energy at least zero")
        x, y = momentum**2 / (k * r) - 1, momentum * radial / k
        e, nu = float(np.hypot(x, y)), float(np.arctan2(y, x))
        orbit = cls(k, 1 / inverse, e, phi - nu)
        anomaly = 2 * np.arctan2(np.sqrt(1 - e) * np.sin(nu / 2), np.sqrt(1 + e) * np.cos(nu / 2))
        return cls(k, 1 / inverse, e, phi - nu, -float(anomaly - e * np.sin(anomaly)) / orbit.rate)

    @property
    def rate(self) -> float:
        """Mean motion 2 π/period."""
        return float(np.sqrt(self.k / self.semi_major**3))

    @property
    def period(self) -> float:
        return float(2 * np.pi / self.rate)

    @property
    def momentum(self) -> float:
        """r² φ̇, √(k a (1 - e²))."""
        return float(np.sqrt(self.k * self.semi_major * (1 - self.eccentricity) * (1 + self.eccentricity)))

    @property
    def energy(self) -> float:
        """Of a unit mass, -k/(2 a)."""
        return -self.k / (2 * self.semi_major)

    def radial_acceleration(self, r: Any) -> Any:
        """Return r̈ = l²/r³ - k/r², the motion in one dimension that Routh's reduction leaves."""
        return self.momentum**2 / r**3 - self.k / r**2

    def effective_potential(self, r: Any) -> Any:
        """Return l²/(2 r²) - k/r of a unit mass."""
        return self.momentum**2 / (2 * r**2) - self.k / r

    def anomaly(self, t: Any) -> Any:
        """Return E, with its turns, by Newton's method on Kepler's equation."""
        e, mean = self.eccentricity, self.rate * (np.asarray(t, dtype=float) - self.passage)
        turns = 2 * np.pi * np.round(mean / (2 * np.pi))
        rest = mean - turns
        # From E = ±π Newton descends on the convex side, whatever e is.
        E = np.where(rest == 0, 0.0, np.copysign(np.pi, rest))
        for _ in range(60):
            E = E - (E - e * np.sin(E) - rest) / (1 - e * np.cos(E))
        return E + turns

    def at(self, t: Any) -> tuple[Array, Array]:
        """Return (r, φ) and (ṙ, φ̇), last axis; φ counts its turns."""
        e, E = self.eccentricity, self.anomaly(t)
        r = self.semi_major * (1 - e * np.cos(E))
        # ν - E lies within half a turn, so ν keeps the turns of E.
        b = e / (1 + np.sqrt(1 - e**2))
        nu = E + 2 * np.arctan2(b * np.sin(E), 1 - b * np.cos(E))
        radial = np.sqrt(self.k * self.semi_major) * e * np.sin(E) / r
        return np.stack([r, self.apse + nu], axis=-1), np.stack([radial, self.momentum / r**2], axis=-1)


# --------------------------------------------------------------------------------------
# Driven systems


@dataclass(frozen=True)
class BeadOnHoop:
    """A bead on a hoop of radius R that is turned about its vertical diameter at Ω; θ from the bottom.

    Taylor 2005, Classical Mechanics, example 7.6: θ̈ = (Ω² cos θ - g/R) sin θ. T₂ = ½ m R² θ̇², T₁ = 0,
    T₀ = ½ m R² Ω² sin² θ; T₂ - T₀ + V is conserved and is not the energy.
    """

    radius: float = 1.0
    spin: float = 4.0
    mass: float = 1.0
    g: float = 9.81

    @property
    def threshold(self) -> float:
        """Return the Ω = √(g/R) above which the bead leaves the bottom."""
        return float(np.sqrt(self.g / self.radius))

    def acceleration(self, theta: Any) -> Any:
        return (self.spin**2 * np.cos(theta) - self.g / self.radius) * np.sin(theta)

    def kinetic_split(self, theta: Any, speed: Any) -> tuple[Any, Any, Any]:
        """Return T₂, T₁ and T₀."""
        scale = self.mass * self.radius**2 / 2
        return scale * speed**2, 0 * theta, scale * self.spin**2 * np.sin(theta) ** 2

    def jacobi_integral(self, theta: Any, speed: Any) -> Any:
        """Return T₂ - T₀ + V."""
        two, _, zero = self.kinetic_split(theta, speed)
        return two - zero - self.mass * self.g * self.radius * np.cos(theta)

    def equilibria(self) -> tuple[tuple[float, float], ...]:
        """Return each θ in (-π, π] with ω² of small oscillations about it, below zero where it is unstable."""
        w2, slow = self.spin**2, self.g / self.radius
        found = [(0.0, slow - w2), (np.pi, -slow - w2)]
        if w2 > slow:
            aside = float(np.arccos(slow / w2))
            found += [(aside, w2 * np.sin(aside) ** 2), (-aside, w2 * np.sin(aside) ** 2)]
        return tuple(found)


@dataclass(frozen=True)
class Kapitza:
    """A pendulum of length l whose pivot moves up and down as a cos Ωt; θ from down.

    Landau, Lifshitz 1976, §30: θ̈ = -(g - a Ω² cos Ωt) sin θ/l. With the pivot's velocity u = -a Ω sin Ωt,
    T₂ = ½ m l² θ̇², T₁ = m l u θ̇ sin θ, T₀ = ½ m u². The average over fast and small shaking moves in the
    potential -m g l cos θ + ¼ m a² Ω² sin² θ, in which the upright stays for a² Ω² > 2 g l.
    """

    length: float = 1.0
    amplitude: float = 0.05
    frequency: float = 150.0
    mass: float = 1.0
    g: float = 9.81

    def pivot(self, t: Any) -> tuple[Any, Any, Any]:
        """Return the pivot's height, velocity and acceleration."""
        phase, a, w = self.frequency * t, self.amplitude, self.frequency
        return a * np.cos(phase), -a * w * np.sin(phase), -a * w**2 * np.cos(phase)

    def acceleration(self, t: Any, theta: Any) -> Any:
        return -(self.g + self.pivot(t)[2]) * np.sin(theta) / self.length

    def kinetic_split(self, t: Any, theta: Any, speed: Any) -> tuple[Any, Any, Any]:
        """Return T₂, T₁ and T₀."""
        u, m, ell = self.pivot(t)[1], self.mass, self.length
        return m * (ell * speed) ** 2 / 2, m * ell * u * speed * np.sin(theta), m * u**2 / 2

    def effective_potential(self, theta: Any) -> Any:
        shaken = self.mass * (self.amplitude * self.frequency) ** 2 / 4 * np.sin(theta) ** 2
        return shaken - self.mass * self.g * self.length * np.cos(theta)

    @property
    def upright_is_stable(self) -> bool:
        """Say so of the averaged motion."""
        return (self.amplitude * self.frequency) ** 2 > 2 * self.g * self.length

    @property
    def upright_square(self) -> float:
        """ω² of slow oscillations about the upright, a² Ω²/(2 l²) - g/l."""
        return (self.amplitude * self.frequency / self.length) ** 2 / 2 - self.g / self.length
