"""Write CCSDS 502.0-B-2 messages in key-value notation: OEM (path, covariances) and OPM (burns).

An OEM has a segment for each coast, so that no interpolation crosses a burn. Segments meet at the
burn's epoch. An OEM cannot hold burns, so an OPM holds them as manoeuvres. Units are the
standard's: km, km/s, kg, s.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime

import numpy as np

from formulations.arrays import Array
from scp_recon.interop.export import Export, heading, maker
from scp_recon.interop.path import Coast
from scp_recon.physics.two_body import Orbit
from scp_recon.scenario.time_scales import iso_tdb

KM = 1e-3
AXES = ("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")
FRAME = "EME2000"
"""Name of SPICE's J2000, whose axes are the ICRF's: docs/frames.md says why not ICRF."""
UNITS = ("km",) * 3 + ("km/s",) * 3
CUBIC = 3


def oem_text(export: Export) -> str:
    """The plan's path and covariances: TIME_SYSTEM TDB, REF_FRAME EME2000, km and km/s."""
    lines = [*_header("OEM", export), ""]
    for number, coast in enumerate(export.path.coasts):
        lines += [*_segment(export, number, coast), ""]
    return "\n".join(lines)


def opm_text(export: Export) -> str:
    """Text of an OPM: state before the first burn, orbit, covariance, spacecraft, burns."""
    craft, before = export.mission.scenario.spacecraft, export.path.coasts[0]
    epoch = iso_tdb(export.instant(0.0))
    lines = [
        *_header("OPM", export),
        *_object(export),
        f"EPOCH = {epoch}",
        *(
            f"{axis} = {x:.15e} [{unit}]"
            for axis, x, unit in zip(AXES, KM * before.states[-1], UNITS, strict=True)
        ),
        *_keplerian(before.states[-1], export.mission.forces.gm),
        f"MASS = {craft.mass_kg:.15e} [kg]",
        f"SOLAR_RAD_AREA = {craft.srp_area_m2:.15e} [m**2]",
        f"SOLAR_RAD_COEFF = {craft.reflectivity_coefficient:.15e}",
        f"COV_REF_FRAME = {FRAME}",
    ]
    for row, name in enumerate(AXES):
        entries = KM**2 * before.covariances[-1][row, : row + 1]
        lines += [
            f"C{name}_{other} = {x:.15e} [{_unit(name, other)}]"
            for other, x in zip(AXES[: row + 1], entries, strict=True)
        ]
    for number, burn in export.executed:
        lines += [
            f"COMMENT burn {number}; the mass is not modelled",
            f"MAN_EPOCH_IGNITION = {iso_tdb(export.instant(burn.t_s))}",
            "MAN_DURATION = 0.0 [s]",
            "MAN_DELTA_MASS = 0.0 [kg]",
            f"MAN_REF_FRAME = {FRAME}",
            *(f"MAN_DV_{i} = {KM * x:.15e} [km/s]" for i, x in enumerate(burn.dv_m_s, start=1)),
        ]
    return "\n".join(lines) + "\n"


def _keplerian(state: Array, gm: float) -> list[str]:
    """Lines of the osculating orbit and GM; no lines for a parabola or a radial fall."""
    orbit = Orbit.of(state[:3], state[3:], gm)
    if np.isinf(orbit.axis) or not orbit.normal.any():
        return []
    angles = np.rad2deg(orbit.angles(state[:3]))
    names = "INCLINATION", "RA_OF_ASC_NODE", "ARG_OF_PERICENTER", "TRUE_ANOMALY"
    return [
        f"SEMI_MAJOR_AXIS = {KM * orbit.axis:.15e} [km]",
        f"ECCENTRICITY = {np.linalg.norm(orbit.eccentricity):.15e}",
        *(f"{name} = {x:.15e} [deg]" for name, x in zip(names, angles, strict=True)),
        f"GM = {KM**3 * gm:.15e} [km**3/s**2]",
    ]


def _header(kind: str, export: Export) -> list[str]:
    return [
        f"CCSDS_{kind}_VERS = 2.0",
        *(f"COMMENT {line}" for line in heading(export)),
        f"CREATION_DATE = {datetime.now(UTC):%Y-%m-%dT%H:%M:%S}",
        f"ORIGINATOR = {maker().partition(' ')[0].upper()}",
    ]


def _object(export: Export) -> list[str]:
    return [
        f"OBJECT_NAME = {plain_name(export.mission.scenario.name)}",
        f"OBJECT_ID = {export.ids.spacecraft}",
        f"CENTER_NAME = {plain_name(export.mission.scenario.body.name)}",
        f"REF_FRAME = {FRAME}",
        "TIME_SYSTEM = TDB",
    ]


def _segment(export: Export, number: int, coast: Coast) -> list[str]:
    epochs = [iso_tdb(export.instant(time)) for time in coast.times_s.tolist()]
    last, burn = len(export.path.coasts) - 1, export.burns_flown + number
    ends = [f"begins after burn {burn}"] if number else []
    ends += [f"ends before burn {burn + 1}"] if number < last else []
    return [
        "META_START",
        f"COMMENT {' and '.join(ends)}",
        *_object(export),
        f"START_TIME = {epochs[0]}",
        f"STOP_TIME = {epochs[-1]}",
        "INTERPOLATION = HERMITE",
        f"INTERPOLATION_DEGREE = {CUBIC}",
        "META_STOP",
        *(
            f"{epoch} {_numbers(KM * state)}"
            for epoch, state in zip(epochs, coast.states, strict=True)
        ),
        "COVARIANCE_START",
        *_covariances(epochs, coast.covariances),
        "COVARIANCE_STOP",
    ]


def _covariances(epochs: Sequence[str], matrices: Array) -> Iterable[str]:
    """Lower triangles, km^2, km^2/s and km^2/s^2."""
    for epoch, matrix in zip(epochs, KM**2 * matrices, strict=True):
        yield f"EPOCH = {epoch}"
        yield f"COV_REF_FRAME = {FRAME}"
        yield from (_numbers(row[: i + 1]) for i, row in enumerate(matrix))


def _unit(row: str, column: str) -> str:
    """Unit of an entry of the covariance."""
    return ("km**2", "km**2/s", "km**2/s**2")[row.count("_DOT") + column.count("_DOT")]


def _numbers(values: Array) -> str:
    return " ".join(f"{value:.15e}" for value in values.tolist())


def plain_name(name: str) -> str:
    """A name in capitals, digits and underscores, which other tools accept."""
    return "".join(c if c.isascii() and c.isalnum() else "_" for c in name).upper() or "UNNAMED"
