"""A plan as data: its stages, how it was made, and what it says in SI."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from html import escape

import numpy as np
import numpy.typing as npt

from formulations.problem.flyby import Iterate
from scp_recon.mission.mission import Mission
from scp_recon.planning.provenance import Certificate, Parent, Provenance, Starts
from scp_recon.planning.stage import Stage, Unit, scale
from scp_recon.scp.loop import Timing
from scp_recon.scp.status import Status

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Plan:
    """The stages of planning a mission; `final` holds the answer.

    A plan is data: it pickles and copies, its arrays are read-only, and it equals another one of the
    same scenario, provenance, certificate and parent that went through the same stages to the same
    flight, to the last bit. Timings do not count. A solver that was kept from an earlier plan may
    differ in the last digits from a new one, and so may their plans.
    """

    mission: Mission
    provenance: Provenance
    stages: tuple[Stage, ...]
    final: Stage
    timing: Timing
    total_s: float
    aim: float | None = None
    certificate: Certificate | None = None
    starts: Starts | None = None
    parent: Parent | None = None

    def __eq__(self, other: object) -> bool:
        """Whether another plan is the same but for the time it took."""
        if not isinstance(other, Plan):
            return NotImplemented
        return self._identity == other._identity

    def __hash__(self) -> int:
        """Of the burns."""
        return hash(self.final.result.lin.iterate.burns.tobytes())

    def __getstate__(self) -> dict[str, object]:
        """Its fields; a copy computes the cached arrays again, read-only too."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def status(self) -> Status:
        """How it ended."""
        return self.final.result.status

    @property
    def times_s(self) -> Array:
        """Times of the nodes past the epoch, s, shape (n,)."""
        return _read_only(self.mission.times_s.view())

    @cached_property
    def burns_m_s(self) -> Array:
        """Burns, J2000, m/s, shape (m, 3)."""
        return _read_only(self.final.result.lin.iterate.burns * self.mission.units.speed_m_s)

    @cached_property
    def states(self) -> Array:
        """Mean states at the nodes, J2000 and body-centred, m and m/s, shape (n, 6).

        After the burn where one falls on the node.
        """
        return _read_only(self.final.result.lin.iterate.mean * self.mission.units.state)

    @cached_property
    def covariances(self) -> Array:
        """Covariances at the nodes in the same units, shape (n, 6, 6)."""
        factor = self.final.result.lin.factor * self.mission.units.state[:, None]
        return _read_only(factor @ factor.transpose(0, 2, 1))

    @property
    def total_dv_m_s(self) -> float:
        """Sum of the burns' sizes, m/s."""
        return float(np.linalg.norm(self.burns_m_s, axis=1).sum())

    @cached_property
    def worst_margins(self) -> dict[str, tuple[float, Unit]]:
        """The smallest margin of each constraint with its unit; >= 0 where it holds."""
        found = {}
        for name, margins in self.final.margins.items():
            unit = self.final.unit(name)
            found[name] = float(margins.margin.min()) * scale(self.mission, unit), unit
        return found

    def __str__(self) -> str:
        """Status and what may help, delta-v, burns, margins and warnings."""
        scenario, outcome = self.mission.scenario, self.status.value
        problem = self.final.problem
        lines = [
            f"{scenario.name}, {problem}: {outcome.message} {outcome.remedy}".rstrip(),
            f"total delta-v {self.total_dv_m_s:.6f} m/s, asked p_chance {scenario.risk.p_chance:g}",
            "burn   time s      x m/s      y m/s      z m/s   size m/s",
        ]
        for number, (time, burn) in enumerate(
            zip(scenario.burn_times_s, self.burns_m_s, strict=True), start=1 + scenario.burns_flown
        ):
            cells = "".join(f" {component:+10.6f}" for component in burn)
            lines.append(f"{number:4} {time:8g}{cells} {np.linalg.norm(burn):10.6f}")
        lines.append(f"{'constraint':20} worst margin")
        lines += [
            f"{name:20} {round(margin, 4) + 0.0:+12.4f} {unit}"
            for name, (margin, unit) in self.worst_margins.items()
        ]
        if self.starts is not None:
            lines.append(f"local optima of {self.starts.number} starts, seed {self.starts.seed}")
            lines += [f"  {optimum}" for optimum in self.starts.optima]
        lines += [f"warning: {warning}" for warning in self.mission.warnings]
        return "\n".join(lines)

    def __repr__(self) -> str:
        """One line."""
        name, dv = self.mission.scenario.name, self.total_dv_m_s
        return f"<Plan {name}: {self.status.value.name}, {dv:.6f} m/s>"

    def _repr_html_(self) -> str:
        """For a notebook."""
        return f"<pre>{escape(str(self))}</pre>"

    @property
    def _identity(self) -> tuple[object, ...]:
        runs = [
            (s.name, s.result.status, len(s.result.records), *_to_the_bit(s.result.lin.iterate))
            for s in (*self.stages, self.final)
        ]
        made = self.provenance, self.aim, self.certificate, self.starts, self.parent
        return self.mission.scenario, made, runs


def as_interrupted(plan: Plan) -> Plan:
    """The plan marked as interrupted: the best that was found when Ctrl-C came."""
    result = replace(plan.final.result, status=Status.INTERRUPTED)
    return replace(plan, final=replace(plan.final, result=result))


def _to_the_bit(iterate: Iterate) -> tuple[bytes, bytes]:
    return iterate.burns.tobytes(), iterate.mean.tobytes()


def _read_only(array: Array) -> Array:
    array.setflags(write=False)
    return array
