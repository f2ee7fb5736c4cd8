"""Sentinels: rows of the studies that are measured again to see whether results have moved.

Each takes some seconds. Tolerances are well above what differs between OpenBLAS's kernels (SkylakeX,
Haswell, Sandybridge): of the delta-v 1e-3 of a designed pass over Didymos, 4e-5 of a plan with uniform
risk, whose facets follow from where P3 stopped, and of a certified plan, whose level follows from
flights, and at most 1e-5 of other plans; 1e-4 of where a simulated spacecraft ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import pandas as pd

from experiments import (
    costs,
    flown,
    knowledge,
    left_out,
    maps,
    missed_burns,
    observation_table,
    other_tools,
    plans,
)
from experiments.evidence import Evidence, Records, path_of
from experiments.harness import Record, default_mission, default_plan
from experiments.solvers import compare_solvers, optima
from experiments.solvers.cases import REFERENCE, SHOOTING, TUNED, Cell, exact_design
from scp_recon.api.campaigns import work_of
from scp_recon.api.plan_verbs import simulate
from scp_recon.campaigns.study import read_study
from scp_recon.errors import InputError
from scp_recon.results.solution import ballistic_arc
from scp_recon.simulation.vehicle import load_vehicle

EXACT = (
    "status total_dv_m_s dv99_m_s mean_dv_m_s delta_v_m_s dv_m_s_min cost cost_m_s open_m_s "
    "feedback_m_s open cases feasible flights passes settled_in_time half_angle_deg "
    "sampled_fraction terminal_m same rms_m window_s"
)
"""Columns that are compared."""
FLOWN = (
    "whole_flight kept open_flown safe reached probability_min observed_mean_s mean_s "
    "closest_0_3_percent_m mean_off_plan_m camera_max_deg terminal_miss_m"
)
"""Columns on flights that are compared; some flights in ten thousand may end otherwise."""
WITHIN = dict.fromkeys(EXACT.split()) | dict.fromkeys(FLOWN.split(), 2e-3)
"""Tolerances by column, relative; that of a sentinel where there is none."""


class Sentinel(NamedTuple):
    """Rows of a study that are measured again to see whether its results have moved.

    Attributes:
        rows: the table in which they stand, "evidence" or "evidence.table".
        key: columns whose cells find a row there, with commas between.
        work: measures a case: a row or several; a function of a module.
        cases: those that are measured in each check.
        within: tolerance of the columns `EXACT`, relative.
    """

    rows: str
    key: str
    work: Callable[[Any], Mapping[str, Any] | Records]
    cases: Sequence[Any]
    within: float = 1e-6

    @property
    def of(self) -> str:
        """Name of the evidence."""
        return self.rows.partition(".")[0]

    def moved(self, measured: Mapping[str, Any] | Records) -> list[str]:
        """A line for each figure of a measured case that has moved.

        Raises:
            InputError: if there is no evidence, or it lacks the table or has not one row of a key.
        """
        table, found = self.rows.rpartition(".")[2], list[str]()
        name, tables = f"{self.of}.json", Evidence.read(path_of(self.of)).tables
        if table not in tables:
            raise InputError(f"{name}: tables", ", ".join(tables), f"must have {table}")
        for new in [measured] if isinstance(measured, Mapping) else measured:
            cells = {column: new[column] for column in self.key.split(", ")}
            said = f"{name}: {table}[{', '.join(map(str, cells.values()))}]"
            rows = [row for row in tables[table] if cells.items() <= row.items()]
            if len(rows) != 1:
                raise InputError(said, f"{len(rows)} rows", "must be one row")
            for column in WITHIN.keys() & rows[0].keys():
                within = WITHIN[column] or self.within
                was, now = rows[0][column], new.get(column)
                if not near(was, now, within):
                    found.append(f"{said}.{column}: was {was}, is {now}, not within {within:g}")
        return found


def near(old: Any, new: Any, within: float) -> bool:
    """Whether a cell differs from the old one by at most so much, relative; texts may be numbers."""
    if new is None or new != new:  # a number that is none is stored as null
        return old is None
    if old == new:
        return True
    try:
        return within > 0.0 and math.isclose(float(old), float(new), rel_tol=within)
    except (TypeError, ValueError):
        return False


# --- rows by themselves -------------------------------------------------------------------------


def in_folder(work: Callable[[Path, Any], Any], case: Any) -> Any:
    """The row of a work that needs a folder, which is not kept."""
    with TemporaryDirectory() as folder:
        return work(Path(folder), case)


def sizes_row(of: str) -> Record:
    """The summary of the cases of some sizes."""
    study = read_study(maps.CAMPAIGNS / "sizes.toml")
    cases = [case for case in study.cases if maps.size(dict(case.changes)) == of]
    rows = [{**case.changes, **work_of(study)(case).values} for case in cases]
    return {"of": of} | maps.summary(pd.DataFrame(rows))


def method_row(cell: Cell) -> Record:
    """A row of the table of methods."""
    row = compare_solvers.solve(cell)
    return row | {"problem": row["scenario"], "delta_v_m_s": row["total_dv_m_s"]}


def fidelity_rows(_: None) -> list[Record]:
    """The ballistic arc by models that matter."""
    rows = left_out.compare_models("ballistic arc", ballistic_arc(default_mission()))
    return [row for row in rows if row["terminal_m"] > 0.1]


# --- the table ----------------------------------------------------------------------------------

DEFAULT = "penalty weight", 1.0
FACETS = 1e-4
"""Tolerance of plans with uniform risk or certified by flights."""

OWN = (
    Sentinel("plans", "plan", plans.measure, ["certified 0.9"]),
    Sentinel("plans", "plan", plans.measure, ["default"], FACETS),
    Sentinel("designs", "design", plans.measure_design, ["whole flights 0.9"], 2e-5),
    Sentinel("gallery", "body", partial(in_folder, plans.measure_pass), ["didymos"], 4e-3),
    Sentinel("frontier", "kind, asked", costs.plan_kind, [("exact, whole flights", 0.7)]),
    Sentinel("frontier", "kind, asked", costs.plan_kind, [("uniform, tangent spheres", 0.9)],
        FACETS),
    Sentinel("knowledge.parameters", "case, parameter", knowledge.measure,
        [("Bennu on approach", knowledge.PHASE)]),
    Sentinel("knowledge.plans", "case", knowledge.measure, [(knowledge.GM_10, knowledge.ALL)],
        FACETS),
    Sentinel("missed_burns.costs", "case, drifts", missed_burns.measure,
        [("nightingale", "missed")]),
    Sentinel("feedback.feedback_errors", "scope, scale, asked",
        lambda at: costs.over_errors(at)["rows"],
        [("flight", 0.9, costs.ERRORS[:3])]),
    Sentinel("policies", "policy, asked, scale", costs.fly_policy,
        [costs.Case("open", 0.7), costs.Case("feedback", 0.7)], 1e-5),
    Sentinel("compare_solvers.methods", "problem, start, method", method_row,
        [Cell("matrix", "recon_b", (), method, "cold") for method in (REFERENCE, TUNED, SHOOTING)],
        2e-5),
    Sentinel("compare_solvers.exact", "scenario, method", compare_solvers.solve,
        [exact_design(range(seed, seed + 1))[0] for seed in (0, 3)]),
    Sentinel("optima", "kind, seeds, seed", optima.plan_drawn, [("uniform", "tuned", 17)], FACETS),
    Sentinel("peers.methods", "method", other_tools.solve, ["scvx"], 1e-5),
    Sentinel("cross_check", "tool, forces",
        lambda _: other_tools.compare(default_plan()), [None]),
    Sentinel("sensitivity", "problem, algorithm, factor, multiple", optima.plan_varied,
        [("nightingale", "scvx", *DEFAULT), ("replan", "scvx", *DEFAULT)]),
    Sentinel("sensitivity", "problem, algorithm, factor, multiple", optima.plan_varied,
        [("recon_b", "scvx", *DEFAULT)], FACETS),
    Sentinel("observation_table", "row", partial(in_folder, observation_table.run_row), ["scp_cold"],
        FACETS),
    Sentinel("observation_table", "row", partial(in_folder, observation_table.run_row), ["p3"]),
    Sentinel("model_fidelity", "flight, effect, model", fidelity_rows, [None], 1e-4),
    Sentinel("battery_cones", "mode, calibrated", left_out.find_cones, [0]),
    Sentinel("uncertainty_sources", "source",
        lambda _: left_out.measure_paths(default_plan(), load_vehicle()), [None], 1e-5),
    Sentinel("flown_plan", "seed",
        lambda seed: flown.row(simulate(default_plan(), seed=seed)), [0]),
    Sentinel("maps.sizes", "of", sizes_row, ["0.05 500"]),
    Sentinel("map_sample.sample", "site.name",
        lambda place: maps.sampled(maps.drawn_numbers()[place]), [9, 10]),
)  # fmt: skip
ALSO = {
    "uncertainty_sources": ("flown_plan",),
    "flown_policies": ("flown_plan", "policies"),
}
"""Studies whose rows take minutes, and those whose sentinels feel the same."""


def sentinels_of(name: str) -> list[Sentinel]:
    """The sentinels of some evidence."""
    return [one for one in OWN if one.of in (name, *ALSO.get(name, ()))]
