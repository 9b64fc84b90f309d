"""Equations of motion as C99 that needs neither mbkit nor CasADi at run time, with a header that documents them.

CasADi's `CodeGenerator` writes the functions; each gets a wrapper that takes plain arrays.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import wrap
from typing import Final

import casadi as ca

from mbkit import _process as _interrupt
from mbkit._check import ALIGNED, CLASSICAL, axes_named
from mbkit._escape import c_comment
from mbkit._version import __version__
from mbkit.codegen.program import program
from mbkit.derivation import FUNCTIONS, equations_of
from mbkit.derivation.body_motion import OF_FRAME, OF_WHOLE
from mbkit.errors import InputError, OutputError, UnsupportedError, require_known
from mbkit.model import Model
from mbkit.model.changes.jumps import held_at_rest
from mbkit.model.elements import paths
from mbkit.model.elements.kinds import kind
from mbkit.model.quantities import QUANTITIES

#: Output of a quantity that has several -> its meaning.
_DERIVATIVES: Final = {
    "by_q": "derivative by q along the configuration manifold: column k is that of q (+) t e_k",
    "by_v": "derivative by v",
    "by_a": "derivative by a, the mass matrix",
    "by_tau": "derivative by tau, without constraints the inverse of the mass matrix",
}
_INPUTS: Final = {
    "q": "coordinates",
    "v": "velocities",
    "a": "accelerations dv/dt",
    "tau": "forces",
    "wrenches": "force, N, then moment, N m, about the frame's origin",
    "parameters": "parameters",
}

_HOLD: Final = "constraints hold accelerations at states that satisfy them; all other terms are those without them"
WITHOUT_STOPS: Final = "joint stops are in no term: neither the forces that they push with, nor impacts on them"
C_CODE: Final = paths.Path(
    "c",
    "export_c: not known of",
    paths.ALL,
    notes={"jump": held_at_rest, "row": _HOLD, "speed": _HOLD, "stop": WITHOUT_STOPS},
)
#: Data of a description that no function holds.
_LEFT_OUT: Final = ("limits", "effort_limits")
#: The comment at the head of the header.
_DESCRIPTION: Final = Path(__file__).with_name("c_header.txt")


@dataclass(frozen=True)
class CFunction:
    """One exported function: name in C, inputs (name, entries) and outputs (name, (rows, columns)), by columns."""

    name: str
    quantity: str
    inputs: tuple[tuple[str, int], ...]
    outputs: tuple[tuple[str, tuple[int, int]], ...]
    #: Arithmetic operations of one call, a sine counted as one.
    operations: int
    #: Bytes of local variables where the compiler does not optimise, copies of the inputs among them.
    stack: int
    #: The frame and its axes, for the comment.
    of: str = ""

    @property
    def signature(self) -> str:
        """The function on one line, such as ``pendulum_gravity(q[1]) -> g[1]``."""
        inputs = ", ".join(f"{name}[{n}]" for name, n in self.inputs)
        outputs = ", ".join(f"{name}[{rows * columns}]" for name, (rows, columns) in self.outputs)
        return f"{self.name}({inputs}) -> {outputs}"


def _extent(macro: str, name: str, n: int, nv: int) -> str:
    named = {"q": "NQ", "parameters": "NP"}.get(name, "NV" if n == nv else "")
    return f"{macro}_{named}" if named else str(n)


def _declaration(f: CFunction, macro: str, nv: int) -> str:
    """Return the declaration of a function with the header's macros as sizes, below a comment."""
    arguments = [f"const double {name}[{_extent(macro, name, n, nv)}]" for name, n in f.inputs]
    rows = [(f"{name}[{n}]", _INPUTS.get(name, "")) for name, n in f.inputs]
    for name, shape in f.outputs:
        extent = " * ".join(_extent(macro, "", n, nv) for n in shape if n > 1) or "1"
        arguments.append(f"double {name}[{extent}]")
        text = QUANTITIES[f.quantity].meaning or _DERIVATIVES.get(name, "")
        matrix = shape[1] > 1
        size = f"{shape[0]} * {shape[1]}" if matrix else shape[0]
        rows.append((f"{name}[{size}]", f"out{', by columns' * matrix}: {text}"))
    width = max(len(shape) for shape, _ in rows)
    of = f" of {c_comment(f.of)}" if f.of else ""
    about = [f"{f.quantity}{of}: {f.operations} operations, {f.stack} bytes of local variables."]
    about += [f"    {shape.ljust(width)}  {text}" for shape, text in rows]
    one_line = f"void {f.name}({', '.join(arguments)})"
    if len(one_line) >= 110:
        one_line = f"void {f.name}(\n    " + ",\n    ".join(arguments) + ")"
    return f"{_comment(about)}\n{one_line};"


