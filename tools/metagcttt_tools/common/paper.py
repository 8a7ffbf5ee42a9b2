"""The paper's settings as presets: `paper-MAZE-DATA-LOSS-ALGORITHM`, one for each row of Table 3.

`paper-MAZE-DATA-LOSS` is the study of its three rows on the same base policies. Trajectories are
filtered as in the published implementation of GC-TTT; studies adapt from both optimiser states.

`DATA` is `navigate` (the paper's expert data) or `stitch`; `LOSS` is that of adaptation, `bc` or
`ddpgbc`. The values are in `paper.yaml`.
"""

from functools import cache
from importlib.resources import files
from typing import Any, NamedTuple

from metagcttt_core.config.yaml_file import read_yaml

_OUTER_STEPS, _SNAPSHOT_EVERY = 50_000, 5_000
_HORIZON = 100
_BATCH = 1024
_SEEDS = [0, 1, 2]
_FILTER = {'variant': 'gcttt'}
_BUDGETS = {'navigate': [0, 10, 20, 50], 'stitch': [0, 10, 20, 50, 100, 200]}


class Row(NamedTuple):
    """A row of Table 3; `checkpoint` is the number of outer steps of the evaluated policy."""

    maze: str
    data: str
    loss: str
    algorithm: str
    inner_lr: float
    meta_lr: float
    inner_steps: int
    ttt_lr: float
    checkpoint: int
    early_stopping: bool

    @property
    def name(self) -> str:
        """The name of its preset."""
        return f'{self.study}-{self.algorithm}'

    @property
    def study(self) -> str:
        """The name of the preset that it shares with the other algorithms."""
        return f'paper-{self.maze}-{self.data}-{self.loss}'


def paper_presets() -> dict[str, dict[str, Any]]:
    """Fresh settings of each row of Table 3 and each study, nested by tool, by preset."""
    mazes = _read()['mazes']
    presets: dict[str, dict[str, Any]] = {}
    studies: dict[str, list[Row]] = {}
    for row in table3():
        presets[row.name] = _preset(row, **mazes[row.maze])
        studies.setdefault(row.study, []).append(row)
    for name, rows in studies.items():
        presets[name] = {**presets[rows[0].name], 'sweep': _sweep(name, rows, presets)}
    for row in table3():
        presets[row.name]['sweep'] = _sweep(row.name, [row], presets)
    return presets


def _sweep(name: str, rows: list[Row], presets: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """A study of rows, with the differences between their presets and that of the first."""
    first = presets[rows[0].name]
    arms: dict[str, Any] = {}
    for row in rows:
        preset = presets[row.name]
        arms[row.algorithm] = {
            'meta': preset['meta_train']['meta'],
            'snapshot': row.checkpoint / _OUTER_STEPS,
        }
        ttt = preset['evaluate']['ttt']
        if ttt != first['evaluate']['ttt']:
            arms[row.algorithm]['evaluate'] = {'ttt': ttt}
    return {
        'base': rows[0].name,
        'seeds': _SEEDS,
        'arms': arms,
        'adaptations': {
            state: {'ttt': {'optimizer_state': state}} for state in ('fresh', 'pretrained')
        },
        'out': f'out/{name}',
    }


def table3() -> list[Row]:
    """The rows of Table 3."""
    return [Row(*entries) for entries in _read()['rows']]


@cache
def _read() -> dict[str, Any]:
    return read_yaml(files('metagcttt_tools.common') / 'paper.yaml')[1]


def _preset(row: Row, environment: str, alpha: float, discount: float) -> dict[str, Any]:
    name, version = environment.rsplit('-', 1)
    dataset = f'data/{name}-{row.data}-{version}.npz'
    base, out = f'out/paper/{name}-{row.data}', f'out/paper/{row.name}'
    pretrain: dict[str, Any] = {
        'environment': environment,
        'dataset': dataset,
        'out': base,
        'agent': 'gcbc',
        'hidden': [512, 512, 512],
        'training': {'steps': 400_000, 'batch_size': _BATCH, 'lr': 3e-4},
    }
    meta: dict[str, Any] = {
        'algorithm': row.algorithm,
        'outer_steps': _OUTER_STEPS,
        'inner_steps': row.inner_steps,
        'inner_lr': row.inner_lr,
        'batch_size': _BATCH,
        'meta_batch_size': 1,
        'early_stopping': row.early_stopping,
        'filter': _FILTER,
    }
    if row.algorithm != 'continual':  # which has one in the table, and no use for it
        meta['meta_lr'] = row.meta_lr
    ttt: dict[str, Any] = {'lr': row.ttt_lr, 'batch_size': _BATCH}
    actor_loss = {}
    if row.data == 'stitch':
        goals = {'actor': {'p_trajgoal': 0.5, 'p_randomgoal': 0.5}}
        pretrain |= {'agent': 'gciql'}
        pretrain['gciql'] = {'alpha': alpha, 'discount': discount, 'goals': goals}
        ttt['horizon'] = _HORIZON
        actor_loss = {'actor_loss': row.loss}
    return {
        'generate': {'environment': environment, 'kind': row.data, 'seed': 0},
        'pretrain': pretrain,
        'meta_train': {
            'checkpoint': f'{base}/checkpoint',
            'dataset': dataset,
            'out': out,
            'meta': meta,
            'snapshot_every': _SNAPSHOT_EVERY,
            **actor_loss,
        },
        'evaluate': {
            'checkpoints': [f'{base}/checkpoint', f'{out}/snapshots/{row.checkpoint:06d}'],
            'dataset': dataset,
            'budgets': _BUDGETS[row.data],
            'ttt': ttt,
            'filter': _FILTER,
            'episodes': 50,
            'seeds': _SEEDS,
            'out': f'{out}/evaluation.json',
            **actor_loss,
        },
    }
