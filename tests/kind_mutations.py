"""Three mutations of each path, which its checks have to catch.

*Dropped*: a gate that no longer takes a kind refuses it by name where the path is gone through, so the path asks its
gate. *Admitted*: a gate lets a kind pass that it refuses, and the path is then wrong or ends with an error, so that the
refusal is needed. *Removed*: the path sees a model without the part, and its truth has it, so that its check sees the
part. `tests.test_mutations` runs some, and ``python -m validation.matrix`` all of them.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from unittest.mock import patch

from mbkit.errors import UnsupportedError
from mbkit.model.elements.kinds import EFFECTS, PART_KINDS, Kind, kind
from mbkit.model.elements.paths import PATHS as GATES
from mbkit.model.elements.paths import Path as Gate
from tests import kind_paths
from tests.kind_examples import EXAMPLES, TYPES, Example
from tests.kind_examples import example as known
from tests.kind_paths import COLUMNS, told
from tests.plain_mechanics import LOOPS

ENGINES = ("lagrangian", "pinocchio", "mujoco", "drake", "oracle")
#: Effects, or kinds, that a column's quantity depends on; all but limits, which are data, where it is not named.
EVERY = frozenset(EFFECTS) - {"bound"}
SEES: dict[str, frozenset[str]] = {
    **{f"{e}: M and inverse dynamics": EVERY - {"row", "speed", "stop"} for e in ENGINES},
    # Its algorithms have no accelerations.
    "URDF in Pinocchio alone": EVERY - {"stop"},
    **{f"{e}: energies": frozenset("TV") for e in ENGINES},
    **{f"{e}: frames": frozenset() for e in ENGINES},
    **dict.fromkeys(("regressor", "base parameters"), frozenset({"gravity"})),
    **dict.fromkeys(("impact", "operational space"), frozenset({"T", "row", "speed"})),
    # "without" takes the part out itself.
    **dict.fromkeys(("picture", "lint", "without"), frozenset()),
    # A motion is found without forces.
    "excitation": frozenset(),
    # What its rows push at rest is nothing in examples without weight.
    "equilibrium": frozenset({"V", "force"}),
    "mobility": frozenset({"row", "speed"}),
    # Its motion is given: what acts at joints is in it already.
    "load of the last joint": frozenset({"gravity", "point.spring", "point.damper"}.union(f"loop.{x}" for x in LOOPS)),
    # Joints beyond the first rest, and nothing accelerates.
    "steady motion": frozenset({"V", "force"}),
    # What is linear in motion has none.
    "second derivatives": frozenset({"gravity", "body.rotor", "point.spring", "point.damper", "joint.stiction"})
    | {"force.joint", "force.frame", "force.bushing", "force.compensation", "force.compensation.partial"},
}
#: A force without a potential has no energy.
WITHOUT_ENERGY = ("force.frame",)
#: Gates of runs that no engine here has; `tests.test_trained_engines` goes through them where one is.
ELSEWHERE = ("newton", "remote runs of joints")
#: Refusals that no check finds needed. Whether motions that a coupler leaves still tell the tree's base parameters
#: depends on the axes that it binds; they do in these examples. Terms of a system are the same beside a stop. What
#: rests on a stop has no event; a torque that holds it is one of many; torques that are identified are off stops.
NEEDLESS = {"base parameters": ("coupler", "coupler.several"), "derivation": ("written.stop",)}
NEEDLESS |= dict.fromkeys(("runs without phases", "equilibrium", "identification"), ("joint.stop",))


@dataclass(frozen=True)
class Mutant:
    """What came of a mutation of a kind on a path: "caught" or "survives", and how the path ended."""

    mutation: str
    kind: str
    path: str
    outcome: str
    text: str = ""


def checks() -> dict[str, kind_paths.Any]:
    """Return the checks of gates without a column, which import every path."""
    from tests.test_matrix import CHECKS

    return CHECKS


@cache
def _column_of(gate: str) -> str:
    return next(name for name, c in COLUMNS.items() if gate in c.gates)


def new(name: str) -> Example:
    """Return a new example, whose model has not said yet what acts in it."""
    return (EXAMPLES | TYPES)[name](name)


@contextmanager
def seen(x: Example) -> Iterator[None]:
    """Let columns see an example in the place of its kind's own; their truths are kept."""

    def forget() -> None:
        for kept in (kind_paths.engine, kind_paths.kept, kind_paths.program_of, kind_paths.on_paper):
            kept.cache_clear()

    forget()
    with patch.object(kind_paths, "example", lambda name: x if name == x.name else known(name)):
        yield
    forget()


