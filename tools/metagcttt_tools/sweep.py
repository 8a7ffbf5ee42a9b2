"""A study: every run of a comparison, from pre-training to success curves."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import chain, count
import math
import os
from pathlib import Path
import sys
from typing import Annotated, Any

from metagcttt_core import MetaConfig
from metagcttt_core.agents.config import ActorLoss
from metagcttt_core.config import error_lines, Settings
from metagcttt_core.files import read_json, write_text
from pydantic import Field, model_validator, ValidationError
import tyro
import yaml

from metagcttt_tools.common.cli import fail, merged, parse, preset_values
from metagcttt_tools.common.estimate import format_estimate
from metagcttt_tools.common.manifest import BASE, checkpoints, Evaluation, FILE, Manifest, Policy
from metagcttt_tools.common.run_log import last_step
from metagcttt_tools.common.session import (
    provenance,
    RunSettings,
    snapshot_folder,
    sole_writer,
    time_limit,
    use_threads,
)
from metagcttt_tools.common.sources import fingerprints
from metagcttt_tools.common.stopping import stop_on_signal
from metagcttt_tools.evaluate import EvaluateSettings, finished_jobs
from metagcttt_tools.jobs.program import Invocation
from metagcttt_tools.jobs.scheduler import Job, LocalScheduler, Resources, run_all, Scheduler
from metagcttt_tools.meta_train import MetaTrainSettings
from metagcttt_tools.pretrain import PretrainSettings, settings_type

_DESCRIPTION = """Run a study: pre-train a policy per seed, post-train each arm, evaluate all.

