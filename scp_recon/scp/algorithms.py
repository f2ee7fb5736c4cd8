"""The algorithms by the name that a solution file records."""

from __future__ import annotations

from collections.abc import Callable

from scp_recon.scp.loop import Algorithm
from scp_recon.scp.ptr import PTR
from scp_recon.scp.scvx import SCvx
from scp_recon.scp.scvx_star import SCvxStar

ALGORITHMS: dict[str, Callable[..., Algorithm]] = {
    "scvx": SCvx,
    "ptr": PTR,
    "scvx-star": SCvxStar,
}