def ends(path: str, x: Example, folder: Path, *, column: bool) -> tuple[str, str]:
    """Return how a check ends: "right", "refused", or anything else, and its text."""
    if column:
        with seen(x):
            out = told(x.name, path, folder)
        return out.outcome, out.text
    with warnings.catch_warnings(action="ignore"):
        try:
            checks()[path](x)
        except kind_paths.NotAskedError:
            return "not asked", ""
        except UnsupportedError as error:
            return "refused", str(error)
        except Exception as error:
            return "wrong", f"{type(error).__name__}: {error}"
    return "right", ""


def gone_through(gate: str, x: Example, folder: Path) -> tuple[str, str]:
    if gate in checks():
        return ends(gate, x, folder, column=False)
    return ends(_column_of(gate), x, folder, column=True)


def dropped(name: str, gate: str, folder: Path) -> Mutant | None:
    """Take a kind out of a gate's set; None where it is not in it, or the path asks for more than the example has."""
    own, x, takes = GATES[gate], new(name), Gate.takes
    # The names of joint types of beams have their numbers.
    gone = kind(next(k for k in x.model.acts if k.startswith(name)))
    # MuJoCo's friction is not asked for where there is none, runs with friction go by phases, and energies are on paper
    # already.
    dry = x.model.needs.friction
    asked = {"mujoco friction loss": dry, "symplectic runs": "jump" not in x.model.effects, "paper": x.model.has_bodies}
    if not (own.takes(gone) and asked.get(gate, True)) or own.refuses(x.model):
        return None

    def fewer(self: Gate, k: Kind) -> bool:
        return not (self is own and k == gone) and takes(self, k)

    with patch.object(Gate, "takes", fewer):
        outcome, text = gone_through(gate, x, folder)
    if outcome == "not asked":
        return None
    named = outcome == "refused" and gone.words.rpartition("}")[2] in text
    return Mutant("dropped", name, gate, "caught" if named else "survives", f"{outcome} {text}")


def admitted(name: str, gate: str, folder: Path) -> Mutant | None:
    """Let a model pass that a gate refuses; None where it takes the model."""
    own, x, refuses = GATES[gate], new(name), Gate.refuses
    if not own.refuses(x.model):
        return None

    def none(self: Gate, model: kind_paths.Any, words: str = "") -> str:
        return "" if self is own else refuses(self, model, words)

    with patch.object(Gate, "refuses", none):
        outcome, text = gone_through(gate, x, folder)
    if outcome == "not asked":
        return None
    return Mutant("admitted", name, gate, "survives" if outcome == "right" else "caught", f"{outcome} {text}")


def sees(k: Kind, path: str) -> bool:
    """Return whether the quantity of a column depends on a kind."""
    seen = SEES.get(path, EVERY)
    if path.endswith("energies") and k.name in WITHOUT_ENERGY:
        return False
    does = k.does - ({"t", "jump"} if "stop" in k.does else {"t"})
    return bool({k.name, *does} & seen) or (k.does == {"t"} and "force" in seen)


def removed(name: str, path: str, folder: Path) -> Mutant | None:
    """Take a part out of the model that a column sees; None where it cannot be taken out, or has no effect there."""
    k, x = PART_KINDS.get(name), new(name)
    if k is None or not (k.features and sees(k, path)):
        return None
    outcome, text = ends(path, replace(x, model=k.removed(x.model)), folder, column=True)
    return Mutant("removed", name, path, "survives" if outcome == "right" else "caught", f"{outcome} {text}")
