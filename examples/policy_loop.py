"""Plug the adapting policy into a control loop of the LeRobot kind: reset, then select_action.

Such a loop knows a policy with `reset()` and `select_action(batch)`, where a batch holds tensors
(1, n) under `observation.state`.

Try it: python examples/policy_loop.py
"""

from metagcttt_core import (
    adapt,
    FilterConfig,
    load_checkpoint,
    TrajectoryDataset,
    TrajectoryFilter,
    TTTConfig,
)
from sim_bridge import make_simulator
import torch

ASSETS = 'assets/pointmaze-medium-navigate'


class AdaptingPolicy:
    """Adapts at the first observation of an episode, then acts with the expert."""

    def __init__(self, steps: int) -> None:
        """Load policy and data; K is `steps`."""
        self.agent = load_checkpoint(f'{ASSETS}/meta')
        self.dataset = TrajectoryDataset.load(f'{ASSETS}/dataset.npz')
        self.filter = TrajectoryFilter(self.dataset, FilterConfig(variant='gcttt'))
        self.config = TTTConfig(steps=steps, batch_size=256)
        self.reset()

    def reset(self) -> None:
        """Forget the expert."""
        self.expert = None

    def select_action(self, batch: dict[str, torch.Tensor]) -> torch.Tensor:
        """Actions (1, act_dim)."""
        state = batch['observation.state'][0].numpy()
        goal = batch['observation.environment_state'][0].numpy()
        if self.expert is None:
            support = self.filter.query(state, goal)
            self.expert = adapt(self.agent, self.dataset, support, goal, self.config).agent
        return torch.from_numpy(self.expert.act(state, goal))[None]


robot = make_simulator('pointmaze-medium-v0')  # stands for a robot with get_observation
policy = AdaptingPolicy(steps=20)
for task in robot.tasks:
    state, goal = robot.reset(task.task_id, seed=0)
    policy.reset()
    while True:  # the loop, which knows nothing of adaptation
        keys = {'observation.state': state, 'observation.environment_state': goal}
        batch = {key: torch.from_numpy(value).float()[None] for key, value in keys.items()}
        result = robot.step(policy.select_action(batch)[0])
        state = result.observation
        if result.terminated or result.truncated:
            break
    print(f'{task.name}: {"reached" if result.success else "missed"}')
