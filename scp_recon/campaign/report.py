"""Show a campaign: `python -m scp_recon.campaign.report DIR`.

Writes campaign.html, one page that works without a network, and its pictures as PNG, into the
campaign's folder. A campaign that is under way, or was stopped, is shown as far as it came.
"""

from __future__ import annotations

from scp_recon.cli.command import (
    Answer,
    exit_on_sigint,
    parse,
    run_command,
    show_line,
    show_written,
)

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any

from rich.console import Console

from scp_recon.campaign.view.outcome import CampaignResults, read_campaign
from scp_recon.campaign.view.remarks import remarks
from scp_recon.errors import needing
from scp_recon.files import unwritable, write_atomically
from scp_recon.report.write import check_extra

PAGE = "campaign.html"
EXTRA = ("jinja2", "matplotlib", "pandas", "plotly")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog="python -m scp_recon.campaign.report", description=__doc__)
    p.add_argument("folder", type=Path, metavar="DIR", help="of a campaign, finished or not")
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0, or 2 after bad input."""
    options = parse(parser(), arguments)
    return run_command(lambda console: _show(options.folder, console), options)


def _show(folder: Path, console: Console) -> Answer:
    results = read_campaign(folder)
    written = write_pictures(results)
    _tell(results, written, console)
    return Answer(0, summary_of(results) | {"files": [str(path) for path in written]})


def summary_of(results: CampaignResults) -> dict[str, Any]:
    """What the terminal says of a campaign, for `--json`."""
    return {
        "feasible": results.feasible,
        "ends": results.counts(),
        "remarks": remarks(results),
    }


def show_campaign(folder: Path, console: Console) -> tuple[CampaignResults, list[Path]]:
    """Tell of a finished campaign, and write what the extra [report] allows of it: those files.

    Raises:
        InputError: if the folder cannot be written, or pandas is missing.
    """
    results = read_campaign(folder)
    lacking = any(find_spec(name) is None for name in EXTRA)
    written = [] if lacking else write_pictures(results)
    _tell(results, written, console)
    if lacking:
        show_line(console, f"no {PAGE}: pip install 'scp_recon[report]' for the page and pictures")
    return results, written


def _tell(results: CampaignResults, written: Sequence[Path], console: Console) -> None:
    for line in (results.verdict, *remarks(results)):
        show_line(console, line)
    for path in written:
        show_written(console, path)


def check_extras() -> None:
    """Find out before the work whether page and pictures can be made.

    Raises:
        InputError: if not.
    """
    check_extra()
    with needing("report", "report", "matplotlib"):
        import matplotlib  # noqa: F401 -- whether it is there


def write_pictures(results: CampaignResults) -> list[Path]:
    """Write the page and the pictures of a campaign into its folder, which it returns.

    Raises:
        InputError: if the extra [report] is missing, or the folder cannot be written.
    """
    check_extras()
    from scp_recon.campaign.view.figures import figures
    from scp_recon.campaign.view.page import render

    try:
        written = [write_atomically(results.folder / PAGE, render(results, datetime.now(UTC)))]
        for name, figure in figures(results).items():
            picture = BytesIO()
            figure.savefig(picture, format="png")
            written.append(write_atomically(results.folder / f"{name}.png", picture.getvalue()))
    except OSError as error:
        raise unwritable(results.folder, "DIR", error) from None
    return written


if __name__ == "__main__":
    sys.exit(main())
