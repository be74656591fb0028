"""Workers in other processes: order, errors, ends of all kinds, and what travels."""

import logging
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from calib.effects.own.files import from_file
from calib.linear.parallel import executing, in_order, over_stops
from calib.linear.parallel.parcels import LackingError, Parcels
from calib.residuals.beams import Association
from chains.errors import InputError

COUNTS = (2, 3)
SOON_S = 30
WORK = """
    import os, signal, time

    def after(shared, scan, seconds):
        time.sleep(seconds)
        return shared, scan.name

    def fails(scan, error):
        if error is not None:
            raise error
        return scan.name

    def dies_once(marker, scan):
        if scan.name == "1" and not os.path.exists(marker):
            open(marker, "w").close()
            os.kill(os.getpid(), signal.SIGKILL)
        return scan.name

    def dies(scan):
        if scan.name == "1":
            os._exit(7)
        return scan.name

    def pid(scan):
        return os.getpid()

    def told(scan):
        print("on stdout", flush=True)
        return scan.name

    def beams(scan, met):
        return int(met.part.sum())

    def not_sent(scan):
        return lambda: None

    def path(path, scan):
        return str(path), os.path.exists(path)
"""


def scans(count):
    return [SimpleNamespace(name=str(i)) for i in range(count)]


def names(count):
    return [str(i) for i in range(count)]


def warnings_of(caplog):
    """What is said whether or not an earlier test asked for more."""
    return [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING]


@pytest.fixture
def work(tmp_path, monkeypatch):
    """A module that workers find where this process does."""
    (tmp_path / "work_of_stops.py").write_text(textwrap.dedent(WORK))
    monkeypatch.syspath_prepend(tmp_path)
    import work_of_stops

    yield work_of_stops
    del sys.modules["work_of_stops"]


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("stops", [0, 1, 2, 17])
def test_results_come_in_the_order_of_stops_whoever_is_done_first(work, count, stops):
    wait_s = [0.02 * (i % 3 == 0) for i in range(stops)]
    with executing(count):
        found = list(over_stops(partial(work.after, {"state": 1}), scans(stops), wait_s))
    assert found == [({"state": 1}, name) for name in names(stops)]


def test_a_stop_is_asked_of_the_same_worker_each_time(work):
    with executing(2):
        first, again = (list(over_stops(work.pid, scans(7))) for _ in range(2))
    assert first == again and len(set(first)) == 2 and os.getpid() not in first


@pytest.mark.parametrize("error", [InputError("scan 3 is empty"), ZeroDivisionError("3")])
def test_an_error_is_passed_on_in_its_turn(work, error):
    taken, errors = [], [error if i == 3 else None for i in range(9)]
    with executing(2), pytest.raises(type(error), match=str(error)):
        for found in over_stops(work.fails, scans(9), errors):
            taken.append(found)
    assert taken == names(3)


def test_after_an_error_the_workers_go_on(work):
    with executing(2):
        with pytest.raises(KeyError):
            list(over_stops(work.fails, scans(5), [KeyError("x")] * 5))
        assert list(over_stops(work.fails, scans(5), [None] * 5)) == names(5)


def test_what_is_printed_in_a_worker_goes_to_stderr(work, capfd):
    with executing(2):
        assert list(over_stops(work.told, scans(3))) == names(3)
    out, err = capfd.readouterr()
    assert (out, err.count("on stdout")) == ("", 3)


# ------------------------------------------------------------------------------ workers that end


def test_another_goes_on_with_the_stops_of_a_worker_that_was_killed(work, tmp_path, caplog):
    with executing(2), caplog.at_level(logging.WARNING, "rigcal"):
        found = list(over_stops(partial(work.dies_once, str(tmp_path / "died")), scans(9)))
    assert found == names(9)
    (said,) = warnings_of(caplog)
    assert said == "worker 2 of 2 was ended by SIGKILL at stop '1'; another goes on with it"


def test_a_worker_that_is_killed_between_two_passes_is_replaced(work, caplog):
    with executing(2), caplog.at_level(logging.WARNING, "rigcal"):
        before = list(over_stops(work.pid, scans(4)))
        os.kill(before[0], signal.SIGKILL)
        after = list(over_stops(work.pid, scans(4)))
    assert after[1] == before[1] and after[0] == after[2] != before[0]
    assert len(warnings_of(caplog)) == 1


def test_a_stop_that_ends_every_worker_is_named(work, caplog):
    with executing(2), pytest.raises(InputError) as error:
        list(over_stops(work.dies, scans(9)))
    assert "worker 2 of 2 ended with code 7 at stop '1', 3 times; where memory" in str(error.value)
    assert len(warnings_of(caplog)) == 2


