"""Pictures of a meta-post-training run: k*, losses, drift, support sizes, redraws."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, TYPE_CHECKING

from metagcttt_core.config import Settings
from metagcttt_core.files import read_json_lines, refuse_foreign
import numpy as np
from pydantic import Field

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.results import write_report
from metagcttt_tools.common.run_log import METRICS
from metagcttt_tools.common.session import SETTINGS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DESCRIPTION = """Draw what happened in a meta-post-training run, finished or not.

Example: metagcttt diagnostics --run out/meta
Writes best_steps.png, inner_losses.png and run.png to OUT and to the run's TensorBoard, and what
they show of start, middle and end to OUT/diagnostics.json."""

_POINTS = 100
_GREY = '#9a9a9a'

Records = Sequence[dict[str, Any]]


class DiagnosticsSettings(Settings):
    """Settings of the program."""

    run: Path = Field(Path('out/meta'), description='folder of the run')
    out: Path | None = Field(None, description='folder for the pictures; RUN/diagnostics if none')
    tensorboard: bool = Field(True, description="add the pictures to the run's TensorBoard")


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(DiagnosticsSettings, _DESCRIPTION, 'diagnostics', argv)
    from torch.utils.tensorboard import SummaryWriter

    from metagcttt_tools.common.plots import save

    path = settings.run / METRICS
    if not path.is_file():
        fail(f'{settings.run}: no run of metagcttt meta-train there ({METRICS} is missing)')
    lines = read_json_lines(path)
    records = [line for line in lines if 'inner/best_step' in line]
    if not records:
        fail(f'{path}: holds no record of meta-post-training')
    for line in lines:
        for warning in line.get('warnings', []):
            print(f'warning: after step {line["step"]}: {warning}')
    last_step = records[-1]['step']
    out = settings.out or settings.run / 'diagnostics'
    figures = out / 'diagnostics.json'
    try:
        for path in (figures, *(out / f'{name}.png' for name in PICTURES)):
            refuse_foreign(*([] if settings.out else [settings.run / SETTINGS]), path)
    except FileExistsError as error:
        fail(str(error))
    writer = SummaryWriter(str(settings.run / 'tensorboard')) if settings.tensorboard else None
    for name, picture in PICTURES.items():
        figure = picture(records)
        save(figure, out / f'{name}.png')
        print(out / f'{name}.png')
        if writer:
            writer.add_figure(f'diagnostics/{name}', figure, last_step)
    if writer:
        writer.close()
    write_report(figures, settings, {name: summary(part) for name, part in parts(records).items()})
    print(figures)


def parts(records: Records) -> dict[str, Records]:
    """The first, the middle and the last tenth of a run."""
    share = max(1, len(records) // 10)
    middle = (len(records) - share) // 2
    return {
        'start': records[:share],
        'middle': records[middle : middle + share],
        'end': records[-share:],
    }


def summary(records: Records) -> dict[str, Any]:
    """Means over some outer steps of what the log has: shares of inner loops, drift and losses."""
    logged = {
        name: float(means([records], log_name)[0])
        for name, log_name in (
            ('rejected', 'inner/rejected'),
            ('one_step', 'inner/one_step'),
            ('drift', 'meta/drift'),
        )
        if any(log_name in record for record in records)
    }
    curves = {name: mean_curve(records, f'inner/{name}_loss_curve') for name in ('train', 'test')}
    return {
        'outer_steps': [records[0]['step'], records[-1]['step']],
        **logged,
        'losses': {name: each.tolist() for name, each in curves.items() if each is not None},
    }


def best_steps_picture(records: Records) -> Figure:
    """Inner steps kept: shares over the run, and the histogram of k*."""
    from matplotlib.figure import Figure

    from metagcttt_tools.common.plots import COLORS

    figure = Figure(figsize=(9, 3.4), layout='constrained')
    over_run, whole = figure.subplots(1, 2)
    groups = grouped(records)
    rejected = means(groups, 'inner/rejected')
    one_step = np.nan_to_num(means(groups, 'inner/one_step'))
    over_run.stackplot(
        last_steps(groups),
        rejected,
        one_step,
        1 - rejected - one_step,
        labels=('rejected (k* = 0)', 'one step (k* = 1)', 'more'),
        colors=COLORS[:3],
        alpha=0.85,
    )
    over_run.set(xlabel='outer step', ylabel='share of inner loops', ylim=(0, 1))
    over_run.margins(x=0)
    over_run.legend(loc='lower right', framealpha=0.9)
    best_steps = samples(records, 'inner/best_steps')
    if len(best_steps):
        counts = np.bincount(best_steps.astype(int))
        colors = [COLORS[min(step, 2)] for step in range(len(counts))]
        whole.bar(range(len(counts)), counts / counts.sum(), width=1, color=colors)
    else:
        _say_missing(whole)
    whole.set(xlabel='k* (inner steps kept)', ylabel='share of inner loops')
    return figure


def inner_losses_picture(records: Records) -> Figure:
    """Train and test loss over the inner steps at three times of the run (paper, figure 8)."""
    from matplotlib.figure import Figure

    from metagcttt_tools.common.plots import COLORS

    figure = Figure(figsize=(10, 3.4), layout='constrained')
    panels = figure.subplots(1, 3, sharey=True)
    for axes, part in zip(panels, parts(records).values(), strict=True):
        train = mean_curve(part, 'inner/train_loss_curve')
        test = mean_curve(part, 'inner/test_loss_curve')
        if train is None:
            _say_missing(axes)
            continue
        # The train loss of a step is that of its batch before the step.
        axes.plot(range(len(train)), train, color=COLORS[0], label='train batch')
        if test is not None:
            axes.plot(range(len(test)), test, color=COLORS[1], label='test split')
            best = int(np.argmin(test))
            axes.plot(best, test[best], 'o', color=COLORS[1], clip_on=False, label='its minimum')
        axes.set(
            xlabel='inner step', title=f'outer steps {part[0]["step"]:,} to {part[-1]["step"]:,}'
        )
        axes.grid(alpha=0.3)
    panels[0].set_ylabel('loss (mean over tasks)')
    panels[0].legend(*panels[-1].get_legend_handles_labels())
    return figure


def run_picture(records: Records) -> Figure:
    """Losses, drift, support sizes and redraws over the outer steps."""
    from matplotlib.figure import Figure

    from metagcttt_tools.common.plots import COLORS

    figure = Figure(figsize=(9, 6), layout='constrained')
    (losses, drift), (support, redraws) = figure.subplots(2, 2, sharex=True)
    groups = grouped(records)
    steps = last_steps(groups)
    lines = {
        'before adapting': 'inner/first_test_loss',
        'at k*': 'inner/best_test_loss',
        'after all steps': 'inner/last_test_loss',
        'pre-trained policy': 'inner/initial_loss',
    }
    for color, (label, name) in zip(COLORS, lines.items(), strict=False):
        losses.plot(steps, means(groups, name), color=color, label=label)
    losses.set_ylabel('test loss')
    losses.legend()
    drift.plot(steps, means(groups, 'meta/drift'), color=COLORS[1])
    drift.set_ylabel('distance from the base weights (L2)')
    sizes = [samples(group, 'task/support_sizes') for group in groups]
    if all(len(group) for group in sizes):
        low, median, high = np.array([np.percentile(g, (10, 50, 90)) for g in sizes]).T
        support.fill_between(steps, low, high, color=COLORS[1], alpha=0.2, label='10 to 90 %')
        support.plot(steps, median, color=COLORS[1], label='median')
    mean = means(groups, 'task/support_transitions')
    support.plot(steps, mean, color=_GREY, linewidth=1, label='mean')
    support.set(ylabel='filtered transitions', yscale='log')
    support.legend()
    redraws.plot(steps, means(groups, 'task/redraws'), color=COLORS[1])
    redraws.set_ylabel('redraws per task')
    redraws.set_ylim(-0.05, max(1.0, redraws.get_ylim()[1]))
    for axes in (support, redraws):
        axes.set_xlabel('outer step')
    for axes in (losses, drift, support, redraws):
        axes.grid(alpha=0.3)
    return figure


PICTURES: dict[str, Callable[[Records], Figure]] = {
    'best_steps': best_steps_picture,
    'inner_losses': inner_losses_picture,
    'run': run_picture,
}


def grouped(records: Records) -> list[Records]:
    """Neighbouring records in at most 100 groups, each of which becomes a point of a line."""
    bounds = np.linspace(0, len(records), min(len(records), _POINTS) + 1).astype(int)
    return [records[a:b] for a, b in pairwise(bounds)]


def last_steps(groups: Sequence[Records]) -> list[int]:
    """The last outer step of each group."""
    return [group[-1]['step'] for group in groups]


def means(groups: Sequence[Records], name: str) -> np.ndarray:
    """The mean of a number over the records of each group, (groups,); NaN where none has it."""
    values = [[record[name] for record in group if name in record] for group in groups]
    return np.array([np.mean(each) if each else np.nan for each in values])


def samples(records: Records, name: str) -> np.ndarray:
    """All values of the samples of that name, one after the other."""
    return np.array([value for record in records for value in record.get(name, [])])


def mean_curve(records: Records, name: str) -> np.ndarray | None:
    """The mean of the curves of that name; None where no record has one."""
    curves = [record[name] for record in records if name in record]
    return np.mean(curves, axis=0) if curves else None


def _say_missing(axes: Axes) -> None:
    axes.text(0.5, 0.5, 'not in this log', ha='center', va='center', transform=axes.transAxes)
