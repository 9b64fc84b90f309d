"""Kinematics to equations to functions: mbkit's own derivation.

Start with `equations`: it derives M, the Coriolis and gravity terms, and both dynamics from T and V, as textbooks do.
`kinematics` gives it placements and twists, `model_values` the description's numbers as floats or symbols.
`link_equations` derives the same quantities with fewer operations: `links` regroups the tree, `link_mechanics` has the
forces, `gauss_elimination` the accelerations. `equations_of` chooses between both ways; the tests compare them.
Where elimination would lose digits, `least_constraint` takes its place; `constraints` adds loops and their multipliers.
`steps` writes a whole step of an integration method as one function.

In: a frozen `Model`. Out: CasADi functions of (q, v, ...), one for each quantity; nothing here runs them.
Callers: `engines.lagrangian`, which has `codegen` turn them into machine code; the oracle; `lagrangian`, for C code.
"""

from mbkit.derivation.equations import ELIMINATIONS, FUNCTIONS, Elimination, Equations
from mbkit.derivation.link_equations import LinkEquations, elimination_of, equations_of

__all__ = ["ELIMINATIONS", "FUNCTIONS", "Elimination", "Equations", "LinkEquations", "elimination_of", "equations_of"]
