"""Success of policies by test-time training budget, over tasks, episodes and seeds."""

from collections.abc import Mapping, Sequence
from concurrent.futures import as_completed, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
import multiprocessing
from pathlib import Path
import sys
from typing import Any, ClassVar

from metagcttt_core import (
    FilterConfig,
    normalized_auc,
    success_statistics,
    TrajectoryDataset,
    TrajectoryFilter,
)
from metagcttt_core.adaptation import TTTSettings
from metagcttt_core.agents.config import ActorLoss
from metagcttt_core.config import Settings
from metagcttt_core.files import read_json, write_json
import numpy as np
from pydantic import Field, field_validator
from sim_bridge import make_simulator
from sim_bridge.generation.workers import end_with_parent
from tqdm import tqdm

from metagcttt_tools import evaluate_offline
from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.environment import environment_of
from metagcttt_tools.common.job_log import JobLog
from metagcttt_tools.common.results import markdown_table, start_column
from metagcttt_tools.common.resume import kept_in, Resumable
from metagcttt_tools.common.session import provenance, sole_writer, use_threads
from metagcttt_tools.common.sources import check_fingerprints, identities

_DESCRIPTION = """Success of policies by test-time training budget.

Example: metagcttt evaluate --checkpoints out/pretrain/checkpoint out/meta/checkpoint
Prints a table with standard errors over seeds and writes OUT as JSON. Without a simulator,
--offline compares with held-out trajectories; evaluate --offline --help has its flags.
Ctrl-C is safe; --resume, with no other flag than --out, continues."""


Job = tuple[str, str, int, int, int]
"""Checkpoint, environment, budget, seed and task."""


class EpisodeSettings(Settings):
    """Settings of the episodes and of the adaptation in them."""

    dataset: Path = Field(
        Path('data/pointmaze-medium-navigate-v0.npz'), description='dataset to adapt on (npz)'
    )
    budgets: tuple[int, ...] = Field(
        (0, 10, 20, 50, 100, 200), min_length=1, description='numbers of gradient steps K'
    )
    ttt: TTTSettings = Field(TTTSettings(), description='test-time training')
    filter: FilterConfig = FilterConfig()
    episodes: int = Field(10, ge=1, description='episodes per task and seed')
    seeds: tuple[int, ...] = Field((0, 1, 2), min_length=1, description='evaluation seeds')
    standing: bool = Field(
        False, description='start humanoids on their feet, not dropped as OGBench does'
    )


class ProtocolSettings(Resumable, EpisodeSettings):
    """Settings of an evaluation without ROS."""

    # The data are known by their content, wherever they are.
    may_change: ClassVar[frozenset[str]] = frozenset({'dataset', 'processes'})

    actor_loss: ActorLoss | None = Field(
        None, description="actor loss to adapt GCIQL policies with; each policy's own by default"
    )
    processes: int = Field(2, ge=1, description='processes to spread the work over')
    out: Path = Field(Path('out/evaluation.json'), description='file for the results')

    def kept(self) -> tuple[Path, Mapping[str, Any]] | None:
        """The settings of an interrupted call, which its log of finished jobs begins with.

        Those of a finished one are with its results.
        """
        log = finished_jobs(self.out)
        return (log, JobLog.settings(log)['program']) if log.exists() else kept_in(self.out)

    @field_validator('out')
    @classmethod
    def _known_ending(cls, out: Path) -> Path:
        if out.suffix != '.json':
            raise ValueError(f'must end in .json, got {out.name}')
        return out


class EvaluateSettings(ProtocolSettings):
    """Settings of the program."""

    checkpoints: tuple[Path, ...] = Field(
        (Path('out/pretrain/checkpoint'),), min_length=1, description='policies to evaluate'
    )


