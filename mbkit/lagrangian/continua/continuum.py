"""Hamilton's principle of one-dimensional continua: the partial differential equation and all boundary conditions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import sympy as sp
from sympy.core.function import AppliedUndef

from mbkit._escape import one_line, terminal
from mbkit.errors import InputError
from mbkit.lagrangian.continua.assumed_modes import AssumedModes, assumed_modes
from mbkit.lagrangian.continua.jets import Jets
from mbkit.lagrangian.continua.ritz import NormalModes, normal_modes
from mbkit.lagrangian.energies.symbols import expression
from mbkit.lagrangian.printer import ExpressionPrinter, Printable, aligned
from mbkit.lagrangian.trig.simplify import tidy


@dataclass(frozen=True, repr=False)
class FieldEquations(Printable):
    """The equations of motion of fields and what holds at the ends; symbols such as w_xxt are derivatives.

    Attributes
    ----------
    field_equations : tuple of sympy.Eq
        One a field, for every x between the ends: inertia and stiffness on the left, applied forces on the right.
    boundary_conditions : tuple of (sympy.Expr, sympy.Eq)
        Each with its end, the lower one first: a fixed derivative, or the balance of forces or moments that the
        variation of a free one leaves.
    """

    field_equations: tuple[sp.Eq, ...]
    boundary_conditions: tuple[tuple[sp.Expr, sp.Eq], ...]
    _jets: Jets

    @cached_property
    def _board(self) -> ExpressionPrinter:
        pairs = [*self.field_equations, *(x for _, x in self.boundary_conditions)]
        return ExpressionPrinter(*self._jets.groups([x.lhs for x in pairs]), time=self._jets.t)

    def _lines(self, written: Callable[[Any], str]) -> list[tuple[str, str, str]]:
        """Return the two sides of each equation, and where it holds."""
        out = [(written(x.lhs), written(x.rhs), "") for x in self.field_equations]
        place = written(self._jets.x)
        return out + [
            (written(x.lhs), written(x.rhs), f"{place} = {written(end)}") for end, x in self.boundary_conditions
        ]

    def latex(self) -> str:
        """Return the equations as an aligned LaTeX block; behind each boundary condition stands its place."""
        lines = self._lines(self._board.latex)
        return aligned((left, right + (rf" && ({place})" if place else "")) for left, right, place in lines)

    def __str__(self) -> str:
        lines = self._lines(self._board.text)
        texts = (f"{left} = {right}" + (f"   at {place}" if place else "") for left, right, place in lines)
        return terminal("\n".join(texts))


class Continuum:
    """A string, a beam or another continuum along one axis, as its energies per length and those of its ends.

    Parameters
    ----------
    T, V : sympy.Expr
        Kinetic and potential energy per length, of the fields and their derivatives, x, t and parameters; J/m.
    fields : sympy function or sequence of them
        w(x, t), and others of the same x and t.
    ends : (lower, upper)
        Where it begins and ends, such as ``(0, L)``.
    fixed : mapping of end to sequence, optional
        What is zero there: ``{0: [w, w.diff(x)]}`` clamps the lower end.
    T_ends, V_ends : mapping of end to sympy.Expr, optional
        Energies of masses and springs there, of the fields as if anywhere; J.
    forces : mapping of field to sympy.Expr, optional
        Applied forces per length along each, of derivatives too, such as ``-c * w.diff(t)``.
    coordinates, velocities : sequence of sympy symbols, optional
        As of `Lagrangian`, of what carries the continuum, where the energies hold them.

    Raises
    ------
    InputError
        Fields of other arguments, an end that is none, an end's energy of a derivative that the continuum does not pass
        on.

    References
    ----------
    Meirovitch 2001, Fundamentals of Vibrations, ch. 8.1: the extended Hamilton's principle.

    Examples
    --------
    >>> import sympy as sp
    >>> import mbkit as mb
    >>> x, t, L, rho, P, m = sp.symbols("x t L rho P m")
    >>> w = sp.Function("w")(x, t)
    >>> string = mb.lagrangian.Continuum(rho * w.diff(t)**2 / 2, P * w.diff(x)**2 / 2, w, (0, L), fixed={0: [w]},
    ...                                  T_ends={L: m * w.diff(t)**2 / 2})
    >>> print(string.equations())
    ρ w_tt - P w_xx = 0
    w = 0   at x = 0
    m w_tt + P w_x = 0   at x = L
    """

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
        if isinstance(ends, (str, sp.Basic)) or len(ends) != 2:
            raise InputError(f"ends: expected two places, such as (0, L), got {ends!r}")
        self.ends = tuple(expression("ends", e) for e in ends)
        if self.ends[0] == self.ends[1] or any(e.has(jets.x, jets.t) for e in self.ends):
            raise InputError(f"ends: expected two places that differ and do not hold {jets.x} or {jets.t}, got {ends}")
        self.T_ends = {e: jets(f"T_ends[{e}]", x) for e, x in self._at_ends("T_ends", T_ends)}
        self.V_ends = {e: jets(f"V_ends[{e}]", x) for e, x in self._at_ends("V_ends", V_ends)}
        self.forces = {}
        for f, x in (forces or {}).items():
            if f not in jets.fields:
                raise InputError(f"forces: {f} is no field here; the fields are {', '.join(map(str, jets.fields))}")
            self.forces[jets.fields.index(f)] = jets(f"forces[{f}]", x)
        if self.T == 0:
            raise InputError("T: a continuum without kinetic energy has no equation of motion")
        self.fixed: dict[sp.Expr, list[sp.Symbol]] = {e: [] for e in self.ends}
        for e, conditions in self._at_ends("fixed", fixed):
            rows = [conditions] if isinstance(conditions, (str, sp.Basic)) else conditions
            self.fixed[e] = [jets(f"fixed[{e}]", x) for x in rows]
        self._check()

    def _at_ends(self, what: str, source: Mapping[Any, Any] | None) -> list[tuple[sp.Expr, Any]]:
        out = [(expression(what, e), x) for e, x in (source or {}).items()]
        for e, _ in out:
            if e not in self.ends:
                raise InputError(f"{what}: {e} is no end; the ends are {self.ends[0]} and {self.ends[1]}")
        return out

    def _check(self) -> None:
        jets, most = self.jets, self.orders
        self.jets.check_parameters({"T": self.T, "V": self.V} | {"ends": sp.Add(*self.ends)})
        ends = [(what, e, x) for what in ("T_ends", "V_ends") for e, x in getattr(self, what).items()]
        parts = [("T", self.T), ("V", self.V), *((f"{what}[{e}]", x) for what, e, x in ends)]
        parts += [(f"forces[{jets.fields[k]}]", x) for k, x in self.forces.items()]
        for what, x in parts:
            for s in jets.among(x):
                if jets.order(s)[1][1] > (0 if what.startswith("V") else 1):
                    most_rates = "no rates" if what.startswith("V") else "no second derivatives by the time"
                    raise InputError(f"{what}: expected {most_rates} of the fields, got {s}")
        for what, e, x in ends:
            for s in jets.among(x):
                field, (along, _) = jets.order(s)
                if along >= most[field]:
                    raise InputError(
                        f"{what}[{e}]: {s} cannot be passed on: T and V hold derivatives of {jets.fields[field]} along "
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
        found = [self.jets.order(s) for s in self.jets.among(self.T - self.V)]
        return tuple(max((o[0] for f, o in found if f == k), default=0) for k in range(len(self.jets.fields)))

    def equations(self) -> FieldEquations:
        """Return the partial differential equations and all boundary conditions.

        ∫ (∫ δ(T - V) dx + δ(T - V) of the ends + ∫ f δw dx) dt = 0 for every variation that `fixed` allows.
        """
        jets, L = self.jets, self.T - self.V
        inside, at_ends = [], []
        for k, most in enumerate(self.orders):
            G = [self._forces(L, k, j) for j in range(most + 1)]
            body = sp.Add(*((-1) ** j * jets.along(g, j) for j, g in enumerate(G)))
            inside.append(sp.Eq(_short(-body, jets, turned=False), self.forces.get(k, sp.Integer(0)), evaluate=False))
            for end, sign in zip(self.ends, (-1, 1), strict=True):
                own = self.T_ends.get(end, 0) - self.V_ends.get(end, 0)
                for j in range(most):
                    free = jets.symbol(k, (j, 0))
                    if free in self.fixed[end]:
                        at_ends.append((end, sp.Eq(free, 0, evaluate=False)))
                        continue
                    passed = ((-1) ** (i - j - 1) * jets.along(G[i], i - j - 1) for i in range(j + 1, most + 1))
                    # What is fixed stays zero, with all its rates.
                    balance = sign * sp.Add(*passed) + self._forces(own, k, j)
                    # A function of x stays one: the place stands beside the equation.
                    balance = balance if balance.atoms(AppliedUndef) else balance.subs(jets.x, end)
                    still = {s: 0 for s in jets.among(balance) if self._held(s, end)}
                    at_ends.append((end, sp.Eq(_short(-balance.subs(still), jets), 0, evaluate=False)))
        # Where nothing is passed on, as at the free end of a turning string, every motion that stays finite will do.
        kept = [pair for pair in at_ends if pair[1].lhs != 0]
        return FieldEquations(tuple(inside), tuple(sorted(kept, key=lambda x: self.ends.index(x[0]))), jets)

    def _held(self, s: sp.Symbol, end: sp.Expr) -> bool:
        field, (along, _) = self.jets.order(s)
        return self.jets.symbol(field, (along, 0)) in self.fixed[end]

    def _forces(self, L: Any, field: int, along: int) -> sp.Expr:
        """Return Σ (-d/dt)^i ∂L/∂w of the derivatives of a field along x of one order."""
        found = [s for s in self.jets.among(sp.sympify(L)) if self.jets.order(s)[0] == field]
        terms = [(self.jets.order(s)[1], s) for s in found]
        return sp.Add(*((-1) ** o[1] * self.jets.rate(sp.diff(L, s), o[1]) for o, s in terms if o[0] == along))

    def discretized(self, shapes: Sequence[Any], name: str = "a") -> AssumedModes:
        """Return T and V with w = Σ φ_i(x) a_i(t), the energies of a `Lagrangian`.

        Parameters
        ----------
        shapes : sequence of sympy.Expr, or of mappings of field to sympy.Expr
            φ_i(x), which keep what `fixed` says; of several fields each mode says its part of each, zero where it does
            not.
        name : str
            Of the coordinates: ``a1``, ``a2``, ...

        Raises
        ------
        InputError
            A shape that moves what is fixed (it is named), or holds parameters other than the ends.
        UnsupportedError
            Energies that are no polynomial of the fields and their derivatives.
        """
        return assumed_modes(self, shapes, name)

    def normal_modes(self, count: int, values: Mapping[Any, float]) -> NormalModes:
        """Return the first modes of free vibration, shapes and circular frequencies, by Ritz's method.

        Parameters
        ----------
        count : int
        values : mapping of sympy.Symbol or name to float
            Of every parameter.

        Raises
        ------
        InputError
            A parameter without a value.
        UnsupportedError
            Energies that are not quadratic, or with terms linear in the rates.
        NumericalError
            Frequencies that do not settle to ten digits, as with coefficients that are not smooth.
        """
        return normal_modes(self, count, values)

    def __repr__(self) -> str:
        fields = ", ".join(map(str, self.jets.fields))
        return one_line(f"<Continuum of {fields} from {self.ends[0]} to {self.ends[1]}>")

    def _repr_latex_(self) -> str:
        return f"${self.equations().latex()}$"


def _short(x: sp.Expr, jets: Jets, *, turned: bool = True) -> sp.Expr:
    """Return a sum over the derivatives of the fields, with the coefficient of each tidied."""
    moving = jets.among(x)
    if not moving or not x.is_polynomial(*moving):
        return tidy(x)
    terms = sp.Poly(x, *moving).terms()
    if turned and all(c.as_coeff_Mul()[0].is_negative for _, c in terms):
        terms = [(powers, -c) for powers, c in terms]
    return sp.Add(*(tidy(c) * sp.Mul(*(s**k for s, k in zip(moving, powers, strict=True))) for powers, c in terms))