def gone(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.mark.parametrize("leaves", [None, KeyboardInterrupt, ZeroDivisionError])
def test_no_worker_outlives_who_asked_it_whatever_it_does(work, leaves):
    """Also while all are at work: leaving does not wait for them."""
    start = time.monotonic()
    with pytest.raises(leaves or ZeroDivisionError), executing(2):
        pids = list(over_stops(work.pid, scans(2)))
        results = over_stops(partial(work.after, None), scans(4), [0, 2 * SOON_S] * 2)
        next(results)
        raise leaves or ZeroDivisionError
    assert time.monotonic() - start < SOON_S
    assert all(gone(pid) for pid in pids)
    assert threading.active_count() < 8


# ------------------------------------------------------------------------------------ what travels


def test_what_beams_met_travels_once(work):
    """The second pass sends keys; what is new is sent."""
    met = [Association(np.full(10_000, i)) for i in range(4)]
    with executing(2) as crew:
        assert list(over_stops(work.beams, scans(4), met)) == [10_000 * i for i in range(4)]
        first = crew.traffic.down
        list(over_stops(work.beams, scans(4), met))
        again = crew.traffic.down - first
        met[2] = Association(np.full(10_000, 7))
        assert list(over_stops(work.beams, scans(4), met))[2] == 70_000
        changed = crew.traffic.down - first - again
    assert first > 4 * 80_000 and again < 8_000 and 80_000 < changed < 90_000
    assert crew.traffic.stops == 12


def test_a_worker_that_lets_go_of_what_it_was_sent_is_sent_it_again():
    """With room for one of three, whatever the order; and never without end."""
    here, there = Parcels(), Parcels(kept_bytes=9_000)
    some = [Association(np.full(1_000, i)) for i in range(3)]
    sent = lacked = 0
    for i in (0, 1, 0, 2, 2, 1, 0):
        parcel = here.packed(("x", some[i]), there.name)
        try:
            _, found = there.opened(parcel, here.name)
        except LackingError as lacking:
            lacked += 1
            here.held(there.name, lacking.args, holds=False)
            parcel = here.packed(("x", some[i]), there.name)
            _, found = there.opened(parcel, here.name)
        here.held(there.name, list(parcel.along))
        sent += len(parcel.along)
        np.testing.assert_array_equal(found.part, some[i].part)
        del found
    assert (sent, lacked) == (6, 3)  # 2 twice in a row is there the second time
    assert there._bytes <= 9_000


def test_an_object_that_comes_back_is_the_one_that_was_sent():
    here, there = Parcels(), Parcels(1e6)
    met = Association(np.arange(5))
    found = there.opened(here.packed([met, met], there.name), here.name)
    assert found[0] is found[1] is not met
    back = there.packed({"met": found[0]}, here.name)
    assert not back.along and here.opened(back, there.name)["met"] is met


def test_keys_of_what_is_gone_are_forgotten():
    here = Parcels()
    for i in range(50):
        here.packed(Association(np.arange(i)), None)
        here.packed([Association(np.arange(i))], None)
    assert not here._by_id and not here._by_key


def test_relative_paths_are_sent_as_absolute_ones(work, tmp_path, monkeypatch):
    (tmp_path / "rec").mkdir()
    monkeypatch.chdir("/")
    with executing(2):
        monkeypatch.chdir(tmp_path)
        found = set(over_stops(partial(work.path, Path("rec")), scans(3)))
    assert found == {(str(tmp_path / "rec"), True)}


def test_what_cannot_be_sent_is_said(work):
    with executing(2):
        with pytest.raises(InputError, match="cannot be sent to another process"):
            list(over_stops(lambda scan: scan.name, scans(3)))
        with pytest.raises(RuntimeError, match="cannot be sent: <function"):
            list(over_stops(work.not_sent, scans(3)))


EFFECT = """
from calib.effects import Effect, Param, Site
import numpy as np

def helped(view):
    return np.ones((1, 3, 1))

class Mine(Effect):
    name, site = "mine", Site.BEAM
    helper = staticmethod(helped)

    def __init__(self):
        self.power = 2.0
        self.twice = Twice()

    def params(self, rig):
        return (Param("a", "m", 0.01),)

    def basis(self, view):
        return self.twice.of(self.helper(view)) ** self.power

class Twice:
    def of(self, x):
        return 2 * x
"""
ELSEWHERE = """
import pickle, sys
effect = pickle.loads(sys.stdin.buffer.read())
print(effect.basis(None).tolist(), effect.origin["name"], effect.name)
"""


def test_an_effect_of_a_python_file_is_sent_with_its_file(tmp_path):
    """The file may be gone by then, as on another machine."""
    (tmp_path / "mine.py").write_text(EFFECT)
    (effect,) = from_file(str(tmp_path / "mine.py"))
    effect.power = 3.0
    (tmp_path / "mine.py").unlink()
    body = Parcels().packed(effect, None).body
    done = subprocess.run([sys.executable, "-c", ELSEWHERE], input=body, capture_output=True)
    assert done.stdout.decode() == "[[[8.0], [8.0], [8.0]]] Mine mine\n", done.stderr.decode()


def test_without_workers_all_is_done_here(work):
    here = [os.getpid()] * 3
    with executing(1):
        assert list(over_stops(work.pid, scans(3))) == here
    with executing():
        assert list(over_stops(work.pid, scans(3))) == here
    with executing(2):
        assert list(in_order(lambda i: os.getpid(), 3)) == here


def test_workers_and_a_cluster_are_not_asked_for_together():
    with pytest.raises(InputError, match="give one"), executing(2, "tcp://127.0.0.1:1"):
        pass
