"""Calls of machine code without the checks of `Dynamics`: quantities, and whole steps of explicit methods.

The code itself finds NaN and infinity in all that it reads and writes. A call says whether it took the arguments; if
not, `Dynamics` repeats it with its checks and messages.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from mbkit._check import Array
from mbkit.codegen.compiled import Call as CallOf
from mbkit.codegen.compiled import Compiled, KernelSequence
from mbkit.codegen.python_call import FLOAT, POSITIVE, Step, python_call
from mbkit.derivation.equations import Equations
from mbkit.derivation.steps.fixed import Part, parts_of, velocity_changes
from mbkit.model import Model
from mbkit.model.manifold import NEAR_UNIT

Call = Callable[..., Any]

_FLOAT: Final = np.dtype(np.float64)


class QuantityCall(NamedTuple):
    """Calls for float64 arrays: `single` of one state and `batch` return the result, or None.

    `turned` gives what `single` returns the quantity's shape, which it has already unless entries change places.
    """

    single: Call
    batch: Call
    turned: Callable[[Array], Array]


def quantity_call(model: Model, code: Compiled, trim: Callable[[Array], Array], threads: int | None) -> QuantityCall:
    """Return the calls of a quantity.

    `code` has one result and q as its first argument; `trim` gives (rows, columns) or (N, rows, columns) the
    quantity's shape.
    """
    sizes, starts = code.inputs, tuple(start for start, _ in model.quaternions)
    inputs = {f"argument {i}": n for i, n in enumerate(sizes)}
    raw = np.empty(code.shapes[0])
    shape = trim(raw).shape
    # More axes than before are a view with the entries in another order.
    ordered = len(shape) <= raw.ndim
    results = {"result": shape if ordered else raw.shape}

    def of_a_state() -> Call:
        return python_call([(code, [*inputs], [*results])], inputs, results, starts)

    single = of_a_state() if code.device is None else _at_first_state(of_a_state)

    def batch(*given: Any) -> Any:
        if not _is_batch(given, sizes, starts):
            return None
        results, finite = code.call_checked(*given, threads=threads)
        return trim(results[0]) if finite else None

    return QuantityCall(single, batch, (lambda x: x) if ordered else trim)


def _at_first_state(make: Callable[[], Call]) -> Call:
    """Return a call of one state that is made when one comes: dynamics on a GPU may never see one."""
    made: list[Call] = []

    def call(*given: Any) -> Any:
        if type(given[0]) is not np.ndarray or given[0].ndim != 1:
            return None
        if not made:
            made.append(make())
        return made[0](*given)

    return call


def _is_batch(given: Sequence[Any], sizes: Sequence[int], starts: Sequence[int]) -> bool:
    """Return whether these are float64 arrays (N, size) with unit quaternions from these places of the first on."""
    # A subclass may be masked, and `is` would refuse the dtype of an array that was unpickled.
    if not all(type(x) is np.ndarray and x.dtype == _FLOAT for x in given):
        return False
    shapes = [x.shape for x in given]
    n = shapes[0][0] if shapes and shapes[0] else 0
    if shapes != [(n, size) for size in sizes]:
        return False
    parts = (given[0][:, start : start + 4] for start in starts)
    # A NaN is not below anything.
    return all((np.abs(np.einsum("ni,ni->n", x, x) - 1.0) < NEAR_UNIT).all() for x in parts)


class Plan:
    """An explicit method's step for one model in machine code: its parts in order, and the rows of what they use.

    `code` compiles a part. `thorough`: of a step that the quick projection onto constraints loses;
    `fed`: under a state feedback with a gain of this pattern; `behind`: parts that follow it.
    """

    def __init__(
        self,
        equations: Equations,
        method: str,
        code: Callable[[Part], Compiled],
        *,
        thorough: bool = False,
        fed: str = "",
        behind: Sequence[Part] = (),
    ) -> None:
        step = parts_of(equations, method, lambda x: code(x).operations, thorough=thorough, fed=fed)
        self.parts = (*step, *behind)
        self.codes = tuple(code(part) for part in self.parts)
        self.sizes: dict[str, int] = {}
        for part, own in zip(self.parts, self.codes, strict=True):
            self.sizes.update(zip(part.reads, own.inputs, strict=True))
            self.sizes.update(zip(part.writes, (rows for rows, _ in own.shapes), strict=True))


class CompiledStep:
    """A step from (q, v) to (q, v) by the code of a plan, which carries along the integrators' own velocity.

    `single` and `batch` take q, v, tau, dt as a Python float above zero, and the parameters' values if there are some,
    for one state or many. They return None for arguments that they do not take, and where a number is not finite.
    """

    def __init__(self, model: Model, equations: Equations, plan: Plan, code: Callable[[Part], Compiled]) -> None:
        before, behind = velocity_changes(equations)
        same = {} if before else {"w": "v", "w1": "v1"}
        codes = [*map(code, before), *plan.codes, *map(code, behind)]
        self._steps: list[Step] = [
            (own, [same.get(name, name) for name in part.reads], [same.get(name, name) for name in part.writes])
            for part, own in zip((*before, *plan.parts, *behind), codes, strict=True)
        ]
        nq, nv = model.nq, model.nv
        inputs = {"q": nq, "v": nv, "tau": equations.force.numel(), "dt": POSITIVE, "squares": FLOAT}
        inputs |= {name: x.numel() for name, x in equations.extra_arguments.items()}
        # These are of parts behind the step.
        self._more = [name for part in plan.parts for name in part.reads if name == "bound"]
        inputs |= {name: plan.sizes[name] for name in self._more}
        self._starts = tuple(start for start, _ in model.quaternions)
        #: Call of q, v, tau, dt, 0.0 and the extra arguments.
        self.single: Call = python_call(self._steps, inputs, {"q1": (nq,), "v1": (nv,)}, self._starts)
        self._extra = [*self._more, *equations.extra_arguments]
        self._sizes = [inputs[name] for name in ("q", "v", "tau", *self._extra)]

    def batch(self, q: Any, v: Any, tau: Any, dt: float, *behind: Any, threads: int | None) -> Any:
        """Return q and v after the step from a batch, or None."""
        if not _is_batch((q, v, tau, *behind), self._sizes, self._starts):
            return None
        q1, v1, finite = self.run(q, v, tau, dt, *behind, threads=threads)
        return (q1, v1) if finite else None

    def run(
        self, q: Array, v: Array, tau: Array, dt: float, *behind: Array, threads: int | None
    ) -> tuple[Array, Array, bool]:
        """Return q and v after the step from one state or a batch, and whether all numbers on the way are finite."""
        arrays = {"q": q, "v": v, "tau": tau, "dt": np.full((*q.shape[:-1], 1), dt)}
        arrays |= {"squares": np.zeros(arrays["dt"].shape), **dict(zip(self._extra, behind, strict=True))}
        finite = True
        for code, reads, writes in self._steps:
            results, good = code.call_checked(*(arrays[name] for name in reads), threads=threads)
            arrays |= zip(writes, (x[..., 0] for x in results), strict=True)
            finite &= good
        return arrays["q1"], arrays["v1"], finite

    def room(self, n: int) -> tuple[dict[str, Array], KernelSequence]:
        """Return room for n states by name: what steps read, zero, and what they write; and the calls on it."""
        sizes = dict(zip(("q", "v", "tau", *self._extra), self._sizes, strict=True)) | {"dt": 1, "squares": 1}
        for code, _, writes in self._steps:
            sizes |= zip(writes, (rows for rows, _ in code.shapes), strict=True)
        # One number after the other, of all states.
        arrays = {name: np.zeros((rows, n)).T for name, rows in sizes.items()}
        calls = (CallOf(code, [arrays[x] for x in ins], [arrays[x] for x in outs]) for code, ins, outs in self._steps)
        return arrays, KernelSequence([*calls])
