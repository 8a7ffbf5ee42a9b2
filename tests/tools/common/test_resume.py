"""`--resume` alone continues a run; what contradicts its settings is refused by name."""

import json

from metagcttt_core import (
    CheckpointError,
    load_checkpoint,
    save_checkpoint,
    TrajectoryDataset,
)
from metagcttt_core.training.checkpoint import steps_done
from metagcttt_tools import evaluate, generate, meta_train, pretrain
from metagcttt_tools.common.resume import flat, nested
from metagcttt_tools.common.session import sole_writer
from metagcttt_tools.common.sources import fingerprints
import pytest
from tests.core.builders import assert_bit_equal, maze_walks, weights_of


@pytest.fixture(scope='module')
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp('data') / 'walks.npz'
    maze_walks().save(path)
    return path


def pretrained(data, out, steps=6, **flags):
    values = {'hidden': 8, 'training.batch-size': 8, 'training.steps': steps, **flags}
    arguments = [part for name, value in values.items() for part in (f'--{name}', str(value))]
    pretrain.main(['--dataset', str(data), '--out', str(out), *arguments])
    return out


def refused(capsys, program, *arguments):
    with pytest.raises(SystemExit, match='2'):
        program.main([*map(str, arguments), '--resume'])
    return capsys.readouterr().err


def test_longer_run_equals_one_that_was_as_long_from_the_start(data, tmp_path):
    straight = pretrained(data, tmp_path / 'straight', 9, seed=3)
    extended = pretrained(data, tmp_path / 'extended', 6, seed=3)
    pretrain.main(['--out', str(extended), '--resume'])  # finished: nothing to do
    assert steps_done(extended / 'checkpoint') == 6
    pretrain.main(['--out', str(extended), '--training.steps', '9', '--resume'])
    assert_bit_equal(
        load_checkpoint(extended / 'checkpoint'),
        weights_of(load_checkpoint(straight / 'checkpoint')),
    )
    kept = json.loads((extended / 'settings.json').read_text())['settings']
    assert (kept['seed'], kept['training']['steps'], kept['hidden']) == (3, 9, [8])


def test_time_limit_is_of_one_call_alone(data, tmp_path):
    out = tmp_path / 'run'
    with pytest.raises(SystemExit, match='75'):
        pretrained(data, out, **{'time-limit': 1e-9})
    pretrain.main(['--out', str(out), '--resume'])
    assert steps_done(out / 'checkpoint') == 6


def test_post_training_continues_by_its_folder_alone(data, tmp_path):
    base = pretrained(data, tmp_path / 'base') / 'checkpoint'
    straight, extended = tmp_path / 'straight', tmp_path / 'extended'
    for out, steps in ((straight, 5), (extended, 3)):
        given = [
            '--checkpoint',
            base,
            '--dataset',
            data,
            '--out',
            out,
            '--meta.outer-steps',
            steps,
        ]
        given += ['--meta.outer-steps', steps, '--meta.inner-steps', 2, '--meta.batch-size', 8]
        meta_train.main([*map(str, given)])
    meta_train.main(['--out', str(extended), '--meta.outer-steps', '5', '--resume'])
    assert_bit_equal(
        load_checkpoint(extended / 'checkpoint'),
        weights_of(load_checkpoint(straight / 'checkpoint')),
    )


@pytest.mark.parametrize(
    ('flags', 'message'),
    [
        (['--seed', '4'], 'cannot resume, seed was 0 and is now 4'),
        (['--training.lr', '0.1'], 'cannot resume, training.lr was 0.0003 and is now 0.1'),
        (['--environment', 'antmaze-medium-v0'], "environment was None and is now 'ant"),
        (['--training.steps', '5'], 'training.steps was 6 and is now 5: a run can be extended'),
    ],
)
def test_contradicting_flag_is_refused_by_name(data, tmp_path, capsys, flags, message):
    out = pretrained(data, tmp_path / 'run')
    assert message in refused(capsys, pretrain, '--out', out, *flags)
    assert steps_done(out / 'checkpoint') == 6


def test_contradicting_preset_is_refused_unless_the_flags_restore_it(data, tmp_path, capsys):
    out = pretrained(data, tmp_path / 'run')
    preset = tmp_path / 'preset.yaml'
    preset.write_text('pretrain: {seed: 5, training: {steps: 8}}')
    arguments = ['--out', str(out), '--preset', str(preset)]
    assert 'seed was 0 and is now 5' in refused(capsys, pretrain, *arguments)
    pretrain.main([*arguments, '--seed', '0', '--resume'])
    assert steps_done(out / 'checkpoint') == 8


def test_other_data_under_the_same_name_are_refused(data, tmp_path, capsys):
    mine = tmp_path / 'walks.npz'
    mine.write_bytes(data.read_bytes())
    out = pretrained(mine, tmp_path / 'run')
    pretrain.main(['--out', str(out), '--dataset', str(data), '--training.steps', '7', '--resume'])
    walks = TrajectoryDataset.load(mine)
    TrajectoryDataset.from_arrays(-walks.observations, walks.actions, walks.terminals).save(mine)
    assert 'cannot resume, dataset was' in refused(
        capsys, pretrain, '--out', out, '--dataset', mine
    )


