"""Forces of friction on joints that rest, as expressions of a model whose joints slide or rest as parameters say."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any

import casadi as ca

from mbkit.derivation.equations import Equations
from mbkit.derivation.steps.fixed import Part, function_of
from mbkit.derivation.steps.symbols import SymbolicSpace, choose
from mbkit.model.changes.dry_friction import ROUNDING
from mbkit.model.parts import RESTING


def holding(equations: Equations, q: Any, v: Any, a: Any, force: Any, parameters: Any) -> Any:
    """Return the forces that an acceleration needs beside what acts, with `parameters` of rotors that turn."""
    needed = equations.function("inverse_dynamics")(q, v, a, parameters)
    return needed - equations.applied(q, force)


def phase_margin(equations: Equations, which: Sequence[int], sides: Sequence[str], locks: Sequence[str]) -> Part:
    """Return the part behind a step that tells how far its end is from that of its phase, ``margin1``.

    It is the least of the velocities `which`: the speed of one that slides, of one that rests the part of its bound
    that is left, and 1 of one without a side; negative beyond. `sides` and `locks` are the parameters of their sides
    and of rotors at rest. The part reads the largest forces at rest, ``bound``.
    """
    model, space, names = equations.model, SymbolicSpace(equations.model), list(equations.model.parameters)
    place, time = {name: i for i, name in enumerate(names)}, model.time_parameter

    def make() -> ca.Function:
        q, w, dt = ca.SX.sym("q1", model.nq), ca.SX.sym("w1", model.nv), ca.SX.sym("dt")
        tau, given = ca.SX.sym("tau", equations.force.numel()), ca.SX.sym("parameters", len(names))
        values = [x + dt * (name == time) for name, x in zip(names, ca.vertsplit(given), strict=True)]
        still, side = (ca.vertcat(*(values[place[x]] for x in of)) for of in (locks, sides))
        still, bound = still / RESTING, ca.SX.sym("bound", len(which))
        pick = ca.DM(ca.Sparsity.triplet(len(which), model.nv, list(range(len(which))), list(which)), 1.0)
        moves = 1 - ca.mtimes(pick.T, still)
        v = moves * space.to_body_velocity(q, w)
        a = moves * equations.function("forward_dynamics")(q, v, tau, ca.vertcat(*values))
        loose = [0.0 if name in {*locks} else x for name, x in zip(names, values, strict=True)]
        needed = ca.mtimes(pick, holding(equations, q, v, a, tau, ca.vertcat(*loose)))
        slides = 1 - ca.fabs(side) + side * ca.mtimes(pick, v)
        margins = choose(still, 1 + ROUNDING - ca.fabs(needed) / bound, slides)
        arguments = {"q1": q, "w1": w, "tau": tau, "dt": dt, "bound": bound, "parameters": given}
        return function_of("phase_margin", arguments, {"margin1": reduce(ca.fmin, ca.vertsplit(margins))})

    return Part("phase_margin", ("q1", "w1", "tau", "dt", "bound", "parameters"), ("margin1",), make)
