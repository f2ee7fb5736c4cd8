"""Sentinels: rows of the studies that are measured again to see whether results have moved.

Each takes some seconds. Tolerances are relative. They are well above what differs between OpenBLAS's
kernels (SkylakeX, Haswell, Sandybridge): of the delta-v up to 4e-5 of a plan with uniform risk, whose
facets follow from where P3 stopped, and of a certified plan, whose level follows from flights; 1e-7 of
other plans, 1e-5 of plans with gains and of designs, 1e-3 of a designed pass over Didymos; 1e-4 of
where a simulated spacecraft ends.
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
    frontier,
    gallery,
    knowledge,
    maps,
    missed_burns,
    observation_table,
    plans,
)
from experiments.evidence import Evidence, Records, path_of
from experiments.harness import Record, default_mission, default_plan
from experiments.in_flight import feedback, policies
from experiments.other_tools import cross_check, peers, spice
from experiments.solvers import optima, sensitivity
from experiments.solvers.cases import REFERENCE, SHOOTING, TUNED, Cell, Method, exact_design
from experiments.solvers.cells import solve
from experiments.spacecraft import (
    battery_cones,
    flown_plan,
    model_fidelity,
    uncertainty_sources,
)
from scp_recon.api.campaigns import work_of
from scp_recon.api.plan_verbs import simulate
from scp_recon.campaigns.study import read_study
from scp_recon.errors import InputError
from scp_recon.results.solution import ballistic_arc
from scp_recon.simulation.vehicle import load_vehicle


class Sentinel(NamedTuple):
    """Rows of a study that are measured again to see whether its results have moved.

    Attributes:
        rows: the table in which they stand, "evidence" or "evidence.table".
        key: columns whose cells find a row there, with commas between.
        within: tolerances of the columns that are compared, relative; 0 for equal cells.
        work: measures a case: a row or several; a function of a module.
        cases: those that are measured in each check.
    """

    rows: str
    key: str
    within: Mapping[str, float]
    work: Callable[[Any], Mapping[str, Any] | Records]
    cases: Sequence[Any]

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
            for column, within in self.within.items():
                was = rows[0].get(column)
                if column not in new:
                    found.append(f"{said}.{column}: no such column any more")
                elif not near(was, new[column], within):
                    allowed = f"within {within:g}" if within else "equal"
                    found.append(f"{said}.{column}: was {was}, is {new[column]}, not {allowed}")
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


def error_rows(at: tuple[str, float, Sequence[float | None]]) -> list[Record]:
    """Rows over the measurement's error."""
    rows: list[Record] = feedback.over_errors(at)["rows"]
    return rows


def sampled_site(place: int) -> Record:
    """A site of the sample by its place."""
    study = read_study(maps.STUDIES / "reconnaissance_map.toml")
    return maps.sampled(study, maps.drawn_numbers(study)[place])


def sizes_row(of: str) -> Record:
    """The summary of the cases of some sizes."""
    study = read_study(maps.STUDIES / "sizes.toml")
    cases = [case for case in study.cases if maps.size(dict(case.changes)) == of]
    rows = [{**case.changes, **work_of(study)(case).values} for case in cases]
    return {"of": of} | maps.summary(pd.DataFrame(rows))


def method_row(method: Method) -> Record:
    """A row of the table of methods."""
    row = solve(Cell("matrix", "recon_b", (), method, "cold"))
    names = {"problem": row["scenario"], "start": row["start"], "method": row["method"]}
    return names | {"status": row["status"], "delta_v_m_s": row["total_dv_m_s"]}


def exact_row(seed: int) -> Record:
    """The default's row of a scenario of exact risk."""
    (cell,) = (each for each in exact_design(range(seed, seed + 1)) if each.method == REFERENCE)
    return solve(cell)


def spice_rows(folder: Path, _: None) -> list[Record]:
    """Differences of position and velocity; the others are rounding."""
    return spice.measure(folder)[:2]


def left_out_rows(_: None) -> list[Record]:
    """The forces that the planner leaves out; the other differences are rounding."""
    return [row for row in cross_check.compare(default_plan()) if row["why"]]


def observation_row(folder: Path, key: str) -> Record:
    """A row of the table of observation times."""
    (row,) = (one for one in observation_table.rows() if one.key == key)
    return observation_table.run_row(folder, row)


def fidelity_rows(_: None) -> list[Record]:
    """The ballistic arc by models that matter."""
    rows = model_fidelity.compare("ballistic arc", ballistic_arc(default_mission()))
    return [row for row in rows if row["terminal_m"] > 0.1]


def flight_row(seed: int) -> Record:
    """A flight of the default plan by the whole spacecraft."""
    return flown_plan.row(simulate(default_plan(), seed=seed))


def path_rows(_: None) -> list[Record]:
    """Sources of uncertainty that act on the path of the default plan."""
    return uncertainty_sources.measure_paths(default_plan(), load_vehicle())


# --- the table ----------------------------------------------------------------------------------

EQUAL, FLOWN = 0.0, 1e-3
"""Tolerances of statuses and sizes; and of shares of flights, a few of ten thousand."""
CERTIFIED = {"open_m_s": 1e-4, "feedback_m_s": 1e-4, "open_flown": FLOWN}
FACETS, OTHER = {"status": EQUAL, "total_dv_m_s": 1e-4}, {"status": EQUAL, "total_dv_m_s": 1e-6}
"""Of plans with uniform risk, and of others."""
DEFAULT = "penalty weight", 1.0

