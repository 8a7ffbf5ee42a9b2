"""No program overwrites files of somebody else, nor follows a link to them."""

from collections.abc import Callable
import os
from pathlib import Path

from matplotlib.figure import Figure
from metagcttt_core.files import refuse_foreign
from metagcttt_tools import (
    controller_measure,
    controller_train,
    controller_train_humanoid,
    diagnostics,
    draw_episodes,
    evaluate,
    evaluate_offline,
    evaluate_robot,
    export_lerobot,
    generate,
    import_bags,
    import_lerobot,
    import_recordings,
    import_table,
    inspect_data,
    loss_curves,
    pretrain,
    report,
    sweep,
    top_view,
)
from metagcttt_tools.common.plots import save, write_gif
from metagcttt_tools.common.session import lock_of, sole_writer
from PIL import Image
import pytest
from tests.core.builders import maze_walks

PRECIOUS = 'four years of work'

# Program, arguments, and a file of somebody else's that it would overwrite.
PROGRAMS: list[tuple[Callable[[list[str]], None], str, str]] = [
    (pretrain.main, '--dataset DATA --out DIR', 'settings.json'),
    (pretrain.main, '--dataset DATA --out DIR', 'metrics.jsonl'),
    (controller_train.main, '--out DIR', 'settings.json'),
    (controller_train_humanoid.main, '--out DIR', 'metrics.jsonl'),
    (controller_measure.main, '--out DIR/walk', 'walk.md'),
    (evaluate.main, '--out DIR/run.json', 'run.json'),
    (evaluate_offline.main, '--dataset DATA --out DIR/run.json', 'run.png'),
    (evaluate_robot.main, '--dataset DATA --out DIR/run.json', 'run.json'),
    (draw_episodes.main, '--dataset DATA --out DIR/run', 'run.png'),
    (loss_curves.main, '--dataset DATA --out DIR/run.json', 'run.json'),
    (inspect_data.main, 'DATA --out DIR/run.png', 'run.png'),
    (top_view.main, '--recording DIR/x.mcap --out DIR/run.gif', 'run.gif'),
    (sweep.main, '--preset quick --out DIR', 'manifest.json'),
    (sweep.main, '--preset quick --out DIR', 'base-0.yaml'),
    (sweep.main, '--preset quick --out DIR', 'evaluation-ttt.json'),
    (generate.main, '--output DIR/maze.npz', 'maze.png'),
    (generate.main, '--output DIR/maze.npz', 'maze.npz'),
    (generate.main, '--output DIR/maze.npz --resume', 'maze.npz'),
    (generate.main, '--output DIR/maze.npz --overwrite', 'maze.npz'),
    (generate.main, '--output DIR/maze.npz --overwrite', 'maze-val.npz'),
    (import_bags.main, '--bags DIR/x.mcap --out DIR/run.npz', 'run.npz'),
    (import_lerobot.main, 'DIR --out DIR/run.npz', 'run.npz'),
    (import_recordings.main, '--recordings DIR/x.mcap --out DIR/run.npz', 'run.npz'),
    (import_table.main, '--tables DIR/x.csv --out DIR/run.npz', 'run.npz'),
    (export_lerobot.main, 'DATA --fps 5 --out DIR/run', 'run'),
]


@pytest.fixture(scope='module')
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp('data') / 'walks.npz'
    maze_walks().save(path)
    return path


@pytest.mark.parametrize(('program', 'arguments', 'name'), PROGRAMS)
@pytest.mark.parametrize('linked', [False, True])
def test_foreign_file_is_named_and_kept(program, arguments, name, linked, data, tmp_path, capsys):
    there, elsewhere = tmp_path / name, tmp_path / 'elsewhere'
    (elsewhere if linked else there).write_text(PRECIOUS)
    if linked:
        there.symlink_to(elsewhere)
    before = sorted(tmp_path.iterdir())
    given = arguments.replace('DATA', str(data)).replace('DIR', str(tmp_path))
    with pytest.raises(SystemExit) as ending:
        program(given.split())
    assert ending.value.code == 2
    assert str(there) in capsys.readouterr().err
    assert there.read_text() == PRECIOUS
    left = [path for path in sorted(tmp_path.iterdir()) if path.suffix != '.lock']
    assert left == before


