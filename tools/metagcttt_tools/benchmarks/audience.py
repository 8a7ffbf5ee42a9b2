"""Somebody who looks at the live view while a benchmark runs."""

from collections.abc import Iterator
from contextlib import contextmanager, ExitStack
import multiprocessing
from pathlib import Path
import shutil
import subprocess
import sys
import tempfile
from typing import Literal

from metagcttt_core.files import open_log

Audience = Literal['none', 'reader', 'browser']

HEADLESS = (
    *('--headless=new', '--no-sandbox', '--disable-dev-shm-usage'),
    *('--use-angle=swiftshader', '--enable-unsafe-swiftshader'),
)
"""Options of a Chromium that runs as root in a container, and draws by the processor."""


@contextmanager
def watching(audience: Audience, folder: Path) -> Iterator[None]:
    """Run `metagcttt view` and look at it: its messages alone, or its page in a browser.

    The reader takes every message as a page would and draws nothing, so that only the view's
    own cost is there. The browser is a headless Chromium at the lowest priority, without a GPU.

    Args:
        audience: Who looks; without anybody there is no view either.
        folder: For the view's log.

    Raises:
        FileNotFoundError: If there is no Chromium on this machine.
        RuntimeError: If the view ends before it listens.
    """
    if audience == 'none':
        yield
        return
    with ExitStack() as stack:
        if audience == 'browser' and shutil.which('chromium') is None:
            raise FileNotFoundError('there is no chromium here; --audience reader needs none')
        url = stack.enter_context(_view(folder))
        if audience == 'browser':
            stack.enter_context(_browser(url))
        else:
            stack.enter_context(_reader(url))
        yield


@contextmanager
def _view(folder: Path) -> Iterator[str]:
    command = [sys.executable, '-m', 'metagcttt_tools', 'view', '--out', str(folder)]
    with (
        open_log(folder / 'view.log', 'view', anew=True) as log,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True) as view,
    ):
        assert view.stdout is not None
        try:
            line = view.stdout.readline()
            if not line:
                raise RuntimeError(
                    f'metagcttt view ended with status {view.wait()}: see {log.name}'
                )
            yield line.split()[-1]
        finally:
            view.terminate()


@contextmanager
def _browser(url: str) -> Iterator[None]:
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = ['nice', '-n', '19', 'chromium', *HEADLESS, '--remote-debugging-port=0']
        command += ['--window-size=1000,560', f'--user-data-dir={profile}', url]
        with subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        ) as browser:
            try:
                yield
            finally:
                browser.terminate()


@contextmanager
def _reader(url: str) -> Iterator[None]:
    reader = multiprocessing.get_context('spawn').Process(target=read, args=(url,), daemon=True)
    reader.start()
    try:
        yield
    finally:
        reader.terminate()
        reader.join()


def read(url: str) -> None:
    """Take all messages of a live view until it ends.

    Args:
        url: Where it listens, such as http://127.0.0.1:8080.
    """
    import viser
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    protocol = Subprotocol(f'viser-v{viser.__version__}')
    address = url.replace('http', 'ws', 1)
    with connect(address, subprotocols=[protocol], max_size=None) as connection:
        for _ in connection:
            pass
