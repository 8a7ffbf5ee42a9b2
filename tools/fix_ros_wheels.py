"""Point the CMake exports of the ROS wheels at this interpreter.

The wheels were built in a container, and about twenty of the CMake files that they install name
that container's Python and NumPy include folders. Interface packages find nothing there. This
script replaces those paths; a second run changes nothing.
"""

from __future__ import annotations

from pathlib import Path
import re
import sys
import sysconfig

NUMPY_INCLUDE = re.compile(
    r'/opt/python/[^/;"]+/lib/python3\.\d+/site-packages/numpy/_core/include'
)
PYTHON_INCLUDE = re.compile(r'/opt/python/[^/;"]+/include/python3\.\d+')


def fix_text(text: str, numpy_include: str, python_include: str) -> str:
    """Return CMake `text` with the build container's include folders replaced."""
    text = NUMPY_INCLUDE.sub(lambda _: numpy_include, text)
    return PYTHON_INCLUDE.sub(lambda _: python_include, text)


def fix_prefix(prefix: Path, numpy_include: str, python_include: str) -> list[Path]:
    """Repair every `share/*/cmake/*.cmake` under `prefix`.

    Args:
        prefix: Environment that holds the ROS wheels.
        numpy_include: Folder of `numpy/arrayobject.h`.
        python_include: Folder of `Python.h`.

    Returns:
        The files that changed, sorted.
    """
    changed = []
    for path in sorted(prefix.glob('share/*/cmake/*.cmake')):
        text = path.read_text(encoding='utf-8')
        fixed = fix_text(text, numpy_include, python_include)
        if fixed != text:
            path.write_text(fixed, encoding='utf-8')
            changed.append(path)
    return changed


def main() -> None:
    """Repair the environment named on the command line, by default the running one."""
    import numpy

    prefix = Path(sys.argv[1] if len(sys.argv) > 1 else sys.prefix)
    changed = fix_prefix(prefix, numpy.get_include(), sysconfig.get_paths()['include'])
    print(f'pointed {len(changed)} CMake files of the ROS wheels at this Python')


if __name__ == '__main__':
    main()
