"""The methods of integration, as data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

from mbkit.errors import InputError, UnknownNameError

__all__ = ["METHODS", "Method", "Tolerances", "method_of"]

_EPS: Final = 2.0**-52


@dataclass(frozen=True)
class Method:
    """A way to integrate.

    Attributes
    ----------
    name : str
    kind : {"fixed", "adaptive", "native"}
        A step `dt`; a tolerance `rtol`; or a step of an engine's own integrator.
    order : int or None
        Order of the global error, as a function of the step; None where it varies.
    stages : int
        Evaluations of the forward dynamics per step; 0 where that varies.
    about : str
        One line, with the source.
    engines : tuple of str
        Those that have it; any engine with forward dynamics where empty.
    events : bool
        Whether a run can stop at an event.
    least : float
        The tightest tolerance that it takes.
    callables : bool
        Whether the torque may be a function.
    lacks : str
        Why other engines do not have it; empty for what is an engine's own.
    """

    name: str
    kind: Literal["fixed", "adaptive", "native"]
    order: int | None
    stages: int
    about: str
    engines: tuple[str, ...] = ()
    events: bool = False
    least: float = 0.0
    callables: bool = True
    lacks: str = ""


class Tolerances(NamedTuple):
    """What an adaptive method keeps its error per step below: atol + rtol |y|."""

    rtol: float
    atol: float


def _scipy(name: str, order: int | None, stages: int, about: str) -> Method:
    # SciPy's solvers raise a smaller rtol to this by themselves.
    return Method(name, "adaptive", order, stages, about, events=True, least=100 * _EPS)


def _mujoco(name: str, order: int, stages: int, about: str) -> Method:
    return Method(f"mujoco_{name}", "native", order, stages, about, engines=("mujoco",), callables=False)


def _drake(name: str, order: int | None, about: str) -> Method:
    return Method(f"drake_{name}", "adaptive", order, 0, about, engines=("drake",), least=1e-15, callables=False)


METHODS: Final[dict[str, Method]] = {
    m.name: m
    for m in (
        Method("rk4", "fixed", 4, 4, "Kutta's method of 1901; Munthe-Kaas (1999) on rotations, as MuJoCo 4 does it"),
        Method("semi_implicit_euler", "fixed", 1, 1, "new velocity, then the position with it, as MuJoCo does it"),
        Method(
            "implicit_midpoint",
            "fixed",
            2,
            0,
            "the midpoint rule in (q, p), on rotations its variational form: symplectic",
            engines=("lagrangian",),
            lacks="gives neither momenta nor ∂T/∂q with their derivatives, which the rule in (q, p) is made of",
        ),
        Method("gauss4", "fixed", 4, 0, "Gauss-Legendre collocation, 2 stages (Hairer, Nørsett, Wanner 1993, II.7)"),
        Method("gauss6", "fixed", 6, 0, "Gauss-Legendre collocation, 3 stages (Hairer, Nørsett, Wanner 1993, II.7)"),
        Method(
            "rk853",
            "adaptive",
            8,
            12,
            "Dormand and Prince 8(5,3) on the manifold, compiled where the dynamics is",
            events=True,
            least=_EPS,
        ),
        Method(
            "auto",
            "adaptive",
            None,
            0,
            "rk853, or rodas5 where stability holds its steps, by a look at the linearized system; stats.chosen tells",
            events=True,
            least=_EPS,
        ),
        Method(
            "rodas5",
            "adaptive",
            5,
            8,
            "Rosenbrock's method Rodas5P, stiff: one Jacobian and one factorization a step (Steinebach 2023)",
            events=True,
            least=_EPS,
        ),
        Method(
            "taylor",
            "adaptive",
            None,
            0,
            "heyoka's Taylor series, order by tolerance (Jorba and Zou 2005); 34 digits on the oracle",
            engines=("lagrangian", "oracle"),
            events=True,
            least=_EPS,
            callables=False,
            lacks="gives numbers and no expressions, which a series is made of",
        ),
        _scipy("dop853", 8, 12, "SciPy's DOP853 (Hairer, Nørsett, Wanner 1993, II.5)"),
        _scipy("radau", 5, 0, "SciPy's Radau IIA, implicit (Hairer, Wanner 1996, IV.8)"),
        _scipy("bdf", None, 0, "SciPy's BDF, orders 1 to 5, implicit (Shampine, Reichelt 1997)"),
        _scipy("lsoda", None, 0, "ODEPACK's LSODA: Adams or BDF, whichever suits (Petzold 1983)"),
        Method(
            "cvodes",
            "adaptive",
            None,
            0,
            "SUNDIALS' CVODES through CasADi: BDF, orders 1 to 5 (Hindmarsh and others 2005)",
            engines=("lagrangian",),
            least=100 * _EPS,
            callables=False,
            lacks="gives numbers and no expressions, which it integrates",
        ),
        _mujoco("euler", 1, 1, "MuJoCo's own semi-implicit Euler"),
        _mujoco("rk4", 4, 4, "MuJoCo's own RK4"),
        _mujoco("implicit", 1, 1, "MuJoCo's own Euler, implicit in dampers and all velocity terms"),
        _mujoco("implicitfast", 1, 1, "as mujoco_implicit, with the Coriolis derivatives of free bodies alone"),
        _mujoco("discrete", 1, 1, "MuJoCo's own Euler, implicit in dampers and springs"),
        _drake("runge_kutta3", 3, "Drake's own third-order Runge-Kutta with error control"),
        _drake("runge_kutta5", 5, "Drake's own Dormand-Prince 5(4)"),
        _drake("bogacki_shampine3", 3, "Drake's own Bogacki-Shampine 3(2)"),
        _drake("radau3", 3, "Drake's own Radau IIA of two stages, implicit"),
        _drake("implicit_euler", 1, "Drake's own implicit Euler with error control"),
    )
}


def method_of(name: object) -> Method:
    """Return the method of this name."""
    if not isinstance(name, str):
        raise InputError(f"method: expected a name, got {name!r}; there are: {', '.join(METHODS)}")
    if name not in METHODS:
        raise UnknownNameError("method", name, METHODS)
    return METHODS[name]
