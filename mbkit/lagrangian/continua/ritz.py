"""Modes of free vibration of a continuum by Ritz's method, with powers of x as shapes, in 200 digits.

Continua by assumed modes: T and V of w = Σ φ_i(x) a_i(t), and the modes of free vibration by Ritz's method.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import mpmath
import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from mbkit._check import ITERATED, ROUNDING, Array, real, real_array, require_finite
from mbkit._check import count as counted
from mbkit._escape import one_line
from mbkit.errors import InputError, NumericalError, UnsupportedError
from mbkit.lagrangian.continua.densities import Densities, Reduction, terms
from mbkit.lagrangian.continua.integrals import MAX_MODES, Integrals, Shape, read_shape, weights_of
from mbkit.lagrangian.continua.jets import Order
from mbkit.lagrangian.energies.symbols import listed, name_of, plain, velocity_of

#: A number for each power of ξ.
OfPower = Callable[[int], Any]


@dataclass(frozen=True, repr=False)
class NormalModes:
    """Modes of free vibration, for `Continuum.discretized` and for `beam`.

    Attributes
    ----------
    frequencies : (n,) array
        Circular, rad/s; zero of a motion as a rigid body.
    shapes : tuple
        Polynomials in x, each with ∫ of the inertia = 1 kg m² at the values that were given.
    """

    frequencies: Array
    shapes: tuple[Any, ...]

    def __repr__(self) -> str:
        return f"<NormalModes: {', '.join(f'{x:.6g}' for x in self.frequencies)} rad/s>"


#: Digits of Ritz's matrices, enough for `MAX_MODES`: n powers cost 1.2 n of them. Shapes are written with fewer.
_MATRIX_DIGITS: Final = 200
#: A pivot is zero below this part of its diagonal entry.
_ZERO_PIVOT_RATIO: Final = 1e-100


def normal_modes(system: Densities, count: int, values: Mapping[Any, float]) -> NormalModes:
    """Return what `Continuum.normal_modes` does."""
    count = counted("count", count, least=1)
    if count > MAX_MODES:
        raise UnsupportedError(f"count: expected at most {MAX_MODES} modes, got {count}")
    if not isinstance(values, Mapping):
        raise InputError(f"values: expected a mapping of parameters to numbers, got {values!r}")
    moved = _moved(system)
    ends = (*system.ends, *system.T_ends.values(), *system.V_ends.values())
    everything = sp.Add(system.T, system.V, *ends, *moved.values())
    own = everything.free_symbols - {system.jets.x, *system.jets.among(everything)}
    numbers = {name_of(s): sp.Rational(real(f"values[{s}]", x)) for s, x in values.items()}
    missing = [s for s in own if s.name not in numbers]
    if missing:
        raise InputError(f"values: no value for {plain(missing)}; a mode of free vibration takes one of each parameter")
    ritz = _Ritz(system, {s: numbers[s.name] for s in own})
    before: Any = None
    # More powers have to give the same frequencies.
    for powers in range(2 * count + 12, 2 * count + 36, 6):
        squares, vectors, shift = ritz.eigenpairs(powers, count)
        if before is not None and (np.abs(before - squares) <= ITERATED * max(squares.max(), shift)).all():
            break
        before = squares
    else:
        raise NumericalError(
            f"values: the frequencies do not settle to ten digits with {powers} powers of "
            "x; T and V need coefficients that are smooth between the ends, and not too many modes at once"
        )
    lower, upper = system.ends
    place = (system.jets.x - lower) / (upper - lower)
    names = [f.func.__name__ for f in system.jets.fields]
    shapes: list[Any] = []
    for mode in vectors:
        # High powers cancel: the shapes keep 60 digits.
        own_shapes = [sp.Add(*(sp.Float(c, 60) * place**p for p, c in enumerate(rows))) for rows in mode]
        shapes.append(dict(zip(names, own_shapes, strict=True)) if len(names) > 1 else own_shapes[0])
    return NormalModes(np.sqrt(squares), tuple(shapes))


_NOT_REAL: Final = (
    "so that modes need have no shapes of real numbers; take modes without them, discretized, and mbkit.equilibrium"
)


def _moved(system: Densities) -> dict[int, sp.Expr]:
    """Return the forces without loads, which move the place of rest alone; refuse those of rates."""
    out = {}
    for k, x in system.forces.items():
        moving = system.jets.among(x)
        if rates := [s for s in moving if system.jets.order(s)[1][1]]:
            what = f"forces[{system.jets.fields[k]}]: {plain(rates)} damps or turns the modes"
            raise UnsupportedError(f"{what}, {_NOT_REAL}")
        out[k] = sp.expand(x - x.xreplace(dict.fromkeys(moving, sp.Integer(0))))
    return out


class _Ritz:
    """Mass and stiffness of the powers ξ^p of each field, which are near to dependent: hence the digits."""

    def __init__(self, system: Densities, numbers: Mapping[sp.Symbol, sp.Expr]) -> None:
        self._system, self._numbers, self._integrals = system, numbers, Integrals([])
        self._length = _digits((system.ends[1] - system.ends[0]).subs(numbers))
        if self._length <= 0:
            raise InputError(f"values: the length from {system.ends[0]} to {system.ends[1]} is not above zero")
        #: Fields and derivatives of products in T - V and in the work of forces, in which the first one's variation
        #: counts alone, each with a function of the powers' sum and the number of rates, or -1 of work.
        self._pairs: list[tuple[tuple[int, Order], tuple[int, Order], OfPower, int]] = []
        for sign, what, x in ((1, "T", system.T), (-1, "V", system.V)):
            self._read(what, sign * x.subs(numbers), self._along(what))
        for sign, what, parts in ((1, "T_ends", system.T_ends), (-1, "V_ends", system.V_ends)):
            for end, x in parts.items():
                self._read(what, sign * x.subs(numbers), self._at(end))
        for k, x in _moved(system).items():
            what = f"forces[{system.jets.fields[k]}]"
            for product, c in terms(system, what, x.subs(numbers)):
                if len(product) > 1:
                    raise UnsupportedError(f"{what}: modes of free vibration are of linear forces, got {product} in it")
                if product:
                    self._pairs.append(((k, (0, 0)), system.jets.order(product[0]), self._along(what)(c), -1))

    def _read(self, what: str, x: sp.Expr, measure: Callable[[sp.Expr], OfPower]) -> None:
        for product, c in terms(self._system, what, x):
            if len(product) > 2:
                raise UnsupportedError(
                    f"{what}: modes of free vibration are of quadratic energies, got {product} in it"
                )
            if len(product) == 2:
                first, second = (self._system.jets.order(s) for s in product)
                self._pairs.append((first, second, measure(c), first[1][1] + second[1][1]))

    def _along(self, what: str) -> Callable[[sp.Expr], OfPower]:
        """Return what makes ∫ c ξ^n dx of a coefficient, as a function of n."""
        ends = tuple(e.subs(self._numbers) for e in self._system.ends)

        def measure(c: sp.Expr) -> OfPower:
            exact = weights_of(c, self._system.jets.x, ends, what)
            weights = [(f, self._length * _digits(k)) for f, k in exact.items()]
            return cache(lambda n: mpmath.fsum(k * self._integrals.of_power(f, n) for f, k in weights))

        return measure

    def _at(self, end: sp.Expr) -> Callable[[sp.Expr], OfPower]:
        """Return what makes c ξ^n at an end."""
        place = self._system.ends.index(end)

        def measure(c: sp.Expr) -> OfPower:
            value = _digits(c.subs(self._system.jets.x, end.subs(self._numbers)))
            return lambda n: value if place or n == 0 else mpmath.mpf(0)

        return measure

    def _basis(self, powers: int) -> Any:
        """Return columns of powers, field by field, that keep fixed places."""
        size, rows = len(self._system.jets.fields) * powers, []
        for place, end in enumerate(self._system.ends):
            for s in self._system.fixed[end]:
                field, (along, _) = self._system.jets.order(s)
                row = [sp.Integer(0)] * size
                for p in range(along, powers):
                    row[field * powers + p] = sp.Integer(math.perm(p, along) * place ** (p - along))
                rows.append(row)
        free = sp.Matrix.hstack(*sp.Matrix(rows).nullspace()) if rows else sp.eye(size)
        return mpmath.matrix([[_digits(x) for x in free[i, :]] for i in range(size)])

    def _matrices(self, powers: int) -> tuple[Any, Any]:
        n = len(self._system.jets.fields) * powers
        forms = {rates: mpmath.matrix(n, n) for rates in range(-1, 3)}
        for (f, first), (g, second), of_power, rates in self._pairs:
            scale = self._length ** (first[0] + second[0])
            rows = [math.perm(p, first[0]) for p in range(powers)], [math.perm(p, second[0]) for p in range(powers)]
            for p in range(first[0], powers):
                for r in range(second[0], powers):
                    x = rows[0][p] * rows[1][r] * of_power(p + r - first[0] - second[0]) / scale
                    i, j = f * powers + p, g * powers + r
                    if rates == 1 and first[1]:
                        i, j = j, i
                    forms[rates][i, j] += x
                    if rates in (0, 2):
                        forms[rates][j, i] += x
        G = forms[1]
        if mpmath.mnorm(G - G.T, mpmath.inf) > _ZERO_PIVOT_RATIO * mpmath.mnorm(G, mpmath.inf):
            raise UnsupportedError(
                "T: a term of a deflection and another one's rate couples the modes like a gyroscope, and they have no "
                "shapes of real numbers; take shapes of the system at rest, and mbkit.simulate"
            )
        return forms[2], -forms[0] - forms[-1]

    def eigenpairs(self, powers: int, count: int) -> tuple[Array, list[list[list[Any]]], float]:
        """Return the least ω², for each the coefficients of the powers, field by field, and how much was added."""
        with mpmath.workdps(_MATRIX_DIGITS):
            B = self._basis(powers)
            M, K = (B.T * A * B for A in self._matrices(powers))
            if mpmath.mnorm(K - K.T, mpmath.inf) > _ZERO_PIVOT_RATIO * mpmath.mnorm(K, mpmath.inf):
                raise UnsupportedError(f"forces: they have no potential, {_NOT_REAL}")
            if _cholesky(M) is None:
                raise NumericalError("T: some shape of a field has no kinetic energy, or a negative one")
            shift, L = mpmath.mpf(0), _cholesky(K)
            if L is None:
                # Motions as a rigid body: their remainder is small beside the slowest other one.
                ratios = [K[i, i] / M[i, i] for i in range(K.rows)]
                shift = min((x for x in ratios if x > _ZERO_PIVOT_RATIO * max(ratios)), default=mpmath.mpf(1))
                L = _cholesky(K + shift * M)
            unstable = "values: the state of rest is not stable: some shape lowers the potential energy"
            if L is None:
                raise NumericalError(unstable)
            inverse = mpmath.inverse(L)
            flexibility = np.array((inverse * M * inverse.T).tolist(), dtype=np.float64)
            # The largest flexibilities are the slowest modes, and exact to rounding.
            sizes, ways = np.linalg.eigh((flexibility + flexibility.T) / 2)
            squares = 1 / sizes[::-1][:count] - float(shift)
            squares[np.abs(squares) < ROUNDING * float(shift)] = 0.0
            if (squares < 0).any():
                raise NumericalError(unstable)
            columns = inverse.T * mpmath.matrix(ways[:, ::-1][:, :count].tolist())
            out = []
            for k in range(count):
                # The sign in which the upper end goes up.
                own = B * columns[:, k] / mpmath.sqrt(sizes[-1 - k])
                sign = mpmath.sign(mpmath.fsum(own[:powers])) or 1
                out.append([[sign * x for x in own[f * powers : (f + 1) * powers]] for f in range(B.rows // powers)])
            return squares, out, float(shift)


def _digits(x: sp.Expr) -> Any:
    """Return a number of mpmath."""
    with mpmath.workdps(_MATRIX_DIGITS):
        return mpmath.mpf(int(x.p)) / int(x.q) if x.is_Rational else mpmath.mpf(sp.Float(x, _MATRIX_DIGITS))


def _cholesky(A: Any) -> Any:
    """Return L of A = L Lᵀ; None where A is not positive definite."""
    try:
        L = mpmath.cholesky(A)
    except ValueError:
        return None
    return None if any(L[i, i] ** 2 <= _ZERO_PIVOT_RATIO * A[i, i] for i in range(A.rows)) else L


@dataclass(frozen=True, repr=False)
class AssumedModes:
    """A continuum in coordinates: ``Lagrangian(modes.T, modes.V, modes.coordinates, forces=modes.forces, ...)``.

    Add to T and V those of what carries it, and to `coordinates` its own.

    Attributes
    ----------
    T, V : sympy.Expr
        In plain symbols; J.
    coordinates, velocities : tuple of sympy.Symbol
        Amplitudes of the modes and their rates.
    forces : mapping of coordinate to sympy.Expr
        Generalized forces of the forces per length.
    """

    T: sp.Expr
    V: sp.Expr
    coordinates: tuple[sp.Symbol, ...]
    velocities: tuple[sp.Symbol, ...]
    forces: Mapping[sp.Symbol, sp.Expr]
    _fields: tuple[str, ...]
    _shapes: tuple[tuple[Shape, ...], ...]

    def at(self, xi: ArrayLike, field: Any = None) -> Array:
        """Return each mode's shape at places, (n,) or (N, n): ``q @ modes.at(1.0)`` is the deflection of the end.

        Parameters
        ----------
        xi : float or (N,) array_like
            0 at the lower end to 1 at the upper one.
        field : sympy function or str, optional
            By itself or its name; the first by default.
        """
        if field is not None and name_of(field) not in self._fields:
            raise InputError(f"field: expected one of {', '.join(self._fields)}, got {field!r}")
        k = 0 if field is None else self._fields.index(name_of(field))
        places = real_array("xi", xi)
        require_finite("xi", places)
        if places.ndim > 1 or (places < 0).any() or (places > 1).any():
            raise InputError(f"xi: expected places from 0 to 1, between the ends, got {xi!r}")
        rows = [[float(mode[k](float(x))) for mode in self._shapes] for x in np.atleast_1d(places)]
        return np.array(rows[0] if places.ndim == 0 else rows)

    def __repr__(self) -> str:
        return one_line(f"<AssumedModes {', '.join(map(str, self.coordinates))} of {', '.join(self._fields)}>")


def assumed_modes(system: Densities, shapes: Any, name: str) -> AssumedModes:
    """Return what `Continuum.discretized` does."""
    fields = tuple(f.func.__name__ for f in system.jets.fields)
    if isinstance(shapes, NormalModes):
        shapes = shapes.shapes
    sources = [shapes] if isinstance(shapes, Mapping) else listed("shapes", shapes)
    read = [_mode(system, f"shapes[{i}]", source, fields) for i, source in enumerate(sources)]
    for i, mode in enumerate(read):
        _require_fixed(system, f"shapes[{i}]", mode)
    if not isinstance(name, str) or not name.strip():
        raise InputError(f"name: expected a text, got {name!r}")
    q = tuple(sp.Symbol(f"{name}{i + 1}") for i in range(len(read)))
    used_names = {s.name for x in (*system._parts.values(), *system.ends) for s in x.free_symbols}
    clash = [s for s in q if s.name in used_names]
    if clash:
        raise InputError(f"name: {plain(clash)} is in the energies or forces already; give the modes another name")
    work = Reduction(system, read, q)
    T = work.along("T", system.T) + sp.Add(*(work.at_end("T_ends", e, x) for e, x in system.T_ends.items()))
    V = work.along("V", system.V) + sp.Add(*(work.at_end("V_ends", e, x) for e, x in system.V_ends.items()))
    n, forces = len(fields), dict.fromkeys(q, sp.Integer(0))
    for k, f in system.forces.items():
        for i, a in enumerate(q):
            # Virtual work ∫ f δw dx, with δw = φ_i δa.
            forces[a] += work.along("forces", f, ((i * n + k, 0),)) if read[i][k].expression != 0 else 0
    acting = {a: x for a, x in forces.items() if x != 0}
    return AssumedModes(T, V, q, tuple(map(velocity_of, q)), acting, fields, tuple(read))


def _mode(system: Densities, what: str, source: Any, fields: tuple[str, ...]) -> tuple[Shape, ...]:
    """Return the shape of each field in one mode."""
    if not isinstance(source, Mapping):
        if len(fields) > 1:
            raise InputError(f"{what}: expected a mapping of {', '.join(fields)} to their shapes, got {source!r}")
        source = {fields[0]: source}
    named = {name_of(f): x for f, x in source.items()}
    unknown = [f for f in named if f not in fields]
    if unknown:
        raise InputError(f"{what}: {unknown[0]} is no field here; the fields are {', '.join(fields)}")
    return tuple(read_shape(what, named.get(f, 0), system.jets.x, system.ends) for f in fields)


def _require_fixed(system: Densities, what: str, mode: tuple[Shape, ...]) -> None:
    for place, end in enumerate(system.ends):
        for s in system.fixed[end]:
            k, (along, _) = system.jets.order(s)
            shape = mode[k].slope(along)
            size = max((abs(shape(x / 8)) for x in range(9)), default=0)
            if abs(shape(place)) > ROUNDING * size:
                raise InputError(
                    f"{what}: {s} = {mpmath.nstr(shape(place), 6)} at {system.jets.x} = {end}, where it is fixed; a "
                    "shape must keep what `fixed` says"
                )
