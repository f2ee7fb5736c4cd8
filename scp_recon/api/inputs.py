"""Read the inputs that functions share: scenarios, overrides and dates."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from scp_recon.errors import InputError, Named, option, shortened
from scp_recon.scenario.load import base_names, load_scenario, override, packaged_scenario
from scp_recon.scenario.schema import Scenario
from scp_recon.scenario.time_scales import tdb_of_utc


def scenario_of(given: Scenario | str | Path, overrides: Sequence[str] = ()) -> Scenario:
    """Read a scenario that is given as itself, by name, or by its file.

    Args:
        given: the scenario, its name, or its file.
        overrides: `section.entry=value` each.

    Raises:
        InputError: if `given` is none of these, or cannot be read.
    """
    check_overrides(overrides)
    if isinstance(given, Scenario):
        return override(given, overrides)
    if not isinstance(given, str | Path):
        raise InputError("scenario", shortened(given), "must be a scenario, its name, or a file")
    return load_scenario(given, overrides)


def scenarios() -> dict[str, Scenario]:
    """The packaged scenarios by name: `plan` takes recon_b, `design` the others.

    Returns:
        The scenarios by name.

    Examples:
        >>> import scp_recon as sr
        >>> sr.scenarios()["recon_b"]
        <Scenario recon_b: Bennu, site Nightingale, 4 burns>
    """
    return Named({name: packaged_scenario(name) for name in base_names()})


def check_overrides(given: object) -> None:
    """Refuse overrides that are not a list of `section.entry=value`.

    Raises:
        InputError: if they are not.
    """
    if isinstance(given, list | tuple) and all(isinstance(text, str) for text in given):
        return
    raise InputError(option("overrides"), shortened(given), "must be a list of section.entry=value")


def date_in_tdb(entry: str, given: datetime | str | None, *, utc: bool = False) -> datetime | None:
    """A date in TDB, converted from UTC if `utc`.

    Raises:
        InputError: if it is no date.
    """
    if given is None:
        return None
    try:
        date = given if isinstance(given, datetime) else datetime.fromisoformat(given)
        if utc:
            return tdb_of_utc(date)
        if date.tzinfo is not None:
            raise ValueError
    except (TypeError, ValueError) as error:
        scale = "UTC" if utc else "TDB, without a zone"
        reason = f", {error.allowed}" if isinstance(error, InputError) else ""
        allowed = f"must be a date and time such as 2020-01-21T20:33:17, {scale}{reason}"
        raise InputError(entry, shortened(given), allowed) from None
    return date
