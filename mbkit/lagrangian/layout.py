"""Text within a width: sums on several lines, matrices in brackets."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import sympy as sp

__all__ = ["folded", "matrix"]

#: Dots above letters take no column.
_MARKS: Final = "\u0307\u0308"
_LOW: Final = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def matrix(name: str, A: sp.ImmutableMatrix, text: Callable[[sp.Expr], str], width: int) -> list[str]:
    """Return a matrix in brackets, or its entries one a line where it is too wide."""
    cells = [[text(x) for x in A[i, :]] for i in range(A.rows)]
    widths = [max(_width(row[j]) for row in cells) for j in range(A.cols)]
    if sum(widths) + 3 * A.cols + 4 <= width:
        edges = "[]" if A.rows == 1 else ("⎡⎤", *("⎢⎥",) * (A.rows - 2), "⎣⎦")
        rows = zip(cells, edges if A.rows > 1 else (edges,), strict=True)
        return [
            f"  {edge[0]} {'   '.join(c + ' ' * (w - _width(c)) for c, w in zip(row, widths, strict=True))} {edge[1]}"
            for row, edge in rows
        ]
    out = []
    symmetric = name == "M"
    for i in range(A.rows):
        for j in range(i if symmetric else 0, A.cols):
            if cells[i][j] != "0":
                place = f"{i + 1}{j + 1}" if A.cols < 10 else f"{i + 1},{j + 1}"
                if A.cols == 1:
                    place = str(i + 1) if A.rows > 1 else ""
                equal = f" = {name}{f'{j + 1}{i + 1}'.translate(_LOW)}" if symmetric and i != j and A.cols < 10 else ""
                out += folded(f"  {name}{place.translate(_LOW)}{equal} = {cells[i][j]}", width)
    return out


def _width(text: str) -> int:
    """Return how many columns a text takes: dots above letters take none."""
    return sum(c not in _MARKS for c in text)


def folded(text: str, width: int) -> list[str]:
    """Return a sum on lines of a width, broken before + and - outside of brackets where there are such."""
    out: list[str] = []
    indent = " " * (len(text) - len(text.lstrip()) + 6)
    while _width(text) > width:
        places, depth, column = [], 0, 0
        for k, c in enumerate(text):
            column += c not in _MARKS
            if column > width:
                break
            depth += (c in "([") - (c in ")]")
            if k > len(indent) + 2 and text[k : k + 3] in (" + ", " - ", " = "):
                places.append((depth, -k))
        if not places:
            break
        # The last place on the line that is within the fewest brackets.
        cut = -min(places)[1]
        out.append(text[:cut])
        text = indent + text[cut + 1 :]
    return [*out, text]
