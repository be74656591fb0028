"""Work side by side: order, exceptions, and how much lies about."""

import threading
import time
from concurrent.futures import Future

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import calib
from calib.linear.parallel import in_order, one_blas_thread, workers
from calib.report import charts_of, plot, report
from calib.results.check import check
from calib.runs.calibrate import grow

COUNTS = (1, 2, 5)
SOON_S = 30


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("size", [0, 1, 3, 40])
def test_results_come_in_order_whoever_is_done_first(count, size):
    def work(i):
        time.sleep(0.003 * (i % 3 == 0))
        return i

    with workers(count):
        assert list(in_order(work, size)) == list(range(size))


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("bad", [0, 7, 29])
def test_an_exception_of_any_one_is_passed_on_in_its_turn_and_the_rest_is_not_begun(count, bad):
    begun = []

    def work(i):
        begun.append(i)
        if i == bad:
            raise ZeroDivisionError(i)
        return i

    taken = []
    with workers(count), pytest.raises(ZeroDivisionError, match=str(bad)):
        for found in in_order(work, 30):
            taken.append(found)
    assert taken == list(range(bad))
    assert max(begun) <= bad + 2 * count


def test_what_waits_when_one_fails_is_cancelled(monkeypatch):
    """Two threads, once the first is done: one fails and takes up another, the other is busy; what
    waits behind these never begins."""
    begun, busy, cancelled = [], threading.Event(), threading.Event()
    cancel = Future.cancel
    monkeypatch.setattr(Future, "cancel", lambda each: cancel(each) and cancelled.set())

    def work(i):
        begun.append(i)
        if i == 1:
            busy.wait()
            raise ZeroDivisionError
        if i > 1:
            busy.set()
            assert cancelled.wait(SOON_S)

    with workers(2), pytest.raises(ZeroDivisionError):
        list(in_order(work, 30))
    assert set(begun) <= {0, 1, 2, 3}


def test_the_first_is_done_before_there_are_threads():
    """What all of them share is computed once, by whoever calls."""
    caller, seen = threading.current_thread(), {}
    with workers(2):
        list(in_order(lambda i: seen.setdefault(i, threading.current_thread()), 6))
    assert seen[0] is caller and caller not in {seen[i] for i in range(1, 6)}


@pytest.mark.parametrize("count", COUNTS)
def test_who_leaves_early_leaves_nothing_running(count):
    begun, running = [], threading.active_count()

    def work(i):
        begun.append(i)
        return i

    with workers(count):
        results = in_order(work, 1000)
        assert next(results) == 0
        results.close()
    assert threading.active_count() == running
    assert max(begun) <= 2 * count


class Result:
    """Knows how many of its kind are alive."""

    alive = most = 0
    lock = threading.Lock()

    def __init__(self):
        with Result.lock:
            Result.alive += 1
            Result.most = max(Result.most, Result.alive)

    def __del__(self):
        with Result.lock:
            Result.alive -= 1


@pytest.mark.parametrize("count", COUNTS)
def test_no_more_than_a_few_results_are_held(count):
    Result.alive = Result.most = 0
    with workers(count):
        for result in in_order(lambda i: Result(), 200):
            time.sleep(0.0005)  # whoever takes them is slower than who makes them
            del result
    assert Result.alive == 0
    assert Result.most <= 2 * count + 2


@pytest.mark.parametrize("count", COUNTS)
def test_no_more_than_so_many_work_at_once_and_as_many_do(count):
    lock, now, most = threading.Lock(), [0], [0]
    all_there = threading.Event()

    def work(i):
        with lock:
            now[0] += 1
            most[0] = max(most[0], now[0])
        if now[0] == count:
            all_there.set()
        if i > 0:  # which is done before there are threads
            assert all_there.wait(SOON_S)
        time.sleep(0.01)
        with lock:
            now[0] -= 1

    with workers(count):
        list(in_order(work, 4 * count))
    assert most[0] == count


# --------------------------------------------------------------------------------------------- BLAS


def blas_threads() -> set[int]:
    """How many threads BLAS may use now."""
    return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}


def test_blas_has_one_thread_within_and_what_it_had_behind():
    with threadpool_limits(limits=3):
        assert one_blas_thread(blas_threads)() == {1}
        assert blas_threads() == {3}
        with pytest.raises(ZeroDivisionError):
            one_blas_thread(lambda: 1 / 0)()
        assert blas_threads() == {3}


def test_whatever_multiplies_large_matrices_has_one_thread():
    """Those that the others call: add, explain and reproduce are made of them."""
    functions = calib.fit, calib.diagnose, calib.evaluate, calib.apply, calib.export, grow
    functions += check, report, plot, charts_of
    name = one_blas_thread(blas_threads).__code__.co_name
    assert [f.__name__ for f in functions if f.__code__.co_name != name] == []
