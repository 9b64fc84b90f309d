"""A beam or string on a moving root: small deflections on a motion of any size, with the stiffening that this needs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import mpmath
import sympy as sp

from mbkit._check import count as counted
from mbkit.errors import InputError, UnsupportedError
from mbkit.lagrangian.continua.continuum import Continuum
from mbkit.lagrangian.continua.integrals import MAX_MODES
from mbkit.lagrangian.energies.energy_form import vanish
from mbkit.lagrangian.energies.symbols import PlainSymbols, expression, listed
from mbkit.lagrangian.trig.simplify import tidy

_ROOT_DIGITS: Final = 40


def clamped_free(count: int, x: sp.Symbol, length: Any) -> tuple[sp.Expr, ...]:
    """Return the exact first modes of a clamped and free beam: cosh βx - cos βx - σ (sinh βx - sin βx).

    cos λ cosh λ = -1 with λ = β L, and ∫ φ_i φ_j dx = L δ_ij; each end deflects by ±2.

    Parameters
    ----------
    count : int
        Up to 20.
    x : sympy.Symbol
        From the clamp.
    length : sympy.Expr

    References
    ----------
    Young, Felgar 1949, Tables of characteristic functions representing normal modes of vibration of a beam.
    """
    count = counted("count", count, least=1)
    if count > MAX_MODES:
        raise UnsupportedError(f"count: expected at most {MAX_MODES} modes, got {count}; take Continuum.normal_modes")
    if not isinstance(x, sp.Symbol):
        raise InputError(f"x: expected a SymPy symbol, got {x!r}")
    place, out = x / _above_zero(expression("length", length)), []
    with mpmath.workdps(_ROOT_DIGITS):
        for k in range(count):
            root = mpmath.findroot(lambda y: mpmath.cos(y) + 1 / mpmath.cosh(y), (k + mpmath.mpf(1) / 2) * mpmath.pi)
            sigma = (mpmath.sinh(root) - mpmath.sin(root)) / (mpmath.cosh(root) + mpmath.cos(root))
            b, s = sp.Float(root, _ROOT_DIGITS), sp.Float(sigma, _ROOT_DIGITS)
            out.append(sp.cosh(b * place) - sp.cos(b * place) - s * (sp.sinh(b * place) - sp.sin(b * place)))
    return tuple(out)


def beam(
    length: Any,
    stiffness: Any,
    density: Any,
    *,
    position: Sequence[Any] = (0, 0),
    rotation: Any = 0,
    coordinates: Sequence[Any] = (),
    velocities: Sequence[Any] | None = None,
    tension: Any = 0,
    tip_mass: Any = 0,
    tip_inertia: Any = 0,
    gravity: Sequence[Any] | None = None,
    stiffening: bool = True,
    fields: Any = None,
) -> Continuum:
    """Return an Euler-Bernoulli beam, clamped at s = 0 to a root that moves, as a `Continuum`.

    The point s of the axis is at r + R (s + u, v, w), where the beam does not stretch: u = -½ ∫₀ˢ (v′² + w′²) ds.
    T and V hold every term of second order in the deflections. Without u, which is of second order itself, the beam of
    a body that turns is too soft, and weaker the faster it turns: the naive form of `stiffening` = False, to compare.

    Parameters
    ----------
    length, stiffness, density : sympy.Expr
        L in m, EI in N m² and the mass per length in kg/m; the last two may depend on s. EI of zero is a string. In
        space ``(EI_v, EI_w)`` are those across the two axes of a section.
    position : vector of 2 or 3 components
        r(q, t) of the root along fixed axes, m.
    rotation : sympy.Expr or (3, 3) matrix
        In a plane the angle of the beam's axis from the first fixed axis, rad; in space R, whose columns are the
        beam's axes: the first along it, the others across, along v and w.
    coordinates, velocities : sequence of sympy symbols, optional
        As of `Lagrangian`, those in position and rotation; the time is ``t``.
    tension : sympy.Expr, optional
        Along the beam without motion, N.
    tip_mass, tip_inertia : sympy.Expr, optional
        Of a body at the end, kg and kg m²; the inertia in a plane only.
    gravity : vector, optional
        Its acceleration along the fixed axes, m/s².
    stiffening : bool
    fields : one or two sympy functions of a place and t, optional
        The deflections; ``v(s, t)``, and ``w(s, t)`` in space.

    Raises
    ------
    InputError
        Vectors and matrices of other shapes, a matrix that is no rotation.

    References
    ----------
    Kane, Ryan, Banerjee 1987, Dynamics of a cantilever beam attached to a moving base, Journal of Guidance, Control,
    and Dynamics 10(2).

    Examples
    --------
    >>> import sympy as sp
    >>> import mbkit as mb
    >>> L, EI, rho, theta, J = sp.symbols("L EI rho theta J")
    >>> arm = mb.lagrangian.beam(L, EI, rho, rotation=theta, coordinates=[theta])
    >>> a = arm.discretized([(sp.Symbol("s") / L) ** 2])
    >>> T = J * sp.Symbol("thetadot") ** 2 / 2 + a.T
    >>> print(mb.lagrangian.Lagrangian(T, a.V, [theta, *a.coordinates], parameters=[L, EI, rho, J]).equations())
    thetaddot*(J + L*rho*(5*L**2 - a1**2)/15) + L**2*addot1*rho/4 - 2*L*a1*adot1*rho*thetadot/15 = 0
    L**2*rho*thetaddot/4 + L*addot1*rho/5 + L*a1*rho*thetadot**2/15 + 4*EI*a1/L**3 = 0
    """
    place = listed("position", position)
    if len(place) not in (2, 3):
        raise InputError(f"position: expected a vector of 2 or 3 components, got {position!r}")
    space = len(place) == 3
    s, t = sp.symbols("s t")
    own = [sp.Function(n)(s, t) for n in ("v", "w")[: len(place) - 1]]
    bent = sp.Matrix(own if fields is None else listed("fields", fields))
    if len(bent) != len(own) or any(len(f.args) != 2 for f in bent):
        raise InputError(f"fields: expected {len(own)} functions of a place and the time, got {fields!r}")
    s, t = bent[0].args
    moved = listed("coordinates", coordinates) if coordinates != () else []
    into = PlainSymbols(moved, velocities, t) if moved else None
    q, rates = (into.coordinates, into.velocities) if into else ((), ())
    if s.name in {x.name for x in q}:
        raise InputError(f"coordinates: {s} is the place along the beam; give others as fields=Function('v')(xi, t)")

    def read(what: str, value: Any) -> sp.Expr:
        return into(what, value) if into else expression(what, value)

    def rate(A: sp.Matrix) -> sp.Matrix:
        return sum((A.diff(x) * w for x, w in zip(q, rates, strict=True)), A.diff(t))

    r = sp.Matrix([read(f"position[{k}]", x) for k, x in enumerate(place)])
    R = _rotation(rotation, read, space=space)
    L, rho, m = _above_zero(read("length", length)), read("density", density), read("tip_mass", tip_mass)
    # Everything in the beam's axes: the root's velocity, the turn of the axes, the point at s without u.
    u0, turn = (A.applyfunc(tidy) for A in (R.T * rate(r), R.T * rate(R)))
    point = sp.Matrix([s, *bent])
    speed = u0 + turn * point + point.diff(t)
    slopes, square = bent.diff(s), bent.diff(s).dot(bent.diff(s))
    T, T_end = rho * speed.dot(speed) / 2, m * speed.dot(speed) / 2
    V = read("tension", tension) * square / 2 + _bending(stiffness, read, bent.diff(s, 2))
    V_end: Any = 0
    # u moves the part beyond s: ∫ ρ u f ds = -½ ∫ v′² (∫ ρ f ds beyond s) ds.
    mass, moment = (sp.integrate(sp.expand(f), (s, s, L)) + end for f, end in ((rho, m), (rho * s, m * L)))
    if stiffening:
        T -= square * (mass * u0.dot(turn[:, 0]) + moment * turn[:, 0].dot(turn[:, 0])) / 2
        T -= mass * u0[0] * slopes.dot(slopes.diff(t))
    if gravity is not None:
        down = sp.Matrix([read(f"gravity[{k}]", x) for k, x in enumerate(listed("gravity", gravity))])
        if len(down) != len(r):
            raise InputError(f"gravity: {len(down)} components, but the position has {len(r)}")
        height = -down.dot(r + R * point)
        V, V_end = V + rho * height, m * height
        if stiffening:
            V += mass * (R.T * down)[0] * square / 2
    inertia = read("tip_inertia", tip_inertia)
    if inertia != 0:
        if space:
            raise UnsupportedError("tip_inertia: a body that turns at the end is written in a plane only")
        T_end += inertia * (turn[1, 0] + slopes[0].diff(t)) ** 2 / 2
    clamped = [x for f in bent for x in ((f, f.diff(s)) if V.has(f.diff(s, 2)) else (f,))]
    return Continuum(
        T,
        V,
        tuple(bent),
        (0, L),
        fixed={0: clamped},
        T_ends={L: T_end},
        V_ends={L: V_end},
        coordinates=q,
        velocities=rates or None,
    )


def _above_zero(length: sp.Expr) -> sp.Expr:
    if length.is_nonpositive:
        raise InputError(f"length: expected a length above zero, got {length}")
    return length


def _rotation(source: Any, read: Callable[[str, Any], sp.Expr], *, space: bool) -> sp.Matrix:
    """Return R, whose columns are the beam's axes."""
    if not space:
        angle = read("rotation", source)
        return sp.Matrix([[sp.cos(angle), -sp.sin(angle)], [sp.sin(angle), sp.cos(angle)]])
    try:
        R = sp.eye(3) if isinstance(source, int) and source == 0 else sp.Matrix(source)
    except (TypeError, ValueError):
        R = sp.zeros(0, 0)
    if R.shape != (3, 3):
        raise InputError(f"rotation: expected a (3, 3) matrix in space, got {source!r}")
    R = R.applyfunc(lambda x: read("rotation", x))
    if not vanish([*(R.T * R - sp.eye(3)), R.det() - 1]):
        raise InputError("rotation: its columns are not orthonormal and right-handed, so that it turns nothing")
    return R


def _bending(source: Any, read: Callable[[str, Any], sp.Expr], curvatures: sp.Matrix) -> sp.Expr:
    """Return ½ EI v″² across each axis."""
    rows = list(source) if isinstance(source, (tuple, list)) else [source] * len(curvatures)
    if len(rows) != len(curvatures):
        raise InputError(f"stiffness: expected one or {len(curvatures)}, got {len(rows)}")
    return sp.Add(*(read("stiffness", EI) * c**2 / 2 for EI, c in zip(rows, curvatures, strict=True)))
