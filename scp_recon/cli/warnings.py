"""Warnings and verdicts on the terminal: what every command ends with."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.text import Text

from scp_recon.scenario.warning import ScenarioWarning


def show_warnings(console: Console, warnings: Iterable[ScenarioWarning], of: str = "") -> None:
    """One line each, however long; each once.

    Args:
        console: to print to.
        warnings: of one plan, or of its file and what its mission says today.
        of: whose they are, where there are several plans.
    """
    head = f"warning of {of}" if of else "warning"
    for warning in dict.fromkeys(warnings):
        console.print(
            f"{head}: {warning}", style="yellow", markup=False, highlight=False, soft_wrap=True
        )


def show_verdict(console: Console, word: str, failed: Sequence[str]) -> None:
    """The last word.

    Args:
        console: to print to.
        word: of what is well, such as "verified".
        failed: names of what is not, or sentences that say what was asked; if empty all is well.
    """
    if failed:
        text = Text(f"not {word}", style="bold red") + Text(
            f": {', '.join(failed)}", style="default"
        )
    else:
        text = Text(word, style="bold green")
    console.print(text, soft_wrap=True)
