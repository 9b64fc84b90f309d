"""Closed forms of the catalog's systems, written apart from mbkit.

Nothing here imports mbkit. Each system is a `System` of plain functions of one
state; the terms are those of M(q) v̇ + c(q, v) + g(q) = τ, copied from textbooks
and papers (named at each function), and the energies are written from positions
and velocities of the masses, so that T = ½ vᵀ M v is a check and no definition.
Conventions: angles from the downward vertical, growing towards +x; quaternions
x, y, z, w; velocities of rotations in body axes; SI units.

Also here: solutions in Jacobi's elliptic functions in double, for many times at once
(``elliptic`` has them with 30 digits, and more of them), and `published`, the figures of
``published.json``.
"""

# One signature serves every system, whether a term depends on q or not.
# ruff: noqa: ARG001, ARG005

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import ellipj, ellipk, ellipkinc, ellipkm1

Array = NDArray[np.float64]


@cache
def published() -> dict[str, Any]:
    """Return the published and exact figures of ``published.json``."""
    found: dict[str, Any] = json.loads((Path(__file__).parent / "published.json").read_text(encoding="utf-8"))
    return found


@dataclass(frozen=True)
class System:
    """The terms of one system as functions of a single state."""

    mass_matrix: Callable[[Array], Array]
    velocity_force: Callable[[Array, Array], Array]
    gravity: Callable[[Array], Array]
    kinetic_energy: Callable[[Array, Array], float]
    potential_energy: Callable[[Array], float]

    def nle(self, q: Array, v: Array) -> Array:
        """Return c(q, v) + g(q)."""
        return np.asarray(self.velocity_force(q, v) + self.gravity(q))

    def forward_dynamics(self, q: Array, v: Array, tau: Array) -> Array:
        """Return v̇."""
        return np.asarray(np.linalg.solve(self.mass_matrix(q), tau - self.nle(q, v)))

    def energy(self, q: Array, v: Array) -> float:
        """Return T + V."""
        return self.kinetic_energy(q, v) + self.potential_energy(q)


def pendulum(length: float = 1.0, mass: float = 1.0, g: float = 9.81) -> System:
    """Return the mathematical pendulum (Landau, Lifshitz 1976, §11)."""
    return System(
        mass_matrix=lambda q: np.array([[mass * length**2]]),
        velocity_force=lambda q, v: np.zeros(1),
        gravity=lambda q: np.array([mass * g * length * np.sin(q[0])]),
        kinetic_energy=lambda q, v: float(mass * (length * v[0]) ** 2 / 2),
        potential_energy=lambda q: float(-mass * g * length * np.cos(q[0])),
    )


def double_pendulum(
    length1: float = 1.0, mass1: float = 1.0, length2: float = 1.0, mass2: float = 1.0, g: float = 9.81
) -> System:
    """Return the double pendulum of point masses, second angle from the first rod.

    Spong, Hutchinson, Vidyasagar 2006, Robot Modeling and Control, ch. 7, planar
    elbow manipulator, with the masses at the ends.
    """
    l1, l2, m1, m2 = length1, length2, mass1, mass2

    def mass_matrix(q: Array) -> Array:
        coupling = m2 * l2**2 + m2 * l1 * l2 * np.cos(q[1])
        first = (m1 + m2) * l1**2 + m2 * l2**2 + 2 * m2 * l1 * l2 * np.cos(q[1])
        return np.array([[first, coupling], [coupling, m2 * l2**2]])

    def velocity_force(q: Array, v: Array) -> Array:
        h = m2 * l1 * l2 * np.sin(q[1])
        return np.array([-h * (2 * v[0] * v[1] + v[1] ** 2), h * v[0] ** 2])

    def gravity(q: Array) -> Array:
        second = m2 * g * l2 * np.sin(q[0] + q[1])
        return np.array([(m1 + m2) * g * l1 * np.sin(q[0]) + second, second])

    def kinetic_energy(q: Array, v: Array) -> float:
        a, b = q[0], q[0] + q[1]
        first = l1 * v[0] * np.array([np.cos(a), np.sin(a)])
        second = first + l2 * (v[0] + v[1]) * np.array([np.cos(b), np.sin(b)])
        return float(m1 * first @ first / 2 + m2 * second @ second / 2)

    def potential_energy(q: Array) -> float:
        z1 = -l1 * np.cos(q[0])
        return float(m1 * g * z1 + m2 * g * (z1 - l2 * np.cos(q[0] + q[1])))

    return System(mass_matrix, velocity_force, gravity, kinetic_energy, potential_energy)


