"""Hamilton's principle of one-dimensional continua: the partial differential equation and all boundary conditions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import sympy as sp
from sympy.core.function import AppliedUndef

from mbkit._escape import one_line, terminal
from mbkit.lagrangian.continua.densities import Densities
from mbkit.lagrangian.continua.jets import Jets
from mbkit.lagrangian.continua.ritz import AssumedModes, NormalModes, assumed_modes, normal_modes
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

    def _lines(self, written: Callable[[Iterable[sp.Expr]], str]) -> list[tuple[str, str, str]]:
        """Return the two sides of each equation, and where it holds: inertia, then the highest derivatives first."""

        def key(term: sp.Expr) -> tuple[int, int]:
            orders = [self._jets.order(a)[1] for a in self._jets.among(term)]
            carried = 2 if term.free_symbols & set(self._jets.accelerations) else 0
            return -max([carried, *(k for _, k in orders)]), -max((k for k, _ in orders), default=-1)

        def sides(x: sp.Eq, place: str = "") -> tuple[str, str, str]:
            return written(sorted(sp.Add.make_args(x.lhs), key=key)), written([x.rhs]), place

        at = written([self._jets.x])
        ends = (sides(x, f"{at} = {written([end])}") for end, x in self.boundary_conditions)
        return [*map(sides, self.field_equations), *ends]

    def latex(self) -> str:
        """Return the equations as an aligned LaTeX block; behind each boundary condition stands its place."""
        lines = self._lines(self._board.latex_of)
        return aligned((left, right + (rf" && ({place})" if place else "")) for left, right, place in lines)

    def __str__(self) -> str:
        lines = self._lines(self._board.text_of)
        texts = (f"{left} = {right}" + (f"   at {place}" if place else "") for left, right, place in lines)
        return terminal("\n".join(texts))


class Continuum(Densities):
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
        Fields of other arguments, an unknown end, an end's energy of a derivative that the continuum does not pass on.

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
                    # A fixed function stays zero, with all its rates.
                    balance = sign * sp.Add(*passed) + self._forces(own, k, j)
                    # A function of x stays one: the place stands beside the equation.
                    balance = balance if balance.atoms(AppliedUndef) else balance.subs(jets.x, end)
                    still = {s: 0 for s in jets.among(balance) if self._held(s, end)}
                    at_ends.append((end, sp.Eq(_short(-balance.subs(still), jets), 0, evaluate=False)))
        # An end that passes nothing on, as the free end of a turning string, takes every motion that stays finite.
        nontrivial = [pair for pair in at_ends if pair[1].lhs != 0]
        return FieldEquations(tuple(inside), tuple(sorted(nontrivial, key=lambda x: self.ends.index(x[0]))), jets)

    def _held(self, s: sp.Symbol, end: sp.Expr) -> bool:
        field, (along, _) = self.jets.order(s)
        return self.jets.symbol(field, (along, 0)) in self.fixed[end]

    def _forces(self, L: Any, field: int, along: int) -> sp.Expr:
        """Return Σ (-d/dt)^i ∂L/∂w of the derivatives of a field along x of one order."""
        derivatives = [s for s in self.jets.among(sp.sympify(L)) if self.jets.order(s)[0] == field]
        terms = [(self.jets.order(s)[1], s) for s in derivatives]
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
            A shape that moves a fixed place (it is named), or holds parameters other than the ends.
        UnsupportedError
            Energies that are no polynomial of the fields and their derivatives.
        """
        return assumed_modes(self, shapes, name)

    def normal_modes(self, count: int, values: Mapping[Any, float]) -> NormalModes:
        """Return the first modes of free vibration, shapes and circular frequencies, by Ritz's method.

        Forces that are linear in the fields count as stiffness; loads move the place of rest alone.

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
            Energies that are not quadratic, or with terms linear in the rates; forces of rates, not linear, or without
            a potential, as those that follow.
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
