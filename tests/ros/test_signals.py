"""Ctrl-C and SIGTERM while a node starts. Each test ends long before what it interrupts would."""

from collections.abc import Callable, Iterator
import os
import signal
import subprocess
import sys

import pytest

IMPORTING = """
import time
from metagcttt.signals import stop_on_signals
stop_on_signals()
print('now', flush=True)
time.sleep(600)  # stands for an import that takes long
"""
MAKING_THE_NODE = """
import time
from metagcttt.running import run
from metagcttt.signals import stop_on_signals
from rclpy.node import Node

class SlowNode(Node):
    def __init__(self):
        super().__init__('slow_node')
        print('now', flush=True)
        time.sleep(600)  # stands for the loading of a policy

raise SystemExit(run(SlowNode, stop_on_signals()))
"""
SWALLOWED = """
import os, signal
from metagcttt.running import run
from metagcttt.signals import stop_on_signals
from rclpy.node import Node

class DeafNode(Node):
    def __init__(self):
        super().__init__('deaf_node')
        try:
            signal.raise_signal(signal.SIGTERM)
        except BaseException:
            print('now', flush=True)

raise SystemExit(run(DeafNode, stop_on_signals()))
"""
REPLACED = """
import signal, sys
from metagcttt import main

class Compiled:
    def find_spec(self, name, path, target=None):
        if name == 'metagcttt.goal.node':
            try:
                signal.raise_signal(signal.SIGTERM)
            except SystemExit:
                print('now', flush=True)
                raise ImportError('initialization failed')

sys.meta_path.insert(0, Compiled())
raise SystemExit(main.goal_node())
"""


@pytest.fixture
def start(ros_domain: int) -> Iterator[Callable[[str], subprocess.Popen]]:
    """Runs a program until it says that it has come to where a signal is to strike."""
    processes = []

    def start(program: str) -> subprocess.Popen:
        process = subprocess.Popen(
            [sys.executable, '-c', program],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        processes.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == 'now\n', process.communicate()
        return process

    yield start
    for process in processes:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM], ids=['ctrl-c', 'sigterm'])
@pytest.mark.parametrize('program', [IMPORTING, MAKING_THE_NODE], ids=['importing', 'making'])
def test_signal_ends_the_start_at_once(start, program: str, number: int) -> None:
    process = start(program)
    os.killpg(process.pid, number)
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, '')


@pytest.mark.parametrize('program', [SWALLOWED, REPLACED], ids=['swallowed', 'replaced'])
def test_signal_that_somebody_took_for_an_error_ends_the_node(start, program: str) -> None:
    process = start(program)
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, '')


@pytest.mark.parametrize('module', ['goal.node', 'recorder.node', 'sim.node', 'commander'])
def test_what_computes_nothing_with_weights_starts_without_pytorch(module: str) -> None:
    program = f'import sys, metagcttt.{module}; raise SystemExit("torch" in sys.modules)'
    assert subprocess.run([sys.executable, '-c', program]).returncode == 0
