"""The methods of integration, as data, and their names.

What other code asks of a method is an attribute of it: no other code tests a method's name.
"""

from __future__ import annotations

import pickle
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, Literal, NamedTuple

from mbkit._check import EPS
from mbkit.errors import InputError, UnsupportedError, require_known
from mbkit.methods.one_step import SemiImplicitEuler
from mbkit.methods.stability import IMPLICIT_EULER, IMPLICIT_IN_VELOCITY, SYMPLECTIC_EULER, Stability, TableauStability
from mbkit.methods.tableaus import (
    RK4,
    EmbeddedTableau,
    ImplicitTableau,
    RosenbrockTableau,
    Tableau,
    dormand_prince_853,
    gauss_legendre,
    rodas5p,
)

#: With a step, when nothing else is said.
DEFAULT_METHOD: Final = "rk4"
#: The method of first order, as MuJoCo does it.
EULER_METHOD: Final = "semi_implicit_euler"
#: With a tolerance, for motions that are not stiff.
ADAPTIVE_METHOD: Final = "rk853"
#: With a tolerance, for stiff systems.
STIFF_METHOD: Final = "rodas5"
#: Chooses between the last two.
AUTOMATIC_METHOD: Final = "auto"
#: The most accurate one; with 34 digits on the oracle.
SERIES_METHOD: Final = "taylor"
#: SciPy's, on any engine: for motions that are not stiff, and for stiff ones.
SCIPY_METHOD: Final = "dop853"
SCIPY_STIFF_METHOD: Final = "radau"
#: With a step, for dry friction at many joints.
FRICTION_METHOD: Final = "moreau"
#: The most accurate implicit one with a fixed step.
GAUSS_METHOD: Final = "gauss6"
#: One of each kind, and MuJoCo's own beside the same formulas.
QUICK_METHODS: Final = (
    DEFAULT_METHOD,
    EULER_METHOD,
    ADAPTIVE_METHOD,
    SCIPY_METHOD,
    *("mujoco_rk4", "mujoco_euler", "mujoco_implicitfast"),
)

#: With a fixed step, on any engine, for a sentence.
IMPLICIT_METHODS: Final = "'gauss4' and 'gauss6'"

#: A step in mbkit's own code.
Formula = Tableau | RosenbrockTableau | SemiImplicitEuler


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
    about, lacks : str
        One line, with the source; why other engines do not have it, empty for an engine's own method.
    engines : tuple of str
        Those that have it, of any version; any engine with forward dynamics where empty.
    events, callables : bool
        Whether a run can stop at an event; whether the torque may be a function.
    least : float
        The tightest tolerance that it takes.
    formula_source : Formula, callable or None
        The step in mbkit's own code, or a function that constructs it; None for what another program integrates.
    solver, scheme : str
        ``"module:function"`` below `mbkit.simulate.solvers` that runs it; its name in the program that integrates.
    stability : Stability or None
        What a fixed step does to linear systems.
    jacobian, mass_matrix : bool
        Whether it needs the Jacobian of the forward dynamics; whether it solves with the mass matrix itself, however
        the engine computes accelerations.
    compiled : bool
        Whether the Lagrangian engine runs its steps as machine code.
    fills_tolerance, scaled_by_start : bool
        Whether the error of a step is as large as the tolerance allows (that of other methods is a third to a
        three-hundredth of it); whether the tolerance is relative to the numbers of the start.
    extended, multistep : bool
        Whether the oracle runs it with 34 digits; whether its interpolant is as accurate as its steps, and stopping
        often slows it.
    own : str
        Of an engine's integrator: the method of mbkit with the same formula.
    wrenches : bool
        Whether wrenches may act on frames.
    carries : frozenset of str
        Effects of kinds of parts that it solves by itself, and for which it is not run phase by phase.
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
    formula_source: Formula | Callable[[], Formula] | None = None
    solver: str = ""
    scheme: str = ""
    stability: Stability | None = None
    jacobian: bool = False
    mass_matrix: bool = False
    compiled: bool = False
    fills_tolerance: bool = False
    scaled_by_start: bool = False
    extended: bool = False
    multistep: bool = False
    own: str = ""
    wrenches: bool = True
    carries: frozenset[str] = frozenset()

    @cached_property
    def formula(self) -> Formula | None:
        """The step in mbkit's own code, from `formula_source`."""
        source = self.formula_source
        return source() if callable(source) else source

    def on(self, engine: str) -> bool:
        """Return whether an engine has it, by its name, with a version or without."""
        return not self.engines or engine.partition("==")[0] in self.engines

    def runs_compiled(self, *, derived: bool) -> bool:
        """Return whether no evaluation is a call from Python, on an engine with mbkit's own derivation or without."""
        return bool(self.engines) or (self.compiled and derived)

    @property
    def explicit(self) -> bool:
        """Whether a fixed step is a formula in which every stage follows from those before."""
        return self.kind == "fixed" and isinstance(self.formula, (Tableau, SemiImplicitEuler)) and self.formula.explicit

    @property
    def in_momenta(self) -> bool:
        """Whether its fixed step is one of (q, p), and no formula of velocities and accelerations."""
        return self.kind == "fixed" and self.formula is None and not self.carries

    @property
    def code_name(self) -> str:
        """Prefix of the names of compiled functions; it tells a tableau's coefficients."""
        return f"{self.name}_{self.formula.digest}" if isinstance(self.formula, Tableau) else self.name


