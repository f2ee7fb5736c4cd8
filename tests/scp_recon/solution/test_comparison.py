"""Plans side by side: how figures are shown."""

from __future__ import annotations

import pytest

from scp_recon.solution.comparison import Comparison


@pytest.mark.parametrize(
    ("figure", "shown"),
    [(-1e-10, "0"), (1e-11, "0"), (0.14013512345, "0.140135"), (-2e-6, "-2e-06"), (None, "")],
)
def test_a_figure_has_six_digits_and_rounding_is_zero(figure: float | None, shown: str) -> None:
    table = Comparison(("a",), (("margin distance", "m", (figure,)),))
    assert table.cells()[1:] == [["margin distance m", shown]]
    assert table["margin distance"] == (figure,)
