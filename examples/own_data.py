"""From your own recordings to a policy that adapts: a robot in two rooms joined by a door.

Try it: python examples/own_data.py
"""

import metagcttt_core as core
from metagcttt_core.training.config import PretrainConfig
from metagcttt_core.training.pretrain import pretrain
import numpy as np

DOOR = np.array([5.0, 5.0])  # in the wall x = 5, 1 m wide


def move(position: np.ndarray, action: np.ndarray) -> np.ndarray:
    """The robot: an action of length 1 moves it by 0.2 m; the wall stops it."""
    moved = np.clip(position + 0.2 * np.clip(action, -1, 1), 0, 10)
    through_wall = (position[0] < 5) != (moved[0] < 5) and abs(moved[1] - 5) > 0.5
    return position if through_wall else moved


def record(rng: np.random.Generator, steps: int = 100) -> tuple[np.ndarray, np.ndarray]:
    """One trajectory to random places: observations (steps, 2), actions (steps, 2)."""
    position, target = rng.uniform(0, 10, (2, 2))
    observations, actions = [], []
    for _ in range(steps):
        if np.linalg.norm(target - position) < 0.3:
            target = rng.uniform(0, 10, 2)
        other_room = (target[0] < 5) != (position[0] < 5) and abs(position[0] - 5) > 0.3
        way = (DOOR if other_room else target) - position
        action = np.clip(way / np.linalg.norm(way) + rng.normal(0, 0.3, 2), -1, 1)
        observations.append(position)
        actions.append(action)
        position = move(position, action)
    return np.array(observations), np.array(actions)


rng = np.random.default_rng(0)
recordings = [record(rng) for _ in range(300)]
dataset = core.TrajectoryDataset.from_arrays(
    observations=np.concatenate([observations for observations, _ in recordings]),
    actions=np.concatenate([actions for _, actions in recordings]),
    terminals=np.tile(np.arange(100) == 99, 300),  # true on the last row of each trajectory
)
nearby = core.FilterConfig(variant='gcttt', epsilon=1.0)  # metres
base = core.make_agent('gcbc', obs_dim=2, act_dim=2, hidden=(64, 64))
base = pretrain(base, dataset, PretrainConfig(steps=1000, batch_size=256, lr=1e-3))
meta = core.MetaConfig(algorithm='reptile', outer_steps=20, inner_steps=10, filter=nearby)
policy = core.post_train(base, dataset, meta)
core.save_checkpoint(policy, 'out/own-data')

start, goal = np.array([2.0, 2.0]), np.array([8.0, 2.0])
support = core.TrajectoryFilter(dataset, nearby).query(start, goal)
expert = core.adapt(policy, dataset, support, goal, core.TTTConfig(steps=50, lr=1e-3)).agent
for name, agent in {'base': base, 'post-trained': policy, 'adapted': expert}.items():
    position, nearest = start, np.inf
    for _ in range(100):
        position = move(position, agent.act(position, goal))
        nearest = min(nearest, np.linalg.norm(position - goal))
    print(f'{name}: comes within {nearest:.2f} m of the goal in 100 steps')
