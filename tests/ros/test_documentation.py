from collections import Counter
from collections.abc import Iterable
import os
from pathlib import Path
import re
import shlex
import signal
import subprocess
import sys
import time

from metagcttt.parameter_set import Parameter
from metagcttt.parameters import TABLES
import pytest

ROOT = Path(__file__).parents[2]
README = ROOT / 'ros2_ws' / 'README.md'


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


def commands_of_the_documents() -> list[str]:
    """What the READMEs say to start with tools/ros2run, and the programs for its recordings."""
    texts = [path.read_text(encoding='utf-8') for path in (README, ROOT / 'README.md')]
    lines = {line for text in texts for line in text.splitlines()}
    return sorted(line for line in lines if re.match(r'(tools/ros2run|metagcttt) ', line))


def python_blocks() -> list[str]:
    return re.findall(r'^```python\n(.*?)^```', README.read_text(encoding='utf-8'), re.M | re.S)


@pytest.mark.slow
def test_documented_nodes_record_what_documented_programs_read(
    ros_domain: int, tmp_path: Path
) -> None:
    for name in ('tools', 'assets', 'ros2_ws', '.venv'):
        (tmp_path / name).symlink_to(ROOT / name)
    environment = {
        **os.environ,
        'METAGCTTT_OVERRIDES': 'quick',
        'PATH': f'{ROOT / ".venv" / "bin"}:{os.environ["PATH"]}',
    }
    commands = commands_of_the_documents()
    nodes = [command for command in commands if command.startswith('tools/ros2run')]
    started = [
        subprocess.Popen(shlex.split(node), cwd=tmp_path, env=environment, stderr=subprocess.PIPE)
        for node in nodes
    ]
    try:
        deadline = time.monotonic() + 60
        while not (tmp_path / 'run.mcap').exists():  # it subscribes at once
            assert time.monotonic() < deadline
            time.sleep(0.05)
        for block, outcome in zip(python_blocks(), ('', 'True '), strict=True):
            driven = subprocess.run(
                [sys.executable, '-c', block], env=environment, capture_output=True, text=True
            )
            assert driven.returncode == 0, driven.stderr
            assert driven.stdout.startswith(outcome), driven.stdout + driven.stderr
        client = [sys.executable, str(ROOT / 'examples' / 'ros_client.py')]
        for goal, outcome in (('20', 'reached after '), ('-9', 'not reached: ')):
            driven = subprocess.run(
                [*client, goal, goal], env=environment, capture_output=True, text=True
            )
            assert driven.stdout.startswith(outcome), driven.stdout + driven.stderr
    finally:
        for process in started:
            process.send_signal(signal.SIGINT)
        ends = [process.communicate(timeout=60)[1].decode() for process in started]
    assert [process.returncode for process in started] == [0] * len(nodes), ends
    assert {
        'goal_node',
        'policy_node',
        'recorder_node',
        'sim_bridge_node',
        'visualization_node',
    } <= {node.split()[2] for node in nodes}
    for command in ('metagcttt import-recordings', 'metagcttt top-view'):
        (line,) = [shown for shown in commands if shown.startswith(command)]
        result = subprocess.run(
            shlex.split(line), cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert result.returncode == 0, result.stdout + result.stderr
