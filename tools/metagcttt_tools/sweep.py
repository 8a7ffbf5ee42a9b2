"""A study: every run of a comparison, from pre-training to success curves."""

from collections.abc import Sequence
from concurrent.futures import as_completed, ThreadPoolExecutor
import json
from pathlib import Path
import signal
import subprocess
import sys
import threading
from typing import Annotated, Any

from metagcttt_core import MetaConfig
from metagcttt_core.adaptation import TTTSettings
from metagcttt_core.config import Settings
from pydantic import Field, model_validator
from tqdm import tqdm
import tyro
import yaml

from metagcttt_tools.common.cli import fail, parse, preset_values
from metagcttt_tools.common.manifest import BASE, checkpoints, Evaluation, Manifest, Policy
from metagcttt_tools.common.session import (
    provenance,
    RunSettings,
    snapshot_folder,
    sole_writer,
    stop_on_signal,
)
from metagcttt_tools.evaluate import EvaluateSettings
from metagcttt_tools.meta_train import MetaTrainSettings
from metagcttt_tools.pretrain import PretrainSettings, settings_type

_DESCRIPTION = """Run a study: pre-train a policy per seed, post-train each arm, evaluate all.

Example: metagcttt sweep --preset pointmaze-medium-navigate-study
Each run is a folder of OUT with its own settings, logs and checkpoints. Ctrl-C is safe: the same
command continues. `metagcttt report OUT` draws the figures and writes the tables."""


class Arm(Settings):
    """One way to post-train."""

    meta: dict[str, Any] = Field({}, description='changes to the meta settings of the preset')
    seeds: tuple[int, ...] | None = Field(
        None, description="training seeds; the study's by default"
    )


class SweepSettings(Settings):
    """Settings of the program."""

    base: str = Field(
        'pointmaze-medium-navigate-study',
        description='preset with the pretrain, meta_train and evaluate settings of all runs',
    )
    seeds: tuple[int, ...] = Field((0, 1, 2), min_length=1, description='training seeds')
    arms: Annotated[dict[str, Arm], tyro.conf.Fixed] = Field({}, description='ways to post-train')
    adaptations: Annotated[dict[str, dict[str, Any]], tyro.conf.Fixed] = Field(
        {'ttt': {}},
        min_length=1,
        description='ways to adapt: changes to the ttt settings of the preset',
    )
    curve: tuple[Annotated[float, Field(gt=0, lt=1)], ...] = Field(
        (), description='fractions of the outer steps at which arms of all seeds are evaluated too'
    )
    curve_budgets: tuple[int, ...] = Field((0, 20), description='budgets K along the curve')
    processes: int = Field(2, ge=1, description='runs at the same time')
    out: Path = Field(Path('out/study'), description='folder of the study')

    @model_validator(mode='after')
    def _check(self) -> 'SweepSettings':
        for fraction in self.curve:
            multiple = fraction / self.curve[0]
            if abs(multiple - round(multiple)) > 1e-9:
                raise ValueError(
                    f'curve must hold multiples of its first fraction, got {self.curve}'
                )
        return self


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(SweepSettings, _DESCRIPTION, 'sweep', argv)
    try:
        study = Study(settings)
        with sole_writer(settings.out):
            study.run()
    except ValueError as error:
        fail(str(error))
    except KeyboardInterrupt:
        print('interrupted; run the same command to continue', file=sys.stderr)
        raise SystemExit(130) from None
    print(f'study: {settings.out}; metagcttt report {settings.out}')