def test_other_base_policy_is_refused(data, tmp_path, capsys):
    bases = [pretrained(data, tmp_path / name, seed=seed) for seed, name in enumerate('ab')]
    out = tmp_path / 'meta'
    steps = ['--meta.outer-steps', '1', '--meta.inner-steps', '1', '--meta.batch-size', '8']
    given = ['--checkpoint', str(bases[0] / 'checkpoint'), '--dataset', str(data)]
    meta_train.main([*given, '--out', str(out), *steps])
    other = ['--checkpoint', bases[1] / 'checkpoint', '--out', out]
    assert 'cannot resume, checkpoint was' in refused(capsys, meta_train, *other)


def test_interrupted_evaluation_continues_by_its_file_alone(data, tmp_path, monkeypatch, capsys):
    base, out = pretrained(data, tmp_path / 'base') / 'checkpoint', tmp_path / 'evaluation.json'
    given = ['--checkpoints', base, '--dataset', data, '--budgets', 0, '--seeds', 0, 1]
    given += ['--episodes', 1, '--processes', 1, '--out', out]
    add = evaluate.JobLog.add

    def interrupted(log, job, result):
        add(log, job, result)
        if len(log.finished) == 4:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(SystemExit, match='130'):
        patch.setattr(evaluate.JobLog, 'add', interrupted)
        evaluate.main([*map(str, given)])
    assert 'episodes was 1 and is now 2' in refused(
        capsys, evaluate, '--out', out, '--episodes', 2
    )
    evaluate.main(['--out', str(out), '--resume'])
    (result,) = json.loads(out.read_text())['results']
    assert len(result['curve'][0]['per_seed']) == 2
    assert not evaluate.finished_jobs(out).exists()
    finished = out.read_bytes()
    evaluate.main(['--out', str(out), '--resume'])  # nothing to do
    assert out.read_bytes() == finished
    assert 'episodes was 1 and is now 2' in refused(
        capsys, evaluate, '--out', out, '--episodes', 2
    )
    save_checkpoint(
        load_checkpoint(pretrained(data, tmp_path / 'other', seed=1) / 'checkpoint'), base
    )
    assert 'is of other policies' in refused(capsys, evaluate, '--out', out)
    assert out.read_bytes() == finished


def test_generation_continues_by_its_file_alone(tmp_path, capsys):
    output = tmp_path / 'maze.npz'
    small = ['--kind', 'stitch', '--episodes', '2', '--rows-per-episode', '11', '--seed', '7']
    generate.main([*small, '--output', str(output), '--processes', '1'])
    before = output.read_bytes()
    generate.main(['--output', str(output), '--resume'])
    assert output.read_bytes() == before
    assert "kind was 'stitch' and is now 'explore'" in refused(
        capsys, generate, '--output', output, '--kind', 'explore'
    )


def test_folder_without_a_run_is_begun(data, tmp_path):
    out = tmp_path / 'run'
    given = ['--dataset', str(data), '--out', str(out), '--hidden', '8']
    pretrain.main([*given, '--training.steps', '2', '--resume'])
    assert steps_done(out / 'checkpoint') == 2


def test_settings_of_something_else_are_refused_with_the_file(tmp_path, capsys):
    for content, message in (
        ('[]', 'holds no settings to continue with'),
        ('{"settings": {"colour": "red"}}', "has no setting 'colour'"),
    ):
        (tmp_path / 'settings.json').write_text(content)
        text = refused(capsys, pretrain, '--out', tmp_path)
        assert str(tmp_path / 'settings.json') in text
        assert message in text


def test_flat_and_nested_are_inverse():
    values = {'a': 1, 'b': {'c': [1, 2], 'd': {'e': None}}, 'f': {}}
    assert flat(values) == {'a': 1, 'b.c': [1, 2], 'b.d.e': None, 'f': {}}
    assert nested(flat(values)) == values


def test_second_writer_is_refused_while_the_first_lives(data, tmp_path, capsys):
    out = tmp_path / 'run'
    with sole_writer(out):
        with pytest.raises(SystemExit, match='2'):
            pretrained(data, out)
        assert f'{out}: another process is writing there' in capsys.readouterr().err
    pretrained(data, out)  # whose lock nobody holds any more
    assert steps_done(out / 'checkpoint') == 6


def test_policy_that_is_replaced_while_it_is_evaluated_is_refused(data, tmp_path):
    base = pretrained(data, tmp_path / 'base') / 'checkpoint'
    settings = evaluate.EvaluateSettings(checkpoints=(base,), dataset=data, episodes=1)
    evaluate._start_worker(settings, fingerprints(data, [base]))
    job = (str(base), 'pointmaze-medium-v0', 0, 0, 1)
    assert evaluate._outcome(job)[0] in (0, 1)
    other = load_checkpoint(pretrained(data, tmp_path / 'other', seed=1) / 'checkpoint')
    save_checkpoint(other, base)
    with pytest.raises(CheckpointError, match='was replaced while it was evaluated'):
        evaluate._outcome(job)
