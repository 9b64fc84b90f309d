"""States of a run over time, and the quantities that follow from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mbkit._check import Array
from mbkit.engines import ENGINES, Dynamics, dynamics
from mbkit.engines.base import at_times
from mbkit.errors import InputError, UnsupportedError
from mbkit.methods.registry import Tolerances
from mbkit.model import Model
from mbkit.simulate.along_trajectory import canonical_momentum, kinetic_energy, momentum, potential_energy, work
from mbkit.simulate.events import Hit
from mbkit.simulate.result import Stats
from mbkit.simulate.torque import Applied, PiecewiseConstantTorque, SampledTorque, TorqueCallback


@dataclass(frozen=True, eq=False)
class RunSettings:
    """What a run was started with, for checks afterwards."""

    t0: float
    q0: Array
    v0: Array
    # The step, s, or the tolerances of an adaptive method.
    setting: float | Tolerances
    # Those of the solver itself.
    doubts: tuple[str, ...]

    def with_start(self, t: Array, q: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return saved times and states with the start."""
        if len(t) and t[0] == self.t0:
            return t, q, v
        q, v = (np.concatenate([x[..., None, :], saved], -2) for x, saved in ((self.q0, q), (self.v0, v)))
        return np.append(self.t0, t), q, v


@dataclass(frozen=True, eq=False, repr=False)
class RunData:
    """States over time of one run or of a batch, with its model and its settings; see `Trajectory`."""

    t: Array
    q: Array
    v: Array
    model: Model
    method: str
    engine: str
    stats: Stats
    _dyn: Dynamics | None = None
    events: tuple[Hit, ...] = ()
    _applied: Applied | None = None
    _settings: RunSettings | None = None

    def __post_init__(self) -> None:
        for name in ("t", "q", "v"):
            array = getattr(self, name)
            if array.flags.writeable or array.base is not None or not array.flags.c_contiguous:
                array = np.array(array, order="C")
                array.setflags(write=False)
            object.__setattr__(self, name, array)

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        # A process pool would derive an engine that is sent along for every trajectory.
        known = self.engine in ENGINES and (self._dyn is None or self._dyn.samples is None)
        applied = self._applied
        if isinstance(applied, TorqueCallback):
            # Functions can seldom be pickled; their values can.
            applied = applied.sampled(self.t, self.q, self.v, strict=False)
        dyn = None if known else self._dyn
        return type(self), (
            *(self.t, self.q, self.v, self.model, self.method, self.engine, self.stats),
            *(dyn, self.events, applied, self._settings),
        )

    # Energies, work and momenta

    def energy(self, engine: str | Dynamics | None = None) -> Array:
        """Return kinetic plus potential energy in J, shape (K,) or (N, K).

        Parameters
        ----------
        engine : str or Dynamics, optional
            The engine that computes it; the run's own when not given.
        """
        dyn = self._by(engine)
        return kinetic_energy(dyn, self.q, self.v) + potential_energy(dyn, self.q)

    def kinetic_energy(self, engine: str | Dynamics | None = None) -> Array:
        """Return ½ vᵀ M v in J, which no known defect of an engine touches; shape (K,) or (N, K)."""
        return kinetic_energy(self._by(engine), self.q, self.v)

    def potential_energy(self, engine: str | Dynamics | None = None) -> Array:
        """Return the energy of gravity and springs in J, shape (K,) or (N, K)."""
        return potential_energy(self._by(engine), self.q)

    def tau(self) -> Array:
        """Return the generalized force that acted at each state, of the shape of v.

        Of an array: the row that acts from there on, at the end the last one. A function is called once
        more at the saved states (when the trajectory is pickled, then). Where the function ended the run,
        the last state has NaN.

        Raises
        ------
        TorqueError
            The function fails at a state where it did not before.
        """
        acted = self._acted()
        if acted is None:
            return np.zeros(self.v.shape)
        if isinstance(acted, SampledTorque):
            return acted.values.copy()
        rows = np.broadcast_to(acted.at(self.t), self.v.shape)
        return np.where(np.isfinite(self.v).all(-1, keepdims=True), rows, np.nan)

    def work(self, engine: str | Dynamics | None = None) -> Array:
        """Return ∫ (τ + τ_damping)·v dt since the first state in J, shape (K,) or (N, K).

        The work of a constant or held torque is τ·Δq, exact for the saved positions, where v = q̇. On
        quasi-velocities, for dampers and for a torque function it is a quadrature of fourth order in the
        distance of the saved states; a torque function that jumps makes it first order.

        Parameters
        ----------
        engine : str or Dynamics, optional
            The engine that computes damping and accelerations.

        Raises
        ------
        UnsupportedError
            The rows of a held torque change between two saved states.
        """
        return work(self._by(engine), self.t, self.q, self.v, self._acted())

    def power_balance(self, engine: str | Dynamics | None = None) -> Array:
        """Return E(t) - E(0) - work(t) in J: zero for a run without error, shape (K,) or (N, K).

        It holds the error of the run and that of `work`, a quadrature on the saved states: save every step
        to make the second small. Without torque or with a constant or held one, on coordinates with v = q̇
        and no dampers, only the error of the run is left.
        """
        energy = self.energy(engine)
        return np.asarray(energy - energy[..., :1] - self.work(engine))

    def momentum(self, engine: str | Dynamics | None = None) -> Array:
        """Return the bodies' momentum, shape (K, 6) or (N, K, 6), in world axes.

        Linear, kg m/s, then angular about the world's origin, kg m²/s: summed over the bodies with the
        engine's poses and Jacobians. Armature belongs to no body and is left out.
        """
        return momentum(self._by(engine), self.q, self.v)

    def canonical_momentum(self, engine: str | Dynamics | None = None) -> Array:
        """Return p = M v, shape (K, nv) or (N, K, nv)."""
        return canonical_momentum(self._by(engine), self.q, self.v)

    def _by(self, engine: str | Dynamics | None) -> Dynamics:
        if engine is None or engine == self.engine:
            dyn = self._own()
        elif isinstance(engine, Dynamics):
            if engine.model.coordinate_names != self.model.coordinate_names:
                raise InputError(f"engine: expected a Dynamics of {self.model.name}, got one of {engine.model.name}")
            dyn = engine
        elif self._dyn is not None and self._dyn.samples is not None:
            raise UnsupportedError(
                f"{engine}: the trajectories have parameters of their own, which only the {self.engine} engine holds"
            )
        else:
            dyn = dynamics(self.model, engine)
        return at_times(dyn, self.t, len(self.q) if self.q.ndim == 3 else None)

    def _own(self) -> Dynamics:
        if self._dyn is None:
            object.__setattr__(self, "_dyn", dynamics(self.model, self.engine))
        assert self._dyn is not None
        return self._dyn

    def _acted(self) -> PiecewiseConstantTorque | SampledTorque | None:
        if isinstance(self._applied, TorqueCallback):
            strict = self.stats.ended != "function_failed"
            answers = self._applied.sampled(self.t, self.q, self.v, strict=strict)
            object.__setattr__(self, "_applied", answers)
        acted = self._applied
        assert not isinstance(acted, TorqueCallback)
        return acted
