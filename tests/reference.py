"""Figures from outside the project that the tests hold it against, each with its source.

They are numbers, and of long tables a dozen rows. Nothing of the project computes them.
"""

from collections.abc import Sequence
from pathlib import Path

Numbers = tuple[float, ...]

EPOCH_ET = 632_910_797.184
"""The epoch, 2020-01-21T20:33:17.184 TDB, in seconds past J2000."""

PRINTED_STATES = {
    "initial_state": (70.2, -1096.3, 406.4, -0.0047, -0.0167, 0.0278),
    "final_state": (19.9, 1128.7, -140.9, 0.0003, 0.0496, -0.0457),
}
"""Boundary states of Reconnaissance B, m and m/s: table of the numerical parameters."""

PRINTED_SITE_NORMAL = (0.394316, 0.565411, 0.724448)
"""Normal of Nightingale in the body's frame: the same table."""

BENNU = 2101955
"""NAIF's number of Bennu."""

POLE_RA_DEG, POLE_DEC_DEG = 85.46097, -60.3586
PRIME_MERIDIAN = (140.68835, 2011.145755336826, 1.815e-6)
"""W in deg and its polynomial in TDB days past J2000."""


def write_bennu_kernel(folder: Path, body: int = BENNU, more: Sequence[str] = ()) -> Path:
    """A text kernel of Bennu's orientation, for SPICE; or of another body that turns as it does."""
    meridian = " ".join(repr(number) for number in PRIME_MERIDIAN)
    lines = (
        "KPL/PCK",
        "\\begindata",
        f"BODY{body}_POLE_RA = ( {POLE_RA_DEG!r} 0. 0. )",
        f"BODY{body}_POLE_DEC = ( {POLE_DEC_DEG!r} 0. 0. )",
        f"BODY{body}_PM = ( {meridian} )",
        *more,
        "\\begintext",
    )
    path = folder / f"{body}.tpc"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


GM_M3_S2, REFERENCE_RADIUS_M = 4.89044967462, 290.0
GRAVITY_DEGREE = 10
COEFFICIENTS: dict[tuple[int, int], tuple[float, float]] = {
    (2, 0): (-1.9261012209376163e-02, 0.0),
    (2, 2): (3.0649946415261201e-03, -1.0945039957394799e-03),
    (3, 0): (1.2219404640668086e-03, 0.0),
    (3, 1): (8.1489212173874322e-04, -5.4345799774780962e-04),
    (4, 0): (6.4960018368895632e-03, 0.0),
    (4, 4): (7.7484811507055277e-04, 2.2464919895245237e-03),
    (5, 3): (-2.1852446688049215e-06, -9.4628559091672446e-06),
    (6, 0): (-1.3718245820512308e-03, 0.0),
    (7, 5): (-1.1470777236382891e-04, -1.7631867901106520e-05),
    (8, 0): (6.8157843924782058e-04, 0.0),
    (9, 2): (8.7884097451286990e-05, -6.2603387395283844e-05),
    (10, 10): (-3.2422729846573093e-05, 6.4237288305565024e-05),
}
"""A dozen of the 63: degree and order to fully normalised (4 pi) C and S in the body's frame."""


SUN_DISTANCE_AU = 1.01077061

SUN_DIRECTIONS: tuple[Numbers, ...] = (
    (632908800.0, -0.999208235, 0.032678493, 0.022694030),
    (632912400.0, -0.999236841, 0.032044422, 0.022335853),
    (632916000.0, -0.999264924, 0.031410168, 0.021977570),
    (632919600.0, -0.999292482, 0.030775730, 0.021619182),
    (632923200.0, -0.999319517, 0.030141110, 0.021260688),
    (632926800.0, -0.999346026, 0.029506308, 0.020902089),
    (632930400.0, -0.999372011, 0.028871323, 0.020543384),
    (632934000.0, -0.999397470, 0.028236156, 0.020184575),
    (632937600.0, -0.999422402, 0.027600808, 0.019825661),
    (632941200.0, -0.999446809, 0.026965279, 0.019466642),
    (632944800.0, -0.999470688, 0.026329569, 0.019107519),
    (632948400.0, -0.999494040, 0.025693678, 0.018748291),
)
"""TDB seconds past J2000, and the unit vector from Bennu to the Sun, J2000; hourly."""


STATES_FROM_SUN_NORTH = {
    "initial_state": (-114.59, -748.623, -893.529, 0.003943, -0.000897, -0.032519),
    "final_state": (24.887, 911.055, 680.862, 0.001808, 0.020466, 0.064239),
}
"""The printed states taken from that frame into J2000, m and m/s."""

DEPARTURE_M_S = 0.0717
"""First impulse of the ballistic arc between them; an independent prototype, field of degree 10."""

SITE_LATITUDE_DEG, SITE_LONGITUDE_DEG = 55.9, 41.8
"""Where OSIRIS-REx touched: Lauretta et al. 2022, from memory."""

SITE_BODY_M = (91.393, 81.715, 181.075)
"""On 14,744 facets of that shape (geodesyNets, `bennu_raw`)."""
