from metagcttt.converters import to_time
from metagcttt.goal_in_force import Goal
from metagcttt.policy.publishers import report_message
from metagcttt_core import Adaptation, make_agent, SupportSet
import numpy as np

GOAL = Goal(query_id=3, episode_id=2, observation=np.zeros(2), xy=(0.0, 0.0), seed=0)


def test_report_message_tells_support_and_losses() -> None:
    support = SupportSet(
        indices=np.array([4, 5, 9]),
        segments=[(4, 6), (9, 10)],
        episodes=np.array([1, 2]),
        scores=np.array([-0.5, -0.7]),
        num_relevant=7,
        num_scored=5,
        milliseconds=1.5,
    )
    agent = make_agent('gcbc', obs_dim=2, act_dim=2, hidden=(4,))
    losses = ([3.0, 2.0], [4.0, 3.5, 3.6])
    adaptation = Adaptation(agent, *losses, best_step=1, support=support, seconds=0.25)
    message = report_message(to_time(0), GOAL, adaptation)
    assert (message.query_id, message.episode_id) == (3, 2)
    assert (message.relevant_trajectories, message.kept_trajectories) == (7, 2)
    assert (message.transitions, message.filter_ms, message.adapt_ms) == (3, 1.5, 250.0)
    assert (list(message.segment_starts), list(message.segment_stops)) == ([4, 9], [6, 10])
    assert (message.steps, message.best_step, message.accepted) == (2, 1, True)
    assert list(message.train_losses) == [3.0, 2.0]
    assert list(message.test_losses) == [4.0, 3.5, 3.6]


def test_cached_report_counts_no_time() -> None:
    adaptation = Adaptation(object(), [3.0], best_step=1, seconds=0.25)
    message = report_message(to_time(0), GOAL, adaptation, cached=True)
    assert (message.cached, message.accepted, message.adapt_ms) == (True, True, 0.0)
    assert list(message.train_losses) == [3.0]


def test_report_without_a_result_keeps_the_reason() -> None:
    message = report_message(to_time(0), GOAL, Adaptation(object(), reason='cancelled'))
    assert (message.reason, message.accepted, message.transitions) == ('cancelled', False, 0)