def cart_pole(cart_mass: float = 1.0, pole_mass: float = 1.0, length: float = 1.0, g: float = 9.81) -> System:
    """Return the cart-pole (Tedrake, Underactuated Robotics, ch. 3.2.1)."""
    M, m, ell = cart_mass, pole_mass, length

    def mass_matrix(q: Array) -> Array:
        coupling = m * ell * np.cos(q[1])
        return np.array([[M + m, coupling], [coupling, m * ell**2]])

    def kinetic_energy(q: Array, v: Array) -> float:
        mass = np.array([v[0] + ell * v[1] * np.cos(q[1]), ell * v[1] * np.sin(q[1])])
        return float(M * v[0] ** 2 / 2 + m * mass @ mass / 2)

    return System(
        mass_matrix,
        velocity_force=lambda q, v: np.array([-m * ell * np.sin(q[1]) * v[1] ** 2, 0.0]),
        gravity=lambda q: np.array([0.0, m * g * ell * np.sin(q[1])]),
        kinetic_energy=kinetic_energy,
        potential_energy=lambda q: float(-m * g * ell * np.cos(q[1])),
    )


def spherical_pendulum(length: float = 1.0, mass: float = 1.0, g: float = 9.81) -> System:
    """Return the spherical pendulum, its mass at length (sin α cos β, sin β, -cos α cos β).

    Landau, Lifshitz 1976, §14, with the sphere's axis laid along y: β is the latitude.
    """
    inertia = mass * length**2

    def velocity_force(q: Array, v: Array) -> Array:
        h = inertia * np.sin(q[1]) * np.cos(q[1])
        return np.array([-2 * h * v[0] * v[1], h * v[0] ** 2])

    def kinetic_energy(q: Array, v: Array) -> float:
        (a, b), (va, vb) = q, v
        x = np.cos(a) * np.cos(b) * va - np.sin(a) * np.sin(b) * vb
        z = np.sin(a) * np.cos(b) * va + np.cos(a) * np.sin(b) * vb
        return float(inertia * (x**2 + (np.cos(b) * vb) ** 2 + z**2) / 2)

    return System(
        mass_matrix=lambda q: inertia * np.diag([np.cos(q[1]) ** 2, 1.0]),
        velocity_force=velocity_force,
        gravity=lambda q: mass * g * length * np.array([np.sin(q[0]) * np.cos(q[1]), np.cos(q[0]) * np.sin(q[1])]),
        kinetic_energy=kinetic_energy,
        potential_energy=lambda q: float(-mass * g * length * np.cos(q[0]) * np.cos(q[1])),
    )


def chain(n: int = 5, length: float = 1.0, mass: float = 1.0, g: float = 9.81) -> System:
    """Return the planar chain of n thin rods, relative angles.

    In angles φ from the vertical, a Lagrangian exercise: with a_ij the sum over the
    rods k of m L² f_ki f_kj, where f is 1 above rod k and ½ on it, and rods of
    inertia m L²/12, T = ½ Σ a_ij cos(φ_i - φ_j) φ̇_i φ̇_j. Relative angles follow from φ = S q.
    """
    level = np.arange(n)
    below = n - 1 - level
    high = np.maximum.outer(level, level)
    a = mass * length**2 * (0.5 + (n - 1 - high))
    a[np.diag_indices(n)] = mass * length**2 * (1 / 3 + below)
    weight = mass * g * length * (0.5 + below)
    S = np.tril(np.ones((n, n)))

    def mass_matrix(q: Array) -> Array:
        phi = S @ q
        return np.asarray(S.T @ (a * np.cos(np.subtract.outer(phi, phi))) @ S)

    def velocity_force(q: Array, v: Array) -> Array:
        phi, rate = S @ q, S @ v
        return np.asarray(S.T @ ((a * np.sin(np.subtract.outer(phi, phi))) @ rate**2))

    def kinetic_energy(q: Array, v: Array) -> float:
        phi, rate = S @ q, S @ v
        out, joint = 0.0, np.zeros(2)
        for angle, spin in zip(phi, rate, strict=True):
            along = length * spin * np.array([np.cos(angle), np.sin(angle)])
            centre = joint + along / 2
            out += mass * centre @ centre / 2 + mass * length**2 / 12 * spin**2 / 2
            joint = joint + along
        return float(out)

    return System(
        mass_matrix,
        velocity_force,
        gravity=lambda q: np.asarray(S.T @ (weight * np.sin(S @ q))),
        kinetic_energy=kinetic_energy,
        potential_energy=lambda q: float(-weight @ np.cos(S @ q)),
    )


