"""Packages that import what they export when it is first asked for.

PyTorch takes a second or more to import; settings, datasets and the filter do without it.
"""

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
import sys


def exports(package: str, modules: Mapping[str, Sequence[str]]) -> Callable[[str], object]:
    """The `__getattr__` of a package.

    Args:
        package: Its name.
        modules: The names it exports, by the module below it that defines them.
    """
    origins = {name: module for module, names in modules.items() for name in names}

    def get(name: str) -> object:
        if name not in origins:
            raise AttributeError(f'module {package!r} has no attribute {name!r}')
        value = getattr(import_module(f'{package}.{origins[name]}'), name)
        setattr(sys.modules[package], name, value)
        return value

    return get