def _header(prefix: str, model: Model, functions: Sequence[CFunction], first_line: str, notes: Iterable[str]) -> str:
    macro = prefix.upper()
    needs = (need for need, on in model.needs.as_dict().items() if on and need not in _LEFT_OUT)
    features = (x for k in map(kind, model.acts) if k.does != {"bound"} for x in k.features)
    present = dict.fromkeys(x.replace("_", " ") for x in (*needs, *features))
    q_units, v_units = _units(model)
    parameters = followers = ""
    if model.parameters:
        values = _table((name, "none" if x is None else repr(x)) for name, x in model.parameters.items())
        head = f"Parameters parameters[{len(model.parameters)}], and the value that the model gives each"
        parameters = f"\n\n{head}\n{values}"
    mimics = [(j.name, j.mimic) for j in model.joints if j.mimic]
    if mimics:
        followers = "\n\nJoints that follow another and have no coordinate of their own"
    for name, mimic in mimics:
        ratio, offset = ("(of the parameters)" if math.isnan(x) else repr(x) for x in (mimic.ratio, mimic.offset))
        followers += f"\n    {c_comment(name)} = {ratio} * {c_comment(mimic.joint)} + {offset}"
    description = _DESCRIPTION.read_text(encoding="utf-8").format(
        first_line=first_line,
        model=model,
        name=c_comment(model.name),
        holds=", ".join(present) or ("inertia alone" if model.has_bodies else "energies T and V"),
        functions=f"\n{' ' * 12}".join(f.name for f in functions),
        example="\n".join(f"    {line}" for line in _example(prefix, model, functions[0])),
        coordinates=_table(zip(model.coordinate_names, q_units, strict=True)),
        velocities=_table((name, *units) for name, units in zip(model.velocity_names, v_units, strict=True)),
        prefix=prefix,
        macro=macro,
        parameters=parameters,
        followers=followers,
        held=" + J(q)^T lambda" if model.constrained else "",
        notes="".join(f"\n    {line}" for note in notes for line in wrap(c_comment(f"Note: {note}."), 84)),
    )
    sizes = {"NQ": model.nq, "NV": model.nv} | ({"NP": len(model.parameters)} if model.parameters else {})
    blocks = [
        _comment(description.splitlines()),
        f"#ifndef MBKIT_{macro}_H\n#define MBKIT_{macro}_H",
        "\n".join(f"#define {macro}_{name} {n}" for name, n in sizes.items()),
        '#ifdef __cplusplus\nextern "C" {\n#endif',
        *(_declaration(f, macro, model.nv) for f in functions),
        "#ifdef __cplusplus\n}\n#endif\n\n#endif\n",
    ]
    return "\n\n".join(blocks)


def _comment(lines: Sequence[str]) -> str:
    first, *rest = lines
    return "\n".join([f"/* {first}", *(f" * {line}".rstrip() for line in rest), " */"])


def _example(prefix: str, model: Model, function: CFunction) -> list[str]:
    # NAN marks a parameter without a value, for which the user has to put a number.
    numbers = ["NAN" if x is None else repr(x) for x in model.parameters.values()]
    ones = ", ".join(f"[{k}] = 1.0" for k, x in enumerate(model.neutral().tolist()) if x)
    values = {"q": ones or "0.0", "parameters": ", ".join(numbers)}
    arrays = [
        f"    const double {name}[{_extent(prefix.upper(), name, n, model.nv)}] = {{{values.get(name, '0.0')}}};"
        for name, n in function.inputs
    ]
    arrays += [f"    double {name}[{rows * columns}];" for name, (rows, columns) in function.outputs]
    head = [*(["#include <math.h>"] if "NAN" in numbers else []), "#include <stdio.h>", f'#include "{prefix}.h"', ""]
    call = f"    {function.name}({', '.join(name for name, _ in (*function.inputs, *function.outputs))});"
    show = f'    printf("%.17g\\n", {function.outputs[0][0]}[0]);'
    return [*head, "int main(void)", "{", *arrays, call, show, "    return 0;", "}"]


def _table(rows: Iterable[tuple[str, ...]]) -> str:
    listed = [[c_comment(text) for text in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*listed, strict=True)]
    texts = ("  ".join(map(str.ljust, row, widths)) for row in listed)
    return "\n".join(f"    {index:3}  {text}".rstrip() for index, text in enumerate(texts))


