"""Find the lighting windows of a span and the legal burn times of each, as a table and a chart."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from scp_recon.api.inputs import date_in_tdb, scenario_of
from scp_recon.bodies.catalogue import DAY_S
from scp_recon.errors import InputError, needing, number_between, option
from scp_recon.files import PICTURE, check_ending, check_own, write_atomically, writing
from scp_recon.mission.schedule import Survey, survey
from scp_recon.results.table import Table
from scp_recon.scenario.load import naming_files
from scp_recon.scenario.schema import Scenario

DAYS_MAX = 100.0
"""At most; the span may begin as far from the epoch. The planets, which two-body motion
leaves out, turn Bennu's direction of the Sun by 0.001 deg in 100 days, and by 0.02 deg in 400."""
MARK = b"opens_tdb,closes_tdb,"
"""At the head of every table of windows."""


def find_windows(
    scenario: Scenario | str | Path,
    begin: datetime | str | None = None,
    span_days: float = 2.0,
    csv: str | Path | None = None,
    chart: str | Path | None = None,
) -> Survey:
    """See `api.verbs.windows`."""
    number_between(option("span_days"), span_days, 0.01, DAYS_MAX)
    given = scenario_of(scenario)
    epoch = given.epoch.tdb
    first = ((date_in_tdb(option("begin"), begin) or epoch) - epoch).total_seconds()
    if abs(first) > DAYS_MAX * DAY_S:
        allowed = (
            f"must be within {DAYS_MAX:g} days of the scenario's epoch, {epoch.isoformat()}: its orbit "
            "is two-body motion from there"
        )
        raise InputError(option("begin"), str(begin), allowed)
    if csv is not None:
        check_ending(Path(csv), option("csv"), ".csv")
        check_own(Path(csv), option("csv"), MARK)
    if chart is not None:
        with needing(option("chart"), "report"):
            from scp_recon.reports.command_charts import draw_windows
            from scp_recon.results.pictures import endings
        check_ending(Path(chart), option("chart"), *endings())
        check_own(Path(chart), option("chart"), PICTURE)
    with naming_files(scenario):
        found = survey(given, (first, first + span_days * DAY_S))
    if csv is not None:
        with writing(Path(csv).parent, option("csv")):
            write_atomically(Path(csv), survey_table(found).csv())
    if chart is not None:
        with writing(Path(chart).parent, option("chart")):
            write_atomically(Path(chart), draw_windows(given, found, Path(chart).suffix))
    return found


def tdb(scenario: Scenario, time_s: float) -> str:
    """Date and time of seconds past the scenario's epoch, TDB, to the second."""
    date = scenario.epoch.tdb + timedelta(seconds=time_s + 0.5)
    return date.replace(microsecond=0).isoformat()


def survey_table(survey: Survey) -> Table:
    """One row for each window; times in s past the scenario's epoch, and edges as TDB dates too.

    An empty interval has its first number above its second.
    """
    burns = range(1, len(survey.scenario.burns.times_s) + 1)
    names = (
        *("opens_tdb", "closes_tdb", "opens_s", "closes_s", "least_incidence_deg"),
        *("local_solar_time_opens_h", "local_solar_time_closes_h"),
        *(f"burn_{i}_{end}_s" for i in burns for end in ("earliest", "latest")),
    )
    rows = (
        [
            *(tdb(survey.scenario, edge) for edge in w.edges_s),
            *w.edges_s,
            float(np.rad2deg(w.least_incidence_rad)),
            *w.local_solar_time_h,
            *(edge for interval in w.burns_s for edge in interval),
        ]
        for w in survey.windows
    )
    return Table.of("Windows", names, rows)
