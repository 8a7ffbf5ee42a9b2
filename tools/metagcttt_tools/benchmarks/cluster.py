"""What a Ray cluster costs, and what is left when its processes are killed."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
import json
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

from metagcttt_core import TrajectoryDataset
import numpy as np
from pydantic import Field
from tqdm import tqdm
import yaml

from metagcttt_tools.common.cli import parse
from metagcttt_tools.common.results import Benchmark, markdown_table, write_report
from metagcttt_tools.common.run_log import last_step
from metagcttt_tools.common.stopping import Stop
from metagcttt_tools.jobs.program import ATTEMPT, Invocation
from metagcttt_tools.jobs.scheduler import Job, LocalScheduler, Resources, run_all, Scheduler

_DESCRIPTION = """Small jobs on this machine and on a Ray cluster of two machines that it plays.

Example: metagcttt benchmark cluster
Then studies in each of which a process is killed with -9: the program that trains, its Ray worker,
the raylet of a machine, all of these, or the sweep. Prints tables and writes JSON."""

_VICTIMS = ('program', 'worker', 'raylet', 'machine', 'sweep')
_MACHINES = 2
_DEADLINE_S = 1800.0
_STARTS = 5


def main(argv: list[str] | None = None) -> None:
    """Run the benchmark."""
    parse(ClusterBenchmark, _DESCRIPTION, 'benchmark cluster', argv).run()


class ClusterBenchmark(Benchmark):
    """Seconds of a study by scheduler, and results after kills beside undisturbed ones."""

    out: Path = Field(Path('out/benchmark/cluster.json'), description='file for the results')
    jobs: int = Field(50, ge=0, description='small trainings of each scheduler; 0 leaves them out')
    steps: int = Field(2000, ge=100, description='gradient steps of a training')
    kills: int = Field(20, ge=0, description='studies in which a process is killed')
    seed: int = Field(0, ge=0, description='of the moments of the kills')

    def run(self) -> None:
        """Measure, print and write.

        Raises:
            RuntimeError: If a study fails, or its results are not those of the undisturbed one.
        """
        load = os.getloadavg()[0]
        results: dict[str, Any] = {}
        with tempfile.TemporaryDirectory(prefix='metagcttt-') as folder, two_machines() as cluster:
            data = _random_walks(Path(folder) / 'walks.npz')
            if self.jobs:
                results['jobs'] = rows = self._jobs(data, cluster)
                print(markdown_table(rows))
            if self.kills:
                results['kills'] = rows = self._kills(data, cluster)
                print(markdown_table(rows))
        results['load_before_and_after'] = [load, os.getloadavg()[0]]
        write_report(self.out, self, results)
        print(f'results: {self.out}')

    def _jobs(self, data: Path, cluster: Any) -> list[dict[str, Any]]:
        """Seconds of equal jobs by scheduler, in two turns of half of them."""
        from metagcttt_tools.jobs.cluster import RayScheduler

        os.environ['RAY_ADDRESS'] = cluster.address
        began = time.perf_counter()
        schedulers: dict[str, Scheduler] = {'cluster': RayScheduler(Resources())}
        start = time.perf_counter() - began
        schedulers['local'] = LocalScheduler(_MACHINES, 0)
        seconds = dict.fromkeys(('local', 'cluster'), 0.0)
        turns = [(name, 0) for name in seconds] + [(name, 1) for name in reversed(seconds)]
        for name, turn in turns:
            count = (self.jobs + 1 - turn) // 2
            jobs = _trainings(data, data.parent / f'{name}-{turn}', self.steps, count)
            began = time.perf_counter()
            run_all(name, jobs, schedulers[name], Stop())
            seconds[name] += time.perf_counter() - began
        return [
            {
                'scheduler': name,
                'jobs': self.jobs,
                'start (s)': start if name == 'cluster' else 0.0,
                'jobs (s)': total,
                'of local': total / seconds['local'],
            }
            for name, total in seconds.items()
        ]

    def _kills(self, data: Path, cluster: Any) -> list[dict[str, Any]]:
        rng = np.random.default_rng(self.seed)
        undisturbed = SmallStudy(data, data.parent / 'undisturbed', self.steps)
        undisturbed.write()
        undisturbed.finish(None)
        rows = []
        for number in tqdm(range(self.kills), unit='kill', desc='kills'):
            study = SmallStudy(data, data.parent / f'killed-{number}', self.steps)
            study.write()
            victim = _VICTIMS[number % len(_VICTIMS)]
            row = study.finish_despite(victim, float(rng.random()), cluster)
            if study.results() != undisturbed.results():
                raise RuntimeError(f'{study.out}: results differ after the kill of a {victim}')
            shutil.rmtree(study.out)
            rows.append({'kill': number, **row, 'same results': True})
        return rows


class SmallStudy:
    """A study of seconds: pre-training, post-training, evaluation."""

    def __init__(self, data: Path, out: Path, steps: int) -> None:
        """Of so many gradient steps a training."""
        self.out = out
        self._data = data
        self._steps = steps
        self._preset = out.with_suffix('.preset.yaml')
        self._outer_steps = steps // 10
        self._every = {'base': steps // 10, 'arm': steps // 100}

    def write(self) -> None:
        """Write its preset."""
        dataset = str(self._data)
        meta = {'outer_steps': self._outer_steps, 'inner_steps': 10, 'batch_size': 16}
        values = {
            'sweep': {
                'base': str(self._preset),
                'seeds': [0],
                'arms': {'arm': {}},
                'out': str(self.out),
                'processes': 1,
            },
            'pretrain': _training(self._data, self._steps),
            'meta_train': {
                'dataset': dataset,
                'meta': meta,
                'checkpoint_every': self._every['arm'],
                'log_every': 1,
            },
            'evaluate': {'dataset': dataset, 'budgets': [0], 'episodes': 1, 'seeds': [0]},
        }
        self._preset.write_text(yaml.safe_dump(values, sort_keys=False), encoding='utf-8')

    def start(self, address: str | None) -> subprocess.Popen[bytes]:
        """The sweep as a process, on the cluster at `address` or on this machine."""
        command = [sys.executable, '-m', 'metagcttt_tools', 'sweep', '--preset', str(self._preset)]
        environment = dict(os.environ)
        if address is not None:
            command.append('--cluster')
            environment['RAY_ADDRESS'] = address
        log = self.out.with_suffix('.log').open('ab')
        return subprocess.Popen(command, stdout=log, stderr=log, env=environment)

    def finish(self, address: str | None) -> None:
        """Run it to its end.

        Raises:
            RuntimeError: If it fails; has the last of its output.
        """
        self._await(self.start(address))

    def finish_despite(self, victim: str, moment: float, cluster: Any) -> dict[str, Any]:
        """Run it on the cluster, killing a process of that kind after a share of its steps.

        Returns:
            The victim, the steps done until then, those of them that were repeated, and the most
            repeated steps of a run as a share of its checkpoint interval.
        """
        sweep = self.start(cluster.address)
        runs = ['base-0', 'arm-0']
        sizes = {'base': self._steps, 'arm': self._outer_steps}
        deadline = time.monotonic() + _DEADLINE_S
        while True:  # a share of every kind of run, as their steps are of different length
            done = {run: last_step(self.out / run) for run in runs}
            share = sum(steps / sizes[run.partition('-')[0]] for run, steps in done.items())
            programs = programs_of(self.out)
            if share >= moment * len(runs) and programs:
                break
            if sweep.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError(f'{self.out}: ended or hung before the kill')
            time.sleep(0.02)
        program = programs[0]
        worker = parent_of(program)
        raylet = parent_of(worker)
        if victim in ('program', 'machine'):
            os.kill(program, signal.SIGKILL)
        if victim in ('worker', 'machine'):
            os.kill(worker, signal.SIGKILL)
        if victim in ('raylet', 'machine'):
            os.kill(raylet, signal.SIGKILL)
            _add_machine(cluster, num_cpus=1)
        if victim == 'sweep':
            sweep.kill()
            sweep.wait()
            sweep = self.start(cluster.address)
        self._await(sweep)
        repeated = {run: steps - self._continued_from(run, steps) for run, steps in done.items()}
        intervals = [steps / self._every[run.partition('-')[0]] for run, steps in repeated.items()]
        return {
            'killed': victim,
            'steps before': sum(done.values()),
            'steps repeated': sum(repeated.values()),
            'of a checkpoint interval': max(intervals),
        }

    def results(self) -> list[Any]:
        """The curves of all policies, in the order of the manifest."""
        manifest = json.loads((self.out / 'manifest.json').read_text(encoding='utf-8'))
        file = self.out / manifest['adaptations']['ttt']['file']
        results = json.loads(file.read_text(encoding='utf-8'))['results']
        from metagcttt_core import load_checkpoint

        return [
            (load_checkpoint(result['checkpoint']).fingerprint(), result['curve'])
            for result in results
        ]

    def _await(self, sweep: subprocess.Popen[bytes]) -> None:
        if sweep.wait(_DEADLINE_S):
            log = self.out.with_suffix('.log').read_text(encoding='utf-8')
            raise RuntimeError(f'{self.out}: ended with {sweep.returncode}\n{log[-2000:]}')

    def _continued_from(self, run: str, done: int) -> int:
        """The step that a run's second attempt began with; `done` if there was none."""
        path = self.out / f'{run}.log'
        attempts = path.read_text(encoding='utf-8').split(f'{ATTEMPT} ') if done else []
        if len(attempts) < 3:  # nothing, an attempt
            return done
        found = re.search(r'continues after step (\d+)', attempts[2])
        return min(done, int(found[1])) if found else 0


