"""Attributes of all that functions of `scp_recon` return are described at their class."""

import ast
import dataclasses
import importlib
import inspect
import re
import sys
import textwrap
from collections.abc import Iterator
from enum import Enum
from typing import Any, get_args

import pytest
from matplotlib.figure import Figure

import scp_recon as sr
from scp_recon.scenario.fields import Section
from scp_recon.scenario.schema import Scenario

pytestmark = pytest.mark.slow

pandas = pytest.importorskip("pandas")
OURS = "scp_recon", "formulations"
LATE = [
    *(f"scp_recon.api.{name}" for name in ("campaigns", "drafts", "files", "showing", "designing")),
    "scp_recon.simulation.record",
    "scp_recon.verification.reintegration",
]


def classes_in(hint: object) -> Iterator[type]:
    """Those of this repository that an annotation names."""
    if inspect.isclass(hint) and hint.__module__.startswith(OURS) and not issubclass(hint, Enum):
        yield hint
    for part in get_args(hint):
        yield from classes_in(part)


def hints(of: Any) -> dict[str, Any]:
    """Annotations, those too that functions name before they import them."""
    late = (importlib.import_module(name) for name in LATE)
    known = {name: kind for module in late for name, kind in vars(module).items()}
    known |= {"pandas": pandas, "Figure": Figure, **vars(sys.modules[of.__module__])}
    return inspect.get_annotations(of, globals=known, eval_str=True)


def reached() -> list[type]:
    """Classes of what functions return, of their attributes, of the attributes of these, ..."""
    found: list[type] = []
    left = [
        one for name in sr.__all__ for one in classes_in(hints(getattr(sr, name)).get("return"))
    ]
    while left:
        one = left.pop()
        if one not in found:
            found.append(one)
            left += [base for base in one.__mro__ if base.__module__.startswith(OURS)]
            left += [c for hint in hints(one).values() for c in classes_in(hint)]
            for value in vars(one).values():
                getter = getattr(value, "fget", getattr(value, "func", None))
                left += classes_in(hints(getter).get("return")) if getter else []
    return found


def described(one: type) -> set[str]:
    """Names that the class's docstring or a docstring below an attribute describes."""
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(one))).body
    assert isinstance(node, ast.ClassDef)
    text = ast.get_docstring(node) or ""
    section = text.partition("Attributes:\n")[2]
    lists = " ".join(re.findall(r"^ {4}([\w, ]+): ", section, re.MULTILINE))
    below = zip(node.body, node.body[1:], strict=False)
    return {
        *re.findall(r"\w+", lists),
        *re.findall(r"`(\w+)`", text),
        *(ast.unparse(one.target) for one, said in below
          if isinstance(one, ast.AnnAssign) and isinstance(said, ast.Expr)),
    }  # fmt: skip


def names_of(one: type) -> set[str]:
    """Public fields of a class, and properties without a docstring."""
    fields = [f.name for f in dataclasses.fields(one)] if dataclasses.is_dataclass(one) else []
    fields += getattr(one, "model_fields", getattr(one, "_fields", ()))
    bare = inspect.getmembers(one, lambda value: isinstance(value, property) and not value.__doc__)
    return {name for name in (*fields, *dict(bare)) if name[0] != "_"}


def test_every_attribute_of_what_comes_back_is_described():
    classes, missing = reached(), {}
    assert len(classes) > 60
    for one in classes:
        bases = (base for base in one.__mro__ if base.__module__.startswith(OURS))
        known = set().union(*map(described, bases))
        if one is Scenario:  # each of its tables is described as a class
            kinds = {name: [*classes_in(hint)] for name, hint in hints(one).items()}
            known |= {name for name, of in kinds.items() if any(issubclass(c, Section) for c in of)}
        if left := names_of(one) - known:
            missing[one.__name__] = left
    assert missing == {}
