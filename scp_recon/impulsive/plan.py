"""Hold a problem's plan in the user's units, and fly it with errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from formulations.arrays import Array
from formulations.linearisation.dynamics import Dynamics
from formulations.problem.expression_flow import ExpressionFlow
from formulations.problem.flow import ScaledFlow
from formulations.rows.node_probability import joint_events
from scp_recon.errors import whole_number
from scp_recon.jobs.cores import one_thread
from scp_recon.monte_carlo.estimates import Estimate, proportion
from scp_recon.monte_carlo.flights import SAMPLES_MAX, SEED_MAX
from scp_recon.monte_carlo.sampling import BLOCK, NAVIGATION, draw
from scp_recon.planning.plan import StagedPlan, Unit
from scp_recon.scp.status import Status

QUANTILE = 0.99
"""Quantile of the flights' commanded delta-v."""
UNITS: dict[Unit, str] = {"m": "length", "m/s": "speed", "sigma": "sigma"}
"""Units of margins: of length or speed in the user's flow, or standard deviations."""


@dataclass(frozen=True, eq=False)
class ImpulsiveFlights:
    """Results of flights with errors, in the problem's units.

    Attributes:
        samples: their number.
        kept: probability that each region is kept at its worst node, by name.
        whole: probability that a flight keeps all regions at all nodes.
        commanded: delta-v commanded by each flight, shape (samples,).
        final: states after the last burn, shape (samples, 6).
    """

    samples: int
    kept: dict[str, Estimate]
    whole: Estimate
    commanded: Array
    final: Array

    @property
    def dv99(self) -> float:
        """99 % quantile of the commanded delta-v."""
        return float(np.quantile(self.commanded, QUANTILE))


