"""Continua by assumed modes: T and V of w = Σ φ_i(x) a_i(t), and the modes of free vibration by Ritz's method."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mpmath
import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from mbkit._check import ROUNDING, Array, real_array, require_finite
from mbkit._escape import one_line
from mbkit.errors import InputError
from mbkit.lagrangian.continua.densities import Densities
from mbkit.lagrangian.continua.integrals import Shape, read_shape
from mbkit.lagrangian.continua.reduction import Reduction
from mbkit.lagrangian.continua.ritz import NormalModes
from mbkit.lagrangian.energies.symbols import listed, name_of, plain, velocity_of


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
