"""A run that goes bad says so, and non-finite numbers stop it."""

import math

from metagcttt_core import load_checkpoint, MetaConfig, post_train
from metagcttt_core.meta import DivergedError, health, OuterStep, TaskReport
from metagcttt_core.meta.health import check_finite, HealthWatch
from metagcttt_core.meta.registry import META_UPDATES
from metagcttt_core.training.run import TrainingRun
import numpy as np
import pytest
from tests.core.builders import assert_bit_equal, random_dataset, tiny_agent, weights_of
import torch


def record(rejected=0.0, test_loss=None, train_loss=None):
    return {
        'inner/rejected': rejected,
        'inner/first_test_loss': test_loss,
        'inner/first_train_loss': train_loss,
    }


def warnings_of(records):
    """What the watch says about each record."""
    watch = HealthWatch()
    return [watch.add(each) for each in records]


def outer_step(train_losses=(1.0, 2.0), test_losses=(3.0, 2.0, 1.0)) -> OuterStep:
    good = TaskReport((0.0,), 10, 5.0, 0, 1.0, [1.0, 1.0], [1.0, 1.0, 1.0], 0, 1.0, 1.0)
    other = TaskReport((0.0,), 10, 5.0, 0, 1.0, list(train_losses), list(test_losses), 2, 1.0, 1.0)
    return OuterStep(7, [good, other])


def test_rejections_are_told_once_when_a_window_is_full_of_them():
    said = warnings_of([record(0.0)] * 5 + [record(1.0)] * 60)
    told = [number for number, warnings in enumerate(said) if warnings]
    # 19 of 20 records rejected: the last of the five good ones is still in the window.
    assert told == [5 + 19 - 1]
    (warning,) = said[told[0]]
    assert warning.startswith('95% of the inner loops are rejected')
    assert 'smaller inner_lr' in warning


def test_rejections_that_stop_and_come_back_are_told_again():
    said = warnings_of([record(1.0)] * 20 + [record(0.0)] * 20 + [record(1.0)] * 20)
    assert sum(map(len, said)) == 2


@pytest.mark.parametrize('rejected', [0.0, 0.5, 0.9])
def test_ordinary_rejection_rates_are_no_warning(rejected):
    assert not any(warnings_of([record(rejected)] * 100))


@pytest.mark.parametrize('kind', ['test_loss', 'train_loss'])
@pytest.mark.parametrize('level', [2.0, -2.0])
def test_loss_that_leaves_its_first_range_is_told(kind, level):
    rng = np.random.default_rng(0)
    start = rng.normal(level, 0.1, size=40)
    rising = start[-1] + np.linspace(0, 1, 60)
    said = warnings_of([record(**{kind: loss}) for loss in [*start, *rising]])
    told = [number for number, warnings in enumerate(said) if warnings]
    assert len(told) == 1
    deviation = start[:20].std()
    mean = np.mean([*start, *rising][told[0] - 19 : told[0] + 1])
    assert mean > start[:20].mean() + 3 * deviation
    assert 'the initialisation is being damaged' in said[told[0]][0]


@pytest.mark.parametrize('slope', [0.0, -1.0])
def test_loss_that_varies_or_falls_is_no_warning(slope):
    rng = np.random.default_rng(1)
    losses = rng.normal(0, 0.1, size=200) + slope * np.linspace(0, 1, 200)
    assert not any(warnings_of([record(test_loss=loss) for loss in losses]))


@pytest.mark.parametrize(('above', 'told'), [(-0.1, []), (0.0, []), (0.005, []), (0.05, [19])])
def test_experts_worse_than_the_pretrained_policy_are_told(above, told):
    rng = np.random.default_rng(2)
    noise = np.tile([0.02, -0.02], 30) + rng.normal(0, 0.001, size=60)
    records = [  # tasks differ much, and by more than chance only where `above` says so
        record() | {'inner/initial_loss': loss, 'inner/expert_loss': loss + above + wobble}
        for loss, wobble in zip(rng.normal(2.0, 0.5, size=60), noise, strict=True)
    ]
    said = warnings_of(records)
    assert [number for number, warnings in enumerate(said) if warnings] == told
    if told:
        assert 'is above the' in said[told[0]][0]
        assert 'post-training does harm' in said[told[0]][0]


