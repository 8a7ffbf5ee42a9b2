"""Downloads through the ogbench package, with a stand-in for the network."""

import io
from pathlib import Path
from urllib.error import URLError

from metagcttt_tools import download as download_data
import numpy as np
import pytest

SIZES = {'pointmaze': (2, 2), 'antmaze': (29, 8), 'humanoidmaze': (69, 21)}


def published(robot: str, episodes: int) -> bytes:
    """A file as OGBench publishes them, with short episodes."""
    obs_dim, act_dim = SIZES[robot]
    rng, rows = np.random.default_rng(0), 11 * episodes
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        observations=rng.normal(size=(rows, obs_dim)).astype(np.float32),
        actions=rng.uniform(-1, 1, (rows, act_dim)).astype(np.float32),
        terminals=np.arange(rows) % 11 == 10,
        qpos=rng.normal(size=(rows, 15)).astype(np.float32),
        qvel=rng.normal(size=(rows, 14)).astype(np.float32),
    )
    return buffer.getvalue()


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> dict[str, bytes]:
    """What the network serves, by file name; anything else cannot be reached."""
    files: dict[str, bytes] = {}

    def urlopen(url: str) -> io.BytesIO:
        name = url.rsplit('/', 1)[1]
        if name not in files:
            raise URLError('[Errno -2] Name or service not known')
        return io.BytesIO(files[name])

    monkeypatch.setattr('urllib.request.urlopen', urlopen)
    return files


@pytest.mark.parametrize('robot', SIZES)
def test_both_files_are_fetched_checked_and_described(
    robot: str, server: dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = f'{robot}-medium-stitch-v0'
    server[f'{name}.npz'], server[f'{name}-val.npz'] = published(robot, 5), published(robot, 1)
    download_data.main([name, '--folder', str(tmp_path)])
    assert sorted(path.name for path in tmp_path.iterdir()) == [f'{name}-val.npz', f'{name}.npz']
    out = capsys.readouterr().out
    assert f'{name}.npz: TrajectoryDataset(5 trajectories, 55 rows' in out
    assert f'{name}-val.npz: TrajectoryDataset(1 trajectories, 11 rows' in out
    server.clear()
    download_data.main([name, '--folder', str(tmp_path)])  # needs no network any more


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as ended:
        download_data.main(list(arguments))
    assert ended.value.code == 2
    return capsys.readouterr().err


@pytest.mark.usefixtures('server')
def test_offline_the_message_says_what_to_copy_where(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    message = refusal(capsys, 'antmaze-medium-navigate-v0', '--folder', str(tmp_path))
    assert 'cannot be downloaded' in message
    assert f'copy {tmp_path}/antmaze-medium-navigate-v0.npz and' in message
    assert 'metagcttt generate' in message


def test_file_cut_short_is_refused(
    server: dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = published('antmaze', 2)
    server['antmaze-medium-stitch-v0.npz'] = content[: len(content) // 2]
    server['antmaze-medium-stitch-v0-val.npz'] = content
    message = refusal(capsys, 'antmaze-medium-stitch-v0', '--folder', str(tmp_path))
    assert 'remove the file and download it again' in message


def test_file_of_another_robot_is_refused(
    server: dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for suffix in ('', '-val'):
        server[f'antmaze-medium-stitch-v0{suffix}.npz'] = published('pointmaze', 1)
    message = refusal(capsys, 'antmaze-medium-stitch-v0', '--folder', str(tmp_path))
    assert 'has 2 observation and 2 action dimensions, antmaze-medium-v0 has 29 and 8' in message


def test_unknown_name_is_refused_before_anything_is_fetched(
    server: dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    message = refusal(capsys, 'antmaze-mediun-navigate-v0', '--folder', str(tmp_path))
    assert "did you mean 'antmaze-medium-v0'" in message
