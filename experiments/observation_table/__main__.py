"""The paper's table of observation times: `python -m experiments.observation_table`.

Every row's burns are designed and flown many times; solution.json and montecarlo.json are left in
OUT/<row>/, the table in OUT/observation_table.csv and .md. A second run takes up what is there.
With --as-flown FILE there is a row for the flight, and the warm rows start from it, as the paper's do;
without it they start from the ballistic arc.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint, parse

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter

from experiments.observation_table.as_flown import read_states
from experiments.observation_table.claims import claims
from experiments.observation_table.report import shown, to_csv, to_markdown
from experiments.observation_table.rows import Row, rows
from experiments.observation_table.runs import Failed, Measured, run_row
from experiments.studies import run
from scp_recon.cli.options import int_between
from scp_recon.files import write_atomically
from scp_recon.mission.mission import Mission
from scp_recon.scenario.load import load_scenario

DEFAULT_OUT = Path("runs") / "paper"
SAMPLES, QUICK_SAMPLES = 10_000, 3_000
ROW_FAILED = 4


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog="python -m experiments.observation_table", description=__doc__)
    p.add_argument(
        "--out",
        type=Path,
        default=DEFAULT_OUT,
        metavar="DIR",
        help=f"folder for the rows and the table (default: {DEFAULT_OUT})",
    )
    p.add_argument(
        "--samples",
        type=int_between(20, 10**9, "20 to 1e9"),
        metavar="N",
        help=f"flights a row (default: {SAMPLES}, with --quick {QUICK_SAMPLES})",
    )
    p.add_argument(
        "--quick", action="store_true", help="fewer flights, and plans are not verified again"
    )
    p.add_argument(
        "--as-flown",
        type=Path,
        metavar="FILE",
        help="SPK of the flight, for a row of its own and as the warm rows' start; needs the extra "
        "[spice]",
    )
    p.add_argument("--skip-ipopt", action="store_true", help="no rows planned by IPOPT")
    p.add_argument("--fresh", action="store_true", help="compute rows that are already there, too")
    return p


def measure(
    mission: Mission,
    table_rows: Sequence[Row],
    out: Path,
    *,
    samples: int,
    check: bool,
    fresh: bool,
    tell: Callable[[str], None],
) -> list[Measured | Failed]:
    """All rows, one after the other; what goes wrong in one does not keep the others from running."""
    entries: list[Measured | Failed] = []
    for row in table_rows:
        started, folder = perf_counter(), out / row.key
        try:
            anew = fresh or row.began_elsewhere(folder)
            entry: Measured | Failed = run_row(
                row, mission, folder, samples=samples, check=check, fresh=anew
            )
        except Exception as error:  # a solver's, a file system's: the row says which
            entry = Failed(row, f"{type(error).__name__}: {' '.join(str(error).split())[:200]}")
        entries.append(entry)
        tell(_progress(entry, perf_counter() - started))
    return entries


def _progress(entry: Measured | Failed, seconds: float) -> str:
    if isinstance(entry, Failed):
        return f"{entry.row.key:12} failed: {entry.reason}"
    source = "taken up" if entry.reused else f"{seconds:.1f} s"
    return (
        f"{entry.row.key:12} {entry.solution.total_dv_m_s:.5f} m/s, observes "
        f"{shown(entry.mean, 0)} s, worst 1 sigma {entry.worst_1_sigma.value:.0f} s; "
        f"{entry.status}; {source}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 if every row is there, 4 if one failed, 2 for bad input."""
    return run(_run, parse(parser(), arguments))


def _run(options: argparse.Namespace) -> int:
    mission, out = Mission.from_scenario(load_scenario()), options.out
    kernel = options.as_flown
    if kernel:
        read_states(mission, kernel)  # before the work, not after it
    out.mkdir(parents=True, exist_ok=True)
    flown = (kernel, out / "as_flown" / "states.csv") if kernel else None
    entries = measure(
        mission,
        rows(ipopt=not options.skip_ipopt, as_flown=flown),
        out,
        samples=options.samples or (QUICK_SAMPLES if options.quick else SAMPLES),
        check=not options.quick,
        fresh=options.fresh,
        tell=lambda line: print(line, flush=True),
    )
    files = {"observation_table.csv": to_csv(entries), "observation_table.md": to_markdown(entries)}
    written = [write_atomically(out / name, text) for name, text in files.items()]
    for claim in claims(entries):
        print(f"{'holds' if claim.holds else 'DOES NOT HOLD'}: {claim.words}")
    for path in written:
        print(f"written: {path}")
    return ROW_FAILED if any(isinstance(entry, Failed) for entry in entries) else 0


if __name__ == "__main__":
    sys.exit(main())
