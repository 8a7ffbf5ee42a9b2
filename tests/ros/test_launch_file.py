"""The launch file, run with recorders in the place of launch and launch_ros.

The wheels have neither, so this cannot start anything; with the real ones `ros2 launch ...
--show-args` does.
"""

from pathlib import Path
import runpy
import sys
from types import ModuleType, SimpleNamespace

from metagcttt.parameters import TABLES
import pytest
import yaml

PACKAGE = Path(__file__).parents[2] / 'ros2_ws' / 'src' / 'metagcttt'


OPTIONAL = {'recorder_node', 'visualization_node'}


class Recorder:
    """Stands for any class of launch: remembers what it was made with."""

    def __init__(self, *args, **kwargs) -> None:
        self.args, self.kwargs = args, kwargs


NAMES = {
    'launch': ['LaunchDescription'],
    'launch.actions': ['DeclareLaunchArgument', 'SetEnvironmentVariable'],
    'launch.substitutions': ['EnvironmentVariable', 'LaunchConfiguration', 'PathJoinSubstitution'],
    'launch_ros': [],
    'launch_ros.actions': ['LifecycleNode', 'Node'],
    'launch_ros.parameter_descriptions': ['ParameterValue'],
    'launch_ros.substitutions': ['FindPackageShare'],
}


@pytest.fixture
def launched(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """The arguments and nodes of the launch file."""
    for module, classes in NAMES.items():
        fake = ModuleType(module)
        for name in classes:
            setattr(fake, name, type(name, (Recorder,), {}))
        monkeypatch.setitem(sys.modules, module, fake)
    names = runpy.run_path(str(PACKAGE / 'launch' / 'metagcttt.launch.py'))
    [entities] = names['generate_launch_description']().args
    return SimpleNamespace(
        arguments={a.args[0]: a.kwargs for a in entities if 'description' in a.kwargs},
        nodes={e.kwargs['executable']: e for e in entities if 'executable' in e.kwargs},
    )


def test_every_argument_is_described_and_finite_ones_list_their_values(launched) -> None:
    assert all(argument['description'] for argument in launched.arguments.values())
    listed = {name for name, argument in launched.arguments.items() if 'choices' in argument}
    assert listed == {'stepping', 'autostart', 'use_sim_time', 'log_level'}


def test_all_nodes_start_under_their_names(launched) -> None:
    assert launched.nodes.keys() == TABLES.keys() - OPTIONAL
    assert all(node.kwargs['name'] == name for name, node in launched.nodes.items())
    assert type(launched.nodes['policy_node']).__name__ == 'LifecycleNode'


def test_parameters_given_by_launch_exist(launched) -> None:
    for name, node in launched.nodes.items():
        known = {parameter.name for parameter in TABLES[name]} | {'use_sim_time'}
        given = {
            key for part in node.kwargs['parameters'] if isinstance(part, dict) for key in part
        }
        assert given <= known


@pytest.mark.parametrize('stepping', ['realtime', 'lockstep'])
def test_parameter_file_fits_the_nodes(stepping: str) -> None:
    text = (PACKAGE / 'config' / f'{stepping}.yaml').read_text(encoding='utf-8')
    sections = yaml.safe_load(text)
    assert {name.removeprefix('/**/') for name in sections} == TABLES.keys() - OPTIONAL
    for name, section in sections.items():
        table = {parameter.name: parameter for parameter in TABLES[name.removeprefix('/**/')]}
        values = section['ros__parameters']
        assert values['stepping'] == stepping
        for key, value in values.items():
            assert type(value) is type(table[key].default), key
            assert table[key].refusal(value) == ''
