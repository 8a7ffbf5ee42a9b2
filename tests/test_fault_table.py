"""The table of faults names tests that there are."""

from pathlib import Path
import re

import pytest

ROOT = Path(__file__).parents[1]
ROWS = [
    [cell.strip() for cell in line.strip('|').split(' | ')]
    for line in (ROOT / 'docs' / 'faults.md').read_text(encoding='utf-8').splitlines()
    if line.startswith('| ') and not line.startswith('| fault ')
]


@pytest.mark.parametrize('row', ROWS, ids=lambda row: row[0][:60])
def test_row_is_whole_and_its_tests_exist(row):
    assert len(row) == 4
    named = re.findall(r'`(tests/[\w/.]+)`', row[3])
    assert named
    for path in named:
        files = [ROOT / path, *(ROOT / path).glob('test_*.py')]
        assert any(file.is_file() and 'def test_' in file.read_text() for file in files), path


def test_table_is_there():
    assert len(ROWS) > 40
