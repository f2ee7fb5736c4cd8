"""Numbers as the page carries them: as many digits as are seen, and null where there is none."""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np
import numpy.typing as npt


def compact(values: npt.ArrayLike, digits: int) -> Any:
    """Nested lists rounded to digits after the point; null where there is no number."""
    rounded = np.round(np.asarray(values, dtype=float), digits) + 0.0
    if digits <= 0:
        rounded = np.trunc(rounded)
    return _plain(rounded)


def _plain(values: npt.NDArray[np.float64]) -> Any:
    if np.isfinite(values).all():
        return values.tolist()
    if values.ndim == 0:
        return None
    return [_plain(np.asarray(part)) for part in values]


def significant(values: npt.ArrayLike, digits: int = 6) -> Any:
    """A list rounded to significant digits; null where there is no number."""
    array = np.asarray(values, dtype=float)
    return [float(f"{x:.{digits}g}") if np.isfinite(x) else None for x in array.tolist()]


def packed(numbers: npt.NDArray[np.intp]) -> dict[str, str]:
    """Whole numbers from 0 to 2^32 - 1 as Plotly's typed array: half as long as their digits."""
    kind = "u2" if numbers.max(initial=0) < 2**16 else "u4"
    return {"dtype": kind, "bdata": base64.b64encode(numbers.astype(f"<{kind}").tobytes()).decode()}


def script(value: object) -> str:
    """JSON that may stand in a page's script: no tag can end it."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
