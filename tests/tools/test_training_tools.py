"""Pre-training, post-training and evaluation as a user runs them, in miniature."""

from concurrent.futures import ThreadPoolExecutor
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import metagcttt_core
from metagcttt_core import adapt, load_checkpoint, save_checkpoint, TrajectoryDataset
from metagcttt_tools import evaluate, meta_train, pack_assets, pretrain
from metagcttt_tools.common.cli import parse
from metagcttt_tools.main import main as metagcttt
import numpy as np
import pytest
from tests.core.builders import maze_walks, random_dataset
from tests.core.robot.messages import contract
from tests.programs import start
from tests.tools.tables import squeezed
import torch

SMALL_AGENT = ['--hidden', '16', '16', '--training.batch-size', '32']
ROOT = Path(__file__).resolve().parents[2]
STEPS = 60


@pytest.fixture(scope='module')
def dataset_path(tmp_path_factory):
    path = tmp_path_factory.mktemp('data') / 'walks.npz'
    maze_walks().save(path)
    return path


@pytest.fixture(scope='module')
def base(dataset_path, tmp_path_factory):
    out = tmp_path_factory.mktemp('base')
    pretrain.main(pretrain_arguments(dataset_path, out, steps=20))
    return out / 'checkpoint'


def pretrain_arguments(dataset_path, out, steps):
    arguments = ['--dataset', str(dataset_path), '--out', str(out), *SMALL_AGENT]
    return [*arguments, '--training.steps', str(steps), '--log-every', '5']


def meta_arguments(dataset_path, base, out, steps):
    arguments = ['--dataset', str(dataset_path), '--checkpoint', str(base), '--out', str(out)]
    inner = ['--meta.inner-steps', '2', '--meta.batch-size', '16', '--log-every', '1']
    return [*arguments, '--meta.outer-steps', str(steps), *inner]


def weights(folder):
    return load_checkpoint(folder).state_dict()


def assert_same_bits(first, second):
    assert first.keys() == second.keys()
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_pretrain_writes_checkpoint_logs_and_settings(base):
    agent = load_checkpoint(base, environment='pointmaze-medium-v0')
    assert agent.metadata['history'][0]['training']['steps'] == 20
    lines = (base.parent / 'metrics.jsonl').read_text().splitlines()
    assert [json.loads(line)['step'] for line in lines] == [5, 10, 15, 20]
    assert all(np.isfinite(json.loads(line)['train/loss']) for line in lines)
    assert json.loads((base.parent / 'settings.json').read_text())['settings']['seed'] == 0
    assert list((base.parent / 'tensorboard').iterdir())


def test_policy_of_a_robot_is_for_no_maze(tmp_path, capsys):
    data, walks = tmp_path / 'robot.npz', maze_walks()
    walks.contract = contract().identity
    walks.made_from = {'program': 'import-bags', 'sources': [{'name': 'drive.mcap'}]}
    walks.save(data)
    pretrain.main(pretrain_arguments(data, tmp_path / 'policy', steps=1))
    metadata = load_checkpoint(tmp_path / 'policy' / 'checkpoint').metadata
    assert metadata['contract'] == contract().identity
    assert 'environment' not in metadata
    assert metadata['history'][0]['environment'] is None
    assert metadata['history'][0]['made_from'] == walks.made_from
    for flag, value in (('--environment', 'pointmaze-medium-v0'), ('--evaluate-every', '1')):
        with pytest.raises(SystemExit, match='2'):
            pretrain.main([*pretrain_arguments(data, tmp_path / 'no', steps=1), flag, value])
        assert (
            f'of the robot cart, which is in no maze: leave out {flag[2:].replace("-", "_")}'
            in (capsys.readouterr().err)
        )


