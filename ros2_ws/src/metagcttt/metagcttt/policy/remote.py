"""An adapter of many robots, as one of them sees it."""

from collections.abc import Callable
import time

from metagcttt_core import TTTConfig
from metagcttt_interfaces.msg import Expert
from metagcttt_interfaces.srv import Adapt
import numpy as np
from numpy.typing import NDArray
from rclpy.lifecycle import LifecycleNode
from rclpy.task import Future

from metagcttt.adaptation_messages import request_message
from metagcttt.deployment import Deployment
from metagcttt.goal_in_force import Goal
from metagcttt.qos import LATCHED

REPEAT_S = 1.0
"""A request is repeated so often: an adapter that was killed looks alive for a while, and the one
that takes its place knows of nothing. A repetition of what is known changes nothing."""


class RemoteAdapter:
    """Asks an adapter for one expert at a time; the newest request wins.

    Each request is answered by one call, of either function, unless it is canceled or a newer one
    takes its place. All of it happens in the thread that spins the node.

    Attributes:
        name: The full name of the adapter's service.
    """

    def __init__(
        self,
        node: LifecycleNode,
        service: str,
        deployment: Deployment,
        instance: int,
        on_expert: Callable[[Expert], None],
        on_failed: Callable[[str], None],
    ) -> None:
        """Look for the adapter and listen to its experts.

        Args:
            node: The node that asks.
            service: The adapter's service.
            deployment: Policy and dataset, which have to be the adapter's.
            instance: Random number that identifies this policy in the graph.
            on_expert: Called with an expert, which is not checked yet.
            on_failed: Called with the reason why there is none.
        """
        self._node = node
        self._identity = deployment.identity
        self._instance = instance
        self._on_answer, self._on_failed = on_expert, on_failed
        self._client = node.create_client(Adapt, service)
        self.name: str = self._client.service_name
        self._robot = node.get_fully_qualified_name()
        self._experts = node.create_subscription(Expert, '~/expert', self._on_expert, LATCHED)
        self._request_id = 0
        self._waiting: Adapt.Request | None = None
        self._response: Future | None = None  # None before the request is sent
        self._cancelling: Future | None = None
        self._timeout_s = self._end_s = self._due_s = 0.0

    def ask(
        self,
        observation: NDArray[np.float64],
        goal: Goal,
        config: TTTConfig,
        timeout_s: float,
    ) -> None:
        """Ask for the expert of a goal, now or as soon as the adapter is there.

        Args:
            observation: State to adapt to, shape (obs_dim,).
            goal: The goal.
            config: The inner loop.
            timeout_s: Longest wait for the expert.
        """
        self._forget()
        self._request_id += 1
        self._waiting = request_message(
            robot=self._robot,
            instance=self._instance,
            request_id=self._request_id,
            timeout_s=timeout_s,
            identity=self._identity,
            observation=observation,
            goal=goal,
            config=config,
        )
        now_s = time.monotonic()
        self._timeout_s, self._end_s, self._due_s = timeout_s, now_s + timeout_s, now_s
        self.check_time()

    def cancel(self) -> None:
        """Give the request up; the adapter stops within one gradient step."""
        request, was_sent = self._waiting, self._response is not None
        self._forget()
        if request is not None and was_sent:
            if self._cancelling is not None:
                self._client.remove_pending_request(self._cancelling)
            request.cancel = True
            self._cancelling = self._client.call_async(request)

    def check_time(self) -> None:
        """Send the request if it is due, or give up when the time is up; to be called often."""
        if self._waiting is None:
            return
        now_s = time.monotonic()
        if now_s >= self._end_s:
            was_sent = self._response is not None
            self._forget()
            what = 'did not answer' if was_sent else 'was not there'
            self._on_failed(f'{what} within {self._timeout_s:g} s')
        elif now_s >= self._due_s and self._client.service_is_ready():
            self._due_s = now_s + REPEAT_S
            self._send(self._waiting, self._end_s - now_s)

    def _send(self, request: Adapt.Request, timeout_s: float) -> None:
        if self._response is not None:
            self._client.remove_pending_request(self._response)
        request.timeout_s = timeout_s
        request_id = request.request_id
        self._response = self._client.call_async(request)
        self._response.add_done_callback(
            lambda future: self._on_response(request_id, future.result())
        )

    def close(self) -> None:
        """Leave the adapter."""
        self.cancel()
        self._node.destroy_subscription(self._experts)
        self._node.destroy_client(self._client)

    def _forget(self) -> None:
        if self._response is not None:
            self._client.remove_pending_request(self._response)
        self._waiting = self._response = None

    def _is_waiting_for(self, request_id: int) -> bool:
        return self._waiting is not None and self._waiting.request_id == request_id

    def _on_response(self, request_id: int, response: Adapt.Response) -> None:
        if self._is_waiting_for(request_id) and not response.success:
            self._forget()
            self._on_failed(f'refused: {response.message or "without a reason"}')

    def _on_expert(self, message: Expert) -> None:
        if message.instance != self._instance or not self._is_waiting_for(message.request_id):
            return  # of an earlier request, or of this robot before it was started again
        self._forget()
        if message.status != Expert.DONE:
            self._on_failed(f'has no expert: {message.reason}')
        elif message.checkpoint != self._identity.checkpoint:
            self._on_failed(f'adapted another checkpoint, {message.checkpoint!r}')
        else:
            self._on_answer(message)
