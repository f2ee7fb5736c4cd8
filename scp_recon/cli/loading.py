"""Make a command's process start quickly: defer or leave out modules, and give NumPy one thread.

NumPy, SciPy and CVXPY import modules that take a third of a second and that no command needs; where
JAX is installed, CVXPY imports it for another 0.9 s.
NumPy's threads wait for each other in busy loops: a certified plan took 7.5 s of the processor with
two threads, and 3.8 s with one.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import Any

LATER: dict[str, tuple[str, ...]] = {
    "numpy.f2py": (),
    "numpy.testing": (),
    "scipy.stats": ("entropy",),
}
"""Modules, and the functions that others take from them when they are imported.

SciPy takes every name of NumPy, and with it these two packages; CVXPY the function for one atom.
"""

UNASKED = frozenset({"highspy", "jax", "osqp"})
"""What CVXPY imports for solvers that are installed, but take no second-order cones."""

THREADS = "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"
"""Variables of the libraries that NumPy may be built with."""


class _Later(ModuleType):
    """Placeholder for a module, which is imported when an attribute is first used."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # who looks at all modules uses none
            raise AttributeError(name)
        if sys.modules.get(self.__name__) is self and name in LATER[self.__name__]:
            return lambda *args, **named: getattr(self._loaded(), name)(*args, **named)
        return getattr(self._loaded(), name)

    def _loaded(self) -> ModuleType:
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
        return import_module(self.__name__)


class _Unasked(MetaPathFinder):
    """Finder that hides some solvers from CVXPY while it lists the installed ones.

    Placeholders as above would not do: SciPy imports JAX where it stands among the modules.
    """

    def find_spec(self, name: str, *_: object) -> ModuleSpec | None:
        listing = sys.modules.get("cvxpy.reductions.solvers.defines")
        if name in UNASKED and listing and not hasattr(listing, "INSTALLED_SOLVERS"):
            raise ModuleNotFoundError(f"CVXPY is not to import {name}", name=name)
        return None


def load_lightly() -> None:
    """Defer modules that are not imported yet; only for a command, which has its own process.

    A number of threads given by OMP_NUM_THREADS or NumPy's own variables is kept.
    """
    if "numpy" not in sys.modules and "OMP_NUM_THREADS" not in os.environ:
        for name in THREADS:
            os.environ.setdefault(name, "1")
    if "cvxpy" not in sys.modules:
        sys.meta_path.insert(0, _Unasked())
    for name in LATER:
        if name not in sys.modules:
            package, _, child = name.rpartition(".")
            spec, stand_in = find_spec(name), _Later(name)
            stand_in.__path__ = list((spec and spec.submodule_search_locations) or ())
            sys.modules[name] = stand_in
            setattr(import_module(package), child, stand_in)
