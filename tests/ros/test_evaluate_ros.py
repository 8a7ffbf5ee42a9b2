"""Evaluation through the graph: the same episodes as without ROS, and settings it cannot have."""

import json
from pathlib import Path

from metagcttt_core import make_agent, save_checkpoint
from metagcttt_tools import evaluate, evaluate_ros
import pytest
import torch

from tests.tools.tables import squeezed

pytestmark = pytest.mark.mujoco


@pytest.fixture(scope='module')
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp('policy')
    agent = make_agent('gcbc', obs_dim=2, act_dim=2, hidden=(32, 32))
    agent.metadata['environment'] = 'pointmaze-medium-v0'
    agent.optimizer_state = {
        number: {
            'step': torch.tensor(100.0),
            'exp_avg': torch.zeros_like(weight),
            'exp_avg_sq': torch.full_like(weight, 1e-6),
        }
        for number, weight in enumerate(agent.trained_parameters())
    }
    save_checkpoint(agent, path)
    return path


@pytest.mark.slow
def test_success_is_that_without_ros(
    ros_domain: int, checkpoint: Path, dataset_file: Path, tmp_path: Path, capsys
) -> None:
    given = {
        'checkpoints': (checkpoint,),
        'dataset': dataset_file,
        'budgets': (0, 60),
        # Enough for an untrained policy to reach some goals.
        'ttt': {
            'lr': 0.01,
            'batch_size': 64,
            'horizon': 400,
            'optimizer_state': 'pretrained',
        },
        'filter': {'variant': 'gcttt'},
        'episodes': 1,
        'seeds': (0,),
    }
    preset = tmp_path / 'preset.yaml'
    preset.write_text(json.dumps({'evaluate': given}, default=str))
    out = tmp_path / 'graph' / 'evaluation.json'
    evaluate_ros.main(['--preset', str(preset), '--out', str(out)])
    evaluate.main(['--preset', str(preset), '--out', str(tmp_path / 'alone.json')])
    graph, alone = (
        json.loads(path.read_text())['results'] for path in (out, tmp_path / 'alone.json')
    )
    keys = ('budget', 'success', 'per_seed', 'per_task')
    for ours, theirs in zip(graph[0]['curve'], alone[0]['curve'], strict=True):
        assert [ours[key] for key in keys] == [theirs[key] for key in keys]
    assert graph[0]['curve'][1]['success'] > graph[0]['curve'][0]['success']
    assert graph[0]['auc'] == alone[0]['auc']
    assert graph[0]['curve'][1]['adapt_ms'] > 0
    assert '| K = 60 |' in squeezed(capsys.readouterr().out)
    assert (out.parent / 'logs' / 'sim_bridge_node.log').exists()


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['--ttt.ratio', '0.5'], 'ttt.ratio: policy_node has no such parameter and takes 1.0'),
        (['--filter.slack', '7'], 'filter.slack: policy_node has no such parameter and takes 5'),
        (['--checkpoints', '/nowhere'], '/nowhere'),
    ],
)
def test_settings_that_the_graph_cannot_have_are_refused(
    arguments: list[str], message: str, capsys
) -> None:
    with pytest.raises(SystemExit):
        evaluate_ros.main(arguments)
    assert message in capsys.readouterr().err
