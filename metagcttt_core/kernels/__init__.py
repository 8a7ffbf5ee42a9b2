"""Kernels in C for what is done for every goal, compiled for the processor that they run on.

That takes half a second, once: the library is kept in `$XDG_CACHE_HOME/metagcttt`, by the hash of
its source, compiler and processor. A machine without a C compiler does without.
"""

from collections.abc import Callable, Iterator
from contextlib import suppress
import ctypes
from ctypes import c_double, c_int, c_int64, c_void_p
from functools import cache, cached_property
import hashlib
import os
from pathlib import Path
import platform
import shutil
import subprocess
import tempfile
from typing import Any

from metagcttt_core.files import atomic_write

_SOURCES = tuple(Path(__file__).with_name(name) for name in ('nearest.c', 'passes.c'))
_COMPILERS = ('cc', 'gcc', 'clang')
# `fopenmp-simd` vectorises sums and needs no library. Not `ffast-math`: a library linked with it
# changes how the whole process treats the smallest numbers.
_FLAGS = (
    *('-O3', '-march=native', '-ffp-contract=off', '-fno-math-errno', '-fno-trapping-math'),
    *('-fopenmp-simd', '-fPIC', '-shared'),
)
_COMPILE_TIMEOUT_S = 120


class KernelsUnavailable(Exception):
    """There are no kernels on this machine; says why."""


class Layer(ctypes.Structure):
    """`struct layer` of passes.c: two sizes, and the addresses of arrays."""

    _fields_ = (
        *((name, c_int64) for name in ('inputs', 'outputs')),
        *((name, c_void_p) for name in ('weight', 'bias', 'scale', 'shift')),
        *((f'{name}_slope', c_void_p) for name in ('weight', 'bias', 'scale', 'shift')),
        *((name, c_void_p) for name in ('output', 'gelu_slope', 'normed', 'inverse_std')),
    )


class Kernels:
    """The functions in C; arrays are passed by their addresses."""

    def __init__(self, library: ctypes.CDLL) -> None:
        """Bind the functions of a compiled `library`."""

        def bind(name: str, *types: Any) -> Callable[..., None]:
            function = library[name]
            function.argtypes, function.restype = types, None
            return function

        self.forward = bind('forward', c_void_p, c_void_p, *[c_int64] * 2, *[c_void_p] * 2)
        self.backward = bind(
            'backward', c_void_p, c_void_p, *[c_int64] * 2, *[c_void_p] * 3, c_int
        )
        self.evaluate = bind(
            'evaluate', *[c_void_p] * 2, *[c_int64] * 2, *[c_void_p] * 2, *[c_int64] * 2, c_void_p
        )
        self.activate = bind('activate', c_void_p, c_int64)
        self.activate_only = bind('activate_only', c_void_p, c_int64, c_void_p, c_void_p)
        self.activate_backward = bind('activate_backward', c_void_p, c_int64, c_void_p, c_int)
        self.nearest_per_episode = bind(
            'nearest_per_episode',
            *[c_int64, c_void_p, c_void_p, c_void_p, c_int64, c_void_p, c_void_p, c_double],
            *[c_void_p] * 5,
        )
        self.adam = bind('adam', c_int64, *[c_void_p] * 5, *[c_double] * 5)

    @cached_property
    def sgemm(self) -> int:
        """The address of the BLAS routine that PyTorch brings along.

        Raises:
            KernelsUnavailable: If it brings none.
        """
        import torch

        path = Path(torch.__file__).parent / 'lib' / 'libtorch_cpu.so'
        try:
            address = ctypes.cast(ctypes.CDLL(str(path)).sgemm_, c_void_p).value
        except (OSError, AttributeError) as error:
            raise KernelsUnavailable(f'no BLAS routine in PyTorch ({error})') from error
        assert address is not None
        return address


def load_kernels() -> Kernels:
    """The kernels, compiled if this processor has none yet; looked for once in a process.

    Raises:
        KernelsUnavailable: Without a compiler, or where it does not serve.
    """
    found = _find()
    if isinstance(found, KernelsUnavailable):
        raise found
    return found


def kernels_if_any() -> Kernels | None:
    """The kernels, or None without a compiler."""
    found = _find()
    return found if isinstance(found, Kernels) else None


@cache
def _find() -> Kernels | KernelsUnavailable:
    compiler = os.environ.get('CC') or next(filter(shutil.which, _COMPILERS), None)
    if compiler is None:
        return KernelsUnavailable(f'no C compiler ({", ".join(_COMPILERS)})')
    command = [*compiler.split(), *_FLAGS]
    try:
        folder = _cache_folder()
        sources = [source.read_bytes() for source in _SOURCES]
        key = _digest(*sources, ' '.join(command).encode(), _processor())
        for library in _kept(folder, key):
            return Kernels(library)
        content = _compiled(command)
        return Kernels(_loaded(content, folder / f'kernels-{key}-{_digest(content)}.so'))
    except (OSError, AttributeError, RuntimeError, subprocess.SubprocessError) as error:
        return KernelsUnavailable(f'{command[0]}: {_reason(error)}')


def _kept(folder: Path, key: str) -> Iterator[ctypes.CDLL]:
    """Libraries compiled before whose content is what their name says."""
    for path in folder.glob(f'kernels-{key}-*.so'):
        with suppress(OSError):
            if path.stem.endswith(_digest(path.read_bytes())):
                yield ctypes.CDLL(str(path))


def _compiled(command: list[str]) -> bytes:
    with tempfile.TemporaryDirectory(prefix='metagcttt-') as folder:
        path = Path(folder, 'kernels.so')
        subprocess.run(
            [*command, *map(str, _SOURCES), '-o', str(path), '-lm'],
            check=True,
            capture_output=True,
            text=True,
            timeout=_COMPILE_TIMEOUT_S,
        )
        return path.read_bytes()


def _loaded(content: bytes, path: Path) -> ctypes.CDLL:
    """The library, kept at `path` where that can be written."""
    try:
        with atomic_write(path) as file:
            file.write(content)
        return ctypes.CDLL(str(path))
    except OSError:
        with tempfile.NamedTemporaryFile(suffix='.so') as temporary:
            temporary.write(content)
            temporary.flush()
            return ctypes.CDLL(temporary.name)


def _cache_folder() -> Path:
    return Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache') / 'metagcttt'


def _processor() -> bytes:
    """What `-march=native` compiles for."""
    lines = Path('/proc/cpuinfo').read_text().splitlines()
    own = next((lines[:end] for end, line in enumerate(lines) if not line), lines)
    kinds = ('model name', 'cpu family', 'model', 'flags', 'Features', 'CPU part')
    facts = [line for line in own if line.split('\t')[0].strip() in kinds]
    return '\n'.join([platform.machine(), *facts]).encode()


def _digest(*contents: bytes) -> str:
    digest = hashlib.blake2b(digest_size=8)
    for content in contents:
        digest.update(len(content).to_bytes(8, 'little') + content)
    return digest.hexdigest()


def _reason(error: Exception) -> str:
    if isinstance(error, subprocess.CalledProcessError):
        lines = error.stderr.strip().splitlines()
        return lines[0] if lines else f'exit status {error.returncode}'
    return str(error)
