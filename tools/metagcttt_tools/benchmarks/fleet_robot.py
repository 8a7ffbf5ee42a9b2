"""A robot of the adapter's load test, as a process of its own. Imports no PyTorch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from hashlib import blake2b
from itertools import count, cycle
from multiprocessing.connection import Connection
import time
from typing import Any, Literal

from metagcttt_interfaces.msg import Expert
from metagcttt_interfaces.srv import Adapt
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message

REPEAT_S = 1.0
_LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)


@dataclass(frozen=True)
class Drive:
    """What a robot is to do.

    Attributes:
        duration_s: It asks for so long.
        every_s: From one goal to the next, seconds.
        offset_s: Wait before the first goal, so that robots do not ask all at once.
    """

    duration_s: float
    every_s: float
    offset_s: float


@dataclass(frozen=True)
class Outcome:
    """What became of a request.

    Attributes:
        kind: `lost` is one without an answer, or accepted and without an expert.
        goal: The number of the goal.
        milliseconds: From the request to the refusal or to the expert.
        wait_ms: Of that, in the adapter's queue.
        digest: Of the expert's weights.
        reason: Of a refusal or a failure, or what was lost.
        unanswered: Calls of the service without an answer within a second.
    """

    kind: Literal['expert', 'refused', 'failed', 'lost']
    goal: int
    milliseconds: float
    wait_ms: float = 0.0
    digest: str = ''
    reason: str = ''
    unanswered: int = 0


def digest_of(weights: bytes) -> str:
    """The digest of an expert's weights."""
    return blake2b(weights, digest_size=8).hexdigest()


def drive(
    name: str, requests: list[bytes], timeout_s: float, orders: Connection[Any, Any]
) -> None:
    """Ask for experts as ordered, until the other end of the connection closes.

    Args:
        name: Of the robot.
        requests: Serialized requests, one for each goal.
        timeout_s: Longest wait for an answer and for an expert.
        orders: Brings `Drive`s and takes lists of `Outcome`s back.
    """
    rclpy.init()
    robot = _Robot(name, requests, timeout_s)
    try:
        while True:
            order = orders.recv()
            orders.send(robot.drive(order))
    except (EOFError, BrokenPipeError):
        pass  # nobody is there any more
    finally:
        robot.destroy_node()
        rclpy.try_shutdown()


class _Robot(Node):
    def __init__(self, name: str, requests: list[bytes], timeout_s: float) -> None:
        super().__init__(name)
        self._numbers = count(1)
        self._goals = cycle(range(len(requests)))
        self._requests = [deserialize_message(each, Adapt.Request) for each in requests]
        self._timeout_s = timeout_s
        self._adapter = self.create_client(Adapt, '/adapt')
        self._newest = Expert()
        self.create_subscription(Expert, '~/expert', self._on_expert, _LATCHED)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)

    def drive(self, order: Drive) -> list[Outcome]:
        if not self._adapter.wait_for_service(self._timeout_s):
            return [Outcome('lost', 0, 0.0, reason='no adapter')]
        warm_up = self._ask()  # the first one waits for DDS to find the robot
        if warm_up.kind == 'lost':
            return [warm_up]
        outcomes = []
        began = time.monotonic()
        due_s = began + order.offset_s
        while due_s < began + order.duration_s:
            time.sleep(max(0.0, due_s - time.monotonic()))
            outcomes.append(self._ask())
            due_s = max(due_s + order.every_s, time.monotonic())
        return outcomes

    def _ask(self) -> Outcome:
        goal, number = next(self._goals), next(self._numbers)
        request = self._requests[goal]
        request.robot, request.request_id = self.get_fully_qualified_name(), number
        began = time.perf_counter()
        end, accepted, unanswered = began + self._timeout_s, False, 0
        while self._newest.request_id != number and (now := time.perf_counter()) < end:
            # As a policy node does: DDS may lose a request while it still finds the adapter.
            response = self._adapter.call_async(request)
            due = min(end, now + REPEAT_S)
            self._wait(due, response.done)
            if not response.done():
                self._adapter.remove_pending_request(response)
                unanswered += 1
                continue
            answer = response.result()
            if not answer.success:
                milliseconds = 1e3 * (time.perf_counter() - began)
                return Outcome(
                    'refused', goal, milliseconds, reason=answer.message, unanswered=unanswered
                )
            accepted = True
            self._wait(due, lambda: self._newest.request_id == number)
        milliseconds, expert = 1e3 * (time.perf_counter() - began), self._newest
        outcome = partial(Outcome, goal=goal, milliseconds=milliseconds, unanswered=unanswered)
        if expert.request_id != number:
            return outcome('lost', reason='accepted, no expert' if accepted else 'no answer')
        if expert.status != Expert.DONE:
            return outcome('failed', reason=expert.reason)
        digest = digest_of(bytes(expert.weights))
        return outcome('expert', wait_ms=expert.wait_ms, digest=digest)

    def _wait(self, end: float, condition: Callable[[], bool]) -> None:
        while not condition() and (left := end - time.perf_counter()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def _on_expert(self, message: Expert) -> None:
        self._newest = message
