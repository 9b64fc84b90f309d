"""`mbkit derive` and `mbkit export`: the equations of motion to read, and as C."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from inspect import getdoc
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from mbkit._escape import json_text
from mbkit._version import __version__
from mbkit.cli import _shared as shared
from mbkit.cli._shared import say, tell

if TYPE_CHECKING:
    from mbkit.codegen.c_source import CSource
    from mbkit.lagrangian.system import Lagrangian
    from mbkit.model import Model

_C_FOLDER: Final = "mbkit-export"


@shared.command(
    "mbkit derive cart_pole", "mbkit derive double_pendulum --latex --out equations", "mbkit derive kepler --python"
)
@click.argument("system")
@click.option("--latex", is_flag=True, help="Print LaTeX.")
@click.option("--python", is_flag=True, help="Print a Python module that needs NumPy only.")
@click.option("--c", is_flag=True, help="Write C99, as mbkit export does.")
@click.option(
    "--program",
    "quantity",
    metavar="QUANTITY",
    help="Print one quantity, such as inverse_dynamics, as named terms: s1, c2, x7, ... Takes robots of any size.",
)
@shared.load_options
@click.option(
    "--snap",
    type=click.FloatRange(0.0, 1e-2),
    default=1e-9,
    show_default=True,
    help="To read: take entries of rotations this near to 0 or 1 as exact. --python and --c take them as they are.",
)
@shared.json_option
@click.option("--out", type=click.Path(path_type=Path), help="Folder to write to, instead of printing.")
@shared.force_option
def derive(
    system: str,
    quantity: str | None,
    options: dict[str, Any],
    snap: float,
    as_json: bool,
    out: Path | None,
    force: bool,
    **forms: bool,
) -> None:
    """Print T, V, M, C, g and the equation of motion of SYSTEM, and what it conserves.

    SYSTEM is a catalog system, a system on paper such as kepler, a small robot, a path to a URDF or MJCF file, or
    package.module:function for a function that returns a Model or a Lagrangian. Where catalog and paper
    have the same name, NAME is the catalog's, or paper's where the catalog's has a quaternion or a loop;
    mbkit.catalog:NAME and mbkit.lagrangian.systems:NAME are always the one and the other.
    """
    chosen = [name for name, on in forms.items() if on]
    if len(chosen) > 1:
        raise click.UsageError(f"{' and '.join(f'--{name}' for name in chosen)} exclude each other; give one")
    form = chosen[0] if chosen else None
    if as_json and quantity:
        raise click.UsageError("--json and --program exclude each other; --program has --python, --latex and --c")
    if as_json and form:
        raise click.UsageError(f"--json and --{form} exclude each other: the JSON holds the equations in both forms")
    from mbkit.report.output_folder import check_writable, write

    if out is not None:
        check_writable(out)
    target = _model(system, options)
    from mbkit.lagrangian.energies.charts import chart_names
    from mbkit.lagrangian.energy_model import EnergyModel
    from mbkit.lagrangian.from_description import from_model
    from mbkit.lagrangian.summary import in_symbols, letters
    from mbkit.model.changes.jumps import held_at_rest
    from mbkit.simulate.progress import Bar

    on_paper = isinstance(target, EnergyModel)
    if quantity is not None:
        text, ending = _program(target, quantity, form, snap)
        stem = shared.stem_of(system, target.name)
        tell(text if out is None else str(write(out, f"{stem}{ending}", text + "\n", force=force)))
        return
    if form == "c":
        model = target if on_paper else in_symbols(target) or target
        _tell_functions(*_write_c(model, system, out or Path(_C_FOLDER), force))
        return
    if form != "python" and not on_paper:
        target = _to_read(target, snap, "equations")
    with Bar(f"derive {target.name}") as bar:
        names = None if on_paper else letters(target)
        lag = from_model(target, coordinates=names, progress=lambda x, text: bar(0.1 * x, text))
        # Prescribed joints are no coordinates of the equation.
        described = target.coordinate_names if on_paper else chart_names(target)
        own = dict(zip(names or described, described, strict=True))
        text, ending = _text(lag, own, form, as_json, bar, held_at_rest(target))
    if out is None:
        tell(text)
        return
    if ending == ".txt":
        # By this line mbkit knows its own file.
        text += f"\n\nWritten by mbkit {__version__}"
    tell(str(write(out, f"{shared.stem_of(system, lag.name)}{ending}", text + "\n", force=force)))


def _model(name: str, options: dict[str, Any]) -> Model:
    """Return what a name stands for; one that the catalog lacks, or has with quaternions or loops, is paper's."""
    from mbkit import catalog
    from mbkit.errors import UnknownNameError
    from mbkit.lagrangian import systems
    from mbkit.load.loader import find
    from mbkit.studies._targets import model_of

    model = catalog.systems()[name]() if name in catalog.systems() and not options else None
    if name in systems.names() and not options and (model is None or model.quaternions or model.needs.loops):
        if model is not None and model.needs.loops:
            other = f"the catalog's has bodies and a loop, and mbkit derive mbkit.catalog:{name} takes that one"
            say("note", f"{name} is in independent coordinates here; {other}")
        elif model is not None:
            say("note", f"{name} is in Euler angles here; the catalog's has a quaternion, which mbkit check takes")
        say("note", _about(systems.get(name)))
        return systems.get(name)().model
    if model is not None:
        robot = find(name)
        if robot is not None:
            say("note", f"{name} is also a robot; this is the catalog's system, and {robot.path} is the robot")
        return model
    try:
        return model_of(name, options)
    except UnknownNameError as error:
        if error.what != "robot or catalog system":
            raise
        known = [*systems.names(), *error.known]
        raise UnknownNameError("robot, catalog system or system on paper", name, known, error.hint) from None


