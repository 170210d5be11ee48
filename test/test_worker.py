"""One worker thread, newest item first."""

from __future__ import annotations

import threading
from concurrent.futures import CancelledError

import pytest

from gsfeatloc_ros.node.worker import LatestWorker

TIMEOUT = 10.0


class Gate:
    """Work that says when it has started and waits until it is let go."""

    def __init__(self) -> None:
        self.started = threading.Semaphore(0)
        self.go = threading.Semaphore(0)
        self.items = []

    def __call__(self, item):
        self.items.append(item)
        self.started.release()
        assert self.go.acquire(timeout=TIMEOUT)
        return f"did {item}"


@pytest.fixture
def gate():
    return Gate()


@pytest.fixture
def worker(gate):
    worker = LatestWorker(gate)
    yield worker
    for _ in range(10):
        gate.go.release()
    assert worker.stop(TIMEOUT)


def test_result_of_the_work(gate, worker):
    future = worker.submit("a")
    gate.go.release()
    assert future.result(TIMEOUT) == "did a"
    assert worker.dropped == 0


def test_newest_waiting_item_wins_and_all_who_waited_get_its_result(gate, worker):
    first = worker.submit("a")
    assert gate.started.acquire(timeout=TIMEOUT)
    waiting = [worker.submit(item) for item in "bcd"]
    gate.go.release()
    gate.go.release()
    assert first.result(TIMEOUT) == "did a"
    assert [future.result(TIMEOUT) for future in waiting] == ["did d"] * 3
    assert gate.items == ["a", "d"]
    assert worker.dropped == 2


def test_the_same_item_again_is_not_a_drop(gate, worker):
    worker.submit("a")
    assert gate.started.acquire(timeout=TIMEOUT)
    item = "b"
    futures = [worker.submit(item), worker.submit(item)]
    gate.go.release()
    gate.go.release()
    assert [future.result(TIMEOUT) for future in futures] == ["did b"] * 2
    assert worker.dropped == 0


def test_exception_goes_to_the_future_and_the_thread_lives_on():
    worker = LatestWorker(lambda item: 1 / item)
    with pytest.raises(ZeroDivisionError):
        worker.submit(0).result(TIMEOUT)
    assert worker.submit(2).result(TIMEOUT) == 0.5
    assert worker.stop(TIMEOUT)


def test_stop_lets_the_running_work_end_and_cancels_what_waits(gate):
    worker = LatestWorker(gate)
    running = worker.submit("a")
    assert gate.started.acquire(timeout=TIMEOUT)
    waiting = worker.submit("b")
    gate.go.release()
    assert worker.stop(TIMEOUT)
    assert running.result(0) == "did a"
    with pytest.raises(CancelledError):
        waiting.result(0)
    with pytest.raises(CancelledError):
        worker.submit("c").result(0)
    assert gate.items == ["a"]


def test_stop_does_not_wait_for_ever(gate):
    worker = LatestWorker(gate)
    worker.submit("a")
    assert gate.started.acquire(timeout=TIMEOUT)
    assert not worker.stop(0.05)
    gate.go.release()


def test_stop_without_work():
    assert LatestWorker(print).stop(TIMEOUT)
