"""Adapt a policy to one state and goal, and see its loss fall: the library in twenty lines.

Try it: python examples/adapt.py
"""

from metagcttt_core import (
    adapt,
    FilterConfig,
    load_checkpoint,
    TrajectoryDataset,
    TrajectoryFilter,
    TTTConfig,
)

agent = load_checkpoint('assets/pointmaze-medium-navigate/base')
dataset = TrajectoryDataset.load('assets/pointmaze-medium-navigate/dataset.npz')
trajectory_filter = TrajectoryFilter(dataset, FilterConfig(variant='gcttt'))

state, goal = dataset.observations[0], dataset.observations[500]
support = trajectory_filter.query(state, goal)
print(f'{support.num_kept} sub-trajectories, {support.num_transitions} transitions')

losses = []
expert = adapt(
    agent,
    dataset,
    support,
    goal,
    TTTConfig(steps=20, batch_size=256),
    on_step=lambda step, parts: losses.append(float(parts['total'])),
)
print(f'loss {losses[0]:.2f} before, {losses[-1]:.2f} after {len(losses)} steps')
print(f'action before {agent.act(state, goal)}, after {expert.agent.act(state, goal)}')
