"""A continuum as its energies per length: the data that everything else in `mbkit.lagrangian.continua` reads.

Energies of a continuum with mode shapes put in: integrals along it, and values at its ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any

import mpmath
import sympy as sp

from mbkit.errors import InputError, UnsupportedError
from mbkit.lagrangian.continua.integrals import INTEGRAL_DIGITS, Integrals, Shape, number, weights_of
from mbkit.lagrangian.continua.jets import Jets
from mbkit.lagrangian.energies.symbols import expression, listed, velocity_of


class Densities:
    """Energies per length and of the ends, checked; arguments are those of `Continuum`."""

    def __init__(
        self,
        T: Any,
        V: Any,
        fields: Any,
        ends: Sequence[Any],
        *,
        fixed: Mapping[Any, Iterable[Any]] | None = None,
        T_ends: Mapping[Any, Any] | None = None,
        V_ends: Mapping[Any, Any] | None = None,
        forces: Mapping[Any, Any] | None = None,
        coordinates: Sequence[Any] = (),
        velocities: Sequence[Any] | None = None,
    ) -> None:
        self.jets = jets = Jets(fields, coordinates, velocities)
        self.T, self.V = jets("T", T), jets("V", V)
        if not isinstance(ends, (tuple, list, sp.Tuple)) or len(ends) != 2:
            raise InputError(f"ends: expected two places, such as (0, L), got {ends!r}")
        self.ends = tuple(expression("ends", e) for e in ends)
        if (self.ends[1] - self.ends[0]).is_nonpositive or any(e.has(jets.x, jets.t) for e in self.ends):
            expected = "a lower and an upper place, two places that differ"
            raise InputError(f"ends: expected {expected} and do not hold {jets.x} or {jets.t}, got {ends}")
        self.T_ends = {e: jets(f"T_ends[{e}]", x) for e, x in self._at_ends("T_ends", T_ends)}
        self.V_ends = {e: jets(f"V_ends[{e}]", x) for e, x in self._at_ends("V_ends", V_ends)}
        self.forces = {}
        for f, x in _mapping("forces", forces).items():
            if f not in jets.fields:
                raise InputError(f"forces: {f} is no field here; the fields are {', '.join(map(str, jets.fields))}")
            self.forces[jets.fields.index(f)] = jets(f"forces[{f}]", x)
        if self.T == 0:
            raise InputError("T: a continuum without kinetic energy has no equation of motion")
        self.fixed: dict[sp.Expr, list[sp.Symbol]] = {e: [] for e in self.ends}
        for e, conditions in self._at_ends("fixed", fixed):
            self.fixed[e] = [jets(f"fixed[{e}]", x) for x in listed(f"fixed[{e}]", conditions)]
        self._check()

    def _at_ends(self, what: str, source: Mapping[Any, Any] | None) -> list[tuple[sp.Expr, Any]]:
        out = [(expression(what, e), x) for e, x in _mapping(what, source).items()]
        for e, _ in out:
            if e not in self.ends:
                raise InputError(f"{what}: {e} is no end; the ends are {self.ends[0]} and {self.ends[1]}")
        return out

    @property
    def _parts(self) -> dict[str, sp.Expr]:
        """All energies and forces by their names."""
        ends = [(what, e, x) for what in ("T_ends", "V_ends") for e, x in getattr(self, what).items()]
        forces = {f"forces[{self.jets.fields[k]}]": x for k, x in self.forces.items()}
        return {"T": self.T, "V": self.V} | {f"{what}[{e}]": x for what, e, x in ends} | forces

    def _check(self) -> None:
        jets, most = self.jets, self.orders
        self.jets.check_parameters(self._parts | {"ends": sp.Add(*self.ends)})
        for what, x in self._parts.items():
            for s in jets.among(x):
                field, (along, rates) = jets.order(s)
                if rates > (0 if what.startswith("V") else 1):
                    most_rates = "no rates" if what.startswith("V") else "no second derivatives by the time"
                    raise InputError(f"{what}: expected {most_rates} of the fields, got {s}")
                if "_ends[" in what and along >= most[field]:
                    raise InputError(
                        f"{what}: {s} cannot be passed on: T and V hold derivatives of {jets.fields[field]} along "
                        f"{jets.x} of order {most[field]} at most, so that an end holds those below"
                    )
        for e, conditions in self.fixed.items():
            for c in conditions:
                if c not in jets.among(c) or jets.order(c)[1][1] or jets.order(c)[1][0] >= most[jets.order(c)[0]]:
                    below = f"derivatives along {jets.x} below the highest in T and V"
                    raise InputError(f"fixed[{e}]: expected a field or one of its {below}, got {c}")

    @cached_property
    def orders(self) -> tuple[int, ...]:
        """The highest derivative of each field along x in T and V."""
        orders = [self.jets.order(s) for s in self.jets.among(self.T - self.V)]
        return tuple(max((o[0] for f, o in orders if f == k), default=0) for k in range(len(self.jets.fields)))


def _mapping(what: str, source: Any) -> Mapping[Any, Any]:
    if source is not None and not isinstance(source, Mapping):
        raise InputError(f"{what}: expected a mapping such as {{L: ...}}, got {source!r}")
    return source or {}


#: Shapes by their number, each with its derivative.
Factors = tuple[tuple[int, int], ...]


class Reduction:
    """Energies per length and of ends, with the modes put in."""

    def __init__(self, system: Densities, modes: Sequence[tuple[Shape, ...]], q: Sequence[sp.Symbol]) -> None:
        self._system, self._q = system, q
        self._shapes = [shape for mode in modes for shape in mode]
        self._integrals = Integrals(self._shapes)
        self._length = system.ends[1] - system.ends[0]

    def _sum(self, what: str, x: sp.Expr, also: Factors, measured: Callable[[sp.Expr, Factors], sp.Expr]) -> sp.Expr:
        """Return a sum over the modes of each product of derivatives in x."""
        jets, n, out = self._system.jets, len(self._system.jets.fields), []
        for product, c in terms(self._system, what, x):
            sums: dict[Factors, sp.Expr] = {also: sp.Integer(1)}
            for s in product:
                field, (along, by_time) = jets.order(s)
                grown: dict[Factors, sp.Expr] = {}
                for factors, amplitude in sums.items():
                    for i, a in enumerate(self._q):
                        if self._shapes[i * n + field].expression != 0:
                            key = tuple(sorted((*factors, (i * n + field, along))))
                            rate = (velocity_of(a) if by_time else a) / self._length**along
                            grown[key] = grown.get(key, sp.Integer(0)) + amplitude * rate
                sums = grown
            out += [measured(c, factors) * amplitude for factors, amplitude in sums.items()]
        return sp.Add(*out)

    def along(self, what: str, x: sp.Expr, also: Factors = ()) -> sp.Expr:
        """Return ∫ x dx, with the shapes `also` as factors."""

        def measured(c: sp.Expr, factors: Factors) -> sp.Expr:
            weights = weights_of(c, self._system.jets.x, self._system.ends, what)
            return self._length * sp.Add(*(k * self._integrals(f, factors) for f, k in weights.items()))

        return self._sum(what, x, also, measured)

    def at_end(self, what: str, end: sp.Expr, x: sp.Expr) -> sp.Expr:
        """Return an energy at an end."""
        place = self._system.ends.index(end)

        def measured(c: sp.Expr, factors: Factors) -> sp.Expr:
            with mpmath.workdps(INTEGRAL_DIGITS):
                value = mpmath.fprod(self._shapes[k].slope(along)(place) for k, along in factors)
            return c.subs(self._system.jets.x, end) * number(value)

        return self._sum(what, x, (), measured)


def terms(system: Densities, what: str, x: sp.Expr) -> list[tuple[tuple[sp.Symbol, ...], sp.Expr]]:
    """Return an expression as products of derivatives, with the coefficient of each.

    Raises
    ------
    UnsupportedError
        Other functions of them.
    """
    moving = system.jets.among(x)
    if not moving:
        return [((), x)] if x != 0 else []
    if not x.is_polynomial(*moving):
        raise UnsupportedError(
            f"{what}: {x} is no polynomial of the fields and their derivatives, and modes cannot be put in; expand it "
            "to the powers that matter"
        )
    monomials = sp.Poly(x, *moving).terms()
    return [(tuple(s for s, k in zip(moving, powers, strict=True) for _ in range(k)), c) for powers, c in monomials]
