"""Asteroid reconnaissance flybys planned under uncertainty by sequential convex programming.

    import scp_recon as sr

    scenario = sr.load_scenario("recon_b").replace({"risk.p_chance": 0.8})
    plan = sr.plan(scenario)
    print(plan)

The names below are imported when they are first used, so that the commands start quickly.
"""

from __future__ import annotations

from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from scp_recon.display import shown_by as _shown_by

if TYPE_CHECKING:
    from scp_recon.api.campaigns import campaign, read_campaign
    from scp_recon.api.designing import design
    from scp_recon.api.drafts import new
    from scp_recon.api.exploring import explore
    from scp_recon.api.files import charts, compare, export, load, report, save, verify
    from scp_recon.api.flights import fly, simulate
    from scp_recon.api.inputs import scenarios
    from scp_recon.api.planning import plan
    from scp_recon.api.replans import replan
    from scp_recon.api.survey import windows
    from scp_recon.errors import InputError
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
_ELSEWHERE = {
    "InputError": "errors",
    "campaign": "api.campaigns",
    "design": "api.designing",
    "explore": "api.exploring",
    "fly": "api.flights",
    "load_scenario": "scenario.load",
    "new": "api.drafts",
    "plan": "api.planning",
    "read_campaign": "api.campaigns",
    "replan": "api.replans",
    "scenarios": "api.inputs",
    "simulate": "api.flights",
    "windows": "api.survey",
}
"""Modules of what `api.files` does not have; classes are of `impulsive.problem` if not of these."""


_shown_by(lambda: import_module("scp_recon.api.showing"))


def __getattr__(name: str) -> Any:
    """A public name, which is imported when it is first asked for."""
    if name == "__version__":
        from scp_recon.errors import version_of

        return version_of(__name__)
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    usual = "impulsive.problem" if name[0].isupper() else "api.files"
    module = import_module(f"{__name__}.{_ELSEWHERE.get(name, usual)}")
    return getattr(module, name)


def __dir__() -> list[str]:
    """For completion: the public names, and the modules that are imported."""
    modules = [name for name, value in globals().items() if isinstance(value, ModuleType)]
    return sorted({*modules, *__all__})
