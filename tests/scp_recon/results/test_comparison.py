"""Plans side by side: how figures are shown."""

from __future__ import annotations

import pytest

from scp_recon.results.comparison import Comparison


@pytest.mark.parametrize(
    ("figure", "shown"),
    [(-1e-10, "0"), (1e-11, "0"), (0.14013512345, "0.140135"), (-2e-6, "-2e-06"), (None, "")],
)
def test_a_figure_has_six_digits_and_rounding_is_zero(figure: float | None, shown: str) -> None:
    table = Comparison(("a",), (("margin distance", "m", (figure,)),))
    assert [cell.text for cell in table.table.rows[0]] == ["margin distance (m)", shown]
    assert table["margin distance"] == (figure,)
