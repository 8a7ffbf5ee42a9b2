"""Draw one episode per task: what was retrieved for it and where a policy went."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TYPE_CHECKING

from metagcttt_core import FilterConfig, TrajectoryDataset, TrajectoryFilter
from metagcttt_core.adaptation import TTTSettings
from metagcttt_core.config import Settings
import numpy as np
from pydantic import Field
from sim_bridge import make_simulator
from tqdm import tqdm

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.environment import environment_of
from metagcttt_tools.common.results import beside, markdown_table, start_column, write_report
from metagcttt_tools.common.session import sole_writer, use_threads

if TYPE_CHECKING:
    from metagcttt_core.evaluation import Episode

_DESCRIPTION = """Draw one episode per task: what was retrieved and where a policy went.

Example: metagcttt draw-episodes --checkpoint out/pretrain/checkpoint --budgets 0 50
Runs every budget on the same starts and goals; prints a table and writes OUT.png and OUT.json."""


class DrawSettings(Settings):
    """Settings of the program."""

    checkpoint: Path = Field(Path('out/pretrain/checkpoint'), description='the policy')
    dataset: Path = Field(
        Path('data/pointmaze-medium-navigate-v0.npz'), description='dataset to adapt on'
    )
    budgets: tuple[int, ...] = Field(
        (0, 50), min_length=1, max_length=6, description='numbers of gradient steps K'
    )
    ttt: TTTSettings = Field(TTTSettings(), description='test-time training')
    filter: FilterConfig = FilterConfig(variant='gcttt')
    standing: bool = Field(
        False, description='start humanoids on their feet, not dropped as OGBench does'
    )
    seed: int = Field(0, ge=0, description='random seed of starts, goals and adaptations')
    out: Path = Field(Path('out/episodes'), description='files to write, without suffix')


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(DrawSettings, _DESCRIPTION, 'draw-episodes', argv)
    use_threads(1)
    record, picture = beside(settings.out, '.json'), beside(settings.out, '.png')
    try:
        with sole_writer(record, record, picture):
            _run(settings, record, picture)
    except ValueError as error:
        fail(str(error))


def _run(settings: DrawSettings, record: Path, picture: Path) -> None:
    from metagcttt_core import load_checkpoint
    from metagcttt_core.evaluation import run_episode

    from metagcttt_tools.common.plots import demo_picture, save

    agent = load_checkpoint(settings.checkpoint)
    dataset = TrajectoryDataset.load(settings.dataset)
    trajectory_filter = TrajectoryFilter(dataset, settings.filter)
    environment = environment_of(agent)
    with make_simulator(environment, standing=settings.standing) as simulator:
        tasks = [task.task_id for task in simulator.tasks]
        goals = [simulator.reset(task, settings.seed)[1] for task in tasks]
        arms: dict[str, list[Episode]] = {}
        with tqdm(total=len(tasks) * len(settings.budgets), unit='episode') as bar:
            for budget in settings.budgets:
                ttt = settings.ttt.with_steps(budget)
                arms[f'K = {budget}'] = episodes = []
                for task in tasks:
                    episodes.append(
                        run_episode(
                            agent,
                            simulator,
                            task,
                            settings.seed,
                            trajectory_filter=trajectory_filter,
                            ttt=ttt,
                        )
                    )
                    bar.update()
        x, y = simulator.spec.position_dims
        figure = demo_picture(
            simulator.maze,
            paths={arm: [e.observations[:, (x, y)] for e in arms[arm]] for arm in arms},
            successes={arm: [e.success for e in arms[arm]] for arm in arms},
            segments=[retrieved(episode, dataset, (x, y)) for episode in episodes],
            goals=[(goal[x], goal[y]) for goal in goals],
        )
    rows = [
        {**start_column(settings.standing), **summarize(arm, episode)}
        for arm, episodes in arms.items()
        for episode in episodes
    ]
    write_report(record, settings, {'episodes': rows})
    save(figure, picture)
    print(markdown_table(rows))
    print(f'picture: {picture}')


def retrieved(
    episode: Episode, dataset: TrajectoryDataset, position_dims: tuple[int, int]
) -> list[np.ndarray]:
    """Sub-trajectories that the first adaptation of an episode trained on, each (n, 2) metres."""
    return [
        dataset.observations[start:stop, position_dims]
        for support in episode.supports[:1]
        for start, stop in support.segments
    ]


def summarize(arm: str, episode: Episode) -> dict[str, Any]:
    """The figures of one episode."""
    supports, adaptations = episode.supports, episode.adaptations
    return {
        'policy': arm,
        'task': episode.task_id,
        'reached': 'yes' if episode.success else 'no',
        'steps': episode.steps,
        'relevant': sum(support.num_relevant for support in supports),
        'kept': sum(support.num_kept for support in supports),
        'transitions': sum(support.num_transitions for support in supports),
        'filter (ms)': sum(support.milliseconds for support in supports),
        'adapt (ms)': 1e3 * sum(adaptation.seconds for adaptation in adaptations),
    }
