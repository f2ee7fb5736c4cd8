"""Lighting windows and legal burn times: `python -m scp_recon.windows SCENARIO`."""

from __future__ import annotations

from scp_recon.cli.command import Answer, exit_on_sigint, parse, run_command, show_written

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from scp_recon.cli.documents import survey_document
from scp_recon.cli.options import date_tdb, number_between
from scp_recon.cli.view.window_tables import as_csv, show_survey
from scp_recon.cli.warnings import show_warnings
from scp_recon.errors import InputError, needing
from scp_recon.files import unwritable, write_atomically
from scp_recon.mission.checks.given import Given
from scp_recon.mission.checks.table import check_given
from scp_recon.mission.mission import rotation_of, site_of
from scp_recon.mission.survey import survey
from scp_recon.physics.frames import DAY_S
from scp_recon.scenario.load import load_scenario

SPAN_DAYS, DAYS_MAX = 2.0, 100.0
"""As a rule, and at most; the span may begin as far from the epoch. The planets, which two-body motion
leaves out, turn Bennu's direction of the Sun by 0.001 deg in 100 days, and by 0.02 deg in 400."""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog="python -m scp_recon.windows", description=__doc__)
    p.add_argument("scenario", metavar="SCENARIO", help="TOML file, or recon_b")
    p.add_argument(
        "--from",
        type=date_tdb,
        metavar="TDB",
        dest="begin",
        help="where the span begins, TDB, e.g. 2020-01-21T20:33:17 (default: the scenario's epoch)",
    )
    p.add_argument(
        "--span-days",
        type=number_between(0.01, DAYS_MAX),
        default=SPAN_DAYS,
        metavar="D",
        help=f"how long it is, up to {DAYS_MAX:g} days (default: {SPAN_DAYS:g})",
    )
    p.add_argument(
        "--chart",
        type=Path,
        metavar="FILE",
        help="draw the windows and where burns may be; .png, .pdf or .svg (the extra [report])",
    )
    p.add_argument("--csv", type=Path, metavar="FILE", help="write them as a table")
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0, or 2 after bad input."""
    options = parse(parser(), arguments)
    return run_command(lambda console: _windows(options, console), options)


def _windows(options: argparse.Namespace, console: Console) -> Answer:
    scenario = load_scenario(options.scenario)
    begin = options.begin or scenario.epoch.tdb
    first = (begin - scenario.epoch.tdb).total_seconds()
    if abs(first) > DAYS_MAX * DAY_S:
        raise InputError(
            "--from",
            f"{begin.isoformat()}",
            f"must be within {DAYS_MAX:g} days of the scenario's epoch, "
            f"{scenario.epoch.tdb.isoformat()}: its orbit is two-body motion from there",
        )
    if options.chart:
        with needing("--chart", "report"):
            from scp_recon.cli.view.window_chart import draw
    warnings = check_given(Given(scenario, rotation_of(scenario), site_of(scenario)))
    found = survey(scenario, (first, first + options.span_days * DAY_S))
    show_survey(console, scenario, found)
    show_warnings(console, warnings)
    if options.csv:
        _write(options.csv, "--csv", as_csv(scenario, found), console)
    if options.chart:
        _write(options.chart, "--chart", draw(scenario, found, options.chart.suffix), console)
    files = [str(path) for path in (options.csv, options.chart) if path]
    return Answer(0, {**survey_document(scenario, found), "files": files})


def _write(path: Path, entry: str, content: str | bytes, console: Console) -> None:
    try:
        write_atomically(path, content)
    except OSError as error:
        raise unwritable(path.parent, entry, error) from None
    show_written(console, path)


if __name__ == "__main__":
    sys.exit(main())
