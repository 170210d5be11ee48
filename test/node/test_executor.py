"""The executor's loop goes on whatever a callback or a message does; no process of its own is needed."""

from __future__ import annotations

import threading
from concurrent.futures import Future
from contextlib import contextmanager

import pytest
import rclpy
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import HistoryPolicy, QoSProfile
from std_srvs.srv import SetBool, Trigger

from gsfeatloc_ros.node import executor as executor_module
from gsfeatloc_ros.node.executor import GuardedExecutor, HopelessError, Later
from gsfeatloc_ros.node.parameters import refuse_unreadable


@contextmanager
def guarded_node(now=None):
    """A node in a guarded executor, with the failures that this is told, and a function that makes it spin."""
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("guarded", context=context)
    failures = []
    executor = GuardedExecutor(failures.append, *([now] if now else []), context=context)
    executor.add_node(node)
    try:
        yield node, executor, failures
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)


def spin_until(executor, condition, times: int = 1000) -> None:
    for _ in range(times):
        if condition():
            return
        executor.spin_once(0.01)
    raise AssertionError("it does not come")


def test_a_callback_that_raises_does_not_end_the_loop():
    with guarded_node() as (node, executor, failures):
        ran = []

        def tick() -> None:
            ran.append(1)
            raise KeyError("unforeseen")

        node.create_timer(0.01, tick)
        spin_until(executor, lambda: len(ran) >= 3)
        assert [type(failure) for failure in failures] == [KeyError] * len(ran)


def test_a_message_that_cannot_be_taken_blocks_nothing(monkeypatch):
    """Out of memory while a request is taken: the service, and all else in its callback group, answers on."""
    with guarded_node() as (node, executor, failures):
        node.create_service(Trigger, "serve", lambda request, response: response)
        client = node.create_client(Trigger, "serve")
        spin_until(executor, client.service_is_ready)
        take = GuardedExecutor._take_request

        def no_memory(self, service):
            if service.srv_name == "serve" and not failures:
                take(self, service)
                raise MemoryError
            return take(self, service)

        monkeypatch.setattr(GuardedExecutor, "_take_request", no_memory)
        client.call_async(Trigger.Request())
        spin_until(executor, lambda: failures)
        again = client.call_async(Trigger.Request())
        spin_until(executor, again.done)
        assert [type(failure) for failure in failures] == [MemoryError]


@pytest.mark.parametrize("asynchronous", [False, True])
def test_of_requests_that_come_together_each_is_answered_once_and_timers_run_between(asynchronous: bool):
    served, ticks = [], []

    def serve(request, response):
        served.append(len(ticks))
        response.message = str(len(served))
        return response

    async def serve_later(request, response):
        await wait
        return serve(request, response)

    with guarded_node() as (node, executor, failures):
        wait = rclpy.task.Future()
        qos = QoSProfile(history=HistoryPolicy.KEEP_ALL)
        node.create_service(Trigger, "serve", serve_later if asynchronous else serve, qos_profile=qos)
        client = node.create_client(Trigger, "serve", qos_profile=qos)
        spin_until(executor, client.service_is_ready)
        count = 3 * executor_module._MAX_REQUESTS
        answers = [client.call_async(Trigger.Request()) for _ in range(count)]
        node.create_timer(1e-4, lambda: ticks.append(1))
        spin_until(executor, lambda: ticks)
        wait.set_result(None)
        spin_until(executor, lambda: all(answer.done() for answer in answers), 20 * count)
        assert sorted(int(answer.result().message) for answer in answers) == list(range(1, count + 1))
        assert not failures
        # They did not all come first.
        assert len(set(served)) > 1


def test_a_response_that_comes_later_costs_nothing_while_it_is_waited_for():
    done, made = Future(), []

    def serve(request, response):
        def make():
            made.append(threading.current_thread())
            response.message = done.result()
            return response

        return Later(done, make)

    with guarded_node() as (node, executor, failures):
        node.create_service(Trigger, "serve", serve)
        client = node.create_client(Trigger, "serve")
        spin_until(executor, client.service_is_ready)
        answers = [client.call_async(Trigger.Request()) for _ in range(8)]
        ticks = []
        node.create_timer(1e-3, lambda: ticks.append(1))
        spin_until(executor, lambda: len(ticks) >= 20)
        # Of many that wait none is looked at: what is done between two ticks is as much as without them.
        assert not made
        assert not [task for task, _, _ in executor._tasks if not task.done()]
        threading.Thread(target=done.set_result, args=("later",)).start()
        spin_until(executor, lambda: all(answer.done() for answer in answers))
        assert [answer.result().message for answer in answers] == ["later"] * 8
        assert set(made) == {threading.current_thread()}
        assert not failures


