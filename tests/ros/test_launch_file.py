"""The launch files, run with recorders in the place of launch and launch_ros.

The wheels have neither, so this cannot start anything; with the real ones `ros2 launch ...
--show-args` does. What the files would start runs as real processes in test_two_robots.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
import re
import runpy
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

from lifecycle_msgs.msg import Transition
from metagcttt.parameters import TABLES
import pytest
import yaml

PACKAGE = Path(__file__).parents[2] / 'ros2_ws' / 'src' / 'metagcttt'
FILES = ('lifecycle', 'metagcttt', 'two_robots')
OPTIONAL = {'recorder_node', 'visualization_node'}
OF_A_MAZE = TABLES.keys() - {'adapter_node', 'robot_bridge_node'}


class Recorder:
    """Stands for any class of launch: remembers what it was made with."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.args, self.kwargs = args, kwargs

    @property
    def kind(self) -> str:
        return type(self).__name__


NAMES = {
    'launch': ['Action', 'LaunchContext', 'LaunchDescription'],
    'launch.actions': [
        'DeclareLaunchArgument',
        'EmitEvent',
        'GroupAction',
        'IncludeLaunchDescription',
        'OpaqueFunction',
        'RegisterEventHandler',
        'SetEnvironmentVariable',
        'Shutdown',
    ],
    'launch.conditions': ['IfCondition'],
    'launch.events': [],
    'launch.events.matchers': ['matches_action'],
    'launch.events.process': ['ProcessExited'],
    'launch.launch_context': ['LaunchContext'],
    'launch.logging': ['get_logger'],
    'launch.launch_description_sources': ['PythonLaunchDescriptionSource'],
    'launch.substitutions': [
        'EnvironmentVariable',
        'LaunchConfiguration',
        'NotEqualsSubstitution',
        'PathJoinSubstitution',
    ],
    'launch_ros': [],
    'launch_ros.actions': ['LifecycleNode', 'Node'],
    'launch_ros.event_handlers': ['OnStateTransition'],
    'launch_ros.events': [],
    'launch_ros.events.lifecycle': ['ChangeState'],
    'launch_ros.parameter_descriptions': ['ParameterValue'],
    'launch_ros.substitutions': ['FindPackageShare'],
}


class Launched:
    """What a launch file describes."""

    def __init__(self, entities: list[Recorder], given: dict[str, str]) -> None:
        self.arguments = {
            e.args[0]: e.kwargs for e in entities if e.kind == 'DeclareLaunchArgument'
        }
        defaults = {name: kwargs['default_value'] for name, kwargs in self.arguments.items()}
        context = SimpleNamespace(launch_configurations=defaults | given, argv=[])
        self.entities = [inner for entity in entities for inner in _inside(entity, context)]
        self.nodes = {e.kwargs['executable']: e for e in self.entities if e.kind.endswith('Node')}

    def of_kind(self, kind: str) -> list[Recorder]:
        return [entity for entity in self.entities if entity.kind == kind]


def _inside(entity: Recorder, context: SimpleNamespace) -> Iterator[Recorder]:
    """An entity and those in a group or made by a function."""
    yield entity
    if entity.kind == 'GroupAction':
        for inner in entity.args[0]:
            yield from _inside(inner, context)
    if entity.kind == 'OpaqueFunction':
        yield from entity.kwargs['function'](context) or ()


@pytest.fixture
def launch(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Launched]:
    """Runs a launch file."""
    for module, classes in NAMES.items():
        fake = ModuleType(module)
        for name in classes:
            setattr(fake, name, type(name, (Recorder,), {}))
        monkeypatch.setitem(sys.modules, module, fake)

    monkeypatch.delitem(sys.modules, 'metagcttt.launch_arguments', raising=False)

    def run(name: str, **given: str) -> Launched:
        names = runpy.run_path(str(PACKAGE / 'launch' / f'{name}.launch.py'))
        [entities] = names['generate_launch_description']().args
        return Launched(entities, given)

    return run


def given_arguments(include: Recorder) -> dict[str, Any]:
    return dict(include.kwargs['launch_arguments'])


@pytest.mark.parametrize(
    ('file', 'finite'),
    [
        ('lifecycle', {'stepping', 'use_sim_time', 'log_level', 'visualize', 'rviz'}),
        (
            'metagcttt',
            {
                'stepping',
                'autostart',
                'use_sim_time',
                'log_level',
                'policy',
                'visualize',
                'rviz',
            },
        ),
        (
            'two_robots',
            {'stepping', 'autostart', 'use_sim_time', 'visualize', 'log_level'},
        ),
    ],
)
def test_arguments_are_described_and_finite_ones_list_their_values(
    launch, file: str, finite: set[str]
) -> None:
    arguments = launch(file).arguments
    assert all(argument['description'] for argument in arguments.values())
    assert {name for name, argument in arguments.items() if 'choices' in argument} == finite
    for name in finite:
        assert arguments[name]['default_value'] in arguments[name]['choices']


