"""Cases that cost nothing, and such as misbehave; few modules, for the processes that run them."""

from __future__ import annotations

import ctypes
import os
import signal
import time
from collections.abc import Mapping
from dataclasses import dataclass

from scp_recon.campaign.rows.case import Case, Found
from scp_recon.errors import InputError


@dataclass(frozen=True)
class Quick:
    """Takes a moment, and depends on seed and changes to the last bit."""

    takes_s: float = 0.0

    @property
    def columns(self) -> Mapping[str, type]:
        return {"status": str, "value": float, "message": str}

    def __call__(self, case: Case, /) -> Found:
        time.sleep(self.takes_s)
        value = (case.seed % 1_000_003) / 7.0 * float(case.changes["x"])
        return Found({"status": "converged", "value": value})


@dataclass(frozen=True)
class Naughty(Quick):
    """Some of its cases hang, eat, die, end or raise."""

    ways: tuple[tuple[int, str], ...] = ()

    def __call__(self, case: Case, /) -> Found:
        way = dict(self.ways).get(case.number)
        if way == "hang":  # in C, where no exception of Python's gets it
            ctypes.PyDLL(None).sleep(1000)
        elif way == "eat":
            return Found({"status": "converged", "value": float(len(bytearray(10**10)))})
        elif way == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        elif way == "end":
            raise SystemExit(3)
        elif way == "raise":
            raise ZeroDivisionError("in\nthe case")
        elif way == "refuse":
            raise InputError("x", "0", "must be more")
        return super().__call__(case)


ENDS = {
    "hang": "timed out",
    "eat": "out of memory",
    "die": "died",
    "end": "failed",
    "raise": "failed",
    "refuse": "refused",
}
