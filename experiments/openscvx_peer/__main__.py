"""P3 in OpenSCvx, an outside peer: `python -m experiments.openscvx_peer`; needs the extra [peer].

Its own algorithm (PTR) and solver (QOCO) solve `openscvx_problem`; the burns that it ends with are
flown by the planner's dynamics, and judged on the planner's grid like the planner's own. The rows go
to OUT, from where `experiments.compare_solvers` takes them into its table and CSV.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint, parse, run_command

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import contextlib
import importlib.util
import io
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np
from rich.console import Console

from experiments.compare_solvers.__main__ import DEFAULT_OUT
from experiments.compare_solvers.cases import Cell, Method
from experiments.compare_solvers.report import peer_table
from experiments.compare_solvers.row import Row, empty_row
from experiments.compare_solvers.runs import PEER_NAME, version
from experiments.kept import Kept
from experiments.openscvx_peer.problem import pose
from formulations.problem.flyby import Iterate
from formulations.problem.regions import Array
from formulations.program.merit import MeritFunction
from formulations.rows.deterministic import DeterministicRows
from scp_recon.errors import InputError
from scp_recon.files import write_atomically
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.flights import FlightConfig, fly_many
from scp_recon.monte_carlo.observation_time import ALL
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import plan
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.scvx import SCvx

FLIGHTS = 2_000


@dataclass(frozen=True)
class Case:
    """How OpenSCvx is asked.

    Attributes:
        stride: of the grid's nodes outside the window that are kept.
        tolerance: of its integration, relative and absolute; None for its defaults, 1e-6 and 1e-3.
        lam_cost, lam_vc, lam_vb: weights of cost, virtual control and virtual buffer. The first two
            are 0.01 and 1 by default, the buffer's is zero.
        ep_tr: size of a step at which it stops, 1e-4 by default.
    """

    stride: int
    tolerance: float | None
    lam_cost: float
    lam_vc: float
    lam_vb: float
    ep_tr: float = 1e-4

    @property
    def algorithm(self) -> dict[str, float]:
        """Its options."""
        names = ("lam_cost", "lam_vc", "lam_vb", "ep_tr")
        return {name: getattr(self, name) for name in names}

    @property
    def method(self) -> Method:
        """Its name in the table."""
        nodes = "every node" if self.stride == 1 else f"every {self.stride}th node"
        tolerance = "default" if self.tolerance is None else f"{self.tolerance:g}"
        weights = " ".join(f"{value:g}" for value in self.algorithm.values())
        return Method(f"OpenSCvx, {nodes}, tolerance {tolerance}", f"ptr {weights}", "QOCO")


CASES = (
    Case(5, None, 1e-2, 1.0, 1.0),
    Case(5, 1e-10, 1e-2, 1.0, 1.0),
    Case(5, 1e-10, 1e-1, 10.0, 10.0),
    Case(5, 1e-10, 1e-1, 10.0, 10.0, ep_tr=1e-6),
    Case(1, 1e-10, 1e-1, 10.0, 10.0),
)


def peers_row(mission: Mission, start: Iterate, case: Case) -> Row:
    """Solve it in OpenSCvx, and fly the burns by the planner's dynamics."""
    import openscvx as ox

    begin, cpu_begin = perf_counter(), process_time()
    problem = pose(mission, start, case.stride)  # anew: its variables belong to one problem
    options: dict[str, Any] = {"algorithm": case.algorithm}
    if case.tolerance is not None:
        within = {"rtol": case.tolerance, "atol": case.tolerance}
        options["discretizer"] = {"diffrax_kwargs": within}
    with contextlib.redirect_stdout(io.StringIO()):  # it prints a table as it goes
        solver = ox.Problem(**problem.arguments, **options)
        solver.initialize()
        result = solver.solve()
    row = replace(
        _row(mission, case.method, np.asarray(result.nodes["burn"])[problem.burn_nodes]),
        status="converged" if result.converged else "not converged",
        iterations_p3=len(result.X) - 1,
    )
    return replace(row, total_s=perf_counter() - begin, cpu_s=process_time() - cpu_begin)


def our_row(mission: Mission, start: Iterate, algorithm: str, solver: str) -> Row:
    """P3 by the planner from the same guess."""
    begin = process_time()
    done = plan(mission, start, problem="P3", algorithm=algorithm, solver=solver)
    cpu_s, result = process_time() - begin, done.final.result
    return replace(
        _row(mission, Method("condensed", algorithm, solver), result.lin.iterate.burns),
        status=result.status.value.name,
        iterations_p3=len(result.records),
        total_s=done.total_s,
        cpu_s=cpu_s,
        solver_s=done.timing.conic_solver,
    )


def _row(mission: Mission, method: Method, burns: Array) -> Row:
    """What flown burns cost and violate of P3 on the planner's grid."""
    p, units, weights = mission.problem, mission.units, SCvx()
    mean = mission.dynamics.rollout(p.initial_state, burns)
    lin = mission.dynamics.linearise(p, Iterate(burns, mean))
    judge = MeritFunction(p, DeterministicRows(p))
    config = FlightConfig(mission, burns * units.speed_m_s)
    return replace(
        empty_row(Cell("matrix", "recon_b", (), method, "warm")),
        key=f"peer|{method.name}",
        group="peer",
        problem="P3",
        total_dv_m_s=lin.iterate.total_dv * units.speed_m_s,
        merit_m_s=judge(lin, weights.weight) * units.speed_m_s,
        heavy_merit_m_s=judge(lin, weights.weight_max) * units.speed_m_s,
        violation_m=judge.worst_violation(lin) * units.length_m,
        observed_s=fly_many(config, samples=FLIGHTS).held[ALL].mean().value,
        burns_m_s=tuple((burns * units.speed_m_s).ravel().tolist()),
        limit_s=np.inf,
        version=version(),
    )


def _as_kept(solve: Callable[[], Row]) -> dict[str, Any]:
    return asdict(solve())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line."""
    p = argparse.ArgumentParser(prog="python -m experiments.openscvx_peer", description=__doc__)
    p.add_argument("--out", type=Path, default=DEFAULT_OUT, metavar="DIR")
    options = parse(p, arguments)
    return run_command(lambda console: _run(options.out, console), options)


def _run(out: Path, console: Console) -> int:
    mission = Mission.from_scenario(load_scenario())
    start = initial_guess.ballistic(mission)
    if importlib.util.find_spec("openscvx") is None:
        raise InputError("the peer", "no OpenSCvx", "install the extra scp_recon[peer]")
    kept = Kept(out / f"{Path(PEER_NAME).stem}_partial.jsonl", __file__, {})
    methods = [
        partial(our_row, mission, start, "scvx", "CLARABEL"),
        partial(our_row, mission, start, "ptr", "QOCO"),
        *(partial(peers_row, mission, start, case) for case in CASES),
    ]
    rows: list[Row] = []
    for solved in methods:
        found = kept.row(str(len(rows)), partial(_as_kept, solved))
        rows.append(Row(**found | {"burns_m_s": tuple(found["burns_m_s"])}))
        console.print(f"{rows[-1].method}: {rows[-1].status}", highlight=False, markup=False)
    console.print("\n".join(peer_table(rows)), highlight=False, soft_wrap=True)
    lines = "".join(json.dumps(asdict(row)) + "\n" for row in rows)
    path = write_atomically(out / PEER_NAME, lines)
    kept.forget()
    console.print(f"written: {path}", highlight=False, soft_wrap=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
