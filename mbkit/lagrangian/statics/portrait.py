"""Phase portraits of systems with one degree of freedom: curves of constant energy, or the directions of motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np
import sympy as sp

from mbkit._check import Array, finite_array, needed
from mbkit.errors import InputError, UnsupportedError
from mbkit.lagrangian.energies.energy_form import acting_forces, parameter_values
from mbkit.lagrangian.energies.sympy_to_casadi import Numeric
from mbkit.lagrangian.printer import written
from mbkit.lagrangian.reduction.routh import Routhian
from mbkit.lagrangian.system import Lagrangian

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_GRID_POINTS: Final = 241


def portrait(
    system: Lagrangian | Routhian[Any], q: Sequence[float], v: Sequence[float], ax: Axes | None = None, **values: float
) -> Figure:
    """Draw the motions of a system with one degree of freedom in the plane of q and q̇.

    Without forces these are curves of constant h = T2 - T0 + V, dashed through unstable states of rest: separatrices.
    With forces or dissipation they are lines along (q̇, q̈). Dots are stable states of rest, rings the others.

    Parameters
    ----------
    system : Lagrangian or Routhian
        With one coordinate, or one that is left; without time, constraints and stops.
    q, v : (2,) array_like
        From and to which coordinate and velocity.
    ax : matplotlib.axes.Axes, optional
        Where to draw; a figure of its own by default.
    **values
        Of parameters, by name; momenta of a Routhian among them.

    Raises
    ------
    UnsupportedError
        More coordinates, a system that depends on the time, constraints or stops.
    InputError
        Bounds that are none, or a parameter without a value.
    """
    form = system.lagrangian if isinstance(system, Routhian) else system
    if not isinstance(form, Lagrangian):
        raise InputError(f"system: expected a Lagrangian or a Routhian, got {type(system).__name__}")
    bound = form.multiplier_symbols or form.stops
    if len(form.coordinates) != 1 or form.time is not None or bound or form.quasi is not None:
        raise UnsupportedError(
            f"portrait: expected one coordinate without time, constraints and stops, got {form.name} of "
            f"{', '.join(map(str, form.coordinates))}; Lagrangian.routhian leaves out cyclic coordinates"
        )
    bounds = [finite_array(name, x, (2,)) for name, x in (("q", q), ("v", v))]
    for name, (low, high) in zip("qv", bounds, strict=True):
        if low >= high:
            raise InputError(f"{name}: expected bounds that increase, got {low:g} and {high:g}")
    Q, W = np.meshgrid(*(np.linspace(low, high, _GRID_POINTS) for low, high in bounds))
    numbers = parameter_values(form, values, "portrait")

    def on(x: sp.Expr, at: Array, speed: Array) -> Array:
        arguments = form.coordinates, form.velocities, tuple(form.parameters)
        with np.errstate(all="ignore"):
            evaluate = Numeric(sp.Matrix([x]), *arguments)(at.reshape(-1, 1), speed.reshape(-1, 1), numbers)
        return np.asarray(evaluate.reshape(at.shape))

    e = form.equations()
    rate = e.applied[0].subs(dict.fromkeys(form.inputs.values(), 0)) / e.mass_matrix[0]
    rests = _rests(Q[0], on(rate, Q[0], np.zeros(_GRID_POINTS)))
    slopes = on(sp.diff(rate, form.coordinates[0]), rests, np.zeros(len(rests)))
    conserved = not any(x.free_symbols - set(form.inputs.values()) for x in acting_forces(form))
    if ax is not None and not hasattr(ax, "contour"):
        raise InputError(f"ax: expected axes of Matplotlib, got {ax!r}")
    drawn = on(form.energy_function if conserved else rate, Q, W)
    if not np.isfinite(drawn).any():
        low, high = bounds[0]
        raise InputError(f"q: {form.name} has no finite energy or acceleration from {low:g} to {high:g}")
    ax = ax or _axes()
    if conserved:
        h = drawn
        levels = np.unique(np.quantile(h[np.isfinite(h)], np.linspace(0.0, 0.97, 14)))
        ax.contour(Q, W, h, levels, colors="C0", linewidths=0.9, linestyles="solid")
        saddles = np.unique(on(form.energy_function, rests[slopes > 0], np.zeros(int((slopes > 0).sum()))))
        if len(saddles):
            ax.contour(Q, W, h, saddles, colors="C3", linewidths=1.2, linestyles="dashed")
    else:
        ax.streamplot(Q[0], W[:, 0], W, drawn, density=1.4, color="C0", linewidth=0.9, arrowsize=0.8)
    for stable, filled in ((True, "C0"), (False, "none")):
        places = rests[(slopes < 0) == stable]
        ax.plot(places, 0 * places, "o", markerfacecolor=filled, markeredgecolor="C0" if stable else "C3")
    names = (written(s.name) for s in (*form.coordinates, *form.velocities))
    ax.set(xlim=bounds[0], ylim=bounds[1], title=form.name, **dict(zip(("xlabel", "ylabel"), names, strict=True)))
    return cast("Figure", ax.get_figure(root=True))


def _rests(q: Array, rate: Array) -> Array:
    """Return where the acceleration at rest changes its sign, by a straight line between places of the grid."""
    a, b = rate[:-1], rate[1:]
    crosses = np.isfinite(a) & np.isfinite(b) & ((a * b < 0) | ((a == 0) & (b != 0)))
    return np.asarray(q[:-1][crosses] + (a[crosses] / (a - b)[crosses]) * np.diff(q)[crosses])


def _axes() -> Axes:
    with needed("matplotlib", "a figure"):
        from matplotlib.figure import Figure

    return Figure(figsize=(6.4, 4.0), layout="constrained").subplots()
