"""Files are whole: the old content or the new, never a part."""

import errno
import json
import os
from pathlib import Path

from metagcttt_core.files import (
    atomic_write,
    claim_folder,
    not_through_links,
    open_log,
    PICTURE_MARK,
    read_with_weights,
    refuse_foreign,
    remove_claimed,
    weights_name,
    write_json,
    write_text,
    write_with_weights,
)
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


def test_a_link_is_neither_followed_nor_replaced(tmp_path):
    link, theirs = tmp_path / 'link.json', tmp_path / 'theirs.json'
    theirs.write_text('{}')
    link.symlink_to(theirs)
    with pytest.raises(FileExistsError, match=r'link\.json is a symbolic link'):
        write_json(link, {'ours': 1})
    with pytest.raises(OSError, match=r'link\.json'), open(link, 'w', opener=not_through_links):
        raise AssertionError('was opened')
    assert (link.readlink(), theirs.read_text()) == (theirs, '{}')


def test_a_full_disk_is_an_error_that_names_the_file(tmp_path):
    with pytest.raises(OSError, match=r"No space left on device: '.*file'"):
        with atomic_write(tmp_path / 'file'):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    'content',
    ['{}', '[1]', 'four years of work', '{"settings": {"colour": "red"}}', '{"study": 1}'],
)
def test_results_of_somebody_else_are_kept(content, tmp_path):
    record, table = tmp_path / 'run.json', tmp_path / 'run.md'
    refuse_foreign(record, table)  # nothing there
    record.write_text(content)
    with pytest.raises(FileExistsError, match=r'run\.json exists and was not made by metagcttt'):
        refuse_foreign(record, table)
    record.unlink()
    table.write_text(content)
    with pytest.raises(FileExistsError, match=r'run\.md exists and was not made by metagcttt'):
        refuse_foreign(record, table)


@pytest.mark.parametrize('depth', [lambda made: made, lambda made: {'study': made}])
def test_results_of_ours_are_known_by_their_record(depth, tmp_path):
    record, table, link = tmp_path / 'run.json', tmp_path / 'run.md', tmp_path / 'link.md'
    write_json(record, depth({'commit': 'abc', 'versions': {}, 'more': 1}))
    table.write_text('| success |')
    refuse_foreign(record, table)
    link.symlink_to(table)
    with pytest.raises(FileExistsError, match=r'link\.md exists'):
        refuse_foreign(record, link)


def test_a_picture_is_known_by_its_mark(tmp_path):
    picture = tmp_path / 'run.png'
    picture.write_bytes(b'holiday')
    with pytest.raises(FileExistsError, match=r'run\.png exists'):
        refuse_foreign(picture)
    picture.write_bytes(PICTURE_MARK.encode())
    refuse_foreign(picture)


def test_old_weights_and_parts_are_removed_but_nothing_of_somebody_else(tmp_path):
    index = tmp_path / 'run' / 'index.json'
    write_with_weights(index, {'weights': weights_name(b'old')}, b'old')
    theirs = index.parent / f'weights-{"0" * 16}.safetensors'  # no hash of its content
    folder = index.parent / f'weights-{"1" * 16}.safetensors'
    link, elsewhere = index.parent / weights_name(b'linked'), tmp_path / 'elsewhere'
    theirs.write_text('four years of work')
    folder.mkdir()
    elsewhere.write_bytes(b'linked')
    link.symlink_to(elsewhere)
    for left in (f'.{weights_name(b"killed")}.ab12cd34', '.index.json.ab12cd34'):
        (index.parent / left).write_text('{"cut')
    write_with_weights(index, {'weights': weights_name(b'new')}, b'new')
    kept = {index.name, weights_name(b'new'), theirs.name, folder.name, link.name}
    assert {path.name for path in index.parent.iterdir()} == kept
    assert theirs.read_text() == 'four years of work'
    assert elsewhere.read_bytes() == b'linked'


def test_weights_are_those_of_the_index_while_another_pair_takes_its_place(tmp_path):
    (tmp_path / 'new').write_bytes(b'new')
    indices = iter(['old', 'new', 'new'])
    assert read_with_weights(lambda: next(indices), tmp_path.joinpath) == ('new', b'new')
    with pytest.raises(FileNotFoundError, match='old'):
        read_with_weights(lambda: 'old', tmp_path.joinpath)


@pytest.mark.parametrize('anew', [False, True])
def test_log_is_opened_again_but_no_file_of_somebody_else(anew, tmp_path):
    log, link = tmp_path / 'logs' / 'node.log', tmp_path / 'link.log'
    for line in (b'first\n', b'second\n'):
        with open_log(log, 'goal_node', anew=anew) as file:
            file.write(line)
    text = log.read_text()
    assert text.startswith('# ')
    assert text.count(': metagcttt goal_node\n') == (1 if anew else 2)
    assert ('first\n' in text, text.endswith('second\n')) == (not anew, True)
    link.symlink_to(log)
    with pytest.raises(FileExistsError, match=r'link\.log is a symbolic link'):
        open_log(link, 'goal_node', anew=anew)
    log.write_text('# Four years of work')
    with pytest.raises(FileExistsError, match=r'node\.log exists and was not made by metagcttt'):
        open_log(log, 'goal_node', anew=anew)
    assert log.read_text() == '# Four years of work'


@pytest.mark.parametrize('make', [Path.mkdir, os.mkfifo])
def test_what_is_no_file_is_not_replaced(make, tmp_path):
    path = tmp_path / 'results.json'
    make(path)
    with pytest.raises(FileExistsError, match=r'results\.json exists and is no file'):
        write_text(path, 'new')
    assert not path.is_file()
    assert list(tmp_path.iterdir()) == [path]
