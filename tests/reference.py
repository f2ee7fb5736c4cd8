"""Figures from outside the project that the tests hold it against, each with its source.

They are numbers, and of long tables a dozen rows. Nothing of the project computes them.
"""

from pathlib import Path
from typing import Any

Numbers = tuple[float, ...]

EPOCH_TDB = "2020-01-21T20:33:17.184"
"""Derived: 13140 s later, Echigo et al.'s start of the window, the site's incidence limit opens.

With NAIF's `bennu_v16.tpc`; 20:32:08 UTC, uncertain by five seconds.
"""

EPOCH_ET = 632_910_797.184
"""The same in TDB seconds past J2000: 7324 days, 30797.184 s past noon."""

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

ORIENTATION_AT_EPOCH: dict[str, Any] = {
    "meridian_deg": 317.611311,
    "spin_rate_rad_s": 0.00040626827857858,
    "period_h": 4.29600179,
    "pole": (0.03913937, 0.49301886, -0.8691378),
    "body_to_j2000": (
        (-0.7826418066832778, -0.621240623395161, 0.03913936988668434),
        (-0.5256467331571385, 0.6932733313965231, 0.4930188636305861),
        (-0.3334176275375415, 0.3652836922420139, -0.8691377968016802),
    ),
}
"""What the kernel comes to at the epoch, by a computation apart from the project's."""


def write_bennu_kernel(folder: Path) -> Path:
    """A text kernel of Bennu's orientation, for SPICE."""
    meridian = " ".join(repr(number) for number in PRIME_MERIDIAN)
    lines = (
        "KPL/PCK",
        "\\begindata",
        f"BODY{BENNU}_POLE_RA = ( {POLE_RA_DEG!r} 0. 0. )",
        f"BODY{BENNU}_POLE_DEC = ( {POLE_DEC_DEG!r} 0. 0. )",
        f"BODY{BENNU}_PM = ( {meridian} )",
        "\\begintext",
    )
    path = folder / "bennu.tpc"
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

SUN_TO_BODY_KM = (151091819.0, -4888099.83, -3401500.27)
SUN_TO_BODY_KM_S = (-4.30313922, 26.81106478, 15.16848766)
"""Geometric heliocentric state at the epoch, J2000."""

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

SUN_NORTH_TO_J2000 = (
    (-0.99922417, 0.03922284, -0.00355358),
    (0.03232675, 0.8683759, 0.49485177),
    (0.02249534, 0.49435298, -0.86897013),
)
"""At the epoch, by a computation apart from the project's."""

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


ARC_COLUMNS = ("t", "x", "y", "z", "vx", "vy", "vz")
ARC_ANGLES = ("d_site", "emission", "phase", "incidence", "lst")
ARC: tuple[Numbers, ...] = (
    (0, -114.5897, -748.6234, -893.5295, -0.02126401, 0.06475727, -0.01840018,
     1121.417, 92.6160, 92.2755, 50.5012, 12.0739),
    (2880, -173.7985, -552.9610, -934.2410, -0.01971319, 0.07099807, -0.00952940,
     1124.843, 114.0417, 85.0256, 85.9303, 16.5454),
    (5820, -228.2454, -336.1489, -946.2304, -0.01713969, 0.07622853, 0.00176505,
     1021.308, 98.0716, 73.2917, 128.8394, 21.1101),
    (8760, -273.3932, -106.8301, -921.6108, -0.01335685, 0.07931460, 0.01533919,
     848.888, 61.2628, 64.2632, 124.7827, 1.6747),
    (11640, -304.9730, 122.1619, -856.1204, -0.00836021, 0.07906530, 0.03034525,
     719.889, 27.5128, 65.9617, 81.1927, 6.1462),
    (14520, -320.4231, 344.3829, -746.3254, -0.00220654, 0.07445924, 0.04584413,
     668.592, 22.7496, 71.8800, 49.3100, 10.6177),
    (17400, -317.0537, 546.3774, -593.3644, 0.00459175, 0.06503105, 0.05997746,
     655.040, 29.3967, 68.1594, 71.5148, 15.0892),
    (20340, -293.4456, 718.0606, -399.8247, 0.01136775, 0.05118036, 0.07095893,
     708.156, 58.5769, 58.9886, 117.1339, 19.6539),
    (23220, -252.2078, 842.8793, -185.5002, 0.01705801, 0.03530316, 0.07706627,
     853.668, 97.6839, 61.8864, 134.0752, 0.1254),
    (26100, -196.6108, 921.2815, 39.5795, 0.02128682, 0.01927227, 0.07852468,
     997.409, 119.5980, 74.0222, 97.1053, 4.5969),
    (29040, -129.6288, 955.5398, 267.8125, 0.02403203, 0.00437518, 0.07619941,
     1045.469, 104.6573, 85.7023, 55.2626, 9.1616),
    (31980, -56.6176, 949.3366, 485.1245, 0.02543760, -0.00817162, 0.07131086,
     1018.457, 71.0117, 90.6278, 59.8196, 13.7262),
    (34842, 16.9190, 911.3710, 680.6828, 0.02581108, -0.01797940, 0.06519767,
     1056.879, 66.0032, 88.2062, 102.6576, 18.1698),
)  # fmt: skip
"""Seconds from the epoch, state in J2000 (m, m/s), distance from the site (m), angles (deg), hour.

Not the flight: the printed positions in the Sun-North frame, joined in the field of degree 10 with the
Sun's tide and light pressure.
"""
