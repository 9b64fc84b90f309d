"""Forces that hold joints at rest, as expressions of a model whose joints slide or rest as parameters say."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any

import casadi as ca
import numpy as np

from mbkit.derivation.equations import Equations
from mbkit.derivation.steps.fixed import Part, function_of
from mbkit.derivation.steps.symbols import SymbolicSpace, choose
from mbkit.model.parts import POSE_ROUNDING, RESTING, ROUNDING, STOPPED


def holding(equations: Equations, q: Any, v: Any, a: Any, force: Any, parameters: Any) -> Any:
    """Return the forces that an acceleration needs beside what acts, with `parameters` of rotors that turn."""
    needed = equations.function("inverse_dynamics")(q, v, a, parameters)
    return needed - equations.applied(q, force)


def phase_margin(equations: Equations, which: Sequence[int], sides: Sequence[str], locks: Sequence[str]) -> Part:
    """Return the part behind a step that tells how far its end is from that of its phase.

    It writes ``margins1`` of the velocities `which`, and the least of them, ``margin1``: the speed of one that slides,
    of one that rests the part of its bound that is left, and 1 of one without a side; negative beyond. `sides` and
    `locks` are the parameters of their sides and of rotors at rest. The part reads the largest forces at rest,
    ``bound``. A margin is NaN where the parts of bounds are those of a linear program, as what rests follows from more
    than one locked velocity.
    """
    model, space, names = equations.model, SymbolicSpace(equations.model), list(equations.model.parameters)
    place, time = {name: i for i, name in enumerate(names)}, model.time_parameter

    def make() -> ca.Function:
        q, w, dt = ca.SX.sym("q1", model.nq), ca.SX.sym("w1", model.nv), ca.SX.sym("dt")
        tau, given = ca.SX.sym("tau", equations.force.numel()), ca.SX.sym("parameters", len(names))
        values = [x + dt * (name == time) for name, x in zip(names, ca.vertsplit(given), strict=True)]
        locked, side = (ca.vertcat(*(values[place[x]] for x in of)) for of in (locks, sides))
        locked, bound = locked > 0, ca.SX.sym("bound", len(which))
        still = (side == 0) * (bound > 0)
        pick = ca.DM(ca.Sparsity.triplet(len(which), model.nv, list(range(len(which))), list(which)), 1.0)
        ends = space.to_body_velocity(q, w)
        v = (1 - ca.mtimes(pick.T, still)) * ends
        a = equations.function("forward_dynamics")(q, v, tau, ca.vertcat(*values))
        speeds = ca.mtimes(pick, v)
        if model.constrained:
            loose = [0.0 if name in {*locks} else x for name, x in zip(names, values, strict=True)]
            needed = holding(equations, q, v, (1 - ca.mtimes(pick.T, still)) * a, tau, ca.vertcat(*loose))
            moved = _ways(equations, which)(q, ca.vertcat(*values))
            used = _shared(ca.mtimes(pick, moved), ca.mtimes(moved.T, needed), bound, still, locked)
            # A joint that rows alone hold moves as soon as they do.
            size = reduce(ca.fmax, ca.vertsplit(ca.fabs(ends)), ca.SX(1.0))
            left = choose(locked, 1.0, 1 - ca.fabs(ca.mtimes(pick, ends)) / (POSE_ROUNDING * size))
            left = ca.fmin(1 + ROUNDING - used, left)
        else:
            # What holds a joint accelerates its rotor.
            left = 1 + ROUNDING - RESTING * ca.fabs(ca.mtimes(pick, a)) / bound
        margins = choose(still, left, choose(side == 0, 1.0, side * speeds - STOPPED))
        arguments = {"q1": q, "w1": w, "tau": tau, "dt": dt, "bound": bound, "parameters": given}
        results = {"margin1": reduce(ca.fmin, ca.vertsplit(margins)), "margins1": margins}
        return function_of("phase_margin", arguments, results)

    return Part("phase_margin", ("q1", "w1", "tau", "dt", "bound", "parameters"), ("margin1", "margins1"), make)


def _ways(equations: Any, which: Sequence[int]) -> ca.Function:
    """Return (q, parameters) -> velocities by rows for 1 of one of `which` and 0 of what is locked, (nv, k)."""
    J = equations.constraints.jacobian
    unit = ca.DM(ca.Sparsity.triplet(J.shape[1], len(which), list(which), list(range(len(which)))), 1.0)
    moved = unit - equations.constraint_factors.change(ca.mtimes(J, unit))
    return ca.Function("ways", [equations.q, *equations.extra_arguments.values()], [ca.densify(moved)])


def _shared(ways: Any, needed: Any, bound: Any, still: Any, locked: Any) -> Any:
    """Return the parts of their bounds that velocities at rest have of the forces `needed` along ways, (k,).

    `ways` has the velocities by each of them that is locked, (k, k).
    """
    k = bound.numel()
    follows = choose(ca.repmat(locked.T, k, 1) * ca.repmat(still, 1, k) * (ca.fabs(ways) > POSE_ROUNDING), ways, 0.0)
    part = choose(locked, ca.fabs(needed) / ca.mtimes(ca.fabs(follows.T), bound), 0.0)
    links = follows != 0
    return ca.mtimes(links, part) + choose(ca.sum2(links) > 1, np.nan, 0.0)
