"""All commands by one name: `scp-recon solve ...`, or `python -m scp_recon solve ...`."""

from __future__ import annotations

from scp_recon.cli.command import BAD_INPUT, exit_on_sigint

if __name__ == "__main__":
    exit_on_sigint()

import sys
from collections.abc import Sequence

from scp_recon.cli.commands import COMMANDS
from scp_recon.errors import version_of

HELP = "\n".join(
    [
        "usage: scp-recon COMMAND ...    (scp-recon COMMAND --help says more; --version)",
        "",
        *(
            f"  {name:11} {(command.function.__doc__ or '').partition('.')[0]}"
            for name, command in COMMANDS.items()
        ),
    ]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; its exit status, or 2 where there is none of that name."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words and words[0] in COMMANDS:
        return COMMANDS[words[0]].main(words[1:])
    if words and words[0] in ("-h", "--help"):
        sys.stdout.write(f"{HELP}\n")
        return 0
    if words == ["--version"]:
        sys.stdout.write(f"scp-recon {version_of('scp_recon')}\n")
        return 0
    given = repr(words[0]) if words else "no command"
    sys.stderr.write(f"{HELP}\n\nerror: got {given}; must be one of {', '.join(COMMANDS)}\n")
    return BAD_INPUT


def script() -> int:
    """The console script `scp-recon`."""
    exit_on_sigint()
    return main()


if __name__ == "__main__":
    sys.exit(main())
