"""Test-time training for one query: from a base agent to an expert, or a reason why not."""

from collections import defaultdict
import copy

from metagcttt_core import (
    adapt,
    FilterConfig,
    SupportSet,
    TrajectoryDataset,
    TrajectoryFilter,
    TTTConfig,
)
from metagcttt_core.adaptation import AdaptationCancelled
from metagcttt_core.agents import GCBC
import numpy as np
import pytest
from tests.core.builders import (
    assert_bit_equal,
    assert_changed,
    EVERY_AGENT,
    random_dataset,
    tiny_agent,
    weights_of,
)
import torch

GOAL = np.array([0.5, -1.5])


def support_of(rows) -> SupportSet:
    return SupportSet(np.array(rows, np.int64), [], np.zeros(0), np.zeros(0), 1, 1)


@pytest.fixture
def dataset() -> TrajectoryDataset:
    return random_dataset([12, 12, 12])


def quick(**settings) -> TTTConfig:
    return TTTConfig(**{'steps': 4, 'lr': 0.05, 'batch_size': 8, **settings})


@pytest.fixture
def tested(monkeypatch) -> list[dict[str, torch.Tensor]]:
    """Every batch whose loss is taken without gradients: the held-out ones."""
    seen, losses = [], GCBC.losses

    def spy(agent, batch, *, actor_only=False):
        if not torch.is_grad_enabled():
            seen.append(batch)
        return losses(agent, batch, actor_only=actor_only)

    monkeypatch.setattr(GCBC, 'losses', spy)
    return seen


@EVERY_AGENT
@pytest.mark.parametrize('early_stopping', [False, True])
@pytest.mark.parametrize('actor_only', [False, True])
def test_base_agent_stays_bit_equal(name, early_stopping, actor_only, dataset):
    agent = tiny_agent(name)
    agent.metadata = {'environment': 'maze'}
    weights = weights_of(agent)
    config = quick(early_stopping=early_stopping, actor_only=actor_only)
    result = adapt(agent, dataset, support_of(range(11)), GOAL, config)
    assert_bit_equal(agent, weights)
    assert agent.metadata == {'environment': 'maze'}
    assert result.accepted
    assert result.reason == ''
    assert result.agent is not agent
    assert_changed(result.agent, weights)
    assert result.seconds > 0
    assert len(result.train_losses) == 4
    assert len(result.test_losses) == (5 if early_stopping else 0)
    for key, weight in result.agent.state_dict().items():
        if actor_only and not key.startswith('actor.'):
            assert torch.equal(weight, weights[key])


@EVERY_AGENT
def test_result_depends_on_the_seed_alone(name, dataset):
    agent = tiny_agent(name)
    runs = []
    for torch_seed, seed in ((0, 3), (1, 3), (1, 4)):
        torch.manual_seed(torch_seed)
        np.random.seed(torch_seed)
        config = quick(early_stopping=True)
        runs.append(adapt(agent, dataset, support_of(range(30)), GOAL, config, seed=seed))
    first, again, other = runs
    assert_bit_equal(again.agent, weights_of(first.agent))
    assert (again.train_losses, again.test_losses) == (first.train_losses, first.test_losses)
    assert other.train_losses != first.train_losses


def test_one_sgd_step_on_one_transition_by_hand(dataset):
    """With the mean m and the hidden units h: db = lr (a - m), dW = lr (a - m) h^T."""
    agent = tiny_agent()
    row, lr = 13, 0.2
    result = adapt(agent, dataset, support_of([row]), GOAL, quick(steps=1, lr=lr, optimizer='sgd'))
    inputs = torch.tensor(np.concatenate([dataset.observations[row], GOAL]), dtype=torch.float32)
    action = torch.from_numpy(dataset.actions[row])
    with torch.no_grad():
        hidden = torch.nn.functional.gelu(agent.actor.fc0(inputs), approximate='tanh')
        error = action - agent.actor.mean(hidden)
    head, adapted = agent.actor.mean, result.agent.actor.mean
    torch.testing.assert_close(adapted.bias, head.bias + lr * error)
    torch.testing.assert_close(adapted.weight, head.weight + lr * torch.outer(error, hidden))
    first = agent.actor.fc0
    log_prob, _ = agent.log_prob(inputs[None, :2], inputs[None, 2:], action[None])
    gradient = torch.autograd.grad(-log_prob.mean(), first.weight)[0]
    torch.testing.assert_close(result.agent.actor.fc0.weight, first.weight - lr * gradient)
    assert result.train_losses == pytest.approx([-log_prob.item()], rel=1e-5)
    assert result.best_step == 1


