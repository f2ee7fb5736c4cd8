"""What each command refuses: one message, a document with --json, and nothing is left behind."""

import json
import shlex
import shutil
from pathlib import Path

import pytest

from scp_recon.__main__ import COMMANDS, main
from tests import reliability
from tests.scp_recon.support import status_of

pytestmark = pytest.mark.slow

SHORT = {
    "EXACT": "risk.allocation=exact",
    "BENNU": "--body Bennu --site 55.9,41.8",
    "STONE": "--body Stone --site 55.9,41.8",
    "ORBIT": "--orbit=1.5e8,9e7,4e7,-13.5,21,9",
    "EPOCH": "--epoch 2020-01-21T20:33:17",
    "STATE": "--state -122.6 419.9 -556.2 0.0069 0.079 0.066",
}
REFUSED = """
solve --set risk.p_chanse=0.8 -> p_chance
solve --set risk.p_chance -> --set: got
solve --scenario none.toml -> none.toml: got no such file
solve --scenario recon-b -> scenario recon-b: got no such file or directory; did you mean 'recon_b'?
solve --scenario words.toml -> TOML
solve --scenario . -> got a folder
solve nightingale -> boundary.home: got
solve --set boundary.home.departure_deg=[0,10] -> boundary.home.radius_m: got nothing; required, as are
solve --set schedule.recharge_s=20000.0 -> nowhere, from 25400 s on but until -10459.8 s
solve --set burns.times_s=[0,8000,8000,34842] -> burns.times_s: got [0, 8000, 8000, 34842]
solve / -> scenario /: got a folder; must be a scenario file in TOML; solve plans
solve a --scenario b -> SCENARIO: got a and b; must be given once
solve a b -> got b; there is no such option or argument
solve --sceanrio=x -> got --sceanrio=x; there is no such option or argument; did you mean --scenario?
solve --init none.json -> none.json: got no such file
solve --init words.json -> JSON
solve --init other.json -> something/1
solve --init other.txt -> something/1
solve --init empty -> solution.json: got no such file
solve --init none.csv -> none.csv: got no such file
solve --init words.csv -> t_s
solve --init lukewarm -> init lukewarm: got no such file
solve --init '' -> --init: got ''; must be cold, warm or a file
solve --out words.csv -> --out
solve --out words.csv/below -> --out
solve --out '' -> --out: got ''; must be a folder
solve --out runs/latest -> --out: got runs/latest, which points to
solve --certify perhaps -> --certify: got 'perhaps'; must be yes or no
solve --certify yes -> --certify: got yes; goes with risk.allocation = exact only
solve --certify yes --problem P3 --set EXACT -> --certify: got yes; goes with --problem P2
solve --certify no --problem P3 --set EXACT -> --certify: got no; goes with --problem P2
solve --objective probability --problem P3 --set EXACT -> --objective: got probability; goes with
solve --problem P4 -> --problem: got 'P4'; must be one of P2, P3
solve --formulation folded -> --formulation: got 'folded'; must be one of condensed
solve --facet-rounds -1 -> --facet-rounds: got -1; must be a whole
solve --facet-rounds many -> --facet-rounds: got 'many'
solve --facet-rounds 1000000 -> --facet-rounds: got 1000000; must be a whole
solve --starts=0 -> must be a whole number from 1 to 1000
solve --starts=two -> must be a whole number from 1 to 1000
solve --starts=1.5 -> must be a whole number from 1 to 1000
solve --starts=1001 -> must be a whole number from 1 to 1000
solve --algorithm sqp -> --algorithm: got 'sqp'; must be one of scvx, ptr, scvx-star
solve --solver simplex -> --solver: got 'SIMPLEX'; must be one of CLARABEL
solve --method ipopt --solver ECOS -> --solver: got ECOS; goes with --method scp
solve --method ipopt --algorithm ptr -> --algorithm: got ptr; goes with
solve --method ipopt --starts 2 -> --starts: got 2; goes with --method scp only
solve --method ipopt --seed 0 -> --seed: got 0; goes with --method scp only
solve --seed 0 -> --seed: got 0; goes with --starts of 2 or more
solve --starts 1 --workers 2 -> --workers: got 2; goes with --starts of 2 or more
solve --starts 2 --objective probability --set EXACT -> --starts: got 2; goes with --objective delta-v
solve --objective probability --dv-budget 115 --set EXACT -> --dv-budget: got 115 m/s; must be at
solve --starts 2 --set EXACT --set risk.p_chance=0.9999 -> risk.p_chance: got 0.9999; takes 3000000
verify none -> none
montecarlo none -> none
montecarlo plan --miss 9 -> --miss: got 9; must be a burn that is planned, 1 to 4
simulate none -> none
compare none -> none
report none -> none
campaign none --out out -> none
schema words.csv/schema.json -> words.csv
schema words.toml -> FILE: got words.toml; must be a file that ends in .json
design recon_b --out '' -> --out: got ''; must be a folder
design recon_b --set 'design.departure_s=[0, 9]' -> design.departure_s: got 0 to 9 s; goes with boundary
design recon_b --set 'burns.times_s=[0, 34842]' -> burns.times_s: got 2 burns; must be at least 3
design recon_b --set schedule.recharge_s=20000.0 -> 25400 s after the one before it: 76200 to 34842 s is
design recon_b --set observation.window_s=[1000,2000] -> burn 1 is left 0 to -3800 s (burn 1 at least
design recon_b --set boundary.home.departure_deg=[0,10] -> boundary.home.radius_m: got nothing
design recon_b --formulation frozen-stm -> got --formulation frozen-stm; there is no such option
design recon_b --facet-rounds=-1 -> --facet-rounds
explore none.toml -> none.toml: got no such file
explore nightingale -> boundary.home: got a home orbit that is flown, or has free phases
explore recon_b --port 80000 -> --port: got 80000; must be a whole number from 0 to 65535
windows -> SCENARIO: got nothing; must be given
windows nothing.toml -> nothing.toml
windows recon_b --span-days -> --span-days: got nothing; must have a value
windows recon_b --span-days 1000 -> 0.01 to 100
windows recon_b --span-days nan -> 0.01 to 100
windows recon_b --from -1x -> --from: got '-1x', which begins as an option does; write --from=-1x
windows recon_b --from yesterday -> must be a date
windows recon_b --from 2020-01-21T20:33:17Z -> without a zone
windows recon_b --from 2029-01-01 -> within 100 days
windows recon_b --csv no/such/folder/w.csv -> --csv
windows recon_b --csv words.toml -> --csv: got words.toml; must be a file that ends in .csv
windows recon_b --span-days 0.1 --chart w.doc -> --chart
new mine --body Bennu EPOCH -> --site
new mine --body Bennu --site 95,0 EPOCH -> within 90 deg
new mine --body Bennu --site north EPOCH -> must be 2 numbers
new mine BENNU EPOCH --gm 5 -> --gm must be left out
new mine STONE EPOCH -> needs --gm, --radius, --period, --pole, --orbit
new mine STONE EPOCH --gm 2e10 --radius 165 --period 12 --pole 90,-66 ORBIT -> 1e+06 kg/m^3 with --r
new mine BENNU -> --epoch
new mine BENNU --epoch soon -> must be a date
new mine BENNU --epoch 1850-01-01 -> --epoch: got 1850-01-01T00:00:00 of Bennu; must be from 2012
new mine BENNU --from-csv nothing.csv EPOCH -> nothing.csv
new mine BENNU --from-csv nothing.csv -> --epoch
new mine BENNU --from-oem nothing.oem -> nothing.oem
new mine BENNU --from-oem x --from yesterday -> UTC
new mine BENNU --from-oem x --from 1960-01-01 -> 1972
new mine BENNU --from-oem x --spacecraft=-64 -> --spacecraft: got -64; must be left out
new mine BENNU EPOCH --from 2020-01-21T20:33:17 -> --from: got
export plan -> --format
export none --format oem -> none
export plan --format xls -> --format: got 'xls'; must be one of oem
export plan --format csv --spacecraft=64 -> must be a whole number from -99999 to -1
export plan --format csv --spacecraft=-0 -> whole number
export plan --format csv --spacecraft=-123456789 -> whole number
export plan --format csv --vehicle dare.toml -> --vehicle: got dare.toml; goes with --format ck
export plan --format csv --out words.csv -> --out
replan none --at 17000 STATE -> none
replan plan --at 17000 STATE --out '' -> --out: got ''; must be a folder
replan plan --at 17000 STATE --out plan -> --out: got plan, which holds the plan in flight
replan plan --at noon STATE -> --at: got 'noon'; must be seconds
replan plan --at 2020-01-22T03:46:37Z STATE -> --at: got '2020-01-22T03:46:37Z'
replan plan --at 2019-01-22T03:46:37 STATE -> --at: got -31510000.184 s
replan plan --at 17000 --state 1 2 3 4 5 -> --state: got 5 numbers; must be six
replan plan --at 17000 --state nowhere.txt -> --state nowhere.txt: got no such file
replan plan --at 17000 STATE --measured-burn 2=0,0,0.1 --measured-burn=2=0,0,0.2 -> got burn 2 twice
replan plan --at 17000 STATE --measured-burn 0.1,0.2,0.3 -> --measured-burn: got '0.1,0.2,0.3'
replan plan --at 17000 STATE --measured-burn 1 -> --measured-burn: got '1'; must read N=X,Y,Z
replan plan --at 17000 STATE --covariance-frame rtn -> --covariance-frame: got rtn; goes with
replan plan --at 17000 STATE --covariance small.txt -> --covariance small.txt: got 2 rows of 2 numbers
replan plan --at 17000 STATE --covariance bad.txt -> --covariance: got
replan plan --at 26000 STATE --free-times -> --free-times: got only burn 4 at 34842 s left
replan plan --at 17000 STATE --free-times --set schedule.recharge_s=20000.0 -> 21800 s' is broken
replan plan --at 17000 STATE --arrive-by noon -> --arrive-by: got 'noon'; must be a number
replan plan --at 17000 STATE --free-times --arrive-by 4e4 --set burns.times_s=[0] -> --arrive-by
replan plan --at 17000 STATE --free-times --formulation frozen-stm -> got --formulation frozen-stm
replan plan --at 17000 STATE --set in_flight.at_s=9000.0 -> --set: got another in_flight
replan plan --at 17000 STATE --set burns.times_s=[0.0,7000.0,25000.0,34842.0] -> burns.times_s: got
"""


