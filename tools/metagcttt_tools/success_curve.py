"""Success over pre-training steps (the paper's figure 9), from a run's snapshots."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import sys
from typing import Any, TYPE_CHECKING

from metagcttt_core import success_statistics
import numpy as np
from pydantic import Field

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.results import markdown_table, start_column, write_report
from metagcttt_tools.common.session import snapshot_folder, SNAPSHOTS, sole_writer
from metagcttt_tools.common.sources import identities
from metagcttt_tools.evaluate import (
    evaluate,
    EvaluateSettings,
    finished_before,
    finished_jobs,
    ProtocolSettings,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DESCRIPTION = """Success over the steps of pre-training, by test-time training budget.

Example: metagcttt success-curve --runs out/base-0 out/base-1 --budgets 0 50
The runs are those of metagcttt pretrain with --snapshot-every, one for each training seed.
Writes OUT as JSON and a picture beside it. Ctrl-C is safe; --resume, with no other flag
than --out, continues."""


class SuccessCurveSettings(ProtocolSettings):
    """Settings of the program."""

    runs: tuple[Path, ...] = Field(
        (Path('out/pretrain'),), min_length=1, description='folders of pre-training runs'
    )
    budgets: tuple[int, ...] = Field(
        (0,), min_length=1, description='numbers of gradient steps K of test-time training'
    )
    out: Path = Field(Path('out/success_curve.json'), description='file for the results')


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(SuccessCurveSettings, _DESCRIPTION, 'success-curve', argv)
    from metagcttt_tools.common.plots import save

    try:
        steps = common_steps(settings.runs)
        evaluation = EvaluateSettings(
            checkpoints=tuple(
                snapshot_folder(run, step) for run in settings.runs for step in steps
            ),
            **settings.model_dump(exclude={'runs'}),
        )
        picture = settings.out.with_suffix('.png')
        with sole_writer(settings.out, settings.out, picture):
            known = identities(evaluation.dataset, evaluation.checkpoints, evaluation.actor_loss)
            marks = known['fingerprints']
            done = finished_before(settings, marks)
            rows = done['results']['curve'] if done else _rows(evaluation, settings, steps, marks)
            if not done:
                write_report(settings.out, settings, {'curve': rows}, marks)
                finished_jobs(settings.out).unlink()
            save(curve_picture(rows), picture)
    except ValueError as error:
        fail(str(error))
    except KeyboardInterrupt:
        print('interrupted; pass --resume to continue', file=sys.stderr)
        raise SystemExit(130) from None
    print(markdown_table(rows))
    print(f'results: {settings.out}\npicture: {picture}')


def _rows(
    evaluation: EvaluateSettings,
    settings: SuccessCurveSettings,
    steps: list[int],
    fingerprints: dict[str, Any],
) -> list[dict[str, Any]]:
    results = evaluate(evaluation, settings, fingerprints)
    return [{**row, **start_column(settings.standing)} for row in curve_rows(results, steps)]


def common_steps(runs: Sequence[Path]) -> list[int]:
    """The steps of the snapshots, ascending; the same in all runs.

    Raises:
        ValueError: If a run has none, or others than the first.
    """
    from metagcttt_core.training.checkpoint import has_checkpoint

    found = []
    for run in runs:
        folders = [path for path in (run / SNAPSHOTS).glob('*') if has_checkpoint(path)]
        found.append(sorted(int(path.name) for path in folders))
        if not found[-1]:
            raise ValueError(f'{run / SNAPSHOTS}: no snapshots; pretrain with --snapshot-every')
        if found[-1] != found[0]:
            raise ValueError(f'{run} has snapshots {found[-1]}, but {runs[0]} has {found[0]}')
    return found[0]


def curve_rows(results: Sequence[dict[str, Any]], steps: Sequence[int]) -> list[dict[str, Any]]:
    """Success by step and budget.

    Args:
        results: From `evaluate`: for each run one after the other, the snapshots of all steps.
        steps: Of the snapshots.

    Returns:
        For each step and budget the mean and its standard error, over the runs where there are
        several and otherwise over the evaluation seeds.
    """
    rows = []
    for number, step in enumerate(steps):
        points = zip(*(result['curve'] for result in results[number :: len(steps)]), strict=True)
        for runs in points:
            rates = [point['success'] for point in runs]
            statistics = success_statistics(rates if len(runs) > 1 else runs[0]['per_seed'])
            rows.append(
                {
                    'step': step,
                    'budget': runs[0]['budget'],
                    'success': statistics.mean,
                    'standard_error': statistics.standard_error,
                }
            )
    return rows


def curve_picture(rows: Sequence[dict[str, Any]]) -> Figure:
    """Success against pre-training steps, one line a budget with its standard error."""
    from matplotlib.figure import Figure

    from metagcttt_tools.common.plots import draw_line

    figure = Figure(figsize=(5, 3.5), layout='constrained')
    axes = figure.subplots()
    for number, budget in enumerate(dict.fromkeys(row['budget'] for row in rows)):
        line = [row for row in rows if row['budget'] == budget]
        x, mean, error = (
            np.array([row[key] for row in line]) for key in ('step', 'success', 'standard_error')
        )
        draw_line(axes, x, (mean, mean - error, mean + error), f'K = {budget}', number)
    axes.set_ylim(-0.02, 1.02)
    axes.set_xlabel('pre-training steps')
    axes.set_ylabel('success')
    axes.legend(frameon=False)
    return figure
