import os
import subprocess

from metagcttt_tools.benchmarks.cluster import parent_of
import pytest


def test_parent_is_the_process_that_started_it() -> None:
    with subprocess.Popen(['sleep', '60']) as process:
        try:
            assert parent_of(process.pid) == os.getpid()
        finally:
            process.kill()


def test_process_without_a_parent_is_refused_before_anything_is_killed() -> None:
    with pytest.raises(RuntimeError, match='process 1 has lost the process that started it'):
        parent_of(1)
