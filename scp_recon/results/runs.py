"""Make folders for runs without a folder given by the user, and point to the latest one.

`runs/NAME/UTC` holds one run. `runs/latest` points to the last finished one: a symbolic link, or if the
system has none a text file with the folder's path from `runs`.
"""

from __future__ import annotations

import os
import re
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from uuid import uuid4

from scp_recon.errors import option
from scp_recon.files import unwritable, write_atomically

RUNS, LATEST = Path("runs"), "latest"
NAME_MAX, POINTER_MAX = 80, 1000
"""Characters of a folder's name, and of a text file that points to one."""


def new_run(name: str, root: Path = RUNS) -> Path:
    """Make a new folder `root/NAME/UTC`; odd characters are replaced.

    Raises:
        InputError: if it cannot be made.
    """
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    home = root / _folder_name(name)
    try:
        for number in count(1):
            folder = home / (stamp if number == 1 else f"{stamp}-{number}")
            try:
                folder.mkdir(parents=True)
            except FileExistsError:
                continue
            break
    except OSError as error:
        raise unwritable(home, option("out"), error) from None
    return folder


def _folder_name(name: str) -> str:
    plain = re.sub(r"[^A-Za-z0-9._=+-]+", "_", name).strip("._")[:NAME_MAX]
    return f"{plain}_" if plain in ("", LATEST) else plain


def point_to(folder: Path, root: Path = RUNS) -> None:
    """Let `root/latest` point to a run's folder, atomically.

    A folder or a file of that name that is no pointer is renamed.

    Raises:
        InputError: if neither a link nor a file can be written.
    """
    latest, target = root / LATEST, os.path.relpath(folder, root)
    try:
        if latest.exists() and not latest.is_symlink() and resolve_run(latest) == latest:
            kept = new_run(f"{LATEST}_before", root)
            kept.rmdir()
            latest.rename(kept)
        beside = root / f".{LATEST}.{uuid4().hex}"
        try:
            beside.symlink_to(target, target_is_directory=True)
        except (OSError, NotImplementedError):  # a file system, or a user, without links
            write_atomically(latest, target + "\n")
        else:
            beside.replace(latest)
    except OSError as error:
        raise unwritable(root, f"{root}/{LATEST}", error) from None


def resolve_run(path: Path) -> Path:
    """The folder that a pointer leads to, or the path itself; resolve once to stay with one run."""
    try:
        if path.is_symlink() and path.is_dir():
            return path.parent / path.readlink()
        if path.name == LATEST and path.is_file() and path.stat().st_size <= POINTER_MAX:
            pointed = path.parent / path.read_text("utf-8").strip()
            return pointed if pointed.is_dir() else path
    except (OSError, ValueError):  # which the reader explains
        pass
    return path


def folder_of(path: Path) -> Path:
    """The folder for the results of a plan: its own, or that of its file."""
    home = resolve_run(path)
    return home if home.is_dir() else home.parent


def is_pointer(path: Path) -> bool:
    """Whether a path is the pointer `latest`, or where it will be: neither is a folder to write to."""
    here = path.absolute() == (RUNS / LATEST).absolute()
    return here or (path.name == LATEST and resolve_run(path) != path)
