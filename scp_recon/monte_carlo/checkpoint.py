"""Flights that were stopped, kept in a file to the last bit: they are continued, not flown again."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scp_recon.files import write_atomically
from scp_recon.monte_carlo.estimates import Tally
from scp_recon.monte_carlo.flights import FlightConfig, FlightTally
from scp_recon.monte_carlo.sampling import BLOCK
from scp_recon.solution.file import Solution

FILE_NAME = "montecarlo_partial.npz"
SCHEMA = "scp_recon.montecarlo_partial/1"

Arrays = dict[str, npt.NDArray[Any]]

TALLIES = ("entry", "exit", "closest", "executed_dv")
SUMS = ("terminal", "terminal_sum", "terminal_outer")


def keep_flights(flown: FlightTally, solution: Solution, folder: Path) -> Path:
    """Write what is flown so far, whole or not at all.

    Raises:
        OSError: if the folder cannot be written.
    """
    arrays: Arrays = {"key": np.array(_key(flown.config, solution))}
    arrays |= {"samples": np.array(flown.samples), "whole": np.array(flown.whole)}
    arrays |= {name: getattr(flown, name) for name in SUMS}
    for name in TALLIES:
        arrays |= _taken_apart(name, getattr(flown, name))
    for name, tally in flown.held.items():
        arrays |= _taken_apart(f"held/{name}", tally)
        arrays[f"full/{name}"] = np.array(flown.full[name])
    arrays |= {f"node_counts/{name}": counts for name, counts in flown.node_counts.items()}
    content = io.BytesIO()
    np.savez(content, **arrays)  # type: ignore[arg-type]
    return write_atomically(folder / FILE_NAME, content.getvalue())


def kept_flights(config: FlightConfig, solution: Solution, folder: Path) -> FlightTally | None:
    """What was flown of this very configuration by this version, in whole blocks; None if nothing was.

    A file that is damaged, or of other flights, counts as none.
    """
    try:
        content = io.BytesIO((folder / FILE_NAME).read_bytes())
        with np.load(content, allow_pickle=False) as file:
            arrays: Arrays = dict(file)
        if str(arrays["key"]) != _key(config, solution):
            return None
        return _put_together(arrays, config)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def forget_flights(folder: Path) -> None:
    """Delete the file: its flights are in a summary now."""
    (folder / FILE_NAME).unlink(missing_ok=True)


def _key(config: FlightConfig, solution: Solution) -> str:
    """What two flights have in common that may be counted together."""
    parts = (SCHEMA, solution.plan_hash, config.seed, config.truth, config.errors, BLOCK)
    return json.dumps([*parts, np.__version__])


def _taken_apart(name: str, tally: Tally) -> Arrays:
    return {
        f"{name}/counts": tally.counts,
        f"{name}/batch_means": np.array(tally.batch_means),
        f"{name}/batch_sizes": np.array(tally.batch_sizes, dtype=np.int64),
    }


def _put_together(arrays: Arrays, config: FlightConfig) -> FlightTally | None:
    flown = FlightTally(config)
    flown.samples, flown.whole = int(arrays["samples"]), int(arrays["whole"])
    if not flown.samples or flown.samples % BLOCK:
        return None

    def tally(name: str, empty: Tally) -> Tally:
        counts = arrays[f"{name}/counts"]
        if counts.shape != empty.counts.shape:
            raise ValueError(name)
        return replace(
            empty,
            counts=counts,
            batch_means=tuple(arrays[f"{name}/batch_means"].tolist()),
            batch_sizes=tuple(arrays[f"{name}/batch_sizes"].tolist()),
        )

    for name in SUMS:
        setattr(flown, name, arrays[name])
    for name in TALLIES:
        setattr(flown, name, tally(name, getattr(flown, name)))
    flown.held = {name: tally(f"held/{name}", empty) for name, empty in flown.held.items()}
    flown.full = {name: int(arrays[f"full/{name}"]) for name in flown.full}
    flown.node_counts = {
        key.removeprefix("node_counts/"): counts
        for key, counts in arrays.items()
        if key.startswith("node_counts/")
    }
    return flown
