"""Test the paper's statements about P2 and about its plan's flights on the rows of the table.

A statement names its place in the paper, and has a criterion of ours. It holds, or the opposite
holds, or it cannot be decided for a given reason.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from experiments.harness import Claim, Record
from experiments.observation_table.rows import KERNEL, PRINTED_CLOSEST_M, PRINTED_WINDOW_S, Printed
from scp_recon.monte_carlo.summary import ONE_SIGMA, TWO_SIGMA
from scp_recon.results.table import Table

SAME_BURNS_M_S = 1e-4
"""Largest difference of a component with which two designs count as one."""

MEAN, ONE, CLOSEST = "mean", "worst 1 sigma", "closest"
COLUMNS = {MEAN: "mean_s", ONE: "worst_1_sigma_s", CLOSEST: "closest_0_3_percent_m"}
"""Of the CSV; the tables for people are views of its rows."""

Rows = Sequence[Record]
ByKey = Mapping[str, Record]

PAIR = (("emission", "emission"), ("site_distance", "distance"))
BREAKS = dict(PAIR) | {"phase": "phase"}
OUTCOMES = {True: "same", False: "opposite", None: "not comparable"}
REFERENCES = ("as_flown", "ballistic")
"""Rows that may stand for the real flight, the best first."""


class Statement(NamedTuple):
    """A statement of the paper, tested.

    Attributes:
        said: the place in the paper, a colon, and the statement in our words.
        criterion: our criterion for agreement.
        measured: our result.
        same: whether the criterion is met; None if that cannot be decided.
        why: explanation of the outcome, if it needs one.
    """

    said: str
    criterion: str
    measured: str
    same: bool | None
    why: str = ""

    @property
    def parts(self) -> tuple[str, str]:
        """Place and statement."""
        place, _, words = self.said.partition(": ")
        return place, words

    @property
    def claim(self) -> Claim:
        """As a claim of the study."""
        return Claim(self.said, self.criterion, self.measured, self.same)


def computed(entries: Rows) -> list[Record]:
    """Rows with figures, without the failed ones."""
    return [row for row in entries if "mean_s" in row]


def of_role(entries: Rows, *roles: str) -> list[Record]:
    """The rows of these roles."""
    return [row for row in entries if row["role"] in roles]


def standing_for(printed: Printed, entries: Rows) -> list[Record]:
    """Rows of the table that stand for one of the paper's."""
    table = of_role(entries, "reference", "planned")
    return [row for row in table if row["paper_row"] == printed.name]


def shown(row: Record, name: str, digits: int) -> str:
    """Text of a value, with its interval if it has one."""
    value, low, high = (row[f"{name}{end}"] for end in ("", "_low", "_high"))
    interval = "" if "" in (low, high) else f" ({low:.{digits}f} to {high:.{digits}f})"
    return f"{value:.{digits}f}{interval}"


def statements(entries: Rows) -> list[Statement]:
    """Every statement whose rows have been computed, in the paper's order."""
    rows = {row["row"]: row for row in computed(entries)}
    parts: tuple[Callable[[ByKey], Iterator[Statement]], ...] = (
        _readings,
        _spread,
        _convexity,
        _polytopes,
        _path,
        _flights,
        _of_reference,
        _table,
        _solvers,
    )
    return [found for part in parts for found in part(rows)]


def statements_table(found: Sequence[Statement]) -> Table:
    """Statements with their outcomes in words, as docs/validation/paper.md shows them."""
    lines = [(*s.parts, s.criterion, s.measured, OUTCOMES[s.same], s.why) for s in found]
    return Table.of("", ("paper", "statement", "criterion", "measured", "outcome", "why"), lines)


# --- the problem ----------------------------------------------------------------------------------


