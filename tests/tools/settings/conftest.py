"""The data and policies of the walk over all settings."""

import json
from pathlib import Path
import shutil

from metagcttt_core import save_checkpoint, TrajectoryDataset
from metagcttt_core.training.config import PretrainConfig
from metagcttt_core.training.pretrain import pretrain
import pytest
from tests.core.builders import DATA, maze_walks, random_dataset, tiny_agent
from tests.core.robot.messages import DRIVE


@pytest.fixture(scope='session')
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two datasets, two policies of each kind, and runs of pre-training with snapshots."""
    folder = tmp_path_factory.mktemp('places')
    walks = maze_walks()
    walks.save(folder / 'walks.npz')
    half = walks.num_rows // 2
    TrajectoryDataset.from_arrays(
        walks.observations[:half], walks.actions[:half], walks.terminals[:half]
    ).save(folder / 'half.npz')
    for name, rows in (('inside', 2 * half), ('half-inside', half)):
        TrajectoryDataset.from_arrays(
            walks.observations[:rows].clip(-5, 25), walks.actions[:rows], walks.terminals[:rows]
        ).save(folder / f'{name}.npz')
    for name, kind, seed in (
        ('gcbc', 'gcbc', 0),
        ('gciql', 'gciql', 0),
        ('other', 'gcbc', 1),
        ('run-a/snapshots/000001', 'gcbc', 2),
        ('run-b/snapshots/000001', 'gcbc', 3),
        ('run-critic/snapshots/000001', 'gciql', 4),
    ):
        agent = tiny_agent(kind, seed=seed)
        agent.metadata['environment'] = 'pointmaze-medium-v0'
        agent = pretrain(agent, walks, PretrainConfig(steps=3, batch_size=16), seed)
        save_checkpoint(agent, folder / name)
    (folder / 'logged').mkdir()
    records = [{'step': step, 'train/loss': 1.0 / step} for step in (1, 2)]
    lines = ''.join(json.dumps(record) + '\n' for record in records)
    (folder / 'logged' / 'metrics.jsonl').write_text(lines)
    for name, k in (('meta-a', 1), ('meta-b', 2)):
        (folder / name).mkdir()
        (folder / name / 'metrics.jsonl').write_text(f'{{"step": 1, "inner/best_step": {k}}}\n')
    for name, data in (('mazes', 'walks'), ('half-mazes', 'half')):
        (folder / name).mkdir()
        for kind in ('navigate', 'stitch'):
            path = folder / name / f'pointmaze-medium-{kind}-v0.npz'
            shutil.copy(folder / f'{data}.npz', path)
            path.with_suffix('.json').touch()  # says that it is complete
    for name in ('nets_gcbc_pm', 'nets_gcbc_ant', 'nets_gciql_pm'):
        shutil.copy(DATA / f'{name}.npz', folder)
    (folder / 'cart.yaml').write_text(DRIVE)
    (folder / 'tasks.yaml').write_text('{max_s: 9, tasks: [{goal: {x: 1}}]}')
    (folder / 'table.csv').write_text('run,x,v\n1,1,0.1\n1,2,0.2\n2,3,0.3\n2,4,0.4\n')
    for name, observed in (('by-run', 'x'), ('by-v', 'v')):
        (folder / f'{name}.yaml').write_text(
            f'{{observations: [{observed}], actions: [v], cut: {{episode: run}}}}'
        )
    for name, column in (('state', 'observation.state'), ('action', 'action')):
        (folder / f'{name}.yaml').write_text(
            f'{{observations: [{column}], actions: [next.reward]}}'
        )
    random_dataset(obs_dim=4).save(folder / 'cart.npz')
    return folder
