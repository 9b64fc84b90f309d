"""The implicit midpoint rule in canonical coordinates and momenta, on the manifold, as parts of a step.

It is the variational integrator of the discrete Lagrangian (Marsden and West 2001,
Discrete mechanics and variational integrators, ch. 1.3)::

    L_d(q0, q1) = h L(q_m, w)      q_m = q0 moved by h w/2      q1 = q0 moved by h w

with w the velocity of `mbkit.model.integration_space`, constant over the step, and forces by the discrete
Lagrange-d'Alembert principle (ch. 3.2). So it is symplectic on T*Q, keeps what Noether's theorem keeps, and is its own
inverse under h -> -h. With μ = ∂L/∂w and f = ∂L/∂q plus all applied forces, both at (q_m, w), plain coordinates have ::

    p0 = μ - h/2 f      p1 = p0 + h f

the midpoint rule in (q, p). For a rotation with body-axes velocity, x = h w and its
angle θ = |x|, the functions of x̂ that the derivation leaves behind collapse to ::

    R0ᵀ π0 = dexp⁻¹(x) μ - h/2 (f + tan(θ/4)/θ x × f)      π1 = π0 + h R_m f

The momentum is carried as π = R p, in the axes of the joint's fixed frame: where no torque
acts it then stays what it is to the bit. The unknown of a step is w alone.

Where L depends on the time, L_d has it at the middle of the step: every step is still the one of
an autonomous system, and symplectic.

The midpoint rule in (q, p) under constraints f(q, t) = 0: RATTLE's form of it, symplectic on the manifold.

The discrete Lagrangian is that of `mbkit.derivation.steps.midpoint`, with f = 0 at both ends of each step (Marsden and
West 2001, Discrete mechanics and variational integrators, ch. 3.4 and 3.5). With J0 and J1 at the ends and the names of
that module, plain coordinates have ::

    p0 + J0ᵀ λ = μ - h/2 f_m      f(q1) = 0      p1 = p0 + J0ᵀ λ + h f_m + J1ᵀ κ      J1 v1 + ∂f/∂t = 0

λ takes q1 onto the constraints, and κ takes p1 = M v1 + b onto their tangent, as in RATTLE (Andersen 1983; Hairer,
Lubich, Wanner 2006, Geometric Numerical Integration, ch. VII.1.4), with the forces at the midpoint. The map from
(q0, p0) to (q1, p1) keeps the symplectic form of the constrained phase space, has order 2, and is its own inverse under
h -> -h. Rotations and free joints are those of the unconstrained rule: λ and κ are momenta that are added at the ends,
in the axes there.

The unknowns of a step are w and, behind it, λ.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, Final

import casadi as ca

from mbkit._check import BOUND
from mbkit.derivation.equations import Equations
from mbkit.derivation.mass_matrix_solve import solve
from mbkit.derivation.steps.fixed import Part, at_time, function_of
from mbkit.derivation.steps.rosenbrock import Factors
from mbkit.derivation.steps.symbols import SymbolicSpace
from mbkit.model import quaternions

#: Weights of the velocities of the last steps in the first guess of the next one, with which their parabola goes on.
GUESS_WEIGHTS: Final = (3.0, -3.0, 1.0)
#: Largest correction that is the last one needed, relative to the velocity: Newton's iteration leaves its square.
MAX_LAST_CORRECTION: Final = 1e-8
#: Largest move of the configuration that is the last one needed, rad, m, or relative to the coordinates.
MAX_LAST_MOVE: Final = 1e-12
#: Most iterations of Newton's method in a step: one that has not converged by then wanders about.
MAX_NEWTON_ITERATIONS: Final = 12


class _MomentumSpace(SymbolicSpace):
    """The integrators' space with its momenta: π of plain coordinates, and of rotations in fixed axes."""

    def toward(self, q: Any, u: Any) -> Any:
        """Return q moved by u, with quaternions of unit length only to rounding."""
        out = self.copied(q)
        for a, b in self._sums:
            out[a] = q[a] + u[b]
        for a, b in self._turns:
            turn = quaternions.exponential(self.arithmetic(q), self.components(u, b))
            self.put(out, a, quaternions.product(self.components(q, a), turn))
        return out

    def pullback(self, q: Any, gradient: Any) -> Any:
        """Return the derivative along `move` of what has this gradient in the coordinates."""
        out = ca.SX(self.nv, 1)
        for a, b in self._sums:
            out[b] = gradient[a]
        for a, b in self._turns:
            (*u, w), (*g, last) = self.components(q, a), self.components(gradient, a)
            turned = quaternions.cross(g, u)
            self.put(out, b, [0.5 * (w * g[i] + turned[i] - last * u[i]) for i in range(3)])
        return out

    def to_body(self, q: Any, pi: Any) -> Any:
        """Return momenta with those of rotations in body axes."""
        return self._turned(q, pi, quaternions.rotate_back)

    def to_fixed(self, q: Any, p: Any) -> Any:
        """Return momenta or forces with those of rotations in the axes of the joint's fixed frame."""
        return self._turned(q, p, quaternions.rotate)

    def _turned(self, q: Any, p: Any, turn: Any) -> Any:
        out = self.copied(p)
        for a, b in self._turns:
            self.put(out, b, turn(self.components(q, a), self.components(p, b)))
        return out

    def discrete(self, x: Any, mu: Any, f: Any, h: Any) -> Any:
        """Return the momentum at the start of a step, rotations' in body axes."""
        out = mu - (h / 2) * f
        for _, b in self._turns:
            angle = self.components(x, b)
            m, force = self.arithmetic(x), self.components(f, b)
            (*u, w) = quaternions.exponential(m, [c / 2 for c in angle])
            along = quaternions.dexp_inverse(m, angle, self.components(mu, b))
            # The vector part over the scalar part is tan(θ/4)/θ x.
            across = quaternions.cross([c / w for c in u], force)
            self.put(out, b, [along[i] - (h / 2) * (force[i] + across[i]) for i in range(3)])
        return out