@dataclass(frozen=True, eq=False, repr=False)
class ImpulsivePlan(StagedPlan):
    """Burns and states that solve an `ImpulsiveProblem`, or the last ones of its search.

    Attributes:
        dynamics: flow with burns, nondimensional.
        unit: of the state's components, shape (6,).
    """

    dynamics: Dynamics
    unit: Array

    @property
    def ok(self) -> bool:
        """Whether the last stage converged."""
        return self.status is Status.CONVERGED

    @property
    def iterations(self) -> int:
        """Number of iterations of all stages."""
        return sum(len(stage.result.records) for stage in self.stages)

    @property
    def cost(self) -> float:
        """Minimised cost in units of speed: the burns' sizes, or feedback's mean or quantile."""
        return self.final.result.lin.cost.value * float(self.unit[3])

    @cached_property
    def burns(self) -> Array:
        """Burns, shape (m, 3)."""
        return self.final.result.lin.iterate.burns * self.unit[3]

    @cached_property
    def states(self) -> Array:
        """Means at the nodes, after the burns, shape (n + 1, 6)."""
        return self.final.result.lin.iterate.mean * self.unit

    @cached_property
    def covariances(self) -> Array:
        """Covariances at the nodes, shape (n + 1, 6, 6)."""
        factor = self.final.result.lin.factor * self.unit[:, None]
        return np.asarray(factor @ factor.swapaxes(1, 2))

    @property
    def _units(self) -> dict[Unit, float]:
        return {"m": float(self.unit[0]), "m/s": float(self.unit[3]), "sigma": 1.0}

    @property
    def margins(self) -> dict[str, float]:
        """Least margin by region: a distance, or standard deviations where risk is exact."""
        stage, units = self.final, self._units
        names = {c.name for c in stage.merit.problem.constraints}
        return {
            name: float(margins.margin.min()) * units[stage.unit(name)]
            for name, margins in stage.margins.items()
            if name in names or name not in ("dv_max", "dv_battery")
        }

    @property
    def violations(self) -> dict[str, tuple[float, str]]:
        """Size and unit of each violation above the tolerance, the largest by constraint.

        "position" and "velocity" are those of states that the flow and the final state do not join.
        """
        stage, apart = self.final, np.abs(self.final.result.lin.defects).max(axis=0)
        amounts: list[tuple[str, float, Unit]] = [
            ("position", float(apart[:3].max()), "m"),
            ("velocity", float(apart[3:].max()), "m/s"),
        ]
        for name, amount in stage.merit.violations(stage.result.lin).items():
            if name != "dynamics":
                amounts.append((name, float(amount.max(initial=0.0)), stage.unit(name)))
        return {
            name: (size * self._units[unit], UNITS[unit])
            for name, size, unit in amounts
            if size > stage.tolerance
        }

    def __str__(self) -> str:
        """Status, cost, burns, violations and margins."""
        lines = [
            f"{self.final.problem}: {self.status.value.message}",
            f"cost {self.cost:.9g}, {self.iterations} iterations",
        ]
        for node, burn in zip(self.final.merit.problem.burn_nodes, self.burns, strict=True):
            lines.append(f"node {node:4}  " + "  ".join(f"{x:+.6e}" for x in burn))
        violated = {} if self.ok else self.violations
        lines += [f"{name}: violated by {size:.6g} ({of})" for name, (size, of) in violated.items()]
        for name, value in self.margins.items():
            lines.append(f"{name}: margin {value:+.6g} ({UNITS[self.final.unit(name)]})")
        return "\n".join(lines)

    def __repr__(self) -> str:
        """One line."""
        return f"<ImpulsivePlan: {self.status.value.name}, cost {self.cost:.9g}>"

    @one_thread
    def fly(
        self,
        samples: int = 10_000,
        seed: int = 0,
        report: Callable[[int], None] = lambda _: None,
    ) -> ImpulsiveFlights:
        """Fly the user's flow with errors drawn, and count the flights that keep the regions.

        `report` is called at times with the number of flights flown.

        Raises:
            InputError: if `samples` or `seed` is out of range.
        """
        samples = whole_number("samples", samples, 1, SAMPLES_MAX)
        seed = whole_number("seed", seed, 0, SEED_MAX)
        events = joint_events(self.final.merit.problem.constraints)
        counts = {event.name: np.zeros(len(event.nodes)) for event in events}
        whole, commanded, final = 0, [], []
        for first in range(0, samples, BLOCK):
            positions, own, last = self._fly(first // BLOCK, min(BLOCK, samples - first), seed)
            kept = np.full(len(own), fill_value=True)
            for event in events:
                at = positions[event.nodes]
                holds = np.logical_and.reduce(
                    [region.inside(at) >= 0.0 for region in event.keep_in]
                    + [region.inside(at) <= 0.0 for region in event.keep_out]
                )
                counts[event.name] += holds.sum(axis=1)
                kept &= holds.all(axis=0)
            whole += int(kept.sum())
            commanded.append(own)
            final.append(last)
            report(min(first + BLOCK, samples))
        worst = {name: proportion(int(some.min()), samples) for name, some in counts.items()}
        ends, own = np.concatenate(final) * self.unit, np.concatenate(commanded) * self.unit[3]
        return ImpulsiveFlights(samples, worst, proportion(whole, samples), own, ends)

    def _fly(self, block: int, flights: int, seed: int) -> tuple[Array, Array, Array]:
        """Positions (n + 1, flights, 3), commanded delta-v (flights,) and final states (flights, 6).

        Estimates are deviations from the plan, of the parameters too; a measurement is taken before a
        burn at its node.
        """
        lin = self.final.result.lin
        problem, flow, mean = lin.problem, self.dynamics.flow, lin.iterate.mean
        errors, feedback, burns = problem.execution_errors, problem.feedback, lin.iterate.burns
        columns = problem.initial_factor.shape[1]
        draws = draw(seed, block, columns + errors.draws(problem.n_burns))[:flights]
        state = problem.initial_state + draws[:, :columns] @ problem.initial_factor[:6].T
        if problem.parameters:
            assert isinstance(flow, ScaledFlow)
            assert isinstance(flow.flow, ExpressionFlow)
            deviations = problem.initial_factor[6:] @ draws[:, :columns].T
            values = flow.flow.parameters[:, None] + deviations
            flow = replace(flow, flow=flow.flow.with_parameters(values))
        draws, estimate = draws[:, columns:], np.zeros((flights, 6 + problem.parameters))
        known: list[Array] = []
        if feedback is not None:
            noise = draw(seed, block, 6 * len(feedback.burns), NAVIGATION)[:flights]
            noise = noise.reshape(flights, -1, 6)
        positions, total = np.empty((problem.n_nodes, flights, 3)), np.zeros(flights)
        for node in range(problem.n_nodes):
            if node > 0:
                state = flow.propagate(state, node - 1)
                estimate = estimate @ lin.stm_of_arcs[node - 1].T
            fired = np.flatnonzero(problem.burn_nodes == node)
            planned = mean[node].copy()
            planned[3:] -= burns[fired].sum(axis=0)
            if feedback is not None:
                for j in np.flatnonzero(feedback.cut_offs == node):
                    innovation = lin.spread.innovations[j]
                    measured = state - planned + noise[:, j] @ feedback.measurement[j].T
                    apart = measured - estimate[:, :6]
                    known.append(np.linalg.solve(innovation.root, apart.T).T)
                    estimate = estimate + known[-1] @ innovation.gain.T
            for burn in fired.tolist():
                command = np.tile(burns[burn], (flights, 1))
                if feedback is not None:
                    for j in np.flatnonzero(feedback.burns == burn):
                        gains = problem.gains_of(lin.iterate, int(j))
                        command += np.hstack(known[: j + 1]) @ gains.T
                own = errors.draws_of_burn(draws, burn)
                state[:, 3:] += errors.execute(command[:, None], own)[:, 0]
                estimate[:, 3:6] += command - burns[burn]
                total += np.linalg.norm(command, axis=1)
            positions[node] = state[:, :3]
        return positions, total, state
