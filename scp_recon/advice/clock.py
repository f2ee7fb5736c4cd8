"""Limit the processor time of trials: planning and flights end where the time is used up."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from time import process_time
from typing import TypeVar

from scp_recon.api.planning import PlanObserver, Watch
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import Estimate
from scp_recon.planning.plan import Plan
from scp_recon.scp.loop import Record

T = TypeVar("T")


class TimeIsUp(Exception):  # noqa: N818 -- no error
    """The time for a diagnosis is used up."""


@dataclass
class Clock(Watch):
    """Limit of processor time, checked after every iteration and every round of flights.

    Attributes:
        limit_s: of the diagnosis.
        began: processor time at its begin, s.
        tried: names of what was tried without success.
        left_out: names of what the time did not suffice for.
        until_s: processor time at which the present trial has to end.
        show: called with what is tried, and for how long.
    """

    limit_s: float
    began: float = field(default_factory=process_time)
    tried: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    until_s: float = math.inf
    show: Callable[[str], None] | None = None
    _trying: str = ""

    def __call__(self, stage: str, record: Record) -> None:
        """An iteration is done."""
        del stage, record
        self.check()

    def flights(
        self, step: str, plan: Plan, samples: int, flown: int = 0, reached: Estimate | None = None
    ) -> None:
        """Some flights are flown."""
        del step, plan, samples, flown, reached
        self.check()

    def planning(self, mission: Mission) -> AbstractContextManager[PlanObserver | None]:
        """Observe the plan of a command."""
        del mission
        return nullcontext(self)

    def check(self) -> None:
        """Stop once the time is used up.

        Raises:
            TimeIsUp: if it is.
        """
        now = process_time()
        if self.show is not None:
            self.show(
                f"trying {self._trying}: {now - self.began:.0f} of at most {self.limit_s:.0f} s"
            )
        if now > min(self.until_s, self.began + self.limit_s):
            raise TimeIsUp

    @contextmanager
    def part(self, share: float) -> Iterator[None]:
        """Context for a share of the time that the present trial has left."""
        until_s, now = self.until_s, process_time()
        self.until_s = now + share * (min(until_s, self.began + self.limit_s) - now)
        try:
            yield
        finally:
            self.until_s = until_s

    def attempt(self, name: str, work: Callable[[], T | None], share: float = 1.0) -> T | None:
        """What a trial finds; None, and the trial is noted, if it finds nothing or time is up.

        Args:
            name: of the trial.
            work: the trial.
            share: of all time that it may take.
        """
        self.until_s, self._trying = process_time() + share * self.limit_s, name
        try:
            self.check()
            found = work()
        except TimeIsUp:
            self.left_out.append(name)
            return None
        except InputError:  # the scenario does not allow such values
            found = None
        if found is None:
            self.tried.append(name)
        return found
