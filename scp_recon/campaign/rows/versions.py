"""Versions of the packages on which the last bits of a result depend."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

PACKAGES = ("scp_recon", "numpy", "scipy", "cvxpy", "clarabel")


def versions() -> dict[str, str]:
    """Version by name."""
    return {name: _version(name) for name in PACKAGES}


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "unknown"
