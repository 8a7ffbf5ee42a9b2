"""See a recorded run from above without RViz: a picture or an animation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import tempfile
from typing import TYPE_CHECKING

from metagcttt_core import TrajectoryDataset
from metagcttt_core.config import assets_dir, Settings
from metagcttt_core.data import DatasetError
from metagcttt_core.files import refuse_foreign
import numpy as np
from pydantic import Field, field_validator
from sim_bridge.maze_map import MazeMap

from metagcttt_tools.common.cli import fail, parse

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from metagcttt_tools.recordings.goal_views import GoalView

_DESCRIPTION = """Draw a recording of recorder_node from above: walls, retrieved sub-trajectories,
the robot's way and its goals, which is what RViz shows of the running robot.

Example: metagcttt top-view --recording run.mcap --out out/run.png
A name ending in .gif gives an animation."""

_ASSETS = 'pointmaze-medium-navigate'


class TopViewSettings(Settings):
    """Settings of the program."""

    recording: Path = Field(Path('run.mcap'), description='MCAP file of recorder_node')
    out: Path = Field(Path('out/top_view.png'), description='picture (.png) or animation (.gif)')
    dataset: Path | None = Field(
        None, description='dataset that the robot adapted on; the committed one by default'
    )
    robot: str = Field('', description='namespace of the robot, such as /robot1')
    goals: int = Field(5, ge=1, le=10, description='number of goals to show, the last ones')
    frames: int = Field(60, ge=2, le=500, description='frames of the animation per goal')

    @field_validator('out')
    @classmethod
    def _known_ending(cls, out: Path) -> Path:
        if out.suffix not in ('.png', '.gif'):
            raise ValueError(f'must end in .png or .gif, got {out.name}')
        return out


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(TopViewSettings, _DESCRIPTION, 'top-view', argv)
    from metagcttt_tools.common.plots import save
    from metagcttt_tools.recordings.goal_views import read_goal_views

    try:
        refuse_foreign(settings.out)
        dataset = TrajectoryDataset.load(
            settings.dataset or assets_dir() / _ASSETS / 'dataset.npz'
        )
        maze, views = read_goal_views(settings.recording, dataset, settings.robot)
    except (DatasetError, OSError) as error:
        fail(str(error))
    views = views[-settings.goals :]
    if settings.out.suffix == '.png':
        save(picture(maze, views), settings.out)
    else:
        animate(maze, views, settings.frames, settings.out)
    reached = sum(view.reached for view in views)
    print(f'{len(views)} goals, {reached} reached: {settings.out}')


def picture(maze: MazeMap, views: Sequence[GoalView]) -> Figure:
    """One panel a goal, with the robot's whole way."""
    from matplotlib.figure import Figure

    from metagcttt_tools.common.plots import COLORS

    figure = Figure(figsize=(3 * len(views), 3.4), layout='constrained')
    for axes, view in zip(np.atleast_1d(figure.subplots(1, len(views))), views, strict=True):
        _draw_surroundings(axes, maze, view)
        axes.plot(*view.path.T, color=COLORS[1], linewidth=1.8)
        axes.plot(*view.path[0], marker='o', color='black', markersize=6)
        end = 'o' if view.reached else 'x'
        axes.plot(*view.path[-1], marker=end, color=COLORS[0], markersize=6)
        axes.set_title(_title(view))
    return figure


def animate(maze: MazeMap, views: Sequence[GoalView], frames: int, path: Path) -> None:
    """The goals one after the other, each in `frames` pictures, as a GIF."""
    from matplotlib.animation import FuncAnimation, PillowWriter
    from matplotlib.figure import Figure

    from metagcttt_tools.common.plots import COLORS, write_gif

    figure = Figure(figsize=(4, 4.3), layout='constrained')
    axes = figure.subplots()

    def draw(frame: int) -> list[Axes]:
        view = views[frame // frames]
        step = round((frame % frames) / (frames - 1) * (len(view.path) - 1))
        axes.clear()
        _draw_surroundings(axes, maze, view)
        axes.plot(*view.path[: step + 1].T, color=COLORS[1], linewidth=1.8)
        axes.plot(*view.path[step], marker='o', color=COLORS[0], markersize=9)
        axes.set_title(f'{_title(view)}, step {step}')
        return [axes]

    animation = FuncAnimation(figure, draw, frames=frames * len(views))
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder, 'film.gif')
        animation.save(film, writer=PillowWriter(fps=15), dpi=80)
        write_gif(path, film.read_bytes())


def _draw_surroundings(axes: Axes, maze: MazeMap, view: GoalView) -> None:
    from metagcttt_tools.common.plots import draw_maze, draw_segments

    draw_maze(axes, maze)
    draw_segments(axes, view.segments)
    axes.plot(*view.goal, marker='*', color='gold', markeredgecolor='black', markersize=14)


def _title(view: GoalView) -> str:
    return f'goal {view.query_id}' + ('' if view.reached else ' (not reached)')
