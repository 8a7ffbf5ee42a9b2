"""Losses by part, over the steps of test-time training (appendix B) or of pre-training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TYPE_CHECKING

from metagcttt_core import FilterConfig, TrajectoryDataset, TrajectoryFilter, TTTConfig
from metagcttt_core.adaptation.config import TTTLoopConfig
from metagcttt_core.agents.config import ActorLoss
from metagcttt_core.config import Settings
from metagcttt_core.files import read_json_lines, refuse_foreign
from metagcttt_core.retrieval.support import SupportSet
import numpy as np
from pydantic import Field
from sim_bridge import make_simulator

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.environment import environment_of
from metagcttt_tools.common.results import markdown_table, write_report
from metagcttt_tools.common.run_log import METRICS
from metagcttt_tools.common.session import use_threads

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from metagcttt_core import Agent
    from torch import Tensor

_DESCRIPTION = """Draw the losses of test-time training by part, such as actor and value.

Example: metagcttt loss-curves --checkpoint out/base-0/checkpoint --lrs 1e-4 3e-4 3e-3
The policy adapts to one task of its simulator with each learning rate. With --run FOLDER the
losses are those of a pre-training run, from its log. Writes OUT as JSON, a picture beside it."""

Curves = dict[str, dict[str, list[float]]]
"""By line and part of the loss, its values in order."""
_PANELS = ('total', 'actor', 'subpolicy', 'critic', 'value')
_SQUARED = ('critic', 'value')  # never negative, and over orders of magnitude


class LossCurvesTTT(TTTLoopConfig):
    """One adaptation, with each of the learning rates."""

    steps: int = Field(200, ge=1, description='gradient steps K')


class LossCurvesSettings(Settings):
    """Settings of the program."""

    checkpoint: Path = Field(Path('out/pretrain/checkpoint'), description='policy to adapt')
    run: Path | None = Field(None, description='folder of a pre-training run to draw instead')
    dataset: Path = Field(
        Path('data/pointmaze-medium-navigate-v0.npz'), description='dataset to adapt on (npz)'
    )
    task: int = Field(1, ge=1, description='evaluation task whose start and goal to adapt to')
    lrs: tuple[float, ...] = Field(
        (3e-5, 1e-4, 3e-4), min_length=1, description='inner learning rates'
    )
    ttt: LossCurvesTTT = Field(LossCurvesTTT(), description='test-time training')
    actor_loss: ActorLoss | None = Field(
        None, description='actor loss to adapt a GCIQL or CRL policy with; its own by default'
    )
    filter: FilterConfig = FilterConfig()
    seed: int = Field(0, ge=0, description='random seed of start and batches')
    out: Path = Field(Path('out/loss_curves.json'), description='file for the results')


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(LossCurvesSettings, _DESCRIPTION, 'loss-curves', argv)
    from metagcttt_tools.common.plots import save

    use_threads(1)
    picture = settings.out.with_suffix('.png')
    try:
        refuse_foreign(settings.out, picture)
        if settings.run is not None:
            steps, curves = pretraining_curves(settings.run)
            axis = 'pre-training steps'
        else:
            curves, axis = test_time_curves(settings), 'steps of test-time training'
            steps = list(range(settings.ttt.steps))
    except (OSError, ValueError) as error:
        fail(str(error))
    rows = roughness_rows(curves)
    write_report(settings.out, settings, {'steps': steps, 'losses': curves, 'roughness': rows})
    save(loss_picture(steps, curves, axis), picture)
    print('Roughness: mean change from step to step over the range of the curve\n')
    print(markdown_table(rows))
    print(f'results: {settings.out}\npicture: {picture}')


def test_time_curves(settings: LossCurvesSettings) -> Curves:
    """Losses of adapting to the start and goal of a task, by learning rate and part."""
    from metagcttt_core import load_checkpoint

    changes = settings.model_dump(include={'actor_loss'}, exclude_none=True)
    agent = load_checkpoint(settings.checkpoint, changes=changes)
    dataset = TrajectoryDataset.load(settings.dataset)
    agent.check(dataset)
    trajectory_filter = TrajectoryFilter(dataset, settings.filter)
    with make_simulator(environment_of(agent)) as simulator:
        observation, goal = simulator.reset(task_id=settings.task, seed=settings.seed)
    support = trajectory_filter.query(observation, goal, agent.value_fn)
    return {
        f'lr {lr:g}': adaptation_losses(
            agent,
            dataset,
            support,
            goal,
            TTTConfig(**settings.ttt.model_dump(), lr=lr),
            settings.seed,
        )
        for lr in settings.lrs
    }


def adaptation_losses(
    agent: Agent,
    dataset: TrajectoryDataset,
    support: SupportSet,
    goal: np.ndarray,
    config: TTTConfig,
    seed: int = 0,
) -> dict[str, list[float]]:
    """The losses before each step of an adaptation, `total` and by part.

    Raises:
        ValueError: If the support is too small to adapt on.
    """
    from metagcttt_core import adapt

    losses: dict[str, list[float]] = {}

    def keep(step: int, parts: Mapping[str, Tensor]) -> None:
        for name, value in parts.items():
            losses.setdefault(name, []).append(float(value))

    result = adapt(agent, dataset, support, goal, config, seed, on_step=keep)
    if not losses:
        raise ValueError(result.reason)
    return losses


def pretraining_curves(run: Path) -> tuple[list[int], Curves]:
    """Steps and losses that a run logged, on training and on validation data.

    Raises:
        OSError: If the run has no log.
        ValueError: If the log holds no training losses.
    """
    records = [record for record in read_json_lines(run / METRICS) if 'train/loss' in record]
    if not records:
        raise ValueError(f'{run / METRICS} holds no training losses')
    curves: Curves = {}
    for line, prefix in (('training', 'train/'), ('validation', 'val/')):
        names = [name for name in records[0] if name.startswith(prefix)]
        if names:
            curves[line] = {
                name.removeprefix(prefix).replace('loss', 'total'): [r[name] for r in records]
                for name in names
            }
    return [record['step'] for record in records], curves


def roughness(values: Sequence[float]) -> float:
    """Mean absolute change from one value to the next over the range of all; 0 if constant."""
    array = np.asarray(values)
    spread = np.ptp(array)
    return float(np.abs(np.diff(array)).mean() / spread) if spread > 0 else 0.0


def roughness_rows(curves: Curves) -> list[dict[str, Any]]:
    """Roughness of each part, one row a line: how erratic it is, whatever its scale."""
    return [
        {'line': line} | {part: roughness(values) for part, values in parts.items()}
        for line, parts in curves.items()
    ]


def loss_picture(steps: Sequence[int], curves: Mapping[str, Any], axis: str) -> Figure:
    """One panel a part of the loss, one line a learning rate."""
    from matplotlib.figure import Figure

    from metagcttt_tools.common.plots import COLORS

    parts = [part for part in _PANELS if part in next(iter(curves.values()))]
    figure = Figure(figsize=(3.2 * len(parts), 3), layout='constrained')
    panels = np.atleast_1d(figure.subplots(1, len(parts)))
    for axes, part in zip(panels, parts, strict=True):
        for number, (line, losses) in enumerate(curves.items()):
            color = COLORS[number % len(COLORS)]
            axes.plot(steps, losses[part], color=color, linewidth=1, label=line)
        if part in _SQUARED:
            axes.set_yscale('log')
        axes.set_title(part)
        axes.set_xlabel(axis)
        axes.grid(alpha=0.25)
    panels[0].set_ylabel('loss')
    panels[0].legend(frameon=False)
    return figure
