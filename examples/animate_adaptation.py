"""Film how K gradient steps change a policy: what was retrieved, where it points, where it goes.

Try it: python examples/animate_adaptation.py out/adaptation.gif
"""

from pathlib import Path
import sys

from matplotlib.animation import PillowWriter
from matplotlib.figure import Figure
import metagcttt_core as core
from metagcttt_tools.common.plots import COLORS, draw_maze, draw_segments
import numpy as np
from sim_bridge import make_simulator

BUDGETS = (*range(0, 11), 12, 14, 16, 18, 20)
TASK = 5

out = Path(sys.argv[1] if len(sys.argv) > 1 else 'out/adaptation.gif')
base = core.load_checkpoint('assets/pointmaze-medium-navigate/base')
dataset = core.TrajectoryDataset.load('assets/pointmaze-medium-navigate/dataset.npz')
simulator = make_simulator('pointmaze-medium-v0')
start, goal = simulator.reset(TASK, seed=0)
support = core.TrajectoryFilter(dataset, core.FilterConfig(variant='gcttt')).query(start, goal)
free = np.array([simulator.maze.center(*cell) for cell in simulator.maze.free_cells()])
grid = np.concatenate([free + shift for shift in ((-1, -1), (-1, 1), (1, -1), (1, 1))])


def drive(agent) -> tuple[np.ndarray, bool]:
    """The path of an episode, and whether it reached the goal."""
    observation, _ = simulator.reset(TASK, seed=0)
    path, over = [simulator.position], False
    while not over:
        result = simulator.step(agent.act(observation, goal))
        observation, over = result.observation, result.terminated or result.truncated
        path.append(simulator.position)
    return np.array(path), result.success


figure = Figure(figsize=(4.6, 5), layout='constrained')
axes = figure.subplots()
out.parent.mkdir(parents=True, exist_ok=True)
with PillowWriter(fps=2).saving(figure, out, dpi=80) as film:
    for steps in (*BUDGETS, *BUDGETS[-1:] * 3):  # the end stays a while
        config = core.TTTConfig(steps=steps, batch_size=256)
        agent = core.adapt(base, dataset, support, goal, config).agent
        path, reached = drive(agent)
        axes.clear()
        draw_maze(axes, simulator.maze)
        draw_segments(axes, [dataset.observations[slice(*rows)] for rows in support.segments])
        arrows = np.array([agent.act(place, goal) for place in grid])
        axes.quiver(*grid.T, *arrows.T, color=COLORS[1], width=0.006, scale=20)
        axes.plot(*path.T, color=COLORS[0], linewidth=2)
        axes.plot(*start, 'o', color='black', markersize=7)
        axes.plot(*goal, '*', color='gold', markeredgecolor='black', markersize=15)
        axes.set_title(f'K = {steps}: ' + (f'{len(path) - 1} steps' if reached else 'missed'))
        film.grab_frame()