class Tolerances(NamedTuple):
    """An adaptive method keeps its error per step below atol + rtol |y|."""

    rtol: float
    atol: float


_RK4_STABILITY: Final = TableauStability(RK4)
_MIDPOINT: Final = ImplicitTableau("implicit_midpoint", [[0.5]], [1.0], 2)

_ABOUT: Final = {
    DEFAULT_METHOD: "Kutta's method of 1901; Munthe-Kaas (1999) on rotations, as MuJoCo 4 does it",
    EULER_METHOD: "new velocity, then the position with it, as MuJoCo does it",
    FRICTION_METHOD: "semi-implicit Euler with dry friction as impulses (Moreau 1988, Jean 1999); its cone is solved "
    "exactly at each step",
    "implicit_midpoint": "the midpoint rule in (q, p), on rotations its variational form: symplectic",
    "gauss4": "Gauss-Legendre collocation, 2 stages (Hairer, Nørsett, Wanner 1993, II.7)",
    GAUSS_METHOD: "Gauss-Legendre collocation, 3 stages (Hairer, Nørsett, Wanner 1993, II.7)",
    ADAPTIVE_METHOD: "Dormand and Prince 8(5,3) on the manifold, compiled where the dynamics is",
    AUTOMATIC_METHOD: f"{ADAPTIVE_METHOD}, or {STIFF_METHOD} where stability holds its steps, by a look at the "
    "linearized system; stats.chosen tells",
    STIFF_METHOD: "Rosenbrock's method Rodas5P, stiff: one Jacobian and one factorization a step (Steinebach 2023)",
    SERIES_METHOD: "heyoka's Taylor series, order by tolerance (Jorba and Zou 2005); 34 digits on the oracle",
    SCIPY_METHOD: "SciPy's DOP853 (Hairer, Nørsett, Wanner 1993, II.5)",
    SCIPY_STIFF_METHOD: "SciPy's Radau IIA, implicit (Hairer, Wanner 1996, IV.8)",
    "bdf": "SciPy's BDF, orders 1 to 5, implicit (Shampine, Reichelt 1997)",
    "lsoda": "ODEPACK's LSODA: Adams or BDF, whichever suits (Petzold 1983)",
    "mujoco_euler": "MuJoCo's own semi-implicit Euler",
    "mujoco_rk4": "MuJoCo's own RK4",
    "newton_featherstone": "SolverFeatherstone of Newton, a semi-implicit Euler",
    "mujoco_implicit": "MuJoCo's own Euler, implicit in dampers and all velocity terms",
    "mujoco_implicitfast": "as mujoco_implicit, with the Coriolis derivatives of free bodies alone",
    "mujoco_discrete": "MuJoCo's own Euler, implicit in dampers and springs",
    "drake_runge_kutta3": "Drake's own third-order Runge-Kutta with error control",
    "drake_runge_kutta5": "Drake's own Dormand-Prince 5(4)",
    "drake_bogacki_shampine3": "Drake's own Bogacki-Shampine 3(2)",
    "drake_radau3": "Drake's own Radau IIA of two stages, implicit",
    "drake_implicit_euler": "Drake's own implicit Euler with error control",
    "drake_sap": "Drake's own discrete plant, whose SAP solver holds loops (Castro, Permenter and Han 2023)",
}


def _fixed(name: str, order: int, **more: Any) -> Method:
    return Method(name, "fixed", order, about=_ABOUT[name], **{"stages": 0, "solver": "fixed_step:run_fixed", **more})


