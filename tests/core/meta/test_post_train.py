"""Algorithm 1: one outer step by hand, repeatable, and resumable from every step."""

from metagcttt_core import (
    CheckpointError,
    FilterConfig,
    load_checkpoint,
    MetaConfig,
    post_train,
    TrajectoryDataset,
)
from metagcttt_core.adaptation.batches import QueryBatches
from metagcttt_core.meta import tasks
from metagcttt_core.meta.registry import GRADIENT_UPDATES, META_UPDATES
from metagcttt_core.meta.tasks import TaskSampler
from metagcttt_core.training.checkpoint import load_training_state
from metagcttt_core.training.config import PretrainConfig
from metagcttt_core.training.optimizers import pretrained_state
from metagcttt_core.training.pretrain import pretrain
from metagcttt_core.training.run import TrainingInterrupted, TrainingRun
import numpy as np
import pytest
from tests.core.builders import (
    assert_bit_equal,
    assert_changed,
    EVERY_AGENT,
    random_dataset,
    terminals_of,
    tiny_agent,
    weights_of,
)
import torch

EVERY_ALGORITHM = pytest.mark.parametrize('algorithm', sorted(META_UPDATES))
WIDE = FilterConfig(epsilon=4.0, top_percent=100)


def quick(**settings) -> MetaConfig:
    return MetaConfig(
        **{
            'outer_steps': 4,
            'inner_steps': 3,
            'inner_lr': 0.05,
            'batch_size': 8,
            'filter': WIDE,
            **settings,
        }
    )


@pytest.fixture
def one_place() -> TrajectoryDataset:
    """All states and actions are equal, so that every batch is known without a generator."""
    return TrajectoryDataset.from_arrays(
        np.tile([0.5, -1.0], (20, 1)), np.tile([0.75, -0.25], (20, 1)), terminals_of([10, 10])
    )


def known_batch(size: int) -> dict[str, torch.Tensor]:
    """The batch that `one_place` gives."""
    return {
        'observations': torch.tensor([[0.5, -1.0]]).repeat(size, 1),
        'actor_goals': torch.tensor([[0.5, -1.0]]).repeat(size, 1),
        'actions': torch.tensor([[0.75, -0.25]]).repeat(size, 1),
    }


def inner_loop_by_hand(agent, steps: int, lr: float):
    """Adam from fresh moments; returns the agents after 0..K steps."""
    copy = agent.clone()
    optimizer = torch.optim.Adam(copy.parameters(), lr=lr)
    agents = [agent.clone()]
    for _ in range(steps):
        optimizer.zero_grad()
        copy.losses(known_batch(8))[0].backward()
        optimizer.step()
        agents.append(copy.clone())
    return agents


