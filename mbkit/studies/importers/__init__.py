"""One file through every engine's own importer, compared with the file as written."""

from mbkit.studies.importers.result import Parsed, ParserComparison, Stage
from mbkit.studies.importers.study import compare_parsers

__all__ = ["Parsed", "ParserComparison", "Stage", "compare_parsers"]
