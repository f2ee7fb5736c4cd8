"""Write and read the file of a simulated flight: arrays, a summary, and unmet requirements.

The summary is SI, with angles in degrees. `docs/simulation_file.md` describes both.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from pydantic import ConfigDict, Field
from scipy.spatial.transform import Rotation

from formulations.arrays import Array
from scp_recon.errors import InputError
from scp_recon.files import reason_of, write_atomically
from scp_recon.mission.schedule import Mode
from scp_recon.monte_carlo.sampling import PolicyKind
from scp_recon.physics import geometry
from scp_recon.physics.frames import unit
from scp_recon.results.read import File, parse_file
from scp_recon.results.solution import Solution
from scp_recon.scenario.fields import Line, Section
from scp_recon.simulation.flight import Flight
from scp_recon.simulation.guidance import CONTROL_PERIOD_S
from scp_recon.simulation.vehicle import Vehicle

FILE_NAME, SCHEMA = "simulation.npz", "scp_recon.simulation/1"
MARK = b"summary.npy"
"""Name of the summary in every such archive."""
SAMPLE_S = 10.0
EVERY = slice(None, None, round(SAMPLE_S / CONTROL_PERIOD_S))
MODES = tuple(Mode)
STEADY_RAD = np.deg2rad(0.25)
"""Attitude error in steady state."""

Arrays = dict[str, npt.NDArray[Any]]
Count = Annotated[int, Field(ge=0)]
Vector = tuple[float, float, float]
Shape = tuple[str | int, ...]
"""Shape of an array: numbers, and names of lengths that must be equal."""
Of = Callable[[Flight, Solution], npt.NDArray[Any]]


class ModeOutcome(Section):
    """A mode as commanded and as flown, against the least length that the schedule's rules require.

    Attributes:
        mode: its name.
        start_s: when it was commanded, past the epoch.
        duration_s: how long it was flown.
        required_s: least duration by the rules.
        ok: whether it was long enough, to a control period.
        settled_s: time from its start after which the attitude error stays below `STEADY_RAD` until its
            end, in delta-V mode until the burn; null if it never does.
        settled_in_time: whether that is as early as the rules assume.
    """

    mode: Line
    start_s: float
    duration_s: float
    required_s: float
    ok: bool
    settled_s: float | None
    settled_in_time: bool


class FlownBurn(Section):
    """A burn as planned and as executed, J2000.

    Attributes:
        t_s: time past the epoch.
        duration_s: of the thrust.
        planned_m_s: commanded velocity.
        executed_m_s: velocity that it added.
        pointing_deg: angle between the planned burn and the thrust, at the instant before it starts.
        executed_pointing_deg: angle between the planned and the executed one.
    """

    t_s: float
    duration_s: float
    planned_m_s: Vector
    executed_m_s: Vector
    pointing_deg: float
    executed_pointing_deg: float


class Angles(Section):
    """Mean and quantiles of an angle, degrees.

    Attributes:
        mean: of all samples.
        q50: median.
        q95: 95 % quantile.
        q997: 99.7 % quantile.
        q100: largest.
    """

    model_config = ConfigDict(validate_by_name=True)

    mean: float
    q50: float
    q95: float
    q997: Annotated[float, Field(alias="q99.7")]
    q100: float


class WindowPointing(Section):
    """Pointing errors of the camera in the observation window: from its command, and from the site.

    Attributes:
        camera: against its command.
        site: against the true line of sight.
    """

    camera: Angles
    site: Angles


class Energy(Section):
    """Energy totals of the bus, Wh.

    Attributes:
        generated: by the panels.
        consumed: by everything.
        lost: in charging and discharging.
        unused: when the batteries were full.
        short: when they were empty.
    """

    generated: float
    consumed: float
    lost: float
    unused: float
    short: float


class TerminalMiss(Section):
    """Distance from the planned final state.

    Attributes:
        position_m: in position.
        velocity_m_s: in velocity.
    """

    position_m: float
    velocity_m_s: float


class SimulatedDrift(Section):
    """The free drift after a burn that did not happen.

    Attributes:
        burn: its number, from 1.
        drift_s: time flown from the burn on.
        closest_m: least distance from the body's centre in that time.
        closest_t_s: when, past the epoch.
    """

    burn: Annotated[int, Field(ge=1)]
    drift_s: float
    closest_m: float
    closest_t_s: float

    def __str__(self) -> str:
        """In words."""
        return (
            f"drift: nearest to the centre in {self.drift_s / 3600.0:.3g} h after burn {self.burn} is "
            f"missed: {self.closest_m:.0f} m at {self.closest_t_s:.0f} s"
        )


class FlightSummary(File):
    """Summary of a simulated flight, with hashes of its plan and inputs.

    Attributes:
        vehicle: its name.
        seed: of the flight's errors.
        policy: that commanded the burns, "open", "replan" or "feedback".
        plan_hash: of the plan that was flown.
        inputs_sha256: digest of plan and vehicle.
        modes: names of the attitude modes; the array `mode` counts in them.
        legs: modes as they were flown, in order.
        burns: in order.
        window_pointing_deg: in the observation window.
        estimate_deg: error of the estimated attitude.
        least_charge: of any battery, 0 to 1.
        floor_charge: below which none may fall.
        energy_wh: totals.
        ledger_error: error of the energy balance, over the energy generated.
        dumps: how often momentum was dumped.
        terminal_miss: of the final state.
        within_3_sigma: share of the nodes whose position is within three sigma of the planned spread.
        largest_sigma_distance: of a node's position from the planned mean, in these sigmas.
        drift: after a burn that did not happen; absent if all did.
    """

    vehicle: Line
    seed: Count
    policy: PolicyKind
    plan_hash: Line
    inputs_sha256: Line
    modes: tuple[Line, ...]
    legs: tuple[ModeOutcome, ...]
    burns: tuple[FlownBurn, ...]
    window_pointing_deg: WindowPointing
    estimate_deg: Angles
    least_charge: float
    floor_charge: float
    energy_wh: Energy
    ledger_error: float
    dumps: Count
    terminal_miss: TerminalMiss
    within_3_sigma: float
    largest_sigma_distance: float
    drift: SimulatedDrift | None = None

    def entries(self) -> dict[str, Any]:
        """The summary as the file holds it."""
        return {"schema": SCHEMA, **self.model_dump(mode="json", by_alias=True)}


def _quaternions(attitudes: Rotation) -> Array:
    return attitudes[EVERY].as_quat(canonical=True, scalar_first=True)


def _modes(flight: Flight) -> npt.NDArray[np.int8]:
    """Number of the mode in `MODES` at each sample."""
    mode = np.zeros(len(flight.times_s), dtype=np.int8)
    for leg in flight.plan.legs:
        mode[flight.times_s >= leg.start_s] = MODES.index(leg.mode)
    return mode[EVERY]


def _means(values: Array) -> Array:
    """Mean over the control periods of each sample, shape (samples, ...)."""
    starts = np.arange(0, len(values), EVERY.step)
    lengths = np.diff(starts, append=len(values))
    return np.add.reduceat(values, starts) / lengths[:, None]


ARRAYS: dict[str, tuple[Shape, Of]] = {
    "t_s": (("samples",), lambda f, _: f.times_s[EVERY]),
    "state": (("samples", 6), lambda f, _: f.states[EVERY]),
    "attitude": (("samples", 4), lambda f, _: _quaternions(f.attitudes)),
    "command": (("samples", 4), lambda f, _: _quaternions(f.commands)),
    "estimate": (("samples", 4), lambda f, _: _quaternions(f.estimates)),
    "rate_rad_s": (("samples", 3), lambda f, _: f.rates_rad_s[EVERY]),
    "mode": (("samples",), lambda f, _: _modes(f)),
    "actuators": (("samples",), lambda f, _: f.in_use[EVERY]),
    "wheel_speed_rad_s": (("samples", "wheels"), lambda f, _: f.wheel_speeds_rad_s[EVERY]),
    "wheel_torque_n_m": (("samples", 3), lambda f, _: _means(f.wheel_torque)),
    "thruster_torque_n_m": (("samples", 3), lambda f, _: _means(f.thruster_torque)),
    "panel_w": (("samples", "panels"), lambda f, _: f.power.panels_w[EVERY]),
    "panel_peak_w": (("panels",), lambda f, _: f.plan.panels.peak_w),
    "consumed_w": (("samples",), lambda f, _: f.power.consumed_w[EVERY]),
    "state_of_charge": (("samples", "batteries"), lambda f, _: f.state_of_charge[EVERY]),
    "pointing_error_rad": (("seconds",), lambda f, _: f.attitude_error.astype(np.float32)),
    "node_state": (("nodes", 6), Flight.node_states),
    "node_sigma_distance": (("nodes",), Flight.sigma_distance),
}
"""Arrays of a file of this schema: the shape of each, and a function of a flight."""


@dataclass(frozen=True)
class Record:
    """A simulation file: arrays by name, and the summary.

    Attributes:
        arrays: by name, as docs/simulation_file.md lists them.
        summary: of the flight.
    """

    arrays: Arrays
    summary: FlightSummary

    def __repr__(self) -> str:
        """One line."""
        return f"<Record of a simulated flight: {', '.join(self.arrays)}>"

    @property
    def plan_hash(self) -> str:
        """`Solution.plan_hash` of the plan flown."""
        return self.summary.plan_hash


def inputs_digest(solution: Solution, vehicle: Vehicle) -> str:
    """SHA-256 of plan and vehicle: flights with equal digests differ by the seed alone."""
    inputs = {"plan_hash": solution.plan_hash, "vehicle": vehicle.model_dump(mode="json")}
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()


def make_record(flight: Flight, solution: Solution, seed: int) -> Record:
    """Make the record of a solution's flight, its errors drawn with a seed."""
    plan, distance = flight.plan, flight.sigma_distance(solution)
    miss = flight.terminal_state - np.array(solution.nodes.state[-1])
    summary = FlightSummary(
        vehicle=plan.vehicle.name,
        seed=seed,
        policy=flight.policy,
        plan_hash=solution.plan_hash,
        inputs_sha256=inputs_digest(solution, plan.vehicle),
        modes=tuple(mode.value for mode in MODES),
        legs=tuple(leg_outcomes(flight)),
        burns=tuple(_burns(flight)),
        window_pointing_deg=_window_pointing(flight),
        estimate_deg=_quantiles(
            np.asarray((flight.estimates.inv() * flight.attitudes).magnitude())
        ),
        least_charge=float(flight.state_of_charge.min()),
        floor_charge=plan.vehicle.battery.floor_charge,
        energy_wh=Energy(**flight.power.totals_wh),
        ledger_error=flight.power.ledger_error,
        dumps=flight.dumps,
        terminal_miss=TerminalMiss(
            position_m=float(np.linalg.norm(miss[:3])),
            velocity_m_s=float(np.linalg.norm(miss[3:])),
        ),
        within_3_sigma=float((distance <= 3.0).mean()),
        largest_sigma_distance=float(distance.max()),
        drift=_drift(flight),
    )
    return Record({name: of(flight, solution) for name, (_, of) in ARRAYS.items()}, summary)


