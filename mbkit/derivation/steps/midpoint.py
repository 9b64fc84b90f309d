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
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, Final

import casadi as ca

from mbkit.derivation.equations import Equations
from mbkit.derivation.mass_matrix_solve import solve
from mbkit.derivation.steps.fixed import Part, function_of
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
#: Sum of squares of a state that counts as diverged, 1e100 squared.
_RUNAWAY: Final = 1e200


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
    return 1 - (ca.sumsqr(q) + ca.sumsqr(pi) < _RUNAWAY)