@pytest.mark.parametrize('program', ['import-table', 'import-lerobot'])
def test_policy_of_imported_data_is_for_no_maze_unless_one_is_named(program, tmp_path, capsys):
    data, walks = tmp_path / 'table.npz', maze_walks()
    walks.made_from = {'program': program, 'sources': []}
    walks.save(data)

    def environment(out, *flags):
        pretrain.main([*pretrain_arguments(data, tmp_path / out, steps=1), *flags])
        return load_checkpoint(tmp_path / out / 'checkpoint').metadata.get('environment')

    assert environment('none') is None
    named = ('--environment', 'pointmaze-large-v0')
    assert environment('named', *named) == 'pointmaze-large-v0'
    with pytest.raises(SystemExit, match='2'):
        environment('no', '--evaluate-every', '1')
    error = capsys.readouterr().err
    assert f'{data}: does not say of which simulator it is: evaluate_every takes an' in error
    with pytest.raises(SystemExit, match='2'):
        evaluate.main(['--checkpoints', str(tmp_path / 'none/checkpoint'), '--dataset', str(data)])
    assert 'does not say which environment it is for' in capsys.readouterr().err


def test_policy_of_data_of_other_widths_is_not_for_the_usual_maze(tmp_path, capsys):
    data = tmp_path / 'arm.npz'
    random_dataset([20], obs_dim=29, act_dim=8).save(data)

    def environment(out, *flags):
        pretrain.main([*pretrain_arguments(data, tmp_path / out, steps=1), *flags])
        return load_checkpoint(tmp_path / out / 'checkpoint').metadata.get('environment')

    assert environment('none') is None
    assert environment('ant', '--environment', 'antmaze-medium-v0') == 'antmaze-medium-v0'
    for flags, error in (
        (
            ('--environment', 'pointmaze-medium-v0'),
            f'{data}: has observations of 29 and actions of 8 values, the robot of pointmaze-medi',
        ),
        (('--environment', 'antmaze-mediun-v0'), "did you mean 'antmaze-medium-v0'"),
        (('--evaluate-every', '1'), f'{data}: does not say of which simulator it is'),
    ):
        with pytest.raises(SystemExit, match='2'):
            environment('no', *flags)
        assert error in ' '.join(capsys.readouterr().err.split())


def test_pretrain_does_not_overwrite_a_checkpoint(dataset_path, base, capsys):
    with pytest.raises(SystemExit, match='2'):
        pretrain.main(pretrain_arguments(dataset_path, base.parent, steps=20))
    assert 'pass --resume to continue' in capsys.readouterr().err


def test_resume_refuses_other_settings_by_name(dataset_path, base, capsys):
    arguments = pretrain_arguments(dataset_path, base.parent, steps=20)
    with pytest.raises(SystemExit, match='2'):
        pretrain.main([*arguments, '--seed', '1', '--resume'])
    assert 'seed was 0 and is now 1' in capsys.readouterr().err


def test_missing_dataset_is_one_line(tmp_path, capsys):
    with pytest.raises(SystemExit, match='2'):
        pretrain.main(['--dataset', str(tmp_path / 'none.npz'), '--out', str(tmp_path)])
    assert 'none.npz: no such file' in capsys.readouterr().err


@pytest.mark.parametrize('algorithm', ['continual', 'fomaml', 'reptile', 'maml'])
def test_meta_train_changes_the_policy_and_keeps_its_history(
    algorithm, dataset_path, base, tmp_path
):
    arguments = meta_arguments(dataset_path, base, tmp_path, steps=4)
    meta_train.main([*arguments, '--meta.algorithm', algorithm, '--snapshot-every', '2'])
    post_trained = load_checkpoint(tmp_path / 'checkpoint')
    stages = [entry['stage'] for entry in post_trained.metadata['history']]
    assert stages == ['pretrain', 'post_train']
    changed = weights(tmp_path / 'checkpoint')
    assert not all(torch.equal(changed[name], tensor) for name, tensor in weights(base).items())
    assert_same_bits(changed, weights(tmp_path / 'snapshots' / '000004'))
    last = json.loads((tmp_path / 'metrics.jsonl').read_text().splitlines()[-1])
    assert last['step'] == 4
    assert last['task/support_transitions'] > 0