OWN = (
    Sentinel("plans", "plan", FACETS | {"whole_flight": FLOWN, "observed_mean_s": 1e-4},
        plans.measure, ["default"]),
    Sentinel("plans", "plan", OTHER, plans.measure, ["certified 0.9"]),
    Sentinel("designs", "design", {"status": EQUAL, "total_dv_m_s": 2e-5},
        plans.measure_design, ["whole flights 0.9"]),
    Sentinel("gallery", "body", {"total_dv_m_s": 4e-3, "flown": 5 * FLOWN, "window_s": 1e-6},
        partial(in_folder, gallery.measure), ["didymos"]),
    Sentinel("frontier", "kind, asked", OTHER | {"whole_flight": FLOWN},
        frontier.measure, [("exact, whole flights", 0.7)]),
    Sentinel("frontier", "kind, asked", FACETS | {"whole_flight": FLOWN},
        frontier.measure, [("uniform, tangent spheres", 0.9)]),
    Sentinel("knowledge.parameters", "case, parameter", {"kept": FLOWN},
        knowledge.measure, [("Bennu on approach", knowledge.PHASE)]),
    Sentinel("knowledge.plans", "case", CERTIFIED,
        knowledge.measure, [(knowledge.GM_10, knowledge.ALL)]),
    Sentinel("missed_burns.costs", "case, drifts",
        {"status": EQUAL, "cost_m_s": 1e-6, "safe": FLOWN},
        missed_burns.measure, [("nightingale", "missed")]),
    Sentinel("feedback.feedback_errors", "scope, scale, asked",
        OTHER | {"dv99_m_s": 1e-6, "whole_flight": FLOWN},
        error_rows, [("flight", 0.9, feedback.ERRORS[:3])]),
    Sentinel("policies", "policy, asked, scale",
        {"status": EQUAL, "mean_dv_m_s": 1e-5, "dv99_m_s": 1e-5, "whole_flight": FLOWN},
        policies.measure, [policies.Case("open", 0.7), policies.Case("feedback", 0.7)]),
    Sentinel("compare_solvers.methods", "problem, start, method",
        {"status": EQUAL, "delta_v_m_s": 2e-5}, method_row, [REFERENCE, TUNED, SHOOTING]),
    Sentinel("compare_solvers.exact", "scenario, method", OTHER | {"reached": FLOWN},
        exact_row, [0, 3]),
    Sentinel("optima", "kind, seeds, seed", FACETS, optima.measure, [("uniform", "tuned", 17)]),
    Sentinel("peers.methods", "method", {"status": EQUAL, "cost": 1e-5},
        peers.measure, ["scvx"]),
    Sentinel("spice", "what", {"off": 1e-4}, partial(in_folder, spice_rows), [None]),
    Sentinel("cross_check", "tool, forces", {"position_m": 1e-4}, left_out_rows, [None]),
    Sentinel("sensitivity", "problem, algorithm, factor, multiple", FACETS,
        sensitivity.measure, [("recon_b", "scvx", *DEFAULT)]),
    Sentinel("sensitivity", "problem, algorithm, factor, multiple", OTHER,
        sensitivity.measure, [("nightingale", "scvx", *DEFAULT), ("replan", "scvx", *DEFAULT)]),
    Sentinel("observation_table", "row", FACETS | {"mean_s": 1e-4, "closest_0_3_percent_m": 1e-3},
        partial(in_folder, observation_row), ["scp_cold"]),
    Sentinel("observation_table", "row", OTHER, partial(in_folder, observation_row), ["p3"]),
    Sentinel("model_fidelity", "flight, effect, model", {"passes": EQUAL, "terminal_m": 1e-4},
        fidelity_rows, [None]),
    Sentinel("battery_cones", "mode, calibrated",
        {"half_angle_deg": 1e-6, "sampled_fraction": 1e-9}, battery_cones.find_cones, [0]),
    Sentinel("uncertainty_sources", "source",
        {"flights": EQUAL, "rms_m": 1e-5, "mean_off_plan_m": 1e-3}, path_rows, [None]),
    Sentinel("flown_plan", "seed",
        {"settled_in_time": EQUAL, "camera_max_deg": 1e-3, "terminal_miss_m": 1e-3},
        flight_row, [0]),
    Sentinel("maps.sizes", "of",
        {"cases": EQUAL, "feasible": EQUAL, "dv_m_s_min": 1e-6, "probability_min": FLOWN},
        sizes_row, ["0.05 500"]),
    Sentinel("map_sample.sample", "site.name",
        {"open": EQUAL, "total_dv_m_s": 1e-6, "whole_flight": 2 * FLOWN},
        sampled_site, [9, 10]),
)  # fmt: skip
ALSO = {
    "sites": ("designs", "policies"),
    "uncertainty_sources": ("flown_plan",),
    "flown_policies": ("flown_plan", "policies"),
}
"""Studies whose rows take minutes, and those whose sentinels feel the same."""


def sentinels_of(name: str) -> list[Sentinel]:
    """The sentinels of some evidence."""
    return [one for one in OWN if one.of in (name, *ALSO.get(name, ()))]