def _drift(flight: Flight) -> SimulatedDrift | None:
    """The drift of a flight after a missed burn."""
    if flight.miss is None:
        return None
    times, start = flight.times_s, flight.plan.firings[flight.miss - 1].start_s
    distance = np.where(times < start, np.inf, np.linalg.norm(flight.states[:, :3], axis=1))
    at = int(np.argmin(distance))
    return SimulatedDrift(
        burn=flight.miss,
        drift_s=float(times[-1] - start),
        closest_m=float(distance[at]),
        closest_t_s=float(times[at]),
    )


def leg_outcomes(flight: Flight) -> Iterator[ModeOutcome]:
    """Outcomes of all modes after the first burn, whose attitude is acquired before the start."""
    plan, times = flight.plan, flight.times_s
    rules, window = plan.mission.scenario.schedule, plan.mission.schedule.window_s
    steady_s = {
        Mode.SUN_POINTING: rules.recharge_s,
        Mode.OBSERVATION: window[1] - window[0],
        Mode.DELTA_V: rules.heating_s,
    }
    for leg in plan.legs[1:]:
        required = rules.attitude_s + steady_s[leg.mode]
        burn = next((f.start_s for f in plan.firings if f.end_s == leg.end_s), leg.end_s)
        error = flight.attitude_error[(times >= leg.start_s) & (times < burn)]
        settling = CONTROL_PERIOD_S * int(np.flatnonzero(np.append(True, error >= STEADY_RAD))[-1])
        settled = settling if settling < CONTROL_PERIOD_S * len(error) else None
        duration = leg.end_s - leg.start_s
        yield ModeOutcome(
            mode=leg.mode.value,
            start_s=leg.start_s,
            duration_s=duration,
            required_s=required,
            ok=bool(duration >= required - CONTROL_PERIOD_S),
            settled_s=settled,
            settled_in_time=settled is not None and settled <= rules.attitude_s,
        )