def main(argv: list[str] | None = None) -> None:
    """Run the program; with `--offline`, that for data without a simulator."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if '--offline' in arguments:
        evaluate_offline.main([argument for argument in arguments if argument != '--offline'])
        return
    settings = parse(EvaluateSettings, _DESCRIPTION, 'evaluate', arguments)
    try:
        with sole_writer(settings.out, settings.out):
            known = identities(settings.dataset, settings.checkpoints, settings.actor_loss)
            marks = known['fingerprints']
            done = finished_before(settings, marks)
            results = done['results'] if done else evaluate(settings, settings, marks)
            if not done:
                report = {'settings': settings.model_dump(mode='json'), **provenance()}
                write_json(settings.out, {**report, **known, 'results': results})
                finished_jobs(settings.out).unlink()
    except ValueError as error:
        fail(str(error))
    except KeyboardInterrupt:
        print('interrupted; pass --resume to continue', file=sys.stderr)
        raise SystemExit(130) from None
    print(format_table(results, settings.standing))
    print(f'results: {settings.out}')


def evaluate(
    settings: EvaluateSettings, program: Resumable, fingerprints: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Success by policy and budget: rates per seed, their mean and error, and the AUC.

    Each point says, too, which share of the experts was accepted.

    Args:
        settings: What to evaluate.
        program: The settings to continue with after an interruption.
        fingerprints: Of the data and policies, see `sources`; what finishes is kept in
            `finished_jobs` until the caller has kept the results.

    Raises:
        ValueError: If data or policies are not those of the fingerprints.
    """
    from metagcttt_core import load_checkpoint

    environments = [environment_of(load_checkpoint(path)) for path in settings.checkpoints]
    num_tasks = make_simulator(environments[0], standing=settings.standing).spec.num_tasks
    jobs = [
        (str(path), environment, budget, seed, task)
        for path, environment in zip(settings.checkpoints, environments, strict=True)
        for budget in settings.budgets
        for seed in settings.seeds
        for task in range(1, num_tasks + 1)
    ]
    outcomes = _run_jobs(settings, program, jobs, fingerprints)
    results = []
    for path, environment in zip(settings.checkpoints, environments, strict=True):
        curve = []
        for budget in settings.budgets:
            key = (str(path), environment, budget)
            rates = {
                task: [outcomes[*key, seed, task][0] for seed in settings.seeds]
                for task in range(1, num_tasks + 1)
            }
            shares = [
                outcomes[*key, seed, task][1]
                for seed in settings.seeds
                for task in range(1, num_tasks + 1)
            ]
            curve.append({**success_point(budget, rates), 'accepted': float(np.mean(shares))})
        results.append(success_curve(path, curve))
    return results


def success_point(budget: int, rates: Mapping[int, Sequence[float]]) -> dict[str, Any]:
    """Success of one policy with one budget, given its rates by task and seed."""
    per_seed = np.mean(list(rates.values()), axis=0)
    statistics = success_statistics(per_seed)
    return {
        'budget': budget,
        'success': statistics.mean,
        'standard_error': statistics.standard_error,
        'per_seed': per_seed.tolist(),
        'per_task': {task: float(np.mean(values)) for task, values in rates.items()},
    }


def success_curve(checkpoint: Path, curve: list[dict[str, Any]]) -> dict[str, Any]:
    """The points of one policy with the area under them."""
    budgets = [point['budget'] for point in curve]
    successes = [point['success'] for point in curve]
    auc = normalized_auc(budgets, successes) if len(curve) > 1 else None
    return {'checkpoint': str(checkpoint), 'curve': curve, 'auc': auc}


def format_table(results: list[dict[str, Any]], standing: bool = False) -> str:
    """Success by budget as a Markdown table."""
    return markdown_table(
        [
            {
                'policy': result['checkpoint'],
                **start_column(standing),
                **{
                    f'K = {point["budget"]}': f'{point["success"]:.2f} ± '
                    f'{point["standard_error"]:.2f}'
                    for point in result['curve']
                },
                'AUC': '' if result['auc'] is None else f'{result["auc"]:.3f}',
            }
            for result in results
        ]
    )


def finished_jobs(out: Path) -> Path:
    """The log of the jobs that an evaluation has finished, while it is under way."""
    return out.with_suffix('.partial.jsonl')