def test_meta_train_retrieves_by_the_contract_of_the_data(dataset_path, base, tmp_path, capsys):
    walks = maze_walks()
    walks.contract = {**contract().identity, 'position_dims': [1], 'epsilon': 0.4}
    walks.save(tmp_path / 'robot.npz')

    def train(out, data, *flags):
        meta_train.main([*meta_arguments(data, base, tmp_path / out, steps=2), *flags])
        history = load_checkpoint(tmp_path / out / 'checkpoint').metadata['history']
        return history[-1]['meta']['filter'], weights(tmp_path / out / 'checkpoint')

    found, robot = train('robot', tmp_path / 'robot.npz')
    assert (found['position_dims'], found['epsilon']) == ([1], 0.4)
    flags = ('--meta.filter.position-dims', '1', '--meta.filter.epsilon', '0.4')
    same, maze = train('maze', dataset_path, *flags)
    assert same == found
    assert_same_bits(robot, maze)
    usual, other = train('usual', dataset_path)
    assert (usual['position_dims'], usual['epsilon']) == ([0, 1], 1.0)
    assert not all(torch.equal(other[name], tensor) for name, tensor in robot.items())
    with pytest.raises(SystemExit, match='2'):
        train('no', tmp_path / 'robot.npz', '--meta.filter.scale', '1', '1')
    assert (
        'scale must have one factor per position dimension (1), got 2' in capsys.readouterr().err
    )


def test_policy_of_another_contract_is_refused_by_name(base, tmp_path, capsys):
    agent, walks = load_checkpoint(base), maze_walks()
    agent.metadata['contract'] = contract().identity
    save_checkpoint(agent, tmp_path / 'cart')
    walks.contract = {'robot': 'van', 'fingerprint': 'other'}
    data = tmp_path / 'van.npz'
    walks.save(data)
    arguments = ['--checkpoints', str(tmp_path / 'cart'), '--dataset', str(data)]
    for program, given in (
        (meta_train, meta_arguments(data, tmp_path / 'cart', tmp_path / 'no', steps=1)),
        (evaluate, ['--offline', *arguments, '--steps-ahead', '5', '--processes', '1']),
    ):
        with pytest.raises(SystemExit, match='2'):
            program.main(given)
        error = capsys.readouterr().err
        assert f'the dataset {data} was made for van (contract other), not for cart (' in error
        assert f', as {tmp_path}/cart is' in error
    assert not (tmp_path / 'no' / 'checkpoint').exists()


@pytest.mark.parametrize('program', ['meta-train', 'evaluate', 'loss-curves', 'draw-episodes'])
def test_data_of_other_widths_are_refused_by_name(program, base, tmp_path, capsys):
    data, out = tmp_path / 'wide.npz', tmp_path / 'out.json'
    random_dataset([20], obs_dim=3).save(data)
    policies = '--checkpoints' if program == 'evaluate' else '--checkpoint'
    with pytest.raises(SystemExit, match='2'):
        metagcttt([program, policies, str(base), '--dataset', str(data), '--out', str(out)])
    assert (
        f'error: {base} is for observations of 2 and actions of 2 values, the dataset {data} has '
        '3 and 2' in capsys.readouterr().err
    )
    assert not (out / 'checkpoint').exists()


def test_run_from_before_contracts_decided_is_continued(dataset_path, base, tmp_path):
    """Its settings name the radius and the coordinates that were the defaults."""
    out = tmp_path / 'run'
    meta_train.main(meta_arguments(dataset_path, base, out, steps=2))
    record = json.loads((out / 'settings.json').read_text())
    record['settings']['meta']['filter'] |= {'epsilon': 1.0, 'position_dims': [0, 1]}
    (out / 'settings.json').write_text(json.dumps(record))
    meta_train.main([*meta_arguments(dataset_path, base, out, steps=4), '--resume'])
    meta_train.main(meta_arguments(dataset_path, base, tmp_path / 'whole', steps=4))
    assert_same_bits(weights(out / 'checkpoint'), weights(tmp_path / 'whole' / 'checkpoint'))


