"""Write the JSON schema of scenario files: `python -m scp_recon.schema docs/scenario.schema.json`."""

from __future__ import annotations

from scp_recon.cli.command import Answer, exit_on_sigint, parse, run_command, show_written

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from scp_recon.files import check_writable, unwritable, write_atomically
from scp_recon.scenario.json_schema import json_schema


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog="python -m scp_recon.schema", description=__doc__)
    p.add_argument("file", type=Path, metavar="FILE", help="where to write it")
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    options = parse(parser(), arguments)
    return run_command(lambda console: _write(options.file, console), options)


def schema_text() -> str:
    """What the file holds."""
    return json.dumps(json_schema(), indent=2) + "\n"


def _write(file: Path, console: Console) -> Answer:
    check_writable(file.parent, file.name, "FILE")
    try:
        path = write_atomically(file, schema_text())
    except OSError as error:
        raise unwritable(file.parent, "FILE", error) from None
    show_written(console, path)
    return Answer(0, {"files": [str(path)]})


if __name__ == "__main__":
    sys.exit(main())