class Study:
    """The runs of a study, each validated before the first begins."""

    def __init__(self, settings: SweepSettings) -> None:
        """Plan the runs.

        Raises:
            ValueError: If the settings of any run are wrong; names the field.
        """
        self.settings = settings
        self.pretraining = [self._pretrain(seed) for seed in settings.seeds]
        self.post_training = [
            (name, self._post_train(name, arm, seed))
            for name, arm in settings.arms.items()
            for seed in arm.seeds or settings.seeds
        ]
        trained = [
            *(self._policy(BASE, run, 0.0) for run in self.pretraining),
            *(self._policy(arm, run, 1.0) for arm, run in self.post_training),
        ]
        self.evaluations = {
            name: self._evaluation(f'evaluation-{name}', trained, ttt=different)
            for name, different in settings.adaptations.items()
        }
        along = [
            self._policy(arm, run, fraction)
            for arm, run in self.post_training
            if settings.arms[arm].seeds is None
            for fraction in settings.curve
        ]
        self.curve = None
        if along:
            self.curve = self._evaluation('curve', along, budgets=settings.curve_budgets)

    def run(self) -> None:
        """Run whatever is not done yet."""
        out = self.settings.out
        out.mkdir(parents=True, exist_ok=True)
        self.manifest().write(out)
        planned = [*self.evaluations.values(), *([self.curve] if self.curve else [])]
        pending = [run for run, _ in planned if not is_evaluated(run)]
        with stop_on_signal() as stop:
            processes = self.settings.processes
            _run_all('pretrain', self.pretraining, processes, stop)
            _run_all('meta_train', [run for _, run in self.post_training], processes, stop)
            _run_all('evaluate', pending, 1, stop)

    def manifest(self) -> Manifest:
        """The policies of the study and the files of their results."""

        def listed(planned: tuple[EvaluateSettings, Sequence[Policy]]) -> Evaluation:
            run, policies = planned
            return Evaluation(file=run.out.name, policies=tuple(policies))

        return Manifest(
            settings=self.settings.model_dump(mode='json'),
            **provenance(),
            adaptations={name: listed(planned) for name, planned in self.evaluations.items()},
            curve=listed(self.curve) if self.curve else None,
        )

    def _policy(self, arm: str, run: RunSettings, fraction: float) -> Policy:
        """A policy that a run leaves: its last, or one it keeps on the way."""
        folder = run.checkpoint_folder
        if isinstance(run, MetaTrainSettings) and fraction < 1:
            folder = snapshot_folder(run.out, round(run.meta.outer_steps * fraction))
        return Policy(checkpoint=folder, arm=arm, seed=run.seed, fraction=fraction)

    def _pretrain(self, seed: int) -> PretrainSettings:
        values = preset_values(self.settings.base, 'pretrain')
        folder = self.settings.out / f'base-{seed}'
        return settings_type().model_validate(
            values | {'seed': seed, 'out': folder, 'resume': True}
        )

    def _post_train(self, name: str, arm: Arm, seed: int) -> MetaTrainSettings:
        values = preset_values(self.settings.base, 'meta_train')
        meta = MetaConfig.model_validate(values.get('meta', {}) | arm.meta)
        base = self._pretrain(seed).checkpoint_folder
        folder = self.settings.out / f'{name}-{seed}'
        values |= {'meta': meta, 'seed': seed, 'checkpoint': base, 'out': folder, 'resume': True}
        if self.settings.curve:
            values['snapshot_every'] = round(meta.outer_steps * self.settings.curve[0])
        return MetaTrainSettings.model_validate(values)

    def _evaluation(
        self,
        name: str,
        policies: Sequence[Policy],
        ttt: dict[str, Any] | None = None,
        **different: Any,
    ) -> tuple[EvaluateSettings, Sequence[Policy]]:
        values = preset_values(self.settings.base, 'evaluate')
        values |= {'ttt': TTTSettings.model_validate(values.get('ttt', {}) | (ttt or {}))}
        values |= {'checkpoints': checkpoints(policies), 'processes': self.settings.processes}
        values |= {'out': self.settings.out / f'{name}.json', 'resume': True, **different}
        return EvaluateSettings.model_validate(values), policies


def _run_all(tool: str, runs: Sequence[Any], processes: int, stop: threading.Event) -> None:
    """Run one tool with each of the settings, some at the same time.

    Raises:
        KeyboardInterrupt: If `stop` was set; the runs have saved what they did.
        ValueError: If a run failed.
    """
    with (
        ThreadPoolExecutor(processes) as pool,
        tqdm(total=len(runs), unit='run', desc=tool) as bar,
    ):
        futures = [pool.submit(_run_tool, tool, run, stop) for run in runs]
        for future in as_completed(futures):
            if future.exception() is not None:
                pool.shutdown(wait=False, cancel_futures=True)
            future.result()
            bar.update()


def _run_tool(tool: str, settings: Any, stop: threading.Event) -> None:
    """Run one tool with the settings, kept as YAML; its output goes beside them."""
    path = settings.out.with_suffix('.yaml')
    path.write_text(
        yaml.safe_dump({tool: settings.model_dump(mode='json')}, sort_keys=False), encoding='utf-8'
    )
    program = [sys.executable, '-m', 'metagcttt_tools', tool.replace('_', '-')]
    command = [*program, '--preset', str(path)]
    log_path = path.with_suffix('.log')
    with log_path.open('a', encoding='utf-8') as log:
        process = subprocess.Popen(
            command, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
        )
        while process.poll() is None:
            if stop.wait(0.2):
                process.send_signal(signal.SIGINT)
                process.wait()
    if stop.is_set():
        raise KeyboardInterrupt
    if process.returncode:
        last = log_path.read_text(encoding='utf-8').rstrip().splitlines()[-1:]
        raise ValueError(
            f'{" ".join(command)} ended with status {process.returncode}: {"".join(last)}'
        )


def is_evaluated(settings: EvaluateSettings) -> bool:
    """True if the results of exactly these settings exist."""
    if not settings.out.exists():
        return False
    free = {'processes', 'out', 'resume'}
    done = json.loads(settings.out.read_text(encoding='utf-8'))['settings']
    wanted = settings.model_dump(mode='json', exclude=free)
    return {name: value for name, value in done.items() if name not in free} == wanted