def _readings(rows: ByKey) -> Iterator[Statement]:
    """Statements on parameters that the paper leaves open."""
    if literal := rows.get("p2_j2000"):
        p3 = rows.get("p3_j2000", {})
        also = f"; P3 {p3['total_dv_m_s']:.4f} m/s, mean {p3['mean_s']:.0f} s" if p3 else ""
        yield Statement(
            "Sec. IV.C, table 3: states are in J2000, the boundary states too",
            "P2 of these has a plan",
            f"{_outcome(literal)}{also}",
            _converged(literal),
            "the default reads them in the Sun-North frame at the epoch, with which P3 comes near the "
            "printed OSIRIS-REx row: that row is no independent evidence",
        )
    spread, plan = (rows.get(key) for key in ("spread_printed", "scp_cold"))
    if spread and plan:
        yield Statement(
            "Table 3: the initial covariance is the square of 1 % of each component of the state",
            "the axes of the components are named",
            f"J2000 after turning: {_cost(plan)}; the printed frame: {_cost(spread)}",
            None,
            "the paper does not name them; J2000, in which it plans, is a reading like the other",
        )
    if plan and plan["still_sun_window_s"] != "":
        still, moving = plan["still_sun_window_s"], plan["window_s"]
        yield Statement(
            "Table 3: the direction to the Sun is one vector",
            "with it the window's length is nearer the printed 3397 s than with a Sun that moves",
            f"{still:.1f} s with the vector of the epoch, {moving:.1f} s",
            bool(abs(still - PRINTED_WINDOW_S) < abs(moving - PRINTED_WINDOW_S)),
            "the printed vector is ours at the epoch, rounded",
        )
    if wide := rows.get("errors_table_1"):
        yield Statement(
            "Tables 1, 3: errors of 3 % and 10 % are measured with, those of 1 % and 8 % planned with",
            "P2 has a plan with those of table 1 too",
            f"{_outcome(wide)}, mean {wide['mean_s']:.0f} s",
            _converged(wide),
            "the paper does not say why the two differ",
        )


def _spread(rows: ByKey) -> Iterator[Statement]:
    if plan := rows.get("scp_cold"):
        ratios = {k.removeprefix("spread_"): v for k, v in plan.items() if k.startswith("spread_")}
        yield Statement(
            "Sec. VI.A, eqs. 17, 18: the filter's prediction step carries the covariance to the end",
            "flights spread by within 5 % as predicted in every component",
            "over the predicted: " + ", ".join(f"{k} {v:.2f}" for k, v in ratios.items()),
            all(abs(v - 1.0) <= 0.05 for v in ratios.values()),
            "errors and dynamics are the same in both, so that the rest is the linearisation's; in the "
            "window every constraint holds with more than the required probability",
        )


def _convexity(rows: ByKey) -> Iterator[Statement]:
    if plan := rows.get("scp_cold"):
        yield Statement(
            "Sec. VI.B: but for both dynamics and the burns' battery cones, P2 is convex",
            "the middle of two points of mean and covariance that keep a facet keeps it",
            f"it lies {plan['facet_missed_m']:.1f} m beyond the tightest facet",
            bool(plan["facet_missed_m"] <= 0.0),
            "the root of a'Sigma a is concave in Sigma; in a factor of Sigma, which is carried here, "
            "the facet is a second-order cone",
        )


def _polytopes(rows: ByKey) -> Iterator[Statement]:
    plan, many, again = (rows.get(key) for key in ("scp_cold", "cones_24", "facets_again"))
    if plan and many:
        yield Statement(
            "Sec. VI.B, fig. 11: hyperplanes may be added for as much accuracy as is needed",
            "P2 with cones of 24 facets costs no more than with 4",
            f"{many['total_dv_m_s']:.4f} against {plan['total_dv_m_s']:.4f} m/s",
            bool(many["total_dv_m_s"] <= plan["total_dv_m_s"]),
            "the set comes closer, but Boole's inequality gives each facet a smaller share of the risk",
        )
    if plan and again:
        yield Statement(
            "Sec. VI.B: the facet of largest probability is found at the solution of P3",
            "chosen again at P2's solution it saves nothing",
            f"{again['total_dv_m_s']:.5f} against {plan['total_dv_m_s']:.5f} m/s",
            bool(again["total_dv_m_s"] > plan["total_dv_m_s"] - SAME_BURNS_M_S),
            "P2's path is another than P3's; `--facet-rounds` chooses again",
        )


