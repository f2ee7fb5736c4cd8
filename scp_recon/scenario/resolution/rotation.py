"""Pole and spin from a kernel, the catalogue, or a period and the prime meridian at the epoch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from scp_recon.environment.catalogue import PackagedBody
from scp_recon.environment.kernels import read_pck
from scp_recon.environment.surface import direction_of
from scp_recon.errors import InputError
from scp_recon.scenario.resolution.agreement import angle_deg, check, fill, has, lacks

POLE = ("pole_ra_deg", "pole_dec_deg")
MERIDIAN = (
    "prime_meridian_deg",
    "prime_meridian_rate_deg_day",
    "prime_meridian_acceleration_deg_day2",
)
POLE_TOLERANCE_DEG, MERIDIAN_TOLERANCE_DEG, RATE_TOLERANCE = 0.1, 0.1, 1e-4
"""Within these, what is given as well is taken for the same: of angles, and as a share of the rate."""


def resolve_rotation(body: dict[str, Any], known: PackagedBody | None, days: float | None) -> None:
    """Enter pole and W0, W1, W2.

    A period of P hours is W1 = 360 * 24 / P and W2 = 0; an angle W at the epoch, d days past J2000, is
    W0 = W - W1 d - W2 d^2.

    Args:
        body: table to enter them in.
        known: the packaged body of that name.
        days: TDB past J2000 of the epoch, None if unknown.

    Raises:
        InputError: if a kernel cannot be used, or entries contradict one another.
    """
    if has(body, "pck_file") and days is not None:
        _from_kernel(body, days)
    if known is not None:
        if lacks(body, *POLE):
            fill(body, {key: known.entries[key] for key in POLE})
        if lacks(body, *MERIDIAN, "rotation_period_h"):
            spin = MERIDIAN if lacks(body, "prime_meridian_at_epoch_deg") else MERIDIAN[1:]
            fill(body, {key: known.entries[key] for key in spin})
    if has(body, "rotation_period_h"):
        rate = 360.0 * 24.0 / body["rotation_period_h"]
        fill(body, {MERIDIAN[1]: rate, MERIDIAN[2]: 0.0})
        given = body[MERIDIAN[1]]
        near = abs(given - rate) <= RATE_TOLERANCE * abs(rate)
        check(
            f"body.{MERIDIAN[1]}",
            given,
            near,
            rate,
            f"body.rotation_period_h, to {RATE_TOLERANCE:g}",
        )
    if has(body, "prime_meridian_at_epoch_deg", MERIDIAN[1]) and days is not None:
        fill(body, {MERIDIAN[2]: 0.0})
        turned = body[MERIDIAN[1]] * days + body[MERIDIAN[2]] * days**2
        at_epoch = body["prime_meridian_at_epoch_deg"]
        fill(body, {MERIDIAN[0]: (at_epoch - turned) % 360.0})
        _check_meridian(at_epoch, body, days, "prime_meridian_at_epoch_deg")


def _from_kernel(body: dict[str, Any], days: float) -> None:
    if not has(body, "naif_id"):
        raise InputError("body.naif_id", "nothing", "must be NAIF's number of the body in pck_file")
    kernel = read_pck(Path(body["pck_file"]), body["naif_id"], days)
    pole = kernel.pole_ra_deg, kernel.pole_dec_deg
    if has(body, *POLE):
        given = body[POLE[0]], body[POLE[1]]
        apart = angle_deg(direction_of(given[1], given[0]), direction_of(pole[1], pole[0]))
        why = f"the pole in pck_file, to {POLE_TOLERANCE_DEG:g} deg"
        check("body.pole_ra_deg, pole_dec_deg", given, apart <= POLE_TOLERANCE_DEG, pole, why)
    fill(body, dict(zip(POLE, pole, strict=True)))
    if lacks(body, *MERIDIAN, "rotation_period_h", "prime_meridian_at_epoch_deg"):
        fill(body, dict(zip(MERIDIAN, kernel.prime_meridian, strict=True)))
    elif has(body, *MERIDIAN):
        w0, w1, w2 = kernel.prime_meridian
        _check_meridian(w0 + w1 * days + w2 * days**2, body, days, "pck_file")
    else:
        raise InputError(
            "body.pck_file", body["pck_file"], "must stand alone, or beside all of W0, W1 and W2"
        )
    if kernel.radii_m is not None and lacks(body, "radii_m"):
        body["radii_m"] = list(kernel.radii_m)


def _check_meridian(at_epoch: float, body: dict[str, Any], days: float, source: str) -> None:
    w0, w1, w2 = (body[key] for key in MERIDIAN)
    given = (w0 + w1 * days + w2 * days**2) % 360.0
    apart = abs((given - at_epoch + 180.0) % 360.0 - 180.0)
    check(
        "body.prime_meridian_deg",
        f"{given:.6g} deg at the epoch",
        apart <= MERIDIAN_TOLERANCE_DEG,
        f"{at_epoch % 360.0:.6g} deg",
        f"by body.{source}, to {MERIDIAN_TOLERANCE_DEG:g} deg",
    )
