"""A system's equations as a Python module that needs NumPy only."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import sympy as sp
from sympy.printing.numpy import NumPyPrinter

from mbkit._escape import identifier, python_docstring
from mbkit._version import __version__
from mbkit.errors import UnsupportedError
from mbkit.lagrangian.system import Lagrangian

#: Names that the module itself uses, beside Python's own.
_TAKEN: Final = {"np", "q", "v", "tau", "t", "M", "h", "out", "given", "unknown", "parameters", "PARAMETERS"}
_FUNCTIONS: Final = {"mass_matrix", "nonlinear", "forward_dynamics"}


def python_code(system: Lagrangian) -> str:
    """Return a module with `mass_matrix`, `nonlinear` and `forward_dynamics` of M(q) v̇ + h(q, v) = τ.

    Its functions take one state, and parameters by keyword. Constraints are refused (UnsupportedError).
    """
    if system.constraints:
        raise UnsupportedError(f"{system.name}: a system with constraints cannot be written as a Python module yet")
    e = system.equations()
    n = len(e.coordinates)
    no_inputs = dict.fromkeys(system.inputs.values(), sp.Integer(0))
    h = e.coriolis_force + e.drift + e.potential_gradient - e.forces.subs(no_inputs)
    names = _names(system)
    written = {s: sp.Symbol(name) for s, name in names.items()}
    upper = [e.mass_matrix[i, j] for i in range(n) for j in range(i, n)]
    clock = ", t=0.0" if system.time else ""
    own = [names[s] for s in system.parameters]
    take = "    unknown = set(parameters) - set(PARAMETERS)\n    if unknown:\n"
    take += '        raise TypeError(f"no such parameters: {sorted(unknown)}")\n'
    if own:
        take += "    given = PARAMETERS | parameters\n" + "".join(f"    {name} = given[{name!r}]\n" for name in own)
    coordinates = python_docstring(", ".join(s.name for s in e.coordinates))
    values = "".join(f"    {names[s]!r}: {x!r},\n" for s, x in system.parameters.items())
    unpack = f"{take}    {', '.join(names[s] for s in e.coordinates)}, = q\n"
    moving = unpack + f"    {', '.join(names[s] for s in e.velocities)}, = v\n"
    return f'''"""Equations of motion of {python_docstring(system.name)}: M(q) a + h(q, v) = tau, in SI units.

Coordinates q: {coordinates}. Written by mbkit {__version__}; needs NumPy only.
"""

import numpy as np

PARAMETERS = {{
{values}}}


def mass_matrix(q{clock}, **parameters):
    """Return M, ({n}, {n})."""
{unpack}{_body(upper, written)}
    M = np.zeros(({n}, {n}))
    M[np.triu_indices({n})] = out
    return M + np.triu(M, 1).T


def nonlinear(q, v{clock}, **parameters):
    """Return h, ({n},): Coriolis, gravity, springs, damping and other forces of the system."""
{moving}{_body(list(h), written)}
    return np.array(out, dtype=float)


def forward_dynamics(q, v, tau={(0.0,) * n!r}{clock}, **parameters):
    """Return a = M^-1 (tau - h), ({n},)."""
    h = nonlinear(q, v{", t" if clock else ""}, **parameters)
    return np.linalg.solve(mass_matrix(q{", t" if clock else ""}, **parameters), np.asarray(tau) - h)
'''


def _body(expressions: list[sp.Expr], written: dict[sp.Symbol, sp.Symbol]) -> str:
    used = {s.name for s in written.values()}
    fresh = (s for s in sp.numbered_symbols("x") if s.name not in used)
    shared, out = sp.cse([x.xreplace(written) for x in expressions], symbols=fresh, order="none")
    code: Callable[[Any], str] = NumPyPrinter({"fully_qualified_modules": True}).doprint
    lines = [f"    {s} = {code(x)}" for s, x in shared]
    return "\n".join([*lines, f"    out = [{', '.join(map(code, out))}]"]).replace("numpy.", "np.")


def _names(system: Lagrangian) -> dict[sp.Symbol, str]:
    """Return a Python name for each symbol."""
    out: dict[sp.Symbol, str] = {}
    if system.time:
        out[system.time] = "t"
    for s in (*system.parameters, *system.coordinates, *system.velocities):
        out[s] = identifier(s.name, _TAKEN | _FUNCTIONS | set(out.values()))
    return out
