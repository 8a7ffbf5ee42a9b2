"""Callbacks that fail: the node lives, and a service answers."""

from metagcttt.guard import GuardedExecutor
from metagcttt.parameters import TABLES
import pytest
from rclpy.node import Node
from std_srvs.srv import Trigger

from tests.ros.graph import Graph


def fail(*_: object) -> None:
    raise KeyError('a mistake')


def test_node_outlives_what_its_callbacks_raise(graph: Graph) -> None:
    node = Node('faulty', context=graph.context)
    executor = GuardedExecutor(context=graph.context)
    beats = []

    def beat() -> None:
        beats.append(1)
        fail()

    node.create_service(Trigger, 'break', fail)
    node.create_timer(0.01, beat)
    executor.add_node(node)
    client = graph.node.create_client(Trigger, 'break')
    graph.wait(client.service_is_ready, 'the service')
    future = client.call_async(Trigger.Request())

    def answered() -> bool:
        executor.spin_once(timeout_sec=0.01)
        return future.done() and len(beats) > 3

    graph.wait(answered, 'the answer')
    assert (future.result().success, future.result().message) == (False, "KeyError: 'a mistake'")
    executor.shutdown()
    node.destroy_node()


@pytest.mark.parametrize('node', TABLES)
def test_no_number_of_a_node_may_be_nan(node: str) -> None:
    for parameter in TABLES[node]:
        if isinstance(parameter.default, float):
            assert 'got nan' in parameter.refusal(float('nan'))
