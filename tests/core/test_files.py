"""Files are whole: the old content or the new, never a part."""

import json

from metagcttt_core.files import atomic_write, claim_folder, remove_claimed, write_json
import pytest


def test_new_content_replaces_the_old(tmp_path):
    path = tmp_path / 'a' / 'file'
    for content in (b'one', b'two'):
        with atomic_write(path) as file:
            file.write(content)
        assert path.read_bytes() == content
    assert [entry.name for entry in path.parent.iterdir()] == ['file']
    assert path.stat().st_mode & 0o777 == 0o644


def test_old_content_stays_until_the_end(tmp_path):
    path = tmp_path / 'file'
    path.write_bytes(b'old')
    with atomic_write(path) as file:
        file.write(b'new')
        file.flush()
        assert path.read_bytes() == b'old'


def test_reader_of_the_old_content_is_not_disturbed(tmp_path):
    path = tmp_path / 'file'
    path.write_bytes(b'old')
    with path.open('rb') as reader:
        with atomic_write(path) as file:
            file.write(b'new')
        assert reader.read() == b'old'
    assert path.read_bytes() == b'new'


@pytest.mark.parametrize('error', [ValueError, KeyboardInterrupt, SystemExit])
def test_failing_block_leaves_the_old_content_and_nothing_else(error, tmp_path):
    path = tmp_path / 'file'
    path.write_bytes(b'old')
    with pytest.raises(error), atomic_write(path) as file:
        file.write(b'half')
        raise error
    assert path.read_bytes() == b'old'
    assert list(tmp_path.iterdir()) == [path]


def test_failing_block_makes_no_file(tmp_path):
    with pytest.raises(ValueError, match='no'), atomic_write(tmp_path / 'file'):
        raise ValueError('no')
    assert list(tmp_path.iterdir()) == []


def test_json_that_cannot_be_written_leaves_the_old(tmp_path):
    path = tmp_path / 'a' / 'file.json'
    write_json(path, {'one': [1, 2.5], 'two': None})
    assert json.loads(path.read_text()) == {'one': [1, 2.5], 'two': None}
    with pytest.raises(TypeError):
        write_json(path, {'one': object()})
    assert json.loads(path.read_text())['two'] is None


def test_claimed_folder_is_reopened_and_removed(tmp_path):
    folder = tmp_path / 'a' / 'ours'
    remove_claimed(folder)  # nothing there
    for _ in range(2):
        claim_folder(folder)
        (folder / 'content').write_text('ours')
    remove_claimed(folder)
    assert list(folder.parent.iterdir()) == []


def test_folder_of_somebody_else_is_neither_used_nor_removed(tmp_path):
    theirs = tmp_path / 'theirs'
    theirs.mkdir()
    (theirs / 'thesis').write_text('four years of work')
    claim_folder(tmp_path / 'ours')
    link, file = tmp_path / 'link', tmp_path / 'file'
    link.symlink_to(tmp_path / 'ours', target_is_directory=True)
    file.write_text('theirs too')
    for path in (theirs, link, file):
        for touch in (claim_folder, remove_claimed):
            with pytest.raises(FileExistsError, match=f'{path.name} exists and was not made by'):
                touch(path)
    assert (theirs / 'thesis').read_text() == 'four years of work'
    assert file.read_text() == 'theirs too'
    assert {path.name for path in tmp_path.iterdir()} == {'theirs', 'ours', 'link', 'file'}
