"""What a report says of a model."""

from __future__ import annotations

from typing import Any

from mbkit.model import Model

__all__ = ["facts_of"]


def facts_of(model: Model) -> dict[str, Any]:
    """Return size, mass, digest, needs, joints, notes and faults of matter, as plain data."""
    return {
        "nq": model.nq,
        "nv": model.nv,
        # Energies do not tell it.
        **({} if model.written is not None else {"mass": model.mass}),
        "digest": model.digest,
        "needs": model.needs.as_dict(),
        "joints": list(model.joint_names),
        "notes": list(model.notes),
        "nonphysical": [f"{name}: {why}" for name, why in model.nonphysical],
    }
