"""The rooms of the house: imports point one way, by the contracts in pyproject.toml."""

import os
from pathlib import Path
import subprocess
import sys

ROOT = Path(__file__).parents[1]
# The sources, not what set-up installed.
SOURCES = (
    ROOT,
    ROOT / 'tools',
    ROOT / 'ros2_ws' / 'src' / 'metagcttt',
    ROOT / 'ros2_ws' / 'src' / 'metagcttt_robots',
)


def test_imports_between_rooms_point_one_way():
    result = subprocess.run(
        [sys.executable, '-c', 'from importlinter.cli import lint_imports_command as c; c()'],
        cwd=ROOT,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(map(str, SOURCES))},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stdout + result.stderr