def _about(system: Callable[..., Lagrangian]) -> str:
    """Return what a system on paper is, its coordinates and their zero, from its docstring."""
    about = (getdoc(system) or "").split("\n\nReferences\n")[0].split("\n\nParameters\n")[0]
    first, *rest = " ".join(about.replace("`", "").split()).split(". ")
    return ". ".join([first.replace("Return ", f"{system.__name__}: ", 1), *rest])


def _to_read(model: Model, snap: float, what: str) -> Model:
    """Return a model whose rotations near to plain ones are plain, and say so."""
    from mbkit.lagrangian.summary import with_plain_turns

    model, note = with_plain_turns(model, snap)
    if note:
        say("note", f"{note}. The {what} to read differ from the model by that; --snap 0 leaves it as it is")
    return model


def _program(model: Model, quantity: str, form: str | None, snap: float) -> tuple[str, str]:
    """Return one quantity as named terms, and the ending of its file."""
    from mbkit.lagrangian.program_text import ProgramText, program

    if form in (None, "latex"):
        model = _to_read(model, snap, "terms")
    text = program(model, quantity)
    forms: dict[str | None, tuple[Callable[[ProgramText], str], str]] = {
        None: (str, ".txt"),
        "latex": (ProgramText.latex, ".tex"),
    }
    forms |= {"python": (ProgramText.python, ".py"), "c": (ProgramText.c, ".c")}
    written, ending = forms[form]
    return written(text).rstrip(), ending


def _text(
    lag: Lagrangian, names: dict[str, str], form: str | None, as_json: bool, bar: Any, note: str
) -> tuple[str, str]:
    if form == "python":
        from mbkit.lagrangian.summary import python_code

        bar(0.1, "equations")
        return python_code(lag, note).rstrip("\n"), ".py"
    from mbkit.lagrangian.summary import SystemSummary

    summary = SystemSummary(lag, names=names, progress=lambda x, text: bar(0.1 + 0.9 * x, text), note=note)
    if as_json:
        return json_text(json.dumps(summary.data(), indent=1, ensure_ascii=False)), ".json"
    return (summary.latex(), ".tex") if form == "latex" else (summary.text(), ".txt")


# Equations as C.


@shared.command("mbkit export ur5", "mbkit export panda --quantity gravity --quantity mass_matrix --out src")
@click.argument("target")
@click.option(
    "--quantity",
    "quantities",
    multiple=True,
    metavar="NAME",
    help="What to compute; may be repeated.  [default: inverse_dynamics, forward_dynamics]",
)
@click.option(
    "--frame", "frames", multiple=True, metavar="NAME", help="Of pose, jacobian and the like; may be repeated."
)
@shared.load_options
@click.option("--name", help="Prefix of every name in C, and stem of the files.  [default: the target's name]")
@shared.force_option
@shared.json_option
@shared.out_option(_C_FOLDER)
def export(target: str, options: dict[str, Any], as_json: bool, out: Path, force: bool, **choices: Any) -> None:
    """Write the equations of motion of TARGET as C99 that needs no library.

    TARGET is what `mbkit check` takes. The header tells how to compile and call it, the units, the conventions and the
    order of the joints. A file that mbkit wrote before is replaced; an unknown quantity lists those that there are.
    """
    from mbkit.studies._targets import model_of

    model = model_of(target, options)
    source, paths = _write_c(model, target, out, force, **choices)
    if not as_json:
        _tell_functions(source, paths)
        return
    functions = [asdict(f) | {"inputs": dict(f.inputs), "outputs": dict(f.outputs)} for f in source.functions]
    data: dict[str, Any] = {
        "name": source.name,
        "model": model.name,
        "digest": source.digest,
        "versions": source.versions,
    }
    data |= {"header": str(paths[0]), "source": str(paths[1]), "functions": functions}
    tell(json.dumps(data, indent=1))


def _write_c(
    model: Model,
    target: str,
    out: Path,
    force: bool,
    quantities: tuple[str, ...] = (),
    name: str | None = None,
    frames: tuple[str, ...] = (),
) -> tuple[CSource, tuple[Path, Path]]:
    """Return the code of a model and the paths of its header and source."""
    from mbkit.codegen.c_source import DEFAULT, c_identifier, export_c
    from mbkit.load.loader import canonical

    # Several robots' files hold the same name.
    robot = canonical(target)
    stem = c_identifier(robot) if name is None and robot is not None else name
    source = export_c(model, quantities or DEFAULT, name=stem, frames=frames)
    return source, source.write(out, force=force)


def _tell_functions(source: CSource, paths: tuple[Path, Path]) -> None:
    for function in source.functions:
        tell(f"{function.signature}: {function.operations} operations")
    tell(f"header {paths[0]}\nsource {paths[1]}")
