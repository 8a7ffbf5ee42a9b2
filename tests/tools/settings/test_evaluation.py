"""Every setting of what evaluates, adapts and draws policies, by the adaptations that it makes."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
import sys
from types import ModuleType, SimpleNamespace

from metagcttt_core.evaluation import offline, rollout
from metagcttt_tools import (
    compare,
    draw_episodes,
    draw_values,
    evaluate,
    evaluate_offline,
    loss_curves,
    report,
    sweep,
)
from metagcttt_tools.common import plots
from metagcttt_tools.common.results import Results
import pytest
from tests.tools.settings.walk import (
    FILTER,
    INNER_LOOP,
    note_time_limits,
    Proof,
    Seen,
    ShortSimulator,
    under,
    Walk,
    walks_through,
)

CRITIC = {'checkpoints': ['@gciql']}
LOOP = {**INNER_LOOP, 'optimizer_state': 'pretrained', 'guard': 'imitation'}
TTT = {**LOOP, 'lr': 0.1, 'horizon': 2}
WIDE = {'filter.epsilon': 4.0, 'filter.top_percent': 50.0}
QUICK = {**WIDE, 'ttt.batch_size': 8, 'dataset': '@walks.npz'}


def note_adaptations(patch: pytest.MonkeyPatch, seen: Seen, module: ModuleType = rollout) -> None:
    """The supports, the experts and the actor loss of each adaptation."""
    adapt = module.adapt

    def noting(agent, dataset, support, *others, **named):
        adaptation = adapt(agent, dataset, support, *others, **named)
        seen.append((support.indices, adaptation.agent))
        return adaptation

    patch.setattr(module, 'adapt', noting)


def watch_evaluation(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    class InThisProcess(ThreadPoolExecutor):
        def __init__(self, processes, *, mp_context, initializer, initargs):
            seen.append(('processes', processes))
            super().__init__(1, initializer=initializer, initargs=initargs)

    class NotedLog(evaluate.JobLog):
        def __init__(self, path, settings, *, resume):
            seen.append(('resume', resume))
            super().__init__(path, settings, resume=resume)

    patch.setattr(evaluate, 'ProcessPoolExecutor', InThisProcess)
    patch.setattr(evaluate, 'JobLog', NotedLog)
    patch.setattr(evaluate, 'make_simulator', ShortSimulator)
    note_adaptations(patch, seen)


EVALUATION = {
    'resume': True,
    'dataset': '@half.npz',
    'out': 'elsewhere.json',
    'budgets': [1],
    'episodes': 2,
    'seeds': [5],
    'standing': True,
    'processes': 3,
}
EVALUATE = Walk(
    'evaluate',
    {**QUICK, 'checkpoints': ['@gcbc'], 'budgets': [2], 'episodes': 1, 'seeds': [0]},
    {
        **EVALUATION,
        'checkpoints': ['@other'],
        'actor_loss': Proof('awr', CRITIC),
        **under('ttt', TTT, actor_only=CRITIC),
        **under('filter', FILTER, min_steps=CRITIC),
    },
    watch_evaluation,
)
OFFLINE = Walk(
    'evaluate-offline',
    {
        **QUICK,
        'checkpoints': ['@gcbc'],
        'budgets': [2],
        'processes': 1,
        'trajectories': 3,
        'steps_ahead': [9],
        'held_out_share': 0.2,
    },
    {
        'checkpoints': ['@other'],
        'dataset': '@half.npz',
        'held_out': '@half.npz',
        'held_out_share': 0.5,
        'trajectories': 4,
        'queries': 2,
        'steps_ahead': [8],
        'budgets': [1],
        'grid': True,
        'epsilons': Proof([3.0], {'grid': True}),
        'lrs': Proof([0.1], {'grid': True}),
        'against': Proof(['nowhere.json'], refused='nowhere.json: no results'),
        'seed': 1,
        'processes': 3,
        'out': 'elsewhere.json',
        **under(
            'ttt',
            {**TTT, 'horizon': Proof(2, refused='horizon is of episodes')},
            actor_only=CRITIC,
        ),
        **under('filter', FILTER, min_steps=CRITIC),
    },
    lambda patch, seen: watch_offline(patch, seen),
)
CRITIC_RUN = {'runs': ['@run-critic']}
SUCCESS_CURVE = Walk(
    'success-curve',
    {**QUICK, 'runs': ['@run-a'], 'budgets': [2], 'episodes': 1, 'seeds': [0]},
    {
        **EVALUATION,
        'runs': ['@run-b'],
        'actor_loss': Proof('awr', CRITIC_RUN),
        **under('ttt', TTT, actor_only=CRITIC_RUN, engine=CRITIC_RUN),
        **under('filter', FILTER, min_steps=CRITIC_RUN),
    },
    watch_evaluation,
)


def watch_offline(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    each = evaluate_offline._each
    patch.setattr(
        evaluate_offline,
        '_each',
        lambda jobs, processes, start: seen.append(processes) or each(jobs, 1, start),
    )
    patch.setattr(plots, 'save', lambda figure, path: seen.append(path))
    note_adaptations(patch, seen, offline)


def watch_drawing(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    patch.setattr(draw_episodes, 'make_simulator', ShortSimulator)
    # Its figures are times.
    patch.setattr(draw_episodes, 'write_report', lambda path, *_: seen.append(path))
    patch.setattr(plots, 'demo_picture', lambda *arguments, **named: None)
    patch.setattr(plots, 'save', lambda figure, path: seen.append(path))
    note_adaptations(patch, seen)


DRAW = Walk(
    'draw-episodes',
    {**QUICK, 'checkpoint': '@gcbc', 'budgets': [2], 'filter.variant': 'paper'},
    {
        'checkpoint': '@other',
        'dataset': '@half.npz',
        'budgets': [1],
        'standing': True,
        'seed': 1,
        'out': 'elsewhere',
        **under('ttt', TTT, actor_only={'checkpoint': '@gciql'}),
        **under('filter', FILTER, min_steps={'checkpoint': '@gciql'}),
    },
    watch_drawing,
)


def watch_values(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    patch.setattr(draw_values, 'make_simulator', ShortSimulator)
    patch.setattr(plots, 'save', lambda figure, path: seen.append(path))


VALUES = Walk(
    'draw-values',
    {'dataset': '@inside.npz', 'checkpoint': '@gciql'},
    {
        'checkpoint': '@run-critic/snapshots/000001',
        'dataset': '@half-inside.npz',
        'rows': 40,
        'seed': 1,
        'out': 'elsewhere',
    },
    watch_values,
)


def watch_losses(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    patch.setattr(loss_curves, 'make_simulator', ShortSimulator)
    patch.setattr(plots, 'save', lambda figure, path: seen.append(path))


LOSSES = Walk(
    'loss-curves',
    {**QUICK, 'checkpoint': '@gcbc', 'lrs': [0.01], 'ttt.steps': 3},
    {
        'checkpoint': '@other',
        'run': '@logged',
        'dataset': '@half.npz',
        'task': 2,
        'lrs': [0.1],
        'actor_loss': Proof('awr', {'checkpoint': '@gciql'}),
        'seed': 1,
        'out': 'elsewhere.json',
        'ttt.steps': 2,
        **under('ttt', LOOP, actor_only={'checkpoint': '@gciql'}),
        **under('filter', FILTER, min_steps={'checkpoint': '@gciql'}),
    },
    watch_losses,
)


def watch_study(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    patch.setattr(sweep, 'format_estimate', lambda *runs: seen.append(runs))

    def ran(tool, jobs, scheduler, stop):
        shown = [(job.invocation.preset.read_text(), job.size, job.cpus) for job in jobs]
        seen.append((tool, shown, scheduler))

    patch.setattr(sweep, 'run_all', ran)
    patch.setattr(sweep, 'LocalScheduler', lambda *given: ('local', given))
    patch.setitem(
        sys.modules,
        'metagcttt_tools.jobs.cluster',
        SimpleNamespace(RayScheduler=lambda resources: ('cluster', resources)),
    )
    note_time_limits(patch, seen, sweep)


ARMS = {'slow': {'meta': {'inner_lr': 1e-6}}}
STUDY = Walk(
    'sweep',
    {'seeds': [0], 'arms': ARMS},
    {
        'base': 'antmaze-medium-navigate-study',
        'seeds': [1],
        'arms': {'slow': {'meta': {'inner_lr': 1e-7}, 'seeds': [3]}},
        'adaptations': {'actor-only': {'ttt': {'actor_only': True}}},
        'dry_run': True,
        'curve': [0.5],
        'curve_budgets': Proof([0, 50], {'curve': [0.5]}),
        'processes': 1,
        'cluster': True,
        'resources.gpus': Proof(0.5, {'cluster': True}),
        'resources.memory_gib': Proof(2.0, {'cluster': True}),
        'resources.retries': 3,
        'time_limit': 1e6,
        'out': 'elsewhere',
    },
    watch_study,
)


def watch_report(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    def read(study, threshold):
        seen.append((study, threshold))
        return {'adaptations': {}, 'curve': {}}

    patch.setattr(report, 'read_study', read)
    patch.setattr(report, 'rebuild', lambda folder: seen.append(('paper', folder)))
    patch.setattr(report, 'format_report', lambda contents: '')
    patch.setattr(plots, 'success_curves', lambda panels: None)
    patch.setattr(plots, 'save', lambda figure, path: seen.append(path))


REPORT = Walk(
    'report',
    {},
    {'study': 'out/other', 'out': 'elsewhere', 'threshold': 0.5, 'paper': True},
    watch_report,
)


def watch_comparison(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    def read(path):
        seen.append(path)
        curve = [{'budget': 0, 'success': 0.5}]
        policies = [{'checkpoint': name, 'curve': curve} for name in ('base-0', 'reptile-0')]
        return Results(results=policies)

    patch.setattr(compare, 'read_results', read)
    patch.setattr(plots, 'save', lambda figure, path: seen.append(path))


COMPARE = Walk(
    'compare',
    {'evaluations': {'GCBC': 'gcbc.json'}},
    {'evaluations': {'SAW': 'saw.json'}, 'policies': 'base', 'out': 'elsewhere'},
    watch_comparison,
)

WALKS = (EVALUATE, OFFLINE, SUCCESS_CURVE, DRAW, VALUES, LOSSES, STUDY, REPORT, COMPARE)


@walks_through(WALKS)
def test_setting(walk: Walk, name: str, tmp_path: Path, places: Path) -> None:
    walk.check(name, tmp_path, places)