def heavy_top(
    mass: float = 15.0,
    inertia: tuple[float, float, float] = (0.234375, 0.46875, 0.234375),
    com: tuple[float, float, float] = (0.0, 1.0, 0.0),
    g: float = 9.81,
) -> System:
    """Return the heavy top: J ω̇ + ω × J ω = m r × Rᵀ(0, 0, -g), J about the fixed point.

    Euler and Poisson; Terze, Müller, Zlatar 2016 for the default values.
    """
    r = np.array(com, dtype=float)
    J = np.diag(inertia) + mass * (r @ r * np.eye(3) - np.outer(r, r))  # Steiner

    def weight(q: Array) -> Array:
        return np.asarray(Rotation.from_quat(q).inv().apply([0.0, 0.0, -mass * g]))

    def kinetic_energy(q: Array, v: Array) -> float:
        velocity = np.cross(v, r)
        return float(mass * velocity @ velocity / 2 + v @ np.diag(inertia) @ v / 2)

    return System(
        mass_matrix=lambda q: J,
        velocity_force=lambda q, v: np.cross(v, J @ v),
        gravity=lambda q: -np.cross(r, weight(q)),
        kinetic_energy=kinetic_energy,
        potential_energy=lambda q: float(mass * g * Rotation.from_quat(q).apply(r)[2]),
    )


def free_body(mass: float = 10.0, sides: tuple[float, float, float] = (0.1, 0.4, 0.9), g: float = 0.0) -> System:
    """Return the free box: Newton's equation in body axes, v̇ + ω × v, and Euler's."""
    inertia = np.diag(box_inertia(mass, sides))
    M = np.zeros((6, 6))
    M[:3, :3], M[3:, 3:] = mass * np.eye(3), inertia

    def gravity(q: Array) -> Array:
        return np.concatenate([Rotation.from_quat(q[3:]).inv().apply([0.0, 0.0, mass * g]), np.zeros(3)])

    def velocity_force(q: Array, v: Array) -> Array:
        return np.concatenate([mass * np.cross(v[3:], v[:3]), np.cross(v[3:], inertia @ v[3:])])

    return System(
        mass_matrix=lambda q: M,
        velocity_force=velocity_force,
        gravity=gravity,
        kinetic_energy=lambda q, v: float(mass * v[:3] @ v[:3] / 2 + v[3:] @ inertia @ v[3:] / 2),
        potential_energy=lambda q: float(mass * g * q[2]),
    )


def box_inertia(mass: float, sides: tuple[float, float, float]) -> Array:
    """Return the principal moments of a homogeneous box."""
    a, b, c = sides
    return mass / 12 * np.array([b**2 + c**2, a**2 + c**2, a**2 + b**2])


def pendulum_solution(t: Array, amplitude: float, length: float = 1.0, g: float = 9.81) -> tuple[Array, Array]:
    """Return θ and θ̇ of a pendulum let go at θ = amplitude.

    sin(θ/2) = k cd(ω₀ t | k²), k = sin(amplitude/2) (Abramowitz, Stegun 1964, ch. 16;
    Landau, Lifshitz 1976, §11).
    """
    k, rate = np.sin(amplitude / 2), np.sqrt(g / length)
    sn, cn, dn, _ = ellipj(rate * t, k * k)
    theta = 2 * np.arcsin(k * cn / dn)
    speed = -2 * k * rate * np.sqrt(1 - k * k) * sn / dn
    return theta, speed


def pendulum_period(amplitude: float, length: float = 1.0, g: float = 9.81) -> float:
    """Return 4 K(k²)/ω₀."""
    return float(4 * ellipk(np.sin(amplitude / 2) ** 2) / np.sqrt(g / length))


