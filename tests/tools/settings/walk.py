"""The walk over all settings: every one changes what its program does, or is refused.

A module of this folder has one `Walk` for each program it is about: what makes the program quick,
what is seen of it besides the files it writes, and for each setting a `Proof`. A value that begins
with `@` is a file or folder of the fixture `places`.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
import json
from pathlib import Path
import re
from typing import Any, get_args, get_origin
from unittest import mock

from metagcttt_core import load_checkpoint, TrajectoryDataset
from metagcttt_core.config import Settings
from metagcttt_tools.common import session
from metagcttt_tools.common.resume import nested
from metagcttt_tools.main import Program, PROGRAMS
import numpy as np
import pytest
from sim_bridge import describe_environment
import torch
import yaml

Seen = list[Any]
"""What a program handed to functions that the test stands in for."""


@dataclass(frozen=True)
class Proof:
    """A value by which a setting makes a difference.

    Attributes:
        value: The value.
        given: Other settings, by dotted name, that it takes to see the difference.
        along: Settings that cannot but change with it, such as the other shares of a whole.
        refused: What the program answers, where it does not accept the value.
        again: Run the program once before, in the same folder.
    """

    value: Any
    given: Mapping[str, Any] = field(default_factory=dict)
    along: Mapping[str, Any] = field(default_factory=dict)
    refused: str = ''
    again: bool = False


@dataclass
class Walk:
    """One program on small data.

    Attributes:
        program: Its subcommand.
        base: Settings, by dotted name, that make it quick.
        proofs: For each setting a proof, or its value.
        watch: Puts stand-ins in place, which note what they are given.
    """

    program: str
    base: Mapping[str, Any]
    proofs: Mapping[str, Any]
    watch: Callable[[pytest.MonkeyPatch, Seen], None] = lambda patch, seen: None
    _usual: dict[str, Any] = field(default_factory=dict, repr=False)
    _places: Path = Path()

    def check(self, name: str, folder: Path, places: Path) -> None:
        """Assert that a setting makes a difference or is refused."""
        self._places = places
        proof = self.proofs[name]
        proof = proof if isinstance(proof, Proof) else Proof(proof)
        key = repr((proof.given, proof.again))
        if key not in self._usual:
            self._usual[key] = self._run(proof.given, folder / 'usual', proof.again)
        usual = self._usual[key]
        assert usual['status'] == 0 or proof.again, usual
        changes = {**proof.given, **proof.along, name: proof.value}
        changed = self._run(changes, folder / 'changed', proof.again)
        if proof.refused:
            assert changed['status'] == 2
            assert proof.refused in changed['error'], changed['error']
        else:
            assert changed['status'] == 0, changed['error']
            assert {**changed, 'error': ''} != {**usual, 'error': ''}

    def check_control(self, folder: Path, places: Path) -> None:
        """Assert that without a change there is no difference."""
        self._places = places
        first, second = (self._run({}, folder / name, again=False) for name in ('1', '2'))
        assert first['status'] == 0, first['error']
        assert {**first, 'error': ''} == {**second, 'error': ''}

    def _run(self, changes: Mapping[str, Any], folder: Path, again: bool) -> dict[str, Any]:
        folder.mkdir(parents=True)
        if again:
            self._call({}, folder)
        return self._call(changes, folder)

    def _call(self, changes: Mapping[str, Any], folder: Path) -> dict[str, Any]:
        seen: Seen = []
        program = program_of(self.program)
        section = (
            'evaluate' if self.program == 'evaluate-ros' else re.sub(r'\W', '_', self.program)
        )
        values = {**self.base, **changes}
        values = {name: self._plain(value) for name, value in values.items()}
        preset = folder.with_suffix('.yaml')
        preset.write_text(yaml.safe_dump({section: nested(values)}))
        with pytest.MonkeyPatch.context() as patch, mock.patch('sys.stderr') as errors:
            patch.chdir(folder)
            patch.setattr(torch, 'set_num_threads', lambda count: seen.append(('threads', count)))
            patch.setattr(session.subprocess, 'run', mock.Mock(side_effect=OSError))  # no git
            self.watch(patch, seen)
            try:
                program.main(['--preset', str(preset)])
                status = 0
            except SystemExit as end:
                status = end.code
        error = ''.join(str(call.args[0]) for call in errors.write.call_args_list)
        return {'status': status, 'error': error, 'seen': digest(seen), 'files': files(folder)}

    def _plain(self, value: Any) -> Any:
        """A value as YAML has it."""
        if isinstance(value, tuple | list):
            return [self._plain(each) for each in value]
        at_place = isinstance(value, str) and value.startswith('@')
        return str(self._places / value[1:]) if at_place else value


def note_time_limits(patch: pytest.MonkeyPatch, seen: Seen, module: Any) -> None:
    """The time limit of a run; one short enough to end it would end the walk's program as well."""
    stop_on_signal = module.stop_on_signal

    def noting(time_limit=None):
        seen.append(('time limit', time_limit))
        return stop_on_signal(time_limit)

    patch.setattr(module, 'stop_on_signal', noting)


def program_of(name: str) -> Any:
    """The module of a subcommand such as `benchmark sim`."""
    *group, last = name.split()
    programs = PROGRAMS[group[0]].programs if group else PROGRAMS
    return import_module(f'metagcttt_tools.{programs[last].module}')


def all_programs() -> Iterator[str]:
    """The names of all subcommands, those of groups after their group's."""
    for name, program in PROGRAMS.items():
        if isinstance(program, Program):
            yield name
        else:
            yield from (f'{name} {member}' for member in program.programs)


