"""Flights of a plan on the runners of campaigns: a case is a block, and blocks are counted in order."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass

from scp_recon.campaign.rows.case import Case, Found, Runner
from scp_recon.campaign.runners.child import Limits
from scp_recon.campaign.runners.cluster import Cluster
from scp_recon.errors import InputError
from scp_recon.monte_carlo.flights import Blocks, FlightBlock, FlightConfig, Job, run_block

FLIGHTS, BLOCK = "flights", "block"
LIMIT_S = 3600.0
"""Wall time of a block, which takes a second or less: what takes longer hangs."""


@dataclass(frozen=True)
class FlyBlock:
    """The work of a block: its number is the case's, its flights are the case's change."""

    config: FlightConfig

    @property
    def columns(self) -> dict[str, type]:
        """None: a block goes into no table."""
        return {}

    def __call__(self, case: Case, /) -> Found:
        """Fly it."""
        return Found({BLOCK: run_block(self.config, (case.number, case.changes[FLIGHTS]))})


def blocks_on_cluster(address: str, say: Callable[[str], None] = lambda _: None) -> Blocks:
    """What flies blocks on a Dask cluster, for `fly_many`.

    Args:
        address: of the scheduler.
        say: called with what is worth a line.
    """
    runner = Cluster(address, Limits(seconds=LIMIT_S), say)
    return lambda config, jobs: in_order(runner, config, jobs)


def in_order(runner: Runner, config: FlightConfig, jobs: Iterator[Job]) -> Generator[FlightBlock]:
    """Blocks by their number, as `fly_many` counts them; those that are early wait.

    Args:
        runner: where they are flown.
        config: what is flown.
        jobs: of each block its number and its flights, the numbers one after the other.

    Raises:
        InputError: if a block could not be flown.
    """
    cases = (Case(number, config.seed, {FLIGHTS: flights}) for number, flights in jobs)
    waiting: dict[int, FlightBlock] = {}
    following: int | None = None

    def noted() -> Iterator[Case]:
        nonlocal following
        for case in cases:
            following = case.number if following is None else following
            yield case

    with closing(runner(FlyBlock(config), noted())) as over:
        for done in over:
            row = done.found.row
            if BLOCK not in row:
                raise InputError(
                    "flights",
                    f"block {done.case.number}, {row['status']}: {row['message']}",
                    "every block must be flown",
                )
            waiting[done.case.number] = row[BLOCK]
            while following in waiting:
                yield waiting.pop(following)
                following += 1
