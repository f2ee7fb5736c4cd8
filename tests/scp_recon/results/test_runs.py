"""Folders of runs: one of its own for each, one run at a time, and a pointer to the last."""

import re
import signal
from dataclasses import replace
from pathlib import Path

import pytest

from scp_recon.api.inputs import is_solution
from scp_recon.errors import InputError
from scp_recon.files import LOCK, only_run_in
from scp_recon.results.read import folder_of, is_pointer, new_run, point_to, read_solution
from tests.scp_recon.support import run_python

NAMES = ["recon_b", "", "latest", ".", "..", "../../etc", "/", "a b\\c", "é" * 300, "con:"]


@pytest.mark.parametrize("name", NAMES)
def test_every_run_has_its_own_folder(tmp_path, name):
    root = tmp_path / "runs"
    made = {new_run(name, root) for _ in range(3)}
    assert len(made) == 3
    for folder in made:
        assert folder.parent.parent == root
        assert folder.parent.name not in ("latest", ".", "..", "")
        assert folder.resolve().is_relative_to(root.resolve())
    assert all(path.is_dir() for path in made)


@pytest.mark.parametrize("links", [True, False], ids=["links", "no links"])
def test_latest_points_to_the_last_run(tmp_path, solution, links, monkeypatch):
    def refuse(*_: object, **__: object) -> None:
        raise OSError("no links here")

    if not links:
        monkeypatch.setattr(Path, "symlink_to", refuse)
    root = tmp_path / "runs"
    for message in ("first", "second"):
        folder = new_run("mine", root)
        replace(solution, message=message).write(folder)
        point_to(folder, root)
        latest = root / "latest"
        assert latest.is_symlink() == links
        assert read_solution(latest).message == message
        assert folder_of(latest).samefile(folder)
        assert is_pointer(latest)
        assert is_solution(latest)
    assert sorted(path.name for path in root.iterdir()) == ["latest", "mine"]


def test_a_folder_named_latest_is_renamed(tmp_path, solution):
    latest = tmp_path / "latest"
    latest.mkdir()
    solution.write(latest)
    assert not is_pointer(latest)
    folder = new_run("mine", tmp_path)
    point_to(folder, tmp_path)
    assert folder_of(latest).samefile(folder)
    (kept,) = (tmp_path / "latest_before").iterdir()
    assert read_solution(kept) == solution


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="there is no SIGKILL here")
def test_a_folder_has_one_run_at_once(tmp_path):
    """Of all processes; the lock of one that was killed is taken over."""
    code = (
        "import os, signal, sys\nfrom pathlib import Path\n"
        "from scp_recon.files import only_run_in\n"
        f"with only_run_in(Path({str(tmp_path)!r}), '--out'):\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )

    with only_run_in(tmp_path, "--out"):
        assert re.search(
            r"InputError: .*in which process \d+ is at work", run_python("-c", code).stderr
        )
        with pytest.raises(InputError), only_run_in(tmp_path, "--out"):
            pass
    assert run_python("-c", code).stderr == ""
    assert (tmp_path / LOCK).exists()
    with only_run_in(tmp_path, "--out"):
        pass
    assert list(tmp_path.iterdir()) == []