def settings_of(program: str) -> type[Settings]:
    """The settings that a subcommand reads."""
    module = program_of(program)
    with pytest.MonkeyPatch.context() as patch:
        read = mock.Mock(side_effect=SystemExit)
        patch.setattr(module, 'parse', read)
        with pytest.raises(SystemExit):
            module.main([])
    return read.call_args.args[0]


def leaves_of(model: type[Settings], prefix: str = '') -> Iterator[str]:
    """The dotted names of the single settings of a model."""
    for name, info in model.model_fields.items():
        inner = list(_models_in(info.annotation))
        if inner:
            yield from leaves_of(inner[0], f'{prefix}{name}.')
        else:
            yield f'{prefix}{name}'


def _models_in(annotation: Any) -> Iterator[type[Settings]]:
    if isinstance(annotation, type) and issubclass(annotation, Settings):
        yield annotation
    elif get_origin(annotation) is not dict:
        for argument in get_args(annotation):
            yield from _models_in(argument)


def digest(value: Any) -> Any:
    """What can be compared of an argument: settings, arrays, agents, datasets, paths."""
    if hasattr(value, 'fingerprint'):
        settings = getattr(value, 'settings', None)
        found = value.fingerprint() if callable(value.fingerprint) else value.fingerprint
        return found, settings and settings.model_dump()
    if isinstance(value, Settings):
        return value.model_dump()
    if isinstance(value, torch.Tensor | np.ndarray):
        return np.asarray(value).tolist()
    if isinstance(value, Mapping):
        return [(digest(key), digest(each)) for key, each in value.items()]
    if isinstance(value, tuple | list):
        return [digest(each) for each in value]
    if isinstance(value, np.random.Generator):
        return value.bit_generator.state
    if isinstance(value, partial):
        return digest(value.keywords)
    return str(value) if isinstance(value, Path) else value


_UNREPEATABLE = (
    *('settings', 'training', 'history', 'machine'),
    *('time', 'speed/updates_per_s', 'task/filter_ms'),
)


def files(folder: Path) -> dict[str, Any]:
    """The files in a folder by name: data and weights by content, pictures by their presence."""
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob('*')):
        name = str(path.relative_to(folder))
        if path.is_dir() or 'tensorboard' in name or path.name == 'settings.json':
            continue
        if path.name == 'checkpoint.json':
            agent = load_checkpoint(path)
            found[name] = digest(agent), agent.metadata.get('environment')
            found[f'{name} state'] = agent.optimizer_state is not None
        elif path.suffix == '.json':
            found[name] = _repeatable(json.loads(path.read_text()))
        elif path.suffix == '.jsonl':
            found[name] = [_repeatable(json.loads(line)) for line in path.read_text().splitlines()]
        elif path.suffix == '.npz':
            found[name] = TrajectoryDataset.load(path).fingerprint
        elif path.name != 'checkpoint.safetensors':  # which has the settings in it
            found[name] = True  # weights are named by their content
    return found


def _repeatable(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _repeatable(v) for key, v in value.items() if key not in _UNREPEATABLE}
    return [_repeatable(each) for each in value] if isinstance(value, list) else value


class ShortSimulator:
    """The tasks of a maze, in which whatever moves does so for four steps."""

    def __init__(self, name: str, *, standing: bool = False) -> None:
        description = describe_environment(name)
        self._lowest_m = 5 + standing  # where starts and goals are drawn
        self.spec, self.maze, self.tasks = description.spec, description.maze, description.tasks

    def __enter__(self) -> 'ShortSimulator':
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def close(self) -> None:
        pass

    def reset(self, task_id: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng((task_id, seed))
        self._steps, self._at = 0, rng.uniform(self._lowest_m, 15, 2)
        return self._at, rng.uniform(self._lowest_m, 15, 2)

    def step(self, action: np.ndarray) -> Any:
        self._steps, self._at = self._steps + 1, self._at + action
        over = self._steps == 4
        return mock.Mock(
            observation=self._at, terminated=False, truncated=over, success=bool(action[0] > 0)
        )


FILTER: dict[str, Any] = {
    'variant': 'score_only',
    'epsilon': 9.0,
    'top_percent': 100.0,
    'top_k': 1,
    'position_dims': Proof((1,)),
    'scale': Proof((0.2, 3.0)),
    'slack': Proof(40, {'filter.variant': 'gcttt'}),
    'min_steps': Proof(60, {'filter.variant': 'gcttt'}),  # with a critic
    'seed': Proof(5, {'filter.variant': 'random'}),
}
INNER_LOOP: dict[str, Any] = {
    'batch_size': 9,
    'optimizer': 'sgd',
    'early_stopping': True,
    'test_fraction': Proof(0.6, {'early_stopping': True}),
    'max_test': Proof(1, {'early_stopping': True}),
    'actor_only': True,  # of an agent with a critic
    'engine': 'eager',
    'precision': 'bfloat16',
    'fix_actor_goal': 0.3,
    'ratio': 0.3,
}


def under(prefix: str, proofs: Mapping[str, Any], **given: Any) -> dict[str, Any]:
    """Proofs for settings inside another, and `given` besides, for those that it names."""
    placed = {}
    for name, proof in proofs.items():
        proof = proof if isinstance(proof, Proof) else Proof(proof)
        inside = {f'{prefix}.{key.removeprefix("filter.")}': v for key, v in proof.given.items()}
        placed[f'{prefix}.{name}'] = Proof(
            proof.value, {**inside, **given.get(name, {})}, refused=proof.refused
        )
    return placed


def walks_through(walks: Sequence[Walk]) -> pytest.MarkDecorator:
    """Every setting of programs, for a test's `walk` and `name`."""
    return pytest.mark.parametrize(
        ('walk', 'name'),
        [
            pytest.param(walk, name, id=f'{walk.program}: {name}')
            for walk in walks
            for name in walk.proofs
        ],
    )
