"""What is installed, built and cited: the wheel, the source distribution, CITATION.cff."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from fnmatch import fnmatch
from itertools import product
from pathlib import Path

import pytest

from tests.helpers import nightly

PROJECT = Path(__file__).parents[1]
PACKAGES = ("formulations", "scp_recon")
PYPROJECT = tomllib.loads((PROJECT / "pyproject.toml").read_text("utf-8"))
CITED = {"cff-version", "message", "title", "authors"}
"""Keys that the Citation File Format 1.2.0 requires; next those that it knows besides."""
KNOWN = CITED | {
    *("abstract", "commit", "contact", "date-released", "doi", "identifiers", "keywords"),
    *("license", "license-url", "preferred-citation", "references", "repository"),
    *("repository-artifact", "repository-code", "type", "url", "version"),
}

FOR_DEVELOPERS = ("crosscheck", "docs", "notebooks", "peers", "test", "dev")


def files_of(package: str) -> set[str]:
    """Modules and data of a package, from the project's folder."""
    found = (path for path in (PROJECT / package).rglob("*") if path.is_file())
    return {str(path.relative_to(PROJECT)) for path in found if path.suffix != ".pyc"}


def test_readme_renders_for_the_package_index():
    render = pytest.importorskip("readme_renderer.markdown").render
    page = render((PROJECT / "README.md").read_text("utf-8"))
    assert page
    assert all(f"<{tag}" in page for tag in ("h1", "img", "pre"))


def test_citation_agrees_with_project():
    yaml = pytest.importorskip("yaml")
    cited = yaml.safe_load((PROJECT / "CITATION.cff").read_text("utf-8"))
    assert CITED <= cited.keys() <= KNOWN
    assert cited["cff-version"] == "1.2.0"
    project = PYPROJECT["project"]
    said = [cited[key] for key in ("title", "version", "license")]
    assert said == [project[key] for key in ("name", "version", "license")]
    licence = (PROJECT / "LICENSE").read_text("utf-8")
    assert all(author["name"] in licence for author in cited["authors"])
    for work in cited["references"]:
        assert {"type", "title", "authors"} <= work.keys()
        assert all("family-names" in author for author in work["authors"])


def test_one_extra_has_all_that_commands_need():
    extras = PYPROJECT["project"]["optional-dependencies"]
    (everything,) = extras["all"]
    name, *listed = re.findall(r"\w+", everything)
    assert name == PYPROJECT["project"]["name"]
    assert {*listed} == extras.keys() - {"all", *FOR_DEVELOPERS}


def test_data_files_are_packaged():
    packaging = PYPROJECT["tool"]["setuptools"]
    assert packaging["packages"]["find"]["include"] == [f"{name}*" for name in PACKAGES]
    globs = [
        f"{package.replace('.', '/')}/{pattern}"
        for package, patterns in packaging["package-data"].items()
        for pattern in patterns
    ]
    data = {name for package in PACKAGES for name in files_of(package) if not name.endswith(".py")}
    used = {pattern for name, pattern in product(data, globs) if fnmatch(name, pattern)}
    assert used == set(globs)
    assert all(any(fnmatch(name, pattern) for pattern in globs) for name in data)


@nightly
@pytest.mark.timeout(1800)
def test_built_wheel_plans_in_clean_environment(tmp_path):
    """Outside the checkout, with nothing but what the wheel asks for; it installs two packages only."""
    source, dist, work = (tmp_path / name for name in ("source", "dist", "work"))
    work.mkdir()
    for package in PACKAGES:
        shutil.copytree(PROJECT / package, source / package)
    for name in ("pyproject.toml", "README.md", *PYPROJECT["project"]["license-files"]):
        shutil.copy(PROJECT / name, source)
    plain = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}

    def run(*command: str | Path, cwd: Path = work) -> str:
        done = subprocess.run(
            [*map(str, command)], cwd=cwd, env=plain, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
        return done.stdout

    run(sys.executable, "-m", "venv", tmp_path / "env")
    python, limits = tmp_path / "env/bin/python", ("-c", PROJECT / "constraints.txt")
    pip = (python, "-m", "pip", "--disable-pip-version-check", "--quiet")
    run(*pip, "install", *PYPROJECT["build-system"]["requires"])
    build = f"import setuptools.build_meta as b; b.build_sdist({str(dist)!r})"
    run(python, "-c", build, cwd=source)
    (archive,) = dist.glob("*.tar.gz")
    run(*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", dist, archive)
    (wheel,) = dist.glob("*.whl")
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert names == files_of("formulations") | files_of("scp_recon")

    run(*pip, "install", *limits, wheel)
    where = "import formulations, scp_recon; print(formulations.__file__, scp_recon.__file__)"
    assert all(str(tmp_path / "env") in path for path in run(python, "-c", where).split())
    script = tmp_path / "env/bin/scp-recon"
    assert "\nverified" in run(python, "-m", "scp_recon.solve", "--init", "cold", "--out", "plan")
    assert "\nverified" in run(script, "verify", "plan")
    place = ("--body", "Eros", "--site=10,20", "--epoch", "2026-01-21T00:00:00")
    assert "written: mine.toml" in run(script, "new", "mine", *place)
