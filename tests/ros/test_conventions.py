"""What the genuine tools ask of a node, asked the way they do."""

from collections.abc import Iterator
from pathlib import Path

from geometry_msgs.msg import Twist, TwistStamped
from metagcttt.adapter.node import AdapterNode
from metagcttt.goal.node import GoalNode
from metagcttt.policy.node import PolicyNode
from metagcttt.recorder.node import RecorderNode
from metagcttt.robot.node import RobotBridgeNode
from metagcttt.sim.node import SimBridgeNode
from metagcttt.visualization.node import VisualizationNode
from metagcttt_interfaces.msg import MazeState, PolicyStatus
import pytest
from rcl_interfaces.msg import Log, ParameterValue
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import (
    GetParameters,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.parameter import Parameter, parameter_dict_from_yaml_file, parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
import yaml

from tests.ros.graph import ANY, EVERY, Graph

CONTRACT = Path(__file__).parents[2] / 'config' / 'robots' / 'turtlebot3.yaml'
NODES = {
    'adapter_node': AdapterNode,
    'goal_node': GoalNode,
    'policy_node': PolicyNode,
    'recorder_node': RecorderNode,
    'robot_bridge_node': RobotBridgeNode,
    'sim_bridge_node': SimBridgeNode,
    'visualization_node': VisualizationNode,
}


def dump(graph: Graph, name: str) -> dict:
    """What `ros2 param dump` prints."""
    names = graph.call(ListParameters, f'{name}/list_parameters', ListParameters.Request())
    request = GetParameters.Request(names=names.result.names)
    values = graph.call(GetParameters, f'{name}/get_parameters', request).values
    return {
        key: parameter_value_to_python(value)
        for key, value in zip(request.names, values, strict=True)
    }


def load(graph: Graph, name: str, parameters: dict, file: Path) -> list[str]:
    """What `ros2 param load` reports as failed."""
    file.write_text(yaml.dump({f'/{name}': {'ros__parameters': parameters}}), encoding='utf-8')
    sent = list(parameter_dict_from_yaml_file(str(file)).values())
    request = SetParameters.Request(parameters=sent)
    results = graph.call(SetParameters, f'{name}/set_parameters', request).results
    return [
        f'{parameter.name}: {result.reason}'
        for parameter, result in zip(sent, results, strict=True)
        if not result.successful
    ]


@pytest.mark.parametrize('name', NODES)
def test_node_takes_the_parameters_that_it_gave(
    graph: Graph, tmp_path: Path, dataset_file: Path, checkpoint_folder: Path, name: str
) -> None:
    given = {
        'dataset': str(dataset_file),
        'checkpoint': str(checkpoint_folder),
        'output': str(tmp_path / 'run.mcap'),
        'adapt_lr': 1e-5,  # which the tools read back as text
        'diagnostics_period_s': 3.0,
    }
    if name == 'robot_bridge_node':
        given['contract'] = str(CONTRACT)
    graph.add(NODES[name], **given)
    before = dump(graph, name)
    assert {'use_sim_time', 'start_type_description_service'} <= before.keys()
    assert any(key.startswith('qos_overrides./') for key in before) or name == 'recorder_node'
    assert load(graph, name, before, tmp_path / 'dump.yaml') == []
    assert dump(graph, name) == before
    other = {'start_type_description_service': False}
    [refused] = load(graph, name, other, tmp_path / 'other.yaml')
    assert 'read-only' in refused


@pytest.fixture
def other_process(ros_domain: int) -> Iterator[Graph]:
    """As good as one: a participant has one type for a topic."""
    graph = Graph(ros_domain)
    yield graph
    graph.close()


def warnings(logs: list[Log]) -> list[str]:
    return [log.msg for log in logs if log.level >= Log.WARN]


def test_incompatible_quality_is_named_on_both_sides(graph: Graph, dataset_file: Path) -> None:
    logs = graph.collect(Log, '/rosout')
    graph.add(SimBridgeNode, stepping='realtime')
    graph.add(GoalNode, dataset=str(dataset_file))
    latched = QoSProfile(
        depth=1,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )
    graph.node.create_subscription(MazeState, 'state', print, latched)
    expected = (
        '/state: durability does not fit, no messages pass: this publisher offers volatile, '
        '/test_node asks for transient_local; qos_overrides./state.publisher.durability changes '
        'ours'
    )
    graph.wait(
        lambda: expected in warnings(logs),
        'the warning of the publisher',
    )
    graph.node.create_publisher(PolicyStatus, 'policy_status', ANY)
    graph.wait(
        lambda: any(
            text.startswith('/policy_status: ')
            and '/test_node offers ' in text
            and 'this subscription asks for ' in text
            for text in warnings(logs)
        ),
        'the warning of the subscription',
    )


def test_quality_can_be_overridden(graph: Graph) -> None:
    overrides = {
        'qos_overrides./state.publisher.durability': 'transient_local',
        'qos_overrides./state.publisher.depth': 7,
    }
    graph.add(SimBridgeNode, **overrides)
    states = graph.collect(MazeState, 'state', EVERY)
    graph.wait(lambda: states, 'a state, for which durability has to fit')
    other = graph.add(lambda **kwargs: SimBridgeNode(namespace='robot2', **kwargs))
    [info] = other.get_publishers_info_by_topic('/robot2/state')
    assert info.qos_profile.durability == DurabilityPolicy.VOLATILE, 'a constant was changed'


@pytest.mark.parametrize(('policy', 'value'), [('reliability', 'fast'), ('depth', -1)])
def test_override_that_is_none_is_refused_by_name(graph: Graph, policy: str, value) -> None:
    with pytest.raises(ValueError, match='state: '):
        graph.add(SimBridgeNode, **{f'qos_overrides./state.publisher.{policy}': value})


def test_parameter_that_the_node_does_not_have_is_named(graph: Graph) -> None:
    logs = graph.collect(Log, '/rosout')
    given = {'speed_factr': 2.0, 'qos_overrides./state.publisher.depht': 7, 'seed': 3}
    graph.add(SimBridgeNode, **given)
    expected = [
        'there is no parameter qos_overrides./state.publisher.depht, it is ignored; did you mean '
        'qos_overrides./state.publisher.depth?',
        'there is no parameter speed_factr, it is ignored; did you mean speed_factor?',
    ]

    def told() -> list[str]:
        return [text for text in warnings(logs) if text.startswith('there is no parameter')]

    graph.wait(lambda: len(told()) > 1, 'the warnings')
    graph.wait_for(1.5)
    assert told() == expected


def test_topic_with_two_types_is_named(graph: Graph, other_process: Graph) -> None:
    logs = graph.collect(Log, '/rosout')
    bridge = graph.add(RobotBridgeNode, contract=str(CONTRACT))
    topic = bridge._contract.act[0].topic
    genuine = Twist if bridge._contract.act[0].type.endswith('/Twist') else TwistStamped
    other = TwistStamped if genuine is Twist else Twist
    other_process.node.create_subscription(other, topic, print, 1)
    expected = (
        f'{bridge.resolve_topic_name(topic)} is geometry_msgs/msg/{genuine.__name__} here, but '
        f'/test_node subscribes to geometry_msgs/msg/{other.__name__}: no messages pass between '
        'them'
    )
    graph.wait(lambda: expected in warnings(logs), 'the warning')
    graph.wait_for(2.5)
    assert warnings(logs).count(expected) == 1


def test_number_as_text_is_a_number_only_where_one_is_declared(graph: Graph) -> None:
    node = graph.add(SimBridgeNode)
    results = node.set_parameters(
        [
            Parameter('speed_factor', value='2e0'),
            Parameter('speed_factor', value='fast'),
            Parameter('speed_factor', value='nan'),
            Parameter('speed_factor', value='1e9'),
        ]
    )
    assert [result.successful for result in results] == [True, False, False, False]
    assert node.get_parameter('speed_factor').value == 2.0


def test_each_parameter_of_a_request_is_answered_for_by_name(
    graph: Graph, dataset_file: Path
) -> None:
    graph.add(GoalNode, dataset=str(dataset_file))
    asked = [
        ParameterMessage(name='max_steps', value=ParameterValue(type=200)),
        ParameterMessage(name='', value=ParameterValue(type=2, integer_value=1)),
        ParameterMessage(name='max_step', value=ParameterValue(type=2, integer_value=1)),
        ParameterMessage(name='max_steps', value=ParameterValue(type=2, integer_value=77)),
    ]
    told = graph.call(
        SetParameters, 'goal_node/set_parameters', SetParameters.Request(parameters=asked)
    ).results
    assert [result.successful for result in told] == [False, False, False, True]
    assert 'max_steps has the type 200' in told[0].reason
    assert told[1].reason == "there is no parameter ''"
    assert told[2].reason == "there is no parameter 'max_step'; did you mean max_steps?"
    asked[3].value.integer_value = 78
    for wrong, reason in zip(asked[:3], [result.reason for result in told[:3]], strict=True):
        both = SetParametersAtomically.Request(parameters=[asked[3], wrong])
        result = graph.call(
            SetParametersAtomically, 'goal_node/set_parameters_atomically', both
        ).result
        assert (result.successful, result.reason) == (False, reason)
    assert dump(graph, 'goal_node')['max_steps'] == 77
