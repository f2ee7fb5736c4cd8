"""A study from what a caller has, and where its cases are run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from scp_recon.campaign.engine.run import limits_of
from scp_recon.campaign.rows.case import Runner
from scp_recon.campaign.runners.here import here
from scp_recon.campaign.runners.processes import Processes
from scp_recon.campaign.study.study import Study, read_study
from scp_recon.errors import InputError, shortened

WORKERS_MAX = 256


def study_of(given: str | Path | Mapping[str, Any], *, yes: bool = False) -> Study:
    """A study from its file or its tables.

    Raises:
        InputError: one message of everything that is wrong.
    """
    if isinstance(given, str | Path):
        return read_study(Path(given), yes=yes)
    if not isinstance(given, Mapping):
        raise InputError("study", shortened(given), "must be a file, or tables as in one")
    return Study.validated(given, yes=yes)


def runner_of(
    study: Study, workers: int, scheduler: str | None, say: Callable[[str], None] = lambda _: None
) -> Runner:
    """What runs a study's cases.

    Args:
        study: for the limits of each case.
        workers: processes; 0 for this one.
        scheduler: address of a Dask cluster's, in their place.
        say: called with what is worth a line.

    Raises:
        InputError: if there is no such scheduler, or the extra [cluster] is missing.
    """
    if scheduler is not None:
        from scp_recon.campaign.runners.cluster import Cluster

        return Cluster(scheduler, limits_of(study), say)
    if workers:
        return Processes(workers, limits_of(study))
    if asked := sorted(study.campaign.model_fields_set & {"limit_s", "memory_mb"}):
        say(f"{' and '.join(asked)}: not kept with --workers 0, where no case can be ended")
    return here