def test_a_response_that_cannot_be_made_later_is_a_failure():
    done = Future()
    done.set_exception(KeyError("unforeseen"))
    with guarded_node() as (node, executor, failures):
        node.create_service(Trigger, "serve", lambda request, response: Later(done, done.result))
        client = node.create_client(Trigger, "serve")
        spin_until(executor, client.service_is_ready)
        client.call_async(Trigger.Request())
        spin_until(executor, lambda: failures)
        assert [type(failure) for failure in failures] == [KeyError]


@pytest.mark.parametrize("asynchronous", [False, True])
def test_requests_that_come_together_are_begun_in_their_order(asynchronous: bool):
    """Of two transitions of a lifecycle the second may need the first."""
    begun = []

    def serve(request, response):
        begun.append(request.data)
        return response

    async def serve_later(request, response):
        serve(request, response)
        await wait
        return response

    with guarded_node() as (node, executor, failures):
        wait = rclpy.task.Future()
        node.create_service(SetBool, "serve", serve_later if asynchronous else serve)
        client = node.create_client(SetBool, "serve")
        spin_until(executor, client.service_is_ready)
        order = [True, False, False, True, False, True, True, False]
        answers = [client.call_async(SetBool.Request(data=data)) for data in order]
        spin_until(executor, lambda: len(begun) == len(order))
        wait.set_result(None)
        spin_until(executor, lambda: all(answer.done() for answer in answers))
        assert begun == order
        assert not failures


def test_a_request_that_cannot_be_taken_costs_no_other(monkeypatch):
    with guarded_node() as (node, executor, failures):
        node.create_service(Trigger, "serve", lambda request, response: response)
        client = node.create_client(Trigger, "serve")
        spin_until(executor, client.service_is_ready)
        take, numbers = GuardedExecutor._take_request, iter(range(1000))

        def no_memory_for_the_third(self, service):
            taken = take(self, service)
            if taken[1] is not None and next(numbers) == 2:
                raise MemoryError
            return taken

        monkeypatch.setattr(GuardedExecutor, "_take_request", no_memory_for_the_third)
        answers = [client.call_async(Trigger.Request()) for _ in range(6)]
        spin_until(executor, lambda: sum(answer.done() for answer in answers) == 5)
        assert [type(failure) for failure in failures] == [MemoryError]


def test_a_loop_in_which_nothing_succeeds_ends_with_a_reason(monkeypatch):
    monkeypatch.setattr(executor_module, "_REST", 0.0)
    seconds = iter(range(1000))
    with guarded_node(lambda: float(next(seconds))) as (_, executor, failures):

        def no_memory(self, *arguments):
            raise MemoryError("no wait set")

        monkeypatch.setattr(SingleThreadedExecutor, "spin_once", no_memory)

        def spin() -> None:
            for _ in range(100):
                executor.spin_once(0.0)

        with pytest.raises(HopelessError, match=r"failures in a row .* MemoryError: no wait set"):
            spin()
        assert 10 <= len(failures) < 30


def test_failures_with_successes_between_are_survived(monkeypatch):
    seconds = iter(range(10_000))
    with guarded_node(lambda: float(next(seconds))) as (node, executor, failures):
        ran = []

        def tick() -> None:
            ran.append(1)
            if len(ran) % 2:
                raise KeyError("now and then")

        node.create_timer(0.001, tick)
        spin_until(executor, lambda: len(ran) >= 50)
        assert len(failures) >= 20


@pytest.fixture(scope="module")
def node():
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("parameters", context=context)
    node.declare_parameter("number", 1)
    refuse_unreadable(node)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


def unreadable_parameters() -> list:
    of_no_type = Parameter("number", value=2).to_parameter_msg()
    of_no_type.value.type = 99
    newer = Parameter("number", value=2).to_parameter_msg()
    newer.value.type = ParameterType.PARAMETER_STRING_ARRAY + 1
    unknown = Parameter("x" * 1_000_000, value=2).to_parameter_msg()
    return [of_no_type, newer, unknown]


def callback(node, kind):
    return next(service.callback for service in node.services if service.srv_type is kind)


def test_parameters_that_rclpy_cannot_read_are_refused_with_a_reason(node):
    good = Parameter("number", value=3).to_parameter_msg()
    bad = unreadable_parameters()
    request = SetParameters.Request(parameters=[*bad, good])
    results = callback(node, SetParameters)(request, SetParameters.Response()).results
    assert [result.successful for result in results] == [False] * len(bad) + [True]
    assert all("cannot be set: " in result.reason and len(result.reason) < 1200 for result in results[:-1])
    assert node.get_parameter("number").value == 3
    for parameter in bad:
        request = SetParametersAtomically.Request(
            parameters=[Parameter("number", value=4).to_parameter_msg(), parameter]
        )
        result = callback(node, SetParametersAtomically)(request, SetParametersAtomically.Response()).result
        assert not result.successful
    assert node.get_parameter("number").value == 3
