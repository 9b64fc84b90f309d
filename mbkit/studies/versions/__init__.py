"""`versions`: which version of an engine changed which number, and whether towards the truth."""

from mbkit.studies.versions.result import Change, VersionRow, VersionsResult
from mbkit.studies.versions.study import versions

__all__ = ["Change", "VersionRow", "VersionsResult", "versions"]
