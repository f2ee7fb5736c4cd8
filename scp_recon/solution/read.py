"""A solution file read: what of it has to fit together, and what an edited one is worth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.scenario.warning import ScenarioWarning
from scp_recon.scp.status import Status
from scp_recon.solution.file import FILE_NAME, HASH, READABLE, Solution
from scp_recon.solution.part import parse_file, read_json
from scp_recon.solution.runs import resolve_run
from scp_recon.solution.times import strange_times


def read_solution(path: Path) -> Solution:
    """Read a solution file, or the one in a folder; `runs/latest` is that of the last finished run.

    A file whose scenario or burns were changed after it was written is read, but as one that is not
    verified, with a warning: its margins and its verification are of another plan.

    Raises:
        InputError: if there is none, it is of another version, it is damaged, or its parts do not
            fit together.
    """
    path = resolve_run(path)
    file = path / FILE_NAME if path.is_dir() else path
    data = read_json(file, "solution")
    solution = parse_file(data, Solution, READABLE, f"solution {file}")
    try:
        Status.named(solution.status)
    except ValueError:
        allowed = ", ".join(status.value.name for status in Status)
        raise InputError(
            f"solution {file}: status", repr(solution.status), f"must be one of {allowed}"
        ) from None
    try:
        mission = Mission.from_scenario(solution.scenario)
    except InputError as error:
        raise InputError(f"solution {file}: {error.entry}", error.given, error.allowed) from None
    if strange := _strange(mission, solution):
        raise InputError(
            f"solution {file}: {strange[0]}", "what contradicts its scenario", "must be of one plan"
        )
    if HASH in data and data[HASH] != solution.plan_hash:  # older files have none
        return _changed(solution, file)
    return solution


def _changed(solution: Solution, file: Path) -> Solution:
    """The solution of a file that was edited: not verified, and with a warning."""
    word = ScenarioWarning.of(
        f"solution {file}",
        "a scenario or burns that were changed after it was written",
        "those it was planned with would be no surprise: its margins are of another plan",
    )
    changes: dict[str, Any] = {"warnings": (*solution.warnings, word)}
    if (checked := solution.verification) is not None:
        failed = [HASH, *checked.failed]
        changes["verification"] = checked.model_copy(update={"ok": False, "failed": failed})
    return solution.model_copy(update=changes)


def _strange(mission: Mission, solution: Solution) -> list[str]:
    """What contradicts what the scenario makes of grid and units, be it on another machine."""
    units, expected, facets = solution.units, mission.units, solution.facets
    found = strange_times(mission, [b.t_s for b in solution.burns], solution.nodes.t_s)
    if facets is not None and max(facets.node, default=0) >= len(mission.times_s):
        found.append("facets.node")
    if not np.allclose([units.length_m, units.time_s], [expected.length_m, expected.time_s]):
        found.append("units")
    return found
