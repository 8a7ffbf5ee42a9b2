"""Jobs on this machine: begun again when they are lost, stopped when they should be."""

import _thread
from concurrent.futures import Future
from pathlib import Path
import signal
import sys
import threading
import time

from metagcttt_tools.common.stopping import Stop
from metagcttt_tools.jobs import program
from metagcttt_tools.jobs.program import Invocation, JobError, JobStoppedError, run_program
from metagcttt_tools.jobs.scheduler import Job, LocalScheduler, run_all
import pytest

ONCE = 'import os, pathlib, signal, sys; again = pathlib.Path({!r}); first = not again.exists(); '
ONCE += 'again.touch(); '


@pytest.fixture
def job(tmp_path, monkeypatch):
    """A job that runs a line of Python."""

    def made(line, name='job', cpus=1):
        commands[name] = [sys.executable, '-c', ONCE.format(str(tmp_path / f'{name}.ran')) + line]
        invocation = Invocation(name, Path(f'{name}.yaml'), Path(name), tmp_path)
        return Job(invocation, 1, lambda: 0, cpus)

    commands = {}
    monkeypatch.setattr(Invocation, 'command', property(lambda self: commands[self.program]))
    return made


@pytest.mark.parametrize('end', ['os.kill(os.getpid(), signal.SIGKILL)', 'sys.exit(75)'])
def test_a_job_that_is_killed_or_preempted_begins_again(job, end, tmp_path):
    run_all('jobs', [job(f'first and {end}')], LocalScheduler(1, retries=1), Stop())
    assert (tmp_path / 'job.log').read_text().count('# ') == 2
    with pytest.raises(JobError, match='for the last of 2 times'):
        run_all('jobs', [job(end)], LocalScheduler(1, retries=1), Stop())


def test_a_job_that_fails_ends_all_with_its_last_line(job, tmp_path):
    fails = job('sys.exit("no such dataset")', 'fails')
    waits = job('signal.signal(15, lambda *_: sys.exit(75)); signal.pause()', 'waits')
    with pytest.raises(JobError, match='ended with status 1: no such dataset'):
        run_all('jobs', [waits, fails], LocalScheduler(2, retries=5), Stop())
    assert (tmp_path / 'fails.log').read_text().count('# ') == 1


def test_stop_makes_jobs_save_and_starts_no_more(job, tmp_path):
    saves = 'signal.signal(15, lambda *_: (pathlib.Path("saved").touch(), sys.exit(75))); '
    first = job(f'{saves} pathlib.Path("runs").touch(); signal.pause()', 'first')
    second = job('pass', 'second')
    stop = Stop()

    def stop_once_it_runs():
        while not (tmp_path / 'runs').exists():
            pass
        stop.set()

    threading.Thread(target=stop_once_it_runs).start()
    with pytest.raises(KeyboardInterrupt):
        run_all('jobs', [first, second], LocalScheduler(1, retries=5), stop)
    assert (tmp_path / 'saved').exists()
    assert not (tmp_path / 'second.ran').exists()


def test_a_job_that_somebody_else_stopped_is_not_taken_for_done(job):
    class Cancelled(LocalScheduler):
        def submit(self, job):
            future = Future()
            future.set_exception(JobStoppedError(job.invocation.program))
            return future

    with pytest.raises(JobStoppedError):
        run_all('jobs', [job('pass')], Cancelled(1, retries=0), Stop())


def test_further_interrupts_do_not_cut_saving_short(job, tmp_path):
    saves = 'signal.signal(15, lambda *_: (time.sleep(1), pathlib.Path("saved").touch())); '
    stopped = job(f'import time; {saves} pathlib.Path("runs").touch(); signal.pause()')

    def interrupt():
        while not (tmp_path / 'runs').exists():
            time.sleep(0.01)
        for _ in range(3):
            _thread.interrupt_main()
            time.sleep(0.2)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        threading.Thread(target=interrupt).start()
        with pytest.raises(JobStoppedError):
            run_program(stopped.invocation)
    finally:
        signal.signal(signal.SIGINT, before)
    assert (tmp_path / 'saved').exists()


def test_jobs_at_the_same_time_fit_the_cores(job):
    exclusive = 'pathlib.Path("busy").touch(exist_ok=False); import time; time.sleep(0.2); '
    exclusive += 'pathlib.Path("busy").unlink()'
    jobs = [job(exclusive, f'wide-{number}', cpus=4) for number in range(2)]
    run_all('jobs', jobs, LocalScheduler(2, retries=0), Stop())


def test_an_attempt_awaits_the_end_of_the_one_before(job, tmp_path, monkeypatch):
    monkeypatch.setattr(program, '_LOCK_TIMEOUT_S', 0.2)
    with (
        program.FileLock(program.lock_of(tmp_path / 'job')),
        pytest.raises(JobError, match=r'\.job\.lock: is held by another process'),
    ):
        run_all('jobs', [job('pass')], LocalScheduler(1, retries=0), Stop())
