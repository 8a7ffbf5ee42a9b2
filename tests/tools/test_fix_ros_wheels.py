from pathlib import Path

from fix_ros_wheels import fix_prefix, fix_text
import pytest

NUMPY = '/venv/numpy/_core/include'
PYTHON = '/usr/include/python3.11'


@pytest.mark.parametrize(
    ('text', 'fixed'),
    [
        (
            'INCLUDES "/opt/python/cp311-cp311/lib/python3.11/site-packages/numpy/_core/include"',
            f'INCLUDES "{NUMPY}"',
        ),
        ('DIRS "/opt/python/cp313-cp313/include/python3.13"', f'DIRS "{PYTHON}"'),
        (
            '/opt/python/cp312-cp312/include/python3.12;/opt/python/cp312-cp312/lib/python3.12/'
            'site-packages/numpy/_core/include;${_IMPORT_PREFIX}/include',
            f'{PYTHON};{NUMPY};${{_IMPORT_PREFIX}}/include',
        ),
        ('/usr/include/python3.12', '/usr/include/python3.12'),
    ],
)
def test_folders_of_the_build_container_are_replaced(text: str, fixed: str) -> None:
    assert fix_text(text, NUMPY, PYTHON) == fixed


def test_only_cmake_exports_change_and_only_once(tmp_path: Path) -> None:
    text = '/opt/python/cp311-cp311/include/python3.11'
    export = tmp_path / 'share' / 'rclpy' / 'cmake' / 'export.cmake'
    other = tmp_path / 'share' / 'rclpy' / 'notes.txt'
    export.parent.mkdir(parents=True)
    export.write_text(text)
    other.write_text(text)
    assert fix_prefix(tmp_path, NUMPY, PYTHON) == [export]
    assert (export.read_text(), other.read_text()) == (PYTHON, text)
    assert fix_prefix(tmp_path, NUMPY, PYTHON) == []
