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


def test_where_no_folder_can_be_made_is_one_message(tmp_path, capsys):
    (tmp_path / "a.md").write_text("")
    with pytest.raises(SystemExit, match="2"):
        main([str(tmp_path / "a.md")])
    assert "must be a folder to write to" in capsys.readouterr().err
