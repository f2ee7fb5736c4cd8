"""Serve a page on this machine with sliders that change a scenario, its plan and the 3-D view."""

from __future__ import annotations

import json
import re
import webbrowser
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock
from typing import Any

from scp_recon.api import files
from scp_recon.api.inputs import PlanRequest, scenario_of
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import carry_out
from scp_recon.display import mm_s
from scp_recon.errors import InputError, number_between, one_of, option, shortened, whole_number
from scp_recon.reports.shown import Shown
from scp_recon.reports.write import (
    check_extra,
    slider_data,
    slider_page,
    slider_plan,
    slider_verdict,
)
from scp_recon.scenario.given import value_of
from scp_recon.scenario.load import naming_files, scenario_text
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status

ADDRESS = "127.0.0.1"
"""The page is served to this machine alone."""
BYTES_MAX, SECONDS_MAX = 20_000, 30.0
"""Largest size of a request, and longest time to receive it."""
BURN, POLICY = "burns.times_s", "policy.kind"
MEASURED = {
    "navigation.sigma_position_m": ("position, 1 sigma (m)", 10.0),
    "navigation.sigma_velocity_m_s": ("velocity, 1 sigma (m/s)", 0.0005),
}
"""Measurement for feedback in a scenario without one: as in docs/feedback.md."""
Values = Mapping[str, Any]
"""Values of changed sliders, by their keys."""


@dataclass(frozen=True)
class Slider:
    """An entry of a scenario that the page changes.

    Attributes:
        group: heading above the slider.
        key: dotted entry; for a burn's time followed by the burn's index.
        label: with the unit.
        value: in the scenario.
        low: least value.
        high: largest.
        log: whether the slider is logarithmic.
        power: exponent for an entry of many numbers: they are multiplied by value**power; 0 for a
            single number.
    """

    group: str
    key: str
    label: str
    value: float
    low: float
    high: float
    log: bool = False
    power: int = 0


SHARES = (
    ("uncertainty.execution_error", "execution error, share of a burn"),
    ("uncertainty.initial_sigma_fraction", "initial state, share of each component"),
)
MULTIPLIED = (
    ("Errors", "uncertainty.gates", "execution errors", 1),
    ("Errors", "uncertainty.initial_sigma_position_m", "initial position's sigmas", 1),
    ("Errors", "uncertainty.initial_sigma_velocity_m_s", "initial velocity's sigmas", 1),
    ("Errors", "uncertainty.initial_covariance", "initial sigmas", 2),
    ("Navigation", "navigation.covariance", "measured sigmas", 2),
)
"""Group, entry of many numbers, its meaning, and the power of the value that multiplies the numbers."""
LIMITS = (
    *(
        (f"observation.{key}_{end}_{unit}", f"{key.replace('_', ' ')}, {words} ({unit})")
        for key, unit in (("site_distance", "m"), ("emission", "deg"), ("phase", "deg"))
        for end, words in (("min", "at least"), ("max", "at most"))
    ),
    ("safety.radius_min_m", "distance from the centre, at least (m)"),
    ("burns.dv_max_m_s", "a burn, at most (m/s)"),
)
GROUPS = ("Risk", "Errors", "Limits", "Burn times", "Navigation")


def sliders_of(scenario: Scenario) -> list[Slider]:
    """The sliders whose entries a scenario has, group by group."""
    tables = scenario.model_dump(mode="json", exclude_none=True)
    p, navigation, times = scenario.risk.p_chance, scenario.navigation, scenario.burns.times_s
    rows = [Slider("Risk", "risk.p_chance", "required probability", p, min(p, 0.51), max(p, 0.999))]
    for key, label in SHARES:
        if (value := value_of(tables, key)) is not None:
            rows.append(Slider("Errors", key, label, value, 0.0, max(0.2, value)))
    for group, key, what, power in MULTIPLIED:
        if value_of(tables, key) is not None:
            label = f"{what}, times the scenario's"
            rows.append(Slider(group, key, label, 1.0, 0.1, 10.0, log=True, power=power))
    for key, label in LIMITS:
        if (value := value_of(tables, key)) is not None:
            ends = (min(value, 1.0), max(value, 89.0)) if "deg" in key else (value / 5, 3 * value)
            rows.append(Slider("Limits", key, label, value, *ends))
    for k in range(max(1, scenario.burns_flown), len(times) - 1):
        ends = times[k - 1], times[k + 1]
        rows.append(Slider("Burn times", f"{BURN}.{k}", f"burn {k + 1} (s)", times[k], *ends))
    lead, label = navigation.lead_s, "cut-off before a burn (s)"
    rows.append(Slider("Navigation", "navigation.lead_s", label, lead, 0.0, max(14_400.0, lead)))
    if navigation.covariance is None and navigation.landmarks is None:
        for key, (label, usual) in MEASURED.items():
            value = value_of(tables, key) or usual
            ends = value / 100, 100 * value
            rows.append(Slider("Navigation", key, label, value, *ends, log=True))
    return sorted(rows, key=lambda slider: GROUPS.index(slider.group))


