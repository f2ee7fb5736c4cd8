"""Gravity fields from files of both kinds."""

from __future__ import annotations

from pathlib import Path

import pytest

from scp_recon.bodies.gravity_file import read_gravity
from scp_recon.errors import InputError

ROWS = ((2, 0, -0.0192, 0.0), (2, 2, 0.003, -0.001), (3, 1, 8e-4, -5e-4))
GFC = """comment of the head: 1 2 3
product_type gravity_field
earth_gravity_constant 4.89D+00
radius 290.0
max_degree 3
norm fully_normalized
key L M C S
end_of_head =====
gfc 0 0 1.0 0.0
gfc 2 0 -0.0192 0.0 1e-9 1e-9
gfc 2 1 0.0 0.0
gfc 2 2 3.0d-3 -1.0d-3
gfc 3 1 8e-4 -5e-4
"""
SHA = """ 0.29, 4.89E-09, 0.0, 3, 3, 1, 0.0, 0.0
 2, 0, -0.0192, 0.0, 1e-9, 0.0
 2, 1, 0.0, 0.0, 0.0, 0.0
 2, 2, 3.0E-03, -1.0E-03, 0.0, 0.0
 3, 1, 8.0E-04, -5.0E-04, 0.0, 0.0
"""
BARE = "\n".join(f"  {n}  {m} {c:.5E} {s:.5E} 0.0 0.0" for n, m, c, s in ROWS)


def written(folder: Path, text: str) -> Path:
    file = folder / "field.txt"
    file.write_text(text, "utf-8")
    return file


@pytest.mark.parametrize("text", [GFC, SHA], ids=["gfc", "sha"])
def test_both_formats_say_the_same(text: str, tmp_path: Path) -> None:
    table = read_gravity(written(tmp_path, text), 20)
    assert table.gm_m3_s2 == pytest.approx(4.89)
    assert table.radius_m == pytest.approx(290.0)
    assert table.rows == ROWS
    assert read_gravity(written(tmp_path, text), 2).rows == ROWS[:2]


def test_a_table_without_a_first_record_has_no_gm_and_no_radius(tmp_path: Path) -> None:
    table = read_gravity(written(tmp_path, BARE), 20)
    assert (table.gm_m3_s2, table.radius_m, table.rows) == (None, None, ROWS)


@pytest.mark.parametrize(
    "text",
    [
        *("", "nonsense", "1 2 3", GFC.replace("fully_", "un"), GFC.replace("gfc 3 1", "gfct 3 1")),
        *(
            GFC + "gfc 2 0 0.1 0.0\n",
            GFC.replace("gfc 3 1", "gfc 3 4"),
            SHA.replace("3, 1, 0.0", "3, 0, 0.0"),
        ),
        *(
            SHA.replace("-0.0192", "-19.2"),
            SHA.replace("-0.0192", "nan"),
            GFC.replace("0 0 1.0", "0 0 2.0"),
            GFC.replace("gfc 2 1 0.0", "gfc 1 1 0.1"),
            "end_of_head\n",
            "0 0 1 0\n",
        ),
    ],
)
def test_what_is_no_normalised_field_is_refused_in_one_message(text: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        read_gravity(written(tmp_path, text), 20)
    assert caught.value.entry.startswith("body.gravity_file")
