"""Registries: built-in objects, and those of other packages by entry points."""

from collections.abc import Callable
import os
from pathlib import Path
import subprocess
import sys

from metagcttt_core.plugins import PluginError, Registry
import pytest

ROOT = Path(__file__).parents[2]
Install = Callable[[str, str], Path]


@pytest.fixture
def install(tmp_path: Path) -> Install:
    """Puts a package into a folder: its entry points and its one module, `guest`."""

    def install(entry_points: str, module: str) -> Path:
        information = tmp_path / 'guest_package-1.0.dist-info'
        information.mkdir()
        (information / 'METADATA').write_text('Metadata-Version: 2.1\nName: guest-package\n')
        (information / 'entry_points.txt').write_text(entry_points)
        (tmp_path / 'guest.py').write_text(module)
        return tmp_path

    return install


@pytest.fixture
def registry(install: Install, monkeypatch) -> Registry[object]:
    """Of paths and maths, with guests: one that works, and ones that do not."""
    lines = 'mine = guest:mine\nabsent = guest:absent\njoin = guest:mine\nlost = nowhere:x'
    monkeypatch.syspath_prepend(install(f'[test.things]\n{lines}\n', 'mine = object()'))
    monkeypatch.delitem(sys.modules, 'guest', raising=False)
    return Registry('test.things', 'thing', {'join': 'posixpath:join', 'sqrt': 'math:sqrt'})


def test_built_in_is_looked_up_without_other_packages(registry, monkeypatch) -> None:
    monkeypatch.setattr('metagcttt_core.plugins.entry_points', None)
    assert registry['sqrt'](4) == registry.find('sqrt')(4) == 2
    assert 'sqrt' in registry


@pytest.mark.filterwarnings('ignore:thing .join.')
def test_names_are_listed_without_importing_anything_of_another_package(registry) -> None:
    assert list(registry) == ['join', 'sqrt', 'mine', 'absent', 'lost']
    assert len(registry) == 5
    assert 'mine' in registry
    assert 'guest' not in sys.modules
    assert registry['mine'] is sys.modules['guest'].mine


@pytest.mark.filterwarnings('ignore:thing .join.')
@pytest.mark.parametrize(
    ('name', 'hint'), [('mien', "; did you mean 'mine'?"), ('xyz', ''), (None, ''), ({'a': 1}, '')]
)
def test_unknown_name_is_refused_with_the_nearest(name, hint, registry) -> None:
    with pytest.raises(ValueError, match='unknown thing') as refused:
        registry.find(name)
    known = '(known: join, sqrt, mine, absent, lost)'
    assert str(refused.value) == f'unknown thing {name!r}{hint} {known}'


def test_name_that_is_taken_stays_with_the_first(registry) -> None:
    with pytest.warns(UserWarning, match="thing 'join' of the package guest-package is ignored"):
        assert 'mine' in registry
    assert registry['join'] is os.path.join


@pytest.mark.filterwarnings('ignore:thing .join.')
@pytest.mark.parametrize(
    ('name', 'why'),
    [('absent', "module 'guest' has no attribute"), ('lost', "No module named 'nowhere'")],
)
def test_what_cannot_be_loaded_is_named_with_its_package(name, why, registry) -> None:
    with pytest.raises(PluginError, match=f"'{name}' of the package guest-package.*: {why}"):
        registry.find(name)


def run(script: str, folder: Path) -> str:
    path = os.pathsep.join(map(str, (folder, ROOT, ROOT / 'tools')))
    result = subprocess.run(
        [sys.executable, '-c', script],
        env={**os.environ, 'PYTHONPATH': path},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_built_ins_take_neither_another_package_nor_pytorch(install) -> None:
    groups = ('agents', 'meta_updates', 'filters', 'simulators')
    points = ''.join(f'[metagcttt.{group}]\nbroken = guest:broken\n' for group in groups)
    folder = install(points, "raise ImportError('is broken')")
    script = """if True:
        import sys
        from metagcttt_core import FilterConfig, MetaConfig
        from metagcttt_core.agents import AGENTS
        from metagcttt_core.retrieval.registry import VARIANTS
        from sim_bridge import describe_environment
        assert VARIANTS['paper'] and 'gciql' in AGENTS and 'broken' in AGENTS
        assert MetaConfig(algorithm='reptile') and FilterConfig(variant='gcttt')
        assert describe_environment('pointmaze-medium-v0')
        assert not {'torch', 'guest', 'mujoco'} & sys.modules.keys()
        assert AGENTS['gcbc'].name == 'gcbc' and 'guest' not in sys.modules
        from metagcttt_tools.main import main
        try: main(['pretrain', '--agent', 'broken'])
        except SystemExit as ended: assert ended.code == 2
        try: main(['pretrain', '--agent', 'gcbc', '--dataset', 'absent.npz'])
        except SystemExit as ended: assert ended.code == 2
        """
    run(script, folder)


GUEST = """
from metagcttt_core.retrieval.variants import paper
from sim_bridge import describe_environment
from sim_bridge.simulator import Family

calls = []

def first_kept(task, config):
    found = paper(task, config)
    return found._replace(keep=found.keep[:1])

def nudge(base, experts, config, optimizer):
    calls.append(type(optimizer).__name__)

maze = Family(
    names=lambda: ('guest-maze',),
    canonical_name=lambda name: name if name == 'guest-maze' else None,
    describe=lambda name: describe_environment('pointmaze-medium-v0'),
    make=lambda name: name.upper(),
)
"""


def test_filters_meta_updates_and_simulators_of_another_package_work(install) -> None:
    points = """[metagcttt.filters]
first = guest:first_kept
[metagcttt.meta_updates]
nudge = guest:nudge
[metagcttt.simulators]
guests = guest:maze
"""
    script = """if True:
        import numpy as np
        from metagcttt_core import FilterConfig, MetaConfig, post_train, TrajectoryFilter
        from sim_bridge import describe_environment, environment_names, make_simulator
        from tests.core.builders import random_dataset, tiny_agent
        dataset = random_dataset()
        state, goal = dataset.observations[0], dataset.observations[9]
        config = FilterConfig(variant='first', epsilon=50.0, top_percent=100.0)
        assert len(TrajectoryFilter(dataset, config).query(state, goal).segments) == 1
        whole = config.model_copy(update={'variant': 'paper'})
        assert len(TrajectoryFilter(dataset, whole).query(state, goal).segments) > 1
        steps = {'outer_steps': 2, 'inner_steps': 1, 'filter': whole}
        meta = MetaConfig(algorithm='nudge', meta_lr=0.5, **steps)
        post_train(tiny_agent('gcbc'), dataset, meta)
        assert make_simulator('guest-maze') == 'GUEST-MAZE'
        assert 'guest-maze' in environment_names() and describe_environment('guest-maze')
        import guest
        print(*guest.calls)
        """
    assert run(script, install(points, GUEST)).split() == ['Adam', 'Adam']
