"""All commands by one name: `scp-recon solve ...`, or `python -m scp_recon solve ...`."""

from __future__ import annotations

from scp_recon.cli.command import BAD_INPUT, exit_on_sigint

if __name__ == "__main__":
    exit_on_sigint()

import sys
from collections.abc import Sequence
from importlib import import_module
from types import ModuleType

COMMANDS = {
    "solve": "plan a flyby",
    "design": "choose departure, arrival and burn times from a home orbit",
    "replan": "plan again what is left of a flight",
    "verify": "verify a solution again",
    "montecarlo": "fly a plan many times",
    "simulate": "fly a plan with the spacecraft in the loop",
    "campaign": "run many cases of a study",
    "compare": "plans side by side",
    "report": "plans on one page to look at",
    "export": "write a plan for other tools",
    "new": "draft a scenario",
    "windows": "lighting windows and legal burn times",
    "schema": "write the JSON schema of scenario files",
}
HELP = "\n".join(
    [
        "usage: scp-recon COMMAND ...    (scp-recon COMMAND --help says more)",
        "",
        *(f"  {name:11} {words}" for name, words in COMMANDS.items()),
    ]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; its exit status, or 2 where there is none of that name."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words and words[0] in COMMANDS:
        return int(_module_of(words[0]).main(words[1:]))
    if words and words[0] in ("-h", "--help"):
        sys.stdout.write(f"{HELP}\n")
        return 0
    given = repr(words[0]) if words else "no command"
    sys.stderr.write(f"{HELP}\n\nerror: got {given}; must be one of {', '.join(COMMANDS)}\n")
    return BAD_INPUT


def _module_of(command: str) -> ModuleType:
    """The module of a command, which may be a package's."""
    module = import_module(f"scp_recon.{command}")
    return module if hasattr(module, "main") else import_module(f"{module.__name__}.__main__")


def script() -> int:
    """The console script `scp-recon`."""
    exit_on_sigint()
    return main()


if __name__ == "__main__":
    sys.exit(main())
