"""The cart-pole."""

from __future__ import annotations

from mbkit.catalog._parameters import SWING, down, positive
from mbkit.model import Model, ModelBuilder, Number

__all__ = ["cart_pole"]


def cart_pole(
    *, cart_mass: Number = 1.0, pole_mass: Number = 1.0, length: Number = 1.0, gravity: Number = 9.81
) -> Model:
    """Return a cart on a horizontal rail that carries a pole with a point mass at its end.

    Two coordinates: ``x``, the cart's position along +x, and ``theta``, the pole's
    angle from the downward vertical, growing towards +x. At zero the cart is at
    the origin and the mass at (0, 0, -length).

    Parameters
    ----------
    cart_mass, pole_mass : float or Parameter
        kg.
    length : float or Parameter
        m.
    gravity : float or Parameter
        m/s², along -z.

    Raises
    ------
    InputError
        A parameter that is not finite or has the wrong sign.

    References
    ----------
    Tedrake, Underactuated Robotics, ch. 3.2.1, whose coordinates these are. The
    IFToMM proposal "light cart-pole" is cart_mass=1e-6 from θ = π/2 at rest.
    """
    cart_mass, pole_mass = positive("cart_mass", cart_mass), positive("pole_mass", pole_mass)
    length = positive("length", length)
    b = ModelBuilder("cart_pole", gravity=down(gravity))
    b.add_body("cart", mass=cart_mass)
    b.add_body("pole", mass=pole_mass, com=(0.0, 0.0, -length))
    b.add_joint("x", "prismatic", parent="world", child="cart", axis=(1.0, 0.0, 0.0))
    b.add_joint("theta", "continuous", parent="cart", child="pole", axis=SWING)
    b.add_frame("tip", body="pole", translation=(0.0, 0.0, -length))
    return b.build()
