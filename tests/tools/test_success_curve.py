"""Success over pre-training steps: which snapshots are evaluated and how rates become a curve."""

import json

from metagcttt_core import save_checkpoint
from metagcttt_tools import success_curve
from metagcttt_tools.common.session import snapshot_folder
from metagcttt_tools.success_curve import common_steps, curve_picture, curve_rows
import numpy as np
import pytest
from tests.core.builders import random_dataset, tiny_agent
from tests.tools.tables import squeezed


def make_run(folder, steps):
    for step in steps:
        agent = tiny_agent(seed=step)
        agent.metadata = {'environment': 'pointmaze-medium-v0'}
        save_checkpoint(agent, snapshot_folder(folder, step))
    return folder


def result(*per_seed_by_budget):
    return {
        'curve': [
            {'budget': budget, 'success': float(np.mean(rates)), 'per_seed': rates}
            for budget, rates in zip((0, 50), per_seed_by_budget, strict=True)
        ]
    }


def test_steps_are_those_of_the_snapshots_in_order(tmp_path):
    runs = [make_run(tmp_path / name, (20_000, 5_000, 1_000_000)) for name in 'ab']
    (tmp_path / 'a' / 'snapshots' / 'notes').mkdir()
    assert common_steps(runs) == [5_000, 20_000, 1_000_000]


def test_runs_without_or_with_other_snapshots_are_refused_by_name(tmp_path):
    first = make_run(tmp_path / 'a', (1, 2))
    with pytest.raises(ValueError, match='b/snapshots: no snapshots; pretrain with --snapshot'):
        common_steps([first, tmp_path / 'b'])
    other = make_run(tmp_path / 'c', (1, 3))
    with pytest.raises(ValueError, match=r'c has snapshots \[1, 3\], but .*a has \[1, 2\]'):
        common_steps([first, other])


def test_several_runs_are_averaged_and_their_spread_is_the_error():
    results = [
        result([0.0, 0.2], [0.5, 0.5]),  # run 1, first step
        result([0.3, 0.5], [1.0, 1.0]),  # run 1, second step
        result([0.4, 0.6], [0.7, 0.7]),
        result([0.4, 0.4], [1.0, 1.0]),
    ]
    rows = curve_rows(results, [100, 200])
    assert [(row['step'], row['budget']) for row in rows] == [
        (100, 0),
        (100, 50),
        (200, 0),
        (200, 50),
    ]
    assert [row['success'] for row in rows] == pytest.approx([0.3, 0.6, 0.4, 1.0])
    # Two runs of 0.1 and 0.5: population deviation 0.2, over the root of 2.
    assert rows[0]['standard_error'] == pytest.approx(0.2 / np.sqrt(2))
    assert rows[3]['standard_error'] == 0


def test_one_run_is_spread_over_its_evaluation_seeds():
    (row, _) = curve_rows([result([0.2, 0.6], [1.0, 1.0])], [100])
    assert row['success'] == pytest.approx(0.4)
    assert row['standard_error'] == pytest.approx(0.2 / np.sqrt(2))


def test_picture_has_a_line_for_each_budget():
    rows = curve_rows([result([0.2], [0.4]), result([0.6], [0.8])], [100, 200])
    (axes,) = curve_picture(rows).axes
    lines = {line.get_label(): line.get_xydata().tolist() for line in axes.get_lines()}
    assert lines == {'K = 0': [[100, 0.2], [200, 0.6]], 'K = 50': [[100, 0.4], [200, 0.8]]}


@pytest.mark.mujoco
@pytest.mark.slow
def test_command_writes_results_and_picture(tmp_path, capsys):
    make_run(tmp_path / 'run', (10,))
    random_dataset([20]).save(tmp_path / 'data.npz')
    out = tmp_path / 'curve.json'
    arguments = ['--runs', str(tmp_path / 'run'), '--dataset', str(tmp_path / 'data.npz')]
    once = ['--episodes', '1', '--seeds', '0', '--processes', '1', '--out', str(out)]
    success_curve.main([*arguments, *once])
    rows = json.loads(out.read_text())['results']['curve']
    assert [(row['step'], row['budget']) for row in rows] == [(10, 0)]
    assert all(0 <= row['success'] <= 1 for row in rows)
    assert out.with_suffix('.png').read_bytes().startswith(b'\x89PNG')
    assert '| step | budget | success | standard_error |' in squeezed(capsys.readouterr().out)
