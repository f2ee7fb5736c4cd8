"""Write a plan for other tools: `python -m scp_recon.export PLAN --format oem`."""

from __future__ import annotations

from scp_recon.cli.command import (
    NOT_VERIFIED,
    Answer,
    exit_on_sigint,
    parse,
    run_command,
    show_written,
)

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from scp_recon.cli.options import int_between
from scp_recon.cli.warnings import show_verdict
from scp_recon.exchange.files import FORMATS, require, stem, write_export
from scp_recon.exchange.heading import (
    SPACECRAFT_ID,
    UNNAMED_BODY_ID,
    Export,
    Ids,
    heading,
)
from scp_recon.exchange.path import WITHIN_M, fly_path
from scp_recon.files import check_writable, unwritable
from scp_recon.mission.mission import Mission
from scp_recon.physics.time_scales import iso_tdb, iso_utc
from scp_recon.solution.read import read_solution
from scp_recon.solution.runs import folder_of, resolve_run
from scp_recon.spacecraft.vehicle import load_vehicle

FOLDER = "export"
NUMBER_MAX = 99_999
"""Of a spacecraft, below zero: its axes have a thousand times that, and SPICE counts to 2^31."""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog="python -m scp_recon.export", description=__doc__)
    p.add_argument(
        "solution", type=Path, metavar="PLAN", help="folder with a solution.json, or the file"
    )
    p.add_argument(
        "--format",
        required=True,
        choices=FORMATS,
        help="CCSDS OEM (and an OPM with the burns); SPICE kernels of the path, or of the attitude "
        "(the extra [spice]); a table as CSV or Parquet (the extra [parquet])",
    )
    p.add_argument(
        "--spacecraft",
        type=_negative,
        default=SPACECRAFT_ID,
        metavar="ID",
        help=f"NAIF's number of the spacecraft, as --spacecraft=-64 (default: {SPACECRAFT_ID})",
    )
    p.add_argument(
        "--vehicle",
        type=Path,
        metavar="FILE",
        help="vehicle as TOML, for --format ck (default: the packaged DARE)",
    )
    p.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help=f"folder for the files (default: {FOLDER} in PLAN's)",
    )
    return p


def _negative(text: str) -> int:
    if not text.startswith("-"):
        raise argparse.ArgumentTypeError(f"got {text!r}; must be a negative whole number")
    return -int_between(1, NUMBER_MAX)(text[1:])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0, 2 after bad input, 4 if the plan is not verified."""
    options = parse(parser(), arguments)
    return run_command(lambda console: _export(options, console), options)


def _export(options: argparse.Namespace, console: Console) -> Answer:
    require(options.format)
    home = resolve_run(options.solution)
    solution, vehicle = read_solution(home), load_vehicle(options.vehicle)
    mission = Mission.from_scenario(solution.scenario)
    path = fly_path(mission, solution)
    ids = Ids(options.spacecraft, mission.scenario.body.naif_id or UNNAMED_BODY_ID)
    export = Export(solution, mission, path, ids)
    folder = options.out or folder_of(home) / FOLDER
    check_writable(folder, f"{stem(export)}.{options.format}", "--out")
    try:
        files = write_export(export, options.format, folder, vehicle)
    except OSError as error:
        raise unwritable(folder, "--out", error) from None
    for line in heading(export):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    show_verdict(console, "verified", export.shortfalls)
    for file in files:
        show_written(console, file)
    document = {
        "verdict": export.verdict,
        "files": [str(file) for file in files],
        "frame": "J2000, body-centred",
        "states": path.size,
        "linear_error_m": path.linear_error_m,
        "cubic_error_m": path.cubic_error_m,
        "asked_error_m": WITHIN_M,
        "burns": [
            {
                "t_s": burn.t_s,
                "tdb": iso_tdb(export.instant(burn.t_s)),
                "utc": iso_utc(export.instant(burn.t_s)),
                "dv_m_s": burn.dv_m_s,
            }
            for burn in solution.burns
        ],
        "plan_hash": solution.plan_hash,
    }
    return Answer(NOT_VERIFIED if export.shortfalls else 0, document)


if __name__ == "__main__":
    sys.exit(main())