IMPORTERS = [(program, given) for program, given, _ in PROGRAMS if 'DIR/run.npz' in given]


@pytest.mark.parametrize('kind', ['file', 'folder', 'pipe', 'link', 'dataset'])
@pytest.mark.parametrize(('program', 'arguments'), IMPORTERS)
def test_overwriting_replaces_imported_datasets_only(program, arguments, kind, tmp_path, capsys):
    there, elsewhere = tmp_path / 'run.npz', tmp_path / 'elsewhere'
    elsewhere.write_text(PRECIOUS)
    make = {
        'file': lambda: there.write_text(PRECIOUS),
        'folder': there.mkdir,
        'pipe': lambda: os.mkfifo(there),
        'link': lambda: there.symlink_to(elsewhere),
        'dataset': lambda: maze_walks().save(there),
    }
    make[kind]()
    before = there.lstat().st_ino, there.lstat().st_mtime_ns
    with pytest.raises(SystemExit, match='2'):
        program([*arguments.replace('DIR', str(tmp_path)).split(), '--overwrite'])
    assert f'{there} exists and is no imported dataset' in capsys.readouterr().err
    assert (there.lstat().st_ino, there.lstat().st_mtime_ns) == before
    assert elsewhere.read_text() == PRECIOUS


def test_what_the_study_report_writes_is_not_taken_from_anybody(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(report, 'read_study', lambda *_: {})
    (tmp_path / 'study-0.5.md').write_text(PRECIOUS)
    with pytest.raises(SystemExit, match='2'):
        report.main([str(tmp_path), '--out', str(tmp_path / 'study-0.5')])
    assert 'study-0.5.md exists and was not made by metagcttt' in capsys.readouterr().err


def test_pictures_carry_the_mark_and_are_readable(tmp_path):
    save(Figure(), tmp_path / 'a.png')
    frames = tmp_path / 'frames.gif'
    Image.new('P', (4, 4)).save(frames)
    write_gif(tmp_path / 'a.gif', frames.read_bytes())
    for path in (tmp_path / 'a.png', tmp_path / 'a.gif'):
        refuse_foreign(path)
        with Image.open(path) as picture:
            picture.load()


def test_diagnostics_of_a_run_are_drawn_anew_but_not_over_other_pictures(tmp_path, capsys):
    (tmp_path / 'run').mkdir()
    (tmp_path / 'run' / 'metrics.jsonl').write_text('{"step": 1, "inner/best_step": 1}\n')
    name = next(iter(diagnostics.PICTURES))
    (tmp_path / f'{name}.png').write_text(PRECIOUS)
    with pytest.raises(SystemExit, match='2'):
        diagnostics.main(['--run', str(tmp_path / 'run'), '--out', str(tmp_path)])
    assert f'{name}.png exists' in capsys.readouterr().err


def test_one_folder_has_one_lock_by_whatever_name(tmp_path, monkeypatch, capsys):
    run, link = tmp_path / 'run', tmp_path / 'link'
    run.mkdir()
    link.symlink_to(run)
    monkeypatch.chdir(run)
    names = [run, link, Path('.'), Path('../run'), run / 'x' / '..', tmp_path / 'link' / '.']
    assert {lock_of(name) for name in names} == {tmp_path / '.run.lock'}
    with sole_writer(run), pytest.raises(SystemExit, match='2'), sole_writer(link):
        raise AssertionError('two writers')
    assert 'another process is writing there' in capsys.readouterr().err


def test_lock_that_cannot_be_taken_is_named(tmp_path):
    (tmp_path / 'file').write_text(PRECIOUS)
    (tmp_path / '.run.lock').symlink_to(tmp_path / 'file')
    for out in (tmp_path / 'run', tmp_path / 'file' / 'run'):
        with pytest.raises(OSError, match=str(tmp_path)), sole_writer(out):
            raise AssertionError('written')
    assert (tmp_path / 'file').read_text() == PRECIOUS
    (tmp_path / '.other.lock').write_bytes(b'\xff damaged')  # its content is nobody's business
    with sole_writer(tmp_path / 'other'):
        pass
