"""Options of `new` that start from a trajectory in another tool's file, and the draft they give."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from scp_recon.cli.options import date_utc, int_between
from scp_recon.draft.draft import Draft
from scp_recon.draft.flown import FlownDraft, Tables, Track, flown_draft
from scp_recon.environment.catalogue import packaged_body
from scp_recon.errors import InputError
from scp_recon.exchange.tracks import csv_track, cut, oem_track, spice_body, spice_track

SOURCES = ("from_spice", "from_oem", "from_csv")


def add_track_options(p: argparse.ArgumentParser) -> None:
    """Where the trajectory is, and which part of it."""
    p.add_argument(
        "--from-spice",
        type=Path,
        metavar="META",
        help="meta-kernel: body, Sun, boundary states and start from it, with --spacecraft, "
        "--from and --to (the extra [spice])",
    )
    p.add_argument(
        "--spacecraft",
        type=_number,
        metavar="ID",
        help="NAIF's number in the kernels, as --spacecraft=-64",
    )
    p.add_argument(
        "--from-oem",
        type=Path,
        metavar="FILE",
        help="CCSDS OEM: boundary states and start from it, --from and --to if given (the extra [oem])",
    )
    p.add_argument(
        "--from-csv",
        type=Path,
        metavar="FILE",
        help="table of states as solve --init takes it, its t_s past --epoch; the same",
    )
    for name, which in (("begin", "from"), ("end", "to")):
        p.add_argument(
            f"--{which}",
            dest=name,
            type=date_utc,
            metavar="UTC",
            help=f"{'first' if which == 'from' else 'last'} burn, UTC, e.g. 2020-01-21T20:32:08",
        )


def _number(text: str) -> int:
    if text.startswith("-"):
        return -int_between(1, 2**31 - 1)(text[1:])
    return int_between(1, 2**31 - 1)(text)


def source_of(options: argparse.Namespace) -> str | None:
    """The option that names a trajectory, if any does.

    Raises:
        InputError: if several do, or one lacks what it needs.
    """
    given = [name for name in SOURCES if getattr(options, name) is not None]
    flags = [f"--{name.replace('_', '-')}" for name in given]
    if len(given) > 1:
        raise InputError(", ".join(flags), "more than one", "must be one of them")
    needs = {
        "from_spice": {"spacecraft": "--spacecraft", "begin": "--from", "end": "--to"},
        "from_csv": {"epoch": "--epoch"},
    }.get(given[0] if given else "", {})
    missing = [flag for name, flag in needs.items() if getattr(options, name) is None]
    if missing:
        raise InputError(flags[0], f"no {', '.join(missing)}", f"needs {', '.join(missing)}")
    if not given and options.epoch is None:
        raise InputError("--epoch", "nothing", "must be given, or a trajectory to start from")
    if given and given[0] != "from_csv" and options.epoch is not None:
        raise InputError(
            "--epoch", options.epoch.isoformat(), f"must be left out: {flags[0]} has it"
        )
    return given[0] if given else None


def track_draft(
    options: argparse.Namespace, source: str, first: Callable[[], Draft]
) -> tuple[FlownDraft, Track]:
    """A draft about a trajectory, and the trajectory.

    Args:
        options: of the command line.
        source: `source_of` it.
        first: the draft before anything is designed, for a body that no kernel describes.

    Raises:
        InputError: if a file cannot be used, or there is no window with room for burns.
    """
    known: Tables = {}
    if source == "from_spice":
        packaged = packaged_body(options.body)
        number, radius, known = spice_body(
            options.from_spice, options.body, packaged, options.begin
        )
        span = options.begin, options.end
        track = spice_track(options.from_spice, options.spacecraft, number, span)
        name = Path(options.name).name
        draft = Draft(name, options.body, None, options.site, track.epoch, radius)
    else:
        packaged = packaged_body(options.body)
        center = str(packaged.entries["name"]) if packaged else options.body
        track = (
            oem_track(options.from_oem, center)
            if source == "from_oem"
            else csv_track(options.from_csv, options.epoch)
        )
        track = cut(track, options.begin, options.end)
        options.epoch = track.epoch  # at which --orbit and the meridian are
        draft = first()
    return flown_draft(replace(draft, epoch=track.epoch), known, track), track
