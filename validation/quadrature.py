"""Motions of one coordinate by quadrature, exact to rounding, written apart from mbkit.

Nothing here imports mbkit. A coordinate x that swings between two turning points in
½ m(x) ẋ² + U(x) = E has its time as an integral (Landau, Lifshitz 1976, Mechanics, §11). So has each
system of more coordinates that are cyclic but for one, by Routh's reduction (ibid., §14 and §15 for two of
them), and what those coordinates gather on the way.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mpmath as mp
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.fft import dct

Array = NDArray[np.float64]
#: Of x, in mpmath's functions.
Function = Callable[[Any], Any]

DIGITS = 40
#: Nodes at which an integral must have converged.
_MOST = 1024


@dataclass(frozen=True)
class Swing:
    """x between two turning points, from x = `start` with ẋ = `speed`, which is not zero.

    With x = (x₁ + x₂)/2 - (x₂ - x₁)/2 cos u the roots at the ends go: dt/du = √(m (x - x₁)(x₂ - x)/(2 (E - U))) is an
    analytic, even and periodic function of u, so that its cosine series converges as a geometric one, from values
    of 40 digits. t(u) is its integral term by term, and Newton's method inverts it.
    """

    inertia: Function
    potential: Function
    start: float
    speed: float

    def at(self, t: ArrayLike) -> tuple[Array, Array]:
        """Return x and ẋ, (K,) each."""
        u = self._angle(t)
        middle, half = (float(x) for x in self._span)
        return middle - half * np.cos(u), half * np.sin(u) / _cosines(self._slope, u)

    @property
    def period(self) -> float:
        return float(2 * np.pi * self._slope[0])

    def gathered(self, t: ArrayLike, rate: Function, along: Function | None = None) -> Array:
        """Return ∫ (rate(x) + along(x) ẋ) dt since the start, (K,)."""
        u, start = self._angle(t), np.array([self._start])
        of = self._series(lambda x: rate(x) * self._stretch(x))
        out = _sines(of, u) - _sines(of, start)
        if along is not None:
            of = self._series(along) * float(self._span[1])
            out = out + _across(of, u) - _across(of, start)
        return np.asarray(out)

    def _angle(self, t: ArrayLike) -> Array:
        """Return u, with its turns."""
        target = np.atleast_1d(np.asarray(t, dtype=float)) + _sines(self._slope, np.array([self._start]))
        u = target / self._slope[0]
        for _ in range(50):
            step = (target - _sines(self._slope, u)) / _cosines(self._slope, u)
            u = u + step
            if np.abs(step).max() <= 4 * np.finfo(float).eps * max(1.0, np.abs(u).max()):
                break
        return np.asarray(u)

    def _free(self, x: Any) -> Any:
        """Return E - U(x)."""
        x0 = mp.mpf(self.start)
        return self.inertia(x0) * mp.mpf(self.speed) ** 2 / 2 + self.potential(x0) - self.potential(x)

    @cached_property
    def _turns(self) -> tuple[Any, Any]:
        """Turning points, found by steps of a fiftieth outwards."""
        if not self.speed:
            raise ValueError("speed: expected a start that moves, got 0")
        with mp.workdps(DIGITS):
            return self._turn(-1), self._turn(1)

    def _turn(self, sense: int) -> Any:
        step, x = mp.mpf(sense) / 50, mp.mpf(self.start)
        for _ in range(1000):
            if self._free(x + step) <= 0:
                return mp.findroot(self._free, (x, x + step), solver="anderson", tol=mp.mpf(10) ** (3 - 2 * DIGITS))
            x += step
        raise ValueError(f"start: expected a motion that turns round, got one that goes on beyond {float(x)}")

    @property
    def _span(self) -> tuple[Any, Any]:
        low, high = self._turns
        return (low + high) / 2, (high - low) / 2

    def _stretch(self, x: Any) -> Any:
        """Return dt/du."""
        low, high = self._turns
        return mp.sqrt(self.inertia(x) * (x - low) * (high - x) / (2 * self._free(x)))

    @cached_property
    def _slope(self) -> Array:
        return self._series(self._stretch)

    @cached_property
    def _start(self) -> float:
        with mp.workdps(DIGITS):
            (low, high), x = self._turns, mp.mpf(self.start)
            return float(mp.atan2(mp.sign(self.speed) * mp.sqrt((x - low) * (high - x)), (low + high) / 2 - x))

    def _series(self, f: Function) -> Array:
        """Return the coefficients of cos k u in f(x(u)), as many as double holds."""
        middle, half = self._span
        n = 32
        while n <= _MOST:
            with mp.workdps(DIGITS):
                angles = [mp.pi * (2 * j + 1) / (2 * n) for j in range(n)]
                values = np.array([float(f(middle - half * mp.cos(u))) for u in angles])
            out = np.asarray(dct(values, type=2) / n)
            out[0] /= 2
            if np.abs(out[-n // 8 :]).max() <= np.finfo(float).eps * np.abs(values).max():
                return out
            n *= 2
        raise ValueError(
            f"no cosine series of {_MOST} terms holds the motion; it comes too near to a third turning point"
        )


def _cosines(of: Array, u: Array) -> Array:
    return np.asarray(np.cos(np.outer(u, np.arange(len(of)))) @ of)


def _sines(of: Array, u: Array) -> Array:
    """Return the integral over u of a cosine series."""
    k = np.arange(1, len(of))
    return np.asarray(of[0] * u + np.sin(np.outer(u, k)) @ (of[1:] / k))


def _across(of: Array, u: Array) -> Array:
    """Return the integral over u of a cosine series times sin u."""
    k = np.arange(len(of))
    below = np.where(k == 1, 1, k - 1)
    back = np.where(k == 1, 0.0, np.cos(np.outer(u, k - 1)) / below)
    return np.asarray((back - np.cos(np.outer(u, k + 1)) / (k + 1)) @ of / 2)


def one_cyclic(
    t: ArrayLike,
    q0: tuple[float, float],
    v0: tuple[float, float],
    first: Function,
    coupling: Function,
    second: Function,
    potential: Function,
) -> tuple[Array, Array]:
    """Return (y, x) and their rates, (K, 2) each, of T = ½ a(x) ẏ² + b(x) ẏ ẋ + ½ c(x) ẋ² and V(x).

    p = a ẏ + b ẋ stays, so by Routh's reduction m = c - b²/a and U = V + p²/(2 a).
    """
    with mp.workdps(DIGITS):
        x0, rate = mp.mpf(q0[1]), mp.mpf(v0[1])
        p = first(x0) * mp.mpf(v0[0]) + coupling(x0) * rate
    swing = Swing(
        lambda x: second(x) - coupling(x) ** 2 / first(x), lambda x: potential(x) + p**2 / (2 * first(x)), q0[1], v0[1]
    )
    x, speed = swing.at(t)
    y = q0[0] + swing.gathered(t, lambda x: p / first(x), lambda x: -coupling(x) / first(x))
    turning = [(p - coupling(a) * b) / first(a) for a, b in zip(map(mp.mpf, x), speed, strict=True)]
    return np.stack([y, x], axis=-1), np.stack([np.array(turning, dtype=float), speed], axis=-1)