def changed(scenario: Scenario, sliders: Sequence[Slider], values: object) -> Scenario:
    """The scenario with the values of sliders, and of `policy.kind`."""
    if not isinstance(values, Mapping):
        raise InputError("values", shortened(values), "must be values by entry")
    by_key = {slider.key: slider for slider in sliders}
    tables = scenario.model_dump(mode="json", exclude_none=True)
    changes: dict[str, Any] = {}
    times = list(scenario.burns.times_s)
    given = dict(values)
    if POLICY in given:
        changes[POLICY] = one_of(POLICY, given.pop(POLICY), ("open", "feedback"))
        if changes[POLICY] == "feedback" and not scenario.navigation.measures:
            given = {key: usual for key, (_, usual) in MEASURED.items()} | given
    for key, value in given.items():
        slider = by_key[one_of("values", key, by_key)]
        number = number_between(key, value, slider.low, slider.high)
        entry, _, place = key.rpartition(".")
        if entry == BURN:
            times[int(place)] = number
            changes[BURN] = times
        elif slider.power:
            changes[key] = _scaled(value_of(tables, key), number**slider.power)
        else:
            changes[key] = number
    return scenario.replace(changes) if changes else scenario


def _scaled(value: Any, factor: float) -> Any:
    """All numbers of nested tables and lists times a factor."""
    if isinstance(value, Mapping):
        return {key: _scaled(each, factor) for key, each in value.items()}
    if isinstance(value, list):
        return [_scaled(each, factor) for each in value]
    return value * factor


@dataclass(eq=False)
class Explorer:
    """Answers the page's questions about a scenario; keeps the last plan, and the values it is of."""

    scenario: Scenario
    sliders: list[Slider] = field(init=False)
    kept: tuple[Values, Shown] | None = None
    _planning: Lock = field(default_factory=Lock)

    def __post_init__(self) -> None:
        self.sliders = sliders_of(self.scenario)

    def plan(self, values: Values) -> Shown:
        """The plan for these values, made as by `plan` but not certified by flights.

        Raises:
            InputError: if there is none for them.
        """
        with self._planning:
            if self.kept is not None and self.kept[0] == values:
                return self.kept[1]
            scenario = changed(self.scenario, self.sliders, values)
            request = PlanRequest(scenario, options=PlanOptions(certify=False))
            shown = slider_plan(carry_out(request, verifies=False).solution)
            self.kept = values, shown
            return shown

    def answer(self, values: Values) -> dict[str, Any]:
        """The plan for these values, not verified yet, and all that is drawn of it."""
        shown = self.plan(values)
        solution, mission = shown.solution, shown.mission
        converged = Status.named(solution.status) is Status.CONVERGED
        iterations = ", ".join(f"{stage.name} {stage.iterations}" for stage in solution.stages)
        legal = mission.schedule.firing_intervals_s[-len(mission.scenario.burn_times_s) :]
        first = 1 + mission.scenario.burns_flown
        return {
            "verdict": slider_verdict(shown, solution),
            "cost": mm_s(solution.total_dv_m_s, 1) + ("" if converged else f", {solution.status}"),
            "converged": converged,
            "effort": f"iterations: {iterations}; planned in {solution.timing_s.total:.2f} s",
            "legal": {
                f"{BURN}.{number - 1}": f"legal, the others kept: {low:.0f} to {high:.0f} s"
                for number, (low, high) in enumerate(legal, start=first)
            },
            "drawn": slider_data(shown),
            "toml": scenario_text(mission.scenario),
        }

    def verdict(self, values: Values) -> dict[str, Any]:
        """The verdict on the plan for these values, by the flights of the verification."""
        shown = self.plan(values)
        return {"verdict": slider_verdict(shown, files.verified(shown.solution))}

    def html(self) -> str:
        """The page with the plan of the scenario as it was given."""
        return slider_page(self.plan({}), self.sliders, self.answer({}))


