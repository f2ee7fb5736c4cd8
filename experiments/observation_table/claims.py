"""What the measured rows say about each other and about the paper's numbers, in sentences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from experiments.observation_table.rows import (
    COLD,
    OSIRIS_REX,
    PRINTED_CLOSEST_M,
    PRINTED_WINDOW_S,
    WARM,
)
from experiments.observation_table.runs import Failed, Measured
from scp_recon.monte_carlo.estimates import Estimate
from scp_recon.monte_carlo.observation_time import ALL

Entries = Sequence[Measured | Failed]

TWO_RUNS = np.sqrt(2.0)
"""The paper's figures come from as many samples as ours: its interval adds to ours."""


SAME_BURNS_M_S = 1e-4
"""Largest difference of a component with which two designs count as one."""


@dataclass(frozen=True)
class Claim:
    """Something the paper's table shows, and whether ours does."""

    words: str
    holds: bool


def claims(entries: Entries) -> list[Claim]:
    """Planned rows above the OSIRIS-REx rows, and a full window at worst 1 sigma from a cold start."""
    measured = [e for e in entries if isinstance(e, Measured)]
    planned = [m for m in measured if m.row.role == "planned"]
    reference = [m for m in measured if m.row.role == "reference"]
    found = []
    if planned and reference:
        found = [
            _order("mean", [(m.row.key, m.mean) for m in planned], reference),
            _order("worst 1 sigma", [(m.row.key, m.worst_1_sigma) for m in planned], reference),
        ]
    for m in planned:
        if m.row.printed is COLD:
            throughout = m.summary.held_s[ALL].throughout.estimate
            words = (
                f"{m.row.label}: full window at worst 1 sigma; {100 * throughout.value:.1f} % of "
                "flights observe throughout, 84.1 % are needed"
            )
            found.append(Claim(words, m.full_at_1_sigma))
    return found


def _order(what: str, planned: list[tuple[str, Estimate]], reference: Sequence[Measured]) -> Claim:
    others = [(m.row.key, m.mean if what == "mean" else m.worst_1_sigma) for m in reference]
    least, most = min(planned, key=lambda p: p[1].value), max(others, key=lambda p: p[1].value)
    # Every row flies the same draws, so that the values are surer of their order than the intervals.
    apart = least[1].low > most[1].high
    words = (
        f"{what} of every planned row above every OSIRIS-REx row; lowest planned {least[0]} with "
        f"{least[1].value:.0f} s, highest OSIRIS-REx row {most[0]} with {most[1].value:.0f} s, "
        f"intervals {'apart' if apart else 'overlapping'}"
    )
    return Claim(words, bool(least[1].value > most[1].value))


def differences(entries: Entries) -> list[str]:
    """One sentence on every row: ours, the paper's, and by how much they differ."""
    sentences = []
    for e in entries:
        if isinstance(e, Failed):
            sentences.append(f"{e.row.label}: not computed ({e.reason}).")
            continue
        p = e.row.printed
        sentences.append(
            f"{e.row.label} beside the paper's {p.name}: mean {e.mean.value:.0f} s, "
            f"{_difference(e.mean.value, p.mean_s)} the printed {p.mean_s:.0f} s; worst 1 sigma "
            f"{e.worst_1_sigma.value:.0f} s, "
            f"{_difference(e.worst_1_sigma.value, p.worst_1_sigma_s)} the printed "
            f"{p.worst_1_sigma_s:.0f} s. {e.solution.message if e.row.anew else ''}".rstrip()
        )
    return sentences


def _difference(ours: float, printed: float) -> str:
    gap = round(ours) - round(printed)
    if gap == 0:
        return "equal to"
    return f"{abs(gap)} s {'above' if gap > 0 else 'below'}"


def verdicts(entries: Entries) -> list[str]:
    """Of every number in the paper's table: whether it is reproduced, and if not why not."""
    by_key = {e.row.key: e for e in entries if isinstance(e, Measured)}
    found: list[str] = []
    if by_key:
        found += _certain_numbers(list(by_key.values()))
    flights = [by_key[k] for k in ("as_flown", "ballistic", "p3") if k in by_key]
    reason = (
        "neither surrogate is the flown trajectory, whose public kernel was not at hand"
        if "as_flown" not in by_key
        else "the forces, the errors and the firing times are those of the scenario, not the flight's"
    )
    found += _uncertain_numbers(OSIRIS_REX.name, OSIRIS_REX.mean_s, flights, "mean", reason)
    found += _uncertain_numbers(
        OSIRIS_REX.name, OSIRIS_REX.worst_1_sigma_s, flights, "worst 1 sigma", reason
    )
    for printed, kind in ((WARM, "warm"), (COLD, "cold")):
        rows = [m for m in by_key.values() if m.row.printed is printed]
        reason = _same_optimum(by_key) if kind == "warm" else _open_readings(rows)
        found += _uncertain_numbers(printed.name, printed.mean_s, rows, "mean", reason)
        found += _uncertain_numbers(
            printed.name, printed.worst_1_sigma_s, rows, "worst 1 sigma", reason
        )
    closest = [m for m in by_key.values() if m.row.role == "planned"]
    reason = "the paper does not say of which start it is; of the OSIRIS-REx rows " + ", ".join(
        f"{m.row.key} has {m.closest.value:.1f} m" for m in flights
    )
    name = "the solution trajectory"
    found += _uncertain_numbers(name, PRINTED_CLOSEST_M, closest, "closest", reason)
    return found


