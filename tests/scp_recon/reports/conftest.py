"""Reports of the default plan, written once."""

from datetime import UTC, datetime
from pathlib import Path

import pytest

from scp_recon.monte_carlo.flights import fly_many
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.monte_carlo.summarise import summarise
from scp_recon.reports.page import Page
from scp_recon.reports.shown import Shown, plans_of
from scp_recon.reports.write import page_of, write_report
from tests.scp_recon.support import fly_few

MADE = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)


@pytest.fixture(scope="session")
def plan_folder(verified, tmp_path_factory) -> Path:
    """With flights of the plan beside it."""
    folder = tmp_path_factory.mktemp("plan")
    verified.write(folder)
    flown = fly_many(Flyer(verified.mission, verified.burns_m_s), samples=200)
    summarise(flown, verified).write(folder)
    return folder


@pytest.fixture(scope="session")
def shown(plan_folder) -> Shown:
    return plans_of([plan_folder])[0]


@pytest.fixture(scope="session")
def page(plan_folder) -> Page:
    """Of few flights, as the file is: what is tested depends not on their number."""
    with pytest.MonkeyPatch.context() as patch:
        fly_few(patch)
        return page_of(plans_of([plan_folder]), MADE)


@pytest.fixture(scope="session")
def html_file(plan_folder) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        fly_few(patch)
        return write_report([plan_folder], plan_folder / "report.html", now=lambda: MADE)
