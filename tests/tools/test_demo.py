"""The demo over real processes, and how it fails."""

import json
import os
from pathlib import Path
import shutil
import signal

from metagcttt_core import make_agent, save_checkpoint, TrajectoryDataset
from metagcttt_core.config import assets_dir
from metagcttt_tools import demo, demo_film, pack_assets
from metagcttt_tools.graph import drive
from metagcttt_tools.graph.client import MazeClient
from metagcttt_tools.graph.process import NodeFailedError, NodeProcess
import numpy as np
from PIL import Image
import pytest
from tests.core.builders import maze_walks
from tests.tools.tables import squeezed

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.mujoco]


def processes_of_this_domain(executable):
    """Process numbers of a node executable on our ROS domain."""
    domain = f'ROS_DOMAIN_ID={os.environ["ROS_DOMAIN_ID"]}'.encode()
    found = []
    for entry in Path('/proc').iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                command = (entry / 'cmdline').read_bytes()
                environment = (entry / 'environ').read_bytes().split(b'\0')
            except OSError:  # it has ended meanwhile, or is not ours to look at
                continue
            if executable.encode() in command and domain in environment:
                found.append(int(entry.name))
    return found


def test_all_goals_get_an_answer_and_results_are_written(tmp_path, capsys):
    demo.main(['--out', str(tmp_path)])
    summary = json.loads((tmp_path / 'summary.json').read_text())
    arms = list(summary['arms'].values())
    assert [len(goals) for goals in arms] == [5, 5, 5]
    assert all(goal['transitions'] > 0 and goal['adaptation_ms'] > 0 for goal in arms[2])
    reached = [sum(goal['success'] for goal in goals) for goals in arms]
    assert reached[0] < reached[2]
    assert (tmp_path / 'demo.png').stat().st_size > 20_000
    assert '| meta + TTT (K = 10) |' in squeezed(capsys.readouterr().out)


def test_robot_with_a_contract_is_sent_to_a_goal_by_each_policy(tmp_path, capsys, monkeypatch):
    assets = tmp_path / 'assets'
    shutil.copytree(assets_dir(), assets)
    tasks = '{max_s: 12.0, tasks: [{start: [-3.0, 3.0, 0.0], goal: [0.25, 1.75]}]}'
    (assets / 'diffbot' / 'tasks.yaml').write_text(tasks)
    monkeypatch.setenv('METAGCTTT_ASSETS', str(assets))
    demo.main(['--robot', 'diffbot', '--out', str(tmp_path)])
    summary = json.loads((tmp_path / 'summary.json').read_text())
    assert [len(goals) for goals in summary['arms'].values()] == [1, 1, 1]
    (base,), *adapted = summary['arms'].values()
    assert base['transitions'] == 0
    assert all(goals[0]['transitions'] > 0 for goals in adapted)
    assert any(goals[0]['success'] for goals in adapted)
    assert all(goals[0]['steps'] > 10 for goals in summary['arms'].values())
    assert (tmp_path / 'demo.png').stat().st_size > 10_000
    assert '| meta + TTT (K = 50) | ' in squeezed(capsys.readouterr().out)


@pytest.fixture
def ant_assets(tmp_path, monkeypatch):
    """Stand-ins for what the ant's preset trains, packed as that is: an untrained policy."""
    agent = make_agent('saw', obs_dim=29, act_dim=8, hidden=(8,))
    agent.metadata = {'environment': 'antmaze-medium-v0'}
    save_checkpoint(agent, tmp_path / 'policy')
    walks = maze_walks()
    rest = np.zeros((walks.num_rows, 27), np.float32)
    rest[:, 0], rest[:, 1] = 0.5, 1  # its height, and upright
    observations = np.hstack([walks.observations, rest])
    actions = np.tile(walks.actions, (1, 4))
    TrajectoryDataset.from_arrays(observations, actions, walks.terminals).save(
        tmp_path / 'walks.npz'
    )
    given = {
        'base': tmp_path / 'policy',
        'meta': tmp_path / 'policy',
        'dataset': tmp_path / 'walks.npz',
        'out': tmp_path / 'assets' / 'antmaze-medium-navigate',
    }
    flags = [word for name, path in given.items() for word in (f'--{name}', str(path))]
    pack_assets.main(['--preset', 'antmaze-medium-navigate-saw', *flags])
    monkeypatch.setenv('METAGCTTT_ASSETS', str(tmp_path / 'assets'))


