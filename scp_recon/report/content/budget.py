"""The delta-v that a plan takes, as planned and as sampled flights execute it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import binom

from scp_recon.report.content.flown import Flown
from scp_recon.report.content.subject import Subject

Array = npt.NDArray[np.float64]

SHARE = 0.99


@dataclass(frozen=True, eq=False)
class Budget:
    """Sizes of burns, m/s.

    Attributes:
        first: number of the first burn, more than 1 in flight.
        planned_m_s: shape (m,).
        mean_m_s: of the executions, shape (m,).
        high_m_s: what `SHARE` of the executions of each burn stay below, shape (m,).
        total_mean_m_s: of a flight's total.
        total_high_m_s: what the totals of `SHARE` of the flights stay below.
        interval_m_s: 95 % confidence interval of that.
    """

    first: int
    planned_m_s: Array
    mean_m_s: Array
    high_m_s: Array
    total_mean_m_s: float
    total_high_m_s: float
    interval_m_s: tuple[float, float]


def budget_of(subject: Subject, flown: Flown) -> Budget:
    """Of a plan; the interval is that of an order statistic, free of any distribution."""
    executed = flown.executed_m_s
    totals = np.sort(executed.sum(axis=1))
    ranks = np.clip(binom.ppf([0.025, 0.975], len(totals), SHARE), 0, len(totals) - 1)
    low, high = totals[ranks.astype(int)]
    return Budget(
        1 + subject.solution.scenario.burns_flown,
        np.linalg.norm(subject.solution.burns_m_s, axis=1),
        executed.mean(axis=0),
        np.quantile(executed, SHARE, axis=0),
        float(totals.mean()),
        float(np.quantile(totals, SHARE)),
        (float(low), float(high)),
    )