def programs_of(out: Path) -> list[int]:
    """Ids of the processes that run programs in a folder, or in one below."""
    found = []
    for process in Path('/proc').glob('[0-9]*'):
        try:
            words = (process / 'cmdline').read_bytes().split(b'\0')
        except OSError:  # it has ended
            continue
        inside = any(word.startswith(str(out).encode()) for word in words)
        if words[1:3] == [b'-m', b'metagcttt_tools'] and inside and b'sweep' not in words:
            found.append(int(process.name))
    return sorted(found)


def _training(data: Path, steps: int) -> dict[str, Any]:
    """Settings of a small training."""
    return {
        'dataset': str(data),
        'hidden': [32],
        'training': {'steps': steps, 'batch_size': 32},
        'checkpoint_every': steps // 10,
        'log_every': steps // 10,
    }


def _trainings(data: Path, folder: Path, steps: int, count: int) -> list[Job]:
    folder.mkdir()
    jobs = []
    for seed in range(count):
        out, preset = folder / f'{seed}', folder / f'{seed}.yaml'
        values = {**_training(data, steps), 'out': str(out), 'seed': seed}
        preset.write_text(yaml.safe_dump({'pretrain': values}), encoding='utf-8')
        invocation = Invocation('pretrain', preset, out, folder)
        jobs.append(Job(invocation, steps, partial(last_step, out)))
    return jobs