# --- the plan, and its flights --------------------------------------------------------------------


def _path(rows: ByKey) -> Iterator[Statement]:
    plan, certain = rows.get("scp_cold"), rows.get("p3")
    if not plan:
        return
    near, far = (plan[f"nominal_site_distance_{end}_m"] for end in ("least", "most"))
    yield Statement(
        "Sec. IV.A: the flown pass was about 625 m low",
        "the plan's distance from the site in the window is about that",
        f"{near:.0f} to {far:.0f} m",
        None,
        "the flight's height, from a surface that is not named; how far the plan stays is P2's choice",
    )
    yield Statement(
        "Sec. VII, fig. 12: the planned path stays 500 m from the centre",
        "at least 500 m",
        f"{plan['nominal_closest_m']:.0f} m",
        bool(plan["nominal_closest_m"] >= 500.0),
    )
    yield Statement(
        "Sec. VII, fig. 13a: every burn keeps the limit of its size and the battery's cones",
        "at most 0.2 m/s, at least 23.3 deg from the Sun line",
        f"{plan['largest_burn_m_s']:.4f} m/s, {plan['nearest_sun_line_deg']:.1f} deg",
        bool(plan["largest_burn_m_s"] <= 0.2 and plan["nearest_sun_line_deg"] >= 23.3),
    )
    inner = 100 * plan["inner_burns"]
    yield Statement(
        "Sec. VII, fig. 13a: the spacecraft fires mainly at the beginning and at the end",
        "first and last burn have most of the delta-v, and each is larger than any between",
        f"{100 - inner:.0f} %; the largest between is {plan['largest_inner_over_least_outer']:.2f} of "
        "the smaller of the two",
        bool(inner < 50.0 and plan["largest_inner_over_least_outer"] < 1.0),
        f"mainly, no more: the two between have {inner:.0f} % of the delta-v, no bang-bang arc",
    )
    if certain:
        without = 100 * certain["inner_burns"]
        yield Statement(
            "Sec. VII: the two burns between are there to keep the constraints under uncertainty",
            "P3, without uncertainty, has none",
            f"P3 {_inner(certain)} m/s, {without:.0f} % of its delta-v; P2 {_inner(plan)} m/s, "
            f"{inner:.0f} %",
            bool(without < 1.0),
        )
    yield Statement(
        "Sec. VII, fig. 13b: the planned path keeps every observation constraint in the window",
        "throughout, to 1 s",
        f"{plan['without_uncertainty_s']:.1f} of {plan['window_s']:.1f} s",
        bool(plan["without_uncertainty_s"] > plan["window_s"] - 1.0),
    )
    reference = _reference(rows)
    if reference:
        ours, theirs = (row["nominal_emission_at_close_deg"] for row in (plan, reference))
        known = reference["row"] == "as_flown"
        yield Statement(
            "Sec. VII, fig. 13b: as the window closes, the plan's emission is above the flight's",
            "larger",
            f"{ours:.1f} deg against {theirs:.1f} deg of {reference['row']}",
            bool(ours > theirs) if known else None,
            "" if known else _no_kernel(),
        )


