"""What positions and burns have to keep in or out of, as the 3-D view shows it on demand."""

from __future__ import annotations

import numpy as np

from scp_recon.mission.constraints import observation_limits
from scp_recon.physics.frames import unit
from scp_recon.report.content import palette
from scp_recon.report.content.subject import Subject
from scp_recon.report.view import solids
from scp_recon.report.view.frame import Frame
from scp_recon.report.view.solids import Solid
from scp_recon.report.view.traces import Trace, mesh, moved


def keep_sets(frame: Frame, subject: Subject) -> list[Trace]:
    """What positions have to keep in or out of, of the first plan; shown on demand."""
    mission = subject.mission
    scenario, site = mission.scenario, mission.site
    limits = {limit.name: limit.value for limit in observation_limits(scenario)}
    distances = limits["site_distance_min"], limits["site_distance_max"]
    emissions = limits["emission_min"], limits["emission_max"]
    keep_in = solids.shell(site.normal_body, site.position_body, distances, emissions)
    sun = frame.seen(mission.sun_direction(float(np.mean(mission.schedule.window_s))))
    keep_out = max(limits["phase_min"], limits["battery_observation"])
    phase = solids.cone(sun, np.zeros(3), keep_out, distances[1])
    safety = solids.sphere(scenario.safety.radius_min_m)
    traces = [
        mesh(safety, "keep out: safety radius", "keep out: safety radius", palette.KEEP_OUT, 0.16),
        moved(
            mesh(
                keep_in,
                "keep in: distance and emission, in the window",
                "keep in: distance and emission",
                palette.KEEP_IN,
                0.22,
            ),
            "body",
        ),
        moved(
            mesh(
                phase,
                "keep out: phase and battery, in the window",
                "keep out: phase and battery cone",
                palette.KEEP_OUT,
                0.22,
            ),
            "site",
        ),
        _burn_cones(frame, subject),
    ]
    if "phase_max" in limits:
        most = solids.cone(sun, np.zeros(3), limits["phase_max"], distances[1])
        name = "keep in: phase at most"
        traces.append(moved(mesh(most, name, name, palette.KEEP_IN, 0.22), "site"))
    return [trace | {"visible": False} for trace in traces]


def _burn_cones(frame: Frame, subject: Subject) -> Trace:
    """The double cone about the Sun line that every burn keeps out of."""
    mission, burns = subject.mission, subject.solution.burns
    times = np.array([burn.t_s for burn in burns])
    angle = float(np.deg2rad(mission.scenario.battery.delta_v_cone_deg))
    parts = [
        solids.cone(side * unit(frame.seen(sun)), at, angle, frame.arrow_m)
        for at, sun in zip(
            frame.seen(subject.positions(times)), mission.sun_direction(times), strict=True
        )
        for side in (1.0, -1.0)
    ]
    name = "keep out: burns' battery cones"
    return mesh(Solid.joined(parts), name, name, palette.KEEP_OUT, 0.22)
