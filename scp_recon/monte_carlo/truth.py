"""Whether a truth can be flown for a mission: the packaged gravity field is one body's."""

from __future__ import annotations

from scp_recon.errors import InputError
from scp_recon.monte_carlo.sampling import TruthModel
from scp_recon.physics.harmonics import HarmonicField
from scp_recon.scenario.schema import Scenario

FIELD_BODY, FIELD_GM_M3_S2 = "Bennu", 4.89044967462
"""Of the packaged field: Chesley et al. 2020."""
SAME_GM, SAME_J2 = 0.01, 0.1
"""How far a scenario's GM and J2 may be off the field's, relative."""


def check_truth(scenario: Scenario, truth: TruthModel) -> None:
    """Refuse to fly one body's field about another.

    Raises:
        InputError: if the harmonics are asked for and the body's name, GM, reference radius or J2 is
            not that of the packaged field.
    """
    if truth != "harmonics":
        return
    body = scenario.body
    field = HarmonicField.bennu(body.gm_m3_s2, 2)
    j2 = -float(field.c[2, 0])
    for entry, given, expected, same in (
        ("name", body.name, FIELD_BODY, body.name.casefold() == FIELD_BODY.casefold()),
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
