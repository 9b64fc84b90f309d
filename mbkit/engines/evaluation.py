"""What the parts of `Dynamics` and of its adapters use of each other, declared once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

from numpy.typing import ArrayLike

from mbkit._check import Array
from mbkit.model import Frame, Model

#: An adapter's method for a quantity.
Evaluate = Callable[..., Any]


class Evaluation:
    """Declarations alone: `Dynamics` and its adapters define what they name."""

    engine: ClassVar[str]
    model: Model
    _soft_jumps: bool
    _state_unchecked: bool
    _step_unchecked: bool
    # Checks, batches and methods of adapters stand in `Dynamics`.
    at: Callable[..., Any]
    _evaluate: Callable[..., Array]
    _method: Callable[[str], Evaluate]
    _without_jumps: Callable[[str], Evaluate]
    _states: Callable[[dict[str, ArrayLike]], tuple[dict[str, Array], int | None]]
    _value: Callable[[Evaluate, list[Array], tuple[Any, ...], int | None], Any]
    _require_finite: Callable[[str, Array, dict[str, Array]], None]
    _of_sample: Callable[[int], Any]
    _of_samples: Callable[[ArrayLike], Any]
    _under: Callable[[tuple[Frame, ...], str], Any]
    _stacked_wrenches: Callable[[Any], tuple[tuple[Frame, ...], Array]]
    _matter: Any
    # Quantities that others are formed from.
    forward_dynamics: Callable[..., Array]
    forward_dynamics_derivatives: Callable[..., tuple[Array, Array, Array]]
    mass_matrix: Callable[[ArrayLike], Array]
    coriolis_force: Callable[[ArrayLike, ArrayLike], Array]
    nle: Callable[[ArrayLike, ArrayLike], Array]
    pose: Callable[..., Array]
    body_poses: Callable[[ArrayLike], Array]
    velocity: Callable[..., Array]
    acceleration: Callable[..., Array]
    loop_wrenches: Callable[..., Array]
    # Adapters have these, at checked states.
    _mass_matrix: Callable[[Array], Array]
    _coriolis_matrix: Callable[[Array, Array], Any]
    _inverse_dynamics: Evaluate
    _forward_dynamics: Evaluate
    _inverse_dynamics_derivatives: Callable[[Array, Array, Array], Any]
    _constraint_jacobian: Callable[[Array], Array]
    _constraint_bias: Callable[[Array, Array], Array]
    _every_jacobian: Callable[[Array], Array]
    _pose: Callable[[Array, tuple[Frame, ...]], Array]
    _jacobian: Callable[[Array, tuple[Frame, ...], str], Array]
    _velocity: Callable[[Array, Array, tuple[Frame, ...], str], Array]
    _acceleration: Callable[[Array, Array, Array, tuple[Frame, ...], str, str], Array]
    _center_of_mass: Callable[[Array], Array]
    _centroidal_momentum: Callable[[Array, Array], Array]
    _joint_wrenches: Evaluate
    _row_choice: Any
    _jumps: Any

    @property
    def _samples(self) -> int | None:
        """Size of the batch that the parameters' values make, None where every sample has the same."""
        return None
