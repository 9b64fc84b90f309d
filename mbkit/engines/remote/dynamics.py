"""An engine of another version behind the protocol: each evaluation is a call of its process.

What an engine in an environment of its own reads from a file by its own importer, described as it is.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

import numpy as np

from mbkit import spatial
from mbkit._attributes import forwarded
from mbkit._check import Array
from mbkit._process import LOOK_SECONDS
from mbkit.engines import known_defects
from mbkit.engines.base import MappedDynamics, applied
from mbkit.engines.elements.passive import JointPassive, pull
from mbkit.engines.frames_and_momenta import ALIGNED, seen_from
from mbkit.engines.imported import Imported, Parts, checked, written
from mbkit.engines.remote.description import REMOTE_RUNS, REMOTE_RUNS_OF_JOINTS, places, travelling
from mbkit.engines.remote.packages import PACKAGES, EngineVersion
from mbkit.engines.remote.process import Answer, Held, RemoteError
from mbkit.errors import NumericalError, UnsupportedError
from mbkit.model import Coupler, Frame, Model
from mbkit.model.quantities import QUANTITIES

#: Quantities that not every engine gives by itself.
_REFUSED: Final = {
    "coriolis_matrix": "this engine forms C v + g without the matrix; nle(q, v) - gravity(q) is C v",
    "function": "it has no symbolic form; mbkit.dynamics(model, 'lagrangian') has",
}


#: A run by the engine's own integrator is left for signals and progress; after so many steps first.
_FIRST_STEPS: Final = 16


def _each(function: Callable[..., Any], *states: Array) -> Any:
    """Return a function of single states at one state or a stack of them."""
    return np.array([function(*row) for row in zip(*states, strict=True)]) if states[0].ndim > 1 else function(*states)


class VersionDynamics(MappedDynamics):
    """An engine of another version on a description.

    Each quantity is that of the engine's own function in that version, in the description's coordinates.

    Attributes
    ----------
    version : EngineVersion

    Notes
    -----
    A call takes some 0.1 ms more than the engine: the state goes to another process and the value comes back. Springs,
    dampers and couplings are mbkit's own, from the engine's poses and Jacobians, where the engine's algorithms know
    none (Pinocchio) and where they are not sent (Drake); MuJoCo's are its own. Energies are those of the engine's mass
    matrix and centre of mass where it has no function for them. A stack of states is one call.
    """

    def __init__(self, model: Model, version: EngineVersion, held: Held | None = None) -> None:
        self.version, self._path = version, version.package.path
        super().__init__(model)
        self._convention = version.package.convention
        #: The engine's joints of each joint.
        names: Mapping[str, Sequence[str]] = {j.name: (j.name,) for j in self.model.joints}
        if held is None:
            data, names = travelling(version.package.steps, self.model)
            held = Held(version, lambda ask: ask("build", **data)[0], f"refuses {self.model.name}: ")
        self._held, self._gives = held, frozenset(held.head["gives"])
        self._places = places(self._convention, self.model, names, held.head["places"])
        self._v_index = self._places.v_index
        layout, gives = self.model.layout, self._gives
        orders = (np.arange(n) for n in layout.sizes[2:])
        self._springs = JointPassive(self.model, *orders)
        #: Passive forces that the engine does not know of.
        self._beside = None if "passive" in gives else self._springs
        rotors = None if self._beside is None else self._beside.rotors
        self._rotors = None if rotors is None else layout.G.T @ rotors @ layout.G
        self._ends = {
            s: tuple(Frame(s.name, b, np.eye(3), p) for b, p in ((s.body_a, s.point_a), (s.body_b, s.point_b)))
            for s in self.model.springs
        }
        #: Whether the engine has an integrator of its own.
        self.runs = "rollout" in gives
        lacks = {x: why for x, why in _REFUSED.items() if x not in gives}
        for needed, quantities in (("frame", ("pose", "jacobian")), ("matter", ("potential_energy",))):
            if needed not in gives and quantities[0] not in gives:
                lacks |= dict.fromkeys(quantities, f"its file here has no function {needed}")
        vars(self)["_refuses"] = lacks

    engine = forwarded("version.name", "Name of the engine with its version.")
    _significand_bits = forwarded(
        "version.package.bits", "Significand bits of its arithmetic: 53, or 24 in single precision."
    )
    _inertias_about = forwarded(
        "version.package.inertias_about", "The point about which it writes composite inertias, by quantity."
    )

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.model, self.version)

    def at(self, /, **values: Any) -> VersionDynamics:
        return type(self)(self.model.with_nominal(values), self.version)

    def _of_model(self, model: Model, form: str) -> VersionDynamics:  # noqa: ARG002  # nothing is derived
        return type(self)(model, self.version)

    def _value(self, method: Callable[..., Any], states: list[Array], more: tuple[Any, ...], size: int | None) -> Any:
        # The methods below take stacks of states: one call of the process for all of them.
        name = getattr(method, "__name__", "")
        together = size and name in vars(VersionDynamics) and name[1:] in QUANTITIES
        return method(*states, *more) if together else super()._value(method, states, more, size)

    def _ask(self, name: str, *arrays: Array, **plain: Any) -> list[Array]:
        if name not in self._gives:
            raise UnsupportedError(f"{self.engine} cannot give {name}: its file here has no such function")
        try:
            return self._held.ask(name, *arrays, **plain)
        except RemoteError as error:
            raise NumericalError(f"{self.engine}: {name} of {self.model.name}: {error}") from None

    def _native(self, q: Array, v: Array | None = None) -> tuple[Array, Array, Array]:
        """Return the engine's q and v, and b of a_engine = T a + b; of one state or a stack of them."""
        layout, convention = self.model.layout, self._convention
        full_q, index = layout.expand_q(q), self._places.v_index
        x, b = full_q[..., self._places.q_index], np.zeros((*np.shape(q)[:-1], len(index)))
        own = b if v is None else layout.expand_v(v)[..., index]
        self._turned = []
        for joint, at_q, at_v in self._places.turning:
            quaternion = full_q[..., layout.full_q[joint.name]][..., -4:]
            R = spatial.matrix_from_quaternion(quaternion)
            first = at_v[0]
            self._turned += [(R, slice(first + k, first + k + 3)) for k in convention.turned[joint.kind]]
            if len(at_q) < 4:
                angles = [spatial.rpy_from_matrix(one) for one in R.reshape(-1, 3, 3)]
                x[..., at_q] = np.reshape(angles, (*R.shape[:-2], 3))
            if joint.type.nv > 3:
                linear = slice(first + convention.linear, first + convention.linear + 3)
                angular = slice(first + 3 - convention.linear, first + 6 - convention.linear)
                b[..., linear] = applied(R, np.cross(own[..., angular], own[..., linear]))
        return x, b if v is None else self._to_engine(v), b

    def _method(self, quantity: str) -> Callable[..., Any]:
        if quantity.startswith(("coriolis", "kinetic")) and (defect := self._defects.get(quantity[:8])):
            known_defects.announce(defect, f"joints of {self.model.name}")
        return super()._method(quantity)

    @cached_property
    def _defects(self) -> dict[str, str]:
        """The engine's known defects that a random state of this model shows, by the begin of a quantity."""
        known = self.version.package.defects
        if not known or not self.model.nv:
            return {}
        q, v = self.model.random_state(1)
        M, h = self._mass_matrix(q), self._nle(q, v) - self._gravity(q)
        size = float(np.abs(v) @ np.abs(M) @ np.abs(v))
        off = {
            "kinetic_": abs(self._kinetic_energy(q, v) - 0.5 * v @ M @ v) > 1e-11 * size,
            "coriolis": np.abs(self._coriolis_force(q, v) - h).max() > 1e-9 * (np.abs(h).max() + size),
        }
        return {name: defect for name, defect in known.items() if off[name]}

    # The protocol.

    def _mass_matrix(self, q: Array) -> Array:
        x, _, _ = self._native(q)
        own = self._columns(self._columns(self._ask("mass_matrix", x)[0]).mT)
        return own if self._rotors is None else own + self._rotors

    def _coriolis_matrix(self, q: Array, v: Array) -> Array:
        x, u, _ = self._native(q, v)
        return self._columns(self._columns(self._ask("coriolis_matrix", x, u)[0]).mT).mT

    def _with_rotation(self, name: str, q: Array, v: Array) -> Array:
        """Return a force of velocities, and M b of the change of velocities."""
        x, u, b = self._native(q, v)
        out = self._ask(name, x, u)[0]
        return self._force(out + applied(self._ask("mass_matrix", x)[0], b) if b.any() else out)

    def _coriolis_force(self, q: Array, v: Array) -> Array:
        if "coriolis_force" not in self._gives:
            return self._nle(q, v) - self._gravity(q)
        return self._with_rotation("coriolis_force", q, v)

    def _nle(self, q: Array, v: Array) -> Array:
        return self._with_rotation("nle", q, v)

    def _gravity(self, q: Array) -> Array:
        return self._force(self._ask("gravity", self._native(q)[0])[0])

    def _passive(self, q: Array, v: Array) -> Array:
        if self._beside is not None:
            return self._passive_beside(q, v)
        x, u, _ = self._native(q, v)
        return self._force(self._ask("passive", x, u)[0])

    def _passive_beside(self, q: Array, v: Array) -> Array:
        """Return the passive force that the engine does not know of."""
        if self._beside is None:
            return np.zeros(np.shape(v))
        layout = self.model.layout
        own = _each(self._beside.force, layout.expand_q(q), layout.expand_v(v))
        out = np.asarray(own @ layout.G)
        for spring, ends in self._ends.items():
            rates = np.diff(self._jacobian(q, ends, ALIGNED)[..., :3, :], axis=-3)[..., 0, :, :]
            pulls = _each(partial(pull, spring), self._gap(q, ends), applied(rates, v))
            out = out - applied(rates.mT, pulls)
        return out

    def _gap(self, q: Array, ends: tuple[Frame, ...]) -> Array:
        X = self._pose(q, ends)
        return np.asarray(X[..., 1, :3, 3] - X[..., 0, :3, 3])

    def _inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array:
        if "inverse_dynamics" not in self._gives:
            return applied(self._mass_matrix(q), a) + self._nle(q, v) - self._passive(q, v)
        x, u, b = self._native(q, v)
        out = self._force(self._ask("inverse_dynamics", x, u, self._to_engine(a) + b)[0])
        rotors = 0.0 if self._rotors is None else a @ self._rotors
        return np.asarray(out + rotors - self._passive_beside(q, v))

    def _forward_dynamics(self, q: Array, v: Array, tau: Array) -> Array:
        if self.model.layout.reduced or self._rotors is not None or "forward_dynamics" not in self._gives:
            rest = self._inverse_dynamics(q, v, np.zeros_like(v))
            return np.asarray(np.linalg.solve(self._mass_matrix(q), (tau - rest)[..., None])[..., 0])
        tau, (x, u, b) = tau + self._passive_beside(q, v), self._native(q, v)
        return self._force(self._ask("forward_dynamics", x, u, self._to_engine(tau))[0] - b)

    def _kinetic_energy(self, q: Array, v: Array) -> Any:
        if "kinetic_energy" not in self._gives:
            return 0.5 * np.einsum("...i,...ij,...j", v, self._mass_matrix(q), v)
        own = self._ask("kinetic_energy", *self._native(q, v)[:2])[0]
        return own if self._rotors is None else own + 0.5 * np.einsum("...i,ij,...j", v, self._rotors, v)

    def _potential_energy(self, q: Array) -> Any:
        if has := "potential_energy" in self._gives:
            own = self._ask("potential_energy", self._native(q)[0])[0]
        else:
            mass, center = self._ask("matter", self._native(q)[0])
            own = -mass * (center @ self.model.gravity)
        if has and self._beside is None:
            return own
        lengths = ((s, np.linalg.norm(self._gap(q, ends), axis=-1)) for s, ends in self._ends.items())
        between = sum(0.5 * s.stiffness * (length - s.rest_length) ** 2 for s, length in lengths)
        return own + _each(self._springs.energy, self.model.layout.expand_q(q)) + between

    def _pose(self, q: Array, frames: tuple[Frame, ...]) -> Array:
        out = np.broadcast_to(np.eye(4), (*np.shape(q)[:-1], len(frames), 4, 4)).copy()
        for k, (R, p, _, _) in enumerate(self._placed_frames(q, frames)):
            out[..., k, :3, :3], out[..., k, :3, 3] = R, p
        return out

    def _jacobian(self, q: Array, frames: tuple[Frame, ...], axes: str) -> Array:
        seen = (seen_from(*placed, axes) for placed in self._placed_frames(q, frames))
        return np.stack([self._columns(J) for J in seen], axis=-3)

    def _placed_frames(self, q: Array, frames: tuple[Frame, ...]) -> Iterator[tuple[Array, Array, Array, Array]]:
        """Yield R_WF, p_WF and the Jacobians of the origin and of turning in the engine's velocities."""
        x = self._native(q)[0]
        for frame in frames:
            R, p, linear, angular = self._ask("frame", x, body=frame.body)
            arm = R @ frame.translation
            yield R @ frame.rotation, p + arm, linear - spatial.skew(arm) @ angular, angular

    # Beside the protocol.

    def rollout(self, q0: Array, v0: Array, dt: float, steps: int, method: str = "rk4") -> tuple[Array, Array]:
        """Return the states of a run by the engine's own integrator, (steps + 1, nq) and (steps + 1, nv).

        Raises `UnsupportedError` for an engine without one, and for what its own run would leave out, such as forces
        by functions, and springs that only mbkit knows of; `NumericalError` for a run that is not finite.
        """
        q, v = self.own_run(self.model.check_q(q0), self.model.check_v(v0), dt, steps, method)
        if not (np.isfinite(q).all() and np.isfinite(v).all()):
            raise NumericalError(f"{self.engine}: its own run of {self.model.name} is not finite")
        return q, v

    def own_run(
        self,
        q0: Array,
        v0: Array,
        dt: float,
        steps: int,
        method: str,
        tau: Array | None = None,
        progress: Callable[[float], object] = lambda _: None,
    ) -> tuple[Array, Array]:
        """Return the same of one checked state or a stack of them; what is not finite is as the engine has it.

        `tau` is held over each step, (steps, nv) or (N, steps, nv). `progress` gets the fraction done, and may end the
        run by an exception.
        """
        model = self.model
        path = REMOTE_RUNS if self._beside is None else REMOTE_RUNS_OF_JOINTS
        path.admit(model, f"{self.engine}: its own runs do not hold all of")
        if not self.runs:
            raise UnsupportedError(f"{self.engine}: it has no rollout of its own here")
        x, u, _ = self._native(q0, v0)
        forces = None if tau is None else self._torques(tau, (*np.shape(q0)[:-1], steps, model.nv))
        parts, done, count = [(x[..., None, :], u[..., None, :])], 0, _FIRST_STEPS
        while done < steps:
            end, begun = min(done + count, steps), time.perf_counter()
            held = () if forces is None else (forces[..., done:end, :],)
            try:
                xs, us = self._ask("rollout", x, u, *held, method=method, dt=dt, steps=end - done)
            except NumericalError as error:
                raise UnsupportedError(str(error)) from None
            parts.append((xs[..., 1:, :], us[..., 1:, :]))
            # The first call may have compiled the step.
            count = max(_FIRST_STEPS, int(count * min(16.0, LOOK_SECONDS / (time.perf_counter() - begun))))
            x, u, done = xs[..., -1, :], us[..., -1, :], end
            progress(done / steps)
        xs, us = (np.concatenate(one, axis=-2) for one in zip(*parts, strict=True))
        q = np.empty_like(xs)
        q[..., self._places.q_index] = xs
        for start, _ in model.quaternions:
            # They have unit length to the engine's precision alone.
            q[..., start : start + 4] /= np.linalg.norm(q[..., start : start + 4], axis=-1, keepdims=True)
        self._native(q)
        return q, self._force(us)

    def _torques(self, tau: Array, shape: tuple[int, ...]) -> Array:
        """Return torques in the engine's coordinates, which it holds in its own axes."""
        out = np.broadcast_to(tau, shape)[..., self._v_index]
        if any(out[..., part].any() for _, part in self._turned):
            raise UnsupportedError(
                f"{self.engine}: its own runs hold a force on a free or ball joint in the world's axes, mbkit in the "
                "body's; use rk4, which any engine has"
            )
        return out