def finished_before(
    program: ProtocolSettings, fingerprints: Mapping[str, Any]
) -> dict[str, Any] | None:
    """The report of a finished call that is asked to go on; None where something is left to do.

    Raises:
        ValueError: If it is of other data or policies.
    """
    out = program.out
    if not program.resume or finished_jobs(out).exists() or not out.exists():
        return None
    report = read_json(out)
    check_fingerprints(out, report, fingerprints)
    return report


def _run_jobs(
    settings: EvaluateSettings,
    program: Resumable,
    jobs: list[Job],
    fingerprints: Mapping[str, Any],
) -> dict[Job, tuple[float, float]]:
    """The outcome of every job; jobs run in separate processes and are kept as they finish."""
    from metagcttt_core import load_checkpoint
    from metagcttt_core.training.optimizers import pretrained_state

    policies = [load_checkpoint(path) for path in settings.checkpoints]
    if settings.ttt.optimizer_state == 'pretrained':
        for policy in policies:
            pretrained_state(policy)  # refuses those without one before anything runs
    log: JobLog[Job] = JobLog(
        finished_jobs(settings.out),
        {
            'decisive': {**settings.decisive(), **fingerprints},
            'program': program.model_dump(mode='json'),
        },
        resume=settings.resume,
    )
    pool = ProcessPoolExecutor(
        settings.processes,
        mp_context=multiprocessing.get_context('spawn'),
        initializer=_start_worker,
        initargs=(settings, fingerprints),
    )
    todo = [job for job in jobs if job not in log.finished]
    with tqdm(total=len(jobs), initial=len(jobs) - len(todo), unit='job', desc='evaluate') as bar:
        try:
            futures = {pool.submit(_outcome, job): job for job in todo}
            for future in as_completed(futures):
                log.add(futures[future], future.result())
                bar.update()
        except BrokenProcessPool as error:
            raise ValueError(
                'a worker process died (out of memory?): resume with fewer processes'
            ) from error
        finally:
            pool.shutdown(cancel_futures=True)
    log.close()
    return log.finished


class _Worker:
    """State that a worker process loads once."""

    settings: EvaluateSettings
    fingerprints: Mapping[str, str]  # of the policies, by path
    outdated: bool
    trajectory_filter: TrajectoryFilter


def _start_worker(settings: EvaluateSettings, fingerprints: Mapping[str, Any]) -> None:
    end_with_parent()
    use_threads(1)
    _Worker.settings = settings
    paths = map(str, settings.checkpoints)
    _Worker.fingerprints = dict(zip(paths, fingerprints['policies'], strict=True))
    dataset = TrajectoryDataset.load(settings.dataset)
    _Worker.outdated = dataset.fingerprint != fingerprints['dataset']
    _Worker.trajectory_filter = TrajectoryFilter(dataset, settings.filter)


def _outcome(job: Job) -> tuple[float, float]:
    """Success rate of a job, and the share of its adaptations whose expert was accepted."""
    from metagcttt_core import CheckpointError, evaluate_success, load_checkpoint

    path, environment, budget, seed, task = job
    changes = _Worker.settings.model_dump(include={'actor_loss'}, exclude_none=True)
    policy = load_checkpoint(path, environment=environment, changes=changes)
    if policy.fingerprint() != _Worker.fingerprints[path]:
        raise CheckpointError(f'{path}: was replaced while it was evaluated')
    if _Worker.outdated:
        raise ValueError(f'{_Worker.settings.dataset}: was replaced during the evaluation')
    simulator = make_simulator(environment, standing=_Worker.settings.standing)
    result = evaluate_success(
        policy,
        simulator,
        ttt=_Worker.settings.ttt.with_steps(budget),
        episodes=_Worker.settings.episodes,
        tasks=[task],
        seed=seed,
        trajectory_filter=_Worker.trajectory_filter,
    )
    simulator.close()
    return result['mean'], result['accepted'] or 0.0