def _burns(flight: Flight) -> Iterator[FlownBurn]:
    """Every burn as planned and as executed; a burn of zero errs by no angle."""
    thrust = unit(flight.plan.vehicle.chemical_thruster.direction)
    for firing, executed in zip(flight.plan.firings, flight.burns_m_s, strict=True):
        start = flight.attitudes[round(firing.start_s / CONTROL_PERIOD_S)].apply(thrust)
        off, turned = np.rad2deg(geometry.angle(np.stack([start, executed]), firing.direction))
        yield FlownBurn(
            t_s=firing.start_s,
            duration_s=firing.duration_s,
            planned_m_s=tuple(firing.dv_m_s.tolist()),
            executed_m_s=tuple(executed.tolist()),
            pointing_deg=float(off) if firing.duration_s else 0.0,
            executed_pointing_deg=float(turned) if executed.any() else 0.0,
        )


def _window_pointing(flight: Flight) -> WindowPointing:
    """Angles of the boresight with its command and with the true line of sight, in the window."""
    mission, camera = flight.plan.mission, unit(flight.plan.vehicle.sensors.camera)
    first, last = mission.schedule.window_s
    window = (flight.times_s >= first) & (flight.times_s < last)
    boresight = flight.attitudes[window].apply(camera)
    track = geometry.track(mission.site, mission.rotation, flight.times_s[window])
    return WindowPointing(
        camera=_quantiles(geometry.angle(boresight, flight.commands[window].apply(camera))),
        site=_quantiles(geometry.angle(track.position - flight.states[window, :3], boresight)),
    )


