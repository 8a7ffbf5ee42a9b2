"""Time without the jumps of the simulated clock."""

from metagcttt.clocks import JumpFreeClock
from metagcttt.converters import to_time
import pytest
from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock

from tests.ros.graph import EVERY, Graph


def test_simulated_time_goes_on_without_its_jumps(graph: Graph) -> None:
    node = graph.add(Node)
    node.set_parameters([Parameter('use_sim_time', value=True)])
    clock = JumpFreeClock(node)
    publisher = graph.node.create_publisher(Clock, '/clock', EVERY)
    graph.wait(publisher.get_subscription_count, 'who follows the clock')

    def tell(seconds: float) -> float:
        publisher.publish(Clock(clock=to_time(round(seconds * 1e9))))
        told = round(seconds * 1e9)
        graph.wait(lambda: node.get_clock().now().nanoseconds == told, 'the time')
        return clock.now_s()

    start = tell(100.0)
    assert tell(100.5) - start == pytest.approx(0.5)
    assert tell(9e8) - start == pytest.approx(0.5)  # a recording is played
    assert tell(9e8 + 0.25) - start == pytest.approx(0.75)
    assert tell(1.0) - start == pytest.approx(0.75)  # the simulator was started again
    assert tell(1.5) - start == pytest.approx(1.25)
    clock.close()
