"""How near policies are to held-out trajectories by test-time training budget, no simulator."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import as_completed, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import lru_cache
import multiprocessing
from pathlib import Path
import sys
from typing import Any, NamedTuple, TYPE_CHECKING

from metagcttt_core import TrajectoryDataset, TrajectoryFilter
from metagcttt_core.adaptation import TTTSettings
from metagcttt_core.config import Settings
from metagcttt_core.files import read_json, write_json
from metagcttt_core.retrieval import FilterSettings
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator
from sim_bridge.generation.workers import end_with_parent
from tqdm import tqdm

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.results import markdown_table
from metagcttt_tools.common.session import provenance, sole_writer, use_threads
from metagcttt_tools.common.sources import identities

if TYPE_CHECKING:
    from metagcttt_core.evaluation.offline import Outcome, Query

_DESCRIPTION = """How near policies are to held-out trajectories, without a simulator.

Example: metagcttt evaluate-offline --checkpoints out/pretrain/checkpoint --grid
A state of a held-out trajectory and a later one of it as the goal are a query: filter, adapt, and
compare actions with the recorded ones on that way. --grid ranks radius, K and learning rate."""

_CHUNK = 16  # queries


class OfflineSettings(Settings):
    """Settings of the program."""

    checkpoints: tuple[Path, ...] = Field(
        (Path('out/pretrain/checkpoint'),), min_length=1, description='policies to evaluate'
    )
    dataset: Path = Field(
        Path('data/pointmaze-medium-navigate-v0.npz'), description='dataset to adapt on (npz)'
    )
    held_out: Path | None = Field(
        None,
        description='held-out trajectories (npz); by default DATASET-val.npz, else a share of the '
        'dataset',
    )
    held_out_share: float = Field(
        0.1, gt=0, lt=1, description='share of the trajectories to hold out where there is no file'
    )
    trajectories: int = Field(50, ge=2, description='held-out trajectories to take')
    queries: int = Field(1, ge=1, description='queries a trajectory and distance')
    steps_ahead: tuple[int, ...] = Field(
        (10, 50, 100, 200), min_length=1, description='distances: rows from state to goal'
    )
    budgets: tuple[int, ...] = Field(
        (0, 10, 20, 50, 100, 200), min_length=1, description='numbers of gradient steps K'
    )
    ttt: TTTSettings = Field(TTTSettings(), description='test-time training')
    filter: FilterSettings = FilterSettings()
    grid: bool = Field(False, description='rank all of `epsilons`, `lrs` and `budgets`')
    epsilons: tuple[float, ...] = Field(
        (0.5, 1.0, 2.0), min_length=1, description="radii of the grid, instead of the filter's"
    )
    lrs: tuple[float, ...] = Field(
        (1e-4, 3e-4, 1e-3),
        min_length=1,
        description="learning rates of the grid, instead of ttt's",
    )
    against: tuple[Path, ...] = Field(
        (), description='results of metagcttt evaluate: rank correlation with success'
    )
    seed: int = Field(0, ge=0, description='random seed of queries and adaptation')
    processes: int = Field(2, ge=1, description='processes to spread the work over')
    out: Path = Field(
        Path('out/offline.json'), description='file for the results; the picture is beside it'
    )

    @field_validator('budgets', 'steps_ahead')
    @classmethod
    def _ascend(cls, values: tuple[int, ...], info: Any) -> tuple[int, ...]:
        if list(values) != sorted(set(values)) or values[0] < (info.field_name == 'steps_ahead'):
            lowest = int(info.field_name == 'steps_ahead')
            raise ValueError(f'must ascend from {lowest} or more')
        return values

    @field_validator('ttt')
    @classmethod
    def _adapts_once(cls, ttt: TTTSettings) -> TTTSettings:
        if ttt.horizon is not None:
            raise ValueError('horizon is of episodes: a query is adapted to once')
        return ttt


class Arm(NamedTuple):
    """What is compared: a policy, a radius and a learning rate."""

    checkpoint: str
    epsilon: float
    lr: float


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(OfflineSettings, _DESCRIPTION, 'evaluate-offline', argv)
    from metagcttt_core.evaluation.offline import draw_queries

    from metagcttt_tools.common import offline_plots, plots

    try:
        picture = settings.out.with_suffix('.png')
        with sole_writer(settings.out, settings.out, picture):
            known = [read_success(path) for path in settings.against]
            marks = identities(settings.dataset, settings.checkpoints)
            source, train, held_out = split(settings)
            queries = draw_queries(
                held_out,
                settings.steps_ahead,
                settings.queries,
                settings.trajectories,
                settings.seed,
            )
            print(f'{len(queries)} queries from {source}')
            results = summarise(settings, run(settings, train, held_out, queries))
            report = {
                'settings': settings.model_dump(mode='json'),
                **provenance(),
                **marks,
                'held_out': source,
                'results': results,
            }
            if known:
                success = {k: v for each in known for k, v in each.items()}
                report['against'] = correlation(results, success)
            write_json(settings.out, report)
            plots.save(offline_plots.offline_picture(results), picture)
    except ValueError as error:
        fail(str(error))
    except KeyboardInterrupt:
        print('interrupted', file=sys.stderr)
        raise SystemExit(130) from None
    print(format_table(results, settings.grid))
    if known:
        print(describe_correlation(report['against']))
    print(f'results: {settings.out}, picture: {picture}')


def split(settings: OfflineSettings) -> tuple[str, TrajectoryDataset, TrajectoryDataset]:
    """Where the held-out trajectories are from, in words; the data to adapt on; and they."""
    from metagcttt_core.evaluation.offline import hold_out

    dataset = TrajectoryDataset.load(settings.dataset)
    beside = settings.dataset.with_name(f'{settings.dataset.stem}-val.npz')
    path = settings.held_out or (beside if beside.exists() else None)
    if path is None:
        train, held_out = hold_out(dataset, settings.held_out_share, settings.seed)
        source = (
            f'{held_out.num_episodes} trajectories of {settings.dataset}, which are not retrieved '
            '(policies trained on that file have seen them)'
        )
        return source, train, held_out
    held_out = TrajectoryDataset.load(path)
    if (held_out.obs_dim, held_out.act_dim) != (dataset.obs_dim, dataset.act_dim):
        raise ValueError(
            f'{path}: observations or actions differ in width from {settings.dataset}'
        )
    return str(path), dataset, held_out


def run(
    settings: OfflineSettings,
    train: TrajectoryDataset,
    held_out: TrajectoryDataset,
    queries: Sequence[Query],
) -> dict[Arm, list[Outcome]]:
    """The outcomes of all queries by arm."""
    radius = settings.filter.on(train.contract).epsilon
    arms = [
        Arm(str(path), epsilon, lr)
        for path in settings.checkpoints
        for epsilon in (settings.epsilons if settings.grid else (radius,))
        for lr in (settings.lrs if settings.grid else (settings.ttt.lr,))
    ]
    jobs = [(arm, first) for arm in arms for first in range(0, len(queries), _CHUNK)]
    found: dict[tuple[Arm, int], list[Outcome]] = {}
    start = (settings, train, held_out, list(queries))
    with tqdm(total=len(arms) * len(queries), unit='query', desc='evaluate') as bar:
        for job, outcomes in _each(jobs, settings.processes, start):
            found[job] = outcomes
            bar.update(len(outcomes))
    return {arm: [each for job in jobs if job[0] == arm for each in found[job]] for arm in arms}


def _each(
    jobs: Sequence[tuple[Arm, int]], processes: int, start: tuple[Any, ...]
) -> Iterator[tuple[tuple[Arm, int], list[Outcome]]]:
    """The jobs with their outcomes, as they end."""
    if processes == 1:
        _start_worker(*start)
        for job in jobs:
            yield job, _outcomes(*job)
        return
    pool = ProcessPoolExecutor(
        processes,
        mp_context=multiprocessing.get_context('spawn'),
        initializer=_start_worker,
        initargs=start,
    )
    try:
        futures = {pool.submit(_outcomes, *job): job for job in jobs}
        for future in as_completed(futures):
            yield futures[future], future.result()
    except BrokenProcessPool as error:
        raise ValueError('a worker process died (out of memory?): give fewer processes') from error
    finally:
        pool.shutdown(cancel_futures=True)


class _Worker:
    """State that a worker process gets once."""

    settings: OfflineSettings
    train: TrajectoryDataset
    held_out: TrajectoryDataset
    queries: list[Query]


def _start_worker(
    settings: OfflineSettings,
    train: TrajectoryDataset,
    held_out: TrajectoryDataset,
    queries: list[Query],
) -> None:
    use_threads(1)
    if multiprocessing.parent_process() is not None:
        end_with_parent()
    _Worker.settings, _Worker.train = settings, train
    _Worker.held_out, _Worker.queries = held_out, queries
    _filter.cache_clear()


@lru_cache(maxsize=1)
def _filter(epsilon: float) -> TrajectoryFilter:
    config = _Worker.settings.filter.model_copy(update={'epsilon': epsilon})
    return TrajectoryFilter(_Worker.train, config)


def _outcomes(arm: Arm, first: int) -> list[Outcome]:
    from metagcttt_core import load_checkpoint
    from metagcttt_core.evaluation.offline import evaluate_query

    settings = _Worker.settings
    agent = load_checkpoint(arm.checkpoint)
    ttt = settings.ttt.model_copy(update={'lr': arm.lr})
    return [
        evaluate_query(
            agent,
            _filter(arm.epsilon),
            _Worker.held_out,
            query,
            ttt,
            settings.budgets,
            settings.seed + first + number,
        )
        for number, query in enumerate(_Worker.queries[first : first + _CHUNK])
    ]


def summarise(
    settings: OfflineSettings, outcomes: dict[Arm, list[Outcome]]
) -> list[dict[str, Any]]:
    """The figures of each arm and budget, over all queries and by distance."""
    results = []
    for arm, found in outcomes.items():
        by_distance: dict[int, list[Outcome]] = defaultdict(list)
        for outcome in found:
            by_distance[outcome.steps].append(outcome)
        whole = _figures(found, settings.budgets)
        parts = {steps: _figures(by_distance[steps], settings.budgets) for steps in by_distance}
        for number, budget in enumerate(settings.budgets):
            results.append(
                {
                    **arm._asdict(),
                    'budget': budget,
                    **whole[number],
                    'by_distance': {
                        str(steps): {
                            'distance': float(np.mean([o.distance for o in by_distance[steps]])),
                            **figures[number],
                        }
                        for steps, figures in parts.items()
                    },
                }
            )
    return results


def _figures(found: Sequence[Outcome], budgets: Sequence[int]) -> list[dict[str, Any]]:
    """Error, likelihood and how both changed by adapting, with intervals, for each budget."""
    from metagcttt_core.evaluation.offline import bootstrap, interval

    trajectories = np.array([outcome.trajectory for outcome in found])
    squares = bootstrap(_table([o.errors for o in found], budgets), trajectories)
    densities = bootstrap(_table([o.log_likelihoods for o in found], budgets), trajectories)
    errors = np.sqrt(squares)
    supports = np.array([outcome.support for outcome in found])
    facts = {
        'queries': len(found),
        'empty': float((supports == 0).mean()),
        'support': float(np.median(supports)),
    }
    return [
        {
            'error': interval(errors[:, number])._asdict(),
            'error_change': interval(errors[:, number] - errors[:, 0])._asdict(),
            'log_likelihood': interval(densities[:, number])._asdict(),
            'log_likelihood_change': interval(densities[:, number] - densities[:, 0])._asdict(),
            **facts,
        }
        for number in range(len(budgets))
    ]


def _table(by_budget: Sequence[Any], budgets: Sequence[int]) -> NDArray[np.float64]:
    return np.array([[values[budget] for budget in budgets] for values in by_budget])


def format_table(results: list[dict[str, Any]], ranked: bool) -> str:
    """The figures as a Markdown table; ranked, those of least error first."""
    rows = sorted(results, key=lambda row: row['error']['mean']) if ranked else results
    return markdown_table(
        [
            {
                **({'': rank} if ranked else {}),
                'policy': row['checkpoint'],
                'radius': row['epsilon'],
                'learning rate': f'{row["lr"]:g}',
                'K': row['budget'],
                'action error': _in_words(row['error']),
                'change by adapting': _in_words(row['error_change'], signed=True),
                'log-likelihood': _in_words(row['log_likelihood']),
                'empty support': f'{row["empty"]:.0%}',
                **{
                    f'{steps} ahead': f'{part["error"]["mean"]:.3f}'
                    for steps, part in row['by_distance'].items()
                },
            }
            for rank, row in enumerate(rows, start=1)
        ]
    )


def _in_words(found: dict[str, float], *, signed: bool = False) -> str:
    sign = '+' if signed else ''
    return f'{found["mean"]:{sign}.3f} ({found["low"]:{sign}.3f} to {found["high"]:{sign}.3f})'


Key = tuple[str, int, float | None, float | None]
"""Checkpoint, budget, radius and learning rate, which do not count without adaptation."""


def _key(checkpoint: str, budget: int, epsilon: float, lr: float) -> Key:
    return (checkpoint, budget, epsilon, lr) if budget else (checkpoint, 0, None, None)


def read_success(path: Path) -> dict[Key, float]:
    """Success by policy and settings, from the results of `metagcttt evaluate`.

    Raises:
        ValueError: If the file has no such results.
    """
    try:
        report = read_json(path)
        settings = report['settings']
        epsilon, lr = settings['filter']['epsilon'], settings['ttt']['lr']
        return {
            _key(result['checkpoint'], point['budget'], epsilon, lr): point['success']
            for result in report['results']
            for point in result['curve']
        }
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise ValueError(f'{path}: no results of metagcttt evaluate ({error})') from error


def correlation(
    results: list[dict[str, Any]], success: dict[Key, float], draws: int = 2000
) -> dict[str, Any]:
    """Spearman's rank correlation of success in simulation with less error on held-out data.

    Over all policies and settings that both have, with its 95 percent interval from resampling
    them; within each policy, over its settings; and the mean of those, resampled by policy.

    Raises:
        ValueError: If there are less than three.
    """
    from metagcttt_core.evaluation.offline import bootstrap, interval

    pairs = {
        key: (-row['error']['mean'], success[key])
        for row in results
        if (key := _key(row['checkpoint'], row['budget'], row['epsilon'], row['lr'])) in success
    }
    if len(pairs) < 3:
        raise ValueError(f'only {len(pairs)} of the policies and settings are in both results')
    values = np.array(list(pairs.values()))
    rng = np.random.default_rng(0)
    resampled = [
        spearman(values[rng.integers(len(values), size=len(values))]) for _ in range(draws)
    ]
    within = defaultdict(list)
    for key, pair in pairs.items():
        within[key[0]].append(pair)
    low, high = np.nanpercentile(resampled, (2.5, 97.5))
    each = {name: spearman(np.array(rows)) for name, rows in within.items()}
    known = np.array([value for value in each.values() if np.isfinite(value)])
    return {
        'spearman': {'mean': spearman(values), 'low': float(low), 'high': float(high)},
        'arms': len(values),
        'within': each,
        'within_mean': interval(bootstrap(known, np.arange(len(known))))._asdict()
        if len(known)
        else None,
        'pairs': [
            {
                **dict(zip(('checkpoint', 'budget', 'epsilon', 'lr'), key, strict=True)),
                'error': -negative,
                'success': rate,
            }
            for key, (negative, rate) in pairs.items()
        ],
    }


def spearman(pairs: NDArray[np.float64]) -> float:
    """Spearman's rank correlation of (n, 2) numbers; nan where one of the two never changes."""
    from scipy.stats import rankdata

    ranks = rankdata(pairs, axis=0)
    if (np.ptp(ranks, axis=0) == 0).any():
        return float('nan')
    return float(np.corrcoef(ranks.T)[0, 1])


def describe_correlation(found: dict[str, Any]) -> str:
    """The rank correlation as text."""
    total = found['spearman']
    lines = [
        f'rank correlation with success over {found["arms"]} policies and settings: '
        f'{total["mean"]:.2f} ({total["low"]:.2f} to {total["high"]:.2f})'
    ]
    lines += [f'  within {name}: {value:.2f}' for name, value in found['within'].items()]
    if mean := found['within_mean']:
        lines.append(
            f'  within a policy: {mean["mean"]:.2f} ({mean["low"]:.2f} to {mean["high"]:.2f})'
        )
    return '\n'.join(lines)