def _flights(rows: ByKey) -> Iterator[Statement]:
    """Statements on the plan's flights, which the paper makes on figures 12, 13b and 16."""
    plan = rows.get("scp_cold")
    if not plan:
        return
    yield Statement(
        "Sec. VII: at the 0.3 % quantile flights keep well away from Bennu",
        "more than 500 m from the centre",
        f"{shown(plan, COLUMNS[CLOSEST], 1)} m",
        bool(plan[f"{COLUMNS[CLOSEST]}_low"] > 500.0),
        f"the printed {PRINTED_CLOSEST_M} m, of whichever start, is not met",
    )
    for name in ("site_distance", "emission"):
        yield _at_sigma(plan, name, TWO_SIGMA, "2 sigma", broken=True)
    yield _at_sigma(plan, "phase", TWO_SIGMA, "2 sigma", broken=False)
    for name in BREAKS:
        yield _at_sigma(plan, name, ONE_SIGMA, "1 sigma", broken=False)
    tangent = rows.get("tangent")
    why = f"with tangent spheres and cones of 12 facets {_shares(tangent)}" if tangent else ""
    yield from _pattern(plan, "the plan's flights", why)


def _of_reference(rows: ByKey) -> Iterator[Statement]:
    """Statements on the same pattern in the flights of the row that represents OSIRIS-REx."""
    if reference := _reference(rows):
        yield from _pattern(reference, _stands_for(reference), "the paper says it of its plan")


def _pattern(row: Record, whose: str, why: str) -> Iterator[Statement]:
    yield Statement(
        f"Sec. VII, fig. 16: emission is violated more often than distance, in {whose}",
        "a larger share of flights",
        _shares(row),
        _above(row, *(f"{name}_broken" for name, _ in PAIR)),
        why,
    )
    little = row["emission_lost_little"]
    yield Statement(
        f"Sec. VII, fig. 16: a violation of emission seldom costs more than 1000 s, in {whose}",
        "at least nine in ten cost at most that",
        f"{100 * little:.0f} % of them; {row['emission_lost_s']:.0f} s on average",
        bool(little >= 0.9) if row["emission_broken"] else None,
    )
    lost = row["site_distance_lost_all"]
    yield Statement(
        f"Sec. VII, fig. 16: a violation of distance costs all of the observation, in {whose}",
        "half of them or more",
        f"{100 * lost:.1f} % of them; {row['site_distance_lost_s']:.0f} s on average",
        bool(lost >= 0.5) if row["site_distance_broken"] else None,
    )


def _at_sigma(row: Record, name: str, tail: float, sigmas: str, *, broken: bool) -> Statement:
    """Whether a constraint is broken at the edge of so many sigmas, at its least probable time."""
    column, kept = f"{name}_lowest", 1.0 - tail
    low, high = (row[f"{column}_{end}"] for end in ("low", "high"))
    decided = low >= kept or high < kept
    verb = "is violated" if broken else "holds"
    return Statement(
        f"Sec. VII, fig. 13b: {BREAKS[name]} {verb} at the worst {sigmas}",
        f"least probability at a time {'below' if broken else 'at least'} {kept:.4f}",
        shown(row, column, 4),
        bool((low >= kept) != broken) if decided else None,
        "" if decided else "undecided: the interval contains the limit",
    )


# --- the table ------------------------------------------------------------------------------------


def _table(rows: ByKey) -> Iterator[Statement]:
    entries = list(rows.values())
    planned, reference = of_role(entries, "planned"), of_role(entries, "reference")
    if planned and reference:
        yield from (_order(what, planned, reference) for what in (MEAN, ONE))
    for row in (row for row in planned if row["row"].endswith("_cold")):
        yield Statement(
            f"Table 4: the worst 1 sigma observes the whole window, {row['label']}",
            f"{100 * (1.0 - ONE_SIGMA):.1f} % of flights observe throughout",
            f"{100 * row['throughout']:.1f} %",
            row["full_window_at_worst_1_sigma"],
        )
    for solver in ("scp", "ipopt"):
        warm, cold = (rows.get(f"{solver}_{start}") for start in ("warm", "cold"))
        if warm and cold:
            apart = burns_apart(warm, cold)
            one = apart < SAME_BURNS_M_S
            yield Statement(
                f"Table 4: the cold start ends better than the warm one, {solver.upper()}",
                "a larger mean observation time, by another plan",
                f"mean {cold['mean_s']:.0f} against {warm['mean_s']:.0f} s; burns differ by at most "
                f"{1e3 * apart:.3f} mm/s",
                bool(cold["mean_s"] > warm["mean_s"] and not one),
                "both starts end at one optimum" if one else "",
            )


