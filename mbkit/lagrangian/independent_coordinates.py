"""Constraints embedded: the motion on independent coordinates alone.

A chart divides q into independent and dependent coordinates. The dependent ones follow from f(q, t) = 0 by Newton's
iteration, velocities from J v + ∂f/∂t = 0 as v = N(q) u + v_t, and the equation is pulled back by N (Wehage and Haug
1982, Generalized coordinate partitioning; Shabana 2013, Dynamics of Multibody Systems, ch. 5)::

    Nᵀ M N u̇ = Nᵀ (τ + force - M a_t)

A chart serves while its dependent block of J is not much nearer to singular than J is.
"""

from __future__ import annotations

import sys
from collections import deque
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbkit._attributes import forwarded
from mbkit._check import Array
from mbkit._escape import one_line
from mbkit._reproducible import pivoted
from mbkit.engines.base import QUANTITIES, Dynamics
from mbkit.engines.constrained import ASKED
from mbkit.engines.constraint_manifold import Manifold, require_few
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import InputError, NumericalError, require_known
from mbkit.lagrangian.energy_model import abstract_parts
from mbkit.methods.one_step import MAX_NEWTON_ITERATIONS
from mbkit.model import Model
from mbkit.model.elements.paths import ALL, Path

EMBEDDED: Final = Path(
    "embedded",
    "embedded: not known of",
    ALL - {"speed"},
    {"speed": "these bind no coordinates"},
    asks=ASKED,
    instead="mbkit.simulate(lag.dynamics(), ...) holds them by multipliers, and maggi() has equations without these",
)
#: Places from which the next one is searched: more than a step has stages.
_MAX_STARTS: Final = 32
# Beyond such a change of J, relative to its size, Newton's iteration may end on another
# branch; a link that turns by half a radian changes it by half.
_MAX_JACOBIAN_CHANGE: Final = 0.5
# Size of Newton's last step, relative to the coordinates.
_NEWTON_STEP_RATIO: Final = 1e-9

#: A pose is near a singular one where the smallest singular value of J, or of the
#: dependent block, is below this part of the largest of J.
SINGULAR_VALUE_RATIO: Final = 1e-3
# A chart is changed below this part of the best quality that any choice can give.
_CHART_QUALITY_RATIO: Final = 0.25

Indices = NDArray[np.intp]


class ReducedModel(Model):
    """The independent coordinates of a system, as integrators see a model."""

    def __init__(self, whole: Model, names: tuple[str, ...]) -> None:
        # The parts of a frozen class are set once, here.
        object.__setattr__(self, "_time", whole.time_parameter)
        super().__init__(whole.name, np.zeros(3), *abstract_parts(names))

    _time: str | None

    time_parameter: str | None = forwarded("_time", "Name of the time, where it enters.")


class Chart(NamedTuple):
    """A choice of independent coordinates, by index."""

    independent: Indices
    dependent: Indices


