"""What a worker process does: it answers one request after the other, until nobody asks any more."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from dataclasses import replace
from multiprocessing import spawn
from pathlib import Path
from typing import Any, Final

from mbkit._check import Array
from mbkit._serving import opened
from mbkit.engines import Dynamics, dynamics
from mbkit.engines.oracle import OracleDynamics
from mbkit.errors import MbkitError
from mbkit.studies._processes import MEMORY
from mbkit.studies.compare.rollouts import TooLongError
from mbkit.studies.stress import messages as m
from mbkit.studies.stress.case import Case, Problem, Truth, problem_of, times_of
from mbkit.studies.stress.reference import Search, Terms, condition, terms_of
from mbkit.studies.stress.result import Cell

__all__ = ["busy", "serve"]

_AT_WORK: Final[list[bool]] = []


def busy() -> bool:
    """Return whether this process is a worker, in which no study may begin."""
    return bool(_AT_WORK)


def serve(handle: int, memory: int) -> None:
    """Answer requests from a connection.

    Parameters
    ----------
    handle : int
        File descriptor.
    memory : int
        Bytes that the process may take; 0 for no bound.
    """
    channel = opened(handle, memory, follow=True)
    _AT_WORK.append(True)
    server = Server(Path.cwd().parent, lambda doing: channel.send(m.Stage(doing)))
    channel.send(m.Hello())
    while True:
        try:
            request = channel.recv()
        except EOFError:
            # Nothing is left to tidy; destructors of loaded libraries could only fail.
            os._exit(0)
        channel.send(server.answer(request))


class Server:
    """Answers requests, and remembers what the next one will need again.

    Parameters
    ----------
    folder : Path
        Of the study, where truths are kept.
    tell : callable
        Is told what is begun.
    """

    def __init__(self, folder: Path, tell: Callable[[m.Doing], None]) -> None:
        self._folder, self._tell_parent = folder, tell
        self._doing: m.Doing = "case"
        self._cases: dict[str, Case] = {}
        self._searches: dict[str, Search] = {}
        self._at: tuple[str, int] | None = None
        self._held: dict[str, Any] = {}

    def _tell(self, doing: m.Doing) -> None:
        self._doing = doing
        self._tell_parent(doing)

    def answer(self, request: m.Request) -> m.Answer:
        """Return the answer to one request; whatever goes wrong is one, too."""
        self._doing = "case"
        try:
            if isinstance(request, m.Introduce):
                return self._introduce(request)
            if self._at != (request.case, request.index):
                self._at, self._held = (request.case, request.index), {}
            if isinstance(request, m.Prepare):
                return self._prepare(request)
            if isinstance(request, m.Condition):
                return condition(self._oracle(request), self._problem(request).q)
            return self._run(request)
        except MemoryError as error:
            # What was held can be as large.
            self._held = {}
            return m.Failed("died", f"{MEMORY} ({error})" if str(error) else MEMORY, self._doing)
        except TooLongError as error:
            return m.Failed("slow", str(error), self._doing)
        except Exception as error:  # engines and cases raise errors of all kinds
            told = str(error) if isinstance(error, MbkitError) else f"{type(error).__name__}: {error}"
            return m.Failed("refused", " ".join(told.split()), self._doing)

    def _introduce(self, request: m.Introduce) -> m.Failed | None:
        if request.pickled is None:
            from mbkit.studies.stress.cases import get

            self._cases[request.case] = get(request.name)
            return None
        try:
            if request.main is not None:
                spawn.prepare(request.main)
            self._cases[request.case] = pickle.loads(request.pickled)
        except Exception as error:  # a user's module may raise anything
            return m.Failed("refused", f"{type(error).__name__}: {error}", "case", misuse=True)
        return None

    def _problem(self, request: m.Prepare | m.Condition | m.Run) -> Problem:
        made: Problem = self._once("problem", lambda: problem_of(self._cases[request.case], request.value))
        return made

    def _oracle(self, request: m.Prepare | m.Condition | m.Run) -> OracleDynamics:
        made: OracleDynamics = self._once("oracle", lambda: OracleDynamics(self._problem(request).model))
        return made

    def _once(self, name: str, make: Callable[[], Any]) -> Any:
        if name not in self._held:
            self._held[name] = make()
        return self._held[name]

    def _prepare(self, request: m.Prepare) -> m.Prepared:
        case, problem = self._cases[request.case], self._problem(request)
        facts = {name: float(x) for name, x in problem.facts.items()}
        self._tell("truth")
        truth: Truth | Terms | None
        if case.measure == "terms":
            truth, told = terms_of(problem, self._oracle(request)), "the own derivation with 34 digits"
        elif case.measure == "energy":
            truth, told = None, "the energy at the start, with 34 digits"
        else:
            search = self._searches.setdefault(request.case, Search())
            wanted = 0.1 * request.bar * problem.scale
            truth, told = search.truth(problem, times_of(problem, case.measure), wanted, request.seconds)
        path = self._path(request)
        temporary = path.with_suffix(".new")
        temporary.write_bytes(pickle.dumps(truth))
        os.replace(temporary, path)
        return m.Prepared(told, facts, None if case.measure == "terms" else problem.dt)

    def _path(self, request: m.Prepare | m.Run) -> Path:
        return self._folder / f"{request.case}-{request.index}.truth"

    def _truth(self, request: m.Run) -> Any:
        path = self._path(request)
        # None where the process that searched for it came to an end.
        return self._once("truth", lambda: pickle.loads(path.read_bytes()) if path.exists() else None)

    def _run(self, request: m.Run) -> Cell:
        from mbkit.studies.stress.measure import heard_warnings

        case, problem = self._cases[request.case], self._problem(request)
        truth = self._truth(request)
        self._tell("engine")

        def made() -> tuple[Dynamics, list[str]]:
            with heard_warnings() as heard:
                return dynamics(problem.model, request.engine), heard

        dyn, told = self._once(request.engine, made)
        cell = self._measured(request, case, problem, truth, dyn)
        # What an engine says when it is made holds for all that it does.
        return replace(cell, warnings=(*told, *cell.warnings)) if told and cell.end == "finished" else cell

    def _measured(self, request: m.Run, case: Case, problem: Problem, truth: Any, dyn: Dynamics) -> Cell:
        from mbkit.studies.stress.measure import evaluated, integrated

        if case.measure == "terms":
            if truth is None:
                return Cell(request.value, "not run", note="not run: no truth")
            return evaluated(request, dyn, truth, self._tell)
        times: Array = times_of(problem, case.measure)
        # What is judged by its energy alone deserves more digits than the run has.
        energies = self._oracle(request) if truth is None else None
        return integrated(request, problem, dyn, times, truth, energies, case.measure, self._tell)
