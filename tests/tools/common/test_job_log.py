"""Finished jobs survive an interruption."""

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


def test_without_resume_it_starts_over(tmp_path):
    path = tmp_path / 'jobs.jsonl'
    JobLog(path, SETTINGS, resume=False).add(('base', 0), 0.25)
    assert JobLog(path, SETTINGS, resume=False).finished == {}


def test_other_settings_are_refused_by_name(tmp_path):
    path = tmp_path / 'jobs.jsonl'
    JobLog(path, SETTINGS, resume=False)
    with pytest.raises(ValueError, match='cannot resume, episodes was 10 and is now 50'):
        JobLog(path, {'decisive': {'episodes': 50, 'seeds': [0, 1]}}, resume=True)


def test_removed_when_the_results_are_kept_elsewhere(tmp_path):
    path = tmp_path / 'jobs.jsonl'
    log = JobLog(path, SETTINGS, resume=False)
    log.remove()
    assert not path.exists()