class EmbeddedDynamics(Dynamics):
    """The equation on one chart."""

    engine = "embedded"
    _batches = False
    _refuses: ClassVar = dict.fromkeys(
        sorted(
            set(QUANTITIES)
            - {"mass_matrix", "forward_dynamics", "inverse_dynamics", "kinetic_energy", "potential_energy"}
        ),
        "on independent coordinates there is the equation as a whole; the dynamics on all coordinates has the terms",
    )

    def __init__(self, model: Model, whole: LagrangianDynamics, chart: Chart, t: float) -> None:
        super().__init__(model)
        self._whole, self._chart = whole, chart
        self._manifold = Manifold(whole).at(t)
        # Ends of Newton's last iterations: q, J, and the sign of the dependent block's determinant.
        self._places: deque[tuple[Array, Array, float]] = deque(maxlen=_MAX_STARTS)

    def at(self, /, **values: float) -> EmbeddedDynamics:
        """Return the same dynamics at another time."""
        out = object.__new__(type(self))
        # Newton's iteration starts from where it last ended, at whatever time.
        out.__dict__.update(self.__dict__)
        (t,) = values.values()
        out._manifold = Manifold(self._whole).at(t)
        return out

    def remember(self, q: Array) -> None:
        """Start the next search at a consistent q; refuse one that leaves dependent coordinates undetermined."""
        J = self._manifold.jacobian(q)
        sign = self._sign(J)
        if not sign:
            raise InputError(
                f"{self.model.name}: {', '.join(self.model.coordinate_names)} do not determine the other coordinates "
                f"at {self._at(q[self._chart.independent])}, a singular pose; choose others, or leave the choice open"
            )
        self._places.clear()
        self._places.append((q.copy(), J, sign))

    def _sign(self, J: Array) -> float:
        return float(np.linalg.slogdet(J[:, self._chart.dependent])[0])

    # All coordinates from the independent ones

    def configuration(self, u: Array) -> Array:
        """Return q, (n,)."""
        chart, name = self._chart, self.model.name
        # The place whose independent coordinates are the nearest; of equal ones the last.
        distance = lambda place: float(np.abs(place[0][chart.independent] - u).max())  # noqa: E731
        q, J, sign = min(reversed(self._places), key=distance)
        q, before = q.copy(), J
        q[chart.dependent] -= self._solved(J, J[:, chart.independent] @ (u - q[chart.independent]), q)
        q[chart.independent] = u
        for _ in range(MAX_NEWTON_ITERATIONS):
            f, J = self._manifold.call("constraint_rows", q)
            step = self._solved(J, f[:, 0], q)
            q[chart.dependent] -= step
            size = float(np.abs(step).max())
            if not np.isfinite(size):
                break
            # The iteration squares the error.
            if size <= _NEWTON_STEP_RATIO * (1 + float(np.abs(q).max())):
                if self._sign(J) != sign:
                    # On the other side of a singular pose another branch begins.
                    raise NumericalError(f"{name}: beyond a singular pose at {self._at(u)}")
                if np.linalg.norm(J - before) > _MAX_JACOBIAN_CHANGE * np.linalg.norm(before):
                    raise NumericalError(f"{name}: too long a step to {self._at(u)} to tell the dependent coordinates")
                self._places.append((q.copy(), J, sign))
                return q
        raise NumericalError(
            f"{name}: Newton's iteration finds no dependent coordinates at {self._at(u)}; perhaps beyond a singular "
            "pose"
        )

    def _at(self, u: Array) -> str:
        return ", ".join(f"{n} = {x:.6g}" for n, x in zip(self.model.coordinate_names, u, strict=True))

    def _solved(self, J: Array, right: Array, q: Array) -> Array:
        try:
            return np.asarray(np.linalg.solve(J[:, self._chart.dependent], right))
        except np.linalg.LinAlgError:
            place = self._at(q[self._chart.independent])
            raise NumericalError(f"{self.model.name}: singular pose at {place}") from None

    def state(self, u: Array, w: Array) -> tuple[Array, Array]:
        """Return q and v, (n,) each."""
        q = self.configuration(u)
        N, drift = self._null(q)
        return q, N @ w + drift

    def pullback(self, u: Array, tau: Array) -> Array:
        """Return Nᵀ τ of a generalized force on all coordinates."""
        return np.asarray(self._null(self.configuration(u))[0].T @ tau)

    def _null(self, q: Array) -> tuple[Array, Array]:
        """Return N and the part of v that the time makes."""
        chart = self._chart
        _, J, by_time, *_ = self._manifold.call("constraint", q, np.zeros_like(q))
        both = self._solved(J, np.column_stack([J[:, chart.independent], by_time]), q)
        N, drift = np.zeros((len(q), len(chart.independent))), np.zeros(len(q))
        N[chart.independent, np.arange(N.shape[1])] = 1.0
        N[chart.dependent], drift[chart.dependent] = -both[:, :-1], -both[:, -1]
        return N, drift

    def _reduced(self, u: Array, w: Array) -> tuple[Array, Array, Array]:
        """Return N, Nᵀ M N and the right side without τ."""
        q = self.configuration(u)
        N, drift = self._null(q)
        J, _, gamma, M, force = self._manifold.call("embedded", q, N @ w + drift)
        a = np.zeros(len(q))
        a[self._chart.dependent] = -self._solved(J, gamma[:, 0], q)
        return N, N.T @ M @ N, N.T @ (force[:, 0] - M @ a)

    # The protocol

    def _mass_matrix(self, q: Array) -> Array:
        return self._reduced(q, np.zeros(len(q)))[1]

    def _forward_dynamics(self, q: Array, v: Array, tau: Array) -> Array:
        _, M, force = self._reduced(q, v)
        return np.asarray(np.linalg.solve(M, tau + force))

    def _inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array:
        _, M, force = self._reduced(q, v)
        return np.asarray(M @ a - force)

    def _kinetic_energy(self, q: Array, v: Array) -> Any:
        return self._manifold.dyn.kinetic_energy(*self.state(q, v))

    def _potential_energy(self, q: Array) -> Any:
        return self._manifold.dyn.potential_energy(self.configuration(q))