def free_spin(t: Array, inertia: Array, w0: Array) -> tuple[Array, float]:
    """Return the angular velocity of a torque-free body, (K, 3) in body axes, and its period.

    Landau, Lifshitz 1976, §37, for three different moments and a body that turns
    about none of its axes.
    """
    order = np.argsort(inertia)
    # L² - 2 E X for a moment X, without the cancellation of the two terms.
    excess = {int(i): float(sum(inertia * (inertia - inertia[i]) * w0**2)) for i in order}
    if excess[order[1]] < 0:
        order = order[::-1]
    A, B, C = inertia[order]
    x, y, z = w0[order]
    low, middle, high = (excess[i] for i in order)
    a = np.sqrt(-high / (A * (C - A)))
    b = np.sqrt(-high / (B * (C - B)))
    c = np.sqrt(low / (C * (C - A)))
    rate = np.sqrt((C - B) * low / (A * B * C))
    # The period depends on 1 - m, which is small near the separatrix.
    complement = (C - A) * middle / ((C - B) * low)
    m = 1 - complement
    side = np.sign(z)
    start = ellipkinc(np.arctan2(y / b, side * x / a), m)
    # Euler's equations run backwards in a mirrored frame (an odd order of the axes), and
    # again where the moments fall instead of rise.
    sense = np.linalg.det(np.eye(3)[order]) * np.sign(C - A)
    sn, cn, dn, _ = ellipj(sense * rate * t + start, m)
    out = np.empty((len(t), 3))
    out[:, order] = np.stack([side * a * cn, b * sn, side * c * dn], axis=-1)
    return out, float(4 * ellipkm1(complement) / rate)


def epicyclic_train(
    teeth: tuple[float, float], inertias: tuple[float, float, float], planets: tuple[int, float], torque: Array
) -> tuple[Array, float]:
    """Return the accelerations of sun, carrier and ring, rad/s², and the torque of the gears on the ring, N m.

    Of sun and ring the teeth z_s and z_r are given, of sun, carrier (with the planets' masses) and ring the moments of
    inertia, kg m², and of the planets the number and the moment of inertia of each. Willis's equation
    (w_s - w_c)/(w_r - w_c) = -z_r/z_s puts the ring in terms of the sun and the carrier, w_r = (1 + k) w_c - k w_s with
    k = z_s/z_r, and a planet, z_p = (z_r - z_s)/2, turns with w_p = (1 + j) w_c - j w_s, j = z_s/z_p. Lagrange's
    equations of w_s and w_c are then two linear ones.
    """
    (z_s, z_r), (I_s, I_c, I_r), (n, I_p), (T_s, T_c, T_r) = teeth, inertias, planets, torque
    k, j = z_s / z_r, 2 * z_s / (z_r - z_s)
    a = I_s + k**2 * I_r + n * j**2 * I_p
    b = -k * (1 + k) * I_r - n * j * (1 + j) * I_p
    c = I_c + (1 + k) ** 2 * I_r + n * (1 + j) ** 2 * I_p
    p, q = T_s - k * T_r, T_c + (1 + k) * T_r
    sun, carrier = (c * p - b * q) / (a * c - b**2), (a * q - b * p) / (a * c - b**2)
    ring = (1 + k) * carrier - k * sun
    return np.array([sun, carrier, ring]), I_r * ring - T_r


def differential(wheel: float, ring: float, torque: Array) -> Array:
    """Return the accelerations of left wheel, right wheel and ring gear of a car's differential, rad/s².

    w_ring = (w_left + w_right)/2: the ring's torque is shared by halves, and the difference of the wheels' rates feels
    their moments of inertia, kg m², alone.
    """
    left, right, gear = torque
    total, apart = (left + right + gear) / (wheel + ring / 2), (left - right) / wheel
    return np.array([(total + apart) / 2, (total - apart) / 2, total / 2])


def light_cart_pole_cart(theta: Array, theta0: float, cart_mass: float, pole_mass: float, length: float) -> Array:
    """Return the cart's position from the pole's angle, from rest at x = 0: momentum along x stays zero."""
    return np.asarray(pole_mass * length * (np.sin(theta0) - np.sin(theta)) / (cart_mass + pole_mass))
