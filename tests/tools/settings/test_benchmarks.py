"""Every setting of the benchmarks, by what they measure and how often; times are left out."""

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
import sys
from types import SimpleNamespace
from typing import Any

import metagcttt_core
from metagcttt_core.meta import experts
from metagcttt_tools.benchmarks import cluster, inner_loop, meta, retrieval, sim, training
from metagcttt_tools.common import plots
import numpy as np
import pytest
from tests.tools.settings.test_training import META
from tests.tools.settings.walk import Proof, Seen, Walk, walks_through
import torch


def without_figures(
    module: Any, watch: Callable[[pytest.MonkeyPatch, Seen], None]
) -> Callable[[pytest.MonkeyPatch, Seen], None]:
    """`watch`, where the report is noted by its file alone, as its figures are times."""

    def watching(patch: pytest.MonkeyPatch, seen: Seen) -> None:
        patch.setattr(module, 'write_report', lambda path, *_: seen.append(path))
        patch.setattr(plots, 'save', lambda figure, path: seen.append(path))
        watch(patch, seen)

    return watching


def watch_meta(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    post_train, adapt = metagcttt_core.post_train, experts.adapt_to_tasks

    def trained(*arguments, **named):
        policy = post_train(*arguments, **named)
        seen.append(policy)
        return policy

    def adapted(*arguments):
        found = adapt(*arguments)
        seen.append([expert.result.agent for expert in found])
        return found

    patch.setattr(metagcttt_core, 'post_train', trained)
    patch.setattr(experts, 'adapt_to_tasks', adapted)


NO_CRITIC = 'have no effect on GCBC, which has no critic'
BENCHMARK_META = Walk(
    'benchmark meta',
    {
        'dataset': '@walks.npz',
        'hidden': [4],
        'rounds': 1,
        'tasks': [2],
        **{name: value for name, value in META.base.items() if name.startswith('meta.')},
    },
    {
        'dataset': '@half.npz',
        'out': 'elsewhere.json',
        'hidden': [3],
        'rounds': 2,
        'threads': 2,
        'tasks': [3],
        'seed': 1,
        **{name: proof for name, proof in META.proofs.items() if name.startswith('meta.')},
        'meta.outer_steps': Proof(3, {'meta.algorithm': 'reptile'}),
        'meta.actor_only': Proof(True, refused=NO_CRITIC),
        'meta.filter.min_steps': Proof(60, refused=NO_CRITIC),
    },
    without_figures(meta, watch_meta),
)


def watch_retrieval(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    def noting(call, *arguments):
        seen.append([a for a in arguments if isinstance(a, np.ndarray)])
        seen.append([a.digest.hex() for a in arguments if hasattr(a, 'digest')])
        return call(*arguments), 1.0

    patch.setattr(retrieval, 'timed', noting)


BENCHMARK_RETRIEVAL = Walk(
    'benchmark retrieval',
    {'data': '@mazes', 'queries': 5, 'goals': 1, 'hidden': [4]},
    {
        'data': '@half-mazes',
        'out': 'elsewhere',
        'queries': 6,
        'goals': 2,
        'hidden': [3],
        'seed': 1,
    },
    without_figures(retrieval, watch_retrieval),
)


def watch_simulation(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    make_simulator = sim.make_simulator

    def made(name):
        seen.append(name)
        return make_simulator(name)

    def seconds(step, actions):
        seen.append(actions)
        return 1.0

    patch.setattr(sim, 'make_simulator', made)
    patch.setattr(sim, '_seconds', seconds)


BENCHMARK_SIM = Walk(
    'benchmark sim',
    {'environments': ['pointmaze-medium-v0'], 'steps': 2, 'rounds': 1},
    {
        'out': 'elsewhere',
        'environments': ['pointmaze-large-v0'],
        'steps': 3,
        'rounds': 2,
        'seed': 1,
    },
    without_figures(sim, watch_simulation),
)


def watch_updates(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    def update_of(agent, batch, precision, *, compiled):
        seen.append((agent, len(batch['observations']), precision, compiled))

    def median_ms(ways, repeats):
        seen.append(('repeats', repeats))
        return dict.fromkeys(ways, 1.0)

    patch.setattr(training, 'update_of', update_of)
    patch.setattr(training, 'products_of', lambda update: [])
    patch.setattr(training, 'median_ms', median_ms)


BENCHMARK_TRAINING = Walk(
    'benchmark training',
    {'sizes': [[4, 1, 8]], 'threads': [1], 'precisions': ['float32'], 'compiled': False},
    {
        'out': 'elsewhere.json',
        'sizes': [[4, 1, 9]],
        'threads': [2],
        'obs_dim': 3,
        'act_dim': 3,
        'precisions': ['bfloat16'],
        'compiled': True,
        'repeats': 4,
    },
    without_figures(training, watch_updates),
)


def watch_inner_loops(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    def times_ms(ways, repeats, clock):
        seen.append((sorted(ways), repeats, torch.get_num_threads()))
        result = ways['early stopping']()
        seen.append((result.train_losses, result.test_losses))
        return {way: [1.0] for way in ways}

    patch.setattr(inner_loop, 'times_ms', times_ms)


BENCHMARK_INNER_LOOP = Walk(
    'benchmark inner-loop',
    {'sizes': [[4, 1, 8]], 'steps': 2},
    {
        'out': 'elsewhere.json',
        'sizes': [[4, 1, 9]],
        'agents': ['gcbc'],
        'steps': 3,
        'test_rows': 1,
        'threads': 2,
        'repeats': 4,
    },
    without_figures(inner_loop, watch_inner_loops),
)


def watch_cluster(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    machines = SimpleNamespace(address='here')
    patch.setattr(cluster, 'two_machines', lambda: nullcontext(machines))
    schedulers = SimpleNamespace(RayScheduler=lambda resources: 'Ray')
    patch.setitem(sys.modules, 'metagcttt_tools.jobs.cluster', schedulers)
    patch.setenv('RAY_ADDRESS', 'there')
    patch.setattr(
        cluster, 'run_all', lambda name, jobs, *_: seen.append((name, [job.size for job in jobs]))
    )

    class Study:
        def __init__(self, data, out, steps):
            self.out = out
            out.mkdir()
            seen.append(('study', steps))

        def write(self):
            pass

        def finish(self, address):
            pass

        def finish_despite(self, victim, moment, machines):
            seen.append((victim, moment))
            return {}

        def results(self):
            return []

    patch.setattr(cluster, 'SmallStudy', Study)


BENCHMARK_CLUSTER = Walk(
    'benchmark cluster',
    {'jobs': 3, 'kills': 2},
    {'out': 'elsewhere.json', 'jobs': 4, 'steps': 300, 'kills': 3, 'seed': 1},
    without_figures(cluster, watch_cluster),
)

WALKS = (
    BENCHMARK_CLUSTER,
    BENCHMARK_INNER_LOOP,
    BENCHMARK_META,
    BENCHMARK_RETRIEVAL,
    BENCHMARK_SIM,
    BENCHMARK_TRAINING,
)


@walks_through(WALKS)
def test_setting(walk: Walk, name: str, tmp_path: Path, places: Path) -> None:
    walk.check(name, tmp_path, places)
