"""The tests keep their machine code apart, and interpret what they evaluate once."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

# Before anything is compiled, in every worker and in what the tests start: trees that
# are used once are not worth a compiler, and no test reads what an earlier run left.
os.environ.setdefault("MBKIT_COMPILE", "0")
os.environ["MBKIT_CACHE_DIR"] = str(
    Path(tempfile.gettempdir()) / f"mbkit-tests-{os.environ.get('PYTEST_XDIST_TESTRUNUID', os.getpid())}"
)
# heyoka keeps compiled code of its own.
os.environ["HEYOKA_CACHE_DIR"] = os.environ["MBKIT_CACHE_DIR"] + "-heyoka"
