"""`lint`: is a description plausible by what it knows of itself."""

from mbkit.studies.lint.checks import CHECKS
from mbkit.studies.lint.result import LintFinding, LintResult
from mbkit.studies.lint.study import lint

__all__ = ["CHECKS", "LintFinding", "LintResult", "lint"]
