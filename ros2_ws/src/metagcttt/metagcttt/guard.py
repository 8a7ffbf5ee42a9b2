"""The one place where an error in a callback ends: no message or request ends a node."""

from collections.abc import Callable
from functools import wraps
import traceback
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node

LOG_PERIOD_S = 1.0


class GuardedExecutor(SingleThreadedExecutor):
    """An executor that logs what a callback raises, and goes on.

    A service whose callback fails answers: `success` is false and `message` names the error, where
    its response has them.
    """

    def add_node(self, node: Node) -> bool:
        """Add a node and guard its services."""
        for service in node.services:
            service.callback = _answering(service.callback, service.srv_name)
        return super().add_node(node)

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Run one callback; an error in it is logged with its traceback."""
        try:
            super().spin_once(timeout_sec)
        except Exception as error:  # noqa: BLE001 - this is the guard
            _log('a callback', error)


def _answering(callback: Callable[[Any, Any], Any], name: str) -> Callable[[Any, Any], Any]:
    @wraps(callback)
    def answer(request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except Exception as error:  # noqa: BLE001 - this is the guard
            _log(name, error)
            failed = type(response)()
            if hasattr(failed, 'success'):
                failed.success = False
            if hasattr(failed, 'message'):
                failed.message = f'{type(error).__name__}: {error}'
            return failed

    return answer


def _log(what: str, error: Exception) -> None:
    text = ''.join(traceback.format_exception(error))
    get_logger('metagcttt').error(f'{what} failed: {text}', throttle_duration_sec=LOG_PERIOD_S)