def _units(model: Model) -> tuple[list[str], list[tuple[str, str]]]:
    """Return the unit of each coordinate, and those of each velocity and force."""
    if not model.has_bodies:
        return ["generalized"] * model.nq, [("generalized", "generalized")] * model.nv
    kinds = [joint.type for joint in model.independent_joints]
    coordinates = [
        "m" if k in kind.lengths else "rad" if k in kind.angular else "1" for kind in kinds for k in range(kind.nq)
    ]
    # Lengths come first and have the same places in q and v.
    velocities = [("m/s", "N") if k in kind.lengths else ("rad/s", "N m") for kind in kinds for k in range(kind.nv)]
    return coordinates, velocities


# C's fmin and fmax ignore NaN; the engine's pass it on.
_FMIN_FMAX: Final = re.compile(r"return (fmin\(x, y\)|fmax\(x, y\)|x<y \? x : y|x>y \? x : y);")
_LESS: Final = {"fmin(x, y)": "<", "x<y ? x : y": "<", "fmax(x, y)": ">", "x>y ? x : y": ">"}
_PROLOGUE: Final = """\
#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif
"""


def c_code(prefix: str, functions: Mapping[str, ca.Function]) -> str:
    """Return C99 definitions of dense SX functions, by their names in C, that take plain arrays: inputs, outputs."""
    generator = ca.CodeGenerator(prefix, {"with_export": False})
    wrappers = []
    for name, function in functions.items():
        # CasADi refuses two underscores in a row.
        inner = re.sub("_+", "_", f"{name}_casadi")
        symbols = function.sx_in()
        generator.add(ca.Function(inner, symbols, function.call(symbols)))
        inputs = [(f"x{k}", function.nnz_in(k)) for k in range(function.n_in())]
        outputs = [(f"y{k}", function.nnz_out(k)) for k in range(function.n_out())]
        arguments = [f"const double {x}[{n}]" for x, n in inputs] + [f"double {y}[{n}]" for y, n in outputs]
        lines = [
            "/* The inputs are copied because an output may lie on one. */",
            f"void {name}({', '.join(arguments)})",
            "{",
            *(f"    double own_{x}[{n}];" for x, n in inputs),
            f"    const double *inputs[] = {{{', '.join(f'own_{x}' for x, _ in inputs)}}};",
            f"    double *outputs[] = {{{', '.join(y for y, _ in outputs)}}};",
            "    int k;",
            *(f"    for (k = 0; k < {n}; k++) own_{x}[k] = {x}[k];" for x, n in inputs),
            f"    {inner}(inputs, outputs, 0, 0, 0);",
            "}",
        ]
        wrappers.append("\n".join(lines))
    text = _FMIN_FMAX.sub(lambda m: f"return x {_LESS[m[1]]} y || x != x ? x : y;", generator.dump())
    return "\n".join([_PROLOGUE, text, *wrappers]) + "\n"


#: The quantities that are exported unless others are named.
DEFAULT: Final = ("inverse_dynamics", "forward_dynamics")
_MARK: Final = "Written by mbkit"
_IDENTIFIER: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


@dataclass(frozen=True)
class CSource:
    """Two C files, not yet written.

    Attributes
    ----------
    name : str
        Stem of both files and prefix of every name in them.
    digest : str
        `Model.digest` of what they compute.
    functions : tuple of CFunction
    header, source : str
        Texts of ``<name>.h`` and ``<name>.c``; the same bytes for the same model and versions of mbkit and casadi.
    versions : dict of str to str
    """

    name: str
    digest: str
    functions: tuple[CFunction, ...]
    header: str = field(repr=False)
    source: str = field(repr=False)
    versions: dict[str, str]

    def write(self, folder: str | Path, *, force: bool = False) -> tuple[Path, Path]:
        """Write both files, and return their paths: header, then source; files of mbkit's own are replaced.

        Parameters
        ----------
        folder : path
            Created if necessary.
        force : bool
            Replace files that mbkit did not write, too, which is an `OutputError` otherwise.
        """
        texts = {Path(folder) / f"{self.name}.h": self.header, Path(folder) / f"{self.name}.c": self.source}
        # Both are checked before either is written.
        for path in texts:
            if not force and path.exists() and not _is_own(path):
                raise OutputError(
                    f"{path} is there and mbkit did not write it; choose another folder or name, or force (--force)"
                )
        try:
            with _interrupt.uninterrupted:
                Path(folder).mkdir(parents=True, exist_ok=True)
                for path, text in texts.items():
                    path.write_bytes(text.encode())
        except OSError as error:
            raise OutputError(f"cannot write to {folder}: {error.strerror or error}; choose another folder") from error
        header, source = texts
        return header, source


