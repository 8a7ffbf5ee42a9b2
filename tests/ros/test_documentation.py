from collections.abc import Iterable
from pathlib import Path

from metagcttt.parameter_set import Parameter
from metagcttt.parameters import TABLES
import pytest

README = Path(__file__).parents[2] / 'ros2_ws' / 'README.md'


def parameter_table(table: Iterable[Parameter]) -> str:
    rows = ['| parameter | default | accepted | changes | meaning |', '|---|---|---|---|---|']
    for parameter in table:
        default = {True: 'true', False: 'false', '': "''"}.get(
            parameter.default if isinstance(parameter.default, bool | str) else None,
            f'{parameter.default}',
        )
        rows.append(
            f'| `{parameter.name}` | `{default}` | {parameter.accepted()} | {parameter.changes} '
            f'| {parameter.description} |'
        )
    return '\n'.join(rows)


@pytest.mark.parametrize('node', TABLES)
def test_readme_has_the_parameters_of_the_node(node: str) -> None:
    section = f'### {node}\n\n{parameter_table(TABLES[node])}\n'
    assert section in README.read_text(encoding='utf-8'), f'the section should be:\n{section}'
