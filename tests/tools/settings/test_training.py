"""Every setting of pre-training and post-training, mostly by the policies that come of it."""

from pathlib import Path

import metagcttt_core
from metagcttt_tools.common import pretraining_metrics, session
import pytest
from tests.tools.settings.walk import (
    FILTER,
    INNER_LOOP,
    note_time_limits,
    Proof,
    Seen,
    under,
    Walk,
    walks_through,
)

RUN = {
    'resume': Proof(True, again=True),
    'dataset': '@half.npz',
    'out': 'elsewhere',
    'seed': 1,
    'checkpoint_every': 1,
    'log_every': 2,
    'threads': 2,
    'device': Proof('cuda:99', refused='must be cpu, cuda or cuda:NUMBER'),
    'snapshot_every': 1,
    'time_limit': 1e6,
}


def note_saves(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    from metagcttt_core.training import run

    save = run.save_checkpoint

    def noting(agent, path, training):
        seen.append(('saved', training.step))
        save(agent, path, training)

    patch.setattr(run, 'save_checkpoint', noting)
    note_time_limits(patch, seen, session)


def watch_pretraining(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    from metagcttt_core.training import pretrain

    loss_function = pretrain.loss_function

    def not_compiled(agent, *, precision, compiled):  # which would take half a minute
        seen.append(('compiled', compiled))
        return loss_function(agent, precision=precision)

    def success(agent, environment, episodes, seed):
        seen.append(('evaluated', environment, episodes, seed))
        return {}

    patch.setattr(pretrain, 'loss_function', not_compiled)
    patch.setattr(pretraining_metrics, 'success_rates', success)
    note_saves(patch, seen)


def goals(place: str, **given: str) -> dict[str, Proof]:
    """Proofs for a distribution of goals, whose probabilities sum to 1."""
    shares = (f'{place}.p_curgoal', f'{place}.p_trajgoal', f'{place}.p_randomgoal')
    even = dict(zip(shares, (0.4, 0.3, 0.3), strict=True))
    proofs = {name: Proof(1.0, given | even, along=dict.fromkeys(shares, 0.0)) for name in shares}
    to_later = dict(zip(shares, (0.0, 1.0, 0.0), strict=True))
    return proofs | {f'{place}.geometric': Proof(True, given | to_later)}


GCIQL = {'agent': 'gciql'}
CRL = {'agent': 'crl'}
SAW = {'agent': 'saw'}
GEOMETRIC = {'gcbc.goals.actor.geometric': True}
PRETRAIN = Walk(
    'pretrain',
    {
        'dataset': '@walks.npz',
        'hidden': [6],
        'training.steps': 3,
        'training.batch_size': 8,
        'log_every': 1,
    },
    {
        **RUN,
        'environment': 'pointmaze-large-v0',
        'agent': 'gciql',
        'standardise': 'yes',
        'hidden': [4],
        'gcbc.const_std': False,
        'gcbc.discount': Proof(0.5, {'gcbc.goals.value': None, **GEOMETRIC}),
        **{
            f'gcbc.goals.{name}': Proof(value, refused='goals.value and goals.gc_negative have no')
            for name, value in (
                ('value.p_curgoal', 0.0),
                ('value.p_trajgoal', 1.0),
                ('value.p_randomgoal', 0.0),
                ('value.geometric', True),
                ('gc_negative', False),
            )
        },
        **goals('gcbc.goals.actor', **{'gcbc.goals.value': None}),
        'gciql.const_std': Proof(False, GCIQL),
        'gciql.discount': Proof(0.5, GCIQL),
        **goals('gciql.goals.value', **GCIQL),
        **goals('gciql.goals.actor', **GCIQL),
        'gciql.goals.gc_negative': Proof(False, GCIQL),
        'gciql.actor_loss': Proof('awr', GCIQL),
        'gciql.alpha': Proof(3.0, GCIQL),
        'gciql.expectile': Proof(0.6, GCIQL),
        'gciql.tau': Proof(0.5, GCIQL),
        'crl.const_std': Proof(False, CRL),
        'crl.discount': Proof(0.5, CRL),
        **goals('crl.goals.value', **CRL),
        **goals('crl.goals.actor', **CRL),
        'crl.goals.gc_negative': Proof(False, refused='goals.gc_negative has no effect on it'),
        'crl.actor_loss': Proof('awr', CRL),
        'crl.alpha': Proof(3.0, CRL),
        'crl.latent_dim': Proof(4, CRL),
        'saw.const_std': Proof(False, SAW),
        'saw.discount': Proof(0.5, SAW),
        **goals('saw.goals.value', **SAW),
        **goals('saw.goals.actor', **SAW),
        'saw.goals.gc_negative': Proof(False, SAW),
        'saw.expectile': Proof(0.6, SAW),
        'saw.tau': Proof(0.5, SAW),
        'saw.subgoal_steps': Proof(2, SAW),
        'saw.alpha': Proof(1.0, SAW),
        'saw.subpolicy_alpha': Proof(1.0, SAW),
        'saw.waypoint_alpha': Proof(1.0, SAW),
        'saw.rep_dim': Proof(4, SAW),
        'training.steps': 2,
        'training.lr': 0.01,
        'training.batch_size': 9,
        'precision': 'bfloat16',
        'compiled': True,
        'evaluate_every': 2,
        'evaluation_episodes': Proof(3, {'evaluate_every': 2}),
    },
    watch_pretraining,
)


def watch_post_training(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    post_train = metagcttt_core.post_train

    def noting(*arguments, cuda_graphs, **others):
        seen.append(('CUDA graphs', cuda_graphs))
        return post_train(*arguments, **others)

    patch.setattr(metagcttt_core, 'post_train', noting)
    note_saves(patch, seen)


CRITIC = {'checkpoint': '@gciql'}
META = Walk(
    'meta-train',
    {
        'dataset': '@walks.npz',
        'checkpoint': '@gcbc',
        'meta.outer_steps': 2,
        'meta.inner_steps': 2,
        'meta.inner_lr': 0.01,
        'meta.batch_size': 8,
        'meta.filter.epsilon': 4.0,
        'meta.filter.top_percent': 50.0,
        'log_every': 1,
    },
    {
        **RUN,
        'checkpoint': '@other',
        'actor_loss': Proof('awr', CRITIC),
        'meta.algorithm': 'fomaml',
        'meta.outer_steps': 1,
        'meta.inner_steps': 1,
        'meta.inner_lr': 0.1,
        'meta.meta_lr': Proof(0.5, {'meta.algorithm': 'reptile'}),
        'meta.rejected': Proof('reject', {'meta.algorithm': 'fomaml', 'meta.inner_lr': 3.0}),
        'meta.meta_batch_size': 2,
        'meta.task_candidates': 4,
        **under('meta', INNER_LOOP | {'early_stopping': False}, actor_only=CRITIC),
        **under('meta.filter', FILTER, min_steps=CRITIC),
        'cuda_graphs': False,
    },
    watch_post_training,
)


WALKS = (PRETRAIN, META)


@walks_through(WALKS)
def test_setting(walk: Walk, name: str, tmp_path: Path, places: Path) -> None:
    walk.check(name, tmp_path, places)
