"""All commands by one name: `scp-recon solve ...`, or `python -m scp_recon solve ...`."""

from __future__ import annotations

from scp_recon.cli.command import BAD_INPUT, Command, exit_on_sigint

if __name__ == "__main__":
    exit_on_sigint()

import sys
from collections.abc import Sequence
from importlib import import_module

COMMANDS = {
    "solve": ("planning", "plan a flyby"),
    "design": ("passes", "choose departure, arrival and burn times from a home orbit"),
    "replan": ("replanning", "plan again what is left of a flight"),
    "verify": ("plans", "verify a solution again"),
    "montecarlo": ("flights", "fly a plan many times"),
    "simulate": ("flights", "fly a plan with the spacecraft in the loop"),
    "campaign": ("campaigns", "run many cases of a study"),
    "compare": ("plans", "plans side by side"),
    "report": ("plans", "plans, or a campaign, on one page to look at"),
    "export": ("plans", "write a plan for other tools"),
    "new": ("scenarios", "draft a scenario"),
    "windows": ("scenarios", "lighting windows and legal burn times"),
    "schema": ("scenarios", "write the JSON schema of scenario files"),
}
"""Each with the module of `cli.commands` that has it, and what it does."""
HELP = "\n".join(
    [
        "usage: scp-recon COMMAND ...    (scp-recon COMMAND --help says more)",
        "",
        *(f"  {name:11} {words}" for name, (_, words) in COMMANDS.items()),
    ]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; its exit status, or 2 where there is none of that name."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words and words[0] in COMMANDS:
        return int(command(words[0]).main(words[1:]))
    if words and words[0] in ("-h", "--help"):
        sys.stdout.write(f"{HELP}\n")
        return 0
    given = repr(words[0]) if words else "no command"
    sys.stderr.write(f"{HELP}\n\nerror: got {given}; must be one of {', '.join(COMMANDS)}\n")
    return BAD_INPUT


def command(name: str) -> Command:
    """A command by its name; what it needs is imported with it."""
    module = import_module(f"scp_recon.cli.commands.{COMMANDS[name][0]}")
    found: Command = getattr(module, name)
    return found


def script() -> int:
    """The console script `scp-recon`."""
    exit_on_sigint()
    return main()


if __name__ == "__main__":
    sys.exit(main())
