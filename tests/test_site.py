"""The site's pages: what `make site` does not see by itself."""

import re
import shutil
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from functools import cache
from pathlib import Path

import pytest

import scp_recon
from tests.helpers import nightly

PROJECT = Path(__file__).parents[1]
PAGES = [*sorted(PROJECT.glob("*.md")), *sorted((PROJECT / "docs").rglob("*.md"))]
EXTERNAL = sorted(
    {
        link
        for page in PAGES
        for link in re.findall(r"\]\((https://[^)#]+)", page.read_text("utf-8"))
    }
)


def test_api_page_has_every_public_name():
    page = (PROJECT / "docs" / "api.md").read_text("utf-8")
    assert sorted(re.findall(r"^::: scp_recon\.(\w+)$", page, re.MULTILINE)) == scp_recon.__all__


@cache
def on_line() -> bool:
    """Whether this machine finds a host by its name."""
    try:
        socket.getaddrinfo("github.com", 443)
    except OSError:
        return False
    return True


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
        if not on_line():
            pytest.skip(f"no network: {error}")
        raise
    assert status in {200, 403, 429}  # the last two: there, but not for programs


BROKEN = {
    "link": ("[a](nowhere.md)", "nowhere.md"),
    "anchor": ("[a](frames.md#nowhere)", "frames.md#nowhere"),
    "picture": ("![a](nowhere.png)", "nowhere.png"),
}


@pytest.fixture
def copied(tmp_path) -> Path:
    """The project with docs of its own."""
    for path in PROJECT.iterdir():
        if path.name not in {"docs", "runs"}:
            (tmp_path / path.name).symlink_to(path)
    shutil.copytree(PROJECT / "docs", tmp_path / "docs")
    return tmp_path


def make_site(folder: Path) -> subprocess.CompletedProcess[str]:
    """By the recipe of the Makefile, with this environment, which is not renewed."""
    environment = Path(sys.prefix)
    if not (environment / "bin" / "mkdocs").is_file():
        pytest.skip("the extra [docs] is not installed")
    words = ("make", "site", f"VENV={environment}", "-o", f"{environment}/.docs")
    return subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)


@nightly
def test_site_has_the_pages_alone(copied):
    compiled = copied / "docs" / "__pycache__" / "site_hook.cpython-311.pyc"
    compiled.parent.mkdir(exist_ok=True)
    compiled.write_bytes(b"")
    made = make_site(copied)
    assert (made.returncode, "WARNING" in made.stderr) == (0, False), made.stderr
    assert (copied / "runs" / "site" / "index.html").is_file()
    assert not list((copied / "runs" / "site").rglob("*.pyc"))


@nightly
def test_broken_links_fail_the_site(copied):
    page = copied / "docs" / "verdict.md"
    lines = (line for line, _ in BROKEN.values())
    page.write_text("\n\n".join([page.read_text("utf-8"), *lines]), "utf-8")
    made = make_site(copied)
    assert made.returncode != 0
    warned = [line for line in made.stderr.splitlines() if "WARNING" in line]
    assert all(any(where in line for line in warned) for _, where in BROKEN.values()), warned
