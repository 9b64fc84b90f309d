"""The tests of engines in environments of their own, which the suite skips where these are not there.

Run ``python -m validation.environments``; environments are made where they are missing, 3 GB in all. Exit status 1 if a
test fails, or skips for want of an environment.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys

from mbkit.engines.remote import environment
from mbkit.engines.remote.packages import engine

ENGINES = ("newton", "mujoco-warp", "mjx", "mjx-single")
TESTS = (
    "tests/test_trained_engines.py",
    "tests/test_engine_versions.py::test_a_real_old_version",
)
OPTIONS = ("-n", "0", "-rs")
#: See `validation.smoke`.
SMOKE = {"ENGINES": (), "OPTIONS": ("-n", "0", "--collect-only")}


def main() -> int:
    for name in ENGINES:
        print(f"{name}: {engine(name).interpreter()}", flush=True)
    folder = str(environment.folder())
    own = {"MBKIT_ENVIRONMENTS": folder, "MBKIT_TEST_ENVIRONMENTS": folder}
    top = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    command = [sys.executable, "-m", "pytest", *OPTIONS, *TESTS]
    run = subprocess.run(command, cwd=top, env=os.environ | own, capture_output=True, text=True)
    print(run.stdout, run.stderr)
    skipped = re.findall(r"^SKIPPED.*environment.*", run.stdout, re.MULTILINE)
    return int(bool(run.returncode or skipped))


if __name__ == "__main__":
    sys.exit(main())