@pytest.mark.parametrize('file', FILES)
def test_every_configuration_that_is_used_is_declared(launch, file: str) -> None:
    text = (PACKAGE / 'launch' / f'{file}.launch.py').read_text(encoding='utf-8')
    launched = launch(file)
    used = set(re.findall(r"LaunchConfiguration\('(\w+)'\)", text))
    for names in re.findall(r'given\(context, ([^)]*)\)', text):
        used |= set(re.findall(r"'(\w+)'", names))
    assert used
    assert used <= launched.arguments.keys()


def test_one_robot_has_all_nodes_under_their_names(launch) -> None:
    nodes = launch('metagcttt').nodes
    assert nodes.keys() == OF_A_MAZE | {'rviz2'}
    assert all(node.kwargs['name'] == name for name, node in nodes.items())
    assert nodes['policy_node'].kind == 'LifecycleNode'
    conditional = {name for name, node in nodes.items() if 'condition' in node.kwargs}
    assert conditional == OPTIONAL | {'rviz2', 'policy_node'}


def test_rviz_is_given_the_topics_of_the_namespace(launch) -> None:
    rviz = launch('metagcttt').nodes['rviz2']
    file = yaml.safe_load((PACKAGE / 'rviz' / 'metagcttt.rviz').read_text(encoding='utf-8'))
    manager = file['Visualization Manager']
    shown = {part['Topic']['Value'] for part in manager['Displays'] + manager['Tools'][2:]}
    assert {name for name, _ in rviz.kwargs['remappings']} == shown
    assert all(name == f'/{relative}' for name, relative in rviz.kwargs['remappings'])


def test_two_robots_have_namespaces_and_clocks_of_their_own(launch) -> None:
    two, one = launch('two_robots'), launch('metagcttt')
    groups = two.of_kind('GroupAction')
    includes = two.of_kind('IncludeLaunchDescription')
    assert len(groups) == len(includes) == 2
    given = [given_arguments(include) for include in includes]
    assert [arguments['namespace'] for arguments in given] == ['robot1', 'robot2']
    for arguments in given:
        assert arguments.keys() <= one.arguments.keys()
        assert arguments['clock_topic'] == 'clock'


def test_lifecycle_is_driven_in_order_and_failure_ends_everything(launch) -> None:
    launched = launch('lifecycle')
    [include] = launched.of_kind('IncludeLaunchDescription')
    assert given_arguments(include)['policy'] == 'false'
    assert given_arguments(include).keys() <= launch('metagcttt').arguments.keys()
    assert launched.nodes.keys() == {'policy_node'}
    assert launched.nodes['policy_node'].kwargs['parameters'][1]['autostart'] is False
    handlers = [handler.args[0].kwargs for handler in launched.of_kind('RegisterEventHandler')]
    succeeded, failed = handlers
    assert (succeeded['start_state'], succeeded['goal_state']) == ('configuring', 'inactive')
    assert transition(succeeded['entities'][0]) == Transition.TRANSITION_ACTIVATE
    assert (failed['start_state'], failed['goal_state']) == ('configuring', 'unconfigured')
    assert failed['entities'][0].kind == 'Shutdown'
    [emitted] = launched.of_kind('EmitEvent')
    assert transition(emitted) == Transition.TRANSITION_CONFIGURE
    assert launched.entities.index(emitted) == len(launched.entities) - 1


def transition(emit_event: Recorder) -> int:
    return emit_event.kwargs['event'].kwargs['transition_id']


@pytest.mark.parametrize('file', FILES)
def test_parameters_given_by_launch_exist(launch, file: str) -> None:
    for name, node in launch(file).nodes.items():
        known = {parameter.name for parameter in TABLES.get(name, ())} | {'use_sim_time'}
        given = {
            key
            for part in node.kwargs.get('parameters', [])
            if isinstance(part, dict)
            for key in part
        }
        assert given <= known


@pytest.mark.parametrize('stepping', ['realtime', 'lockstep'])
def test_parameter_file_fits_the_nodes(stepping: str) -> None:
    text = (PACKAGE / 'config' / f'{stepping}.yaml').read_text(encoding='utf-8')
    sections = yaml.safe_load(text)
    assert {name.removeprefix('/**/') for name in sections} == OF_A_MAZE - OPTIONAL
    for name, section in sections.items():
        table = {parameter.name: parameter for parameter in TABLES[name.removeprefix('/**/')]}
        values = section['ros__parameters']
        assert values['stepping'] == stepping
        for key, value in values.items():
            assert type(value) is type(table[key].default), key
            assert table[key].refusal(value) == ''


