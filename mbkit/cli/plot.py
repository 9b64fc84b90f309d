"""`mbkit plot`: figures of the files that other commands wrote."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from mbkit.cli import _shared as shared
from mbkit.errors import InputError, MbkitError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@shared.command(
    "mbkit plot mbkit-report/cart_pole-trajectory.csv",
    "mbkit plot mbkit-report/panda.json mbkit-report/panda-bench.json --format svg --out figures",
    "mbkit plot mbkit-report/stress.json --case joint_spring",
)
@click.argument("files", metavar="FILE...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--case", metavar="NAME", help="Of a result of mbkit stress: the map of this case.")
@click.option("--format", "ending", type=click.Choice(["png", "svg"]), default="png", show_default=True)
@click.option("--out", type=click.Path(path_type=Path), help="Folder to fill.  [default: the folder of each FILE]")
@shared.force_option
def plot(files: tuple[Path, ...], case: str | None, ending: str, out: Path | None, force: bool) -> None:
    """Draw results that mbkit wrote.

    FILE is the CSV of mbkit simulate, or the JSON of mbkit check, mbkit bench or mbkit stress. The figure has the
    file's name. Exit status: 0 done, 2 misuse or bad input.
    """
    from mbkit.report.output_folder import check_replaceable, check_writable, write
    from mbkit.studies.svg import image

    stems = [(f"{file.stem}-{case}" if case else file.stem) for file in files]
    folders = [out or file.parent for file in files]
    if len({*zip(folders, stems, strict=True)}) < len(files):
        names = ", ".join(map(str, files))
        raise InputError(f"FILE...: expected files whose figures have different names, got {names}; plot them apart")
    for folder, stem in zip(folders, stems, strict=True):
        check_writable(folder)
        check_replaceable(folder, f"{stem}.{ending}", force=force)
    for file, folder, stem in zip(files, folders, stems, strict=True):
        content = image(_figure(file, case), ending)
        shared.tell(str(write(folder, f"{stem}.{ending}", content, force=force)))


def _figure(file: Path, case: str | None) -> Figure:
    """Return the figure of a file of any kind that mbkit writes."""
    from mbkit.simulate.plotting.time_series import plot_csv
    from mbkit.studies.compare.result import Comparison
    from mbkit.studies.stress.result import StressResult
    from mbkit.studies.work_precision.result import WorkPrecision

    try:
        text = file.read_text(encoding="utf-8")
        if file.suffix == ".csv" and case is None:
            return plot_csv(text, file.stem)
        data = json.loads(text)
        if "cases" in data:
            return StressResult.from_json(text).plot(case)
        if case is None and ("curves" in data or "rollouts" in data):
            return (WorkPrecision if "curves" in data else Comparison).from_json(text).plot()
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror or error}") from error
    except MbkitError as error:
        raise InputError(f"{file}: {error}") from None
    except (ValueError, TypeError, RecursionError):
        # Neither text nor JSON.
        pass
    expected = "JSON of mbkit stress, for --case"
    if case is None:
        expected = "CSV of mbkit simulate, or the JSON of mbkit check, bench or stress"
    raise InputError(f"{file}: expected the {expected}")
