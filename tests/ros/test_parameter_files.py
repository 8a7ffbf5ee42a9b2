"""Parameter files none of whose sections is for the node are named; rcl itself says which are."""

from pathlib import Path

from metagcttt.parameter_files import warn_of_unused_files
import pytest
import rclpy
from rclpy.node import Node
import yaml


class Talker(Node):
    """A node that keeps what it warns of."""

    def __init__(self, **kwargs) -> None:
        super().__init__(
            'policy_node', automatically_declare_parameters_from_overrides=True, **kwargs
        )
        self.warnings = []

    def get_logger(self):
        return self

    def warning(self, text: str) -> None:
        self.warnings.append(text)


def outcome(file: Path, namespace: str) -> tuple[bool, list[str]]:
    """Whether rcl took the parameters of a file, and the warnings."""
    argv = ['node', '--ros-args', '--params-file', str(file)]
    context = rclpy.Context()
    rclpy.init(args=argv, context=context)
    try:
        node = Talker(context=context, namespace=namespace)
        warn_of_unused_files(node, argv)
        found = node.has_parameter('seed'), node.warnings
        node.destroy_node()
        return found
    finally:
        context.shutdown()


@pytest.mark.parametrize('namespace', ['', '/left', '/left/front'])
@pytest.mark.parametrize(
    'section',
    [
        'policy_node', '/policy_node', 'left/policy_node', '/left/policy_node', 'left', 'policy',
        '/**', '/*', '/*/policy_node', '/**/policy_node', '/left/*', '/left/**', '/**/front/*',
        'policy_nodes', '/lef/policy_node', '/left/front/policy_node', '/*/*/policy_node',
    ],
)  # fmt: skip
def test_file_is_named_where_rcl_ignores_it(tmp_path: Path, section: str, namespace: str) -> None:
    file = tmp_path / 'robot.yaml'
    file.write_text(yaml.safe_dump({section: {'ros__parameters': {'seed': 3}}}))
    taken, warnings = outcome(file, namespace)
    name = f'{namespace}/policy_node'
    expected = f'{file} is ignored: it has parameters of /{section.strip("/")}, and this is {name}'
    assert warnings == ([] if taken else [expected])


def test_namespaces_as_mappings_count(tmp_path: Path) -> None:
    file = tmp_path / 'robot.yaml'
    file.write_text(
        'left: {goal_node: {ros__parameters: {seed: 1}}}\n'
        'right: {goal_node: {ros__parameters: {seed: 1}}}\n'
    )
    taken, warnings = outcome(file, '/left')
    assert not taken
    assert warnings == [
        f'{file} is ignored: it has parameters of /left/goal_node, /right/goal_node, '
        'and this is /left/policy_node'
    ]
    file.write_text(yaml.safe_dump({'left': {'policy_node': {'ros__parameters': {'seed': 1}}}}))
    assert outcome(file, '/left') == (True, [])