@pytest.mark.parametrize(
    ('algorithm', 'rate'), [('continual', 1.0), ('fomaml', 3e-4), ('maml', 3e-4), ('reptile', 0.1)]
)
def test_another_algorithm_over_the_preset_of_the_readme_has_a_rate_of_its_own(algorithm, rate):
    flags = ['--preset', 'pointmaze-medium-navigate-cpu', '--meta.algorithm', algorithm]
    settings = parse(meta_train.MetaTrainSettings, '', 'meta-train', flags)
    assert (settings.meta.algorithm, settings.meta.outer_lr) == (algorithm, rate)
    assert settings.decisive()['meta.meta_lr'] == rate


def test_merging_coefficient_is_refused_as_a_rate_of_adam(tmp_path, capsys):
    preset = tmp_path / 'mine.yaml'
    preset.write_text('meta_train: {meta: {algorithm: reptile, meta_lr: 0.1}}')
    with pytest.raises(SystemExit, match='2'):
        meta_train.main(['--preset', str(preset), '--meta.algorithm', 'fomaml'])
    printed = ' '.join(capsys.readouterr().err.split())
    assert 'learning rate of the outer Adam of fomaml and must be at most 0.01' in printed


@pytest.fixture(scope='module')
def straight(dataset_path, base, tmp_path_factory):
    """What becomes of a run that nobody interrupts."""
    out = tmp_path_factory.mktemp('straight')
    meta_train.main(meta_arguments(dataset_path, base, out, STEPS))
    return out / 'checkpoint'


@pytest.mark.slow
@pytest.mark.parametrize(
    ('number', 'status'),
    [
        (signal.SIGKILL, -signal.SIGKILL),
        (signal.SIGINT, 130),
        (signal.SIGTERM, 75),
        (signal.SIGUSR1, 75),
    ],
)
def test_interrupted_run_resumes_to_the_same_bits(
    number, status, straight, dataset_path, base, tmp_path
):
    broken = tmp_path / 'broken'
    arguments = [*meta_arguments(dataset_path, base, broken, STEPS), '--checkpoint-every', '3']
    process = start(['meta-train', *arguments], ROOT, os.environ, tmp_path / 'log')
    wait_for((broken / 'checkpoint' / 'checkpoint.json').exists, lambda: process.exitcode)
    os.kill(process.pid, number)
    process.join(60)
    assert process.exitcode == status, (tmp_path / 'log').read_text()
    interrupted = json.loads((broken / 'checkpoint' / 'checkpoint.json').read_text())
    assert 0 < interrupted['training']['step'] < STEPS
    meta_train.main([*arguments, '--resume'])
    assert_same_bits(weights(straight), weights(broken / 'checkpoint'))
    logged = [json.loads(line)['step'] for line in (broken / 'metrics.jsonl').open()]
    assert logged == list(range(1, STEPS + 1))


@pytest.mark.parametrize('program', [pretrain, meta_train])
def test_a_run_at_its_time_limit_wants_another_turn(program, dataset_path, base, tmp_path):
    def arguments(out):
        if program is pretrain:
            return pretrain_arguments(dataset_path, out, steps=3)
        return meta_arguments(dataset_path, base, out, steps=3)

    program.main(arguments(tmp_path / 'straight'))
    turns = tmp_path / 'turns'
    for _ in range(2):  # each turn is over after a step
        with pytest.raises(SystemExit, match='75'):
            program.main([*arguments(turns), '--resume', '--time-limit', '1e-9'])
    program.main(['--out', str(turns), '--resume'])
    assert_same_bits(weights(turns / 'checkpoint'), weights(tmp_path / 'straight' / 'checkpoint'))