def parent_of(process: int) -> int:
    """Id of the process that started another, which may be killed.

    Raises:
        RuntimeError: If that one has ended, so that the first process of the machine, or none,
            stands in its place.
    """
    fields = Path(f'/proc/{process}/stat').read_text(encoding='utf-8').rpartition(')')[2].split()
    parent = int(fields[1])
    if parent <= 1:
        raise RuntimeError(f'process {process} has lost the process that started it')
    return parent


def _random_walks(path: Path) -> Path:
    """A dataset that wanders all over the medium maze's square."""
    rng = np.random.default_rng(0)
    steps = rng.normal(0, 0.6, size=(40, 101, 2)).cumsum(axis=1)
    observations = (steps + rng.uniform(0, 20, size=(40, 1, 2))).reshape(-1, 2)
    terminals = np.zeros((40, 101), bool)
    terminals[:, -1] = True
    actions = np.clip(rng.normal(size=observations.shape), -1, 1)
    TrajectoryDataset.from_arrays(observations, actions, terminals.reshape(-1)).save(path)
    return path


@contextmanager
def two_machines() -> Iterator[Any]:
    """A Ray cluster on this machine: a head without cores, and two raylets with one core each.

    Raises:
        TimeoutError: If a raylet does not start.
    """
    os.environ.setdefault('RAY_USAGE_STATS_ENABLED', '0')
    import ray
    from ray.cluster_utils import Cluster

    cluster = Cluster()
    try:
        _add_machine(cluster, num_cpus=0, include_dashboard=False)  # the first is the head
        for _ in range(_MACHINES):
            _add_machine(cluster, num_cpus=1)
        cluster.wait_for_nodes(timeout=300)
        yield cluster
    finally:
        ray.shutdown()  # where this process has connected to it
        cluster.shutdown()


def _add_machine(cluster: Any, **settings: Any) -> None:
    """Ray gives a raylet 30 s to start, which is short where much else runs."""
    for _ in range(_STARTS):
        try:
            cluster.add_node(**settings)
            return
        except Exception as error:  # Ray raises nothing narrower
            if 'timed out during startup' not in str(error):
                raise
    raise TimeoutError(f'Ray started no machine within its 30 s, {_STARTS} times')
