"""Programs that tests start: each can be ended, and ends with its test."""

import sys

import pytest

from .programs import execute, script, started

ASKED = "import signal; print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)"
NESTED = f"""
import sys, tests.conftest
from tests.programs import execute
print(execute([sys.executable, "-c", {ASKED!r}]).stdout)
"""


@pytest.mark.parametrize("shell", ["", 'trap "" INT; '], ids=["in front", "in the background"])
def test_a_child_hears_ctrl_c_wherever_the_tests_run(shell):
    done = execute(["sh", "-c", shell + 'exec "$0" -c "$1"', sys.executable, NESTED])
    assert (done.stdout.strip(), done.stderr) == ("True", "")


def test_a_program_does_not_outlive_a_test_that_fails():
    with (
        pytest.raises(ZeroDivisionError),
        started([sys.executable, "-c", "import time; time.sleep(1000)"]) as process,
    ):
        _ = 1 / 0
    assert process.poll() is not None


def test_a_script_that_says_it_failed_fails(tmp_path):
    (tmp_path / "good.py").write_text("import sys; print(sys.argv[1]); sys.exit(0)")
    assert script(tmp_path / "good.py", ["x"], tmp_path) == "x\n"
    (tmp_path / "bad.py").write_text("import sys; print('so far'); sys.exit(3)")
    with pytest.raises(AssertionError, match="so far"):
        script(tmp_path / "bad.py", [], tmp_path)