@pytest.mark.parametrize('file', FILES)
def test_no_argument_masks_the_parameter_file_unless_it_is_given(launch, file: str) -> None:
    """`autostart` and `output` are what the file is about; time comes from the simulator."""
    theirs = {'autostart', 'output', 'use_sim_time'}
    for node in launch(file).nodes.values():
        parts = [part for part in node.kwargs.get('parameters', []) if isinstance(part, dict)]
        assert {key for part in parts for key in part} <= theirs


@pytest.mark.parametrize('file', ['metagcttt', 'lifecycle'])
def test_policy_is_told_of_the_adapter(launch, file: str) -> None:
    policy = launch(file, adapter='/adapt').nodes['policy_node']
    parts = [part for part in policy.kwargs['parameters'] if isinstance(part, dict)]
    assert [part['adapter'].args for part in parts if 'adapter' in part] == [('/adapt',)]


def test_an_argument_that_is_given_becomes_a_parameter_of_every_node_that_has_it(launch) -> None:
    nodes = launch('metagcttt', dataset='1.npz', environment='pointmaze-large-v0').nodes
    for name in OF_A_MAZE - {'recorder_node'}:
        keys = {parameter.name for parameter in TABLES[name]} & {'dataset', 'environment'}
        merged: dict[str, Any] = {}
        for part in nodes[name].kwargs['parameters']:
            merged |= part if isinstance(part, dict) else {}
        assert {key: merged[key].args for key in keys} == {
            key: {'dataset': ('1.npz',), 'environment': ('pointmaze-large-v0',)}[key]
            for key in keys
        }


@pytest.mark.parametrize(
    ('argv', 'problem'),
    [
        (['steping:=lockstep'], 'metagcttt.launch.py has no argument steping; it has '),
        (['stepping:=lockstep', 'params_file:=a.yaml'], 'give one of them'),
        (['stepping:=lockstep', 'sigterm_timeout:=9', 'launch-prefix:=nice'], ''),
        (['params_file:=a.yaml', 'record:=a.mcap'], ''),
    ],
)
def test_argument_that_would_be_ignored_is_refused(
    launch, monkeypatch: pytest.MonkeyPatch, argv: list[str], problem: str
) -> None:
    [check] = [e for e in launch('metagcttt').of_kind('OpaqueFunction')][:1]
    refuse = check.kwargs['function']
    context = SimpleNamespace(argv=argv)
    refuse(context)  # another file was launched, and includes this one
    monkeypatch.setattr(sys, 'argv', ['ros2', 'launch', 'metagcttt', 'metagcttt.launch.py', *argv])
    if problem:
        with pytest.raises(ValueError, match=problem):
            refuse(context)
    else:
        refuse(context)


def test_respawn_limit_that_is_no_number_is_refused(launch) -> None:
    for text in ('-1', 'three', '', '1.5'):
        with pytest.raises(ValueError, match='respawn_limit must be 0 or a positive number'):
            launch('metagcttt', respawn_limit=text)


@pytest.mark.parametrize('limit', [0, 1, 3])
def test_node_that_ends_too_often_ends_all_with_a_word(
    launch, monkeypatch: pytest.MonkeyPatch, limit: int
) -> None:
    nodes = launch('metagcttt', respawn_limit=str(limit)).nodes
    ours = [node for name, node in nodes.items() if name != 'rviz2']
    assert all(node.kwargs['respawn'] is True for node in ours)
    on_exit = nodes['goal_node'].kwargs['on_exit']
    module = sys.modules['metagcttt.launch_arguments']
    said: list[str] = []
    log = SimpleNamespace(warning=said.append, error=said.append)
    monkeypatch.setattr(module, 'get_logger', lambda _: log)
    now = 1000.0
    monkeypatch.setattr(module.time, 'monotonic', lambda: now)
    event = SimpleNamespace(process_name='goal_node-2', returncode=-9)
    running = SimpleNamespace(is_shutdown=False)
    assert on_exit(event, SimpleNamespace(is_shutdown=True)) == []
    for number in range(limit):
        assert on_exit(event, running) == []
        assert said[number].startswith('goal_node-2 ended with exit code -9 and is started again')
    now += 61.0  # what was long ago does not count
    if limit:
        assert on_exit(event, running) == []
    for _ in range(limit - 1):
        on_exit(event, running)
    [shutdown] = on_exit(event, running)
    assert shutdown.kind == 'Shutdown'
    assert said[-1] == 'goal_node-2 ended with exit code -9: shutting down all nodes'
