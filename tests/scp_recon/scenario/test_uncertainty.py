"""The tables `[uncertainty]`, `[navigation]` and `[policy]`.

Each thing is said in one way, and there is one message where it is not.
"""

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from formulations.arrays import Array
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.scenario.load import base_names, load_scenario, scenario_text, validate_scenario
from scp_recon.scenario.uncertainty import MATRIX_TOLERANCE
from tests.helpers import generators
from tests.scp_recon.support import mission_of, refusal, sigma_of

POSITION = "uncertainty.initial_sigma_position_m=[30, 10, 5]"
VELOCITY = "uncertainty.initial_sigma_velocity_m_s=[1e-3, 5e-4, 1e-4]"
RTN = "uncertainty.initial_frame=rtn"
ABSOLUTE = (POSITION, VELOCITY, RTN)
GATES = {
    "magnitude_fixed_m_s": 1e-3,
    "magnitude_proportional": 0.01,
    "pointing_fixed_m_s": 5e-4,
    "pointing_proportional_rad": 0.0087,
}
DIAGONAL = np.diag([900.0, 100.0, 25.0, 1e-6, 2.5e-7, 1e-8])


def gates(**changes: float) -> str:
    entries = ", ".join(f"{key} = {value!r}" for key, value in (GATES | changes).items())
    return f"uncertainty.gates={{{entries}}}"


def covariance(matrix: Array) -> tuple[str, str]:
    return f"uncertainty.initial_covariance={np.asarray(matrix).tolist()}", RTN


def measured(matrix: Array) -> tuple[str]:
    return (f"navigation.covariance={np.asarray(matrix).tolist()}",)


def changed(entries: dict[tuple[int, int], float]) -> Array:
    matrix = DIAGONAL.copy()
    for place, value in entries.items():
        matrix[place] = value
    return matrix


MEASURED = measured(DIAGONAL)


@pytest.mark.parametrize("overrides", [(*ABSOLUTE, gates()), (*covariance(DIAGONAL), gates())])
def test_another_way_replaces_the_bases_and_back(overrides):
    base = load_scenario()
    mine = load_scenario(None, overrides)
    given = mine.uncertainty.model_dump()
    assert not {"initial_sigma_fraction", "execution_error"} & set(given)
    assert validate_scenario(json.loads(mine.model_dump_json())) == mine
    back = {"uncertainty.initial_sigma_fraction": 0.01, "uncertainty.execution_error": 0.08}
    assert mine.replace(back) == base


def test_absent_ways_and_empty_tables_are_not_written():
    """So that files, and hashes of plans, from before there was a choice stay what they were."""
    scenario = load_scenario()
    tables = scenario.model_dump(mode="json")
    assert tables["uncertainty"] == {"initial_sigma_fraction": 0.01, "execution_error": 0.08}
    assert not {"navigation", "policy"} & tables.keys()
    same = load_scenario(None, ["navigation.lead_s=3600", "policy.kind=open", "policy.cost=dv99"])
    assert scenario_text(same) == scenario_text(scenario)


def test_another_way_replaces_the_navigation_errors():
    first = load_scenario(None, MEASURED)
    sigmas = {"navigation.sigma_position_m": 1.0, "navigation.sigma_velocity_m_s": 1e-4}
    second = first.replace(sigmas)
    assert second.navigation.covariance is None
    third = second.replace({"navigation.sigma_position_m": 2.0})
    assert third.navigation.sigma_velocity_m_s == 1e-4
    assert first.replace({"navigation.lead_s": 0.0}).navigation.covariance is not None


def test_one_number_of_the_same_way_may_change(tmp_path):
    first = load_scenario(None, [gates()])
    assert first.replace({"uncertainty.gates.magnitude_bias": 0.02}).uncertainty.gates is not None
    file = tmp_path / "mine.toml"
    file.write_text(
        f'base = "{base_names()[0]}"\n[uncertainty]\ninitial_sigma_position_m = [1.0, 1.0, 1.0]\n'
        'initial_sigma_velocity_m_s = [1e-4, 1e-4, 1e-4]\ninitial_frame = "sun_north"\n',
        "utf-8",
    )
    moved = load_scenario(file, ["uncertainty.initial_frame=j2000"]).uncertainty
    assert moved.initial_frame == "j2000"
    assert moved.initial_sigma_position_m == (1.0, 1.0, 1.0)


def sigma(entry: str, values: str) -> str:
    return f"uncertainty.initial_sigma_{entry}={values}"


