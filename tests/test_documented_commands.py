"""Every command in the documentation runs to its end, on settings that take seconds.

`METAGCTTT_OVERRIDES=quick` makes them short. What cannot run here is listed with its reason.
"""

import os
from pathlib import Path
import re
import shlex
import shutil
import subprocess
from typing import Any

from markdown_it import MarkdownIt
from metagcttt_core.robot import load_contract
import numpy as np
import pytest

from tests.core.builders import DATA
from tests.programs import metagcttt
from tests.tools.robots.bags import turtlebot, write

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
DOCUMENTS = (
    'README.md',
    'CONTRIBUTING.md',
    'docs/guide.md',
    'docs/data.md',
    'docs/robot.md',
    'docs/faq.md',
    'docs/index.md',
)
PLAIN = r'metagcttt [\w .,:/=@+-]*'  # nothing that a shell would read otherwise
# What the documents take for granted: before their blocks, and before what prose names.
BEFORE_BLOCKS = {
    'README.md': ['metagcttt generate --kind stitch'],
}
BEFORE_PROSE = {
    'docs/faq.md': ['metagcttt generate --kind navigate', 'metagcttt pretrain'],
    'README.md': ['metagcttt meta-train --preset pointmaze-medium-navigate-cpu'],
    'docs/guide.md': [
        'metagcttt generate --kind navigate',
        'metagcttt pretrain',
        'metagcttt meta-train',
        *(f'metagcttt pretrain --out out/base-{seed} --seed {seed}' for seed in (0, 1)),
    ],
}
NOT_RUN = {
    r'make (demo|test|setup|assets|docs|release).*': 'tests of their own, or this very run',
    r'source .*': 'sets up a shell',
    r'\.venv/bin/python -m ruff format \.': 'changes the tree',
    r'tensorboard .*': 'a server',
    r'metagcttt (view|demo --view)': 'a server; tests/ros/live has it',
    r'metagcttt demo --robot .*': 'tests/tools/test_demo.py drives it',
    r'python3? -m (venv|colcon) .*': 'needs ROS 2 of the machine',
    r'(pip install .*workspace.*|cd ros2_ws.*)': 'needs ROS 2 of the machine',
    r"pip install -c constraints.txt '\.\[mazes,plots\]'": 'make wheel installs the package',
    r'pip install "metagcttt-core\[tables\]"': 'make wheel installs the package',
    r'metagcttt pretrain --agent huber .*': 'tests/test_examples.py installs the agent',
    r'ros2 (launch|topic|run) .*': 'needs ROS 2 of the machine',
    r'tools/ros2run .*': 'tests/ros/test_documentation.py runs them',
    r'metagcttt download .*': 'needs the network; tests/tools/test_download.py has a stand-in',
    r'np\.savez.*': 'is of the JAX program',
    r'python -m torch\.distributed\.run .*': 'tests/tools/common/test_session.py runs it',
    r'metagcttt (report|sweep|compare|evaluate-ros)( .*)?': 'tests/tools has them in small',
}


def commands_of(document: str) -> tuple[list[str], list[str]]:
    """The shell commands in the blocks of a document, and those of metagcttt in its prose."""
    blocks, prose = [], []
    for token in MarkdownIt('commonmark').enable('table').parse((ROOT / document).read_text()):
        if token.type == 'fence' and not token.info:
            lines = token.content.replace('\\\n', '').splitlines()
            blocks += [line.split('  #')[0].split('     #')[0].strip() for line in lines]
        for child in token.children or ():
            if child.type == 'code_inline' and child.content.startswith('metagcttt '):
                prose.append(' '.join(child.content.split()))
    return [line for line in blocks if line and line[0] != '#'], prose


def reason_not_to_run(command: str) -> str:
    return next((why for known, why in NOT_RUN.items() if re.fullmatch(known, command)), '')


@pytest.fixture
def workplace(tmp_path: Path) -> Path:
    """A folder with what a checkout has, in which commands may write."""
    for name in ('assets', 'config', 'tools', 'constraints.txt'):
        (tmp_path / name).symlink_to(ROOT / name)
    with np.load(DATA / 'nets_gciql_ant.npz') as arrays:  # stands for the JAX program's file
        params = {key.removeprefix('init.'): arrays[key] for key in arrays if 'init.' in key}
    np.savez(tmp_path / 'params.npz', **params)
    shutil.copytree(DATA / 'lerobot_pusht', tmp_path / 'pusht')
    drive = write(tmp_path / 'drive', several_drives())
    (tmp_path / 'drive.mcap').symlink_to(next(drive.glob('*.mcap')))
    (tmp_path / 'drive.csv').write_text(drive_csv(60))
    [columns] = re.findall(
        r'```yaml\n# columns.yaml\n(.*?)```', (ROOT / 'docs/data.md').read_text(), re.S
    )
    (tmp_path / 'columns.yaml').write_text(columns)
    return tmp_path


