"""Every robot of example-robot-data through the importers of engines in which robots are trained.

Run ``python -m validation.importers_trained``; it writes ``validation/importers_trained.json``, with the base held
still, robot by robot: some minutes, and environments of 600 MB each.
"""

from __future__ import annotations

from validation.importers import FEW, trained

ENGINES = ["newton", "mujoco-warp", "mjx"]


#: See `validation.smoke`.
SMOKE = {"ENGINES": ["mujoco"], "importers.ROBOTS": FEW[:1]}


def main() -> None:
    """Measure, and write after each robot."""
    trained(ENGINES)


if __name__ == "__main__":
    main()
