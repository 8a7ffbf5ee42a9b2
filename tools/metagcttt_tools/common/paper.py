"""The paper's settings as presets: `paper-MAZE-DATA-LOSS-ALGORITHM`, one for each row of Table 3.

`DATA` is `navigate` (the paper's expert data) or `stitch`; `LOSS` is that of adaptation, `bc` or
`ddpgbc`. The values are in `paper.yaml`.
"""

from functools import cache
from importlib.resources import files
from typing import Any, NamedTuple

import yaml

_OUTER_STEPS, _SNAPSHOT_EVERY = 50_000, 5_000
_HORIZON = 100
_BATCH = 1024


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
        return f'paper-{self.maze}-{self.data}-{self.loss}-{self.algorithm}'


def paper_presets() -> dict[str, dict[str, Any]]:
    """Fresh settings of each row of Table 3, nested by tool, by name of the preset."""
    mazes = _read()['mazes']
    return {row.name: _preset(row, **mazes[row.maze]) for row in table3()}


def table3() -> list[Row]:
    """The rows of Table 3."""
    return [Row(*entries) for entries in _read()['rows']]


@cache
def _read() -> dict[str, Any]:
    text = (files('metagcttt_tools.common') / 'paper.yaml').read_text(encoding='utf-8')
    return yaml.safe_load(text)


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
            'budgets': [0, 10, 20, 50, 100, 200],
            'ttt': ttt,
            'episodes': 50,
            'seeds': [0, 1, 2],
            'out': f'{out}/evaluation.json',
            **actor_loss,
        },
    }
