"""What was expected to be a system on an engine, and is not: told with the way to one."""

from __future__ import annotations

from typing import Any

from mbkit.errors import InputError

__all__ = ["no_dynamics"]


def no_dynamics(given: Any, name: str = "dyn") -> InputError:
    """Return what to raise, with what makes a `Dynamics`: a `Lagrangian` on paper does it by itself.

    Parameters
    ----------
    given : object
    name : str
        The argument's.
    """
    own = not isinstance(given, type) and callable(getattr(given, "dynamics", None))
    way = "its .dynamics() makes one" if own else "mbkit.dynamics(model, engine) makes one"
    return InputError(f"{name}: expected a Dynamics, got {type(given).__name__}; {way}")
