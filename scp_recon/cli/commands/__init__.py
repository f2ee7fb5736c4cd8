"""The commands, each a typed function; light at import, for a quick --help."""

from __future__ import annotations

from scp_recon.cli.commands.planning import (
    campaign,
    design,
    explore,
    new,
    replan,
    scenarios,
    schema,
    solve,
    windows,
)
from scp_recon.cli.commands.plans import compare, export, montecarlo, report, simulate, verify

COMMANDS = {
    command.name: command
    for command in (
        *(solve, design, replan, verify, montecarlo, simulate, campaign, compare),
        *(report, explore, export, new, windows, scenarios, schema),
    )
}
"""By name, in the order of the help."""
