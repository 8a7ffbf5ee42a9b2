"""What can happen to long runs: full disks, bad settings, several processes."""

import math
import os
from pathlib import Path
import resource
import signal
import subprocess
import sys
import time

from metagcttt_core import load_checkpoint, make_agent, save_checkpoint
from metagcttt_core.files import read_json_lines
from metagcttt_core.meta.diagnostics import Diagnostics
from metagcttt_core.meta.registry import META_UPDATES
from metagcttt_core.training.checkpoint import load_training_state
from metagcttt_tools import meta_train
import pytest
from tests.core.builders import maze_walks
import torch

ROOT = Path(__file__).resolve().parents[3]
META_TRAIN = (sys.executable, '-m', 'metagcttt_tools', 'meta-train')


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    """Arguments that name a dataset and a policy made for the purpose."""
    folder = tmp_path_factory.mktemp('made')
    maze_walks().save(folder / 'walks.npz')
    save_checkpoint(make_agent('gcbc', obs_dim=2, act_dim=2, hidden=(48, 48)), folder / 'base')
    return ['--dataset', str(folder / 'walks.npz'), '--checkpoint', str(folder / 'base')]


def arguments(made, out, steps=6, **settings):
    inner = ['--meta.inner-steps', '3', '--meta.batch-size', '16', '--log-every', '1']
    given = [part for name, value in settings.items() for part in (f'--{name}', str(value))]
    return [*made, '--out', str(out), '--meta.outer-steps', str(steps), *inner, *given]


def weights(out):
    return load_checkpoint(out / 'checkpoint').state_dict()


def assert_same_bits(first, second):
    assert all(torch.equal(weight, second[name]) for name, weight in first.items())


def interrupt_after(step, monkeypatch):
    """As Ctrl-C would while that outer step is logged."""
    add = Diagnostics.add

    def interrupting(diagnostics, outer):
        add(diagnostics, outer)
        if outer.step == step:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Diagnostics, 'add', interrupting)


@pytest.mark.slow
def test_full_disk_ends_the_run_and_leaves_the_last_checkpoint(made, tmp_path, monkeypatch):
    straight, broken = tmp_path / 'straight', tmp_path / 'broken'
    meta_train.main(arguments(made, straight))
    with monkeypatch.context() as patch, pytest.raises(SystemExit, match='130'):
        interrupt_after(2, patch)
        meta_train.main(arguments(made, broken))
    before = {path.name: path.read_bytes() for path in (broken / 'checkpoint').iterdir()}
    # A limit on file sizes that logs keep to and the 12 kB of weights do not.
    resumed = subprocess.run(
        [*META_TRAIN, *arguments(made, broken), '--resume'],
        cwd=ROOT,
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000)),
    )
    assert resumed.returncode == 2, resumed.stderr
    error = resumed.stderr.splitlines()[-1]
    assert error.startswith(f'error: {broken}: cannot be written')
    assert error.endswith('the checkpoint of step 2 is whole')
    assert {p.name: p.read_bytes() for p in (broken / 'checkpoint').iterdir()} == before
    meta_train.main([*arguments(made, broken), '--resume'])
    assert_same_bits(weights(straight), weights(broken))
    assert [line['step'] for line in read_json_lines(broken / 'metrics.jsonl')] == list(
        range(1, 7)
    )


def test_folder_that_cannot_be_made_is_one_line(made, tmp_path, capsys):
    (tmp_path / 'file').write_text('in the way')
    with pytest.raises(SystemExit, match='2'):
        meta_train.main(arguments(made, tmp_path / 'file' / 'run'))
    error = capsys.readouterr().err.splitlines()[-1]
    assert 'cannot be written' in error
    assert error.endswith('there is no checkpoint yet')


def test_diverging_run_names_the_weight_and_what_is_left(made, tmp_path, monkeypatch, capsys):
    calls, fomaml = [], META_UPDATES['fomaml']

    def spoiled(base, *rest):
        fomaml(base, *rest)
        calls.append(1)
        if len(calls) == 4:
            with torch.no_grad():
                base.actor.mean.bias[0] = math.nan

    monkeypatch.setitem(META_UPDATES, 'fomaml', spoiled)
    with pytest.raises(SystemExit, match='2'):
        meta_train.main(
            arguments(made, tmp_path, **{'meta.algorithm': 'fomaml', 'checkpoint-every': 3})
        )
    error = capsys.readouterr().err.splitlines()[-1]
    assert 'outer step 4: weight actor.mean.bias is not finite' in error
    assert error.endswith('the checkpoint of step 3 is whole')
    assert load_training_state(tmp_path / 'checkpoint').step == 3
    last = read_json_lines(tmp_path / 'metrics.jsonl')[-1]
    assert last['step'] == 4
    assert 'weight actor.mean.bias is not finite' in last['warnings'][0]


