"""Render the tables of pages from evidence, and compare the figures in their text with it.

A table of a page stands between two comments, each on a line of its own:

    <!-- table frontier.costs -->

    | delta-v (m/s) for | 0.55 |
    ...

    <!-- end -->

`experiments/tables.toml` says which rows of the evidence and which columns it has. Figures in the
text are typed; `docs/claims.toml` names the rows that they come from. Both files say how.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal
from functools import cache
from pathlib import Path
from typing import Any

from experiments.evidence import ROOT, Evidence, Records, path_of
from scp_recon.errors import InputError, one_of
from scp_recon.results.table import Column, Table, Value

PAGES = (
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted(p for p in (ROOT / "docs").rglob("*.md") if p.parent.name != "reference"),
)
TABLES = ROOT / "experiments" / "tables.toml"
CLAIMS = ROOT / "docs" / "claims.toml"
BLOCK = re.compile(r"^<!-- table (\S+) -->\n(.*?)^<!-- end -->$", re.DOTALL | re.MULTILINE)
COLUMN = re.compile(r"(?:(.+) = )?([^*:]+)(?:\*([^:]+))?(?::(.+))?")
VALUE = re.compile(
    r"(.+?\]\.[^]/*]+?)(?: / (.+?\]\.[^]/*]+?))?"
    r"(?: \* (\d+(?:\.\d+)?(?:e-?\d+)?))?(?: \+- (\d+(?:\.\d+)?(?:e-?\d+)?))?"
)
FIELD = re.compile(r"(\w+)(?:\.(\w+))?\[([^\]]*)\]\.(.+)")
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:,\d{3})*(?:\.\d+)?(?:e[-+]?\d+)?")


def render(text: str) -> str:
    """A page's text with every table rendered anew.

    Raises:
        InputError: if a table, or evidence, a row or a column of it does not exist.
    """
    return BLOCK.sub(
        lambda block: f"<!-- table {block[1]} -->\n\n{table(block[1]).markdown()}\n\n<!-- end -->",
        text,
    )


def behind() -> dict[Path, str]:
    """Pages of which a table is not the evidence's: their text as it should be.

    Raises:
        InputError: if a table, or evidence, a row or a column of it does not exist.
    """
    _tables.cache_clear()
    texts = {page: page.read_text("utf-8") for page in PAGES}
    return {page: new for page, text in texts.items() if (new := render(text)) != text}


def table(name: str) -> Table:
    """The table EVIDENCE.NAME of `experiments/tables.toml`.

    Raises:
        InputError: if there is none, or no row or column of it.
    """
    evidence, _, key = name.partition(".")
    known = _read(TABLES).get(evidence, {})
    spec = known[one_of(f"{TABLES.name}: {evidence}", key, known)]
    rows = _matching(_table(evidence, spec.get("of", key)), spec.get("where", ""), name)
    if not rows:
        allowed = f"must be met by one: {spec.get('where', '')}"
        raise InputError(f"{TABLES.name}: {name}", "no row", allowed)
    columns, cells = list[Column](), list[list[Value]]()
    for part in " ".join(str(spec.get("columns", "")).split()).split(" | "):
        heading, column, factor, form = COLUMN.fullmatch(part).groups()  # type: ignore[union-attr]  # matches all
        columns.append(Column(heading or column, form=form or ".6g"))
        values = (row[one_of(f"{TABLES.name}: {name}", column, row)] for row in rows)
        cells.append([_scaled(value, factor) for value in values])
    return Table.of("", columns, zip(*cells, strict=True))


def wrong_claims() -> Iterator[str]:
    """Compare the figures in the text with the evidence; a line for each phrase that is wrong.

    Raises:
        InputError: if `docs/claims.toml` names no page.
    """
    _tables.cache_clear()
    for page, claims in _read(CLAIMS).items():
        one_of(CLAIMS.name, page, [path.relative_to(ROOT).as_posix() for path in PAGES])
        text = " ".join((ROOT / page).read_text("utf-8").split())
        for phrase, values in claims.items():
            try:
                wrong = _wrong(phrase, values if isinstance(values, list) else [values], text)
            except InputError as error:
                wrong = str(error)
            if wrong:
                yield f"{CLAIMS.name}: {page}: {phrase!r}: {wrong}"


def _wrong(phrase: str, values: Sequence[str], page: str) -> str:
    """What is wrong with a phrase of a page; empty if its figures are the evidence's."""
    if (times := page.count(phrase)) != 1:
        return f"stands {times} times in the page, must stand there once"
    typed = NUMBER.findall(phrase)
    measured = [number for value in values for number in _measured(value, phrase)]
    if len(typed) != len(measured):
        return f"has {len(typed)} figures, the evidence {len(measured)}"
    for text, (number, tolerance) in zip(typed, measured, strict=True):
        decimal = Decimal(text.replace(",", ""))
        half = 0.5 * 10.0 ** int(decimal.as_tuple().exponent)
        if abs(float(decimal) - number) > (tolerance or half) * (1.0 + 1e-9):
            return f"{text} is {number:.6g} in the evidence"
    return ""


