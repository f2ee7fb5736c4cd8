"""Show plans on one page: `python -m scp_recon.report PLAN [PLAN ...]`.

One HTML file that works without a network: the verdict, a 3-D view in time, histories with their
bands, probabilities, ground track, delta-v, margins, convergence. Flights and simulations that lie
beside a plan are shown with it.
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
from pathlib import Path

from rich.console import Console

from scp_recon.cli.options import int_between, number_between
from scp_recon.report.content.camera import Camera
from scp_recon.report.write import FILE_NAME, write_report
from scp_recon.solution.runs import folder_of, resolve_run


def parser() -> argparse.ArgumentParser:
    """The command line."""
    usual = Camera()
    p = argparse.ArgumentParser(prog="python -m scp_recon.report", description=__doc__)
    p.add_argument(
        "plans",
        type=Path,
        nargs="+",
        metavar="PLAN",
        help="folder with a solution.json, or a file; several are laid over each other",
    )
    p.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help=f"the page (default: {FILE_NAME} in the first plan's folder)",
    )
    p.add_argument(
        "--field-deg",
        type=number_between(0.01, 170.0),
        default=usual.field_deg,
        metavar="DEG",
        help=f"full angle of the camera's field of view (default: {usual.field_deg:g}, DARE's)",
    )
    p.add_argument(
        "--pixels",
        type=int_between(1, 1_000_000),
        default=usual.pixels,
        metavar="N",
        help=f"across the field of view (default: {usual.pixels}, DARE's)",
    )
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0, or 2 after bad input."""
    options = parse(parser(), arguments)
    return run_command(lambda console: _write(options, console), options)


def _write(options: argparse.Namespace, console: Console) -> Answer:
    file = options.out or folder_of(resolve_run(options.plans[0])) / FILE_NAME
    camera = Camera(options.field_deg, options.pixels)
    path = write_report(options.plans, file, camera)
    show_line(console, f"{path.stat().st_size / 1e6:.1f} MB")
    show_written(console, path)
    return Answer(0, {"files": [str(path)]})


if __name__ == "__main__":
    sys.exit(main())
