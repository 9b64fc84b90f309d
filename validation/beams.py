"""Strings and beams from their textbooks' frequency equations and power series, in 40 digits: nothing of mbkit.

Frequencies are roots of determinants of exact solutions; the spin-up of a beam is integrated from the equation that
Kane, Ryan and Banerjee (1987) give for each mode, with integrals by quadrature.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import mpmath
import numpy as np
from scipy.integrate import solve_ivp

mp: Final = mpmath.MPContext()
mp.dps = 40
#: The beam that papers on spin-up take: length m, EI N m², mass a metre kg/m; full speed rad/s after so many s.
LENGTH, EI, DENSITY, SPEED, RISE = 10.0, 1.4e4, 1.2, 6.0, 15.0


def roots(f: Callable[[Any], Any], count: int, step: float, start: float = 1e-3) -> list[Any]:
    """Return the first roots of a function, each between two places of a grid at which its signs differ."""
    out, x, before = [], mp.mpf(start), f(mp.mpf(start))
    while len(out) < count:
        after = f(x + step)
        if before * after < 0:
            out.append(mp.findroot(f, (x, x + step), solver="anderson", tol=1e-60, verify=False))
        x, before = x + step, after
    return out


# Frequencies in rad/s


def string(tension: float, density: float, length: float, mass: float, count: int) -> list[Any]:
    """Of a string with a mass at its end, which slides across: β L tan β L = ρ L/m (Meirovitch 2001, ch. 8.6)."""
    P, rho, L, m = map(mp.mpf, (tension, density, length, mass))
    found = roots(lambda y: rho * L * mp.cos(y) - m * y * mp.sin(y), count, 0.3)
    return [y / L * mp.sqrt(P / rho) for y in found]


def cantilever(stiffness: float, density: float, length: float, mass: float, inertia: float, count: int) -> list[Any]:
    """Of an Euler-Bernoulli beam with a body at its end (Meirovitch 2001, ch. 8.6; Gürgöze 1996)."""
    E, rho, L, m, J = map(mp.mpf, (stiffness, density, length, mass, inertia))

    def determinant(y: Any) -> Any:
        b, c, s, C, S = y / L, mp.cos(y), mp.sin(y), mp.cosh(y), mp.sinh(y)
        square = E / rho * b**4
        # w = A (cosh - cos) + B (sinh - sin): EI w'' = ω² J w', EI w''' = -ω² m w at the end.
        first = [E * b**2 * (C + c) - square * J * b * (S + s), E * b**2 * (S + s) - square * J * b * (C - c)]
        second = [E * b**3 * (S - s) + square * m * (C - c), E * b**3 * (C + c) + square * m * (S - s)]
        return (first[0] * second[1] - first[1] * second[0]) / C

    return [(y / L) ** 2 * mp.sqrt(E / rho) for y in roots(determinant, count, 0.3)]


def timoshenko(
    bending: float,
    shear: float,
    density: float,
    rotary: float,
    length: float,
    mass: float,
    inertia: float,
    count: int,
    step: float,
) -> list[Any]:
    """Of a Timoshenko beam with a body at its end: EI, k G A, ρ A, ρ I (Han, Benaroya, Wei 1999, sec. 6).

    The four solutions are exponentials exp(z x), with the roots z of the characteristic polynomial.
    """
    E, K, r, R, L, m, J = map(mp.mpf, (bending, shear, density, rotary, length, mass, inertia))

    def determinant(w: Any) -> Any:
        # K (w'' - ψ') + ρA ω² w = 0 and EI ψ'' + K (w' - ψ) + ρI ω² ψ = 0.
        p = E * r * w**2 / K + R * w**2
        q = r * w**2 * (R * w**2 / K - 1)
        squares = [(-p + sign * mp.sqrt(p**2 - 4 * E * q)) / (2 * E) for sign in (1, -1)]
        # Real solutions, even and odd.
        columns = []
        for z2 in squares:
            z = mp.sqrt(mp.fabs(z2))
            slope = (K * z2 + r * w**2) / (K * z)
            if z2 > 0:
                even, odd = (mp.cosh, mp.sinh), (mp.sinh, mp.cosh)
                turn = slope, slope
            else:
                even, odd = (mp.cos, mp.sin), (mp.sin, mp.cos)
                # ψ' = w'' + ρA ω²/K w.
                turn = slope, -slope
            for (f, g), k, odd_one in ((even, turn[0], False), (odd, turn[1], True)):
                sign = -1 if z2 < 0 and not odd_one else 1
                columns.append(
                    (
                        lambda x, f=f, z=z: f(z * x),
                        lambda x, g=g, z=z, sign=sign: sign * z * g(z * x),
                        lambda x, g=g, z=z, k=k: k * g(z * x),
                        lambda x, f=f, z2=z2: (z2 + r * w**2 / K) * f(mp.sqrt(mp.fabs(z2)) * x),
                    )
                )
        rows = [
            [v(mp.mpf(0)) for v, _, _, _ in columns],
            [psi(mp.mpf(0)) for _, _, psi, _ in columns],
            [K * (dv(L) - psi(L)) - m * w**2 * v(L) for v, dv, psi, _ in columns],
            [E * dpsi(L) - J * w**2 * psi(L) for _, _, psi, dpsi in columns],
        ]
        return mp.det(mp.matrix(rows))

    return roots(determinant, count, step)


def rotating(stiffness: float, density: float, length: float, speed: float, count: int, step: float) -> list[Any]:
    """Out of the plane in which a beam turns: EI w'''' - (½ ρ Ω² (L² - x²) w')' = ρ ω² w, by its power series.

    Wright, Smith, Thresher, Wang 1982, Vibration modes of centrifugally stiffened beams.
    """
    E, rho, L, Om = map(mp.mpf, (stiffness, density, length, speed))
    eta, terms = rho * Om**2 * L**4 / E, 160

    def solution(first: int, mu: Any) -> tuple[Any, Any]:
        """Return w'' and w''' at ξ = 1 of the solution that begins with ξ^first."""
        a = [mp.mpf(0)] * terms
        a[first] = mp.mpf(1)
        for n in range(terms - 4):
            # (½ η (1 - ξ²) w')' has ½ η ((n + 2) (n + 1) a[n + 2] - n (n + 1) a[n]) at ξⁿ.
            pull = eta / 2 * ((n + 2) * (n + 1) * a[n + 2] - n * (n + 1) * a[n])
            a[n + 4] = (pull + mu * a[n]) / ((n + 4) * (n + 3) * (n + 2) * (n + 1))
        second = mp.fsum(k * (k - 1) * a[k] for k in range(terms))
        return second, mp.fsum(k * (k - 1) * (k - 2) * a[k] for k in range(terms))

    def determinant(w: Any) -> Any:
        mu = rho * w**2 * L**4 / E
        one, other = solution(2, mu), solution(3, mu)
        return one[0] * other[1] - one[1] * other[0]

    return roots(determinant, count, step)


# Spin-up in the plane


def angle(t: Any, module: Any = np, speed: float = SPEED) -> tuple[Any, Any, Any]:
    """Return θ, its rate and its acceleration: Ω (t/T - sin(2π t/T)/(2π)) until T, then Ω."""
    c = 2 * np.pi / RISE
    rate = speed / RISE * (t - module.sin(c * t) / c)
    return speed / RISE * (t**2 / 2 + (module.cos(c * t) - 1) / c**2), rate, speed / RISE * (1 - module.cos(c * t))


def spin_up(count: int, times: np.ndarray, *, stiffening: bool = True, speed: float = SPEED) -> np.ndarray:
    """Return the deflection of the tip, m, at times up to the end of the rise, by Kane's equation of each mode."""
    modes = []
    for k in range(count):
        y = mp.findroot(lambda y: mp.cos(y) + 1 / mp.cosh(y), (k + mp.mpf(1) / 2) * mp.pi)
        modes.append((y, (mp.cosh(y) + mp.cos(y)) / (mp.sinh(y) + mp.sin(y))))

    def phi(k: int, x: Any) -> Any:
        y, s = modes[k]
        return mp.cosh(y * x) - mp.cos(y * x) - s * (mp.sinh(y * x) - mp.sin(y * x))

    def slope(k: int, x: Any) -> Any:
        y, s = modes[k]
        return y * (mp.sinh(y * x) + mp.sin(y * x) - s * (mp.cosh(y * x) - mp.cos(y * x)))

    places = mp.linspace(0, 1, 5)
    moment = np.array([float(mp.quad(lambda x, k=k: x * phi(k, x), places)) for k in range(count)]) * LENGTH
    stiffer = np.zeros((count, count))
    for i in range(count if stiffening else 0):
        for j in range(i + 1):
            value = mp.quad(lambda x, i=i, j=j: (1 - x**2) / 2 * slope(i, x) * slope(j, x), places)
            stiffer[i, j] = stiffer[j, i] = float(value)
    K = np.diag([float(y**4) for y, _ in modes]) * EI / (DENSITY * LENGTH**4)

    def rates(t: float, z: np.ndarray) -> np.ndarray:
        a, v = z[:count], z[count:]
        _, w, dw = angle(t, speed=speed)
        return np.concatenate([v, -K @ a - w**2 * (stiffer - np.eye(count)) @ a - dw * moment])

    run = solve_ivp(rates, (0, times[-1]), np.zeros(2 * count), method="DOP853", t_eval=times, rtol=1e-12, atol=1e-14)
    return run.y[:count].T @ np.array([float(phi(k, mp.mpf(1))) for k in range(count)])
