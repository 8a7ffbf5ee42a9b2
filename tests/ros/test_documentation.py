from collections import Counter
from collections.abc import Iterable
from pathlib import Path
import re
import subprocess
import sys

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


def test_readme_counts_the_fault_tests() -> None:
    folder = Path(__file__).parent
    files = sorted(folder.rglob('test_*faults.py'))
    command = [sys.executable, '-m', 'pytest', '-p', 'pytest_timeout', '--collect-only', '-q']
    listed = subprocess.run([*command, *files], capture_output=True, text=True, check=True).stdout
    found = Counter(re.findall(r'^(tests/ros/[\w/]+faults\.py)::', listed, re.MULTILINE))
    text = README.read_text(encoding='utf-8')
    stated = re.findall(r'^\| `(tests/ros/[\w/]+faults\.py)` \| (\d+) \|', text, re.MULTILINE)
    assert {file: int(count) for file, count in stated} == found
    assert len(found) == len(files) == 3
