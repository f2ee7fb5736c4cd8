"""Ctrl-C while a command is still importing ends in one line and its exit status."""

import textwrap

import pytest

from tests import reliability
from tests.helpers import usually
from tests.scp_recon.support import run_python

pytestmark = pytest.mark.slow

COMMANDS = ["scp_recon.solve", "scp_recon verify plan"]
COMMANDS += ["experiments", "paper_figs", "benchmarks"]
CASES = [
    *(("numpy", command) for command in COMMANDS),
    *((late, command) for command in COMMANDS for late in ("argparse", "rich.console")),
]
"""Each command; then the first early and late; then the others early and late."""

AS_CTRL_C = """
    import os, runpy, signal, sys
    late, module, *words = sys.argv[1:]
    def hook(event, arguments):
        if event == "import" and arguments[0] == late:
            os.kill(os.getpid(), signal.SIGINT)
    sys.addaudithook(hook)
    sys.argv[1:] = words
    runpy.run_module(module, run_name="__main__", alter_sys=True)
"""


@pytest.mark.parametrize(("late", "command"), usually(CASES, 3))
def test_ctrl_c_during_import_ends_in_one_line(late, command):
    done = run_python("-c", textwrap.dedent(AS_CTRL_C), late, *command.split())
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "\ninterrupted\n")
    reliability.count(reliability.FAULTS)
