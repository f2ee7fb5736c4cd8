"""Run a study by its name, `python -m experiments NAME [options]`; without a name list them."""

from __future__ import annotations

import os

from scp_recon.cli.command import exit_on_sigint

if __name__ == "__main__":
    exit_on_sigint()
    # NumPy's threads wait for each other in busy loops, which a study would count.
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

import sys
from collections.abc import Sequence

from rich.console import Console

from experiments.evidence import STUDIES
from experiments.harness import run, study_of
from scp_recon.cli.command import run_command, show_line
from scp_recon.errors import one_of

RENEW = "evidence"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a study by name; returns 0 or the study's exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    name = words[0] if words else "--help"
    if name in ("-h", "--help"):
        return run_command(_list_them)
    if name == RENEW:
        from experiments import renewal  # which imports all studies

        return renewal.main(words[1:])
    if name not in STUDIES:
        return run_command(lambda _: int(one_of("NAME", name, STUDIES)))
    return run(f"python -m experiments {name}", study_of(name), words[1:])


def _list_them(console: Console) -> int:
    show_line(console, "usage: python -m experiments NAME [options]; NAME is one of\n")
    from experiments import renewal  # which imports all studies

    about = {name: study_of(name).about for name in STUDIES} | {RENEW: renewal.__doc__}
    for name, words in about.items():
        show_line(console, f"  {name:20} {str(words).splitlines()[0]}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
