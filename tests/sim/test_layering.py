"""The simulators know nothing of ROS, of the tools, or of the method beyond its files."""

import ast
from pathlib import Path

import pytest
import sim_bridge

ROOT = Path(sim_bridge.__file__).parent
OF_THE_CORE = ('metagcttt_core.data', 'metagcttt_core.files')
FILES = sorted(ROOT.rglob('*.py'))


@pytest.mark.parametrize('file', FILES, ids=[str(file.relative_to(ROOT)) for file in FILES])
def test_imports_point_one_way(file: Path) -> None:
    for node in ast.walk(ast.parse(file.read_text(encoding='utf-8'))):
        if isinstance(node, ast.ImportFrom):
            names = [node.module or '']
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        for name in names:
            package = name.split('.')[0]
            assert package not in ('rclpy', 'metagcttt', 'metagcttt_interfaces', 'tools', 'torch')
            assert package != 'metagcttt_core' or name in (
                'metagcttt_core.data',
                'metagcttt_core.files',
            )