def wait_for(condition, status, timeout_s=60):
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert status() is None, f'ended with status {status()}'
        assert time.monotonic() < deadline, f'nothing happened within {timeout_s} s'
        time.sleep(0.01)


@pytest.mark.mujoco
@pytest.mark.slow
def test_evaluate_writes_success_by_budget_and_seed_for_any_number_of_processes(
    dataset_path, base, tmp_path, capsys, monkeypatch
):
    out = tmp_path / 'evaluation.json'
    arguments = ['--checkpoints', str(base), '--dataset', str(dataset_path), '--episodes', '1']
    arguments += ['--budgets', '0', '1', '--seeds', '0', '1', '--ttt.batch-size', '16']
    evaluate.main([*arguments, '--processes', '2', '--out', str(out)])
    (result,) = results = json.loads(out.read_text())['results']
    assert [point['budget'] for point in result['curve']] == [0, 1]
    for point in result['curve']:
        assert len(point['per_seed']) == 2
        assert sorted(point['per_task']) == ['1', '2', '3', '4', '5']
        assert point['success'] == pytest.approx(np.mean(point['per_seed']))
    assert '| K = 0 | K = 1 | AUC |' in squeezed(capsys.readouterr().out)

    monkeypatch.setattr(evaluate, 'ProcessPoolExecutor', InThisProcess)
    evaluate.main([*arguments, '--processes', '1', '--out', str(tmp_path / 'here.json')])
    assert json.loads((tmp_path / 'here.json').read_text())['results'] == results


@pytest.mark.mujoco
@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith('linux'), reason='looks for children in /proc')
def test_workers_of_a_killed_evaluation_end(dataset_path, base, tmp_path):
    arguments = ['--checkpoints', str(base), '--dataset', str(dataset_path), '--processes', '2']
    arguments += ['--episodes', '500', '--out', str(tmp_path / 'evaluation.json')]
    process = subprocess.Popen(
        [sys.executable, '-m', 'metagcttt_tools', 'evaluate', *arguments],
        cwd=ROOT,
        stderr=subprocess.DEVNULL,
    )
    children = Path(f'/proc/{process.pid}/task/{process.pid}/children')
    wait_for(lambda: len(children.read_text().split()) >= 3, process.poll)  # two, and a tracker
    workers = [Path(f'/proc/{number}') for number in children.read_text().split()]
    process.kill()
    process.wait()
    deadline = time.monotonic() + 60
    while any(worker.exists() for worker in workers):
        assert time.monotonic() < deadline, 'workers outlive the evaluation'
        time.sleep(0.05)


def test_evaluate_begins_with_the_optimizer_state_of_pretraining(
    dataset_path, base, tmp_path, capsys, monkeypatch
):
    """In this process, to see the agents that act."""
    post_trained = tmp_path / 'meta' / 'checkpoint'
    meta_train.main(meta_arguments(dataset_path, base, post_trained.parent, steps=2))
    started = []

    def success(agent, simulator, ttt, trajectory_filter, seed, **_):
        data = trajectory_filter.dataset
        support = trajectory_filter.query(data.observations[0], data.observations[30])
        adapted = [
            adapt(agent, data, support, data.observations[30], config).agent
            for config in (ttt, ttt.model_copy(update={'optimizer_state': 'fresh'}))
        ]
        started.append((adapted[0].fingerprint(), adapted[1].fingerprint()))
        return {'mean': 0.5, 'accepted': 1.0}

    monkeypatch.setattr(evaluate, 'ProcessPoolExecutor', InThisProcess)
    monkeypatch.setattr(metagcttt_core, 'evaluate_success', success)
    files = ['--dataset', str(dataset_path), '--checkpoints', str(base), str(post_trained)]
    steps = ['--budgets', '2', '--seeds', '0', '--ttt.batch-size', '16', '--filter.epsilon', '9']
    arguments = [*files, *steps, '--out', str(tmp_path / 'evaluation.json')]
    evaluate.main([*arguments, '--ttt.optimizer-state', 'pretrained'])
    assert len(started) == 2 * 5
    assert all(pretrained != fresh for pretrained, fresh in started)
    packed = tmp_path / 'packed'
    save_checkpoint(without_optimizer_state(base), packed)
    arguments[arguments.index(str(post_trained))] = str(packed)
    with pytest.raises(SystemExit, match='2'):
        evaluate.main([*arguments, '--ttt.optimizer-state', 'pretrained'])
    assert f'{packed}: has no optimiser state of pre-training' in capsys.readouterr().err
    assert len(started) == 2 * 5


