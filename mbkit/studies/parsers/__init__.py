"""One file through every engine's own importer, compared stage by stage."""

from mbkit.studies.parsers.compare import compare_parsers
from mbkit.studies.parsers.result import Parsed, ParserComparison, Stage

__all__ = ["Parsed", "ParserComparison", "Stage", "compare_parsers"]