Example: metagcttt sweep --preset pointmaze-medium-navigate-study
Each run is a folder of OUT with its own settings, logs and checkpoints. Ctrl-C is safe: the same
command continues; --dry-run lists what is left and the hours it takes.
`metagcttt report OUT` draws the figures and writes the tables."""


class Arm(Settings):
    """One way to post-train, and to evaluate what comes of it."""

    meta: dict[str, Any] = Field({}, description='changes to the meta settings of the preset')
    actor_loss: ActorLoss | None = Field(
        None, description="actor loss of GCIQL policies in post-training; the preset's by default"
    )
    evaluate: dict[str, Any] = Field(
        {},
        description='changes to the evaluate settings of the preset; such an arm is evaluated by '
        'itself, beside base policies that adapt in the same way',
    )
    snapshot: float = Field(
        1.0, gt=0, le=1, description='fraction of the outer steps whose policy is evaluated'
    )
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
        description='ways to adapt: changes to the evaluate settings of the preset',
    )
    curve: tuple[Annotated[float, Field(gt=0, lt=1)], ...] = Field(
        (), description='fractions of the outer steps at which arms of all seeds are evaluated too'
    )
    curve_budgets: tuple[int, ...] = Field((0, 20), description='budgets K along the curve')
    processes: int = Field(
        2, ge=1, description='cores to use: runs at the same time, processes of an evaluation'
    )
    cluster: bool = Field(
        False, description='run on the Ray cluster of RAY_ADDRESS or of this machine'
    )
    resources: Resources = Resources()
    time_limit: float | None = time_limit()
    dry_run: bool = Field(
        False, description='list the runs and the hours they take, by rates measured here'
    )
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
        if settings.dry_run:
            use_threads(1)
            print(study.estimate())
            return
        with sole_writer(settings.out, settings.out / FILE, *study.files):
            study.run()
    except ValueError as error:
        fail(str(error))
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
        base = [self._policy(BASE, run, 0.0) for run in self.pretraining]
        self.evaluations = {}
        for name, different in settings.adaptations.items():
            alike = [self._trained(arm) for arm in settings.arms if not self._is_alone(arm)]
            self.evaluations[name] = self._evaluation(
                f'evaluation-{name}', [*base, *chain(*alike)], different
            )
            for arm in filter(self._is_alone, settings.arms):
                own = merged(settings.arms[arm].evaluate, different)
                if f'{name}-{arm}' in settings.adaptations:
                    raise ValueError(f'adaptations: {name}-{arm} is that of {name} for arm {arm}')
                self.evaluations[f'{name}-{arm}'] = self._evaluation(
                    f'evaluation-{name}-{arm}', [*base, *self._trained(arm)], own
                )
        along = [
            self._policy(name, run, fraction)
            for name, run in self.post_training
            if settings.arms[name].seeds is None and not self._is_alone(name)
            for fraction in settings.curve
        ]
        self.curve = None
        if along:
            budgets = {'budgets': settings.curve_budgets}
            self.curve = self._evaluation('curve', along, budgets)
            self._check_curve_budgets()
        self._check_names()

    def _check_names(self) -> None:
        """Each run has a place of its own, in the folder of the study."""
        runs = [*self.pretraining, *(run for _, run in self.post_training)]
        evaluations = [*self.evaluations.values(), *([self.curve] if self.curve else [])]
        taken: set[str] = set()
        for out in (*(run.out for run in runs), *(run.out for run, _ in evaluations)):
            name = out.name.removesuffix('.json')
            if out.parent != self.settings.out or name.startswith('.'):
                raise ValueError(f'{out}: names of arms and adaptations must be plain names')
            if name in taken:
                raise ValueError(f'{out}: two runs would go there; seeds and names must differ')
            taken.add(name)

    def _check_curve_budgets(self) -> None:
        """The curve ends with the policies that every adaptation evaluates."""
        for name in self.settings.adaptations:
            budgets = self.evaluations[name][0].budgets
            missing = set(self.settings.curve_budgets) - set(budgets)
            if missing:
                raise ValueError(
                    f'curve_budgets: {min(missing)} is not among the budgets of evaluate '
                    f'({", ".join(map(str, budgets))})'
                )

    @property
    def files(self) -> list[Path]:
        """What is written into its folder besides the manifest and folders of runs."""
        evaluations = self._planned_evaluations
        runs = [*self.pretraining, *(run for _, run in self.post_training), *evaluations]
        return [*map(_preset_of, runs), *(run.out for run in evaluations)]

    @property
    def _planned_evaluations(self) -> list[EvaluateSettings]:
        planned = [*self.evaluations.values(), *([self.curve] if self.curve else [])]
        return [run for run, _ in planned]

    def run(self) -> None:
        """Run whatever is not done yet."""
        out = self.settings.out
        out.mkdir(parents=True, exist_ok=True)
        self.manifest().write(out)
        with stop_on_signal(self.settings.time_limit) as stop:
            scheduler = self._scheduler()
            try:
                for tool, runs in (
                    ('pretrain', self.pretraining),
                    ('meta_train', [run for _, run in self.post_training]),
                    ('evaluate', None),
                ):
                    left = self._to_evaluate() if runs is None else runs
                    run_all(tool, _jobs(tool, left), scheduler, stop)
            except KeyboardInterrupt:
                print('interrupted; run the same command to continue', file=sys.stderr)
                raise SystemExit(stop.status) from None

    def _scheduler(self) -> Scheduler:
        settings = self.settings
        if not settings.cluster:
            return LocalScheduler(settings.processes, settings.resources.retries)
        from metagcttt_tools.jobs.cluster import RayScheduler

        return RayScheduler(settings.resources)

    def estimate(self) -> str:
        """The runs and the hours that are left of them."""
        return format_estimate(
            self.pretraining,
            [run for _, run in self.post_training],
            self._not_evaluated(),
            self.settings.processes,
        )

    def _not_evaluated(self) -> list[EvaluateSettings]:
        return [
            run
            for run in self._planned_evaluations
            if not (is_evaluated(run) and _is_up_to_date(run))
        ]

    def _to_evaluate(self) -> list[EvaluateSettings]:
        """What is left, outdated results of which are put aside."""
        runs = self._not_evaluated()
        for run in runs:
            if run.out.exists() and not finished_jobs(run.out).exists():
                run.out.replace(_free_name(run.out.with_suffix('.outdated.json')))
        return runs

    def manifest(self) -> Manifest:
        """The policies of the study and the files of their results."""

        def listed(planned: tuple[EvaluateSettings, Sequence[Policy]]) -> Evaluation:
            run, policies = planned
            return Evaluation(file=run.out.name, policies=tuple(policies))

        return Manifest(
            settings=self.settings.model_dump(mode='json', exclude={'dry_run'}),
            **provenance(),
            adaptations={name: listed(planned) for name, planned in self.evaluations.items()},
            curve=listed(self.curve) if self.curve else None,
        )

    def _is_alone(self, arm: str) -> bool:
        """True for an arm that is evaluated in its own way."""
        return bool(self.settings.arms[arm].evaluate)

    def _trained(self, arm: str) -> list[Policy]:
        fraction = self.settings.arms[arm].snapshot
        return [
            self._policy(arm, run, fraction) for name, run in self.post_training if name == arm
        ]

    def _policy(self, arm: str, run: RunSettings, fraction: float) -> Policy:
        """A policy that a run leaves: its last, or one it keeps on the way."""
        folder = run.checkpoint_folder
        if isinstance(run, MetaTrainSettings) and fraction < 1:
            folder = snapshot_folder(run.out, round(run.meta.outer_steps * fraction))
        return Policy(checkpoint=folder, arm=arm, seed=run.seed, fraction=fraction)

    def _pretrain(self, seed: int) -> PretrainSettings:
        values = preset_values(self.settings.base, 'pretrain')
        folder = self.settings.out / f'base-{seed}'
        with _named(f'preset {self.settings.base}: pretrain'):
            return settings_type().model_validate(
                values | {'seed': seed, 'out': folder, 'resume': True}
            )

    def _post_train(self, name: str, arm: Arm, seed: int) -> MetaTrainSettings:
        values = preset_values(self.settings.base, 'meta_train')
        with _named(f'meta_train with arms.{name}'):
            meta = MetaConfig.model_validate(merged(values.get('meta', {}), arm.meta))
        base = self._pretrain(seed).checkpoint_folder
        folder = self.settings.out / f'{name}-{seed}'
        values |= {'meta': meta, 'seed': seed, 'checkpoint': base, 'out': folder, 'resume': True}
        if arm.actor_loss is not None:
            values['actor_loss'] = arm.actor_loss
        parts = {
            part: round(meta.outer_steps * part) for part in (*self.settings.curve, arm.snapshot)
        }
        for part, step in parts.items():
            if step == 0:
                raise ValueError(
                    f'arms.{name}: {part:g} of {meta.outer_steps} outer steps is before the first'
                )
        kept = set(parts.values()) - {meta.outer_steps}
        if kept:
            values['snapshot_every'] = math.gcd(*kept)
        with _named(f'meta_train with arms.{name}'):
            return MetaTrainSettings.model_validate(values)

    def _evaluation(
        self, name: str, policies: Sequence[Policy], different: dict[str, Any]
    ) -> tuple[EvaluateSettings, Sequence[Policy]]:
        values = merged(preset_values(self.settings.base, 'evaluate'), different)
        values |= {'checkpoints': checkpoints(policies), 'processes': self.settings.processes}
        values |= {'out': self.settings.out / f'{name}.json', 'resume': True}
        with _named(f'evaluate for {name}'):
            return EvaluateSettings.model_validate(values), policies


def _free_name(path: Path) -> Path:
    """The path, or one with a number where there is a file already."""
    names = (path.with_stem(f'{path.stem}-{number}') for number in count(2))
    return next(each for each in chain([path], names) if not os.path.lexists(each))


def _preset_of(run: Any) -> Path:
    """The file of settings beside the results of a run."""
    out: Path = run.out
    return out.with_name(f'{out.name.removesuffix(".json")}.yaml')


@contextmanager
def _named(part: str) -> Iterator[None]:
    """Says in errors which part of a study has the wrong settings."""
    try:
        yield
    except ValidationError as error:
        lines = '; '.join(error_lines(error))
        raise ValueError(f'{part}: {lines}') from error


def _jobs(tool: str, runs: Sequence[Any]) -> list[Job]:
    """One tool with each of the settings, kept as YAML beside the results."""
    jobs = []
    for run in runs:
        preset = _preset_of(run)
        write_text(preset, yaml.safe_dump({tool: run.model_dump(mode='json')}, sort_keys=False))
        invocation = Invocation(tool.replace('_', '-'), preset, run.out, Path.cwd())
        if isinstance(run, EvaluateSettings):
            jobs.append(Job(invocation, 1, partial(is_evaluated, run), run.processes))
        else:
            done = partial(last_step, run.out)
            jobs.append(Job(invocation, run.steps, done, run.threads, run.device != 'cpu'))
    return jobs


def _is_up_to_date(settings: EvaluateSettings) -> bool:
    """False if the data or policies have changed since they were evaluated."""
    kept = read_json(settings.out).get('fingerprints')
    return kept is None or kept == fingerprints(
        settings.dataset, settings.checkpoints, settings.actor_loss
    )


def is_evaluated(settings: EvaluateSettings) -> bool:
    """True if the results of exactly these settings exist."""
    if not settings.out.exists():
        return False
    free = {'processes', 'out', 'resume'}
    done = read_json(settings.out).get('settings')
    if not isinstance(done, dict):
        raise ValueError(f'{settings.out}: holds no results of metagcttt evaluate')
    wanted = settings.model_dump(mode='json', exclude=free)
    return {name: value for name, value in done.items() if name not in free} == wanted
