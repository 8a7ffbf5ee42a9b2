"""What a policy does once before it is used. No ROS in here."""

from metagcttt_core import adapt, TTTConfig
import numpy as np

from metagcttt.policy.deployment import Deployment


def warm_up(deployment: Deployment) -> None:
    """Take one gradient step that nobody needs; policy and dataset are not changed.

    The first one makes PyTorch import and set up what takes a second or two, and would keep the
    control loop waiting for as long.
    """
    observation = np.asarray(deployment.dataset.observations[0], dtype=np.float64)
    agent, trajectory_filter = deployment.agent, deployment.trajectory_filter
    support = trajectory_filter.query(observation, observation, agent.value_fn)
    config = TTTConfig(steps=1, batch_size=2)
    adapt(agent, deployment.dataset, support, observation, config)
    agent.act(observation, observation)