def _certain_numbers(measured: Sequence[Measured]) -> list[str]:
    """The window, and the observation times without uncertainty."""
    window = measured[0].window_s
    certain = {m.row.key: m.without_uncertainty_s for m in measured}
    short = [f"{k} {v:.0f} s" for k, v in certain.items() if abs(v - PRINTED_WINDOW_S) > 1.0]
    lines = [
        f"{_word(abs(window - PRINTED_WINDOW_S) < 1.0)}: window {PRINTED_WINDOW_S:.0f} s; ours "
        f"{window:.1f} s."
    ]
    text = f"observation time without uncertainty, {PRINTED_WINDOW_S:.0f} s in every row"
    tail = f"; shorter: {', '.join(short)}" if short else "; ours is within 1 s in every row"
    return [*lines, f"{_word(not short)}: {text}{tail}."]


def _uncertain_numbers(
    name: str, printed: float, rows: Sequence[Measured], what: str, reason: str
) -> list[str]:
    if not rows:
        return [f"Not reproduced: {name}, {what} {printed:g}: no row was computed for it."]
    unit = "m" if what == "closest" else "s"
    values = {m.row.key: _value(m, what) for m in rows}
    agree = [key for key, e in values.items() if _agrees(e, printed)]
    ours = ", ".join(f"{key} {e.value:.{unit == 'm':d}f}" for key, e in values.items())
    label = "closest approach at 0.3 %" if what == "closest" else what
    word = f"Reproduced by {', '.join(agree)} alone" if agree else _word(False)
    word = _word(True) if len(agree) == len(rows) else word
    line = f"{word}: {name}, {label} {printed:g} {unit}; ours {ours} {unit}"
    if len(agree) == len(rows):
        return [f"{line}."]
    return [f"{line}; {reason}."]


def _value(m: Measured, what: str) -> Estimate:
    return {"mean": m.mean, "worst 1 sigma": m.worst_1_sigma, "closest": m.closest}[what]


def _agrees(e: Estimate, printed: float) -> bool:
    """Equal within what two such runs may differ by, or to the printed digit."""
    if abs(e.value - printed) < 0.5:
        return True
    side = e.high - e.value if printed > e.value else e.value - e.low
    return bool(np.isfinite(side) and abs(e.value - printed) <= TWO_RUNS * side)


def _word(reproduced: bool) -> str:
    return "Reproduced" if reproduced else "Not reproduced"


def _same_optimum(by_key: dict[str, Measured]) -> str:
    """How far apart the two starts end."""
    pairs = [(f"{solver}_warm", f"{solver}_cold") for solver in ("scp", "ipopt")]
    apart = [
        (warm, np.abs(by_key[warm].solution.burns_m_s - by_key[cold].solution.burns_m_s).max())
        for warm, cold in pairs
        if warm in by_key and cold in by_key
    ]
    if not apart:
        return "no pair of starts was computed to compare"
    words = ", ".join(f"{1e3 * d:.3f} mm/s ({k.removesuffix('_warm')})" for k, d in apart)
    same = max(d for _, d in apart) < SAME_BURNS_M_S
    so = (
        "both find the same design, and the warm row is as good as the cold one; in the paper they end "
        "apart"
        if same
        else "they end at different designs, as in the paper"
    )
    return f"the burns of the two starts differ by at most {words} a component: {so}"


def _open_readings(rows: Sequence[Measured]) -> str:
    """What the paper leaves open, and what of it was measured not to be the cause."""
    shifts = [m.summary.counted_on_uniform_grid.mean_s - m.mean.value for m in rows]
    gaps = [COLD.mean_s - m.mean.value for m in rows]
    moved, gap = (
        " and ".join(dict.fromkeys(f"{s:+.0f} s" for s in values)) for values in (shifts, gaps)
    )
    return (
        f"counting nodes of the paper's uniform grid would move our mean by {moved} of the "
        f"{gap} between them; not printed, and therefore ours, are how the polytopes are turned, the "
        "site's position, the gravity field and the spacecraft's reflectivity"
    )
