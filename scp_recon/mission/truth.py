"""The gravity that is flown where the planner's J2 is held against the truth."""

from __future__ import annotations

from scp_recon.environment.catalogue import packaged_body
from scp_recon.errors import InputError
from scp_recon.physics.harmonics import HarmonicField
from scp_recon.scenario.body import Body
from scp_recon.scenario.schema import Scenario

HARMONICS_DEGREE = 8
"""Of the packaged field: the paper's ground truth."""
FIELD_BODY, FIELD_GM_M3_S2 = "Bennu", 4.89044967462
"""Of the packaged field: Chesley et al. 2020."""
SAME_GM, SAME_J2 = 0.01, 0.1
"""How far a scenario's GM and J2 may be off the packaged field's, relative."""


def truth_field(scenario: Scenario) -> HarmonicField:
    """The field of `body.gravity_file` in full, else that of the packaged body to degree 8; SI.

    Raises:
        InputError: if the body has neither, or its GM, reference radius or J2 is not that of the
            packaged field: no other body's field is flown in its place.
    """
    body = scenario.body
    if body.gravity is not None:
        rows = body.gravity.coefficients
        degree = max(n for n, _, _, _ in rows)
        return HarmonicField.of_rows(body.gm_m3_s2, body.gravity.reference_radius_m, degree, rows)
    if packaged_body(body.name) is packaged_body(FIELD_BODY):
        field = HarmonicField.bennu(body.gm_m3_s2, HARMONICS_DEGREE)
        _check_is_packaged(body, field)
        return field
    raise InputError(
        "body.gravity_file",
        f"nothing for {body.name}",
        "must name a gravity field (.gfc, or a PDS SHA table) for harmonics of this body to be flown",
    )


def _check_is_packaged(body: Body, field: HarmonicField) -> None:
    j2 = -float(field.c[2, 0])
    for entry, given, expected, same in (
        (
            "gm_m3_s2",
            f"{body.gm_m3_s2:g}",
            f"within {100 * SAME_GM:g} % of {FIELD_GM_M3_S2:g}",
            abs(body.gm_m3_s2 - FIELD_GM_M3_S2) <= SAME_GM * FIELD_GM_M3_S2,
        ),
        (
            "reference_radius_m",
            f"{body.reference_radius_m:g}",
            f"{field.radius:g}",
            body.reference_radius_m == field.radius,
        ),
        (
            "j2",
            f"{body.j2:g}",
            f"within {100 * SAME_J2:g} % of {j2:g}",
            abs(body.j2 - j2) <= SAME_J2 * j2,
        ),
    ):
        if not same:
            raise InputError(
                "--truth harmonics",
                f"body.{entry} {given}",
                f"must be {expected}: the packaged gravity field is that of {FIELD_BODY}",
            )