def test_adam_steps_on_one_transition_equal_a_torch_loop(dataset):
    agent = tiny_agent()
    result = adapt(agent, dataset, support_of([13]), GOAL, quick(steps=7, lr=0.01))
    copy = agent.clone()
    optimizer = torch.optim.Adam(copy.parameters(), lr=0.01)
    batch = {
        'observations': torch.from_numpy(dataset.observations[[13]]),
        'actions': torch.from_numpy(dataset.actions[[13]]),
        'actor_goals': torch.from_numpy(GOAL[None].astype(np.float32)),
    }
    losses = []
    for _ in range(7):
        optimizer.zero_grad()
        loss, _ = copy.losses(batch)
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    for name, weight in copy.state_dict().items():
        torch.testing.assert_close(result.agent.state_dict()[name], weight, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(result.train_losses, losses, rtol=1e-5)


def test_adapting_lowers_the_loss_towards_the_goal(dataset):
    agent = tiny_agent()
    support = support_of(range(11))
    result = adapt(agent, dataset, support, GOAL, quick(steps=60, batch_size=64))
    assert result.train_losses[-1] < result.train_losses[0] - 0.01
    rows = np.arange(11)
    before, after = (
        np.square(policy.act(dataset.observations[rows], GOAL) - dataset.actions[rows]).mean()
        for policy in (agent, result.agent)
    )
    assert after < before


def test_held_out_rows_are_never_trained_on_and_their_best_weights_kept(
    dataset, tested, monkeypatch
):
    trained = defaultdict(int)
    spied = GCBC.losses

    def count(agent, batch, *, actor_only=False):
        if torch.is_grad_enabled():
            for observation in batch['observations'].numpy():
                trained[observation.tobytes()] += 1
        return spied(agent, batch, actor_only=actor_only)

    monkeypatch.setattr(GCBC, 'losses', count)
    agent = tiny_agent()
    config = quick(steps=15, lr=0.1, early_stopping=True, test_fraction=0.3, engine='eager')
    result = adapt(agent, dataset, support_of(range(11)), GOAL, config)
    assert len(tested) == len(result.test_losses) == 16
    held_out = {observation.tobytes() for observation in tested[0]['observations'].numpy()}
    assert len(held_out) == 3
    assert not held_out & trained.keys()
    assert len(trained) == 8
    assert (tested[0]['actor_goals'].numpy() == GOAL.astype(np.float32)).all()
    assert result.best_step == int(np.argmin(result.test_losses)) > 0
    loss, _ = result.agent.losses(tested[0])
    assert loss.item() == min(result.test_losses)
    base_loss, _ = agent.losses(tested[0])
    assert base_loss.item() == result.test_losses[0]


def test_test_split_has_at_most_max_test_transitions(tested):
    dataset = random_dataset([60])
    config = quick(steps=1, early_stopping=True, test_fraction=0.5, max_test=7, engine='eager')
    adapt(tiny_agent(), dataset, support_of(range(59)), GOAL, config)
    assert len(tested[0]['observations']) == 7


def test_adaptation_that_only_makes_the_held_out_loss_worse_is_rejected(dataset):
    agent = tiny_agent()
    weights = weights_of(agent)
    config = quick(lr=50, optimizer='sgd', early_stopping=True)
    result = adapt(agent, dataset, support_of(range(11)), GOAL, config)
    assert min(result.test_losses[1:]) > result.test_losses[0]
    assert result.agent is agent
    assert not result.accepted
    assert result.best_step == 0
    assert result.reason == 'the held-out loss never fell below its start'
    assert (len(result.train_losses), len(result.test_losses)) == (4, 5)
    assert_bit_equal(agent, weights)


@EVERY_AGENT
@pytest.mark.parametrize('guard', ['loss', 'imitation'])
@pytest.mark.parametrize(('optimizer', 'lr'), [('sgd', 1e-3), ('adam', 1.0)])
def test_guard_accepts_an_expert_only_if_its_measure_falls_on_held_out_rows(
    name, guard, optimizer, lr, dataset, monkeypatch
):
    agent = tiny_agent(name)
    measured, losses = [], type(agent).losses

    def spy(each, batch, *, actor_only=False):
        loss, parts = losses(each, batch, actor_only=actor_only)
        if not torch.is_grad_enabled():
            measured.append((batch, (parts['bc'] if guard == 'imitation' else loss).item()))
        return loss, parts

    monkeypatch.setattr(type(agent), 'losses', spy)
    settings = {'lr': lr, 'optimizer': optimizer, 'test_fraction': 0.3, 'engine': 'eager'}
    config = quick(**settings, guard=guard)
    result = adapt(agent, dataset, support_of(range(11)), GOAL, config)
    (batch, before), (same_batch, after) = measured
    assert batch is same_batch
    assert len(batch['observations']) == 3
    assert result.accepted == (after < before) == (lr < 1)
    assert result.test_losses == []
    if not result.accepted:
        assert result.agent is agent
        assert result.reason == f'the held-out {guard} went from {before:.4g} to {after:.4g}'


def test_guard_leaves_the_steps_of_early_stopping_as_they_are(dataset):
    results = [
        adapt(
            tiny_agent(),
            dataset,
            support_of(range(11)),
            GOAL,
            quick(early_stopping=True, lr=1e-3, guard=guard),
        )
        for guard in ('none', 'loss')
    ]
    assert results[0].test_losses == results[1].test_losses
    assert results[0].best_step == results[1].best_step > 0


def test_weights_that_become_non_finite_are_rejected(dataset):
    agent = tiny_agent()
    result = adapt(agent, dataset, support_of(range(11)), GOAL, quick(lr=1e30, optimizer='sgd'))
    assert (result.agent is agent, result.accepted) == (True, False)
    assert result.reason == 'the adapted weights are not finite'
    assert not np.isfinite(result.train_losses).all()


@pytest.mark.parametrize('rows', [[], [11], [11, 23, 35]], ids=['none', 'last', 'only-last'])
@pytest.mark.parametrize('early_stopping', [False, True])
def test_support_without_transitions_gives_the_base_agent(rows, early_stopping, dataset):
    agent = tiny_agent()
    config = quick(early_stopping=early_stopping)
    result = adapt(agent, dataset, support_of(rows), GOAL, config)
    assert (result.agent is agent, result.accepted, result.best_step) == (True, False, 0)
    assert result.reason == 'the filtered dataset is empty'
    assert (result.train_losses, result.test_losses) == ([], [])


def test_empty_query_result_gives_the_base_agent(dataset):
    support = TrajectoryFilter(dataset).query(np.full(2, 1e3), GOAL)
    result = adapt(tiny_agent(), dataset, support, GOAL, quick())
    assert result.reason == 'the filtered dataset is empty'


@pytest.mark.parametrize('rows', [[3], [3, 11]], ids=['one', 'one-and-a-last'])
def test_support_too_small_to_split_gives_the_base_agent(rows, dataset):
    agent = tiny_agent()
    # Whichever of the two rows is held out, one part is left without a transition.
    results = [
        adapt(agent, dataset, support_of(rows), GOAL, quick(early_stopping=True), seed=seed)
        for seed in range(6)
    ]
    for result in results:
        assert (result.agent is agent, result.accepted) == (True, False)
    reasons = {result.reason for result in results}
    assert reasons <= {
        'the filtered dataset is empty',
        'the filtered dataset is too small to hold out a test split',
    }


def test_zero_steps_give_the_base_agent(dataset):
    agent = tiny_agent()
    result = adapt(agent, dataset, support_of(range(11)), GOAL, quick(steps=0))
    assert (result.agent is agent, result.accepted, result.best_step) == (True, False, 0)
    assert result.reason == 'no adaptation steps were asked for'


@pytest.mark.parametrize('settings', [{}, {'steps': 0}, {'early_stopping': True, 'lr': 1e3}])
def test_result_tells_what_it_was_adapted_on(dataset, settings):
    support = support_of(range(11))
    told = []
    result = adapt(
        tiny_agent(),
        dataset,
        support,
        GOAL,
        quick(**settings),
        on_step=lambda step, losses: told.append((step, losses['total'].item())),
    )
    assert result.support is support
    assert result.accepted == (result.best_step > 0) == (not result.reason)
    assert told == list(enumerate(result.train_losses, start=1))


def test_cancelled_within_one_step(dataset):
    agent = tiny_agent()
    weights = weights_of(agent)
    asked = []

    def should_stop():
        asked.append(1)
        return len(asked) == 3

    with pytest.raises(AdaptationCancelled, match='cancelled before inner step 3'):
        adapt(
            agent,
            dataset,
            support_of(range(11)),
            GOAL,
            quick(steps=1000, early_stopping=True),
            should_stop=should_stop,
        )
    assert len(asked) == 3
    assert_bit_equal(agent, weights)


def with_optimizer_state(agent):
    """The agent with an Adam state of 1000 steps whose moments differ from weight to weight."""
    rng = np.random.default_rng(7)
    agent.optimizer_state = {
        number: {
            'step': torch.tensor(1000.0),
            'exp_avg': torch.from_numpy(rng.normal(0, 0.5, weight.shape).astype(np.float32)),
            'exp_avg_sq': torch.from_numpy(rng.uniform(0.1, 1, weight.shape).astype(np.float32)),
        }
        for number, weight in enumerate(agent.trained_parameters())
    }
    return agent


@EVERY_AGENT
@pytest.mark.parametrize('actor_only', [False, True])
def test_pretrained_state_continues_adam_of_pretraining(name, actor_only, dataset):
    """Adam's step 1001 in numpy, in double precision, from the moments of step 1000."""
    agent = with_optimizer_state(tiny_agent(name))
    given = copy.deepcopy(agent.optimizer_state)
    weights = weights_of(agent)
    batches, losses = [], type(agent).losses

    def spy(agent, batch, *, actor_only=False):
        batches.append(batch)
        return losses(agent, batch, actor_only=actor_only)

    config = quick(
        steps=1,
        lr=1e-3,
        optimizer_state='pretrained',
        actor_only=actor_only,
        engine='eager',
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(agent), 'losses', spy)
        result = adapt(agent, dataset, support_of([13]), GOAL, config)
    trained = list(agent.trained_parameters(actor_only=actor_only))
    (batch,) = batches
    gradients = torch.autograd.grad(agent.losses(batch, actor_only=actor_only)[0], trained)
    numbers = [number for number, p in enumerate(agent.trained_parameters()) if is_in(p, trained)]
    assert len(numbers) == len(trained)
    for number, before, gradient, after in zip(
        numbers,
        trained,
        gradients,
        result.agent.trained_parameters(actor_only=actor_only),
        strict=True,
    ):
        g, theta = (tensor.detach().double().numpy() for tensor in (gradient, before))
        m, v = (given[number][key].double().numpy() for key in ('exp_avg', 'exp_avg_sq'))
        first = (0.9 * m + 0.1 * g) / (1 - 0.9**1001)
        second = (0.999 * v + 0.001 * g**2) / (1 - 0.999**1001)
        expected = theta - 1e-3 * first / (np.sqrt(second) + 1e-8)
        np.testing.assert_allclose(after.detach().numpy(), expected, rtol=0, atol=1e-6)
        assert np.abs(after.detach().numpy() - theta).max() > 1e-5
    if actor_only:
        for key, weight in result.agent.state_dict().items():
            assert key.startswith('actor.') or torch.equal(weight, weights[key])
    assert_bit_equal(agent, weights)
    for number, moments in given.items():
        for key, tensor in moments.items():
            assert torch.equal(agent.optimizer_state[number][key], tensor)
    again = adapt(agent, dataset, support_of([13]), GOAL, config)
    assert_bit_equal(again.agent, weights_of(result.agent))


def is_in(parameter, parameters):
    return any(parameter is other for other in parameters)


def test_fresh_state_is_the_default_and_forgets_the_agent_s(dataset):
    plain, carrying = tiny_agent(), with_optimizer_state(tiny_agent())
    arguments = (dataset, support_of(range(11)), GOAL, quick())
    assert_bit_equal(adapt(carrying, *arguments).agent, weights_of(adapt(plain, *arguments).agent))


def test_optimizer_state_travels_with_copies_and_experts(dataset):
    agent = with_optimizer_state(tiny_agent())
    config = quick(optimizer_state='pretrained')
    expert = adapt(agent, dataset, support_of(range(11)), GOAL, config).agent
    for copied in (agent.clone(), agent.to('cpu'), expert):
        assert copied.optimizer_state is agent.optimizer_state


def test_optimizer_state_that_does_not_fit_is_refused(dataset):
    agent = with_optimizer_state(tiny_agent())
    agent.origin = 'out/run/checkpoint'
    del agent.optimizer_state[2]
    with pytest.raises(ValueError, match=r'out/run/checkpoint: optimiser state of parameter 2'):
        adapt(agent, dataset, support_of([0]), GOAL, quick(optimizer_state='pretrained'))


def test_memory_mapped_dataset_gives_the_same_expert(dataset, tmp_path):
    dataset.save(tmp_path / 'data.npz')
    mapped = TrajectoryDataset.load(tmp_path / 'data.npz', memory_map=True)
    agent = tiny_agent('gciql')
    expected, result = (
        adapt(agent, data, support_of(range(11)), GOAL, quick(early_stopping=True))
        for data in (dataset, mapped)
    )
    assert_bit_equal(result.agent, weights_of(expected.agent))


def test_support_of_a_real_query_makes_an_expert(dataset):
    state, goal = dataset.observations[0], dataset.observations[8]
    support = TrajectoryFilter(dataset, FilterConfig(epsilon=2.0)).query(state, goal)
    assert support
    first = adapt(tiny_agent(), dataset, support, goal, quick())
    weights = weights_of(first.agent)
    second = adapt(first.agent, dataset, support, goal, quick())
    assert first.accepted
    assert second.accepted
    assert_bit_equal(first.agent, weights)
    assert_changed(second.agent, weights)


@pytest.mark.parametrize(
    ('agent_settings', 'goal', 'ttt', 'message'),
    [
        (
            {'obs_dim': 3},
            np.zeros(3),
            {},
            'is for observations of 3 and actions of 2 values, the dataset has 2 and 2',
        ),
        (
            {'act_dim': 1},
            GOAL,
            {},
            'is for observations of 2 and actions of 1 values, the dataset has 2 and 2',
        ),
        ({}, np.zeros(3), {}, r'goal must have shape \(2,\), got \(3,\)'),
        ({}, np.zeros((1, 2)), {}, r'goal must have shape \(2,\), got \(1, 2\)'),
        ({}, np.array([0, np.inf]), {}, 'goal holds a non-finite value'),
        ({}, GOAL, {'optimizer_state': 'pretrained'}, 'the agent: has no optimiser state'),
    ],
)
def test_what_does_not_fit_together_is_refused(agent_settings, goal, ttt, message, dataset):
    with pytest.raises(ValueError, match=message):
        adapt(tiny_agent(**agent_settings), dataset, support_of([0]), goal, quick(**ttt))
