"""A model's equations to read: its energies in SymPy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import sympy as sp

from mbkit.errors import InputError, UnsupportedError
from mbkit.lagrangian.symbolic_kinematics import SymbolicKinematics
from mbkit.lagrangian.symbols import velocity_of
from mbkit.lagrangian.system import Lagrangian
from mbkit.lagrangian.textbook import in_symbols
from mbkit.lagrangian.written import WrittenModel
from mbkit.model import Model

__all__ = ["from_model"]

#: Velocities up to which anybody reads a matrix.
_MOST: Final = 24


def from_model(
    model: Model,
    *,
    symbols: bool | None = None,
    coordinates: Sequence[str] | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> Lagrangian:
    """Return a model as a `Lagrangian` to read: T, V and Rayleigh's dissipation in its coordinates.

    The joints' own formulas are evaluated on exact sums of cosines and sines, which are
    short without a search: a planar chain has cos(theta2 + theta3) where one would write it.
    Numbers are the decimals of the description. Springs are in V, dampers in the
    dissipation, armature in T; dry friction and limits are left out, as in every engine.

    Parameters
    ----------
    model : Model
        A tree of joints whose velocities are the rates of their coordinates: not ball and free ones.
    symbols : bool, optional
        Whether a system of the catalog is written in the textbooks' symbols, with the model's
        numbers as values of the parameters: cart_pole in m_c, m_p, l and g. Not given, it is if
        the model has no named parameters of its own.
    coordinates : sequence of str, optional
        Names instead of the model's, such as ``["q1", "q2"]``.
    progress : callable, optional
        Called with a fraction and a text.

    Raises
    ------
    UnsupportedError
        Ball or free joints, loops, prescribed motions, or more terms than anybody reads.
    InputError
        `symbols` asked for of a model that is no system of the catalog, or names that do not fit.

    Examples
    --------
    >>> import mbkit as mb
    >>> lag = mb.lagrangian.from_model(mb.catalog.pendulum(mass=2.0))
    >>> lag.T, lag.V
    (l**2*m*thetadot**2/2, -g*l*m*cos(theta))
    >>> {s.name: x for s, x in lag.parameters.items()}
    {'g': 9.81, 'm': 2.0, 'l': 1.0}
    """
    if not isinstance(model, Model):
        raise InputError(f"model: expected a Model, got {type(model).__name__}; mbkit.load(...) gives one")
    if isinstance(model, WrittenModel):
        return model.system
    _check(model)
    q = _coordinates(model, coordinates)
    named = None
    if symbols or symbols is None:
        named = in_symbols(model)
        if named is None and symbols:
            known = "it has named parameters already" if model.parameters else "it is no system of the catalog"
            raise InputError(f"symbols: {model.name}: {known}; leave symbols out to keep its numbers")
    source = named or model
    parameters = {name: sp.Symbol(name) for name in source.parameters}
    clash = [s.name for s in q if s.name in parameters]
    if clash:
        raise InputError(f"coordinates: {clash[0]!r} is a parameter of {model.name}; give coordinates=... other names")
    v = [velocity_of(s) for s in q]
    kin = SymbolicKinematics(source, q, v, parameters, progress or _silent)
    T, V, R = _kinetic(kin.mass_matrix, v), kin.gravity_energy + kin.spring_energy, kin.dissipation
    used = T.free_symbols | V.free_symbols | R.free_symbols
    return Lagrangian(
        T,
        V,
        q,
        v,
        dissipation=R,
        # What only a frame needs is no part of the equation; a name of the user's own is kept all the same.
        parameters={s: source.parameters[n] for n, s in parameters.items() if named is None or s in used},
        name=model.name,
    )


def _silent(_fraction: float, _text: str) -> None:
    pass


def _check(model: Model) -> None:
    turning = [j.name for j in model.independent_joints if not j.type.coordinate_velocities]
    if turning:
        raise UnsupportedError(
            f"{model.name}: joint {turning[0]!r} has velocities that are no coordinate's rate; write it in Euler "
            "angles (mbkit.lagrangian.systems.heavy_top, or spherical_zyx joints), or use Lagrangian.quasi_velocities"
        )
    for feature, told in (("loops", model.loops), ("prescribed", model.prescribed)):
        if told:
            raise UnsupportedError(f"{model.name}: cannot be written with {feature}; model.without({feature!r}) can")
    if not model.nv:
        raise UnsupportedError(f"{model.name}: no joint of it moves, so there is no equation")
    if model.nv > _MOST:
        raise UnsupportedError(
            f"{model.name}: {model.nv} coordinates are more than the {_MOST} that are written out; "
            'mbkit.dynamics(model, "lagrangian") computes the same without writing it'
        )


def _coordinates(model: Model, names: Sequence[str] | None) -> list[sp.Symbol]:
    told = list(model.coordinate_names if names is None else names)
    if len(told) != model.nq or not all(isinstance(n, str) and n for n in told) or len(set(told)) != len(told):
        raise InputError(f"coordinates: expected {model.nq} different names, got {names!r}")
    return [sp.Symbol(n) for n in told]


def _kinetic(M: list[list[Any]], v: list[sp.Symbol]) -> sp.Expr:
    n = len(v)
    terms = [sp.Mul(sp.Rational(1, 2), M[i][i], v[i] ** 2) for i in range(n)]
    terms += [sp.Mul(M[i][j], v[i], v[j]) for i in range(n) for j in range(i + 1, n)]
    return sp.Add(*terms)