class Midpoint:
    """The parts of a step of the implicit midpoint rule, and the way between v and momenta.

    Every function takes the equations' extra arguments behind its own.
    """

    carried = ("q", "pi")
    #: The names of the velocities of the last steps.
    past = ("w", "w_1", "w_2")
    #: The time that the parameters hold, in steps behind the start of one.
    clock = 0.5

    def __init__(self, equations: Equations) -> None:
        self._equations, self._space = equations, _MomentumSpace(equations.model)
        nq, nv = equations.model.nq, equations.model.nv
        #: Entries of a step's unknown.
        self.unknowns = self._size_of_unknowns()
        sizes = {"q": nq, **dict.fromkeys(("v", "v1", "pi"), nv), **dict.fromkeys(("w", "w_1", "w_2"), self.unknowns)}
        sizes |= {"tau": equations.force.numel(), **dict.fromkeys(("dt", "miss", "misses"), 1)}
        self._s = {**{name: ca.SX.sym(name, n) for name, n in sizes.items()}, **equations.extra_arguments}
        step = ("q", "pi", "w", "tau", "dt")
        #: One step of Newton's iteration, and 0 where it was the last one needed.
        self.newton = self._part("newton", step, ("w1", "miss"), self._newton)
        #: The parts of one such step: this one.
        self.iteration = (self.newton,)
        #: The same equation, to be solved elsewhere.
        self.system = self._part("system", step, ("residual", "jacobian"), self._system)
        #: The state after the step from its velocity w and those of the two before, the first guess of the next
        #: velocity, and the number of steps that were not solved or ended nowhere.
        ends = ("q", "pi", "w", "w_1", "w_2", "tau", "dt", "miss", "misses")
        self.end = self._part("end", ends, ("q1", "pi1", "guess", "misses1"), self._end)
        self.momentum = self._part("momentum", ("q", "v"), ("pi",), self._momentum)
        #: By the tree's sparse factorization of the mass matrix.
        self.velocity = self._part("velocity", ("q", "pi"), ("v",), self._velocity)
        #: M and M v, the momentum less what it is at rest, in mbkit's velocity, to be solved elsewhere.
        self.velocity_system = self._part("velocity_system", ("q", "pi"), ("M", "p"), self._velocity_system)
        #: Both equations of a step from (q, v) to v1, by its velocity w and by v1, and the new configuration; with
        #: the derivatives of the equations by the unknowns, and of all by q along the manifold, v, τ and parameters.
        whole = ("q", "v", "w", "v1", "tau", "dt")
        slopes = ("residual", "by_unknowns", "by_state", "q1", "q1_by_unknowns", "q1_by_state")
        self.slopes = self._part("slopes", whole, slopes, self._slopes)

    def _part(self, name: str, own: tuple[str, ...], writes: tuple[str, ...], make: Any) -> Part:
        name, reads = f"midpoint_{name}", (*own, *self._equations.extra_arguments)

        def function() -> ca.Function:
            return function_of(name, {n: self._s[n] for n in reads}, dict(zip(writes, make(), strict=True)))

        return Part(name, reads, writes, function)

    def _size_of_unknowns(self) -> int:
        return self._equations.model.nv

    def _at_midpoint(self, w: Any) -> tuple[Any, Any, Any]:
        """Return q_m, μ and f of a step with this velocity."""
        s = self._s
        q_m = self._space.toward(s["q"], (s["dt"] / 2) * w)
        mu, f = self._forces(q_m, w, s["tau"], *self._equations.extra_arguments.values())
        return q_m, mu, f

    @cached_property
    def _forces(self) -> ca.Function:
        """(q, w, tau) -> μ = ∂L/∂w and f = ∂L/∂q + τ + damping, along `move`."""
        eq, space = self._equations, self._space
        # Its own argument, of a velocity's size.
        w = self._s["v"]
        v = space.to_body_velocity(eq.q, w)
        kinetic = ca.substitute(eq.kinetic_energy, eq.v, v)
        applied = eq.tau + ca.substitute(eq.damping, eq.v, v)
        f = space.pullback(eq.q, ca.gradient(kinetic - eq.potential_energy, eq.q)) + space.to_integrator_force(
            eq.q, applied
        )
        arguments = [eq.q, w, eq.force, *eq.extra_arguments.values()]
        return ca.Function("forces", arguments, [ca.gradient(kinetic, w), f], {"cse": True})

    def _residual(self) -> Any:
        s = self._s
        _, mu, f = self._at_midpoint(s["w"])
        return self._space.discrete(s["dt"] * s["w"], mu, f, s["dt"]) - self._space.to_body(s["q"], s["pi"])

    def _system(self) -> tuple[Any, Any]:
        residual = self._residual()
        return residual, ca.jacobian(residual, self._s["w"])

    def _newton(self) -> tuple[Any, Any]:
        s = self._s
        # ∂ residual/∂w is M + O(h), with M's own zeros.
        residual, jacobian = self._system()
        factors = Factors.of(jacobian, self._equations.elimination_order)
        change = factors.applied(factors.values, ca.vertsplit(residual))
        w1 = s["w"] - change
        return w1, 1 - is_last(change, w1, s["q"], s["dt"])

    def _end(self) -> tuple[Any, ...]:
        s, h = self._s, self._s["dt"]
        q_m, _, f = self._at_midpoint(s["w"])
        q1 = self._space.retract(s["q"], h * s["w"])
        pi1 = s["pi"] + h * self._space.to_fixed(q_m, f)
        return q1, pi1, self._guess(), s["misses"] + s["miss"] + is_lost(q1, pi1)

    def _guess(self) -> Any:
        return sum(weight * self._s[n] for weight, n in zip(GUESS_WEIGHTS, self.past, strict=True))

    def _momentum(self) -> tuple[Any]:
        eq, s = self._equations, self._s
        p = ca.substitute(eq.momentum, ca.vertcat(eq.q, eq.v), ca.vertcat(s["q"], s["v"]))
        return (self._space.to_fixed(s["q"], self._space.to_integrator_force(s["q"], p)),)

    def _slopes(self) -> tuple[Any, ...]:
        eq, s, space = self._equations, self._s, self._space
        w, v1, h = s["w"], s["v1"], s["dt"]
        q_m, mu, f = self._at_midpoint(w)
        momentum = ca.Function("momentum", [s["q"], s["v"], *eq.extra_arguments.values()], [*self._momentum()])
        pi0 = momentum(s["q"], s["v"], *eq.extra_arguments.values())
        q1 = space.retract(s["q"], h * w)
        pi1 = momentum(q1, v1, *eq.extra_arguments.values())
        first = space.discrete(h * w, mu, f, h) - space.to_body(s["q"], pi0)
        residual = ca.vertcat(first, pi1 - pi0 - h * space.to_fixed(q_m, f))
        tangent = ca.substitute(ca.jacobian(eq.kin.qdot, eq.v), eq.q, s["q"])
        rest = ca.vertcat(s["v"], s["tau"], eq.parameters)

        def by_state(x: Any) -> Any:
            return ca.horzcat(ca.mtimes(ca.jacobian(x, s["q"]), tangent), ca.jacobian(x, rest))

        unknowns = ca.vertcat(w, v1)
        return (
            *(residual, ca.jacobian(residual, unknowns), by_state(residual)),
            *(q1, ca.jacobian(q1, unknowns), by_state(q1)),
        )

    def _velocity_system(self) -> tuple[Any, Any]:
        eq, s = self._equations, self._s
        at_rest = ca.substitute(eq.momentum, eq.v, ca.SX.zeros(eq.model.nv))
        M, b = (ca.substitute(x, eq.q, s["q"]) for x in (eq.mass_matrix, at_rest))
        return M, self._space.to_body_force(s["q"], self._space.to_body(s["q"], s["pi"])) - b

    def _velocity(self) -> tuple[Any]:
        return (solve(*self._velocity_system(), self._equations.elimination_order),)


