"""The command lines that make one case of a campaign again."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from typing import Any

from scp_recon.campaign.study.study import Campaign

SOLVE = "solve --scenario {base} {changes}"
COMMANDS = {
    "plan": (SOLVE,),
    "certify": (SOLVE,),
    "design": ("design {base} {changes}",),
    "fly": (SOLVE, "montecarlo runs/latest --samples {samples} --seed {seed}"),
    "simulate": (SOLVE, "simulate runs/latest --seed {seed}"),
}
"""What is done with a case, as commands after `python -m scp_recon.`."""


def command_lines(
    campaign: Campaign, changes: Mapping[str, Any], seed: int, allocation: str
) -> list[str]:
    """Commands that repeat a case, to be given in the study's folder.

    Args:
        campaign: the study's.
        changes: values by entry of the scenario; of lists their JSON.
        seed: of the case.
        allocation: of the base's risk.
    """
    values = {**campaign.overrides, **changes}
    words = {
        "base": shlex.quote(campaign.base),
        "changes": " ".join(f"--set {shlex.quote(f'{e}={as_toml(v)}')}" for e, v in values.items()),
        "samples": str(campaign.samples),
        "seed": str(seed),
    }
    lines = [f"python -m scp_recon.{line.format(**words)}" for line in COMMANDS[campaign.do]]
    if campaign.do != "certify" and values.get("risk.allocation", allocation) == "exact":
        lines[0] += " --certify no"  # as the campaign does not
    return lines


def as_toml(value: Any) -> str:
    """A value in TOML, whose text, numbers and lists are JSON's."""
    if isinstance(value, str):
        value = _parsed(value)
    if isinstance(value, Mapping):
        inner = ", ".join(f"{key} = {as_toml(each)}" for key, each in value.items())
        return f"{{ {inner} }}"
    return json.dumps(value)


def _parsed(text: str) -> Any:
    """What a cell of text stands for: a list, a table or a number as JSON, or the text itself."""
    try:
        found = json.loads(text)
    except ValueError:
        return text
    return text if found is None or isinstance(found, bool | str) else found
