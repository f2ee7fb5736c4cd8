"""Which files a format of export comes to, and how they are written: whole, beside each other."""

from __future__ import annotations

import re
from pathlib import Path

from scp_recon.exchange import ccsds, kernel_texts, kernels, table
from scp_recon.exchange.heading import Export
from scp_recon.files import write_atomically
from scp_recon.spacecraft.guidance import FlightPlan
from scp_recon.spacecraft.vehicle import Vehicle

FORMATS = ("oem", "spk", "ck", "csv", "parquet")
BINARY = (".bsp", "_body.bsp", ".bc")
TEXTS = {
    ".tls": kernel_texts.leap_seconds,
    ".tpc": kernel_texts.body_constants,
    ".tf": kernel_texts.frames,
    ".tsc": kernel_texts.clock,
}
NAME_MAX = 60


def stem(export: Export) -> str:
    """Of all names: scenario, first digits of the plan's hash, spacecraft."""
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", export.mission.scenario.name)[:NAME_MAX]
    return f"{name}_{export.solution.plan_hash[:8]}_{abs(export.ids.spacecraft)}"


def require(form: str) -> None:
    """Find out before the work whether a format's extra is there.

    Raises:
        InputError: if not.
    """
    if form in ("spk", "ck"):
        kernels.needing_spice()
    elif form == "parquet":
        table.needing_pyarrow()


def write_export(export: Export, form: str, folder: Path, vehicle: Vehicle) -> list[Path]:
    """Write a plan in a format.

    Args:
        export: the plan.
        form: of `FORMATS`.
        folder: which is there.
        vehicle: whose attitude a CK has.

    Returns:
        The files; of kernels the one to load comes first.

    Raises:
        InputError: if an extra is missing, or the vehicle cannot fly the plan.
        OSError: if a file cannot be written.
    """
    home = folder / stem(export)
    if form in ("spk", "ck"):
        return _kernels(export, form, home, vehicle)
    contents: dict[str, str | bytes] = {}
    if form == "oem":
        contents = {".oem": ccsds.oem_text(export), ".opm": ccsds.opm_text(export)}
    elif form == "csv":
        contents = {".csv": table.csv_text(export)}
    else:
        contents = {".parquet": table.parquet_bytes(export)}
    return [write_atomically(_named(home, end), content) for end, content in contents.items()]


def _kernels(export: Export, form: str, home: Path, vehicle: Vehicle) -> list[Path]:
    """The binary kernels, the texts that go with them, and the list of all that are there."""
    if form == "spk":
        kernels.write_spk(export, _named(home, ".bsp"))
        kernels.write_body_spk(export, _named(home, "_body.bsp"))
        written = [_named(home, ".bsp"), _named(home, "_body.bsp")]
    else:
        flight = FlightPlan.of(export.solution, export.mission, vehicle)
        kernels.write_ck(export, flight, _named(home, ".bc"))
        written = [_named(home, ".bc")]
    written += [write_atomically(_named(home, end), text(export)) for end, text in TEXTS.items()]
    there = [path for end in (*TEXTS, *BINARY) if (path := _named(home, end)).is_file()]
    listed = write_atomically(_named(home, ".tm"), kernel_texts.meta_kernel(export, there))
    return [listed, *written]


def _named(home: Path, end: str) -> Path:
    return home.with_name(home.name + end)