def is_last(change: Any, w: Any, q: Any, h: Any) -> Any:
    """Return 1 where a correction of w was the last one needed, else 0."""
    # A NaN is not below anything.
    return ca.sumsqr(change) < MAX_LAST_CORRECTION**2 * ca.sumsqr(w) + (MAX_LAST_MOVE / h) ** 2 * (1 + ca.sumsqr(q))


def is_lost(q: Any, pi: Any) -> Any:
    """Return 1 where a state is beyond all bounds, else 0."""
    return 1 - (ca.sumsqr(q) + ca.sumsqr(pi) < BOUND**2)


#: Slope of a row without one, and mass along one that moves links without mass alone.
_MIN_SLOPE: Final = 1e-150


class ConstrainedMidpoint(Midpoint):
    """The parts of a step under constraints, with the names and arguments of `Midpoint`'s."""

    # Equations under constraints have more than `Equations`.
    _equations: Any

    def __init__(self, equations: Any) -> None:
        # Before the parts get their sizes.
        self._rows: int = equations.constraints.value.shape[0]
        super().__init__(equations)

    def _size_of_unknowns(self) -> int:
        return super()._size_of_unknowns() + self._rows

    @cached_property
    def _constraints(self) -> ca.Function:
        """(q) -> f, Jᵀ on the velocities of the integrators' space as columns, and ∂f/∂t."""
        eq, space = self._equations, self._space
        c = eq.constraints
        columns = [space.to_integrator_force(eq.q, c.jacobian[i, :].T) for i in range(self._rows)]
        outs = [c.value, ca.horzcat(ca.SX(eq.model.nv, 0), *columns), c.by_time]
        return ca.Function("constraints", [eq.q, *eq.extra_arguments.values()], outs)

    @cached_property
    def _held(self) -> ca.Function:
        """(q, p) -> v with J v + ∂f/∂t = 0 and κ of M v + b = p + Jᵀ κ, in mbkit's velocity."""
        eq = self._equations
        p = ca.SX.sym("p", eq.model.nv)
        at_rest = ca.substitute(eq.momentum, eq.v, ca.SX.zeros(eq.model.nv))
        outs = eq.constraint_factors.solved(p - at_rest, -eq.constraints.by_time)
        return ca.Function("held", [eq.q, p, *eq.extra_arguments.values()], [*outs])

    def _at(self, part: float) -> Any:
        """Return the extra arguments this part of a step behind its middle, at which they are given."""
        return at_time(self._equations, part * self._s["dt"]).values()

    def _split(self) -> tuple[Any, Any]:
        w, multipliers = ca.vertsplit(self._s["w"], [0, self._equations.model.nv, self.unknowns])
        return w, multipliers

    def _whole(self, w: Any, multipliers: Any) -> tuple[Any, Any, Any]:
        """Return the residual of the momentum, of the constraints at the end over the step, and J0ᵀ."""
        s = self._s
        _, mu, f = self._at_midpoint(w)
        _, pushes, _ = self._constraints(s["q"], *self._at(-0.5))
        start = self._space.to_body(s["q"], s["pi"]) + ca.mtimes(pushes, multipliers)
        momentum = self._space.discrete(s["dt"] * w, mu, f, s["dt"]) - start
        end = self._constraints(self._space.retract(s["q"], s["dt"] * w), *self._at(0.5))[0]
        return momentum, end / s["dt"], pushes

    def _system(self) -> tuple[Any, Any]:
        momentum, end, _ = self._whole(*self._split())
        residual = ca.vertcat(momentum, end)
        return residual, ca.jacobian(residual, self._s["w"])

    def _newton(self) -> tuple[Any, Any]:
        s, eq = self._s, self._equations
        w, multipliers = self._split()
        # λ enters linearly, and each iteration solves for it: the residual without it is that of w.
        momentum, end, pushes = self._whole(w, 0 * multipliers)
        by_w, slopes = ca.jacobian(momentum, s["w"])[:, : eq.model.nv], ca.jacobian(end, s["w"])[:, : eq.model.nv]
        if eq.constraint_factors.careful:
            weight = ca.mtimes(pushes, ca.diag(self._masses(s["q"], *self._at(-0.5))))
            momentum, by_w = momentum + ca.mtimes(weight, end), by_w + ca.mtimes(weight, slopes)
        factors = Factors.of(by_w, eq.elimination_order)
        free, *columns = (
            factors.applied(factors.values, ca.vertsplit(x)) for x in (momentum, *ca.horzsplit(ca.densify(pushes)))
        )
        Y = ca.horzcat(*columns)
        # (A - J0ᵀ; C 0) (dw; λ) = -(momentum; end): C A⁻¹ J0ᵀ λ = C A⁻¹ momentum - end.
        S = Factors.of(ca.mtimes(slopes, Y), range(self._rows))
        new = S.applied(S.values, ca.vertsplit(ca.mtimes(slopes, free) - end))
        change = free - ca.mtimes(Y, new)
        return ca.vertcat(w - change, new), 1 - is_last(change, w - change, s["q"], s["dt"])

    @cached_property
    def _masses(self) -> ca.Function:
        """(q) -> s > 0 of each row, the mean mass along it: J0ᵀ diag(s) J1 has an inverse where the mass has none.

        The term is zero with the constraints, and as heavy as the links that are not without mass.
        """
        eq = self._equations
        squares, masses = eq.constraints.jacobian**2, ca.diag(eq.mass_matrix)
        out = (ca.mtimes(squares, masses) + _MIN_SLOPE) / (ca.sum2(squares) + _MIN_SLOPE) ** 2
        return ca.Function("masses", [eq.q, *eq.extra_arguments.values()], [out])

    def _end(self) -> tuple[Any, ...]:
        s, h, space = self._s, self._s["dt"], self._space
        w, multipliers = self._split()
        q_m, _, f = self._at_midpoint(w)
        q1 = space.retract(s["q"], h * w)
        _, pushes, _ = self._constraints(s["q"], *self._at(-0.5))
        pi1 = s["pi"] + space.to_fixed(s["q"], ca.mtimes(pushes, multipliers)) + h * space.to_fixed(q_m, f)
        _, pushes1, _ = self._constraints(q1, *self._at(0.5))
        _, kappa = self._held(q1, space.to_body_force(q1, space.to_body(q1, pi1)), *self._at(0.5))
        pi1 = pi1 + space.to_fixed(q1, ca.mtimes(pushes1, kappa))
        return q1, pi1, self._guess(), s["misses"] + s["miss"] + is_lost(q1, pi1)

    def _velocity(self) -> tuple[Any]:
        s, space = self._s, self._space
        p = space.to_body_force(s["q"], space.to_body(s["q"], s["pi"]))
        return (self._held(s["q"], p, *self._equations.extra_arguments.values())[0],)
