"""Tables of the documentation say each thing once."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCUMENTS = [
    *ROOT.glob('*.md'),
    *(ROOT / 'docs').glob('**/*.md'),
    *(ROOT / 'ros2_ws').glob('*.md'),
]


def tables(document: Path) -> list[list[str]]:
    """The rows of each table, with its head and without the line below that."""
    found: list[list[str]] = [[]]
    for line in document.read_text(encoding='utf-8').splitlines():
        if not line.startswith('|'):
            found.append([])
        elif set(line) - set('|-: '):
            found[-1].append(line)
    return [table for table in found if table]


@pytest.mark.parametrize('document', DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_row_stands_twice(document):
    for rows in tables(document):
        assert len(set(rows)) == len(rows), [row for row in rows if rows.count(row) > 1]


def test_there_are_tables():
    assert sum(bool(tables(document)) for document in DOCUMENTS) > 5
