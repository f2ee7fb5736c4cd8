"""Store the policy of a plan with feedback: corrected burns, and the delta-v they command."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from formulations.arrays import Array
from scp_recon.planning.plan import Plan
from scp_recon.results.policy import Correction, Policy, policy_of
from scp_recon.scenario.fields import Number

Rows = list[list[Number]]


@dataclass(frozen=True)
class CorrectedBurn:
    """One corrected burn: its nominal value and, for each cut-off so far, a gain times an estimate.

    An estimate is the deviation from the plan at a cut-off, by a Kalman filter along the plan, after
    the measurement there; corrections commanded before are part of it.

    Attributes:
        burn: its number, from 1.
        cut_off_s: time of its measurement past the epoch, before a burn at that time.
        gain: 3 by 6 for each cut-off so far, the earliest first: m/s by m and by m/s.
        measurement_covariance: of the measured state's errors, 6 by 6.
        predicted_covariance: of the estimate's errors before the measurement, 6 by 6.
        estimate_covariance: of the estimate's errors after it, 6 by 6.
        sigma_m_s: root of the summed variances of the correction.
    """

    burn: Annotated[int, Field(ge=1)]
    cut_off_s: Number
    gain: list[Rows]
    measurement_covariance: Rows
    predicted_covariance: Rows
    estimate_covariance: Rows
    sigma_m_s: Annotated[float, Field(ge=0)]

    def __post_init__(self) -> None:
        """Refuse arrays of other shapes."""
        for name in ("measurement", "predicted", "estimate"):
            rows = getattr(self, f"{name}_covariance")
            if len(rows) != 6 or any(len(row) != 6 for row in rows):
                raise ValueError(f"{name}_covariance must hold 6 by 6 numbers")
        if any(len(block) != 3 or any(len(row) != 6 for row in block) for block in self.gain):
            raise ValueError("gain must hold 3 by 6 numbers for each cut-off so far")


@dataclass(frozen=True)
class StoredPolicy:
    """Corrected burns, and the law of the delta-v that they command.

    Attributes:
        corrections: one for each corrected burn.
        mean_m_s: mean of the commanded burns' sizes, summed; `total_dv_m_s` is that of the plan itself.
        dv99_m_s: its 99 % quantile, by the program's draws.
    """

    corrections: list[CorrectedBurn]
    mean_m_s: Annotated[float, Field(ge=0)]
    dv99_m_s: Annotated[float, Field(ge=0)]

    def __str__(self) -> str:
        """Its commanded delta-v in one line."""
        mean, most = f"mean {self.mean_m_s:.6f} m/s", f"99 % {self.dv99_m_s:.6f} m/s"
        return f"commanded delta-v, by the normal law: {mean}, {most}"

    def __post_init__(self) -> None:
        """Refuse corrections out of order, or with more or fewer gains than cut-offs so far."""
        burns = [correction.burn for correction in self.corrections]
        cut_offs = [correction.cut_off_s for correction in self.corrections]
        if not burns or any(sorted(set(given)) != given for given in (burns, cut_offs)):
            raise ValueError("corrections must be of ascending burns and cut-offs, one at least")
        if any(len(c.gain) != j for j, c in enumerate(self.corrections, start=1)):
            raise ValueError("gain must have one block for each cut-off so far")


def stored_policy(plan: Plan) -> StoredPolicy | None:
    """The policy of a plan; None where its burns are fixed before departure."""
    mission, lin = plan.mission, plan.final.result.lin
    feedback, scenario = lin.problem.feedback, plan.mission.scenario
    if feedback is None or plan.commanded is None:
        return None
    speed, spread = mission.units.speed_m_s, lin.spread
    corrections = []
    for j, one in enumerate(policy_of(mission, lin)):
        before = spread.stm[feedback.cut_offs[j]] @ spread.errors[j] * mission.units.state[:, None]
        innovations = np.vstack([each.rows for each in spread.innovations[: j + 1]])
        command = lin.problem.gains_of(lin.iterate, j) @ innovations
        corrections.append(
            CorrectedBurn(
                burn=one.burn + 1 + scenario.burns_flown,
                cut_off_s=one.cut_off_s,
                gain=one.gains.tolist(),
                measurement_covariance=one.measurement_covariance.tolist(),
                predicted_covariance=(before @ before.T).tolist(),
                estimate_covariance=one.estimate_covariance.tolist(),
                sigma_m_s=float(speed * np.linalg.norm(command)),
            )
        )
    return StoredPolicy(corrections, *plan.commanded)


def policy_in(stored: StoredPolicy | None, burns_flown: int) -> Policy:
    """The stored policy in arrays; none where all burns are fixed."""
    return tuple(
        Correction(
            burn=c.burn - 1 - burns_flown,
            cut_off_s=c.cut_off_s,
            gains=np.array(c.gain),
            measurement_covariance=np.array(c.measurement_covariance),
            estimate_covariance=np.array(c.estimate_covariance),
        )
        for c in (stored.corrections if stored is not None else ())
    )


def sigmas(covariance: Array) -> tuple[float, float]:
    """Roots of the summed variances of position, m, and velocity, m/s, of a covariance (6, 6)."""
    variance = np.diag(covariance)
    return float(np.sqrt(variance[:3].sum())), float(np.sqrt(variance[3:].sum()))
