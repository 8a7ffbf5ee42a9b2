"""Tables and figures of a study (paper, figures 3 to 5 and table 1)."""

from collections.abc import Sequence
from pathlib import Path
import shlex
from typing import Any

from metagcttt_core import normalized_auc, success_statistics
from metagcttt_core.config import Settings
from metagcttt_core.evaluation import (
    adaptation_efficiency,
    interquartile_mean,
    Interval,
    probability_of_improvement,
    stratified_bootstrap,
)
from metagcttt_core.files import read_json, write_json, write_text
import numpy as np
from pydantic import Field
import tyro

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.differences import differences
from metagcttt_tools.common.evidence import format_evidence, read_evidence
from metagcttt_tools.common.manifest import BASE, Evaluation, FILE, Manifest, Policy
from metagcttt_tools.common.results import (
    beside,
    markdown_table,
    Point,
    read_results,
    success_cells,
)
from metagcttt_tools.common.session import sole_writer

_DESCRIPTION = """Tables and figures of a study that metagcttt sweep ran.

Example: metagcttt report out/study --out docs/results/study
Prints the tables; writes OUT.json, OUT.md, OUT.png, interquartile means in OUT-iqm.png where
results tell tasks apart, and, with a curve, OUT-curve.png.
With --paper it rebuilds the page on the paper's claims, and tables and figures from the results it
names, in the folder OUT of paper.yaml."""

_DIFFERENCES = (
    'Mean difference over training seeds, each policy against the base policy it began as, ± half '
    "the 95 percent interval of Student's t; a star where that excludes 0. It knows no spread "
    'where all seeds differ equally. Without an interval there is one seed.'
)

_ROBUST = (
    'Interquartile mean over training seeds and tasks, with the 95 percent interval of a '
    'bootstrap that draws seeds within each task; P: how likely a seed of the arm does better on '
    'a task than one of the base policies, a draw counting half.'
)

Rates = dict[tuple[str, float], dict[int, dict[int, float]]]
"""Success by arm and fraction of the outer steps, then by training seed, then by budget."""

TaskRates = dict[str, dict[int, list[list[float]]]]
"""Success by arm, budget, training seed and task."""


class ReportSettings(Settings):
    """Settings of the program."""

    study: tyro.conf.Positional[Path] = Field(Path('out/study'), description='folder of the study')
    out: Path | None = Field(None, description='files to write; STUDY/report by default')
    paper: bool = Field(
        False, description='rebuild all that paper.yaml in OUT (docs/results) lists, from results'
    )
    threshold: float = Field(
        0.8, gt=0, le=1, description='success rate that adaptation efficiency counts steps to'
    )


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(ReportSettings, _DESCRIPTION, 'report', argv)
    try:
        if settings.paper:
            print(rebuild(settings.out or Path('docs/results')))
            return
        report = read_study(settings.study, settings.threshold)
    except ValueError as error:
        fail(str(error))
    out = settings.out or settings.study / 'report'
    record = beside(out, '.json')
    others = [beside(out, ending) for ending in ('.md', '.png', '-iqm.png', '-curve.png')]
    with sole_writer(record, record, *others):
        write_json(record, report)
        print(_write_tables_and_figures(report, out))


def rebuild(folder: Path) -> str:
    """Write tables and figures of all studies in paper.yaml, and the page, which is returned.

    Raises:
        ValueError: If paper.yaml or a result that it names is missing or malformed.
    """
    evidence = read_evidence(folder / 'paper.yaml')
    for name in sorted({name for artefact in evidence.artefacts for name in artefact.files}):
        results = read_json(folder / name) if name.endswith('.json') else {}
        if 'adaptations' in results:
            results['curve'] = {  # JSON has no numbers for names
                arm: {float(fraction): point for fraction, point in points.items()}
                for arm, points in results['curve'].items()
            }
            _write_tables_and_figures(results, folder / name.removesuffix('.json'))
    page = format_evidence(evidence)
    write_text(folder / 'paper.md', page)
    return page


def _write_tables_and_figures(report: dict[str, Any], out: Path) -> str:
    """Write OUT.md and the figures; returns the tables."""
    from metagcttt_tools.common.plots import (
        interquartile_picture,
        post_training_curves,
        save,
        success_curves,
    )

    text = format_report(report)
    write_text(beside(out, '.md'), text)
    save(success_curves(_panels(report['adaptations'])), beside(out, '.png'))
    robust = {
        name: arms
        for name, arms in report['adaptations'].items()
        if any('robust' in arm for arm in arms.values())
    }
    if robust:
        save(interquartile_picture(_panels(robust)), beside(out, '-iqm.png'))
    if report['curve']:
        save(post_training_curves(report['curve']), beside(out, '-curve.png'))
    return text


