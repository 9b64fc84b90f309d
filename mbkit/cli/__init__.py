"""The command `mbkit`: checks arguments, calls the library, prints, and says how it ended.

Exit status: 0 done, and the engines agree (or are as a baseline has them), 1 they differ, a run diverged or is
doubtful, or a file has findings that are sure or likely, 2 misuse or bad input,
70 a fault of mbkit's own, 130 interrupted.
"""

from __future__ import annotations

import os
import sys

import click

from mbkit._version import __version__
from mbkit.cli import baseline, bench_and_stress, check_and_lint, derive, descriptions, simulate_and_plot
from mbkit.cli._shared import CommandGroup


@click.group(
    cls=CommandGroup,
    context_settings={"help_option_names": ["-h", "--help"]},
    examples=("mbkit check panda", "mbkit simulate cart_pole --q0 0,1", "mbkit COMMAND --help"),
)
@click.version_option(__version__, prog_name="mbkit")
def cli() -> None:
    """Equations of motion that can be trusted: Pinocchio, MuJoCo and an own derivation, compared."""
    if os.environ.get("MBKIT_CPU"):
        # A study would take it for an engine that failed, and go on without it.
        from mbkit.codegen import jit

        jit.host()


for _command in (
    *(check_and_lint.check, check_and_lint.lint, descriptions.diff, baseline.baseline, derive.derive, derive.export),
    *(simulate_and_plot.simulate, simulate_and_plot.plot, bench_and_stress.bench, bench_and_stress.stress),
    *(descriptions.convert, descriptions.robots),
):
    cli.add_command(_command)


def main() -> None:
    """Run the command."""
    # Nothing is drawn with MuJoCo here, and its import would start a process that looks for a window system.
    os.environ.setdefault("MUJOCO_GL", "disable")
    for stream in (sys.stdout, sys.stderr):
        # Marks and units are not ASCII, whatever the locale says.
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(encoding="utf-8", errors="backslashreplace")
    cli()
