"""Letters for roots that an equation holds in many places: ρ = √(l² - r² sin² θ)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any, Final

import sympy as sp

__all__ = ["Abbreviations"]

#: Operations of a root, and how often it stands somewhere, from which a letter is worth it.
_LONG: Final = 4
_OFTEN: Final = 3


class Abbreviations:
    """Letters for the long roots among some expressions.

    Parameters
    ----------
    expressions : iterable of sympy.Expr
    taken : iterable of sympy.Symbol
        Whose names are no letters to take.

    Attributes
    ----------
    roots : dict of sympy.Symbol to sympy.Expr
        ρ -> what it stands for; ρ1, ρ2 where there are several.
    """

    def __init__(self, expressions: Iterable[sp.Expr], taken: Iterable[sp.Symbol]) -> None:
        counts: Counter[sp.Expr] = Counter()
        found: set[sp.Expr] = set()
        for x in expressions:
            for part in sp.preorder_traversal(x):
                if part.is_Pow and part.base.is_Add and part.base.count_ops() >= _LONG:
                    counts[part.base] += 1
                    if part.exp.is_Rational and part.exp.q == 2:
                        found.add(part.base)
        # In the order in which they were met.
        bases = [base for base, n in counts.items() if base in found and n >= _OFTEN]
        names = {s.name for s in taken}
        letter = next(name for name in ("rho", "varrho", "rho_") if name not in names)
        letters = [letter] if len(bases) == 1 else [f"{letter}{k + 1}" for k in range(len(bases))]
        self.roots = {sp.Symbol(name): sp.sqrt(base) for name, base in zip(letters, bases, strict=True)}

    def __call__(self, x: Any) -> Any:
        """Return an expression or a matrix with the letters."""
        for letter, root in self.roots.items():
            base = root.base
            x = x.replace(lambda e, base=base: e.is_Pow and e.base == base, lambda e, s=letter: s ** (2 * e.exp))
        return x
