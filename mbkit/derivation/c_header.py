"""The header of exported C code: all that its user has to know, where the compiler sees it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from mbkit._escape import c_comment
from mbkit.model import Model

__all__ = ["CFunction", "header", "output_names", "prototype"]

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
