"""TrainingRun: when it saves, when it stops, and what it refuses to go on with."""

from metagcttt_core import CheckpointError, save_checkpoint
from metagcttt_core.training.checkpoint import has_checkpoint, load_training_state, TrainingState
from metagcttt_core.training.optimizers import make_optimizer
from metagcttt_core.training.run import TrainingInterrupted, TrainingRun
import pytest
from tests.core.builders import assert_bit_equal, assert_changed, tiny_agent, weights_of
import torch

SETTINGS = {'lr': 0.1, 'seed': 3, 'hidden': (6, 6), 'filter': {'position_dims': (0, 1)}}


def trained(seed: int = 0):
    """An agent and an Adam that has taken a step."""
    agent = tiny_agent(seed=seed)
    optimizer = make_optimizer('adam', agent.parameters(), 0.1)
    for weight in agent.parameters():
        weight.grad = torch.full_like(weight, 0.5)
    optimizer.step()
    return agent, optimizer


def test_run_without_a_folder_saves_nothing_and_starts_at_zero():
    agent, optimizer = trained()
    run = TrainingRun('pretrain', SETTINGS, resume=True)
    assert run.restore(agent, optimizer) == 0
    run.step_done(agent, optimizer, 10, 10)


def test_checkpoints_come_every_so_many_steps_and_at_the_end(tmp_path):
    agent, optimizer = trained()
    run = TrainingRun('pretrain', SETTINGS, tmp_path, every=3)
    saved = []
    for step in range(1, 8):
        run.step_done(agent, optimizer, step, 7)
        saved.append(load_training_state(tmp_path).step if has_checkpoint(tmp_path) else None)
    assert saved == [None, None, 3, 3, 3, 6, 7]


def test_resuming_restores_weights_optimizer_and_step(tmp_path):
    agent, optimizer = trained()
    TrainingRun('pretrain', SETTINGS, tmp_path).step_done(agent, optimizer, 5, 5)
    other = tiny_agent(seed=8)
    other_optimizer = make_optimizer('adam', other.parameters(), 0.1)
    run = TrainingRun('pretrain', SETTINGS, tmp_path, resume=True)
    assert run.restore(other, other_optimizer) == 5
    assert_bit_equal(other, weights_of(agent))
    own, loaded = (each.state_dict()['state'] for each in (optimizer, other_optimizer))
    assert own.keys() == loaded.keys() == set(range(4))
    for number, moments in own.items():
        assert moments.keys() == loaded[number].keys()
        assert all(torch.equal(tensor, loaded[number][key]) for key, tensor in moments.items())


def test_resuming_without_a_checkpoint_starts_at_zero(tmp_path):
    agent, optimizer = trained()
    weights = weights_of(agent)
    assert TrainingRun('pretrain', SETTINGS, tmp_path, resume=True).restore(agent, optimizer) == 0
    assert_bit_equal(agent, weights)


def test_checkpoint_is_left_alone_unless_resuming(tmp_path):
    agent, optimizer = trained()
    TrainingRun('pretrain', SETTINGS, tmp_path).step_done(agent, optimizer, 5, 5)
    other = tiny_agent(seed=8)
    assert TrainingRun('pretrain', SETTINGS, tmp_path).restore(other, None) == 0
    assert_changed(other, weights_of(agent))


def test_other_stage_is_refused_by_name(tmp_path):
    agent, optimizer = trained()
    TrainingRun('pretrain', SETTINGS, tmp_path).step_done(agent, optimizer, 5, 5)
    run = TrainingRun('post_train', SETTINGS, tmp_path, resume=True)
    with pytest.raises(CheckpointError, match='is a pretrain run, not post_train'):
        run.restore(agent, optimizer)


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'lr': 0.2}, 'cannot resume, lr was 0.1 and is now 0.2'),
        ({'hidden': (6, 7)}, r'cannot resume, hidden was \[6, 6\] and is now \[6, 7\]'),
        ({'filter': {'position_dims': (1, 0)}}, 'cannot resume, filter was .* and is now'),
        ({'new': 1}, 'cannot resume, new was None and is now 1'),
    ],
)
def test_other_settings_are_refused_by_name(change, message, tmp_path):
    agent, optimizer = trained()
    TrainingRun('pretrain', SETTINGS, tmp_path).step_done(agent, optimizer, 5, 5)
    weights = weights_of(agent)
    run = TrainingRun('pretrain', SETTINGS | change, tmp_path, resume=True)
    with pytest.raises(CheckpointError, match=message):
        run.restore(agent, optimizer)
    assert_bit_equal(agent, weights)


def test_missing_setting_is_refused_by_name(tmp_path):
    agent, optimizer = trained()
    TrainingRun('pretrain', SETTINGS, tmp_path).step_done(agent, optimizer, 5, 5)
    run = TrainingRun('pretrain', {'lr': 0.1, 'hidden': [6, 6]}, tmp_path, resume=True)
    with pytest.raises(CheckpointError, match=r'cannot resume, filter was .* and is now None'):
        run.restore(agent, optimizer)


def test_interruption_saves_first(tmp_path):
    agent, optimizer = trained()
    stop = []
    run = TrainingRun('pretrain', SETTINGS, tmp_path, every=1000, should_stop=lambda: bool(stop))
    run.step_done(agent, optimizer, 1, 10)
    assert not has_checkpoint(tmp_path)
    stop.append(True)
    with pytest.raises(TrainingInterrupted, match='stopped after step 2 of 10'):
        run.step_done(agent, optimizer, 2, 10)
    assert load_training_state(tmp_path).step == 2


def test_stop_after_the_last_step_is_no_interruption(tmp_path):
    agent, optimizer = trained()
    run = TrainingRun('pretrain', SETTINGS, tmp_path, should_stop=lambda: True)
    run.step_done(agent, optimizer, 10, 10)
    assert load_training_state(tmp_path).step == 10


def test_resume_refuses_an_agent_of_another_shape_by_name(tmp_path):
    small, large = tiny_agent(hidden=(6,)), tiny_agent(hidden=(7,))
    TrainingRun('pretrain', {}, tmp_path).step_done(small, None, 1, 1)
    with pytest.raises(CheckpointError, match='cannot resume, settings of the agent was'):
        TrainingRun('pretrain', {}, tmp_path, resume=True).restore(large, None)


def test_resume_refuses_moments_of_another_shape_by_name(tmp_path):
    agent, optimizer = trained()
    state = optimizer.state_dict()['state']
    state[3]['exp_avg'] = torch.zeros(1)  # kernels in C would read beyond its end
    save_checkpoint(agent, tmp_path, TrainingState('pretrain', 5, SETTINGS, state))
    with pytest.raises(CheckpointError, match=r'cannot resume, optimiser state of parameter 3'):
        TrainingRun('pretrain', SETTINGS, tmp_path, resume=True).restore(agent, optimizer)


def test_process_that_does_not_write_restores_and_stops_all_the_same(tmp_path):
    agent, optimizer = trained()
    TrainingRun('pretrain', SETTINGS, tmp_path, every=5).step_done(agent, optimizer, 5, 10)
    other = tiny_agent(seed=8)
    run = TrainingRun(
        'pretrain',
        SETTINGS,
        tmp_path,
        every=1,
        resume=True,
        should_stop=lambda: True,
        writes=False,
    )
    assert run.restore(other, None) == 5
    assert_bit_equal(other, weights_of(agent))
    with pytest.raises(TrainingInterrupted, match='stopped after step 6 of 10'):
        run.step_done(other, None, 6, 10)
    assert load_training_state(tmp_path).step == 5