def _adaptive(name: str, order: int | None, solver: str, **more: Any) -> Method:
    more = {"stages": 0, "events": True, "least": EPS, **more}
    return Method(name, "adaptive", order, about=_ABOUT[name], solver=solver, **more)


def _scipy(name: str, scheme: str, order: int | None, **more: Any) -> Method:
    # SciPy's solvers raise a smaller rtol to this by themselves.
    return _adaptive(name, order, "external:run_scipy", scheme=scheme, least=100 * EPS, **more)


def _native(name: str, order: int, stability: Stability, *engines: str, **more: Any) -> Method:
    more = {"solver": "external:run_native", "stability": stability, "callables": False, "wrenches": False, **more}
    return Method(name, "native", order, order, _ABOUT[name], engines=engines, **more)


def _drake(scheme: str, order: int) -> Method:
    more: dict[str, Any] = {"engines": ("drake",), "events": False, "callables": False, "wrenches": False}
    return _adaptive(f"drake_{scheme}", order, "external:run_drake", scheme=scheme, least=1e-15, **more)


#: The programs that have MuJoCo's integrators.
_OF_MUJOCO: Final = ("mujoco", "mujoco-warp", "mjx", "mjx-single", "newton")
_STIFF: Final[dict[str, Any]] = {"jacobian": True, "fills_tolerance": True}
_STIFF_OWN: Final[dict[str, Any]] = {**_STIFF, "compiled": True}
_MOMENTA: Final[dict[str, Any]] = {
    "engines": ("lagrangian",),
    "lacks": "gives neither momenta nor ∂T/∂q with their derivatives, which the rule in (q, p) needs",
    "solver": "implicit_midpoint:run_midpoint",
}
_SERIES: Final[dict[str, Any]] = {
    "engines": ("lagrangian", "oracle"),
    "callables": False,
    "lacks": "gives numbers and no expressions, which a series needs",
}

METHODS: Final[dict[str, Method]] = {
    m.name: m
    for m in (
        _fixed(DEFAULT_METHOD, 4, stages=4, formula_source=RK4, stability=_RK4_STABILITY, compiled=True),
        _fixed(
            EULER_METHOD, 1, stages=1, formula_source=SemiImplicitEuler(), stability=SYMPLECTIC_EULER, compiled=True
        ),
        _fixed(
            "implicit_midpoint", 2, stability=TableauStability(_MIDPOINT), mass_matrix=True, compiled=True, **_MOMENTA
        ),
        *(
            _fixed(
                tableau.name, tableau.order, formula_source=tableau, stability=TableauStability(tableau), compiled=True
            )
            for tableau in (gauss_legendre(2), gauss_legendre(3))
        ),
        _fixed(
            FRICTION_METHOD,
            1,
            stages=1,
            stability=SYMPLECTIC_EULER,
            carries=frozenset(["jump"]),
            compiled=True,
            solver="in_phases.moreau:run_moreau",
        ),
        _adaptive(
            ADAPTIVE_METHOD, 8, "adaptive:run_embedded", stages=12, formula_source=dormand_prince_853, compiled=True
        ),
        _adaptive(AUTOMATIC_METHOD, None, "auto:run_auto", jacobian=True, compiled=True),
        _adaptive(
            STIFF_METHOD, 5, "adaptive:run_embedded", stages=8, formula_source=rodas5p, mass_matrix=True, **_STIFF_OWN
        ),
        _adaptive(
            SERIES_METHOD, None, "taylor:run_taylor", scaled_by_start=True, extended=True, compiled=True, **_SERIES
        ),
        _scipy(SCIPY_METHOD, "DOP853", 8, stages=12),
        _scipy(SCIPY_STIFF_METHOD, "Radau", 5, **_STIFF),
        _scipy("bdf", "BDF", None, multistep=True, **_STIFF),
        _scipy("lsoda", "LSODA", None, multistep=True, **_STIFF),
        _native("mujoco_euler", 1, SYMPLECTIC_EULER, *_OF_MUJOCO, scheme="euler", own=EULER_METHOD),
        _native("mujoco_rk4", 4, _RK4_STABILITY, *_OF_MUJOCO, scheme="rk4", own=DEFAULT_METHOD),
        _native("mujoco_implicit", 1, IMPLICIT_IN_VELOCITY, "mujoco", scheme="implicit"),
        _native("mujoco_implicitfast", 1, IMPLICIT_IN_VELOCITY, *_OF_MUJOCO, scheme="implicitfast"),
        _native("mujoco_discrete", 1, IMPLICIT_EULER, "mujoco", scheme="discrete"),
        _native("newton_featherstone", 1, SYMPLECTIC_EULER, "newton", scheme="featherstone"),
        _drake("runge_kutta3", 3),
        _drake("runge_kutta5", 5),
        _drake("bogacki_shampine3", 3),
        _drake("radau3", 3),
        _drake("implicit_euler", 1),
        _native("drake_sap", 1, IMPLICIT_IN_VELOCITY, "drake", solver="external:run_drake_discrete"),
    )
}
_BUILT_IN: Final = frozenset(METHODS)