class Server(ThreadingHTTPServer):
    """Serves one page to this machine; idle connections of a browser do not block others."""

    daemon_threads = True

    def __init__(self, explorer: Explorer, port: int) -> None:
        self.explorer = explorer
        self.questions = {"/plan": explorer.answer, "/verdict": explorer.verdict}
        super().__init__((ADDRESS, port), _Handler)

    @property
    def hosts(self) -> list[str]:
        """Accepted names of this server; requests for any other name are refused."""
        return [f"{name}:{self.server_port}" for name in (ADDRESS, "localhost")]


class _Handler(BaseHTTPRequestHandler):
    """One request."""

    server: Server
    timeout = SECONDS_MAX

    def do_GET(self) -> None:
        """The page."""
        if self._is_ours({"/"}):
            self._send(HTTPStatus.OK, self.server.explorer.html(), "text/html; charset=utf-8")

    def do_POST(self) -> None:
        """A plan or a verdict in JSON; if the values have no plan, the reason."""
        if not self._is_ours(self.server.questions):
            return
        length = self.headers.get("Content-Length", "")
        if not re.fullmatch("[0-9]{1,9}", length) or int(length) > BYTES_MAX:
            self._refuse(HTTPStatus.BAD_REQUEST, f"at most {BYTES_MAX} bytes, and their number")
            return
        if self.headers.get_content_type() != "application/json":
            self._refuse(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "must be application/json")
            return
        try:
            values = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            self._refuse(HTTPStatus.BAD_REQUEST, "must be JSON")
            return
        try:
            answer = self.server.questions[self.path](values)
        except InputError as error:
            answer = {"refused": str(error)}
        self._send(HTTPStatus.OK, json.dumps(answer, allow_nan=False), "application/json")

    def _is_ours(self, paths: Sequence[str] | set[str] | Mapping[str, object]) -> bool:
        """Whether the request comes from this page for a known path; others are refused."""
        origin, host = self.headers.get("Origin"), self.headers.get("Host")
        if host not in self.server.hosts or origin not in (None, f"http://{host}"):
            self._refuse(HTTPStatus.FORBIDDEN, "only this page may ask")
        elif self.path not in paths:
            known = self.path in ("/", *self.server.questions)
            status = HTTPStatus.METHOD_NOT_ALLOWED if known else HTTPStatus.NOT_FOUND
            self._refuse(status, f"must be {' or '.join(paths)}")
        else:
            return True
        return False

    def _refuse(self, status: HTTPStatus, reason: str) -> None:
        self._send(status, f"{status.phrase}: {reason}\n", "text/plain; charset=utf-8")

    def _send(self, status: HTTPStatus, text: str, kind: str) -> None:
        body = text.encode()
        with suppress(ConnectionError):  # who asked is gone
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Cache-Control", "no-store")
            self.send_header("X-Content-Type-Options", "nosniff")
            self.end_headers()
            self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Say nothing: the library is silent."""


def serve(
    scenario: Scenario | str | Path,
    port: int,
    overrides: Sequence[str],
    progress: Callable[[str], None],
    *,
    browser: bool,
) -> None:
    """Serve the page until Ctrl-C: see `api.verbs.explore`."""
    port = whole_number(option("port"), port, 0, 65_535)
    check_extra()
    with naming_files(scenario, overrides):
        explorer = Explorer(scenario_of(scenario, overrides))
    try:
        server = Server(explorer, port)
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(option("port"), f"{port} ({reason})", "must be free; 0 for any") from None
    with server, suppress(KeyboardInterrupt):
        with naming_files(scenario, overrides):
            explorer.plan({})
        address = f"http://{server.hosts[0]}/"
        progress(address)
        if browser:
            webbrowser.open(address)
        server.serve_forever()
