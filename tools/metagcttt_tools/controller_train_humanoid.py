"""Train the controllers of the humanoid: to walk along a direction, and to get up."""

from dataclasses import replace
from pathlib import Path

from pydantic import Field
from tqdm import tqdm

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.resume import Resumable
from metagcttt_tools.common.run_log import RunLog
from metagcttt_tools.common.session import (
    files_of_run,
    sole_writer,
    time_limit,
    use_threads,
    write_settings,
)
from metagcttt_tools.common.stopping import stop_on_signal
from metagcttt_tools.controller.recipe import HumanoidTask, STAGES_OF

_DESCRIPTION = """Train a controller of the humanoid (SAC): to walk along a direction or to get up.

Example: metagcttt controller train-humanoid --out out/humanoid-controller
Three stages to walk: on a floor, with noise and pushes, in mazes. To get up, the humanoids are
dropped as OGBench drops them, and lifted by a force that fades as they succeed.
Writes OUT/controller, OUT/checkpoint.safetensors (replay buffer included) and logs.
Ctrl-C saves and ends; --resume, with no other flag than --out, continues."""


class TrainHumanoidSettings(Resumable):
    """Settings of the program."""

    may_change = frozenset({'checkpoint_every', 'log_every', 'threads', 'time_limit'})

    out: Path = Field(Path('out/humanoid-controller'), description='folder of the run')
    task: HumanoidTask = Field('walk', description='what to learn')
    length: float = Field(1.0, gt=0, description='of each stage, as a share of the usual length')
    seed: int = Field(0, ge=0, description='random seed')
    checkpoint_every: int = Field(2500, ge=1, description='sweeps between checkpoints')
    log_every: int = Field(250, ge=1, description='sweeps between log lines')
    threads: int = Field(1, ge=1, description='threads for tensor operations')
    time_limit: float | None = time_limit()


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(TrainHumanoidSettings, _DESCRIPTION, 'controller train-humanoid', argv)
    use_threads(settings.threads)
    try:
        with sole_writer(settings.out, *files_of_run(settings.out)):
            _run(settings)
    except ValueError as error:
        fail(str(error))


def _run(settings: TrainHumanoidSettings) -> None:
    from metagcttt_tools.controller.humanoid import HumanoidTraining

    stages = tuple(
        replace(stage, sweeps=max(1, round(settings.length * stage.sweeps)))
        for stage in STAGES_OF[settings.task]
    )
    training = HumanoidTraining(settings.out, settings.seed, stages)
    if training.checkpoint.exists():
        if not settings.resume:
            fail(f'{training.checkpoint} exists: pass --resume or choose another --out')
        training.restore()
    write_settings(settings.out, settings)
    first = training.sweep
    with (
        stop_on_signal(settings.time_limit) as stop,
        RunLog(settings.out, first) as run_log,
        tqdm(total=training.total, initial=first, unit='sweep', desc='humanoid') as bar,
    ):

        def log(sweep: int, scalars: dict[str, float]) -> None:
            run_log.write(sweep, scalars)
            bar.set_postfix(stage=training.stage.name, refresh=False)
            bar.update(sweep - bar.n)

        finished = training.run(log, stop.is_set, settings.log_every, settings.checkpoint_every)
    if not finished:
        print(f'stopped after sweep {training.sweep}; pass --resume to continue')
        raise SystemExit(stop.status)
    print(f'controller: {settings.out / "controller"}')