def method_of(name: object) -> Method:
    """Return the method of this name."""
    if not isinstance(name, str):
        raise InputError(f"method: expected a name, got {name!r}; there are: {', '.join(METHODS)}")
    require_known("method", METHODS, name)
    return METHODS[name]


def explicit_method(name: object) -> Method:
    """Return the method of this name, whose fixed step must be explicit."""
    method = method_of(name)
    if not method.explicit:
        there = ", ".join(m.name for m in METHODS.values() if m.explicit)
        raise UnsupportedError(
            f"step: {method.name} has no explicit fixed step; use {there}, or mbkit.simulate, which has every method"
        )
    return method


def register_method(method: Method | Tableau) -> Method:
    """Add a Runge-Kutta method with a fixed step to `METHODS`, for this process and the workers of its studies.

    Every engine runs it; where the Lagrangian engine compiles and the method is explicit, as machine code.

    Parameters
    ----------
    method : Tableau, ImplicitTableau or Method
        A tableau, named as the method; or a `Method` of kind ``"fixed"`` with a tableau as `formula_source`.

    Returns
    -------
    Method
        Now in `METHODS`.

    Raises
    ------
    InputError
        The name is in use or no identifier of lower-case letters, digits and single underscores; or the method is no
        Runge-Kutta method with a fixed step.

    Examples
    --------
    >>> import mbkit as mb
    >>> heun = mb.simulate.Tableau("heun", [[0, 0], [1, 0]], [0.5, 0.5], order=2)
    >>> mb.simulate.register_method(heun).stages
    2
    >>> del mb.simulate.METHODS["heun"]
    """
    tableau = method.formula if isinstance(method, Method) else method
    if not isinstance(tableau, Tableau) or isinstance(tableau, EmbeddedTableau):
        raise InputError(
            "method: expected a Tableau or an ImplicitTableau, or a Method with one as formula_source, "
            f"got {type(tableau).__name__}; give a pair with an error estimate as Tableau(name, A, b, order)"
        )
    if isinstance(method, Tableau):
        method = _runge_kutta(method)
    name = method.name
    if not isinstance(name, str) or not re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", name):
        raise InputError(f"method: expected a name of lower-case letters, digits and single underscores, got {name!r}")
    if name in METHODS:
        raise InputError(f"method: {name} is registered already; choose another name")
    if method.kind != "fixed" or method.order != tableau.order:
        raise InputError(
            f"method: {name}: expected kind 'fixed' and the tableau's order {tableau.order}, "
            f"got {method.kind!r} and {method.order}"
        )
    if not tableau.explicit and len({*tableau.c.tolist()}) < tableau.stages:
        raise InputError(
            f"method: {name}: expected an implicit method whose stages have different times, got {tableau.c.tolist()}"
        )
    METHODS[name] = method
    return method


def registered_methods() -> tuple[Method, ...]:
    """Return the methods of `register_method` that can be sent to another process."""
    out = []
    for method in METHODS.values():
        if method.name not in _BUILT_IN:
            with suppress(Exception):  # pickle raises errors of several kinds
                sent = replace(method, formula_source=method.formula)
                pickle.dumps(sent)
                out.append(sent)
    return tuple(out)


def _runge_kutta(tableau: Tableau) -> Method:
    about = f"Runge-Kutta method of order {tableau.order} in {tableau.stages} stages"
    stages, stability = tableau.stages if tableau.explicit else 0, TableauStability(tableau)
    more: dict[str, Any] = {"solver": "fixed_step:run_fixed", "formula_source": tableau, "compiled": True}
    return Method(tableau.name, "fixed", tableau.order, stages, about, stability=stability, **more)
