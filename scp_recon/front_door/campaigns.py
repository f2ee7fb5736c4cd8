"""Many plans from Python."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from scp_recon.errors import whole_number

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure


class CampaignOutput(NamedTuple):
    """What `run_campaign` returns.

    Attributes:
        table: a row a case, as in results.parquet.
        figures: by name; a map and the shape of sites, else curves.
    """

    table: pandas.DataFrame
    figures: dict[str, Figure]


def run_campaign(
    study: str | Path | Mapping[str, Any],
    folder: str | Path,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    yes: bool = False,
) -> CampaignOutput:
    """Run the cases of a study that have no row in a folder yet; see docs/campaigns.md.

    Needs the extras [campaign] and [report], with a scheduler [cluster].

    Args:
        study: a file, or its tables, with files relative to the current folder.
        folder: for the results.
        workers: processes; 0 runs the cases in this one, where none can be ended.
        scheduler: address of a Dask cluster's, in their place.
        yes: whether more than 100,000 cases are meant.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    from scp_recon.campaign import report, studies
    from scp_recon.campaign.engine.run import run_study
    from scp_recon.campaign.view import outcome

    report.check_extras()
    whole_number("workers", workers, 0, studies.WORKERS_MAX)
    given = studies.study_of(study, yes=yes)
    path = Path(folder)
    run_study(given, path, studies.runner_of(given, workers, scheduler))
    results = outcome.read_campaign(path)
    from scp_recon.campaign.view.figures import figures

    return CampaignOutput(results.table, figures(results))
