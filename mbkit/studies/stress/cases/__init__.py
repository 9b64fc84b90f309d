"""The cases of a study of stress, a family a file."""

from __future__ import annotations

from typing import Final, get_args

from mbkit.errors import require_known
from mbkit.studies.stress.case import TABLE, Case, Family

# They fill the table, in this order within a family.
from mbkit.studies.stress.cases import springs, rigid, loops  # noqa: F401  # isort: skip

__all__ = ["CASES", "get", "names"]

#: Name -> case, family by family.
CASES: Final = dict(sorted(TABLE.items(), key=lambda item: get_args(Family).index(item[1].family)))


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
    """Return the case of this name; `UnknownNameError` with near names where there is none."""
    require_known("case", CASES, name)
    return CASES[name]
