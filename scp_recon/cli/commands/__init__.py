"""The commands, each a typed function; light at import, for a quick --help."""

from __future__ import annotations

from scp_recon.cli.commands.flying import montecarlo, simulate
from scp_recon.cli.commands.kept import compare, export, report, verify
from scp_recon.cli.commands.planning import campaign, design, new, replan, solve
from scp_recon.cli.commands.showing import explore, scenarios, schema, windows

COMMANDS = {
    command.name: command
    for command in (
        solve,
        design,
        replan,
        verify,
        montecarlo,
        simulate,
        campaign,
        compare,
        report,
        explore,
        export,
        new,
        windows,
        scenarios,
        schema,
    )
}
"""By name, in the order of the help."""