#: The file in `remote` of engines that take MuJoCo's model.
_MUJOCO: Final = "mujoco_importer"


def importers() -> tuple[str, ...]:
    """Return the engines whose importers are judged in an environment of their own."""
    return tuple(name for name, package in PACKAGES.items() if package.importer)


def read(version: EngineVersion, text: str, format_: str, floating_base: bool, files: Mapping[str, bytes]) -> Imported:
    """Return an importer's reading of a text; an MJCF says by itself that its base floats.

    Raises `UnsupportedError` where it refuses the text, and `EngineProcessError` where it ends its process or takes
    longer than `version.seconds`.
    """
    file = _File(text, format_, floating_base, files)
    if version.package.importer == _MUJOCO:
        return _OfMujoco(version, file, changes={}).imported()
    return _Read(version, file).imported()


class _File(NamedTuple):
    text: str
    format: str
    floating_base: bool
    files: Mapping[str, bytes]

    def read(self, module: str, more: Mapping[str, Any], ask: Callable[..., Answer]) -> dict[str, Any]:
        """Return what a module of the process says of it."""
        with written(self.text, self.files) as path:
            file = {"path": str(path), "format_": self.format, "floating": self.floating_base}
            return ask("import", module=module, **file, **more)[0]


class _Read(VersionDynamics):
    """An engine on its own reading of a file."""

    def __init__(self, version: EngineVersion, file: _File, **more: Any) -> None:
        self._file, self._more = file, more
        held = Held(version, partial(file.read, version.package.importer, more))
        self.said = held.head
        super().__init__(checked(version.name, self._described(version.engine)), version, held)

    def _described(self, engine: str) -> Model:
        return _model(engine, self.said)

    def imported(self) -> Imported:
        """Return the reading."""
        said = self.said
        notes = [*said["notes"]]
        if said["loops"]:
            notes.append(f"joints that close a loop, in none of the terms: {', '.join(said['loops'])}")
        held = tuple(Coupler(*x) for x in said["mimics"])
        return Imported(self.model, self.terms, tuple(notes), (), held, holds_mimics=said["holds"] * bool(held))

    def terms(self, q: Array, v: Array, without: tuple[str, ...] = ()) -> dict[str, Array]:
        """Return M, g, nle and passive at a batch of states, without some of what acts beside bodies and joints."""
        if without:
            return self._less(without).terms(q, v)
        out = {"M": self._mass_matrix(q), "g": self._gravity(q), "nle": self._nle(q, v), "passive": self._passive(q, v)}
        return {name: np.asarray(x, float) for name, x in out.items()}

    def _less(self, without: tuple[str, ...]) -> _Read:
        raise NotImplementedError


