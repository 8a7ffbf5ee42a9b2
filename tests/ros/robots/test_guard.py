"""No message ends the node of a simulated robot."""

import os
import signal

from metagcttt_robots.main import _run
import pytest
from rclpy.node import Node


class Clumsy(Node):
    def __init__(self) -> None:
        super().__init__('clumsy')
        self.calls = 0
        self.create_timer(0.01, self._stumble)

    def _stumble(self) -> None:
        self.calls += 1
        if self.calls == 3:
            os.kill(os.getpid(), signal.SIGINT)
        raise KeyError('shoulder_joint')


@pytest.mark.usefixtures('ros_domain')
def test_a_callback_that_fails_is_logged_and_called_again(capfd) -> None:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    nodes: list[Clumsy] = []
    try:
        assert _run(lambda: nodes.append(Clumsy()) or nodes[0]) == 0
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert nodes[0].calls == 3
    assert "KeyError: 'shoulder_joint'" in capfd.readouterr().err