def test_run_whose_inner_loops_are_rejected_says_so(made, tmp_path, capsys):
    settings = {'meta.inner-lr': 3.0}  # every step makes the loss worse
    meta_train.main(arguments(made, tmp_path, steps=20, **settings))
    lines = read_json_lines(tmp_path / 'metrics.jsonl')
    (told,) = [line for line in lines if 'warnings' in line]
    assert told['step'] == 20
    assert 'of the inner loops are rejected' in told['warnings'][0]
    assert f'warning: after step 20: {told["warnings"][0]}' in capsys.readouterr().err


def test_unknown_device_is_refused_by_name(made, tmp_path, capsys):
    for device in ('tpu', 'cuda:99', 'cuda:x'):
        with pytest.raises(SystemExit, match='2'):
            meta_train.main(arguments(made, tmp_path, device=device))
        assert 'must be cpu, cuda or cuda:NUMBER' in capsys.readouterr().err


TORCHRUN = (sys.executable, '-m', 'torch.distributed.run', '--standalone')
ENVIRONMENT = {**os.environ, 'OMP_NUM_THREADS': '1'}


def torchrun(processes, given, *options):
    """The command line of the tool in several processes of one machine."""
    return [*TORCHRUN, f'--nproc-per-node={processes}', *options, *META_TRAIN[1:], *given]


@pytest.mark.slow
@pytest.mark.parametrize(('algorithm', 'tasks'), [('fomaml', 3), ('reptile', 4)])
def test_two_processes_give_the_policy_of_one(algorithm, tasks, made, tmp_path):
    settings = {'meta.algorithm': algorithm, 'meta.meta-batch-size': tasks, 'meta.inner-lr': 1e-3}
    alone, shared = tmp_path / 'alone', tmp_path / 'shared'
    meta_train.main(arguments(made, alone, **settings))
    command = torchrun(2, arguments(made, shared, **settings))
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=ENVIRONMENT)
    assert run.returncode == 0, run.stderr
    assert run.stdout.count('policy:') == 1
    assert_same_bits(weights(alone), weights(shared))
    assert without_times(alone) == without_times(shared)
    assert len(list((shared / 'tensorboard').iterdir())) == 1


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_killed_rank_restarts_all_from_the_checkpoint_to_the_same_bits(made, tmp_path):
    settings = {'meta.algorithm': 'fomaml', 'meta.meta-batch-size': 2, 'checkpoint-every': 3}
    steps, alone, shared = 150, tmp_path / 'alone', tmp_path / 'shared'
    meta_train.main(arguments(made, alone, steps, **settings))
    given = [*arguments(made, shared, steps, **settings), '--resume']
    with (tmp_path / 'log').open('w+') as log:
        elastic = subprocess.Popen(
            torchrun(2, given, '--max-restarts=1'),
            cwd=ROOT,
            stdout=log,
            stderr=log,
            env=ENVIRONMENT,
        )
        children = Path(f'/proc/{elastic.pid}/task/{elastic.pid}/children')
        while not (shared / 'checkpoint' / 'checkpoint.json').exists():
            assert elastic.poll() is None, (tmp_path / 'log').read_text()
            time.sleep(0.01)
        ranks = [
            process
            for process in map(int, children.read_text().split())
            if b'meta-train' in Path(f'/proc/{process}/cmdline').read_bytes()
        ]
        assert len(ranks) == 2
        os.kill(ranks[1], signal.SIGKILL)
        assert elastic.wait() == 0, (tmp_path / 'log').read_text()
    assert 'continues after step' in (tmp_path / 'log').read_text()
    assert_same_bits(weights(alone), weights(shared))
    assert without_times(alone) == without_times(shared)


def without_times(out):
    """The lines of a run's log that do not depend on the machine's speed."""
    lines = read_json_lines(out / 'metrics.jsonl')
    return [{key: line[key] for key in line.keys() - {'time', 'task/filter_ms'}} for line in lines]
