"""The result of an identification: the parameters with their standard deviations, and the model with them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, ClassVar, Final

import numpy as np

from mbkit._check import MAX_LINES
from mbkit.errors import InputError, ModelError
from mbkit.model import Joint, Model
from mbkit.model.base_parameters import OF_JOINTS, STANDARD, body_of, length_of, standard_names
from mbkit.model.validation import check_substituted, suspects
from mbkit.studies.document import Block, Bullet, Column, Document, Items, Section, Table
from mbkit.studies.results import ResultTable, columns_of

#: Standard deviations that are no accident: an estimate beyond a bound by less is the bound.
SIGNIFICANT_DEVIATIONS: Final = 3.0


@dataclass(frozen=True)
class IdentifiedParameter:
    """One parameter: a base parameter, friction or armature.

    `combination` is the sum of standard parameters that it is. `before` is its value in the model, `value` the estimate
    and `deviation` its standard deviation (Cramér and Rao's bound for the noise found), infinite where the data cannot
    tell it; SI units. `bias` is what noise of the motion is estimated to add to the value, beside that; zero where the
    samples tell of none.
    """

    name: str
    combination: str
    before: float
    value: float
    deviation: float
    bias: float = 0.0

    _derived: ClassVar = ("determined", "relative")

    @property
    def determined(self) -> bool:
        """Whether the data determine it."""
        return bool(np.isfinite(self.deviation))

    @property
    def relative(self) -> float:
        """The standard deviation over the size of the value, infinite of zero."""
        return self.deviation / abs(self.value) if self.value else float("inf")


@dataclass(frozen=True)
class Undetermined:
    """A direction that changes no torque of the data: these parameters may change together in these ratios."""

    names: tuple[str, ...]
    ratios: tuple[float, ...]

    @property
    def text(self) -> str:
        """The direction as a sum, such as ``"link1.Izz - joint1.armature"``; of a single one its name."""
        out = ""
        for name, x in zip(self.names, self.ratios, strict=True):
            size = f"{abs(x):.4g}"
            sign = (" - " if x < 0 else " + ") if out else ("-" if x < 0 else "")
            out += f"{sign}{'' if size == '1' else f'{size} '}{name}"
        return out


@dataclass(frozen=True)
class Residual:
    """Residual of a velocity's torque: `noise` is its standard deviation, `torque` the torque's root mean square.

    N m or N.
    """

    velocity: str
    samples: int
    torque: float
    noise: float


_COLUMNS: Final = (
    Column("parameter", lambda x: x.name),
    Column("before", lambda x: f"{x.before:.6g}", right=True),
    Column("identified", lambda x: f"{x.value:.6g}", right=True),
    Column("standard deviation", lambda x: f"{x.deviation:.2g}", right=True),
    Column("is", lambda x: x.combination),
)
_RESIDUALS: Final = (
    Column("torque of", lambda x: x.velocity),
    Column("samples", lambda x: f"{x.samples:d}", right=True),
    Column("root mean square", lambda x: f"{x.torque:.4g}", right=True),
    Column("noise", lambda x: f"{x.noise:.2g}", right=True),
)


@dataclass(frozen=True)
class Identification(ResultTable):
    """Identified parameters of a model.

    Attributes
    ----------
    model_name : str
    parameters : tuple of IdentifiedParameter
        Base parameters, then friction and armature where they were asked for.
    undetermined : tuple of Undetermined
        What the data cannot tell. Along these directions the estimates are as near to the model as can be.
    residuals : tuple of Residual
        One for each velocity.
    condition : float
        Condition number of the equations with columns of equal length, without the undetermined directions.
    samples : int
    physical : bool
        Whether the parameters are those of matter, by constraints.
    prior : str
        What they were held to, empty without.
    standard_names : tuple of str
    standard : tuple of float
        Standard parameters of all bodies that have these base parameters; without `physical` the nearest to the model.
    friction, armature : bool
        Whether these were identified.
    source : Model or None
        The model before; None in a result that was read from JSON.
    cutoff : float or None
        Hz, of the filter that the positions went through, where it was given.
    """

    model_name: str
    parameters: tuple[IdentifiedParameter, ...]
    undetermined: tuple[Undetermined, ...]
    residuals: tuple[Residual, ...]
    condition: float
    samples: int
    physical: bool
    prior: str
    standard_names: tuple[str, ...]
    standard: tuple[float, ...]
    friction: bool
    armature: bool
    source: Model | None = None
    cutoff: float | None = None

    _listed: ClassVar = "parameters"
    _csv_columns: ClassVar = {**columns_of(IdentifiedParameter), "determined": lambda x: x.determined}

    @property
    def model(self) -> Model:
        """The model with the identified parameters; see `applied_to`."""
        if self.source is None:
            raise InputError("model: a result that was read from JSON holds no model; use result.applied_to(model)")
        return self.applied_to(self.source)

    def applied_to(self, model: Model) -> Model:
        """Return a description with the identified masses, centres of mass and inertias, friction and armature.

        `mbkit.convert` writes it as URDF or MJCF. A joint that others mimic gets the friction that is not theirs.
        Friction and armature below zero by less than three standard deviations are zero.

        Raises
        ------
        InputError
            A model with other bodies.
        ModelError
            The estimates are not those of matter, with the bodies; ``identify(..., physical=True)`` finds others.
        """
        if standard_names(model) != self.standard_names:
            raise InputError(f"model: expected one with the bodies of {self.model_name}, got {model.name}")
        plain = model.with_parameters(**{name: x for name, x in model.parameters.items() if x is not None})
        parts = np.reshape(self.standard, (-1, len(STANDARD)))
        length = length_of(plain)
        bodies = {j.child: body_of(plain.body(j.child), x, length) for j, x in zip(plain.tree, parts, strict=True)}
        faults = [f"body {name!r}: no mass, but a moment or an inertia" for name, x in bodies.items() if x is None]
        if not faults:
            new = tuple(x for b in plain.bodies if (x := bodies[b.name]) is not None)
            try:
                after = check_substituted(plain, replace(plain, bodies=new, joints=self._joints(plain)))
                return replace(after, nonphysical=suspects(after, point_masses=True))
            except ModelError as error:
                faults = [*error.faults]
        hint = "identify(..., physical=True) finds parameters of matter"
        raise ModelError(model.name, [*faults, hint])

    def _joints(self, model: Model) -> tuple[Joint, ...]:
        estimates = {p.name: p for p in self.parameters}
        out = []
        for joint in model.joints:
            changes: dict[str, Any] = {}
            for field in chain(*OF_JOINTS):
                names = [f"{n}.{field}" for n in model.velocity_names[model.layout.v[joint.name]]]
                if names and names[0] in estimates:
                    offset = getattr(joint, field) - model.per_velocity(field)[model.layout.v[joint.name]]
                    values = np.array([estimates[n].value for n in names]) + offset
                    # Rounding and noise of a zero have any sign.
                    deviations = np.array([estimates[n].deviation if estimates[n].determined else 0.0 for n in names])
                    insignificant = (values < 0) & (values >= -SIGNIFICANT_DEVIATIONS * deviations)
                    changes[field] = np.where(insignificant, 0.0, values)
            out.append(replace(joint, **changes) if changes else joint)
        return tuple(out)

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the model as plain data."""
        data = ResultTable.to_dict(replace(self, source=None))
        return {name: x for name, x in data.items() if name != "source"}

    def __repr__(self) -> str:
        undetermined = f", {len(self.undetermined)} directions undetermined" if self.undetermined else ""
        size = f"{len(self.parameters)} parameters of {self.samples} samples"
        return f"<Identification of {self.model_name!r}: {size}{undetermined}>"

    def __str__(self) -> str:
        determined = [p for p in self.parameters if p.determined]
        worst = max(determined, key=lambda p: p.relative, default=None)
        biased = max(determined, key=lambda p: abs(p.bias) / p.deviation if p.deviation else 0.0, default=None)
        lines = [f"{self.model_name}: {len(self.parameters)} parameters of {self.samples} samples"]
        lines += [f"  condition {self.condition:.3g}" + (f", cut-off {self.cutoff:g} Hz" if self.cutoff else "")]
        if worst:
            lines += [f"  least sure: {worst.name}, {100 * worst.relative:.2g} % of its value"]
        if biased and biased.bias:
            ratio = abs(biased.bias) / biased.deviation if biased.deviation else 0.0
            lines += [f"  bias by noise of the motion: up to {ratio:.2g} standard deviations ({biased.name})"]
        if self.undetermined:
            lines += [f"  {len(self.undetermined)} directions that the data cannot tell"]
        lines += ["  residual / torque, root mean squares"]
        lines += [f"    {r.velocity}: {r.noise:.3g} / {r.torque:.3g}" for r in self.residuals[:MAX_LINES]]
        more = len(self.residuals) - MAX_LINES
        return "\n".join(lines + ([f"    and {more} more; .residuals has all"] if more > 0 else []))

    def document(self) -> Document:
        """Return the document of the identification: parameters, residuals, and what the data cannot tell."""
        how = f", physically consistent, {self.prior} prior" if self.physical else ""
        text = f"{len(self.parameters)} parameters of {self.samples} samples, condition {self.condition:.3g}{how}"
        unknown = Items([Bullet("", f"the data cannot tell {x.text}") for x in self.undetermined])
        blocks: list[Block] = [Table(_COLUMNS, self.parameters), Table(_RESIDUALS, self.residuals), unknown]
        return Document(self.model_name, text, True, [Section("", blocks)], self, marked=False)
