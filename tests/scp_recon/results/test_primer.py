"""The primer in the solution file: written, read back, and left out by older files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scp_recon.errors import InputError
from scp_recon.results.read import read_solution
from scp_recon.results.solution import Solution


def changed(solution: Solution, folder: Path, primer: Any) -> Path:
    path = solution.write(folder)
    data = json.loads(path.read_text("utf-8"))
    if primer == "left out":
        del data["primer"]
    else:
        data["primer"] |= primer
    path.write_text(json.dumps(data), "utf-8")
    return path


def test_it_is_written_with_every_node_and_read_back(solution: Solution, tmp_path: Path) -> None:
    read = read_solution(solution.write(tmp_path)).primer
    assert read is not None
    assert read == solution.primer
    assert read.t_s == solution.nodes.t_s
    sizes = np.linalg.norm(read.vector, axis=1)
    assert np.all(np.array(read.allowed) <= sizes + 1e-12)
    assert read.residual < 1e-3
    assert not any(read.legal)  # four burns leave none of the default flight's gaps to a fifth


def test_older_files_without_it_are_read(solution: Solution, tmp_path: Path) -> None:
    assert read_solution(changed(solution, tmp_path, "left out")).primer is None


@pytest.mark.parametrize("damage", [{"legal": [True]}, {"residual": -1.0}, {"allowed": ["1"]}])
def test_a_damaged_one_is_refused(
    solution: Solution, tmp_path: Path, damage: dict[str, Any]
) -> None:
    with pytest.raises(InputError, match="primer"):
        read_solution(changed(solution, tmp_path, damage))