def several_drives() -> list[tuple[str, Any, int]]:
    """Of a TurtleBot: five seconds each, with a second of silence between them."""
    messages = turtlebot(600)
    return [m for m in messages if (m[2] - messages[0][2]) // 10**9 % 6 < 5]


def drive_csv(rows: int) -> str:
    """Twenty drives in circles of different sizes."""
    lines = ['run,t,x,y,heading,v,w']
    for run in range(20):
        for step in range(rows):
            angle, radius = 0.1 * step, 0.2 + 0.05 * run
            x, y = radius * np.sin(angle), radius * (1 - np.cos(angle))
            lines.append(
                f'{run},{0.1 * step:.1f},{x:.4f},{y:.4f},{angle:.4f},{radius / 5:.4f},1.0'
            )
    return '\n'.join(lines) + '\n'


def run(command: str, workplace: Path) -> None:
    environment = {
        **os.environ,
        'METAGCTTT_OVERRIDES': 'quick',
        'PATH': f'{ROOT / ".venv" / "bin"}:{os.environ["PATH"]}',
    }
    if re.fullmatch(PLAIN, command):
        ended = metagcttt(shlex.split(command)[1:], workplace, environment)
        status, output = ended.returncode, ended.output
    else:
        in_shell = ['bash', '-c', command]
        done = subprocess.run(
            in_shell, cwd=workplace, env=environment, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        status, output = done.returncode, done.stdout
    assert status == 0, f'{command}\n{output[-4000:]}'


@pytest.mark.parametrize('document', ('README.md', 'docs/extending.md'))
def test_every_python_block_runs(document: str, workplace: Path) -> None:
    tokens = MarkdownIt('commonmark').parse((ROOT / document).read_text())
    blocks = [token.content for token in tokens if token.info == 'python']
    assert blocks
    for number, block in enumerate(blocks):
        (workplace / f'block{number}.py').write_text(block)
        run(f'python block{number}.py', workplace)


def test_other_documents_have_no_python_block() -> None:
    """Those of ros2_ws/README.md need a graph, which tests/ros/test_documentation.py has.

    That of docs/robot.md needs a robot's graph; tests/ros has its calls.
    """
    with_blocks = ('README.md', 'docs/extending.md', 'docs/robot.md')
    for document in {*ROOT.glob('*.md'), *ROOT.glob('docs/*.md')} - {
        ROOT / n for n in with_blocks
    }:
        assert '```python' not in document.read_text(), document


def test_contract_of_the_page_is_one(tmp_path: Path) -> None:
    [text] = re.findall(r'```yaml\n(.*?)```', (ROOT / 'docs/robot.md').read_text(), re.S)
    (tmp_path / 'robot.yaml').write_text(text)
    contract = load_contract(tmp_path / 'robot.yaml')
    assert contract.columns == ['x', 'y', 'yaw.cos', 'yaw.sin']
    assert contract.goal.timeout_s == 60


@pytest.mark.timeout(600)
@pytest.mark.parametrize('document', DOCUMENTS)
def test_every_command_runs(document: str, workplace: Path) -> None:
    blocks, prose = commands_of(document)
    commands = [
        *BEFORE_BLOCKS.get(document, []),
        *(command for command in blocks if not reason_not_to_run(command)),
        *BEFORE_PROSE.get(document, []),
        *(command for command in prose if not reason_not_to_run(command)),
    ]
    for command in dict.fromkeys(commands):
        run(command, workplace)


def test_reasons_are_needed() -> None:
    """No reason outlives its command, and the programs that matter are among those that run."""
    shown = [command for name in DOCUMENTS for part in commands_of(name) for command in part]
    for known in NOT_RUN:
        assert any(re.fullmatch(known, command) for command in shown), known
    ran = {shlex.split(command)[1] for command in shown if not reason_not_to_run(command)}
    assert {'generate', 'pretrain', 'meta-train', 'evaluate', 'benchmark'} <= ran
