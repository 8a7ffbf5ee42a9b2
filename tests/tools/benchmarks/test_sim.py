"""The simulation benchmark steps what it says, and every way of stepping is the same physics."""

import json
from pathlib import Path

from metagcttt_tools.benchmarks.sim import physics_step
from metagcttt_tools.main import main
import numpy as np
import pytest
from sim_bridge import make_simulator
from tests.tools.tables import squeezed

pytestmark = pytest.mark.mujoco


@pytest.mark.parametrize('name', ['antmaze-medium-v0', 'AntMaze_UMaze-v5', 'PointMaze_UMaze-v3'])
def test_bare_physics_ends_where_the_simulator_does(name: str) -> None:
    actions = np.random.default_rng(0).uniform(-1, 1, (20, 8 if 'nt' in name[:3] else 2))
    ends = []
    with make_simulator(name) as simulator:
        for way in (simulator.step, simulator.environment.step, physics_step(simulator)):
            simulator.reset_free(seed=3, start_xy=simulator.tasks[0].start_xy)
            for action in actions:
                way(action)
            ends.append(simulator.qpos)
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-9)
    np.testing.assert_allclose(ends[2], ends[0], atol=1e-9)


def test_report_compares_the_three_by_maze(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ['--out', str(tmp_path), '--steps', '20', '--rounds', '2']
    main(['benchmark', 'sim', *arguments, '--environments', 'pointmaze-medium-v0'])
    (row,) = json.loads((tmp_path / 'sim.json').read_text())['results']['steps_per_second']
    assert row['maze'] == 'pointmaze-medium-v0'
    assert row['simulator / environment (time)'] == pytest.approx(
        row['environment'] / row['simulator']
    )
    assert '| pointmaze-medium-v0 |' in squeezed(capsys.readouterr().out)
