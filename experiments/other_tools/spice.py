"""Compare the default plan's geometry with what SPICE finds from its exported kernels alone.

The plan is exported as SPK, with the kernels of body, frames and times, into OUT/kernels, and SPICE
loads their list. OUT/spice.csv has the largest difference of each quantity: states, rotation and the
Sun's direction at all nodes without a burn, the site's distance and angles at those of the window.
Needs the extra [spice].
"""

from __future__ import annotations

from contextlib import chdir
from pathlib import Path
from types import ModuleType

import numpy as np

from experiments.harness import Findings, Record, Session, Study, default_plan
from formulations.arrays import Array
from scp_recon.api.plan_verbs import export
from scp_recon.errors import imported
from scp_recon.interop.export import Export
from scp_recon.interop.kernels import frame_names
from scp_recon.physics import geometry


def run(session: Session) -> Findings:
    """Compare, with kernels in OUT."""
    return Findings({"spice": measure(session.out / "kernels")})


def measure(folder: Path) -> list[Record]:
    """Export to a folder, load and compare: rows."""
    spice = imported("spice", "spice", "spiceypy")
    files, found = export(default_plan(), "spk", folder)
    (listed,) = (path for path in files if path.suffix == ".tm")
    with chdir(listed.parent):  # from which it names the others
        spice.furnsh(listed.name)
    try:
        return compared(spice, found)
    finally:
        spice.kclear()


def compared(spice: ModuleType, found: Export) -> list[Record]:
    """Rows of the largest differences, the kernels loaded."""
    mission, body = found.mission, str(found.ids.body)
    _, fixed = frame_names(found)
    coasting = np.setdiff1d(np.arange(len(mission.times_s)), mission.burn_nodes)
    times, nodes = mission.times_s[coasting], np.array(found.solution.nodes.state)[coasting]
    ets = found.et(times)
    craft = str(found.ids.spacecraft)
    states = 1e3 * np.array([spice.spkezr(craft, et, "J2000", "NONE", body)[0] for et in ets])
    suns = np.array([spice.vhat(spice.spkpos("SUN", et, "J2000", "NONE", body)[0]) for et in ets])
    turns = np.array([spice.pxform(fixed, "J2000", et) for et in ets])
    ours = np.array([mission.rotation.body_to_j2000(time) for time in times])
    seen = np.isin(coasting, mission.window_nodes)
    track = geometry.track(mission.site, mission.rotation, times[seen])
    position, sun = nodes[seen, :3], mission.sun_direction(times[seen])
    to_craft = states[seen, :3] - turns[seen] @ mission.site.position_body
    normal = turns[seen] @ mission.site.normal_body

    def angle(a: Array, b: Array) -> Array:
        return np.array([spice.vsep(*pair) for pair in zip(a, b, strict=True)])

    off = {
        ("position", "m"): np.linalg.norm(states[:, :3] - nodes[:, :3], axis=1),
        ("velocity", "m/s"): np.linalg.norm(states[:, 3:] - nodes[:, 3:], axis=1),
        ("rotation of the body", "rad"): [
            spice.raxisa(one @ other.T)[1] for one, other in zip(turns, ours, strict=True)
        ],
        ("direction of the Sun", "rad"): angle(suns, mission.sun_direction(times)),
        ("distance from the site", "m"): np.linalg.norm(to_craft, axis=1)
        - geometry.distance(position, track),
        ("phase", "rad"): angle(to_craft, suns[seen]) - geometry.phase(position, track, sun),
        ("emission", "rad"): angle(to_craft, normal) - geometry.emission(position, track),
        ("incidence", "rad"): angle(normal, suns[seen]) - geometry.incidence(track, sun),
    }
    return [
        {"what": what, "unit": unit, "nodes": len(values), "off": float(np.abs(values).max())}
        for (what, unit), values in off.items()
    ]


STUDY = Study(__doc__, run)
