import ast
from collections.abc import Iterator
from pathlib import Path
import sys
import tomllib
from xml.etree import ElementTree

import pytest

SOURCES = Path(__file__).parents[2] / 'ros2_ws' / 'src'
ROOT = SOURCES.parents[1]
# Not ROS packages; ros2_ws/README.md says how Python gets them.
FROM_PIP = {'mcap', 'metagcttt_core', 'pydantic', 'sim_bridge', 'torch'}
KEYS = {'numpy': 'python3-numpy', 'yaml': 'python3-yaml'}


def manifest(package: str) -> ElementTree.Element:
    return ElementTree.parse(SOURCES / package / 'package.xml').getroot()


def imports(folder: Path) -> Iterator[str]:
    """Top-level names of the modules that the files of a folder import."""
    for file in folder.rglob('*.py'):
        for node in ast.walk(ast.parse(file.read_text(encoding='utf-8'))):
            if isinstance(node, ast.Import):
                yield from (alias.name.split('.')[0] for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0
                yield str(node.module).split('.')[0]


@pytest.mark.parametrize('package', ['metagcttt', 'metagcttt_interfaces', 'metagcttt_robots'])
def test_version_is_the_project_s(package: str) -> None:
    project = tomllib.loads((ROOT / 'pyproject.toml').read_text())['project']
    assert manifest(package).findtext('version') == project['version']


@pytest.mark.parametrize('package', ['metagcttt', 'metagcttt_robots'])
def test_setup_py_has_the_version_of_the_manifest(package: str) -> None:
    version = manifest(package).findtext('version')
    assert f"version='{version}'" in (SOURCES / package / 'setup.py').read_text()


def test_manifest_of_the_robots_names_every_import() -> None:
    imported = set(imports(SOURCES / 'metagcttt_robots' / 'metagcttt_robots'))
    needed = imported - set(sys.stdlib_module_names) - {'metagcttt_robots', 'mujoco'}
    named = {element.text for element in manifest('metagcttt_robots').iter('exec_depend')}
    assert {KEYS.get(name, name) for name in needed} == named


def test_manifest_names_every_import() -> None:
    package = SOURCES / 'metagcttt'
    imported = {*imports(package / 'metagcttt'), *imports(package / 'launch')}
    needed = imported - set(sys.stdlib_module_names) - FROM_PIP - {'metagcttt'}
    named = {element.text for element in manifest('metagcttt').iter('exec_depend')}
    assert {KEYS.get(name, name) for name in needed} <= named
    # The lifecycle's messages are only used by those who drive it, through rclpy.
    assert named - {KEYS.get(name, name) for name in needed} <= {'lifecycle_msgs'}


def test_every_field_of_every_message_is_explained() -> None:
    files = [file for kind in ('msg', 'srv', 'action') for file in SOURCES.glob(f'*/{kind}/*.*')]
    assert len(files) >= 8
    bare = [
        f'{file.name}: {line}'
        for file in files
        for line in file.read_text().splitlines()
        if line and not line.startswith(('#', '---')) and '# ' not in line
    ]
    assert bare == []
