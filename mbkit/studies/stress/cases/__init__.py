"""The cases of a study of stress, a family a file."""

from __future__ import annotations

from typing import Final

from mbkit.errors import UnknownNameError
from mbkit.studies.stress.case import Case
from mbkit.studies.stress.cases import loops, rigid, springs

__all__ = ["CASES", "get", "names"]

_FAMILIES: Final = (
    *(springs.CASES, loops.DRIVEN_CASES, rigid.MASS_CASES, loops.REDUNDANT_CASES, rigid.LENGTH_CASES),
    *(rigid.SPIN_CASES, rigid.SINGULAR_CASES, loops.SINGULAR_CASES, rigid.LARGE_CASES, springs.STEP_CASES),
    *(springs.LONG_CASES, loops.LONG_CASES),
)
#: Name -> case: stiff ones first, those that take longest last.
CASES: Final[dict[str, Case]] = {case.name: case for family in _FAMILIES for case in family}


def names() -> tuple[str, ...]:
    """Return the cases' names.

    Examples
    --------
    >>> from mbkit.studies.stress import cases
    >>> cases.names()[:3]
    ('joint_spring', 'lightly_damped_joint_spring', 'critically_damped_joint_spring')
    """
    return tuple(CASES)


def get(name: str) -> Case:
    """Return the case of this name.

    Raises
    ------
    UnknownNameError
        With near names.
    """
    if name not in CASES:
        raise UnknownNameError("case", str(name), CASES)
    return CASES[name]
