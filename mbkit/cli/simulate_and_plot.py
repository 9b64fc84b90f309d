"""`mbkit simulate`: a motion as a table and figures; `mbkit plot`: figures of files that commands wrote."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mbkit.cli import _shared as shared
from mbkit.cli._shared import DIFFER, DONE, Report
from mbkit.errors import InputError, MbkitError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mbkit.engines import Dynamics
    from mbkit.model import Model
    from mbkit.simulate import Trajectory


@shared.command(
    "mbkit simulate cart_pole --q0 0,1 --duration 3",
    "mbkit simulate panda --q0 random:0 --engine lagrangian --method rk853 --rtol 1e-9",
    "mbkit simulate arm.urdf --dt 5e-4 --save 100 --out runs --json",
)
@click.argument("target")
@click.option("--engine", metavar="NAME", help="[default: pinocchio; lagrangian for loops and systems on paper]")
@click.option("--method", metavar="NAME", help="Integrator.  [default: rk4]")
@click.option("--duration", default=1.0, show_default=True, type=float, help="Length of the motion, s.")
@click.option("--dt", type=float, help="Step of a fixed-step method, s.  [default: 1e-3]")
@click.option("--rtol", type=float, help="Tolerance of an adaptive method.  [default: 1e-10]")
@click.option("--q0", default="neutral", show_default=True, metavar="STATE", help="neutral, random:SEED or 1,-0.5.")
@click.option("--v0", default="neutral", show_default=True, metavar="STATE", help="Its velocity; neutral is rest.")
@click.option("--t0", type=float, help="First time, s, of motions and forces in time.  [default: the model's]")
@click.option("--torque", metavar="STATE", help="Constant torque, such as 1,-0.5.  [default: none]")
@click.option("--saturate", is_flag=True, help="Clip the torque to the effort limits.")
@click.option("--save", type=click.IntRange(min=1), metavar="N", help="Keep the start and N more states, evenly.")
@shared.load_options
@shared.report_options
def simulate(
    target: str, q0: str, v0: str, save: int | None, options: dict[str, Any], report: Report, **settings: Any
) -> None:
    """Simulate TARGET, and write its trajectory and figures.

    TARGET is what `mbkit check` takes, also with loops. A CSV file has t, q and v of each state; a figure has
    coordinates, velocities and energies over time, and another one the motion as stick figures. Exit status:
    0 finished, 1 diverged or doubtful, 2 misuse or bad input.
    """
    import numpy as np

    from mbkit.simulate import simulate as integrate
    from mbkit.studies._targets import model_of

    report.prepare()
    model = model_of(target, options)
    stem = shared.stem_of(target, model.name)
    for name, ending in (("trajectory", "csv"), ("plot", "png"), ("picture", "png")):
        report.prepare(f"{stem}-{name}", ending)
    dyn = _dynamics(model, settings.pop("engine"))
    start = _state("--q0", q0, dyn.model, 0), _state("--v0", v0, dyn.model, 1)
    settings["torque"] = settings["torque"] and _state("--torque", settings["torque"], dyn.model, 1)
    first = dyn.model.time if settings["t0"] is None else settings["t0"]
    times = None if save is None else first + np.linspace(0.0, settings["duration"], save + 1)
    run = integrate(dyn, *start, save=times, progress=True, **{k: x for k, x in settings.items() if x is not None})
    paths = _write(run, report, stem)
    if report.as_json:
        shared.tell(_json(run))
        shared.say("written", " ".join(paths))
    else:
        _show(run)
        shared.tell("\n".join(paths))
    shared.leave(DONE if run.stats.finished and not run.stats.doubts else DIFFER)


def _dynamics(model: Model, engine: str | None) -> Dynamics:
    from mbkit.engines.registry import ENGINES, PINOCCHIO, dynamics

    derived = next(name for name, info in ENGINES.items() if info.derived)
    return dynamics(model, engine or (PINOCCHIO if model.has_bodies else derived))


def _state(option: str, text: str, model: Model, which: int) -> Any:
    """Return a start of coordinates (`which` is 0) or velocities (1)."""
    import numpy as np

    kind, _, seed = text.partition(":")
    if text == "neutral":
        return np.zeros(model.nv) if which else model.neutral()
    with suppress(ValueError):
        return model.random_state(int(seed))[which] if kind == "random" else np.array(text.split(","), dtype=float)
    count = f"{model.nv if which else model.nq} numbers such as 0.1,-0.2"
    raise InputError(f"{option}: expected neutral, random:SEED or {count}, got {text!r}")


def _write(run: Trajectory, report: Report, stem: str) -> list[str]:
    from mbkit.report.output_folder import write
    from mbkit.studies.svg import image

    contents: dict[str, Any] = {"trajectory.csv": run.to_csv, "plot.png": lambda: image(run.plot())}
    if run.model.has_bodies:
        contents["picture.png"] = lambda: image(run.picture())
    return [str(write(report.out, f"{stem}-{name}", make(), force=report.force)) for name, make in contents.items()]


def _json(run: Trajectory) -> str:
    from mbkit.studies.results import to_plain, versions

    names = {"q": run.model.coordinate_names, "v": run.model.velocity_names}
    last = {x: dict(zip(names[x], getattr(run, x)[-1].tolist(), strict=True)) for x in "qv"}
    data = {"model": run.model.name, "engine": run.engine, "method": run.method, "finished": run.stats.finished}
    data |= {"stats": asdict(run.stats), "doubts": run.stats.doubts, "final": {"t": float(run.t[-1]), **last}}
    return json.dumps(to_plain(data | {"versions": versions()}), indent=1)


def _show(run: Trajectory) -> None:
    shared.tell(f"{run.model.name}: {run.method} on {run.engine}, {len(run.t)} states to {run.t[-1]:g} s; {run.stats}")
    with suppress(MbkitError):
        shared.tell(f"largest |E - E(0) - work|: {abs(run.power_balance()).max():.2g} J")
    for x, names in (("q", run.model.coordinate_names), ("v", run.model.velocity_names)):
        width = max(map(len, names), default=0)
        for name, (start, end) in zip(names, getattr(run, x)[[0, -1]].T.tolist(), strict=True):
            shared.tell(f"  {x} {name:<{width}}  {start:>12.6g} -> {end:>12.6g}")


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
