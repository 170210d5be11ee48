"""One worker thread: requests first, then the newest of what is offered."""

from __future__ import annotations

import threading
import time
from concurrent.futures import CancelledError

import pytest

from gsfeatloc_ros.common.stage_clock import Interrupted
from gsfeatloc_ros.node.worker import Worker

TIMEOUT = 10.0


class Gate:
    """Work that says when it has started, and waits until it is let go or interrupted."""

    def __init__(self) -> None:
        self.started = threading.Semaphore(0)
        self.go = threading.Semaphore(0)
        self.items = []

    def __call__(self, item, interrupted):
        self.items.append(item)
        self.started.release()
        deadline = time.monotonic() + TIMEOUT
        while not self.go.acquire(timeout=0.01):
            assert time.monotonic() < deadline
            if interrupted():
                raise Interrupted
        return f"did {item}"

    def wait_until_started(self):
        assert self.started.acquire(timeout=TIMEOUT)


@pytest.fixture
def gate():
    return Gate()


@pytest.fixture
def worker(gate):
    worker = Worker(gate)
    yield worker
    for _ in range(10):
        gate.go.release()
    assert worker.stop(TIMEOUT)


def test_result_of_a_request(gate, worker):
    future = worker.request("a")
    gate.go.release()
    assert future.result(TIMEOUT) == "did a"
    assert worker.dropped == 0


def test_of_what_is_offered_the_newest_waits(gate, worker):
    worker.request("busy")
    gate.wait_until_started()
    for item in "abc":
        worker.offer(item)
    assert worker.dropped == 2
    gate.go.release()
    gate.wait_until_started()
    assert gate.items == ["busy", "c"]
    gate.go.release()


def test_all_requests_are_served_in_order_and_before_what_is_offered(gate, worker):
    first = worker.request("a")
    gate.wait_until_started()
    worker.offer("offered")
    waiting = [worker.request(item) for item in "bcd"]
    for _ in range(5):
        gate.go.release()
    assert first.result(TIMEOUT) == "did a"
    assert [future.result(TIMEOUT) for future in waiting] == ["did b", "did c", "did d"]
    for _ in range(4):
        gate.wait_until_started()
    assert gate.items == ["a", "b", "c", "d", "offered"]
    assert worker.dropped == 0


def test_a_request_interrupts_what_was_offered(gate, worker):
    worker.offer("offered")
    gate.wait_until_started()
    future = worker.request("a")
    gate.wait_until_started()
    gate.go.release()
    assert future.result(TIMEOUT) == "did a"
    assert gate.items == ["offered", "a"]
    assert worker.dropped == 1


def test_a_request_does_not_interrupt_a_request(gate, worker):
    first = worker.request("a")
    gate.wait_until_started()
    second = worker.request("b")
    with pytest.raises(TimeoutError):
        first.result(0.1)
    gate.go.release()
    gate.go.release()
    assert (first.result(TIMEOUT), second.result(TIMEOUT)) == ("did a", "did b")


@pytest.mark.parametrize("offered", [True, False])
def test_who_asks_for_what_is_worked_on_shares_its_result(gate, worker, offered):
    item = "a"
    if offered:
        worker.offer(item)
    else:
        worker.request(item)
    gate.wait_until_started()
    futures = [worker.request(item), worker.request(item)]
    # It is a request now, which another does not interrupt.
    other = worker.request("b")
    gate.go.release()
    assert [future.result(TIMEOUT) for future in futures] == ["did a"] * 2
    gate.go.release()
    assert other.result(TIMEOUT) == "did b"
    assert gate.items == ["a", "b"]
    assert worker.dropped == 0


def test_who_asks_for_what_waits_shares_its_result(gate, worker):
    worker.request("busy")
    gate.wait_until_started()
    item = "a"
    worker.offer(item)
    futures = [worker.request(item), worker.request(item)]
    gate.go.release()
    gate.go.release()
    assert [future.result(TIMEOUT) for future in futures] == ["did a"] * 2
    assert gate.items == ["busy", "a"]
    assert worker.dropped == 0


def test_exception_goes_to_the_future_and_the_thread_lives_on():
    worker = Worker(lambda item, interrupted: 1 / item)
    with pytest.raises(ZeroDivisionError):
        worker.request(0).result(TIMEOUT)
    assert worker.request(2).result(TIMEOUT) == 0.5
    assert worker.stop(TIMEOUT)


def test_stop_interrupts_the_running_work_and_cancels_what_waits(gate):
    worker = Worker(gate)
    running = worker.request("a")
    gate.wait_until_started()
    waiting = worker.request("b")
    worker.offer("c")
    assert worker.stop(TIMEOUT)
    with pytest.raises(Interrupted):
        running.result(0)
    with pytest.raises(CancelledError):
        waiting.result(0)
    with pytest.raises(CancelledError):
        worker.request("d").result(0)
    worker.offer("e")
    assert gate.items == ["a"]


def test_stop_does_not_wait_for_ever():
    started, go = threading.Event(), threading.Event()

    def stubborn(item, interrupted):
        started.set()
        assert go.wait(TIMEOUT)

    worker = Worker(stubborn)
    worker.request("a")
    assert started.wait(TIMEOUT)
    assert not worker.stop(0.05)
    go.set()


def test_stop_without_work():
    assert Worker(print).stop(TIMEOUT)
