"""What every file of results begins with: the day, the versions of everything that computes, the processor."""

from __future__ import annotations

import datetime
from typing import Any

from mbkit.studies.results import processor, versions


def stamp() -> dict[str, Any]:
    return {"date": datetime.date.today().isoformat(), "versions": versions(), "processor": processor()}