class _OfMujoco(_Read):
    """The same of MuJoCo's model as `put_model` holds it; `changes` are numbers to set in the model before."""

    def _described(self, engine: str) -> Model:
        # The import loads MuJoCo.
        from mbkit.engines.mujoco import importer

        self._held_model = _HeldModel(self.said)
        self._reading = importer.Described(engine, self._held_model)
        return self._reading.model

    def imported(self) -> Imported:
        return self._reading.imported(self.terms, self.said["notes"])

    def _less(self, without: tuple[str, ...]) -> _Read:
        m = copy.deepcopy(self._held_model)
        for key in without:
            self._reading.removals[key](m)
        before = vars(self._held_model)
        changes = {k: x.tolist() for k, x in vars(m).items() if isinstance(x, np.ndarray) and (x != before[k]).any()}
        was = vars(self._held_model.opt)
        changes |= {k: x for k, x in vars(m.opt).items() if np.any(np.asarray(x) != was[k])}
        return type(self)(self.version, self._file, changes={**self._more["changes"], **changes})


class _HeldModel:
    """The numbers and names of a compiled model, as `mujoco.MjModel` has them."""

    def __init__(self, said: Mapping[str, Any]) -> None:
        vars(self).update({name: np.array(x) if isinstance(x, list) else x for name, x in said["fields"].items()})
        self.opt = SimpleNamespace(**{k: np.array(x) if isinstance(x, list) else x for k, x in said["opt"].items()})
        for kind, names in said["labels"].items():
            setattr(self, kind, [SimpleNamespace(name=x) for x in names].__getitem__)


def _model(name: str, said: Mapping[str, Any]) -> Model:
    """Return the description that an importer's file in `remote` sent as plain data."""
    parts = Parts()
    for body, mass, com, inertia in said["bodies"]:
        parts.body(body, mass, np.array(com), np.array(inertia))
    for (joint, kind, parent, child, R, p), numbers in said["joints"]:
        values = {name: np.array(x) for name, x in numbers.items()}
        if kind == "revolute" and np.isinf(values["lower"]).all() and np.isinf(values["upper"]).all():
            kind = "continuous"
        parts.joint(joint, kind, parent, child, np.array(R), np.array(p), **values)
    return parts.model(name, np.array(said["gravity"]))