def _panels(adaptations: dict[str, Any]) -> dict[str, Any]:
    """One panel an adaptation, and another for its arms of fewer seeds."""
    panels = {}
    for name, arms in adaptations.items():
        most = max(len(arm['seeds']) for arm in arms.values())
        for title, enough in ((name, True), (f'{name}, fewer seeds', False)):
            chosen = {
                key: arm for key, arm in arms.items() if (len(arm['seeds']) == most) == enough
            }
            if chosen:
                panels[title] = chosen
    return panels


def read_study(folder: Path, threshold: float = 0.8) -> dict[str, Any]:
    """Read the results of a study.

    Args:
        folder: Folder of the study.
        threshold: Success rate that adaptation efficiency counts steps to.

    Returns:
        `study` (its settings and versions); `adaptations`: by name of the adaptation and arm the
        `budgets`, `success` (per budget), `standard_error`, `per_seed` (per budget and seed),
        `auc`, `auc_error`, `auc_per_seed` and `efficiency`, against the base policies of the same
        seeds, and, where results tell tasks apart, `robust`, the interquartile mean and the
        probability of improvement by budget, each with its interval; `curve`: by arm, the same by
        fraction of the outer steps, from 0, the base policy, to that of the evaluated one.

    Raises:
        ValueError: If the folder holds no finished study; names the file that is missing.
    """
    manifest = Manifest.read(folder)
    adaptations = {}
    evaluated: dict[str, float] = {}  # after which fraction of the outer steps
    for name, evaluation in manifest.adaptations.items():
        rates = _rates(folder, evaluation)
        evaluated |= dict(rates.keys())
        arms = {arm: _summary(seeds) for (arm, _), seeds in rates.items()}
        for trained, robust in robust_figures(_task_rates(folder, evaluation)).items():
            arms[trained]['robust'] = robust
        for arm in arms.values():
            base = _summary({seed: rates[BASE, 0.0][seed] for seed in arm['seeds']})
            efficiency = adaptation_efficiency(_by_budget(base), _by_budget(arm), threshold)
            arm['efficiency'] = _finite(efficiency)
        adaptations[name] = arms
    curve: dict[str, dict[float, Any]] = {}
    if manifest.curve is not None:
        final = next(iter(adaptations.values()))
        curve = _curve(_rates(folder, manifest.curve), final, evaluated)
    study = manifest.model_dump(mode='json', include={'settings', 'commit', 'versions'})
    return {'study': study, 'threshold': threshold, 'adaptations': adaptations, 'curve': curve}


def _curve(rates: Rates, final: dict[str, Any], evaluated: dict[str, float]) -> dict[str, Any]:
    """Success by arm and fraction of the outer steps, from the base to the evaluated policy."""
    budgets = list(next(iter(next(iter(rates.values())).values())))
    curve: dict[str, dict[float, Any]] = {}
    for (arm, fraction), seeds in rates.items():
        curve.setdefault(arm, {0.0: _restrict(final[BASE], budgets)})[fraction] = _summary(seeds)
    for arm, points in curve.items():
        points[evaluated[arm]] = _restrict(final[arm], budgets)
    return {arm: dict(sorted(points.items())) for arm, points in curve.items()}


def _restrict(summary: dict[str, Any], budgets: list[int]) -> dict[str, Any]:
    chosen = [summary['budgets'].index(budget) for budget in budgets]
    return {
        name: [summary[name][index] for index in chosen]
        for name in ('budgets', 'success', 'standard_error')
    }


def _rates(folder: Path, evaluation: Evaluation) -> Rates:
    """The success rates in the file of an evaluation."""
    rates: Rates = {}
    for policy, curve in _curves(folder, evaluation):
        points = {point.budget: point.success for point in curve}
        rates.setdefault((policy.arm, policy.fraction), {})[policy.seed] = points
    return rates


def _task_rates(folder: Path, evaluation: Evaluation) -> TaskRates:
    """The success rates of each task in the file of an evaluation, where it has them."""
    rates: TaskRates = {}
    for policy, curve in _curves(folder, evaluation):
        for point in curve:
            if point.per_task:
                of_arm = rates.setdefault(policy.arm, {}).setdefault(point.budget, [])
                of_arm.append(list(point.per_task.values()))
    return rates


def _curves(folder: Path, evaluation: Evaluation) -> list[tuple[Policy, Sequence[Point]]]:
    """Each policy of an evaluation with its results."""
    path = folder / evaluation.file
    try:
        results = read_results(path).results
    except FileNotFoundError as error:
        raise ValueError(f'{path} does not exist: run metagcttt sweep to its end first') from error
    if len(results) != len(evaluation.policies):
        raise ValueError(
            f'{path}: holds results of {len(results)} policies, '
            f'{FILE} lists {len(evaluation.policies)}'
        )
    return [(p, r.curve) for p, r in zip(evaluation.policies, results, strict=True)]


