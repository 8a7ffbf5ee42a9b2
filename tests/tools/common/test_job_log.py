"""Finished jobs survive an interruption."""

import errno
import os

from metagcttt_tools.common.job_log import JobLog
import pytest

SETTINGS = {'decisive': {'episodes': 10, 'seeds': [0, 1]}, 'program': {'processes': 2}}


def test_finished_jobs_are_there_after_a_kill(tmp_path):
    path = tmp_path / 'runs' / 'jobs.jsonl'
    log = JobLog(path, SETTINGS, resume=True)
    log.add(('base', 0), 0.25)
    log.add(('base', 10), 0.75)
    with path.open('a') as file:
        file.write('{"job": ["ba')  # killed in the middle of a line
    again = JobLog(path, SETTINGS, resume=True)
    assert again.finished == {('base', 0): 0.25, ('base', 10): 0.75}
    again.add(('meta', 0), 1.0)
    assert JobLog(path, SETTINGS, resume=True).finished[('meta', 0)] == 1.0


def test_without_resume_nothing_finished_is_lost(tmp_path):
    path = tmp_path / 'jobs.jsonl'
    JobLog(path, SETTINGS, resume=False)  # which ended before its first job
    JobLog(path, SETTINGS, resume=False).add(('base', 0), 0.25)
    with pytest.raises(ValueError, match='holds what an interrupted call finished: pass --resume'):
        JobLog(path, SETTINGS, resume=False)
    assert JobLog(path, SETTINGS, resume=True).finished == {('base', 0): 0.25}


def test_a_full_disk_at_the_start_leaves_what_was_finished(tmp_path, monkeypatch):
    path = tmp_path / 'jobs.jsonl'
    JobLog(path, SETTINGS, resume=False).add(('base', 0), 0.25)

    def full(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch, pytest.raises(OSError, match=r'No space .*jobs\.jsonl'):
        patch.setattr(os, 'fsync', full)
        JobLog(path, SETTINGS, resume=True)
    assert JobLog(path, SETTINGS, resume=True).finished == {('base', 0): 0.25}


def test_other_settings_are_refused_by_name(tmp_path):
    path = tmp_path / 'jobs.jsonl'
    JobLog(path, SETTINGS, resume=False)
    with pytest.raises(ValueError, match='cannot resume, episodes was 10 and is now 50'):
        JobLog(path, {'decisive': {'episodes': 50, 'seeds': [0, 1]}}, resume=True)