def without_optimizer_state(folder):
    agent = load_checkpoint(folder)
    agent.optimizer_state = None
    return agent


class InThisProcess(ThreadPoolExecutor):
    """Runs the jobs of an evaluation one after the other, where the test can watch them."""

    def __init__(self, processes, *, mp_context, initializer, initargs):
        super().__init__(1, initializer=initializer, initargs=initargs)


@pytest.mark.parametrize('kept', [False, True])
def test_packed_policies_have_their_optimizer_state_when_asked(kept, dataset_path, base, tmp_path):
    arguments = ['--base', str(base), '--meta', str(base), '--dataset', str(dataset_path)]
    arguments += ['--out', str(tmp_path / 'assets')]
    pack_assets.main([*arguments, '--optimizer-state'] if kept else arguments)
    agent = load_checkpoint(tmp_path / 'assets' / 'base')
    assert (agent.optimizer_state is not None) == kept


def test_half_weights_are_half_as_large_and_load_as_whole_ones(dataset_path, base, tmp_path):
    arguments = ['--base', str(base), '--meta', str(base), '--dataset', str(dataset_path)]
    sizes = {}
    for name, further in (('whole', []), ('half', ['--half-weights'])):
        pack_assets.main([*arguments, *further, '--out', str(tmp_path / name)])
        (weights,) = (tmp_path / name / 'meta').glob('*.safetensors')
        sizes[name] = weights.stat().st_size
    assert sizes['half'] < 0.7 * sizes['whole']
    whole, half = (load_checkpoint(tmp_path / name / 'meta').state_dict() for name in sizes)
    for name, weight in whole.items():
        torch.testing.assert_close(half[name], weight, rtol=1e-3, atol=1e-6)


def test_packed_data_keep_their_contract(dataset_path, base, tmp_path):
    data = TrajectoryDataset.load(dataset_path)
    identity = contract().identity
    of_robot = TrajectoryDataset.from_arrays(
        data.observations, data.actions, data.terminals, contract=identity
    )
    settings = pack_assets.PackSettings(out=tmp_path, episodes=1)
    pack_assets.pack_dataset(of_robot, settings)
    packed = TrajectoryDataset.load(tmp_path / 'dataset.npz')
    assert packed.contract == identity
    assert packed.num_episodes == 1


def test_evaluate_table_shows_mean_error_and_auc():
    curve = [
        {'budget': 0, 'success': 0.25, 'standard_error': 0.0125},
        {'budget': 10, 'success': 0.875, 'standard_error': 0.05},
    ]
    results = [{'checkpoint': 'meta', 'curve': curve, 'auc': 0.5625}]
    table = evaluate.format_table(results)
    assert squeezed(table).splitlines()[-1] == '| meta | 0.25 ± 0.01 | 0.88 ± 0.05 | 0.562 |'
    standing = squeezed(evaluate.format_table(results, standing=True)).splitlines()
    assert standing[0].startswith('| policy | start | K = ')
    assert standing[-1].startswith('| meta | standing | 0.25')
