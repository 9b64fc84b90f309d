"""Every term in every engine, judged against the oracle."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.oracle import OracleDynamics
from mbkit.errors import KnownDefectWarning, MbkitError, NumericalError
from mbkit.model import Model
from mbkit.studies.measure import Errors, Scales
from mbkit.studies.power import power_rows
from mbkit.studies.result import Refusal, Row, tupled
from mbkit.studies.states import States
from mbkit.studies.terms import TERMS, Term
from mbkit.studies.timing import interleaved

__all__ = ["Judge", "announced"]

_EPS: Final = float(np.finfo(float).eps)
# Each of the largest terms went through about this many roundings on the way.
_ROUNDINGS: Final = 4.0
#: Where a warning of a known defect goes on with the joints of this model.
_AS_IT_IS: Final = "; returned as it is"
Progress = Callable[[float, str], None]


class Judge:
    """Evaluates every term in every engine, and judges it against the oracle.

    A term for which the oracle has no value, as where M is singular, is judged
    against the first engine that gives one.
    """

    def __init__(
        self,
        model: Model,
        made: dict[str, Dynamics],
        oracle: OracleDynamics,
        at: States,
        tolerance: float,
        defects: Mapping[str, str] | None = None,
    ) -> None:
        self.model, self.made, self.oracle = model, made, oracle
        #: What engines announced when they were made, of all their terms.
        self.defects = defects or {}
        self.at, self.tolerance = at, tolerance
        self.refusals: list[Refusal] = []
        acting = np.abs(at.tau)
        for quantity in (oracle.nle, oracle.passive):
            # Where a term has no value, its own row says so.
            with contextlib.suppress(NumericalError):
                acting = acting + np.abs(quantity(at.q, at.v))
        gravity = float(np.linalg.norm(model.gravity))
        heavy = gravity * float(np.sqrt(model.mass)) if gravity else 0.0
        self.scales = Scales.of(oracle.mass_matrix(at.q), at.v, acting, heavy)
        #: The joint of each velocity.
        self.joint_of = [j.name for j in model.independent_joints for _ in range(j.type.nv)]

    def rows(self, tell: Progress) -> tuple[list[Row], list[Refusal]]:
        """Return a row per term and engine."""
        rows: list[Row] = []
        for k, term in enumerate(TERMS):
            tell(k / (len(TERMS) + 1), term.name)
            rows += self._term(term)
        tell(len(TERMS) / (len(TERMS) + 1), "power balance")

        def refuse(engine: str, error: MbkitError) -> None:
            self._refuse(engine, "power balance", error)

        for name, errors in power_rows(self.made, self.oracle, self.at, self.scales, refuse):
            rows.append(self._row("power balance", name, errors, (np.nan, np.nan), self.defects.get(name, "")))
        return rows, self.refusals

    def _term(self, term: Term) -> list[Row]:
        values: dict[str, Array] = {}
        defects: dict[str, str] = {}
        broken: dict[str, str] = {}
        for name, dyn in self.made.items():
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                try:
                    values[name] = term.call(dyn, self.at)
                except NumericalError as error:
                    broken[name] = str(error).removeprefix(f"{name}: ")
                except MbkitError as error:
                    self._refuse(name, term.name, error)
            defects[name] = announced(caught) or self.defects.get(name, "")
        if broken and not values:
            # All alike: the model, not an engine. Named, and not counted as agreement.
            self.refusals += [Refusal(name, term.name, why) for name, why in broken.items()]
            return []
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", KnownDefectWarning)
            times = interleaved({name: term.single(self.made[name], self.at) for name in values})
        reference, high, low = self._reference(term, values)
        rows = [self._broken_row(term.name, name, reference, why) for name, why in broken.items()]
        for name, value in values.items():
            errors = term.errors((value - high) - low, high, self.scales)
            allowed = self._allowed(term, name, errors)
            zero = not high.any()
            rows.append(self._row(term.name, name, errors, times[name], defects[name], allowed, reference, zero))
        return rows

    def _reference(self, term: Term, values: dict[str, Array]) -> tuple[str, Array, Array]:
        """Return who has the reference values, and their high and low part."""
        try:
            return self.oracle.engine, *term.reference(self.oracle, self.at)
        except NumericalError as error:
            self._refuse(self.oracle.engine, term.name, error)
        name = next(iter(values))
        return name, values[name], np.zeros_like(values[name])

    def _refuse(self, engine: str, term: str, error: MbkitError) -> None:
        self.refusals.append(Refusal(engine, term, str(error).removeprefix(f"{engine}: ")))

    def _broken_row(self, term: str, engine: str, reference: str, why: str) -> Row:
        """Return the failure of an engine that gives no number where another gives one."""
        return Row(
            term=term,
            engine=engine,
            reference=reference,
            joint="",
            max_abs=float("inf"),
            relative=float("inf"),
            per_joint=float("inf"),
            median=float("inf"),
            samples=len(self.at.q),
            worst_kind="",
            worst_q=(),
            worst_v=(),
            ns=float("nan"),
            ns_spread=float("nan"),
            passed=False,
            reason=why,
            allowed=self.tolerance,
        )

    def _allowed(self, term: Term, engine: str, errors: Errors) -> float:
        """Return the tolerance, or the engine's own bound where its formula cannot do better."""
        # Accelerations are M's solution: they cannot be better than M.
        if term.quantity not in ("mass_matrix", "forward_dynamics") or errors.relative.max() <= self.tolerance:
            return self.tolerance
        amplified = self.made[engine].mass_matrix_rounding(self.at.q[errors.worst])
        return self.tolerance if amplified is None else max(self.tolerance, _ROUNDINGS * _EPS * float(amplified))

    def _row(
        self,
        term: str,
        engine: str,
        errors: Errors,
        ns: tuple[float, float],
        defect: str,
        allowed: float | None = None,
        reference: str | None = None,
        zero: bool = False,
    ) -> Row:
        allowed = self.tolerance if allowed is None else allowed
        worst = errors.worst
        relative = float(errors.relative[worst])
        per = errors.per_velocity
        joint = self.joint_of[int(np.argmax(per))] if per.size and per.max() > 0 else ""
        passed = relative <= allowed
        reason = ""
        if passed and relative > self.tolerance:
            reason = (
                f"{relative:.1e} at {joint} is above {self.tolerance:.0e}, and within the rounding of {engine}'s own "
                f"formula ({allowed:.0e}): its terms are {allowed / (_ROUNDINGS * _EPS):.0e} times the result"
            )
        if not passed:
            bad = [n for n, e in zip(self.joint_of, per, strict=False) if e > self.tolerance] if per.size else []
            named = ", ".join(dict.fromkeys(bad)) or "no single joint"
            reason = f"differs by {relative:.1e} at {named}" if per.size else f"differs by {relative:.1e}"
            if defect:
                reason += f"; {defect}"
        return Row(
            term=term,
            engine=engine,
            reference=reference or self.oracle.engine,
            joint=joint,
            max_abs=float(errors.absolute.max()),
            relative=relative,
            per_joint=float(per.max()) if per.size else 0.0,
            median=float(np.median(errors.relative)),
            samples=len(errors.relative),
            worst_kind=self.at.kinds[worst],
            worst_q=tupled(self.at.q[worst]),
            worst_v=tupled(self.at.v[worst]),
            ns=ns[0],
            ns_spread=ns[1],
            passed=passed,
            reason=reason,
            allowed=allowed,
            defect="" if passed else defect.split(_AS_IT_IS)[0],
            zero=zero,
        )


def announced(caught: Iterable[warnings.WarningMessage]) -> str:
    """Return the known defects among recorded warnings, in words."""
    return "; ".join(dict.fromkeys(str(w.message) for w in caught if issubclass(w.category, KnownDefectWarning)))
