"""Plan a flyby: `python -m scp_recon.solve --init cold`, the same as `scp-recon solve`."""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint

if __name__ == "__main__":
    exit_on_sigint()

import sys

from scp_recon.cli.commands import solve

if __name__ == "__main__":
    sys.exit(solve.main())
