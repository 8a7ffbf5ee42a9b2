"""Pictures of episodes: what is drawn is what was retrieved and walked."""

import json
from pathlib import Path

from metagcttt_core import load_checkpoint, TrajectoryDataset, TrajectoryFilter, TTTConfig
from metagcttt_core.config import assets_dir
from metagcttt_core.evaluation import run_episode
from metagcttt_tools import draw_episodes
import numpy as np
import pytest
from sim_bridge import make_simulator
from tests.tools.tables import squeezed

pytestmark = pytest.mark.mujoco
ASSETS = assets_dir() / 'pointmaze-medium-navigate'


@pytest.mark.slow
def test_picture_and_table_of_a_base_and_an_adapted_policy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    draw_episodes.main(
        [
            *('--checkpoint', str(ASSETS / 'meta'), '--dataset', str(ASSETS / 'dataset.npz')),
            *('--budgets', '0', '2', '--ttt.batch-size', '32', '--out', str(tmp_path / 'view')),
        ]
    )
    rows = json.loads((tmp_path / 'view.json').read_text())['results']['episodes']
    assert [(row['policy'], row['task']) for row in rows] == [
        (arm, task) for arm in ('K = 0', 'K = 2') for task in range(1, 6)
    ]
    for row in rows:
        assert (row['transitions'] > 0) == (row['policy'] == 'K = 2')
        assert row['reached'] == ('yes' if row['steps'] < 1000 else 'no')
    assert (tmp_path / 'view.png').stat().st_size > 20_000
    assert '| K = 2 | 5 |' in squeezed(capsys.readouterr().out)


def test_retrieved_are_the_positions_of_the_support(tmp_path: Path) -> None:
    dataset = TrajectoryDataset.load(ASSETS / 'dataset.npz')
    with make_simulator('pointmaze-medium-v0') as simulator:
        episode = run_episode(
            load_checkpoint(ASSETS / 'meta'),
            simulator,
            task_id=3,
            seed=0,
            trajectory_filter=TrajectoryFilter(dataset),
            ttt=TTTConfig(steps=1, batch_size=8),
        )
    segments = draw_episodes.retrieved(episode, dataset, (0, 1))
    (support,) = episode.supports
    assert len(segments) == support.num_kept > 0
    drawn = {tuple(point) for segment in segments for point in segment}
    assert drawn >= {tuple(point) for point in dataset.observations[support.indices]}
    start = episode.observations[0]
    assert all(np.linalg.norm(segment - start, axis=1).min() <= 1.0 for segment in segments)
