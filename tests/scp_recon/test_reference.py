"""The generated reference pages: current, with every option, entry and key described."""

from pathlib import Path

import pytest

from scp_recon.reference import PAGES, main

PUBLISHED = Path(__file__).parents[2] / "docs" / "reference"


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("reference")
    assert main([str(folder)]) == 0
    return folder


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_current_and_describes_everything(name, written):
    text = (written / f"{name}.md").read_text("utf-8")
    assert (PUBLISHED / f"{name}.md").read_text("utf-8") == text, "run make reference"
    for line in text.splitlines():
        if line.startswith("| `") and name != "warnings":
            assert len(line.rstrip(" |").rpartition(" | ")[2]) > 4, line


def test_no_other_page_stands_there():
    assert {path.stem for path in PUBLISHED.iterdir()} == {*PAGES}


def test_no_folder_and_pages_of_others_are_refused(tmp_path, capsys):
    (tmp_path / "warnings.md").write_text("mine", "utf-8")
    for folder, said in (
        (tmp_path / "warnings.md", "a folder to write to"),
        (tmp_path, "a new file"),
    ):
        with pytest.raises(SystemExit, match="2"):
            main([str(folder)])
        assert f"must be {said}" in capsys.readouterr().err
    assert (tmp_path / "warnings.md").read_text("utf-8") == "mine"
    (tmp_path / "warnings.md").unlink()
    assert main([str(tmp_path)]) == main([str(tmp_path)]) == 0
