"""What holds of the paper: its tables and figures, what was run for each, and what that shows."""

from pathlib import Path
from typing import Annotated, Literal

from metagcttt_core.config import error_lines, Settings
from metagcttt_core.config.yaml_file import read_yaml
from pydantic import Field, TypeAdapter, ValidationError
import yaml

from metagcttt_tools.common.results import markdown_table

Verdict = Literal['holds', 'does not hold', 'not established', 'not tested']

_INTRODUCTION = """# What holds of the paper

Written by `metagcttt report --paper` from [paper.yaml](paper.yaml). A claim *holds* or *does not
hold* where all training seeds say so beyond a 95 percent interval or a factor; it is *not
established* where the interval holds both answers, or one seed was run. Nothing here is at the
paper's scale: 512 x 3 units, batches of 1024, 400,000 pre-training and 50,000 outer steps."""


class Claim(Settings):
    """A statement of the paper, and what the results say of it."""

    claim: str = Field(description='what the paper states')
    verdict: Verdict
    evidence: str = Field(description='the figures behind the verdict, or what is missing')


class Artefact(Settings):
    """A table, figure or appendix of the paper."""

    id: str = Field(pattern=r'^([TF]\d|[A-F])$')
    command: tuple[str, ...] = Field((), description='what makes the files')
    preset: str | None = Field(None, description='where the settings of the runs are')
    files: tuple[str, ...] = Field((), description='results, beside this list')
    seeds: int = Field(0, ge=0, description='training seeds')
    settings: dict[str, object] = Field({}, description='of the preset, by dotted name')
    scale: str = Field('', description="networks, batch and steps against the paper's")
    claims: Annotated[tuple[Claim, ...], Field(min_length=1)]


class Evidence(Settings):
    """The contents of paper.yaml."""

    artefacts: tuple[Artefact, ...]
    from_dirty_trees: tuple[str, ...] = Field(
        (), description='results of uncommitted code, to be made anew; no others may be'
    )
    other_rates: str = Field('', description='where the studies depart from Table 3')


def read_evidence(path: Path) -> Evidence:
    """The list of artefacts.

    Raises:
        ValueError: If the file is missing or malformed; names it.
    """
    try:
        return TypeAdapter(Evidence).validate_python(read_yaml(path)[1])
    except (FileNotFoundError, yaml.YAMLError) as error:
        raise ValueError(f'{path}: {error}') from error
    except ValidationError as error:
        raise ValueError(f'{path}: {"; ".join(error_lines(error))}') from error


def format_evidence(evidence: Evidence) -> str:
    """The page: a line for each claim, then the runs behind each artefact."""
    claims = [
        {
            '': artefact.id,
            'the paper says': claim.claim,
            'here it': claim.verdict,
            'because': claim.evidence,
        }
        for artefact in evidence.artefacts
        for claim in artefact.claims
    ]
    runs = [
        {
            '': artefact.id,
            'results': ', '.join(f'[{name}]({name})' for name in artefact.files),
            'seeds': artefact.seeds,
            'scale': artefact.scale,
            'commands': '; '.join(f'`{command}`' for command in artefact.command),
        }
        for artefact in evidence.artefacts
        if artefact.files
    ]
    parts = [
        *(_INTRODUCTION, markdown_table(claims)),
        *('## What was run', markdown_table(runs)),
        *('## Rates that differ from Table 3', evidence.other_rates.strip()),
    ]
    if evidence.from_dirty_trees:
        dirty = ', '.join(evidence.from_dirty_trees)
        parts += ['## To be made anew', f'From trees with uncommitted changes: {dirty}.']
    return '\n\n'.join(parts) + '\n'
