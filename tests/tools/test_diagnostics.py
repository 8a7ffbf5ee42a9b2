"""Pictures of a post-training run from its log."""

import json

from metagcttt_core.files import read_json_lines
from metagcttt_tools import diagnostics
from metagcttt_tools.common.run_log import RunLog
import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

OLD = {  # what the logs held before samples and curves
    'inner/best_step': 4.0,
    'inner/rejected': 0.25,
    'inner/first_train_loss': 2.0,
    'inner/last_train_loss': 1.0,
    'task/support_transitions': 120.0,
    'task/redraws': 0.5,
    'meta/drift': 0.1,
}


def write_run(folder, steps=30, *, samples=True, warnings=()):
    with RunLog(folder, 0) as log:
        for step in range(1, steps + 1):
            losses = {'inner/first_test_loss': 2.0, 'inner/best_test_loss': 1.5 - step / 100}
            new = {**losses, 'inner/last_test_loss': 1.6, 'inner/one_step': 0.25}
            log.write(
                step,
                {**OLD, **(new if samples else {})},
                samples={'inner/best_steps': [0, 1, 7, 8], 'task/support_sizes': [5, 50]}
                if samples
                else None,
                curves={
                    'inner/train_loss_curve': np.linspace(2, 1, 8),
                    'inner/test_loss_curve': [2.0, 1.9, 1.5, 1.6, 1.7, 1.8, 1.8, 1.9, 1.9],
                }
                if samples
                else None,
                warnings=warnings if step == 20 else (),
            )


def test_pictures_are_written_and_shown_in_tensorboard(tmp_path, capsys):
    write_run(tmp_path, warnings=['the loss rose'])
    diagnostics.main(['--run', str(tmp_path)])
    out = capsys.readouterr().out
    assert 'warning: after step 20: the loss rose' in out
    for name in ('best_steps', 'inner_losses', 'run'):
        content = (tmp_path / 'diagnostics' / f'{name}.png').read_bytes()
        assert content.startswith(b'\x89PNG')
        assert len(content) > 10_000
    events = EventAccumulator(str(tmp_path / 'tensorboard')).Reload()
    tags = events.Tags()
    assert set(tags['images']) == {f'diagnostics/{name}' for name in diagnostics.PICTURES}
    assert 'inner/rejected' in tags['scalars']
    assert {'inner/best_steps', 'task/support_sizes'} <= set(tags['histograms'])
    assert 'warnings/text_summary' in tags['tensors']


def test_the_figures_of_start_middle_and_end_are_kept(tmp_path):
    write_run(tmp_path)
    diagnostics.main(['--run', str(tmp_path), '--out', str(tmp_path / 'figures')])
    figures = json.loads((tmp_path / 'figures' / 'diagnostics.json').read_text())['results']
    assert list(figures) == ['start', 'middle', 'end']
    assert figures['middle']['outer_steps'] == [14, 16]
    end = figures['end']
    assert (end['rejected'], end['one_step']) == (0.25, 0.25)
    assert end['drift'] == pytest.approx(0.1)
    np.testing.assert_allclose(end['losses']['train'], np.linspace(2, 1, 8), rtol=1e-5)
    np.testing.assert_allclose(
        end['losses']['test'], [2.0, 1.9, 1.5, 1.6, 1.7, 1.8, 1.8, 1.9, 1.9], rtol=1e-5
    )


def test_bars_and_shares_are_those_of_the_log(tmp_path):
    write_run(tmp_path)
    records = read_json_lines(tmp_path / 'metrics.jsonl')
    over_run, whole = diagnostics.best_steps_picture(records).axes
    heights = [bar.get_height() for bar in whole.patches]
    assert heights == [0.25, 0.25, 0, 0, 0, 0, 0, 0.25, 0.25]
    tops = [area.get_paths()[0].vertices[:, 1].max() for area in over_run.collections]
    assert tops == [0.25, 0.5, 1.0]


def test_inner_losses_are_those_of_start_middle_and_end(tmp_path):
    write_run(tmp_path)
    panels = diagnostics.inner_losses_picture(read_json_lines(tmp_path / 'metrics.jsonl')).axes
    titles = [axes.get_title() for axes in panels]
    assert titles == ['outer steps 1 to 3', 'outer steps 14 to 16', 'outer steps 28 to 30']
    train, test, best = panels[0].get_lines()
    np.testing.assert_allclose(train.get_ydata(), np.linspace(2, 1, 8), rtol=1e-5)
    assert test.get_xdata().tolist() == list(range(9))
    assert (best.get_xdata()[0], best.get_ydata()[0]) == (2, 1.5)


def test_old_logs_and_unfinished_lines_are_read(tmp_path):
    write_run(tmp_path, samples=False)
    with (tmp_path / 'metrics.jsonl').open('a') as file:
        file.write('{"step": 31, "inner/best')
    assert len(read_json_lines(tmp_path / 'metrics.jsonl')) == 30
    out = tmp_path / 'pictures'
    diagnostics.main(['--run', str(tmp_path), '--out', str(out), '--no-tensorboard'])
    assert sorted(path.name for path in out.iterdir()) == [
        'best_steps.png',
        'diagnostics.json',
        'inner_losses.png',
        'run.png',
    ]
    figures = json.loads((out / 'diagnostics.json').read_text())['results']
    assert figures['end'] == {
        'outer_steps': [28, 30],
        'rejected': 0.25,
        'drift': pytest.approx(0.1),
        'losses': {},
    }


def test_many_records_become_a_hundred_points():
    records = [{'step': step, 'x': float(step)} for step in range(1, 1001)]
    groups = diagnostics.grouped(records)
    assert len(groups) == 100
    assert [record for group in groups for record in group] == records
    assert diagnostics.last_steps(groups)[:2] == [10, 20]
    assert diagnostics.means(groups, 'x')[0] == 5.5
    assert np.isnan(diagnostics.means(groups, 'y')).all()
    assert len(diagnostics.grouped(records[:7])) == 7


@pytest.mark.parametrize(
    ('content', 'message'),
    [
        (None, 'no run of metagcttt meta-train there (metrics.jsonl is missing)'),
        (json.dumps({'step': 1, 'train/loss': 2.0}) + '\n', 'holds no record of meta-post-train'),
    ],
)
def test_folder_of_something_else_is_refused(content, message, tmp_path, capsys):
    if content is not None:
        (tmp_path / 'metrics.jsonl').write_text(content)
    with pytest.raises(SystemExit, match='2'):
        diagnostics.main(['--run', str(tmp_path)])
    assert message in capsys.readouterr().err
