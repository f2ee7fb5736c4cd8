"""What a notebook or a script needs, in SI: `import scp_recon as sr`.

The functions have names that no command has, because `import scp_recon.solve` makes `solve` a module.
Paths may be strings.
"""

from __future__ import annotations

from scp_recon.front_door.campaigns import run_campaign
from scp_recon.front_door.planning import plan, plan_again
from scp_recon.front_door.results import check, fly, save, side_by_side, write_report
from scp_recon.scenario.load import load_scenario

__all__ = [
    "check",
    "fly",
    "load_scenario",
    "plan",
    "plan_again",
    "run_campaign",
    "save",
    "side_by_side",
    "write_report",
]
