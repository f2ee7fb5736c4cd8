"""The algorithms by the name that a solution file records."""

from __future__ import annotations

from collections.abc import Callable

from scp_recon.ptr import ProxLinear
from scp_recon.scp import Algorithm
from scp_recon.scvx import TrustRegion
from scp_recon.scvx_star import AugmentedLagrangian

ALGORITHMS: dict[str, Callable[[], Algorithm]] = {
    "scvx": TrustRegion,
    "ptr": ProxLinear,
    "scvx-star": AugmentedLagrangian,
}
