"""All commands, each with the function of `api` whose options it has; light, for a quick --help."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from scp_recon.cli.command import Command
from scp_recon.cli.options import named_folder


def _out(files: str) -> dict[str, Any]:
    """The folder of a run."""
    return {
        "type": named_folder,
        "metavar": "DIR",
        "help": f"folder for {files} (default: runs/NAME/UTC with the scenario's name, to which "
        "runs/latest then points); a verified plan there is overwritten only by a verified one",
    }


FOLDER = {"type": Path, "metavar": "DIR"}

solve = Command(
    "solve",
    "planning",
    "api.planning.plan",
    "Plan a flyby.",
    {
        "file": {
            "first": True,
            "nargs": "?",
            "metavar": "SCENARIO",
            "help": "in place of --scenario: a file, or a packaged one's name",
        },
        "init": {
            "help": "straight line; ballistic arc; a solution file (and its scenario, unless "
            "--scenario is given) or a CSV of states t, x, y, z, vx, vy, vz in SI, J2000 (default: "
            "cold)"
        },
        "report": {
            "action": "store_true",
            "help": "write report.html too, a page to look at; the extra [report]",
        },
        "out": _out("solution.json"),
    },
)
design = Command(
    "design",
    "passes",
    "api.designing.design",
    "Choose departure, arrival and burn times of a pass from a home orbit, and plan it.",
    {"out": _out("solution.json, scenario.toml, design.csv and pictures")},
)
replan = Command(
    "replan",
    "replanning",
    "api.replans.replan",
    "Plan the rest of a flight.",
    {
        "overrides": {
            "help": "override one entry of the scenario for the rest, e.g. "
            "navigation.lead_s=900; may be repeated"
        },
        "out": _out("solution.json"),
    },
)
verify = Command("verify", "plans", "api.files.verify", "Verify a solution again.")
montecarlo = Command(
    "montecarlo", "flights", "api.flights.fly", "Fly a plan many times with errors."
)
simulate = Command(
    "simulate",
    "flights",
    "api.flights.simulate",
    "Fly a plan once with the spacecraft in the loop.",
    {"out": FOLDER | {"help": "folder for simulation.npz (default: the plan's)"}},
)
campaign = Command(
    "campaign",
    "campaigns",
    "api.campaigns.campaign",
    "Run many cases of a study, here or on a cluster. A study names a base scenario, axes along which "
    "it changes, and what to do with each case. Results are one row a case, in DIR/results.parquet. A "
    "campaign that was stopped goes on with the same command.",
    {"out": FOLDER},
)
compare = Command(
    "compare",
    "plans",
    "api.files.compare",
    "Compare plans side by side; paths are compared with the first one's.",
)
report = Command(
    "report",
    "plans",
    "api.files.report",
    "Show plans, or a campaign, on one page. It is an HTML file that works without a network: the "
    "verdict, a 3-D view in time, histories with their bands, probabilities, ground track, delta-v, "
    "margins, convergence. It includes flights and simulations beside a plan.",
    {
        "plans": {
            "help": "folder with a solution.json, or a file; several are overlaid; or the "
            "folder of a campaign, finished or not, which gets a page"
        },
        "out": {
            "type": Path,
            "metavar": "FILE",
            "default": None,
            "help": "the page (default: report.html in the first plan's folder)",
        },
    },
)
explore = Command(
    "explore",
    "scenarios",
    "api.exploring.explore",
    "Serve a page of sliders, on this machine alone. The plan and its 3-D view follow probability, "
    "errors, limits, burn times and navigation. Ctrl-C ends it.",
)
export = Command(
    "export",
    "plans",
    "api.files.export",
    "Write a plan for other tools.",
    {"out": FOLDER | {"default": None, "help": "folder for the files (default: export in PLAN's)"}},
)
new = Command("new", "scenarios", "api.drafts.new", "Draft a scenario for one's own site and body.")
windows = Command(
    "windows", "scenarios", "api.survey.windows", "Find lighting windows and legal burn times."
)
scenarios = Command(
    "scenarios", "scenarios", "api.inputs.scenarios", "List the packaged scenarios."
)
schema = Command(
    "schema",
    "scenarios",
    None,
    "Write the JSON schema of scenario files.",
    {"file": {"first": True, "type": Path, "metavar": "FILE", "help": "where to write it"}},
)

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