def robust_figures(rates: TaskRates) -> dict[str, dict[str, list[Interval]]]:
    """Interquartile means by arm and budget, and probabilities of improvement over the base."""
    found: dict[str, dict[str, list[Interval]]] = {}
    for arm, by_budget in rates.items():
        scores = {budget: np.array(seeds) for budget, seeds in by_budget.items()}
        found[arm] = {
            'interquartile_mean': [
                stratified_bootstrap(interquartile_mean, each) for each in scores.values()
            ]
        }
        if arm != BASE:
            found[arm]['improvement'] = [
                stratified_bootstrap(
                    probability_of_improvement, each, np.array(rates[BASE][budget])
                )
                for budget, each in scores.items()
            ]
    return found


def _summary(seeds: dict[int, dict[int, float]]) -> dict[str, Any]:
    budgets = list(next(iter(seeds.values())))
    per_seed = np.array([[points[budget] for budget in budgets] for points in seeds.values()])
    statistics = [success_statistics(column) for column in per_seed.T]
    aucs = [normalized_auc(budgets, row) for row in per_seed] if len(budgets) > 1 else []
    auc = success_statistics(aucs) if aucs else None
    return {
        'seeds': list(seeds),
        'budgets': budgets,
        'success': [point.mean for point in statistics],
        'standard_error': [point.standard_error for point in statistics],
        'per_seed': per_seed.T.tolist(),
        'auc': auc and auc.mean,
        'auc_error': auc and auc.standard_error,
        'auc_per_seed': aucs,
    }


def _by_budget(summary: dict[str, Any]) -> dict[int, float]:
    return dict(zip(summary['budgets'], summary['success'], strict=True))


def _finite(ratio: float | str | None) -> float | str | None:
    """JSON knows no infinity: a method that needs no step at all says so in words."""
    return 'no step needed' if ratio == float('inf') else ratio


def format_report(report: dict[str, Any]) -> str:
    """The tables as Markdown, with the commands that made them."""
    settings = report['study']['settings']
    command = f'metagcttt report {shlex.quote(settings["out"])}'
    if report['threshold'] != ReportSettings().threshold:
        command += f' --threshold {report["threshold"]:g}'
    parts = [
        'Success: mean over training seeds ± standard error.',
        f'```\nmetagcttt sweep --preset {settings["base"]}\n{command}\n```',
    ]
    for name, arms in report['adaptations'].items():
        parts += [f'## Success by steps of test-time training ({name})', _success_table(arms)]
        parts[-1] += (
            f'\n\nEfficiency: smallest K with success >= {report["threshold"]:g}, '
            f'that of the base policies of the same seeds over that of the arm.'
        )
        if len(arms) > 1:
            parts += [f'## Against the base policies ({name})', _DIFFERENCES]
            parts.append(_difference_table(arms, report['threshold']))
        if any('robust' in arm for arm in arms.values()):
            parts += [f'## Interquartile means ({name})', _ROBUST, _robust_table(arms)]
    if report['curve']:
        parts += ['## Success over post-training', _curve_table(report['curve'])]
    return '\n\n'.join(parts) + '\n'


def _success_table(arms: dict[str, Any]) -> str:
    rows = []
    for name, arm in arms.items():
        rows.append(
            {
                'policy': name,
                'seeds': len(arm['seeds']),
                **success_cells(arm),
                'AUC': '' if arm['auc'] is None else f'{arm["auc"]:.3f} ± {arm["auc_error"]:.3f}',
                'AUC by seed': ', '.join(f'{value:.3f}' for value in arm['auc_per_seed']),
                'efficiency': _ratio(arm['efficiency']),
            }
        )
    return markdown_table(rows)


def _ratio(efficiency: float | str | None) -> str:
    ratio = _finite(efficiency)
    return f'{ratio:g}x' if isinstance(ratio, float) else ratio or '-'


def _difference_table(arms: dict[str, Any], threshold: float) -> str:
    rows = []
    for name, arm in arms.items():
        if name != BASE:
            found, efficiency = differences(arms[BASE], arm, threshold)
            rows.append(
                {
                    'policy': name,
                    'seeds': len(arm['seeds']),
                    **{figure: str(difference) for figure, difference in found.items()},
                    'efficiency by seed': ', '.join(map(_ratio, efficiency)),
                }
            )
    return markdown_table(rows)


def _robust_table(arms: dict[str, Any]) -> str:
    def cell(figures: dict[str, Any], index: int) -> str:
        mean, low, high = figures['interquartile_mean'][index]
        text = f'{mean:.2f} [{low:.2f}, {high:.2f}]'
        if 'improvement' in figures:
            probability, low, high = figures['improvement'][index]
            text += f', P {probability:.2f} [{low:.2f}, {high:.2f}]'
        return text

    return markdown_table(
        [
            {
                'policy': name,
                'seeds': len(arm['seeds']),
                **{f'K = {k}': cell(arm['robust'], i) for i, k in enumerate(arm['budgets'])},
            }
            for name, arm in arms.items()
            if 'robust' in arm
        ]
    )


def _curve_table(curve: dict[str, Any]) -> str:
    return markdown_table(
        [
            {'policy': arm, 'outer steps': f'{fraction:.0%}', **success_cells(point)}
            for arm, points in curve.items()
            for fraction, point in points.items()
        ]
    )
