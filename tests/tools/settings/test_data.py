"""Every setting of what makes data, controllers and pictures of them, or converts and packs."""

from contextlib import nullcontext
from pathlib import Path
from types import ModuleType, SimpleNamespace
from unittest import mock

from metagcttt_tools import (
    contract_check,
    controller_measure,
    controller_train,
    controller_train_humanoid,
    diagnostics,
    download,
    generate,
    import_bags,
    import_recordings,
    inspect_data,
    top_view,
)
from metagcttt_tools.common import plots
from metagcttt_tools.controller import humanoid
from metagcttt_tools.recordings import goal_views, trajectories
from metagcttt_tools.robots import bag, episodes, report
from metagcttt_tools.tables import lerobot, lerobot_writer
import numpy as np
import ogbench
import pytest
from sim_bridge.controllers.direction import BUNDLED
from sim_bridge.controllers.walk import GoalRun
from tests.core.builders import DATA, random_dataset
from tests.core.robot.messages import contract
from tests.tools.settings.walk import (
    note_time_limits,
    Proof,
    Seen,
    ShortSimulator,
    Walk,
    walks_through,
)
import torch.utils.tensorboard


def watch_generation(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    def note(plan, output, *, progress, **others):
        seen.append((plan, output, others))
        figures = ('rows', 'validation_rows', 'goals_per_episode', 'falls_per_episode', 'coverage')
        return SimpleNamespace(**dict.fromkeys(figures, 1.0))

    patch.setattr(generate, 'generate', note)
    patch.setattr(generate, '_draw', lambda *_: None)


GENERATE = Walk(
    'generate',
    {'processes': 1},
    {
        'resume': True,
        'environment': 'pointmaze-large-v0',
        'kind': 'stitch',
        'episodes': 7,
        'rows_per_episode': 9,
        'noise': 0.1,
        'to_goal': True,
        'standing': Proof(True, refused='only humanoids have a standing start'),
        'seed': 1,
        'output': 'elsewhere.npz',
        'processes': 2,
        'controller': 'controller',
        'overwrite': True,
    },
    watch_generation,
)


def watch_download(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    patch.setattr(ogbench, 'download_datasets', lambda *given: seen.append(given))
    patch.setattr(download, 'check', lambda *given: seen.append(given))


DOWNLOAD = Walk(
    'download', {}, {'names': ['antmaze-large-navigate-v0'], 'folder': 'elsewhere'}, watch_download
)


def watch_import(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    def note(*given, **named):
        seen.append((given, named))
        summary = SimpleNamespace(
            states=1, actions=1, transitions=1, trajectories=1, dropped={}, unfinished=[]
        )
        return random_dataset(), summary

    patch.setattr(trajectories, 'read_recordings', note)
    patch.setattr(import_recordings, 'made_by', lambda program, paths: {'program': program})


IMPORT = Walk(
    'import-recordings',
    {'recordings': ['a.mcap']},
    {
        'recordings': ['b.mcap'],
        'out': 'elsewhere.npz',
        'extend': '@half.npz',
        'keep_idle': True,
        'refuse_gaps': True,
        'overwrite': Proof(True, again=True),
    },
    watch_import,
)

CART = contract()


def watch_contract(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    patch.setattr(contract_check, 'load_contract', lambda path: seen.append(path) or CART)
    patch.setattr(bag, 'open_bag', lambda path, contract, *given: end(seen.append((path, given))))


def end(_: object) -> None:
    raise SystemExit(0)


CONTRACT_CHECK = Walk(
    'contract check',
    {},
    {
        'file': 'elsewhere.yaml',
        'bag': 'drive.mcap',
        'namespace': Proof('cart1', {'bag': 'drive.mcap'}),
    },
    watch_contract,
)


def watch_bags(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    def note(path, contract, *given):
        seen.append((path, given))
        return nullcontext(mock.Mock(types={}))

    trajectory = (np.arange(12.0).reshape(3, 4), np.zeros((3, 2)))
    patch.setattr(import_bags, 'load_contract', lambda path: seen.append(path) or CART)
    patch.setattr(import_bags, 'made_by', lambda program, paths: {'program': program})
    patch.setattr(bag, 'open_bag', note)
    patch.setattr(report, 'bag_faults', lambda *_: [])
    patch.setattr(
        episodes, 'read_episodes', lambda *_: episodes.Episodes({}, trajectories=[trajectory])
    )


IMPORT_BAGS = Walk(
    'import-bags',
    {'bags': ['a.mcap']},
    {
        'contract': 'elsewhere.yaml',
        'bags': ['a.mcap', 'b.mcap'],
        'namespace': 'cart1',
        'longest_s': 0.1,
        'out': 'elsewhere.npz',
        'overwrite': Proof(True, again=True),
    },
    watch_bags,
)


IMPORT_TABLE = Walk(
    'import-table',
    {'tables': ['@table.csv'], 'columns': '@by-run.yaml'},
    {
        'tables': ['@table.csv', '@table.csv'],
        'columns': '@by-v.yaml',
        'limits_from_data': True,
        'out': 'elsewhere.npz',
        'overwrite': Proof(True, again=True),
    },
)
PUSHT = str(DATA / 'lerobot_pusht')
IMPORT_LEROBOT = Walk(
    'import-lerobot',
    {'folder': PUSHT, 'columns': '@state.yaml'},
    {
        'folder': Proof('nowhere', refused='no LeRobot dataset there'),
        'columns': '@action.yaml',
        'contract': Proof(
            '@cart.yaml', {'columns': None, 'limits_from_data': True}, refused="no value 'x'"
        ),
        'limits_from_data': True,
        'trust_rows': True,
        'out': 'elsewhere.npz',
        'overwrite': Proof(True, again=True),
    },
    lambda patch, seen: note_calls(patch, seen, lerobot, 'read_lerobot'),
)
EXPORT_LEROBOT = Walk(
    'export-lerobot',
    {'data': '@cart.npz', 'fps': 5},
    {
        'data': '@walks.npz',
        'contract': '@cart.yaml',
        'fps': 7,
        'task': Proof('push'),
        'rows_per_file': 3,
        'out': 'elsewhere',
    },
    lambda patch, seen: note_calls(patch, seen, lerobot_writer, 'write_lerobot'),
)


def note_calls(patch: pytest.MonkeyPatch, seen: Seen, module: ModuleType, name: str) -> None:
    """Note the settings that a function is called with, and call it."""
    function = getattr(module, name)

    def noting(*given, **named):
        seen.append(named)
        return function(*given, **named)

    patch.setattr(module, name, noting)


def watch_inspection(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    patch.setattr(inspect_data, 'inspect', lambda data: seen.append(data.fingerprint))
    patch.setattr(inspect_data, 'describe', lambda found, *names: seen.append(names))
    patch.setattr(plots, 'places_picture', lambda places, *names: seen.append((places[0], names)))
    note_pictures(patch, seen)


INSPECT = Walk(
    'inspect',
    {'data': '@walks.npz'},
    {
        'data': '@half.npz',
        'contract': Proof('@cart.yaml', refused='the contract of cart has 4 and 2'),
        'columns': Proof('@action.yaml', {'data': PUSHT}),
        'coverage': [1, 0],
        'out': 'elsewhere.png',
    },
    watch_inspection,
)
WITH_CRITIC = {'agent': 'gciql', 'file': '@nets_gciql_pm.npz'}
CONVERT = Walk(
    'convert',
    {'file': '@nets_gcbc_pm.npz', 'prefix': 'init'},
    {
        'file': Proof('@nets_gcbc_ant.npz'),
        'agent': Proof('gciql', refused='reference parameters do not fit a gciql agent'),
        'environment': 'pointmaze-large-v0',
        'discount': 0.5,
        'actor_loss': Proof('awr', WITH_CRITIC),
        'alpha': Proof(3.0, WITH_CRITIC),
        'prefix': 'adam1',
        'out': 'elsewhere',
    },
)
PACK = Walk(
    'pack-assets',
    {'base': '@gcbc', 'meta': '@gcbc', 'dataset': '@walks.npz', 'episodes': 30},
    {
        'base': '@other',
        'meta': '@other',
        'dataset': '@half.npz',
        'episodes': 2,
        'optimizer_state': True,
        'half_weights': True,
        'out': 'elsewhere',
    },
)


def note_pictures(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    patch.setattr(plots, 'save', lambda figure, path: seen.append(path))


def watch_diagnostics(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    def writer(folder):
        seen.append('TensorBoard')
        return mock.Mock()

    patch.setattr(torch.utils.tensorboard, 'SummaryWriter', writer)
    patch.setattr(diagnostics, 'PICTURES', {'one': seen.append})
    note_pictures(patch, seen)


DIAGNOSTICS = Walk(
    'diagnostics',
    {'run': '@meta-a'},
    {'run': '@meta-b', 'out': 'elsewhere', 'tensorboard': False},
    watch_diagnostics,
)


def watch_top_view(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    def read(*given):
        seen.append(given)
        return None, [SimpleNamespace(reached=True, query_id=number) for number in range(8)]

    patch.setattr(goal_views, 'read_goal_views', read)
    patch.setattr(top_view, 'picture', lambda maze, views: seen.append(len(views)))
    patch.setattr(top_view, 'animate', lambda maze, *given: seen.append(given[1:]))
    note_pictures(patch, seen)


TOP_VIEW = Walk(
    'top-view',
    {'dataset': '@walks.npz'},
    {
        'recording': 'other.mcap',
        'out': 'elsewhere.png',
        'dataset': '@half.npz',
        'robot': '/robot1',
        'goals': 2,
        'frames': Proof(3, {'out': 'film.gif'}),
    },
    watch_top_view,
)


def watch_ant_training(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    save = controller_train.ControllerTraining.save

    def noting(training):
        seen.append(('saved', training.replay.added))
        save(training)

    patch.setattr(controller_train.ControllerTraining, 'save', noting)
    note_time_limits(patch, seen, controller_train)


ANT = Walk(
    'controller train',
    {
        'steps': 12,
        'random_steps': 4,
        'decay_steps': 2,
        'replay_size': 50,
        'log_every': 4,
        'sac.batch_size': 4,
        'sac.lr': 0.01,
        'sac.actor_hidden': [4],
        'sac.critic_hidden': [4],
    },
    {
        'resume': Proof(True, again=True),
        'out': 'elsewhere',
        'steps': 11,
        'decay_steps': 8,
        'update_every': 1,
        'replay_size': 3,
        'random_steps': 6,
        'seed': 1,
        'checkpoint_every': 3,
        'log_every': 3,
        'threads': 2,
        'time_limit': 1e6,
        'sac.lr': 0.1,
        'sac.critic_lr': 0.1,
        'sac.batch_size': 3,
        'sac.discount': 0.5,
        'sac.tau': 0.5,
        'sac.target_entropy': 3.0,
        'sac.temperature': 2.0,
        'sac.actor_hidden': [3],
        'sac.critic_hidden': [3],
        'sac.actor_layer_norm': True,
        'sac.critic_layer_norm': True,
        'sac.critics': 'mean',
        'sac.actor_critics': 'first',
        'sac.actor_every': 2,
        'sac.log_std_range': [-1.0, -0.5],
    },
    watch_ant_training,
)


def watch_humanoid_training(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    class Training:
        sweep, total = 0, 1

        def __init__(self, out, seed, stages):
            seen.append((out, seed, stages))
            self.checkpoint = out / 'checkpoint.safetensors'

        def restore(self):
            seen.append('restored')

        def run(self, log, should_stop, log_every, checkpoint_every):
            seen.append((log_every, checkpoint_every))
            self.checkpoint.touch()
            return True

    patch.setattr(humanoid, 'HumanoidTraining', Training)
    note_time_limits(patch, seen, controller_train_humanoid)


HUMANOID = Walk(
    'controller train-humanoid',
    {},
    {
        'resume': Proof(True, again=True),
        'out': 'elsewhere',
        'task': 'get-up',
        'length': 0.5,
        'seed': 1,
        'checkpoint_every': 3,
        'log_every': 3,
        'threads': 2,
        'time_limit': 1e6,
    },
    watch_humanoid_training,
)


def watch_measuring(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    def walk_along(follower, *given):
        seen.append(('walk', follower.robot, given))
        figures = dict.fromkeys(('speed', 'drift_m', 'period_s', 'falls', 'duration_s'), 1.0)
        return SimpleNamespace(direction=given[0], **figures)

    def walk_to_goal(follower, maze, *given):
        seen.append(('goal', maze.spec.name, given))
        return GoalRun(reached=True, falls=0, duration_s=1.0)

    def stands_up(follower, maze, *given):
        seen.append(('rise', maze.spec.name, given))
        return True

    patch.setattr(controller_measure, 'walk_along', walk_along)
    patch.setattr(controller_measure, 'walk_to_goal', walk_to_goal)
    patch.setattr(controller_measure, 'stands_up', stands_up)
    patch.setattr(controller_measure, 'OGBenchMaze', ShortSimulator)
    patch.setattr(controller_measure, 'film', lambda _, *given: seen.append(given))
    patch.setattr(plots, 'controller_picture', lambda walks: None)
    note_pictures(patch, seen)


MEASURE = Walk(
    'controller measure',
    {'directions': 2, 'repeats': 1, 'walks': 2, 'mazes': ['medium'], 'episodes_per_task': 1},
    {
        'controller': str(BUNDLED / 'humanoid'),
        'directions': 3,
        'duration_s': 1.0,
        'repeats': 2,
        'walks': 3,
        'drops': Proof(2, given={'controller': str(BUNDLED / 'humanoid')}),
        'mazes': ['large'],
        'episodes_per_task': 2,
        'action_noise': 0.4,
        'seed': 1,
        'out': 'out/elsewhere',
        'gif': 'walk.gif',
    },
    watch_measuring,
)

WALKS = (
    GENERATE,
    DOWNLOAD,
    IMPORT,
    IMPORT_BAGS,
    IMPORT_TABLE,
    IMPORT_LEROBOT,
    EXPORT_LEROBOT,
    CONTRACT_CHECK,
    INSPECT,
    CONVERT,
    PACK,
    DIAGNOSTICS,
    TOP_VIEW,
    ANT,
    HUMANOID,
    MEASURE,
)


@walks_through(WALKS)
def test_setting(walk: Walk, name: str, tmp_path: Path, places: Path) -> None:
    walk.check(name, tmp_path, places)
