"""The site's pages: what `make site` does not see by itself."""

import re
import urllib.error
import urllib.request
from pathlib import Path

import pytest

import scp_recon
from tests.helpers import nightly

PROJECT = Path(__file__).parents[1]
PAGES = [PROJECT / "README.md", *sorted((PROJECT / "docs").rglob("*.md"))]
EXTERNAL = sorted(
    {
        link
        for page in PAGES
        for link in re.findall(r"\]\((https://[^)#]+)", page.read_text("utf-8"))
    }
)


def test_every_public_name_is_on_the_page_of_python():
    page = (PROJECT / "docs" / "api.md").read_text("utf-8")
    assert sorted(re.findall(r"^::: scp_recon\.(\w+)$", page, re.MULTILINE)) == scp_recon.__all__


@nightly
@pytest.mark.parametrize("link", EXTERNAL)
def test_external_links_answer(link):
    request = urllib.request.Request(link, headers={"User-Agent": "Mozilla/5.0"})
    try:
        with urllib.request.urlopen(request, timeout=30) as answer:
            status = answer.status
    except urllib.error.HTTPError as error:
        status = error.code
    except OSError as error:
        pytest.skip(f"no network: {error}")
    assert status in {200, 403, 429}  # the last two: there, but not for programs
