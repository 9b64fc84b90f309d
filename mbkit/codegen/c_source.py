"""A program as the body of a C99 function.

CasADi can write C of its own, but with a dozen exported symbols a function, names
that clash between two models, and work arrays that the caller has to bring. One
straight run of assignments needs none of that.
"""

from __future__ import annotations

import heapq
import math
import re
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import casadi as ca

from mbkit import _interrupt
from mbkit._escape import c_comment
from mbkit._version import __version__
from mbkit.codegen.program import Program, program
from mbkit.derivation.equations import FUNCTIONS, equations_of
from mbkit.errors import InputError, OutputError, UnknownNameError, UnsupportedError
from mbkit.model import Model

__all__ = [
    "DEFAULT",
    "CFunction",
    "CSource",
    "c_body",
    "c_identifier",
    "export_c",
    "header",
    "output_names",
    "places",
    "prototype",
    "variables",
]


#: Functions of math.h.
_OF_ONE: Final = (
    *("fabs", "sqrt", "sin", "cos", "tan", "asin", "acos", "atan", "exp", "expm1", "log", "log1p"),
    *("sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
)
_OF_TWO: Final = ("atan2", "pow", "hypot")
_FORMS: Final = {
    "add": "{0} + {1}",
    "sub": "{0} - {1}",
    "mul": "{0} * {1}",
    "div": "{0} / {1}",
    "neg": "-{0}",
    "sq": "{0} * {0}",
    "twice": "2.0 * {0}",
    "inv": "1.0 / {0}",
    **{name: f"{name}({{0}})" for name in _OF_ONE},
    **{name: f"{name}({{0}}, {{1}})" for name in _OF_TWO},
    "sign": "{0} > 0.0 ? 1.0 : {0} < 0.0 ? -1.0 : {0}",
    # Not C's own, which pass over what is no number.
    "fmin": "{0} < {1} || {0} != {0} ? {0} : {1}",
    "fmax": "{0} > {1} || {0} != {0} ? {0} : {1}",
    "lt": "(double)({0} < {1})",
    "le": "(double)({0} <= {1})",
    "eq": "(double)({0} == {1})",
    "ne": "(double)({0} != {1})",
    "not": "(double)({0} == 0.0)",
    "and": "(double)({0} != 0.0 && {1} != 0.0)",
    "or": "(double)({0} != 0.0 || {1} != 0.0)",
    "if_else_zero": "{0} != 0.0 ? {1} : 0.0",
}


def places(program: Program) -> list[int | None]:
    """Return in which local variable each operation's value is kept, None for those written in place.

    A variable is taken again when its last reader has run, which keeps the stack small
    even where a compiler does not optimise. Constants and entries of the arguments are
    written where they are read. An entry that goes unchanged to the output is kept
    all the same, so that the output may lie over an argument.
    """
    results = {int(index) for out in program.outputs for index in out.flat}
    last = {}
    for k, operation in enumerate(program.operations):
        if operation.name != "input":
            for argument in operation.arguments:
                last[argument] = k
    where: list[int | None] = []
    free: list[int] = []
    count = 0
    for k, operation in enumerate(program.operations):
        if operation.name == "const" or (operation.name == "input" and k not in results):
            where.append(None)
            continue
        if operation.name != "input":
            for argument in set(operation.arguments):
                held = where[argument]
                if last[argument] == k and argument not in results and held is not None:
                    heapq.heappush(free, held)
        if free:
            where.append(heapq.heappop(free))
        else:
            where.append(count)
            count += 1
    return where


def c_body(program: Program, inputs: Sequence[str], outputs: Sequence[str]) -> list[str]:
    """Return the lines between a function's braces.

    Parameters
    ----------
    program : Program
    inputs, outputs : sequence of str
        Name of each argument's array of doubles; outputs are filled column after column.
    """
    where = places(program)
    texts: list[str] = []
    lines: list[str] = []
    for operation, place in zip(program.operations, where, strict=True):
        if operation.name == "const":
            text = _literal(operation.value)
        elif operation.name == "input":
            which, entry = operation.arguments
            text = f"{inputs[which]}[{entry}]"
        else:
            text = _FORMS[operation.name].format(*(texts[i] for i in operation.arguments))
        if place is not None:
            lines.append(f"t{place} = {text};")
            text = f"t{place}"
        texts.append(text)
    for name, out in zip(outputs, program.outputs, strict=True):
        lines += [f"{name}[{k}] = {texts[int(index)]};" for k, index in enumerate(out.ravel(order="F"))]
    read = {o.arguments[0] for o in program.operations if o.name == "input"}
    unread = [f"(void){name};" for k, name in enumerate(inputs) if k not in read]
    return [*_declaration(variables(where)), *unread, *lines]


def variables(where: Sequence[int | None]) -> int:
    """Return how many local variables `places` takes."""
    return max((place for place in where if place is not None), default=-1) + 1


def _declaration(count: int) -> list[str]:
    if not count:
        return []
    names = ", ".join(f"t{k}" for k in range(count))
    return textwrap.wrap(f"double {names};", width=96, subsequent_indent="    ")


def _literal(value: float) -> str:
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "(-INFINITY)"
    # The shortest digits that give the same double back.
    return repr(value) if math.copysign(1.0, value) > 0 else f"({value!r})"


# The header of exported C code: all that its user has to know, where the compiler sees it.

#: Quantity -> (name in C of its one output, what it is).
_ONE_OUTPUT: Final = {
    "mass_matrix": ("M", "mass matrix M(q), symmetric"),
    "coriolis_matrix": ("C", "Coriolis matrix C(q, v), Christoffel's"),
    "gravity": ("g", "gravity g(q), without springs"),
    "nle": ("nle", "C(q, v) v + g(q)"),
    "coriolis_force": ("Cv", "C(q, v) v"),
    "passive": ("tau_passive", "forces of springs and dampers"),
    "inverse_dynamics": ("tau", "forces M a + C(q, v) v + g(q) - tau_passive(q, v)"),
    "forward_dynamics": ("a", "accelerations dv/dt = M^-1 (tau + tau_passive - C v - g)"),
    "kinetic_energy": ("T", "kinetic energy, J"),
    "potential_energy": ("V", "potential energy of gravity and springs, J"),
    "energy_rate": ("dE_dt", "d(T + V)/dt at accelerations a, W"),
}
#: Output of the quantities that have several -> what it is.
_SEVERAL_OUTPUTS: Final = {
    "by_q": "derivative by q along the configuration manifold: column k is that of q (+) t e_k",
    "by_v": "derivative by v",
    "by_a": "derivative by a, the mass matrix",
    "by_tau": "derivative by tau, the inverse of the mass matrix",
}
_INPUTS: Final = {
    "q": "coordinates",
    "v": "velocities",
    "a": "accelerations dv/dt",
    "tau": "forces",
    "parameters": "parameters",
}

_CONVENTIONS: Final = """\
The equation of motion
    M(q) dv/dt + C(q, v) v + g(q) = tau + tau_passive(q, v)

Conventions
    SI units and radians. Vectors are arrays of double, in the order listed below.
    Matrices are stored by columns: entry (i, j) of M is M[i + {macro}_NV * j].
    Angles are plain real numbers, never wrapped. Quaternions are x, y, z, w, of unit
    length, and taken as they are. A free joint is its position in the parent, then its
    quaternion; its velocity is linear, then angular, both in the moving body's axes.
    A ball joint's velocity is angular, in the moving body's axes. A planar joint is
    x, y, theta in its parent's axes, and its velocity is their rate. The potential
    energy of gravity is zero with every centre of mass at the world's origin.
    Dry friction, limits and contacts are left out.

Calls
    Nothing is allocated, kept or locked: any number of threads may call at once.
    An output may lie on an input of the same size. Arguments are not checked: a singular
    mass matrix, or a function outside of its domain, gives NaN or infinity."""


@dataclass(frozen=True)
class CFunction:
    """One exported function.

    Attributes
    ----------
    name : str
        In C.
    quantity : str
    inputs : tuple of (str, int)
        Name and entries of each, in order.
    outputs : tuple of (str, (int, int))
        Name, rows and columns of each; they follow the inputs, stored by columns.
    operations : int
        Arithmetic operations of one call, a sine counted as one.
    stack : int
        Bytes of local variables where the compiler does not optimise.
    """

    name: str
    quantity: str
    inputs: tuple[tuple[str, int], ...]
    outputs: tuple[tuple[str, tuple[int, int]], ...]
    operations: int
    stack: int

    @property
    def signature(self) -> str:
        """The function on one line, such as ``pendulum_gravity(q[1]) -> g[1]``."""
        taken = ", ".join(f"{name}[{n}]" for name, n in self.inputs)
        given = ", ".join(f"{name}[{rows * columns}]" for name, (rows, columns) in self.outputs)
        return f"{self.name}({taken}) -> {given}"


def output_names(quantity: str, names: Sequence[str]) -> tuple[str, ...]:
    """Return the names in C of a function's outputs, given those of its expressions."""
    return (_ONE_OUTPUT[quantity][0],) if quantity in _ONE_OUTPUT else tuple(names)


def prototype(prefix: str, function: CFunction, model: Model) -> str:
    """Return a declaration without its semicolon, with the header's macros as sizes."""
    macro = prefix.upper()
    taken = [f"const double {name}[{_size(macro, name, n, model)}]" for name, n in function.inputs]
    given = [
        f"double {name}[{' * '.join(_size(macro, '', n, model) for n in shape if n > 1) or 1}]"
        for name, shape in function.outputs
    ]
    arguments = taken + given
    one_line = f"void {function.name}({', '.join(arguments)})"
    if len(one_line) < 110:
        return one_line
    return f"void {function.name}(\n    " + ",\n    ".join(arguments) + ")"


def header(prefix: str, model: Model, functions: Sequence[CFunction], written_by: str) -> str:
    """Return the text of the header.

    Parameters
    ----------
    prefix : str
        Of every name in C.
    model : Model
    functions : sequence of CFunction
        At least one.
    written_by : str
        The first line, by which mbkit knows its own files.
    """
    macro = prefix.upper()
    told = [
        written_by,
        "",
        *_facts(model, functions),
        "",
        *_example(prefix, model, functions[0]),
        "",
        *_CONVENTIONS.format(macro=macro).splitlines(),
        "",
        f"Coordinates q[{model.nq}]",
        *_table(zip(model.coordinate_names, _coordinate_units(model), strict=True)),
        "",
        f"Velocities v[{model.nv}], and the unit of the force on each",
        *_table((name, *units) for name, units in zip(model.velocity_names, _velocity_units(model), strict=True)),
    ]
    if model.parameters:
        told += ["", f"Parameters parameters[{len(model.parameters)}], and the value that the model gives each"]
        told += _table((name, "none" if x is None else repr(x)) for name, x in model.parameters.items())
    followers = [(j.name, j.mimic) for j in model.joints if j.mimic]
    if followers:
        told += ["", "Joints that follow another and have no coordinate of their own"]
        rows = ((c_comment(name), c_comment(m.joint), m) for name, m in followers)
        told += [f"    {name} = {_told(m.ratio)} * {other} + {_told(m.offset)}" for name, other, m in rows]
    sizes = {"NQ": model.nq, "NV": model.nv} | ({"NP": len(model.parameters)} if model.parameters else {})
    blocks = [
        _comment(told),
        f"#ifndef MBKIT_{macro}_H\n#define MBKIT_{macro}_H",
        "\n".join(f"#define {macro}_{name} {n}" for name, n in sizes.items()),
        '#ifdef __cplusplus\nextern "C" {\n#endif',
        *(f"{_comment(_documented(f))}\n{prototype(prefix, f, model)};" for f in functions),
        "#ifdef __cplusplus\n}\n#endif",
        "#endif",
    ]
    return "\n\n".join(blocks) + "\n"


def _comment(lines: Sequence[str]) -> str:
    first, *rest = lines
    return "\n".join([f"/* {first}", *(f" * {line}".rstrip() for line in rest), " */"])


def _facts(model: Model, functions: Sequence[CFunction]) -> list[str]:
    present = [need.replace("_", " ") for need, on in model.needs.as_dict().items() if on]
    alone = "inertia alone" if model.written is None else "what was written as T and V"
    return [
        f"Model       {c_comment(model.name)}",
        f"Digest      {model.digest}",
        f"Holds       {', '.join(present) or alone}",
        f"Functions   {functions[0].name}",
        *(f"            {f.name}" for f in functions[1:]),
    ]


def _example(prefix: str, model: Model, function: CFunction) -> list[str]:
    macro = prefix.upper()
    # Whoever compiles this must see that a parameter without a value still has to get one.
    numbers = ["NAN" if x is None else repr(x) for x in model.parameters.values()]
    values = {"q": _initial(model), "parameters": ", ".join(numbers)}
    lines = [
        f"const double {name}[{_size(macro, name, n, model)}] = {{{values.get(name, '0.0')}}};"
        for name, n in function.inputs
    ]
    lines += [f"double {name}[{rows * columns}];" for name, (rows, columns) in function.outputs]
    call = ", ".join([name for name, _ in function.inputs] + [name for name, _ in function.outputs])
    lines += [f"{function.name}({call});", f'printf("%.17g\\n", {function.outputs[0][0]}[0]);', "return 0;"]
    return [
        f"A program   cc -std=c99 -O2 main.c {prefix}.c -o main -lm",
        "",
        *(["    #include <math.h>"] if "NAN" in numbers else []),
        "    #include <stdio.h>",
        f'    #include "{prefix}.h"',
        "",
        "    int main(void)",
        "    {",
        *(f"        {line}" for line in lines),
        "    }",
    ]


def _initial(model: Model) -> str:
    return ", ".join(f"[{k}] = 1.0" for k, x in enumerate(model.neutral().tolist()) if x) or "0.0"


def _told(x: float) -> str:
    return "(what the parameters make)" if math.isnan(x) else repr(x)


def _table(rows: Iterable[tuple[str, ...]]) -> list[str]:
    listed = [[c_comment(text) for text in row] for row in rows]
    widths = [max(len(row[k]) for row in listed) for k in range(len(listed[0]))]
    return [
        f"    {index:3}  {'  '.join(text.ljust(width) for text, width in zip(row, widths, strict=True))}".rstrip()
        for index, row in enumerate(listed)
    ]


def _coordinate_units(model: Model) -> list[str]:
    if model.written is not None:
        return ["generalized"] * model.nq
    return [
        "m" if k in j.type.lengths else "rad" if k in j.type.angular else "1"
        for j in model.independent_joints
        for k in range(j.type.nq)
    ]


def _velocity_units(model: Model) -> list[tuple[str, str]]:
    if model.written is not None:
        return [("generalized", "generalized")] * model.nv
    # Lengths come first and keep their places in v, whatever a quaternion takes.
    return [
        ("m/s", "N") if k in j.type.lengths else ("rad/s", "N m")
        for j in model.independent_joints
        for k in range(j.type.nv)
    ]


def _documented(function: CFunction) -> list[str]:
    rows = [(f"{name}[{n}]", _INPUTS.get(name, "")) for name, n in function.inputs]
    for name, (n, columns) in function.outputs:
        one = _ONE_OUTPUT.get(function.quantity)
        told = one[1] if one else _SEVERAL_OUTPUTS.get(name, "")
        shape, layout = (f"{n}", "") if columns == 1 else (f"{n} * {columns}", ", by columns")
        rows.append((f"{name}[{shape}]", f"out{layout}: {told}"))
    width = max(len(shape) for shape, _ in rows)
    lines = [f"    {shape.ljust(width)}  {text}".rstrip() for shape, text in rows]
    return [
        f"{function.quantity}: {function.operations} operations, {function.stack} bytes of local variables.",
        *lines,
    ]


def _size(macro: str, name: str, n: int, model: Model) -> str:
    named = {"q": "NQ", "parameters": "NP"}.get(name, "NV" if n == model.nv else "")
    return f"{macro}_{named}" if named else str(n)


# Equations of motion as plain C99 that needs neither mbkit nor CasADi.

_MARK: Final = "Written by mbkit"

#: What is exported where no quantity is named.
DEFAULT: Final = ("inverse_dynamics", "forward_dynamics")
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
        Texts of ``<name>.h`` and ``<name>.c``; the same bytes for the same model and
        versions of mbkit and casadi.
    versions : dict of str to str
    """

    name: str
    digest: str
    functions: tuple[CFunction, ...]
    header: str
    source: str
    versions: dict[str, str]

    def write(self, folder: str | Path, *, force: bool = False) -> tuple[Path, Path]:
        """Write both files, and return their paths: header, then source.

        Parameters
        ----------
        folder : path
            Made if it is not there.
        force : bool
            Replace files that mbkit did not write. Those that it wrote are replaced
            in any case.

        Raises
        ------
        OutputError
            A file of other origin is in the way, or the folder cannot be written to.
        """
        with _interrupt.held:
            return self._write(Path(folder), force=force)

    def _write(self, folder: Path, *, force: bool) -> tuple[Path, Path]:
        texts = {folder / f"{self.name}.h": self.header, folder / f"{self.name}.c": self.source}
        header, source = texts
        try:
            # Both are looked at before either is written.
            for path in texts:
                if not force and path.exists() and not _ours(path):
                    raise OutputError(
                        f"{path} is there and mbkit did not write it; choose another folder or name, or force (--force)"
                    )
            folder.mkdir(parents=True, exist_ok=True)
            for path, text in texts.items():
                path.write_bytes(text.encode())
        except OutputError:
            raise
        except OSError as error:
            raise OutputError(f"cannot write to {folder}: {error.strerror or error}; choose another folder") from error
        return header, source


def export_c(model: Model, quantities: Iterable[str] = DEFAULT, *, name: str | None = None) -> CSource:
    """Return C99 code that computes quantities of a model.

    Each becomes one function without loops, heap or state, such as
    ``void panda_forward_dynamics(const double q[], const double v[], const double tau[],
    double a[])``; named parameters of the model are a last input. The header tells
    units, layouts, conventions and the order of the joints. Compilers take long for
    long functions: with ``gcc -O2`` about a second for Panda's forward dynamics (4,000
    operations), four for Talos' (18,000), over a minute for the two-armed Tiago's
    (72,000), which ``-O0`` compiles in two seconds.

    Parameters
    ----------
    model : Model
    quantities : iterable of str
        Keys of `mbkit.derivation.FUNCTIONS`.
    name : str, optional
        Prefix of every name in C, and stem of the files; the model's name in lower
        case letters, digits and underscores if not given.

    Returns
    -------
    CSource
        Its `write` writes the files.

    Raises
    ------
    UnknownNameError
        A quantity that there is not.
    InputError
        No quantity, or a `name` that is no identifier in C.
    UnsupportedError
        The model has loops or motions prescribed in time, or no joint that moves.

    Examples
    --------
    >>> import mbkit as mb
    >>> made = mb.lagrangian.export_c(mb.catalog.pendulum(), ["forward_dynamics"])
    >>> made.functions[0].name
    'pendulum_forward_dynamics'
    """
    wanted = _checked(quantities)
    for needed, told in (("loops", model.needs.loops), ("prescribed", model.needs.time)):
        if told:
            raise UnsupportedError(
                f"{model.name} has {needed!r}, which C code of its tree leaves out; mbkit.lagrangian.from_model(model)"
                f".model can be exported with them, and model.without({needed!r}) without them"
            )
    if not model.nv:
        raise UnsupportedError(f"{model.name} cannot be exported: no joint of it moves, and C has no empty arrays")
    prefix = c_identifier(model.name) if name is None else name
    if not _IDENTIFIER.fullmatch(prefix):
        raise InputError(f"name: expected letters, digits and _, a letter first, got {name!r}")
    equations = equations_of(model)
    made = [_function(prefix, model, quantity, equations.function(quantity)) for quantity in wanted]
    functions = tuple(function for function, _ in made)
    versions = {"mbkit": __version__, "casadi": str(ca.CasadiMeta.version())}
    written_by = f"{_MARK} {versions['mbkit']} with casadi {versions['casadi']}"
    bodies = [f"/* {written_by}; {prefix}.h tells the rest. */", f'#include "{prefix}.h"', "#include <math.h>"]
    return CSource(
        name=prefix,
        digest=model.digest,
        functions=functions,
        header=header(prefix, model, functions, f"{written_by}; made anew rather than edited."),
        source="\n\n".join([*bodies, *(body for _, body in made)]) + "\n",
        versions=versions,
    )


def _function(prefix: str, model: Model, quantity: str, function: ca.Function) -> tuple[CFunction, str]:
    written = program(function)
    inputs = tuple(zip(function.name_in(), written.inputs, strict=True))
    outputs = tuple(zip(output_names(quantity, function.name_out()), written.shapes, strict=True))
    described = CFunction(
        name=f"{prefix}_{quantity}",
        quantity=quantity,
        inputs=inputs,
        outputs=outputs,
        operations=written.arithmetic,
        stack=8 * variables(places(written)),
    )
    lines = c_body(written, [n for n, _ in inputs], [n for n, _ in outputs])
    body = "\n".join(f"    {line}" for line in lines)
    return described, f"{prototype(prefix, described, model)}\n{{\n{body}\n}}"


def _checked(quantities: Iterable[str]) -> list[str]:
    if isinstance(quantities, str):
        raise InputError(f"quantities: expected a list of names, got the text {quantities!r}; write [{quantities!r}]")
    # Each once, in the order asked for.
    wanted = list(dict.fromkeys(quantities))
    for quantity in wanted:
        if quantity not in FUNCTIONS:
            raise UnknownNameError("quantity", quantity, FUNCTIONS)
    if not wanted:
        raise InputError(f"quantities: expected at least one of {', '.join(FUNCTIONS)}, got none")
    return wanted


def c_identifier(name: str) -> str:
    """Return a name as a prefix of names in C: lower case letters, digits and underscores."""
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")[:100]
    return plain if plain[:1].isalpha() else f"model_{plain}".rstrip("_")


def _ours(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(64).startswith(f"/* {_MARK} ".encode())
