"""Asteroid reconnaissance flybys planned under uncertainty by sequential convex programming.

    import scp_recon as sr

    scenario = sr.load_scenario("recon_b").replace({"risk.p_chance": 0.8})
    plan = sr.plan(scenario)
    print(plan)

The names below are imported when they are first used, so that the commands start quickly.
"""

from __future__ import annotations

from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scp_recon.front_door import (
        check,
        fly,
        load_scenario,
        plan,
        plan_again,
        run_campaign,
        save,
        side_by_side,
        write_report,
    )

__all__ = [
    "check",
    "fly",
    "load_scenario",
    "plan",
    "plan_again",
    "run_campaign",
    "save",
    "side_by_side",
    "write_report",
]


def __getattr__(name: str) -> Any:
    """A name of the front door, which is imported when it is first asked for."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from scp_recon import front_door

    return getattr(front_door, name)


def __dir__() -> list[str]:
    """For completion: the front door, and the modules that are imported."""
    modules = [name for name, value in globals().items() if isinstance(value, ModuleType)]
    return sorted({*modules, *__all__})
