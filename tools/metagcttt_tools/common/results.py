"""Results of programs: Markdown tables and JSON reports."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
import os
from pathlib import Path
import platform
from typing import Annotated, Any

from metagcttt_core.config import error_lines, Settings
from metagcttt_core.files import read_json, refuse_foreign, write_json
from pydantic import BaseModel, Field, ValidationError

from metagcttt_tools.common.session import provenance


class Point(BaseModel):
    """Success with one budget, in a file of results."""

    budget: int = Field(ge=0)
    success: float = Field(ge=0, le=1, allow_inf_nan=False)
    per_task: dict[str, Annotated[float, Field(ge=0, le=1)]] = {}


class PolicyResult(BaseModel):
    """Success of one policy, in a file of results."""

    checkpoint: str = ''
    curve: Annotated[tuple[Point, ...], Field(min_length=1)]


class Results(BaseModel):
    """What is read again of the file that `metagcttt evaluate` writes."""

    settings: dict[str, Any] = {}
    results: tuple[PolicyResult, ...]


class Benchmark(Settings, ABC):
    """Settings of a benchmark."""

    @abstractmethod
    def run(self) -> None:
        """Measure, print a table and write JSON."""


def read_results(path: Path) -> Results:
    """The results in a file of `metagcttt evaluate`.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If it is malformed; names the file and what is wrong.
    """
    try:
        return Results.model_validate(read_json(path))
    except ValidationError as error:
        raise ValueError(f'{path}: {"; ".join(error_lines(error))}') from error


def success_cells(summary: Mapping[str, Any]) -> dict[str, str]:
    """Success by budget as cells of a table; of a summary with `budgets` and their figures."""
    rates = zip(summary['budgets'], summary['success'], summary['standard_error'], strict=True)
    return {f'K = {budget}': f'{mean:.2f} ± {error:.2f}' for budget, mean, error in rates}


def beside(out: Path, ending: str) -> Path:
    """The file of that ending beside a place that is named without one, or with .json."""
    return out.with_name(out.name.removesuffix('.json') + ending)


def markdown_table(rows: list[dict[str, Any]]) -> str:
    """Rows of equal keys as a Markdown table; numbers with three significant digits."""
    from tabulate import tabulate

    def cell(value: Any) -> str:
        if isinstance(value, float):
            return f'{value:.3g}' if abs(value) < 1000 else f'{value:,.0f}'
        return f'{value:,}' if isinstance(value, int) else str(value)

    cells = [{name: cell(value) for name, value in row.items()} for row in rows]
    return tabulate(cells, headers='keys', tablefmt='github', disable_numparse=True)


def start_column(standing: bool) -> dict[str, str]:
    """The column of a table that names a start which is not OGBench's; else none."""
    return {'start': 'standing'} if standing else {}


def write_report(
    path: Path,
    settings: Settings,
    results: dict[str, Any],
    fingerprints: dict[str, Any] | None = None,
) -> None:
    """Results as JSON, with settings, commit, versions, machine and hashes of what they are of.

    Raises:
        FileExistsError: If the file is there and was not made by a program of ours.
    """
    refuse_foreign(path)
    report = {
        'settings': settings.model_dump(mode='json'),
        **provenance(),
        'machine': {'processor': platform.machine(), 'cores': os.cpu_count()},
        **({'fingerprints': fingerprints} if fingerprints else {}),
        'results': results,
    }
    write_json(path, report)
