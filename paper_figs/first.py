"""The studies that figures are drawn from, run one after the other where they have left nothing yet."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

from paper_figs.inputs import COMMAND as TABLE_COMMAND
from paper_figs.inputs import PLAN, TABLE
from scp_recon.solution.file import FILE_NAME

SOLUTION = "SOLUTION"
"""In a study's command, what stands for the plan."""


def run_first(
    runs: Path,
    studies: Path,
    wanted: Iterable[tuple[str, str]],
    tell: Callable[[str], None],
    run: Callable[[list[str]], int] | None = None,
) -> None:
    """Run what is missing; what cannot be run, for want of an extra, says so itself and is passed over.

    Args:
        runs: folder of the observation-time table, or a plan.
        studies: folder of the studies' folders.
        wanted: of each study its folder's name and its command.
        tell: takes the command lines.
        run: runs one, and returns its exit status.
    """
    run = run or _run
    own = runs.is_file() or (runs / FILE_NAME).exists()
    plan = runs if own else runs / PLAN
    lines = [] if own or (runs / TABLE).exists() else [(TABLE_COMMAND, runs)]
    for folder, command in dict.fromkeys(wanted):
        if not (studies / folder).is_dir():
            lines.append((command, studies / folder))
    for command, out in lines:
        words = [str(plan) if word == SOLUTION else word for word in command.split()]
        tell(" ".join([*words, "--out", str(out)]))
        status = run([sys.executable, *words[1:], "--out", str(out)])
        if status == EMPTY_HANDED:
            tell(f"exit status {status}: left out")


EMPTY_HANDED = 2
"""Exit status of a command that could not begin."""


def _run(words: list[str]) -> int:
    return subprocess.run(words, check=False).returncode