def _measured(value: str, phrase: str) -> list[tuple[float, float | None]]:
    """Figures of a value of a claim, each with the tolerance if one is given."""
    parts = VALUE.fullmatch(str(value))
    if parts is None:
        raise InputError(str(value), "no value", "must be EVIDENCE[ROW].COLUMN")
    one, other, factor, tolerance = parts.groups()
    figures, divisor = _figures(one), _figures(other) if other else [1.0]
    if not figures and str(_cell(one)) not in phrase:
        raise InputError(value, repr(_cell(one)), "must stand in the phrase")
    if len(divisor) != 1 or not divisor[0]:
        raise InputError(other, f"{divisor}", "must be a figure to divide by")
    scale = float(factor or 1.0) / divisor[0]
    return [(figure * scale, float(tolerance) if tolerance else None) for figure in figures]


def _figures(field: str) -> list[float]:
    """The figures of a cell: a number itself, or those of a text."""
    return [float(number.replace(",", "")) for number in NUMBER.findall(str(_cell(field)))]


def _cell(field: str) -> Any:
    whole = FIELD.fullmatch(field)
    if whole is None:
        raise InputError(field, "no cell", "must be EVIDENCE[ROW].COLUMN")
    name, of, key, column = whole.groups()
    rows = _table(name, of or name)
    found: Records = _matching(rows, key, field) if "=" in key else []
    for cells in () if "=" in key else (1, 2, 3):
        found = found or [r for r in rows if " ".join(map(_shown, [*r.values()][:cells])) == key]
    if len(found) != 1:
        raise InputError(field, f"{len(found)} rows", "must be of exactly one row")
    return found[0][one_of(field, column, found[0])]


def _scaled(value: Any, factor: str | None) -> Value:
    """A cell of a table; figures are multiplied if the column has a factor."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return value * float(factor) if factor and isinstance(value, int | float) else value


def _read(path: Path) -> dict[str, dict[str, Any]]:
    """The tables of a file of TOML."""
    return tomllib.loads(path.read_text("utf-8"))


@cache
def _tables(name: str) -> Mapping[str, Records]:
    return Evidence.read(path_of(name)).tables


def _table(name: str, of: str) -> Records:
    tables = _tables(name)
    return tables[one_of(f"{name}.{of}", of, tables)]


def _matching(rows: Records, conditions: str, where: str) -> Records:
    for condition in filter(None, (part.strip() for part in conditions.split(";"))):
        column, _, words = condition.partition("=")
        begins, values = column.endswith("^"), tuple(words.split("|"))
        texts = [_shown(r[one_of(where, column.rstrip("^"), r)]) for r in rows]
        kept = [text.startswith(values) if begins else text in values for text in texts]
        rows = [row for row, keep in zip(rows, kept, strict=True) if keep]
    return rows


def _shown(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