ALIKE = {(0, 1): 900.0, (1, 0): 900.0, (1, 1): 900.0}
"""Errors along two axes that are one and the same."""
SIGMAS = "sigma_position_m=10", "sigma_velocity_m_s=5e-4"
NAVIGATION = [
    # entries of the table, the one that is named, words of the message
    (["lead_s=-1"], "lead_s", "at least 0"),
    (["sigma_position_m=-10", SIGMAS[1]], "sigma_position_m", "least 1e-12"),
    (measured(changed(ALIKE)), "covariance", "positive definite"),
    (SIGMAS[:1], "", "must have sigma_velocity_m_s"),
    ([*SIGMAS, *MEASURED], "", "in one way"),
    (["covariance=[[1.0]]"], "covariance", "6 rows of 6"),
    (measured(changed({(0, 0): -100.0})), "covariance", "entry 1,1 is -100"),
]
MATRIX = "initial_covariance"
REFUSED = [
    # overrides, entry of the table, words of the message
    ((*ABSOLUTE, "uncertainty.initial_sigma_fraction=0.01"), "", "in one way"),
    ((*ABSOLUTE, *covariance(DIAGONAL)), "", "in one way"),
    ((gates(), "uncertainty.execution_error=0.08"), "", "execution_error and gates"),
    ((POSITION, VELOCITY), "", "must have initial_frame"),
    (covariance(DIAGONAL)[:1], "", "must have initial_frame"),
    ((RTN,), "", "must have no initial_frame"),
    ((POSITION, VELOCITY, "uncertainty.initial_frame=lvlh"), "initial_frame", "'rtn'"),
    (covariance(changed({(0, 1): 30.0})), MATRIX, "entries 1,2 and 2,1"),
    (covariance(changed({(0, 1): 450.0, (1, 0): 450.0})), MATRIX, "correlations is -0.5"),
    (covariance(changed({(4, 4): -1.0})), MATRIX, "entry 5,5 is -1"),
    (covariance(changed(dict.fromkeys([(0, 1), (1, 0)], 1.0) | {(0, 0): 0.0})), MATRIX, "of zero"),
    (covariance(np.eye(2)), MATRIX, "6 rows of 6"),
    (covariance(1e6 * DIAGONAL), MATRIX, "distance from the centre"),
    ((sigma("position_m", "[30, -1, 5]"), VELOCITY, RTN), "initial_sigma_position_m.1", "least 0"),
    ((POSITION, sigma("velocity_m_s", "[1, 5, 1]"), RTN), "initial_sigma_velocity_m_s", "speed"),
    ((gates(pointing_proportional_rad=0.5),), "gates.pointing_proportional_rad", "0.2"),
    ((gates(magnitude_fixed_m_s=1.0),), "gates.magnitude_fixed_m_s", "dv_max_m_s"),
    ((gates(magnitude_proportional=1.0),), "gates.magnitude_proportional", "less than"),
    (("uncertainty.gates.magnitude_bias=0.1",), "gates.magnitude_fixed_m_s", "required"),
    (("uncertainty.gates=5",), "gates", "a table"),
    ((*ABSOLUTE, "boundary.initial_velocity_m_s=[0, 0, 0]"), "initial_frame", "another frame"),
]


POLICY = [
    (["policy.kind=closed"], "policy.kind", "'open' or 'feedback'"),
    (["policy.cost=mean"], "policy.cost", "'nominal', 'expected' or 'dv99'"),
]


@pytest.mark.parametrize(
    ("overrides", "entry", "words"),
    [
        *((given, f"uncertainty.{entry}".rstrip("."), words) for given, entry, words in REFUSED),
        *(
            (
                [f"navigation.{one.removeprefix('navigation.')}" for one in given],
                *(f"navigation.{entry}".rstrip("."), words),
            )
            for given, entry, words in NAVIGATION
        ),
        *POLICY,
    ],
)
def test_invalid_uncertainty_is_refused_in_one_message(overrides, entry, words):
    error = refusal(mission_of, *overrides)
    assert (error.entry, "\n" in error.allowed) == (entry, False)
    assert words in str(error)


@pytest.mark.parametrize("missing", ["initial_sigma_fraction", "execution_error"])
def test_nothing_given_is_refused_and_answered(missing):
    data: dict[str, Any] = load_scenario().model_dump(mode="json")
    del data["uncertainty"][missing]
    with pytest.raises(InputError, match=f"{missing}.*not nothing"):
        validate_scenario(data)


def random_covariance(rng: np.random.Generator, rank: int) -> Array:
    root = np.diag([20.0, 20.0, 20.0, 1e-3, 1e-3, 1e-3]) @ rng.normal(size=(6, rank))
    matrix: Array = root @ root.T
    return matrix


@pytest.mark.slow
@given(generators, st.integers(1, 6), st.sampled_from(["j2000", "sun_north", "body_fixed", "rtn"]))
def test_factor_is_a_root_of_the_covariance(rng, rank, frame):
    matrix = random_covariance(rng, rank)
    scenario = load_scenario(None, [covariance(matrix)[0], f"uncertainty.initial_frame={frame}"])
    mission = Mission.from_scenario(scenario)
    r, v = mission.initial_state[:3], mission.initial_state[3:]
    sun, pole = mission.sun_direction(0.0), mission.rotation.pole
    x, z, across = {
        "j2000": (np.eye(3)[0], np.eye(3)[2], None),
        "sun_north": (sun, None, np.cross(pole, sun)),
        "rtn": (r, np.cross(r, v), None),
        "body_fixed": (mission.rotation.body_to_j2000(0.0)[:, 0], pole, None),
    }[frame]
    y = np.cross(z, x) if across is None else across
    z = np.cross(x, y) if z is None else z
    axes = np.stack([a / np.linalg.norm(a) for a in (x, y, z)])
    back = np.kron(np.eye(2), axes) @ mission.initial_factor
    scale = np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))
    assert (np.abs(back @ back.T - matrix) <= 1e-9 * scale).all()
    sigma = np.sqrt(np.diag(mission.initial_factor @ mission.initial_factor.T))
    np.testing.assert_allclose(sigma_of(mission), sigma, rtol=1e-12)


@pytest.mark.slow
@given(generators, st.floats(0.1, 0.9))
def test_a_rounded_covariance_is_accepted(rng, share):
    """Rounding makes a singular covariance a little indefinite and a little asymmetric."""
    matrix = random_covariance(rng, 2)
    scale = np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))
    rounded = matrix + share * MATRIX_TOLERANCE / 6.0 * scale * rng.uniform(-1, 1, (6, 6))
    factor = Mission.from_scenario(
        load_scenario(None, [*covariance(rounded)[:1], "uncertainty.initial_frame=j2000"])
    ).initial_factor
    assert (np.abs(factor @ factor.T - matrix) <= 2.0 * MATRIX_TOLERANCE * scale).all()