@pytest.fixture(scope="module")
def folder(verified, tmp_path_factory) -> Path:
    """A plan, and files that are no scenario, no solution, no table and no covariance."""
    folder = tmp_path_factory.mktemp("bad")
    for name in ("plan", "empty"):
        (folder / name).mkdir()
    verified.write(folder / "plan")
    for name, text in {
        "words.toml": "not a scenario at all",
        "words.json": "not a solution",
        "other.json": '{"schema": "something/1"}',
        "other.txt": ' {"schema": "something/1"}',
        "words.csv": "no,table,of\nstates,at,all\n",
        "small.txt": "1 0\n0 1\n",
        "bad.txt": "\n".join(
            " ".join("-1" if i == j == 3 else str(int(i == j)) for j in range(6)) for i in range(6)
        ),
    }.items():
        (folder / name).write_text(text, "utf-8")
    return folder


@pytest.mark.parametrize(
    "line",
    [*REFUSED.strip().splitlines(), *(f"{name} --no-such-option -> got" for name in COMMANDS)],
)
def test_bad_input_is_one_message_and_document(line, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    before = set(folder.rglob("*"))
    words, _, said = line.partition(" -> ")
    for short, long in SHORT.items():
        words = words.replace(short, long)
    status = status_of(main, *shlex.split(words), "--json", "--quiet")
    printed = capsys.readouterr()
    error = json.loads(printed.out)["error"]
    assert status == json.loads(printed.out)["status"] == 2
    assert said in error["message"]
    assert printed.err == f"error: {error['message']}\n"
    if "entry" in error:
        assert error["message"].endswith(
            f"{error['entry']}: got {error['given']}; {error['allowed']}"
        )
    assert set(folder.rglob("*")) == before
    reliability.count(reliability.BAD_INPUTS)


def test_refused_flights_draw_no_bar(folder, capsys):
    assert status_of(main, "montecarlo", str(folder / "plan"), "--miss", "9") == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1


def test_flights_of_unrequired_drifts_say_so(folder, tmp_path, capsys):
    plan = shutil.copytree(folder / "plan", tmp_path / "plan")
    assert status_of(main, "montecarlo", str(plan), "--miss", "2", "--samples", "100") == 0
    printed = capsys.readouterr().out
    assert "nothing is required" in printed
    assert "as required" not in printed