def export_c(
    model: Model,
    quantities: Iterable[str] = DEFAULT,
    *,
    name: str | None = None,
    frames: Iterable[str] = (),
    axes: str = ALIGNED,
) -> CSource:
    """Return C99 code that computes quantities of a model, each in one function without heap or state.

    Named parameters of the model are a last input. The header states units, layouts, conventions and the order of the
    joints. Compilers take long for long functions: with ``gcc -O2`` about a second for Panda's forward dynamics (4,000
    operations), over a minute for the two-armed Tiago's (72,000), which ``-O0`` compiles in two seconds.

    Parameters
    ----------
    model : Model
    quantities : iterable of str
        Keys of `mbkit.derivation.FUNCTIONS`; of frames pose, jacobian, velocity, acceleration, jacobian_dot_v and
        generalized_force; of the whole center_of_mass, centroidal_momentum and what belongs to them.
    name : str, optional
        Prefix of every name in C, and stem of the files; the model's name in lower case, with underscores, if not
        given.
    frames : iterable of str
        Each quantity of frames has a function for each, such as ``panda_jacobian_panda_hand``.
    axes : {"local_world_aligned", "local", "world"}
        Of velocities, Jacobians and wrenches, as in `Dynamics.velocity`.

    Returns
    -------
    CSource

    Raises
    ------
    UnknownNameError
        An unknown quantity or frame.
    InputError
        No quantity, a quantity of frames without `frames`, or a `name` that is no identifier in C.
    UnsupportedError
        The model has no joint that moves.

    Examples
    --------
    >>> import mbkit as mb
    >>> source = mb.lagrangian.export_c(mb.catalog.pendulum(), ["forward_dynamics"])
    >>> source.functions[0].name
    'pendulum_forward_dynamics'
    """
    wanted, named, axes = _checked(quantities), list(frames), axes_named(axes)
    for quantity in wanted:
        if quantity in OF_FRAME and not named:
            raise InputError(f"frames: {quantity} is of a frame; expected the names of some, got none")
    notes = C_CODE.admit(model)
    if not model.nv:
        raise UnsupportedError(f"{model.name} cannot be exported: no joint of it moves, and C has no empty arrays")
    prefix = c_identifier(model.name) if name is None else name
    if not _IDENTIFIER.fullmatch(prefix):
        raise InputError(f"name: expected letters, digits and _, a letter first, got {name!r}")
    equations = equations_of(model)
    code, of = {}, []
    for quantity in wanted:
        for frame in named if quantity in OF_FRAME else [""]:
            own = "_".join(x for x in (prefix, quantity, c_identifier(frame) if frame else "") if x)
            while own in code:
                own += "_"
            code[own] = equations.function(quantity, frame or None, axes, CLASSICAL)
            of.append((quantity, f"{frame} in {axes} axes" if frame and quantity != "pose" else frame))
    functions = tuple(_described(*item, *x) for item, x in zip(code.items(), of, strict=True))
    versions = {"mbkit": __version__, "casadi": str(ca.CasadiMeta.version())}
    written_by = f"{_MARK} {versions['mbkit']} with casadi {versions['casadi']}"
    return CSource(
        name=prefix,
        digest=model.digest,
        functions=functions,
        header=_header(prefix, model, functions, f"{written_by}; do not edit, export again.", notes),
        source=f'/* {written_by}; see {prefix}.h. */\n#include "{prefix}.h"\n{c_code(prefix, code)}',
        versions=versions,
    )


def _described(name: str, function: ca.Function, quantity: str, of: str) -> CFunction:
    operations = program(function)
    inputs = tuple(zip(function.name_in(), operations.inputs, strict=True))
    names = (QUANTITIES[quantity].symbol,) if QUANTITIES[quantity].symbol else function.name_out()
    outputs = tuple(zip(names, operations.shapes, strict=True))
    stack = 8 * (function.sz_w() + sum(operations.inputs))
    return CFunction(name, quantity, inputs, outputs, operations.arithmetic, stack, of)


def _checked(quantities: Iterable[str]) -> list[str]:
    if isinstance(quantities, str) or not isinstance(quantities, Iterable):
        raise InputError(f"quantities: expected a list of names such as ['nle'], got {quantities!r}")
    known = (*FUNCTIONS, *OF_FRAME, *OF_WHOLE)
    # Each once, in the caller's order.
    wanted = list(dict.fromkeys(map(str, quantities)))
    require_known("quantity", known, *wanted)
    if not wanted:
        raise InputError(f"quantities: expected at least one of {', '.join(FUNCTIONS)}, got none")
    return wanted


def c_identifier(name: str) -> str:
    """Return a name as a prefix of names in C: lower case letters, digits and underscores."""
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")[:100]
    return plain if plain[:1].isalpha() else f"model_{plain}".rstrip("_")


def _is_own(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(64).startswith(f"/* {_MARK} ".encode())
    except OSError:
        return False
