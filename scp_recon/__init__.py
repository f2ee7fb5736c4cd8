"""Asteroid reconnaissance flybys planned under uncertainty by sequential convex programming.

    import scp_recon as sr

    scenario = sr.load_scenario("recon_b").replace({"risk.p_chance": 0.8})
    plan = sr.plan(scenario)
    print(plan)

Functions import what they need when they are called, and the classes below are imported when they are
first used, so that the commands start quickly.
"""

from __future__ import annotations

from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from scp_recon.api.plan_verbs import (
    charts,
    compare,
    export,
    fly,
    load,
    report,
    save,
    simulate,
    verify,
)
from scp_recon.api.verbs import (
    campaign,
    design,
    explore,
    new,
    plan,
    read_campaign,
    replan,
    scenarios,
    windows,
)
from scp_recon.display import shown_by as _shown_by
from scp_recon.errors import InputError

if TYPE_CHECKING:
    from scp_recon.impulsive.problem import (
        Ball,
        ComponentwiseErrors,
        Cone,
        Ellipsoid,
        ExpressionFlow,
        Feedback,
        GatesErrors,
        Halfspaces,
        ImpulsiveProblem,
        Keep,
        Polytope,
    )
    from scp_recon.scenario.load import load_scenario

__all__ = [
    "Ball",
    "ComponentwiseErrors",
    "Cone",
    "Ellipsoid",
    "ExpressionFlow",
    "Feedback",
    "GatesErrors",
    "Halfspaces",
    "ImpulsiveProblem",
    "InputError",
    "Keep",
    "Polytope",
    "campaign",
    "charts",
    "compare",
    "design",
    "explore",
    "export",
    "fly",
    "load",
    "load_scenario",
    "new",
    "plan",
    "read_campaign",
    "replan",
    "report",
    "save",
    "scenarios",
    "simulate",
    "verify",
    "windows",
]

_shown_by(lambda: import_module("scp_recon.api.showing"))


def __getattr__(name: str) -> Any:
    """A public name, which is imported when it is first asked for."""
    if name == "__version__":
        from scp_recon.errors import version_of

        return version_of(__name__)
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = "scenario.load" if name == "load_scenario" else "impulsive.problem"
    return getattr(import_module(f"{__name__}.{home}"), name)


def __dir__() -> list[str]:
    """For completion: the public names, and the modules that are imported."""
    modules = [name for name, value in globals().items() if isinstance(value, ModuleType)]
    return sorted({*modules, *__all__})