@pytest.mark.parametrize('batch', [1, 3])
@pytest.mark.parametrize('early_stopping', [False, True])
@pytest.mark.parametrize('algorithm', ['continual', 'reptile', 'fomaml'])
def test_one_outer_step_by_hand(algorithm, early_stopping, batch, one_place):
    base = tiny_agent()
    config = quick(
        algorithm=algorithm,
        outer_steps=1,
        inner_steps=6,
        inner_lr=0.4,
        meta_lr={'continual': None, 'reptile': 0.1, 'fomaml': 0.01}[algorithm],
        meta_batch_size=batch,
        early_stopping=early_stopping,
    )
    outer_steps = []
    trained = post_train(
        base, one_place, config, on_step=lambda outer, agent: outer_steps.append(outer)
    )
    agents = inner_loop_by_hand(base, 6, 0.4)
    losses = [agent.losses(known_batch(3))[0].item() for agent in agents]
    best = int(np.argmin(losses))
    assert 0 < best < 6
    (outer,) = outer_steps
    assert len(outer.tasks) == batch
    for result in outer.tasks:
        assert result.best_step == (best if early_stopping else 6)
        if early_stopping:
            np.testing.assert_allclose(result.test_losses, losses, rtol=1e-5)
        else:
            assert result.test_losses == []
    adapted = agents[best if early_stopping else 6]
    # Every task is the same, so the mean over tasks is the one expert.
    gradients = torch.autograd.grad(adapted.losses(known_batch(3))[0], list(adapted.parameters()))
    for own, theta, expert, gradient in zip(
        trained.parameters(), base.parameters(), adapted.parameters(), gradients, strict=True
    ):
        expected = {
            'continual': expert,
            'reptile': theta + 0.1 * (expert - theta),
            'fomaml': theta - 0.01 * gradient / (gradient.abs() + 1e-8),
        }[algorithm]
        torch.testing.assert_close(own, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize('algorithm', ['continual', 'reptile'])
def test_rejected_inner_loops_leave_the_base(algorithm, one_place):
    base = tiny_agent()
    # From the optimum every step makes the test loss worse.
    optimum = inner_loop_by_hand(base, 400, 0.02)[-1]
    config = quick(algorithm=algorithm, inner_lr=0.5, optimizer='adam', meta_batch_size=3)
    outer_steps = []
    trained = post_train(
        optimum, one_place, config, on_step=lambda outer, agent: outer_steps.append(outer)
    )
    assert [result.best_step for outer in outer_steps for result in outer.tasks] == [0] * 12
    assert_bit_equal(trained, weights_of(optimum))


@EVERY_ALGORITHM
@EVERY_AGENT
def test_given_agent_is_left_alone_and_runs_repeat(algorithm, name):
    agent, dataset = tiny_agent(name), random_dataset([15, 15])
    weights = weights_of(agent)
    config = quick(algorithm=algorithm, meta_batch_size=2)
    first = post_train(agent, dataset, config, seed=1)
    assert_bit_equal(agent, weights)
    assert_changed(first, weights)
    assert_bit_equal(post_train(agent, dataset, config, seed=1), weights_of(first))
    assert_changed(post_train(agent, dataset, config, seed=2), weights_of(first))


@EVERY_ALGORITHM
@EVERY_AGENT
def test_optimizer_state_of_pretraining_is_kept(algorithm, name, tmp_path):
    """The outer Adam, where there is one, is another optimiser and has a state of its own."""
    agent, dataset = tiny_agent(name), random_dataset([15, 15])
    agent = pretrain(agent, dataset, PretrainConfig(steps=3, batch_size=8))
    state = {n: moments['exp_avg'].clone() for n, moments in pretrained_state(agent).items()}
    post_train(agent, dataset, quick(algorithm=algorithm), run=run_in(tmp_path))
    loaded = pretrained_state(load_checkpoint(tmp_path))
    assert loaded.keys() == state.keys()
    for number, moment in state.items():
        assert float(loaded[number]['step']) == 3
        assert torch.equal(loaded[number]['exp_avg'], moment)
    outer = load_training_state(tmp_path).optimizer
    assert {float(moments['step']) for moments in outer.values()} == (
        {4.0} if algorithm in GRADIENT_UPDATES else set()
    )


@EVERY_ALGORITHM
def test_actor_only_leaves_everything_else(algorithm):
    agent, dataset = tiny_agent('gciql'), random_dataset([15, 15])
    config = quick(algorithm=algorithm, actor_only=True, early_stopping=False)
    trained = post_train(agent, dataset, config)
    weights = weights_of(agent)
    for name, weight in trained.state_dict().items():
        assert torch.equal(weight, weights[name]) == (not name.startswith('actor.')), name


def test_steps_are_reported_with_the_agent_as_it_is_then():
    seen = []
    trained = post_train(
        tiny_agent(),
        random_dataset([15, 15]),
        quick(),
        on_step=lambda outer, agent: seen.append((outer.step, weights_of(agent))),
    )
    assert [step for step, _ in seen] == [1, 2, 3, 4]
    assert_bit_equal(trained, seen[-1][1])


def test_every_outer_step_draws_other_tasks_and_batches(monkeypatch):
    batches, steps = [], QueryBatches.steps

    def spy(source, count, size, rng):
        drawn = list(steps(source, count, size, rng))
        batches.extend(drawn)
        return iter(drawn)

    monkeypatch.setattr(QueryBatches, 'steps', spy)
    drawn = []
    post_train(
        tiny_agent(),
        random_dataset([60, 60]),
        quick(meta_batch_size=2),
        on_step=lambda outer, agent: drawn.extend(outer.tasks),
    )
    assert len({task.goal for task in drawn}) > 5
    assert len(batches) == 4 * 2 * 3
    assert len({batch['observations'].numpy().tobytes() for batch in batches}) == len(batches)


def test_agent_with_a_critic_filters_with_its_current_value(monkeypatch):
    critics = []
    sample = TaskSampler.sample

    def spy(sampler, rng, value_fn=None):
        critics.append(value_fn)
        return sample(sampler, rng, value_fn)

    monkeypatch.setattr(TaskSampler, 'sample', spy)
    dataset = random_dataset([15, 15])
    post_train(tiny_agent('gciql'), dataset, quick(algorithm='fomaml'))
    assert len(set(critics)) == 4  # the weights change with every outer step
    critics.clear()
    post_train(tiny_agent('gcbc'), dataset, quick())
    assert critics == [None] * 4


def run_in(folder, *, stop_after: int | None = None, resume: bool = False, **settings):
    taken = []
    return TrainingRun(
        'post_train',
        {'seed': 0, **settings},
        folder,
        resume=resume,
        should_stop=lambda: bool(taken.append(1)) or len(taken) == stop_after,
    )


@EVERY_ALGORITHM
@EVERY_AGENT
def test_resuming_after_any_step_gives_the_same_bits(algorithm, name, tmp_path):
    agent, dataset = tiny_agent(name), random_dataset([15, 15])
    config = quick(algorithm=algorithm, meta_batch_size=2)
    expected = weights_of(post_train(agent, dataset, config))
    for interrupted_at in range(1, config.outer_steps):
        folder = tmp_path / str(interrupted_at)
        message = f'stopped after step {interrupted_at} of 4'
        with pytest.raises(TrainingInterrupted, match=message):
            post_train(agent, dataset, config, run=run_in(folder, stop_after=interrupted_at))
        resumed = post_train(agent, dataset, config, run=run_in(folder, resume=True))
        assert_bit_equal(resumed, expected)
        assert_bit_equal(load_checkpoint(folder), expected)


def test_resuming_with_other_settings_is_refused_by_name(tmp_path):
    agent, dataset = tiny_agent(), random_dataset([15, 15])
    settings = quick().model_dump(mode='json')
    post_train(agent, dataset, quick(), run=run_in(tmp_path, **settings))
    changed = quick(algorithm='reptile').model_dump(mode='json')
    message = "cannot resume, algorithm was 'continual' and is now 'reptile'"
    with pytest.raises(CheckpointError, match=message):
        post_train(agent, dataset, quick(), run=run_in(tmp_path, resume=True, **changed))


def test_pretraining_checkpoint_is_not_taken_for_a_post_training_run(tmp_path):
    agent, dataset = tiny_agent(), random_dataset([15, 15])
    TrainingRun('pretrain', {'seed': 0}, tmp_path).step_done(agent, None, 1, 1)
    with pytest.raises(CheckpointError, match='is a pretrain run, not post_train'):
        post_train(agent, dataset, quick(), run=run_in(tmp_path, resume=True))


def test_dataset_without_tasks_is_refused(monkeypatch):
    monkeypatch.setattr(tasks, '_MAX_REDRAWS', 50)
    dataset = TrajectoryDataset.from_arrays(
        np.arange(8.0).reshape(4, 2) * 100, np.zeros((4, 2)), np.ones(4, bool)
    )
    with pytest.raises(ValueError, match='random state-goal pairs has trajectories between them'):
        post_train(tiny_agent(), dataset, quick())