def test_ant_is_sent_to_a_goal_by_the_adapting_policy_and_filmed(
    ant_assets, tmp_path, capsys, monkeypatch
):
    drive_arms = drive.drive_arms

    def one_arm_for_a_moment(arms, drives, *, goal_node, **graph):
        last = dict([arms.popitem()])
        return drive_arms(last, drives[:1], goal_node={**goal_node, 'max_steps': 15}, **graph)

    monkeypatch.setattr(drive, 'drive_arms', one_arm_for_a_moment)
    film = tmp_path / 'ant.gif'
    flags = ['--robot', 'ant', '--steps', '2', '--out', str(tmp_path / 'out')]
    demo.main([*flags, '--film', str(film)])
    summary = json.loads((tmp_path / 'out' / 'summary.json').read_text())
    assert summary['environment'] == 'antmaze-medium-v0'
    ((goal,),) = summary['arms'].values()
    assert goal['transitions'] > 0
    assert goal['steps'] == 15
    assert (tmp_path / 'out' / 'demo.png').stat().st_size > 10_000
    with Image.open(film) as frames:
        assert frames.n_frames >= 2
        width, height = frames.size
        assert width == demo_film.SIZE_PX[1]
        assert height > demo_film.SIZE_PX[0]
    assert '| meta + TTT (K = 2) | 0 of 1 |' in squeezed(capsys.readouterr().out)


@pytest.mark.parametrize(
    ('robot', 'preset'), [('ant', 'antmaze-medium-navigate-saw'), ('diffbot', 'diffbot')]
)
def test_assets_that_are_not_there_are_named_with_what_packs_them(
    robot, preset, tmp_path, capsys, monkeypatch
):
    monkeypatch.setenv('METAGCTTT_ASSETS', str(tmp_path))
    with pytest.raises(SystemExit, match='2'):
        demo.main(['--robot', robot, '--out', str(tmp_path / 'out')])
    error = ' '.join(capsys.readouterr().err.split())
    assert 'lacks base, meta, dataset.npz: `metagcttt pack-assets' in error
    assert f'--preset {preset}` packs' in error


@pytest.mark.parametrize(
    ('flags', 'reason'),
    [
        (['--film', 'a.gif'], 'film shows the ant, not point'),
        (['--robot', 'ant', '--film', 'a.mp4'], 'film must end in .gif, got a.mp4'),
        (['--robot', 'ant', '--view'], 'view shows the point maze, not ant'),
    ],
)
def test_what_cannot_be_shown_is_refused(flags, reason, capsys):
    with pytest.raises(SystemExit, match='2'):
        demo.main(flags)
    assert reason in ' '.join(capsys.readouterr().err.split())


def test_a_node_that_dies_ends_the_demo_with_its_log(tmp_path, capsys, monkeypatch):
    drive = MazeClient.drive

    def drive_then_kill(self, task_id, seed, timeout_s):
        outcome = drive(self, task_id, seed, timeout_s)
        victims = processes_of_this_domain('policy_node')
        assert victims
        for victim in victims:
            os.kill(victim, signal.SIGKILL)
        return outcome

    monkeypatch.setattr(MazeClient, 'drive', drive_then_kill)
    with pytest.raises(SystemExit, match='2'):
        demo.main(['--out', str(tmp_path)])
    error = capsys.readouterr().err
    assert 'policy_node ended with status -9' in error
    assert 'trajectories' in error  # what the node had logged


def test_a_node_that_cannot_configure_shows_its_reason(tmp_path, capsys, monkeypatch):
    assets = tmp_path / 'assets'
    shutil.copytree(assets_dir(), assets)
    (assets / 'pointmaze-medium-navigate' / 'base' / 'checkpoint.json').write_text('{}')
    monkeypatch.setenv('METAGCTTT_ASSETS', str(assets))
    monkeypatch.setattr(drive, 'START_TIMEOUT_S', 15.0)
    with pytest.raises(SystemExit, match='2'):
        demo.main(['--out', str(tmp_path / 'out')])
    assert 'not a checkpoint of this project' in capsys.readouterr().err


def test_an_unknown_executable_ends_with_what_there_is(tmp_path):
    with NodeProcess('pilot_node', {}, tmp_path / 'log') as node:
        node._process.wait(10)
        there = 'adapter_node, goal_node'
        with pytest.raises(NodeFailedError, match=f"no executable 'pilot_node'; it has: {there}"):
            node.check()