def test_losses_reported_are_those_of_pretrained_policy_and_expert():
    agent, dataset, reports = tiny_agent(), random_dataset([15, 15]), []
    config = MetaConfig(
        outer_steps=3,
        inner_steps=3,
        inner_lr=0.05,
        batch_size=8,
        filter={'epsilon': 4.0, 'top_percent': 100},
    )
    post_train(agent, dataset, config, on_step=lambda outer, _: reports.extend(outer.tasks))
    for report in reports:
        assert report.expert_loss == pytest.approx(min(report.test_losses), rel=1e-5)
    assert reports[0].initial_loss == reports[0].test_losses[0]  # nothing has changed yet
    assert reports[2].initial_loss != reports[2].test_losses[0]


def test_watch_goes_on_from_earlier_records():
    records = [record(0.0, 1.0 + 0.01 * (number % 3)) for number in range(30)]
    records += [record(1.0, 2.0)] * 40
    straight = warnings_of(records)
    resumed = HealthWatch(records[:33])
    assert [resumed.add(each) for each in records[33:]] == straight[33:]
    assert sum(map(len, straight[33:])) == 2


def test_finite_numbers_pass():
    check_finite(outer_step(), tiny_agent())


@pytest.mark.parametrize(
    ('losses', 'message'),
    [
        ({'train_losses': [1.0, math.nan]}, r'the train loss of task 1 after 1 inner .* \(nan\)'),
        ({'test_losses': [math.inf, 1.0, 1.0]}, r'the test loss of task 1 after 0 .* \(inf\)'),
    ],
)
def test_non_finite_loss_is_named(losses, message):
    with pytest.raises(DivergedError, match=f'outer step 7: {message} is not finite') as caught:
        check_finite(outer_step(**losses), tiny_agent())
    assert caught.value.step == 7


def test_non_finite_weight_is_named():
    agent = tiny_agent()
    with torch.no_grad():
        agent.actor.mean.bias[1] = math.nan
    with pytest.raises(DivergedError, match=r'weight actor\.mean\.bias is not finite'):
        check_finite(outer_step(), agent)


@pytest.mark.parametrize('algorithm', ['continual', 'fomaml'])
def test_diverging_run_keeps_its_last_good_checkpoint(algorithm, tmp_path, monkeypatch):
    update, kept = META_UPDATES[algorithm], []

    def spoiled(base, *args):
        update(base, *args)
        kept.append(weights_of(base))
        if len(kept) == 3:
            with torch.no_grad():
                base.actor.mean.bias.fill_(math.inf)

    monkeypatch.setitem(META_UPDATES, algorithm, spoiled)
    config = MetaConfig(
        algorithm=algorithm,
        outer_steps=5,
        inner_steps=2,
        batch_size=8,
        filter={'epsilon': 4.0, 'top_percent': 100},
    )
    run = TrainingRun('post_train', {}, tmp_path, every=1)
    with pytest.raises(DivergedError, match='outer step 3: weight'):
        post_train(tiny_agent(), random_dataset([15, 15]), config, run=run)
    assert_bit_equal(load_checkpoint(tmp_path), kept[1])


def test_inner_rate_out_of_all_bounds_stops_the_run():
    config = MetaConfig(
        optimizer='sgd',
        inner_lr=1e30,
        outer_steps=5,
        inner_steps=3,
        batch_size=8,
        filter={'epsilon': 4.0, 'top_percent': 100},
    )
    with pytest.raises(DivergedError, match='outer step 1: the train loss of task 0 after'):
        post_train(tiny_agent(), random_dataset([15, 15]), config)


def test_window_is_the_one_these_tests_assume():
    assert (health._WINDOW, health._REJECTED, health._DEVIATIONS) == (20, 0.95, 3.0)