class Embedded:
    """A system under constraints, to be simulated on independent coordinates: ``mbkit.simulate(embedded, ...)``.

    Attributes
    ----------
    dynamics : LagrangianDynamics
        On all coordinates, with multipliers.
    independent : tuple of str or None
        A fixed choice; else the best one, chosen again when it no longer is.
    degrees : int
        Of freedom.
    """

    def __init__(self, manifold: Manifold, independent: tuple[str, ...] | None = None) -> None:
        self.manifold, self.dynamics, self.independent = manifold, manifold.dyn, independent
        self.model = manifold.dyn.model
        form = manifold.equations.form
        EMBEDDED.admit(self.model)
        rows = len(form.constraints)
        require_few(manifold)
        self.degrees = self.model.nv - rows
        if self.degrees < 1:
            raise InputError(f"{self.model.name}: {rows} constraints leave none of {self.model.nv} coordinates free")
        # However chosen, the best block of a matrix is no worse than this (Gu and Eisenstat 1996).
        self.least = _CHART_QUALITY_RATIO / float(np.sqrt(1 + rows * self.degrees))
        known = self.model.coordinate_names
        require_known("coordinate", known, *(independent or ()))
        if independent is not None and len(set(independent)) != self.degrees:
            choice = ", ".join(independent) or "none"
            raise InputError(f"independent: expected {self.degrees} of {', '.join(known)}, got {choice}")

    def __repr__(self) -> str:
        chosen = "chosen as it runs" if self.independent is None else ", ".join(self.independent)
        return one_line(f"<Embedded {self.model.name!r}: {self.degrees} of {self.model.nv} coordinates, {chosen}>")

    def chart(self, q: Array, t: float) -> Chart:
        """Return the chart to start with at a configuration: the pivots of J, or what the user chose."""
        names = self.model.coordinate_names
        if self.independent is None:
            J = self.manifold.at(t).jacobian(q)
            first = pivoted(J.T, 0.0)[0]
            # At a singular pose fewer columns have a remainder than there are rows.
            order = [*first, *np.setdiff1d(np.arange(J.shape[1]), first)]
            independent = np.sort(order[len(J) :])
        else:
            independent = np.array([names.index(n) for n in self.independent], dtype=np.intp)
        return Chart(independent, np.setdiff1d(np.arange(len(names)), independent))

    def names(self, chart: Chart) -> str:
        """Return the independent coordinates of a chart to read."""
        return ", ".join(self.model.coordinate_names[i] for i in chart.independent)

    def quality(self, chart: Chart, q: Array, t: float) -> float:
        """Return the smallest singular value of the dependent block over that of J: small where it is a bad choice."""
        J = self.manifold.at(t).jacobian(q)
        return _smallest(J[:, chart.dependent]) / max(_smallest(J), sys.float_info.min)

    def nearness(self, chart: Chart, q: Array, t: float) -> float:
        """Return the smallest singular value over the largest: of J, or of a dependent block that is to stay."""
        J = self.manifold.at(t).jacobian(q)
        block = J if self.independent is None else J[:, chart.dependent]
        return _smallest(block) / max(float(np.linalg.norm(J, 2)), sys.float_info.min)

    def on(self, chart: Chart, q: Array, t: float) -> EmbeddedDynamics:
        """Return the dynamics on a chart's independent coordinates, at a time and a consistent configuration."""
        names = tuple(self.model.coordinate_names[i] for i in chart.independent)
        out = EmbeddedDynamics(ReducedModel(self.model, names), self.dynamics, chart, t)
        out.remember(q)
        return out


def _smallest(J: Array) -> float:
    return float(np.linalg.svd(J, compute_uv=False)[-1])
