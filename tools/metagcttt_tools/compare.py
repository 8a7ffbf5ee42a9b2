"""One table and picture of evaluations: other agents, data or settings of test-time training."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from metagcttt_core import success_statistics
from metagcttt_core.config import Settings
from pydantic import Field

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.results import (
    beside,
    markdown_table,
    read_results,
    Results,
    success_cells,
    write_report,
)
from metagcttt_tools.common.resume import flat
from metagcttt_tools.common.session import sole_writer

_DESCRIPTION = """Compare evaluations in one table and picture.

Example: metagcttt compare --evaluations GCBC out/gcbc.json SAW out/saw.json --out out/agents
Takes the files of metagcttt evaluate, each under a name, and averages over the policies of a file,
which should be those of several training seeds. Prints the table, and in which settings the
evaluations differ; writes OUT.json and OUT.png."""

# Where and how it ran, and what the table shows by itself.
_NOT_COMPARED = ('out', 'checkpoints', 'processes', 'resume', 'budgets')


class CompareSettings(Settings):
    """Settings of the program."""

    evaluations: dict[str, Path] = Field({}, description='names, each with its file of results')
    policies: str = Field(
        '', description="only the policies with this in their checkpoint's path; all by default"
    )
    out: Path = Field(Path('out/comparison'), description='files to write')


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(CompareSettings, _DESCRIPTION, 'compare', argv)
    from metagcttt_tools.common.plots import save, success_curves

    if not settings.evaluations:
        fail('name evaluations to compare: --evaluations NAME FILE NAME FILE')
    try:
        files = {name: read_results(path) for name, path in settings.evaluations.items()}
        lines = {name: line(file, settings.policies) for name, file in files.items()}
    except ValueError as error:
        fail(str(error))
    record, picture = beside(settings.out, '.json'), beside(settings.out, '.png')
    apart = settings_apart({name: file.settings for name, file in files.items()})
    with sole_writer(record, record, picture):
        write_report(record, settings, {'lines': lines, 'settings_apart': apart})
        save(success_curves({'': lines}), picture)
    print(format_lines(lines))
    if apart:
        rows = [{'setting': setting, **values} for setting, values in apart.items()]
        print(f'\nThey differ in:\n\n{markdown_table(rows)}')
    print(f'results: {record}\npicture: {picture}')


def line(evaluation: Results, policies: str = '') -> dict[str, Any]:
    """Success by budget over the policies whose checkpoint's path contains `policies`.

    Returns:
        `checkpoints`, `budgets`, and for each budget `success`, `standard_error` and `per_policy`.

    Raises:
        ValueError: If there is no such policy, or they have other budgets than the first.
    """
    chosen = [result for result in evaluation.results if policies in result.checkpoint]
    if not chosen:
        known = ', '.join(result.checkpoint for result in evaluation.results)
        raise ValueError(f'no policy has {policies!r} in its path: {known or "the file has none"}')
    budgets = [point.budget for point in chosen[0].curve]
    for result in chosen:
        if (other := [point.budget for point in result.curve]) != budgets:
            raise ValueError(
                f'{result.checkpoint} has the budgets {other}, {chosen[0].checkpoint} {budgets}'
            )
    by_budget = zip(*(result.curve for result in chosen), strict=True)
    rates = [[point.success for point in points] for points in by_budget]
    statistics = [success_statistics(each) for each in rates]
    return {
        'checkpoints': [result.checkpoint for result in chosen],
        'budgets': budgets,
        'success': [point.mean for point in statistics],
        'standard_error': [point.standard_error for point in statistics],
        'per_policy': rates,
    }


def settings_apart(settings: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, str]]:
    """The settings in which evaluations differ, by dotted name, and their values by evaluation.

    One that a file lacks, for it is older than the setting, has no value and makes no difference.
    """
    each_flat = {name: flat(each) for name, each in settings.items()}
    names = dict.fromkeys(name for each in each_flat.values() for name in each)
    values = {
        name: {key: str(each.get(name, '')) for key, each in each_flat.items()}
        for name in names
        if name not in _NOT_COMPARED
    }
    return {name: each for name, each in values.items() if len(set(each.values()) - {''}) > 1}


def format_lines(lines: Mapping[str, Mapping[str, Any]]) -> str:
    """The table: mean over policies ± standard error, by budget."""
    budgets = sorted({budget for each in lines.values() for budget in each['budgets']})
    return markdown_table(
        [
            {
                'evaluation': name,
                'policies': len(each['checkpoints']),
                **{f'K = {budget}': '' for budget in budgets},
                **success_cells(each),
            }
            for name, each in lines.items()
        ]
    )
