"""Messages about wrong words and files: one line, with the file or the line."""

import json
from pathlib import Path

import pytest

import scp_recon as sr
from scp_recon.__main__ import main
from scp_recon.errors import InputError

CHAIN = {
    "c.toml": 'base = "b.toml"\n',
    "b.toml": 'base = "a.toml"\n',
    "a.toml": 'base = "recon_b"\n',
}
BROKEN = {
    "an entry": ("b.toml", "[risk]\np_chance = 1.7\n", "b.toml: risk.p_chance: got 1.7"),
    "an unknown one": ("a.toml", "[risk]\np = 0.7\n", "a.toml: risk.p: got an unknown entry"),
    "a rule": (
        "a.toml",
        "[burns]\ntimes_s = [0.0, 14000.0, 25000.0, 34842.0]\n",
        "a.toml: burns.times_s.1: got 14000 s; rule",
    ),
    "a list": ("c.toml", '[boundary]\ninitial_position_m = [1.0, 2.0, "x"]\n', "c.toml: boundary."),
}


@pytest.fixture
def chain(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for name, text in CHAIN.items():
        (tmp_path / name).write_text(text, "utf-8")
    return tmp_path


@pytest.mark.parametrize("name", BROKEN)
def test_scenario_error_names_file_of_the_entry(name, chain, capsys):
    file, text, said = BROKEN[name]
    with (chain / file).open("a", encoding="utf-8") as opened:
        opened.write(text)
    assert main(["solve", "c.toml", "--json"]) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith(f"error: {said}")
    assert json.loads(printed.out)["error"]["file"] == file
    with pytest.raises(InputError, match=said) as caught:
        sr.plan("c.toml")
    assert caught.value.file == file


def test_entry_of_no_file_names_none(chain):
    for given in ("recon_b", "c.toml"):
        with pytest.raises(InputError, match=r"^risk\.p_chance: got 1\.7"):
            sr.load_scenario(given, ["risk.p_chance=1.7"])
    (chain / "a.toml").write_text('base = "recon_bb"\n', "utf-8")
    with pytest.raises(InputError, match=r"^a\.toml: base: got 'recon_bb'"):
        sr.load_scenario("c.toml")
