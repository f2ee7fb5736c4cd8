"""Flights that were stopped go on where they were, and come to the same."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from scp_recon import montecarlo
from scp_recon.cli.interrupts import asked_to_stop
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.checkpoint import FILE_NAME, keep_flights, kept_flights
from scp_recon.monte_carlo.flights import FlightConfig, fly_many
from scp_recon.monte_carlo.summarise import summarise
from scp_recon.solution.file import Solution
from tests import reliability
from tests.scp_recon.spacecraft.short_plan import SHORT, short_plan
from tests.scp_recon.support import mission_of

PROJECT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def short() -> Mission:
    return mission_of(*SHORT)


@pytest.fixture(scope="module")
def plan(short: Mission) -> Solution:
    return short_plan(short)


@pytest.fixture(scope="module")
def config(short: Mission, plan: Solution) -> FlightConfig:
    return FlightConfig(short, plan.burns_m_s, seed=3)


@pytest.mark.parametrize("workers", [1, 2])
def test_stopped_and_continued_is_as_flown_at_once(
    config: FlightConfig, plan: Solution, tmp_path: Path, workers: int
) -> None:
    whole = fly_many(config, samples=2500)
    stopped = fly_many(config, samples=2500, workers=workers, stop=lambda: True)
    assert stopped.samples == 1000
    keep_flights(stopped, plan, tmp_path)
    begun = kept_flights(config, plan, tmp_path)
    assert begun is not None
    again = fly_many(config, samples=2500, workers=workers, begun=begun)
    assert again.samples == 2500
    # every figure, to the last bit
    assert summarise(again, plan) == summarise(whole, plan)
    np.testing.assert_array_equal(again.terminal, whole.terminal)


def test_what_suffices_already_is_not_flown_on(config: FlightConfig) -> None:
    begun = fly_many(config, samples=1000)
    again = fly_many(config, samples=5000, until=0.9, begun=begun)
    assert again.samples == 1000


@pytest.mark.parametrize("change", ["seed", "truth", "plan", "damage", "cut", "none"])
def test_other_flights_and_damaged_files_count_as_none(
    short: Mission, config: FlightConfig, plan: Solution, tmp_path: Path, change: str
) -> None:
    keep_flights(fly_many(config, samples=1000), plan, tmp_path)
    file = tmp_path / FILE_NAME
    if change == "seed":
        config = FlightConfig(short, plan.burns_m_s, seed=4)
    elif change == "truth":
        config = FlightConfig(short, plan.burns_m_s, seed=3, truth="harmonics")
    elif change == "plan":
        name = plan.scenario.model_copy(update={"name": "other"})
        plan = plan.model_copy(update={"scenario": name})
    elif change == "damage":
        file.write_bytes(b"PK" + file.read_bytes()[40:])
    elif change == "cut":
        file.write_bytes(file.read_bytes()[:-500])
    else:
        file.unlink()
    assert kept_flights(config, plan, tmp_path) is None
    reliability.count(reliability.FAULTS)


def test_ctrl_c_is_heard_once_and_then_at_once() -> None:
    with asked_to_stop() as stop:
        assert not stop()
        signal.raise_signal(signal.SIGINT)
        assert stop()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_in_another_thread_nobody_asks() -> None:
    heard: list[bool] = []

    def work() -> None:
        with asked_to_stop() as stop:
            heard.append(stop())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert heard == [False]


def test_the_command_keeps_and_continues(
    plan: Solution,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folders = tmp_path / "a", tmp_path / "b"
    for folder in folders:
        folder.mkdir()
        plan.write(folder)
    words = ("--samples", "2000", "--json")
    fly = montecarlo.fly_many

    def pressed(*given: object, **options: object) -> object:
        signal.raise_signal(signal.SIGINT)
        return fly(*given, **options)

    with monkeypatch.context() as patch:
        patch.setattr(montecarlo, "fly_many", pressed)
        assert montecarlo.main([str(folders[0]), *words]) == 130
    said = capsys.readouterr()
    assert json.loads(said.out)["samples"] == 1000
    assert "1000 flights are kept" in said.err
    assert not (folders[0] / "montecarlo.json").exists()
    first = montecarlo.main([str(folders[0]), *words])
    assert "continued after 1000 flights" in capsys.readouterr().err
    second = montecarlo.main([str(folders[1]), *words])
    assert first == second in (0, 4)
    results = [(folder / "montecarlo.json").read_bytes() for folder in folders]
    assert results[0] == results[1]
    assert not (folders[0] / FILE_NAME).exists()


@pytest.mark.parametrize("workers", ["1", "2"])
def test_ctrl_c_at_the_terminal_keeps_what_was_flown(
    plan: Solution, tmp_path: Path, workers: str
) -> None:
    """The whole process group gets the signal, as from a terminal."""
    plan.write(tmp_path)
    words = ["montecarlo", str(tmp_path), "--samples", "100000000", "--workers", workers]
    run = subprocess.Popen(
        [sys.executable, "-m", "scp_recon", *words],
        cwd=PROJECT,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    try:
        lock, began = tmp_path / ".lock", time.monotonic()
        while not lock.exists() and time.monotonic() - began < 100.0:
            time.sleep(0.1)
        time.sleep(0.5)
        os.killpg(run.pid, signal.SIGINT)
        said, _ = run.communicate(timeout=100.0)
    finally:
        run.kill()
    assert run.returncode == 130
    assert "flights are kept" in said
    assert (tmp_path / FILE_NAME).stat().st_size > 1000
    reliability.count(reliability.FAULTS)
