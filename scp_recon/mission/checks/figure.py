"""Whether the body's figure is one that turns about its shortest axis: J2 and semi-axes."""

from __future__ import annotations

from collections.abc import Iterator

from scp_recon.environment.catalogue import packaged_body
from scp_recon.mission.checks.given import Given
from scp_recon.scenario.warning import ScenarioWarning

SHORTEST = 1.02
"""How much longer than another the semi-axis along the pole may be: rounding of nearly round bodies."""
J2_MAX = 0.5
"""At the reference radius; Itokawa, twice as long as thick, has half of that."""
J2_SHARE, J2_SLACK = 0.4, 0.01
"""How far J2 may be off that of a homogeneous ellipsoid, as a share of the larger one, and at least.

Bennu's is 20 % above, and Eros' 13 %; C20 normalised in the place of J2 is sqrt(5) times too small.
"""


def semi_axes(given: Given) -> Iterator[ScenarioWarning]:
    """What turns freely ends turning about its shortest axis, which is body-fixed z."""
    radii = given.scenario.body.radii_m
    if radii is not None and radii[2] > SHORTEST * min(radii[:2]):
        yield ScenarioWarning.of(
            "body.radii_m",
            f"[{', '.join(f'{x:g}' for x in radii)}] m",
            "the shortest last would be no surprise, as bodies turn about it; are the axes in order?",
        )


def oblateness(given: Given) -> Iterator[ScenarioWarning]:
    """J2 is positive of what is flattened, and about that of a homogeneous ellipsoid of its radii.

    The latter is (a^2 + b^2 - 2 c^2) / (10 R^2) at a reference radius R. A packaged body's is known.
    """
    body = given.scenario.body
    if packaged_body(body.name) is not None:
        return
    text = f"{body.j2:g}"
    if not 0.0 <= body.j2 <= J2_MAX:
        yield ScenarioWarning.of(
            "body.j2",
            text,
            f"0 to {J2_MAX:g} would be no surprise; unnormalised, which is -sqrt(5) C20?",
        )
    elif body.radii_m is not None:
        a, b, c = body.radii_m
        even = (a * a + b * b - 2.0 * c * c) / (10.0 * body.reference_radius_m**2)
        if abs(body.j2 - even) > max(J2_SHARE * max(body.j2, even), J2_SLACK):
            yield ScenarioWarning.of(
                "body.j2",
                text,
                f"a homogeneous ellipsoid of body.radii_m has {even:.3g} at "
                f"{body.reference_radius_m:g} m; unnormalised, which is -sqrt(5) C20?",
            )
