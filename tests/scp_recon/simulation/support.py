"""A bare plant that flies without flight software."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from Basilisk.architecture import sysModel
from Basilisk.utilities import SimulationBaseClass, macros

from formulations.arrays import Array
from scp_recon.simulation.basilisk.plant import STEP_S, Plant


@dataclass(frozen=True)
class Hub:
    """State J2000 (6,), MRPs (3,) and rate in the body frame (3,)."""

    state: Array
    mrp: Array
    rate: Array


def coast(plant: Plant, times_s: Sequence[float] | Array, step_s: float = STEP_S) -> Iterator[Hub]:
    """Fly, and stop with the state of the hub at each of the ascending times."""
    sim = SimulationBaseClass.SimBaseClass()
    process = sim.CreateNewProcess("flight")
    process.addTask(sim.CreateNewTask("dynamics", macros.sec2nano(step_s)))
    models: Sequence[sysModel.SysModel] = (*plant.effectors, plant.hub)
    for model in models:
        sim.AddModelToTask("dynamics", model)
    sim.InitializeSimulation()
    for time in times_s:
        sim.ConfigureStopTime(macros.sec2nano(float(time)))
        sim.ExecuteSimulation()
        now = plant.hub.scStateOutMsg.read()
        yield Hub(
            np.array([*now.r_CN_N, *now.v_CN_N]), np.array(now.sigma_BN), np.array(now.omega_BN_B)
        )