def _order(what: str, planned: Rows, reference: Rows) -> Statement:
    name = COLUMNS[what]
    least = min(planned, key=lambda row: row[name])
    most = max(reference, key=lambda row: row[name])
    low, high = least[name], most[name]
    # Every row flies the same draws, so that the values are surer of their order than the intervals.
    apart = "apart" if least[f"{name}_low"] > most[f"{name}_high"] else "overlapping"
    return Statement(
        f"Table 4: {what} of every planned row above every OSIRIS-REx row",
        "the lowest planned row above the highest OSIRIS-REx row",
        f"{least['row']} {low:.0f} s, {most['row']} {high:.0f} s, intervals {apart}",
        bool(low > high),
        "" if most["row"] == "as_flown" else "the OSIRIS-REx rows are surrogates",
    )


def _solvers(rows: ByKey) -> Iterator[Statement]:
    if nlp := rows.get("ipopt_cold"):
        plan = rows["scp_cold"]["total_dv_m_s"] if "scp_cold" in rows else np.nan
        yield Statement(
            "Sec. VI.B, VII: an off-the-shelf solver of nonlinear programs solves P2",
            "IPOPT converges from the cold start",
            f"{nlp['status'].split(',')[0]}, {nlp['total_dv_m_s']:.6f} m/s; SCP {plan:.6f} m/s",
            _converged(nlp),
        )


# --- words ----------------------------------------------------------------------------------------


def burns_apart(one: Record, other: Record) -> float:
    """Largest difference of a burn's component, m/s."""
    burns = [np.array(row["burns_m_s"].split(), dtype=float) for row in (one, other)]
    return float(np.abs(burns[0] - burns[1]).max())


def _reference(rows: ByKey) -> Record | None:
    return next((rows[key] for key in REFERENCES if key in rows), None)


def _stands_for(row: Record) -> str:
    who = "OSIRIS-REx's" if row["row"] == "as_flown" else "the ballistic surrogate's"
    return f"flights of {who} burns"


def _no_kernel() -> str:
    return f"of the real flight, whose kernel {KERNEL} was not at hand"


def _inner(row: Record) -> str:
    """Sizes of the burns between the first and the last."""
    burns = np.array(row["burns_m_s"].split(), dtype=float).reshape(-1, 3)
    return " and ".join(f"{size:.4f}" for size in np.linalg.norm(burns[1:-1], axis=1))


def _converged(row: Record) -> bool:
    return " converged" in row["status"]


def _cost(row: Record) -> str:
    return f"{row['total_dv_m_s']:.6f} m/s, mean {row['mean_s']:.0f} s"


def _outcome(row: Record) -> str:
    """Status, cost and largest violation."""
    return (
        f"{row['status'].split(',')[0]}, {row['total_dv_m_s']:.4f} m/s and "
        f"{row['violation_m']:.1f} m beyond a limit"
    )


def _shares(row: Record) -> str:
    """How often emission is broken, and how often distance."""
    return ", ".join(f"{words} {_percent(row, f'{name}_broken')}" for name, words in PAIR)


def _percent(row: Record, name: str) -> str:
    value, low, high = (100 * row[f"{name}{end}"] for end in ("", "_low", "_high"))
    return f"{value:.1f} % ({low:.1f} to {high:.1f})"


def _above(row: Record, one: str, other: str) -> bool | None:
    """Whether a share is above another; None where their intervals overlap."""
    if row[f"{one}_low"] > row[f"{other}_high"]:
        return True
    return False if row[f"{one}_high"] < row[f"{other}_low"] else None
