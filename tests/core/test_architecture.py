"""Habits that keep libraries usable: no pickle, no global randomness, no prints."""

import ast
from collections.abc import Iterator
import importlib
from pathlib import Path
import re

import pytest

ROOT = Path(__file__).parents[2]
LIBRARIES = ('metagcttt_core', 'sim_bridge')


def files_of(*folders: str) -> list:
    """The Python files under folders of the repository, as parameters named by their paths."""
    found = [path for folder in folders for path in sorted((ROOT / folder).rglob('*.py'))]
    assert found, folders
    return [pytest.param(path, id=str(path.relative_to(ROOT))) for path in found]


def tree_of(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding='utf-8'))


def imports_of(file: Path) -> set[str]:
    """The full names of all imported modules, wherever in the file."""
    names: set[str] = set()
    for node in ast.walk(tree_of(file)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{file}: relative import'
            names.add(node.module)
    return names


def packages_of(file: Path) -> set[str]:
    return {name.split('.')[0] for name in imports_of(file)}


def dotted_names(tree: ast.AST) -> Iterator[str]:
    """Names such as `np.random.seed`, as written."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            try:
                yield ast.unparse(node)
            except ValueError:
                continue


@pytest.mark.parametrize('file', files_of(*LIBRARIES))
def test_libraries_do_not_print(file):
    calls = [node for node in ast.walk(tree_of(file)) if isinstance(node, ast.Call)]
    assert not any(isinstance(c.func, ast.Name) and c.func.id == 'print' for c in calls)


@pytest.mark.parametrize('file', files_of('metagcttt_core'))
def test_randomness_comes_from_generators_only(file):
    for name in dotted_names(tree_of(file)):
        assert name != 'torch.manual_seed'
        if found := re.fullmatch(r'(np|numpy)\.random\.(\w+)', name):
            assert found[2] in {'default_rng', 'Generator', 'SeedSequence'}, name
    assert 'random' not in imports_of(file)


@pytest.mark.parametrize('file', files_of(*LIBRARIES, 'tools', 'ros2_ws/src'))
def test_nothing_is_ever_pickled(file):
    forbidden = {'pickle', 'cPickle', 'dill', 'cloudpickle', 'joblib', 'shelve', 'marshal'}
    assert not packages_of(file) & forbidden
    names = set(dotted_names(tree_of(file)))
    assert not names & {'torch.load', 'torch.save', 'yaml.load', 'yaml.unsafe_load'}
    for node in ast.walk(tree_of(file)):
        if isinstance(node, ast.keyword) and node.arg == 'allow_pickle':
            assert isinstance(node.value, ast.Constant)
            assert node.value.value is False


@pytest.mark.parametrize('package', ['metagcttt_core', 'metagcttt_core.data', 'sim_bridge'])
def test_every_exported_name_exists(package):
    module = importlib.import_module(package)
    assert len(set(module.__all__)) == len(module.__all__)
    for name in module.__all__:
        assert hasattr(module, name), name


def test_names_that_other_programs_rely_on():
    names = """
        TrajectoryDataset FilterConfig TrajectoryFilter make_agent save_checkpoint load_checkpoint
        TTTConfig adapt MetaConfig post_train evaluate_success normalized_auc success_statistics
    """
    core = importlib.import_module('metagcttt_core')
    assert set(names.split()) <= set(core.__all__)
