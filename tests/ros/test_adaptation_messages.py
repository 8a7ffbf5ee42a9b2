from array import array
from pathlib import Path

from metagcttt.adaptation_messages import (
    expert_message,
    ExpertError,
    request_message,
    to_adaptation,
)
from metagcttt.deployment import adapt_to_goal, Deployment, Identity
from metagcttt.goal_in_force import Goal
from metagcttt_core import Adaptation, make_agent, TrajectoryDataset, TrajectoryFilter, TTTConfig
from metagcttt_interfaces.msg import Expert
import numpy as np
import pytest

GOAL = Goal(3, 1, np.array([20.0, 20.0]), (20.0, 20.0), seed=5)
CONFIG = TTTConfig(steps=3, batch_size=16, early_stopping=True, lr=1e-3)


@pytest.fixture(scope='module')
def deployment(dataset_file: Path) -> Deployment:
    agent = make_agent('gciql', obs_dim=2, act_dim=2, hidden=(8, 8))
    return Deployment(agent, TrajectoryFilter(TrajectoryDataset.load(dataset_file)))


@pytest.fixture(scope='module')
def adaptation(deployment: Deployment) -> Adaptation:
    return adapt_to_goal(deployment, np.zeros(2), GOAL, CONFIG, lambda: False)


@pytest.fixture
def message(deployment: Deployment, adaptation: Adaptation) -> Expert:
    return expert_message(deployment.agent, GOAL, adaptation)


def read(message: Expert, deployment: Deployment, config: TTTConfig = CONFIG) -> Adaptation:
    return to_adaptation(message, deployment.agent, deployment.dataset, config, '/adapt')


def test_adaptation_comes_back_as_it_was(
    deployment: Deployment, adaptation: Adaptation, message: Expert
) -> None:
    back = read(message, deployment)
    assert adaptation.accepted
    assert back.agent.fingerprint() == adaptation.agent.fingerprint()
    assert back.support == adaptation.support
    for name in ('train_losses', 'test_losses', 'best_step', 'reason', 'engine'):
        assert getattr(back, name) == getattr(adaptation, name)
    assert back.adapter == '/adapt'


def test_adaptation_that_is_not_accepted_comes_back_with_its_reason(
    deployment: Deployment,
) -> None:
    far = adapt_to_goal(deployment, np.full(2, 500.0), GOAL, CONFIG, lambda: False)
    back = read(expert_message(deployment.agent, GOAL, far), deployment)
    assert back.agent is deployment.agent
    assert (back.accepted, back.reason) == (False, 'the filtered dataset is empty')


def test_request_asks_for_the_inner_loop_of_the_node() -> None:
    request = request_message(
        robot='/robot/policy_node',
        instance=1,
        request_id=2,
        timeout_s=3.0,
        identity=Identity('a', 'b', 'c'),
        observation=np.zeros(2),
        goal=GOAL,
        config=CONFIG,
    )
    assert TTTConfig.model_validate_json(request.settings) == CONFIG
    assert (request.checkpoint, request.dataset, request.filter) == ('a', 'b', 'c')
    assert (request.query.seed, list(request.query.goal)) == (5, [20.0, 20.0])


@pytest.mark.parametrize(
    ('change', 'reason'),
    [
        (lambda m: setattr(m, 'weights', array('B', m.weights[:-1])), 'no safetensors file'),
        (lambda m: setattr(m.report, 'accepted', False), 'accepted'),
        (lambda m: setattr(m.report, 'best_step', 4), 'best_step 4 for 3'),
        (lambda m: setattr(m.report, 'steps', 2), 'steps 2 for 3'),
        (lambda m: m.report.train_losses.pop(), 'train_losses 2 for 3'),
        (lambda m: m.report.test_losses.pop(), 'test_losses 3 for 4'),
        (lambda m: m.scores.pop(), 'other numbers of sub-trajectories'),
        (lambda m: m.report.segment_stops.pop(), 'other numbers of sub-trajectories'),
        (lambda m: setattr(m.report, 'transitions', 1), 'another number of transitions'),
        (lambda m: m.report.segment_stops.__setitem__(-1, 10**9), 'none of the dataset'),
        (lambda m: m.report.segment_starts.__setitem__(1, 0), 'none of the dataset'),
    ],
)
def test_false_expert_is_refused(
    deployment: Deployment, message: Expert, change, reason: str
) -> None:
    change(message)
    with pytest.raises(ExpertError, match=reason):
        read(message, deployment)


def test_weights_of_an_expert_that_is_not_accepted_are_refused(
    deployment: Deployment, message: Expert
) -> None:
    message.report.accepted, message.report.best_step = False, 0
    with pytest.raises(ExpertError, match='not accepted'):
        read(message, deployment)