def _quantiles(angle: Array) -> Angles:
    """Mean and quantiles in degrees."""
    degrees = np.rad2deg(angle)
    q50, q95, q997, q100 = np.quantile(degrees, [0.5, 0.95, 0.997, 1.0]).tolist()
    return Angles(mean=float(degrees.mean()), q50=q50, q95=q95, q997=q997, q100=q100)


def write_record(record: Record, folder: Path) -> Path:
    """Write `simulation.npz`, or that of a missed burn, into a folder, whole or not at all.

    Raises:
        OSError: if the folder cannot be written.
    """
    buffer = io.BytesIO()
    text = np.array(json.dumps(record.summary.entries()))
    np.savez_compressed(buffer, allow_pickle=False, summary=text, **record.arrays)
    miss = record.summary.drift.burn if record.summary.drift else None
    return write_atomically(folder / file_name(miss), buffer.getvalue())


def file_name(miss: int | None) -> str:
    """Name of the file of a flight, of one in which a burn is missed if a number is given."""
    return FILE_NAME if miss is None else FILE_NAME.replace(".", f"_miss_{miss}.")


def read_record(path: Path) -> Record:
    """Read a simulation file, or the one in a folder.

    Raises:
        InputError: if there is none, or it is damaged or of another version.
    """
    file = path / FILE_NAME if path.is_dir() else path
    if file.is_fifo():  # NumPy reads it more than once
        raise InputError(f"simulation {file}", "a pipe", "must be a file")
    try:
        with file.open("rb") as stream, zipfile.ZipFile(stream):
            pass  # or it is no archive, of which NumPy has other readers
        with np.load(file, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files if name != "summary"}
            summary = json.loads(str(data["summary"]))
    except OSError as error:
        raise InputError(
            f"simulation {file}", reason_of(error), "must be a readable file"
        ) from None
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(
            f"simulation {file}", str(error)[:80], "must be a simulation file"
        ) from None
    parsed = parse_file(summary, FlightSummary, SCHEMA, f"simulation {file}")
    lengths = dict[str | int, int]()
    for name, (shape, _) in ARRAYS.items():
        if not _fits(arrays, name, lengths):
            given = f"must be finite numbers of shape ({', '.join(map(str, shape))})"
            raise InputError(f"simulation {file}: {name}", "missing or malformed", given)
    return Record(arrays, parsed)


def _fits(arrays: Arrays, name: str, lengths: dict[str | int, int]) -> bool:
    """Whether an array is there, finite, and of the right shape with the lengths of those before."""
    shape, array = ARRAYS[name][0], arrays.get(name)
    if array is None or array.dtype.kind not in "fiu" or array.ndim != len(shape):
        return False
    expected = [
        side if isinstance(side, int) else lengths.setdefault(side, length)
        for side, length in zip(shape, array.shape, strict=True)
    ]
    return list(array.shape) == expected and array.size > 0 and bool(np.isfinite(array).all())
