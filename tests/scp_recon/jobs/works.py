"""Work that costs nothing, and such as misbehaves; few modules, for the processes that run it."""

import ctypes
import os
import signal
import time
from dataclasses import dataclass
from typing import Any

from scp_recon.errors import InputError


@dataclass(frozen=True)
class Quick:
    """Takes a moment, and depends on its input to the last bit."""

    takes_s: float = 0.0

    def __call__(self, number: int, /) -> dict[str, Any]:
        time.sleep(self.takes_s)
        return {"value": (number * 0x9E3779B97F4A7C15 % 1_000_003) / 7.0 * 0.1}


@dataclass(frozen=True)
class Naughty(Quick):
    """Some of its jobs hang, spin, eat, die, end or raise."""

    ways: tuple[tuple[int, str], ...] = ()

    def __call__(self, number: int, /) -> dict[str, Any]:
        way = dict(self.ways).get(number)
        if way == "hang":  # in C, where no exception of Python's gets it
            ctypes.PyDLL(None).sleep(1000)
        elif way == "spin":
            while True:
                pass
        elif way == "eat":
            return {"value": len(bytearray(10**10))}
        elif way == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        elif way == "end":
            raise SystemExit(3)
        elif way == "raise":
            raise ZeroDivisionError("in\nthe job")
        elif way == "raise oddly":
            raise OddError(1, 2)
        elif way == "refuse":
            raise InputError("x", "0", "must be more")
        return super().__call__(number)


class OddError(Exception):
    """Cannot be made again from its arguments."""

    def __init__(self, one: int, other: int) -> None:
        super().__init__(f"{one} and {other}")


ENDS = {
    "hang": "timed out",
    "spin": "timed out",
    "eat": "out of memory",
    "die": "died",
    "end": "failed",
    "raise": "failed",
    "raise oddly": "failed",
    "refuse": "refused",
}
