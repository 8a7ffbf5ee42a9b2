"""Registries: what there is by name, here and in other installed packages."""

from collections.abc import Callable, Iterator, Mapping, MutableMapping
from difflib import get_close_matches
from functools import cached_property
from importlib.metadata import entry_points, EntryPoint
from typing import Annotated, Any, Literal, TypeVar
import warnings

from pydantic import BeforeValidator

T = TypeVar('T')


class PluginError(ValueError):
    """A plugin that cannot be loaded; the message names it, its package and why."""


class Registry(MutableMapping[str, T]):
    """Objects by name, each imported when it is first looked up.

    Another package adds one by an entry point, which is a line in its `pyproject.toml`:

        [project.entry-points."metagcttt.agents"]
        mine = "my_package:MyAgent"

    Attributes:
        group: The group of these entry points.
        kind: What one of the objects is, in words.
    """

    def __init__(self, group: str, kind: str, built_in: Mapping[str, str]) -> None:
        """Name the objects of this project, each as `module:attribute`."""
        self.group = group
        self.kind = kind
        self._built_in = {name: EntryPoint(name, at, group) for name, at in built_in.items()}
        self._loaded: dict[str, T] = {}

    @cached_property
    def plugins(self) -> Mapping[str, EntryPoint]:
        """The entry points of other packages; nothing of theirs is imported."""
        found: dict[str, EntryPoint] = {}
        for point in entry_points(group=self.group):
            if point.name in self._built_in or point.name in found:
                warnings.warn(f'{self._words(point)} is ignored: the name is taken', stacklevel=2)
            else:
                found[point.name] = point
        return found

    def known(self, name: Any) -> Any:
        """`name`, if there is such an object.

        Raises:
            ValueError: If there is none; says which name comes closest.
        """
        if isinstance(name, str) and name in self:
            return name
        close = get_close_matches(str(name), self, n=1)
        hint = f'; did you mean {close[0]!r}?' if close else ''
        raise ValueError(f'unknown {self.kind} {name!r}{hint} (known: {", ".join(self)})')

    def find(self, name: str) -> T:
        """The named object.

        Raises:
            ValueError: If there is none; says which name comes closest.
            PluginError: If it is another package's and cannot be loaded.
        """
        return self[self.known(name)]

    @property
    def names(self) -> Any:
        """The type of the names, for settings: validated by `known`, and choices in a help."""
        return Annotated[Literal[tuple(self)], BeforeValidator(self.known)]

    def __getitem__(self, name: str) -> T:
        """The named object; `KeyError` if there is none."""
        if name not in self._loaded:
            if name in self._built_in:
                self._loaded[name] = self._built_in[name].load()
            else:
                self._loaded[name] = self._load_plugin(self.plugins[name])
        return self._loaded[name]

    def _load_plugin(self, point: EntryPoint) -> T:
        load: Callable[[], T] = point.load
        try:
            return load()
        except (ImportError, AttributeError) as error:
            raise PluginError(f'{self._words(point)} cannot be loaded: {error}') from error

    def _words(self, point: EntryPoint) -> str:
        package = point.dist.name if point.dist else point.module
        return f'{self.kind} {point.name!r} of the package {package}'

    def __setitem__(self, name: str, value: T) -> None:
        """Put an object under a name, in this process."""
        self._loaded[name] = value

    def __delitem__(self, name: str) -> None:
        """Take back what was put under a name."""
        del self._loaded[name]

    def __contains__(self, name: object) -> bool:
        """Whether there is an object of that name; imports nothing."""
        return name in self._built_in or name in self._loaded or name in self.plugins

    def __iter__(self) -> Iterator[str]:
        """The names, those of this project first."""
        return iter(dict.fromkeys([*self._built_in, *self.plugins, *self._loaded]))

    def __len__(self) -> int:
        """Number of names."""
        return len(list(iter(self)))
