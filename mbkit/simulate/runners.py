"""Which integrator runs a method, each imported when it is first needed."""

from __future__ import annotations

from collections.abc import Callable

from mbkit.engines import Dynamics
from mbkit.simulate.asked import Asked
from mbkit.simulate.methods import Method
from mbkit.simulate.outcome import Outcome
from mbkit.simulate.torque import Torque

__all__ = ["adaptive_runner", "fixed_runner"]


def fixed_runner(method: Method, dyn: Dynamics, torque: Torque) -> Callable[..., Outcome]:
    """Return run(dyn, method, q0, v0, grid, kept, torque, bar)."""
    if method.name == "implicit_midpoint":
        from mbkit.simulate.midpoint import run_midpoint

        return run_midpoint
    if method.name in ("rk4", "semi_implicit_euler") and not torque.callable and _compiles(dyn):
        from mbkit.simulate.rollout import run_rollout

        return run_rollout
    from mbkit.simulate.fixed import run_fixed

    return run_fixed


def adaptive_runner(method: Method) -> Callable[[Asked], Outcome]:
    """Return what integrates with tolerances."""
    if method.name == "auto":
        from mbkit.simulate.auto import run_auto

        return run_auto
    if method.name in ("rk853", "rodas5"):
        from mbkit.simulate.embedded import run_embedded

        return run_embedded
    if method.name == "taylor":
        from mbkit.simulate.taylor import run_taylor

        return run_taylor
    if method.name == "cvodes":
        from mbkit.simulate.cvodes import run_cvodes

        return run_cvodes
    if method.name.startswith("drake_"):
        from mbkit.simulate.drakes import run_drake

        return run_drake
    from mbkit.simulate.adaptive import run_scipy

    return run_scipy


def _compiles(dyn: Dynamics) -> bool:
    """Return whether whole steps can be compiled: own derivation, written out, and a compiler."""
    if dyn.engine != "lagrangian":
        return False
    # Other engines need no CasADi.
    from mbkit.derivation.machine import Machine
    from mbkit.engines.lagrangian import LagrangianDynamics

    # A compiled step has one value of each parameter, the time among them.
    if not isinstance(dyn, LagrangianDynamics) or not dyn.model.nv or not dyn.written_out or dyn.model.clock:
        return False
    # Nor does it look for constraints after each step.
    if dyn.model.constrained:
        return False
    return not isinstance(dyn.code("forward_dynamics"), Machine)
