"""Beams as chains of rigid segments with springs in their hinges, which every engine runs."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from mbkit._check import PRINTED, TYPED, count
from mbkit.errors import UnsupportedError
from mbkit.model.builder import ModelBuilder
from mbkit.model.elements.beams import BeamEnd
from mbkit.model.elements.forces import arguments_of
from mbkit.model.elements.paths import ALL, Path
from mbkit.model.elements.references import KINDS_OF_PARTS, entries, names_in
from mbkit.model.joint_types import FIXED, REVOLUTE, UNIVERSAL
from mbkit.model.model import Model
from mbkit.model.parameters import nominal
from mbkit.model.parts import Joint

SEGMENTED: Final = Path("segmented", "segmented: not known of", ALL)


def segmented(model: Model, segments: int) -> Model:
    """Return a model with a chain in the place of each beam, as `Model.segmented` says."""
    n = count("segments", segments, least=1)
    SEGMENTED.admit(model)
    beams = [j for j in model.joints if isinstance(j.type, BeamEnd)]
    if not beams:
        return model
    b = ModelBuilder.of(model)
    for joint in beams:
        points = [j for j in model.joints if j.mimic and j.mimic.joint == joint.name]
        _require_free(model, joint, points)
        EI, tau, rho = _numbers(model, joint, points)
        gone = {j.name for j in (joint, *points)}
        where = next(i for i, j in enumerate(b._parts["joints"]) if j.name == joint.name)
        before, after = b._parts["joints"][:where], b._parts["joints"][where:]
        b._parts["joints"] = before
        b._parts["bodies"] = [x for x in b._parts["bodies"] if x.name not in gone - {joint.name}]
        b._bindings = [x for x in b._bindings if x.where not in ("bodies", "joints") or x.part not in gone]
        _add_chain(b, joint, n, EI, tau, rho)
        b._parts["joints"] += [j for j in after if j.name not in gone]
        b.note(f"beam {joint.name!r} as {n} rigid segments")
    return b.build()


def _numbers(model: Model, joint: Joint, points: list[Joint]) -> tuple[list[Any], Any, Any]:
    """Return EI of each plane, the damping time and the mass a metre, numbers or expressions."""
    beam: Any = joint.type
    K = np.atleast_1d(entries(joint, "stiffness", model.bindings))
    D = np.atleast_1d(entries(joint, "damping", model.bindings))
    masses = [entries(model.body(p.child), "mass", model.bindings) for p in points]
    each = len(K) // len(beam.across)
    # Straight shapes of a string bend nowhere.
    bent = int(np.argmax(beam.squares[:each]))
    EI = [K[k + bent] / beam.squares[k + bent] if beam.squares[bent] else 0.0 for k in range(0, len(K), each)]
    tau, rho = D[0] / K[0] if nominal(D[0]) else 0.0, masses[0] / beam.weights[0]
    for what, own, whole in (
        ("stiffness", K, [EI[k // each] * c for k, c in enumerate(beam.squares)]),
        ("damping", D, [tau * k for k in K] if nominal(D[0]) else [0.0 for _ in K]),
        ("mass of its points", masses, [rho * w for w in beam.weights]),
    ):
        one, other = (np.array([nominal(x) for x in values]) for values in (own, whole))
        if not np.allclose(one, other, rtol=TYPED, atol=0.0, equal_nan=True):
            raise UnsupportedError(
                f"segmented: the {what} of beam {joint.name!r} is not that of one uniform beam: {one}; let add_beam "
                "set it"
            )
    return EI, tau, rho


def _require_free(model: Model, joint: Joint, points: list[Joint]) -> None:
    """Refuse what acts on the modes, or on points of the beam."""
    lost = {p.name for p in points}
    own = {*arguments_of(model, joint.name)}
    for kind in KINDS_OF_PARTS[2:]:
        for part in getattr(model, kind):
            of_modes = {getattr(part, "joint", None), getattr(part, "leader", None), *getattr(part, "joints", ())}
            if names_in(part) & lost or joint.name in of_modes or own & {*getattr(part, "arguments", ())}:
                raise UnsupportedError(
                    f"segmented: {part.name!r} acts on the modes or points of beam {joint.name!r}, which segments have "
                    "not; leave it out"
                )


def _add_chain(b: ModelBuilder, joint: Joint, n: int, EI: list[Any], tau: Any, rho: Any) -> None:
    """Add segments between the clamp and the end; the first half of one belongs to the clamp, none of a string."""
    length, name = joint.type.length, joint.name  # type: ignore[attr-defined]  # of a beam
    h = length / n
    springs = [x / h for x in EI]
    kind = UNIVERSAL.name if len(EI) > 1 else REVOLUTE.name
    axes: dict[str, Any] = {"axis": (0.0, 0.0, 1.0)} | ({"axis2": (0.0, -1.0, 0.0)} if len(EI) > 1 else {})

    def segment(body: str, long: float) -> None:
        J = rho * (long**3 / 12)
        # A beam has no inertia about its own axis, and MuJoCo takes no body without.
        b.add_body(body, mass=rho * long, com=(long / 2, 0.0, 0.0), inertia=[PRINTED * J, J, J])

    before, at, last = joint.parent, 0.0, h
    if any(nominal(x) for x in EI):
        before, at, last = f"{name}.s0", h / 2, h / 2
        segment(before, at)
        b.add_joint(before, FIXED.name, parent=joint.parent, child=before)
    for k in range(1, n + 1):
        own, long = f"{name}.s{k}", h if k < n else last
        segment(own, long)
        loss = [tau * x for x in springs] if tau else 0.0
        place = (at, 0.0, 0.0)
        b.add_joint(own, kind, parent=before, child=own, translation=place, **axes, stiffness=springs, damping=loss)
        before, at = own, h
    b.add_joint(name, FIXED.name, parent=before, child=joint.child, translation=(last, 0.0, 0.0))
