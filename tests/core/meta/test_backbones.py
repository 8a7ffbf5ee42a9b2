"""Every agent, actor loss and meta-update, full or actor-only, together or one by one."""

from functools import partial

from metagcttt_core import FilterConfig, MetaConfig, post_train
from metagcttt_core.meta import experts
from metagcttt_core.meta.experts import adapts_together
from metagcttt_core.meta.registry import META_UPDATES
import pytest
from tests.core.builders import random_dataset, tiny_agent, weights_of
import torch

BACKBONES = [
    ('gcbc', {}),
    ('gciql', {'actor_loss': 'bc'}),
    ('gciql', {'actor_loss': 'awr'}),
    ('gciql', {'actor_loss': 'ddpgbc'}),
    ('saw', {}),
    ('crl', {}),
    ('crl', {'actor_loss': 'awr'}),
]


def quick(**settings) -> MetaConfig:
    return MetaConfig(
        **{
            'outer_steps': 1,
            'inner_steps': 4,
            'inner_lr': 0.02,
            'batch_size': 16,
            'filter': FilterConfig(epsilon=4.0, top_percent=100),
            **settings,
        }
    )


def moved(before, after) -> set[str]:
    """The networks of which some weight changed."""
    return {
        name.split('.')[0]
        for name, weight in before.items()
        if not torch.equal(weight, after[name])
    }


@pytest.mark.parametrize('algorithm', sorted(META_UPDATES))
@pytest.mark.parametrize('actor_only', [False, True])
@pytest.mark.parametrize(('name', 'settings'), BACKBONES)
def test_meta_batch_adapted_together_gives_the_policy_of_one_by_one(
    name, settings, actor_only, algorithm, monkeypatch
):
    agent, dataset = tiny_agent(name, **settings), random_dataset([20, 30, 25])
    # Autograd's tanh rounds the slope of saturated units, and Adam divides by it.
    config = quick(algorithm=algorithm, actor_only=actor_only, meta_batch_size=3, engine='eager')
    trained, best_steps = [], []
    monkeypatch.setattr(experts, '_FEWEST_STACKED_ON_CPU', 2)
    for largest in (0, 10**9):
        monkeypatch.setattr(experts, '_LARGEST_STACKED_ON_CPU', largest)
        steps = []
        policy = post_train(
            agent, dataset, config, on_step=lambda outer, _, steps=steps: steps.extend(outer.tasks)
        )
        trained.append(weights_of(policy))
        best_steps.append([task.best_step for task in steps])
    assert best_steps[0] == best_steps[1]
    assert max(best_steps[0]) > 0
    for key, weight in trained[0].items():
        torch.testing.assert_close(weight, trained[1][key], rtol=1e-3, atol=1e-4)
    networks = {key.split('.')[0] for key in trained[0]}
    changed = {'actor'} if actor_only else networks
    assert moved(weights_of(agent), trained[0]) == changed


def test_tasks_are_stacked_where_that_is_faster():
    small, large = tiny_agent(hidden=(32, 32)), tiny_agent(hidden=(256, 256, 256))
    learned = tiny_agent(hidden=(32, 32), const_std=False)  # has no gradient written out
    eager = partial(quick, engine='eager')
    assert adapts_together(small, eager(meta_batch_size=4, batch_size=64))
    assert not adapts_together(small, eager(meta_batch_size=3, batch_size=64))
    assert not adapts_together(large, eager(meta_batch_size=4, batch_size=256))
    assert not adapts_together(small, quick(meta_batch_size=4, batch_size=64, engine='auto'))
    assert adapts_together(learned, quick(meta_batch_size=4, batch_size=64, engine='auto'))


@pytest.mark.parametrize('engine', ['kernels', 'analytic'])
def test_engine_that_is_named_is_used_or_refused(engine):
    learned = tiny_agent(hidden=(32, 32), const_std=False)
    config = quick(meta_batch_size=4, engine=engine)
    with pytest.raises(ValueError, match=f'engine {engine}: agent gcbc has no loss written out'):
        post_train(learned, random_dataset([20, 30, 25]), config)


def test_first_task_of_a_meta_batch_is_the_only_one_of_a_batch_of_one():
    """Each task has a generator of its own: the first is that of a meta-batch of one."""
    agent, dataset = tiny_agent(), random_dataset([20, 30, 25])
    reports = {}
    for size in (1, 3):
        tasks = reports.setdefault(size, [])
        post_train(
            agent,
            dataset,
            quick(outer_steps=1, meta_batch_size=size),
            on_step=lambda outer, _, tasks=tasks: tasks.extend(outer.tasks),
        )
    assert (len(reports[1]), len(reports[3])) == (1, 3)
    assert reports[1][0].goal == reports[3][0].goal
    assert reports[1][0].train_losses == pytest.approx(reports[3][0].train_losses, rel=1e-4)
    assert len({task.goal for task in reports[3]}) == 3
