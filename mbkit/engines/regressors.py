"""Public methods for regressors: quantities as linear functions of inertial parameters, friction and armature."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array
from mbkit.engines.evaluation import Evaluation
from mbkit.model.base_parameters import PARAMETER_SETS, RegressorColumns, regressor_columns

_STANDARD: Final = PARAMETER_SETS[0]


def with_joints(Y: Array, columns: RegressorColumns, v: Array, rate: Array) -> Array:
    """Return these columns of the regressor of one state, with those of joints, of what adds to T with this rate."""
    own = columns.of_rates(loss=v, jump=np.sign(v), T=rate)
    return np.hstack([Y[:, list(columns.bodies)], *(np.diag(x)[:, which] for x, which in own)])


class Regressors(Evaluation):
    """The part of `Dynamics` that is linear in the inertial parameters of the bodies.

    The standard parameters π are ``model.base_parameters().standard``: of each body, in the order of the tree, Ixx,
    Ixy, Ixz, Iyy, Iyz, Izz about the origin of its frame, in its axes, then the first moment hx, hy, hz = m c, then m.
    Pinocchio's ``toDynamicParameters`` has the same ten as m, hx, hy, hz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz. The base
    parameters are ``model.base_parameters().values``; their columns are those of the standard parameters that lead
    them.
    """

    def regressor(
        self,
        q: ArrayLike,
        v: ArrayLike,
        a: ArrayLike,
        parameters: str = _STANDARD,
        *,
        friction: bool = False,
        armature: bool = False,
    ) -> Array:
        """Return the matrix Y(q, v, a) of τ = Y π.

        Parameters
        ----------
        q : (nq,) or (N, nq) array_like
            rad, m.
        v, a : (nv,) or (N, nv) array_like
            rad/s, m/s and their rates.
        parameters : {"standard", "base"}
            The ten standard parameters of each body, or the base parameters, of which Y has independent columns. Both
            give the same torque.
        friction : bool
            Whether columns of viscous and of dry friction follow, v and sign(v) of each velocity. That of dry friction
            is zero at v = 0.
        armature : bool
            Whether columns of rotors follow, a of each joint with one velocity.

        Returns
        -------
        (nv, p) or (N, nv, p) array
            ``model.regressor_columns(parameters, ...)`` names the columns. Springs are not in it.

        Raises
        ------
        InputError
            Arguments of wrong shapes or not finite, or another set of parameters.
        UnsupportedError
            An engine without it, or a model without bodies.

        Notes
        -----
        Khalil and Dombre 2002, Modeling, Identification and Control of Robots, ch. 12.3; the columns of base parameters
        are theirs too, ch. 9.4.

        Examples
        --------
        >>> import mbkit as mb
        >>> model = mb.catalog.double_pendulum()
        >>> dyn = mb.dynamics(model, "lagrangian")
        >>> Y = dyn.regressor([0.3, 0.4], [1.0, -1.0], [0.5, 0.2], "base")
        >>> Y.shape
        (2, 6)
        >>> tau = Y @ model.base_parameters().values
        >>> bool(abs(tau - dyn.inverse_dynamics([0.3, 0.4], [1.0, -1.0], [0.5, 0.2])).max() < 1e-14)
        True
        """
        columns = self._columns_of(parameters, friction, armature)
        return self._evaluate("regressor", columns, q=q, v=v, a=a)

    def momentum_regressor(
        self, q: ArrayLike, v: ArrayLike, parameters: str = _STANDARD, *, armature: bool = False
    ) -> Array:
        """Return the matrix Y(q, v) of the generalized momentum p = M v = Y π.

        Parameters and columns are those of `regressor`.

        Returns
        -------
        (nv, p) or (N, nv, p) array

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.double_pendulum(), "lagrangian")
        >>> q, v = [0.1, 0.2], [1.0, -2.0]
        >>> pi = dyn.model.base_parameters().standard
        >>> bool(abs(dyn.momentum_regressor(q, v) @ pi - dyn.mass_matrix(q) @ v).max() < 1e-12)
        True
        """
        columns = self._columns_of(parameters, False, armature)
        return self._evaluate("momentum_regressor", columns, q=q, v=v)

    def energy_regressor(
        self, q: ArrayLike, v: ArrayLike, parameters: str = _STANDARD, *, armature: bool = False
    ) -> Array:
        """Return the matrix Y(q, v) of the kinetic and the potential energy, [T, V] = Y π.

        V is that of gravity, without springs. With base parameters it is V up to a constant, which no motion tells.
        Parameters and columns are those of `regressor`.

        Returns
        -------
        (2, p) or (N, 2, p) array

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.double_pendulum(), "lagrangian")
        >>> q, v = [0.1, 0.2], [1.0, -2.0]
        >>> T, V = dyn.energy_regressor(q, v) @ dyn.model.base_parameters().standard
        >>> bool(abs(T - dyn.kinetic_energy(q, v)) < 1e-12), bool(abs(V - dyn.potential_energy(q)) < 1e-12)
        (True, True)
        """
        columns = self._columns_of(parameters, False, armature)
        return self._evaluate("energy_regressor", columns, q=q, v=v)

    def _columns_of(self, parameters: str, friction: bool, armature: bool) -> RegressorColumns:
        self.model.require_bodies("regressor")
        return regressor_columns(self.model, parameters, friction, armature)
