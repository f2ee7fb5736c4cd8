"""Read the project's JSON files strictly by their schema, above all the solution file of a run.

A solution's times, nodes and units are checked against its scenario. An edited file is read as not
verified. Files of older schemas are refused.

Without a folder given by the user, `runs/NAME/UTC` holds one run. `runs/latest` points to the last
finished one: a symbolic link, or if the system has none a text file with the folder's path from `runs`.
"""

from __future__ import annotations

import json
import os
import re
from dataclasses import fields, replace
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any, TypeVar
from uuid import uuid4

import numpy as np
from pydantic import ConfigDict, TypeAdapter, ValidationError

from scp_recon.errors import InputError, option
from scp_recon.files import read_text, unwritable, write_atomically
from scp_recon.results.facts import Facts, adapter
from scp_recon.results.figures import Figures, strange_parts
from scp_recon.results.solution import FILE_NAME, HASH, SCHEMA, Solution
from scp_recon.scenario.fields import ScenarioWarning, Section
from scp_recon.scp.status import Status

RUNS, LATEST = Path("runs"), "latest"
NAME_MAX, POINTER_MAX = 80, 1000
"""Characters of a folder's name, and of a text file that points to one."""


class File(Section):
    """The whole content of a file, strict; keys that a later version added are ignored."""

    model_config = ConfigDict(extra="ignore")


FileKind = TypeVar("FileKind", bound=File)


def read_file(path: Path, kind: type[FileKind], schema: str, noun: str) -> FileKind:
    """Read a file of a schema; messages use the noun.

    Raises:
        InputError: if the file is missing, damaged or of another version.
    """
    return parse_file(read_json(path, noun), kind, schema, f"{noun} {path}")


def parse_file(data: Any, kind: type[FileKind], schema: str, named: str) -> FileKind:
    """Validate parsed JSON, as `read_file` does; messages call it by its name."""
    _check_schema(data, schema, named)
    return _validated(TypeAdapter(kind), data, named)


def read_json(path: Path, noun: str) -> Any:
    """Parse a file of JSON; messages call it by the noun.

    Raises:
        InputError: if the file is missing, or is not JSON.
    """
    text = read_text(path, f"{noun} {path}", f"{noun} file in JSON")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        reason = f"no JSON ({error})"
        raise InputError(f"{noun} {path}", reason, f"must be a {noun} file") from None


def _check_schema(data: Any, schema: str, named: str) -> None:
    if not isinstance(data, dict) or data.get("schema") != schema:
        given = data.get("schema", "no schema") if isinstance(data, dict) else "no object"
        raise InputError(named, repr(given)[:80], f"schema must be {schema!r}")


def _validated(kind: TypeAdapter[Any], data: Any, named: str) -> Any:
    try:
        # Through JSON again: strict fields such as tuples and dates read from it as written to it.
        return kind.validate_json(json.dumps(data))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        entry = ".".join(str(part) for part in first["loc"])
        given = "nothing" if first["type"].startswith("missing") else repr(first["input"])[:80]
        raise InputError(f"{named}: {entry}", given, first["msg"]) from None


# --- solutions ----------------------------------------------------------------------------------


def read_solution(path: Path) -> Solution:
    """Read a solution file, or the one in a folder; `runs/latest` is that of the last finished run.

    A file is read as not verified, with a warning, if its scenario, burns or corrections were
    changed after it was written: its verification then belongs to another plan. Its figures are
    computed from its facts; `verify` compares those that the file carries.

    Raises:
        InputError: if the file is missing, damaged, of another version, or its parts contradict
            each other.
    """
    path = resolve_run(path)
    file = path / FILE_NAME if path.is_dir() else path
    data = read_json(file, "solution")
    solution = parse_solution(data, f"solution {file}")
    try:
        Status.named(solution.status)
    except ValueError:
        allowed = ", ".join(status.value.name for status in Status)
        raise InputError(
            f"solution {file}: status", repr(solution.status), f"must be one of {allowed}"
        ) from None
    try:
        solution.mission  # noqa: B018  resolved once, here
    except InputError as error:
        raise InputError(f"solution {file}: {error.entry}", error.given, error.allowed) from None
    if strange := _strange(solution):
        raise InputError(
            f"solution {file}: {strange[0]}", "what contradicts its scenario", "must be of one plan"
        )
    if data.get(HASH) != solution.plan_hash:
        return _edited(solution, file)
    return solution


def parse_solution(data: Any, named: str) -> Solution:
    """Parse the content of a file of this schema, without checks against its scenario.

    Keys that a later version added are ignored.

    Raises:
        InputError: if it is of another version or damaged.
    """
    _check_schema(data, SCHEMA, named)
    data = dict(data)
    carried = {each.name: data.pop(each.name) for each in fields(Figures) if each.name in data}
    known = {each.name: data[each.name] for each in fields(Facts) if each.name in data}
    figures = _validated(adapter(Figures), carried, named)
    facts = _validated(adapter(Facts), known, named)
    return Solution(**vars(facts), carried=figures)


def _edited(solution: Solution, file: Path) -> Solution:
    """The solution of a file that was edited: not verified, and with a warning."""
    word = ScenarioWarning.of(
        f"solution {file}",
        "a scenario, burns or corrections that were changed after it was written",
        "expected those it was planned with: its margins are of another plan",
    )
    checked = solution.verification
    if checked is not None:
        checked = replace(checked, ok=False, failed=list(dict.fromkeys([HASH, *checked.failed])))
    return replace(solution.with_verification(checked), warnings=(*solution.warnings, word))


def _strange(solution: Solution) -> list[str]:
    """Entries that contradict the scenario's grid or units by more than machines differ."""
    assert solution.carried is not None
    units, expected, facets = solution.carried.units, solution.units, solution.facets
    found = strange_parts(solution.mission, solution)
    if facets is not None and max(facets.node, default=0) >= len(solution.mission.times_s):
        found.append("facets.node")
    if not np.allclose([units.length_m, units.time_s], [expected.length_m, expected.time_s]):
        found.append("units")
    return found


# --- folders of runs ----------------------------------------------------------------------------


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
