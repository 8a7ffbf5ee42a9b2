"""Trainings on a Ray cluster of two machines that this one plays."""

from contextlib import ExitStack
from dataclasses import replace
import os
from pathlib import Path
import signal
import threading
import time

from metagcttt_core import load_checkpoint
from metagcttt_tools import pretrain
from metagcttt_tools.benchmarks import cluster as benchmark
from metagcttt_tools.common.run_log import last_step
from metagcttt_tools.common.stopping import Stop
from metagcttt_tools.jobs.program import ATTEMPT, Invocation, JobError
from metagcttt_tools.jobs.scheduler import Job, Resources, run_all
import pytest
from tests.core.builders import maze_walks
import yaml

ray = pytest.importorskip(
    'ray', reason='needs the extra cluster: pip install "metagcttt-core[cluster]"'
)
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

STEPS, EVERY = 3000, 300


def settings(folder, seed, steps=STEPS):
    return {
        'dataset': str(folder / 'walks.npz'),
        'out': str(folder / f'run-{seed}'),
        'seed': seed,
        'hidden': [16],
        'training': {'steps': steps, 'batch_size': 32},
        'checkpoint_every': EVERY,
        'log_every': EVERY,
        'resume': True,
    }


def training(folder, seed, steps=STEPS):
    preset = folder / f'run-{seed}.yaml'
    preset.write_text(yaml.safe_dump({'pretrain': settings(folder, seed, steps)}))
    out = folder / f'run-{seed}'
    invocation = Invocation('pretrain', preset, out, folder)
    return Job(invocation, steps, lambda: last_step(out))


@pytest.fixture(scope='module')
def ray_cluster():
    with ExitStack() as stack:
        try:
            machines = stack.enter_context(benchmark.two_machines())
        except TimeoutError as error:
            pytest.skip(f'this machine is too busy: {error}')
        patch = stack.enter_context(pytest.MonkeyPatch.context())
        patch.setenv('RAY_ADDRESS', machines.address)
        yield machines


@pytest.fixture
def make_scheduler(ray_cluster):
    """A process connects to a cluster once."""
    from metagcttt_tools.jobs.cluster import RayScheduler

    def made():
        ray.shutdown()
        return RayScheduler(Resources())

    yield made
    ray.shutdown()


def test_a_machine_that_dies_costs_no_bit_of_the_results(make_scheduler, tmp_path, capsys):
    """Its raylet and the training on it are killed in the middle."""
    maze_walks().save(tmp_path / 'walks.npz')
    scheduler = make_scheduler()
    assert (
        'cluster: 3 machines, 2 cores, 0 GPUs; dashboard: not started' in capsys.readouterr().out
    )
    failures = []

    def kill():
        log = tmp_path / 'run-0'
        deadline = time.monotonic() + 400
        while not 2 * EVERY <= last_step(log) < STEPS:  # a step is logged before it is saved
            if time.monotonic() > deadline:
                return failures.append('no checkpoint in time')
            time.sleep(0.01)
        program = benchmark.programs_of(log)[0]
        raylet = benchmark.parent_of(benchmark.parent_of(program))
        os.kill(program, signal.SIGKILL)
        os.kill(raylet, signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    run_all('pretrain', [training(tmp_path, seed) for seed in (0, 1)], scheduler, Stop())
    killer.join()
    assert failures == []
    attempts = (tmp_path / 'run-0.log').read_text().split(f'{ATTEMPT} ')[1:]
    assert len(attempts) == 2
    assert 'continues after step' in attempts[1]
    for seed in (0, 1):
        alone = tmp_path / 'alone' / f'{seed}'
        preset = tmp_path / f'{seed}.yaml'
        values = {**settings(tmp_path, seed), 'out': str(alone)}
        preset.write_text(yaml.safe_dump({'pretrain': values}))
        pretrain.main(['--preset', str(preset)])
        found = load_checkpoint(tmp_path / f'run-{seed}' / 'checkpoint')
        assert found.fingerprint() == load_checkpoint(alone / 'checkpoint').fingerprint()

    too_wide = Job(Invocation('evaluate', Path('a'), Path('b'), tmp_path), 1, lambda: 0, cpus=8)
    with pytest.raises(JobError, match='evaluate asks for 8 of CPU on one machine, the largest'):
        scheduler.submit(too_wide)


def test_a_stopped_training_saves_and_the_next_call_goes_on(make_scheduler, tmp_path):
    """Ray blocks SIGINT in its workers, and so in what they start."""
    maze_walks().save(tmp_path / 'walks.npz')
    run, steps = tmp_path / 'run-0', 10_000_000  # more than it takes while it is stopped

    for _ in range(2):
        before, stop = last_step(run), Stop()

        def done(before=before, stop=stop):
            if last_step(run) > before:
                stop.set()
            return last_step(run)

        job = replace(training(tmp_path, 0, steps), done=done)
        with pytest.raises(KeyboardInterrupt):
            run_all('pretrain', [job], make_scheduler(), stop)
        assert before < last_step(run) < steps
    assert 'continues after step' in (tmp_path / 'run-0.log').read_text()


@pytest.mark.parametrize(
    ('address', 'message'),
    [
        ('nonsense', "RAY_ADDRESS must be HOST:PORT or auto, got 'nonsense'"),
        ('localhost:66000', 'RAY_ADDRESS must be HOST:PORT or auto'),
        ('localhost:1', 'RAY_ADDRESS localhost:1: no Ray cluster answers there: .*refused'),
        ('[::1]:1', r'RAY_ADDRESS \[::1\]:1: no Ray cluster answers there'),
        ('ray://localhost:1', 'RAY_ADDRESS ray://localhost:1: no Ray cluster answers there'),
    ],
)
def test_address_without_a_cluster_is_refused_at_once(address, message, monkeypatch):
    from metagcttt_tools.jobs.cluster import RayScheduler

    monkeypatch.setenv('RAY_ADDRESS', address)
    with pytest.raises(ValueError, match=message):
        RayScheduler(Resources())
