"""The picture of an evaluation on held-out data."""

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from metagcttt_tools.common.plots import draw_line


def offline_picture(results: list[dict[str, Any]]) -> Figure:
    """Action error by K: all arms on the left, the best one by distance on the right.

    Args:
        results: Rows with `checkpoint`, `epsilon`, `lr`, `budget`, `error` and `by_distance`.
    """
    figure = Figure(figsize=(10, 4), layout='constrained')
    left, right = figure.subplots(1, 2)
    arms: dict[tuple[str, float, float], list[dict[str, Any]]] = {}
    for row in results:
        arms.setdefault((row['checkpoint'], row['epsilon'], row['lr']), []).append(row)
    best = min(arms, key=lambda arm: min(row['error']['mean'] for row in arms[arm]))
    shared = [len({arm[part] for arm in arms}) == 1 for part in range(3)]
    for number, (arm, rows) in enumerate(arms.items()):
        words = (arm[0], f'radius {arm[1]:g}', f'rate {arm[2]:g}')
        label = ', '.join(w for w, same in zip(words, shared, strict=True) if not same)
        _line(left, rows, label, number)
    left.set(title='all distances')
    for number, steps in enumerate(arms[best][0]['by_distance']):
        parts = [{'budget': row['budget'], **row['by_distance'][steps]} for row in arms[best]]
        _line(right, parts, f'{steps} steps ahead', number)
    right.set(title='by distance to the goal' + ('' if len(arms) == 1 else ', least error'))
    right.legend(frameon=False, fontsize=7)
    if 1 < len(arms) <= 12:
        left.legend(frameon=False, fontsize=6)
    for axes in (left, right):
        axes.set(xlabel='steps of test-time training K', ylabel='action error (rms)')
    return figure


def _line(axes: Axes, rows: list[dict[str, Any]], label: str, number: int) -> None:
    x = np.arange(len(rows))
    values = tuple(
        np.array([row['error'][key] for row in rows]) for key in ('mean', 'low', 'high')
    )
    draw_line(axes, x, values, label, number)
    axes.set_xticks(x, [str(row['budget']) for row in rows])
