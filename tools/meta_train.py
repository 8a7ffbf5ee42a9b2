"""Meta-post-train a policy so that a few steps of test-time training make it an expert."""

from pathlib import Path

from metagcttt_core import (
    CheckpointError,
    DatasetError,
    load_checkpoint,
    MetaConfig,
    post_train,
    save_checkpoint,
    TrajectoryDataset,
)
from metagcttt_core.config import Settings
from metagcttt_core.meta.diagnostics import OuterStepScalars
from metagcttt_core.training.checkpoint import has_checkpoint, load_training_state
from metagcttt_core.training.run import TrainingInterrupted, TrainingRun
from pydantic import Field
from tqdm import tqdm

from tools.cli import fail, parse
from tools.runs import provenance, RunLog, stop_on_signal, use_threads, write_settings

_DESCRIPTION = """Meta-post-train a pre-trained policy (Algorithm 1).

Example: python -m tools.meta_train --preset pointmaze-medium-navigate-cpu --meta.algorithm fomaml
Writes OUT/checkpoint, OUT/metrics.jsonl and TensorBoard logs.
Ctrl-C saves and ends; --resume goes on."""


class MetaTrainSettings(Settings):
    """Settings of the tool."""

    checkpoint: Path = Field(Path('out/pretrain/checkpoint'), description='pre-trained policy')
    dataset: Path = Field(
        Path('data/pointmaze-medium-navigate-v0.npz'), description='offline dataset (npz)'
    )
    out: Path = Field(Path('out/meta'), description='folder of the run')
    meta: MetaConfig = MetaConfig()
    seed: int = Field(0, ge=0, description='of tasks, splits and batches')
    checkpoint_every: int = Field(100, ge=1, description='outer steps between checkpoints')
    snapshot_every: int | None = Field(
        None, ge=1, description='outer steps between policies kept in OUT/snapshots'
    )
    log_every: int = Field(10, ge=1, description='outer steps between log lines (means over them)')
    threads: int = Field(1, ge=1, description='threads for tensor operations')
    resume: bool = Field(False, description='go on from the checkpoint in OUT, if there is one')


def main(argv: list[str] | None = None) -> None:
    """Run the tool."""
    settings = parse(MetaTrainSettings, _DESCRIPTION, 'meta_train', argv)
    use_threads(settings.threads)
    try:
        _run(settings)
    except (DatasetError, CheckpointError) as error:
        fail(str(error))


def _run(settings: MetaTrainSettings) -> None:
    folder = settings.out / 'checkpoint'
    if not settings.resume and has_checkpoint(folder):
        fail(f'{folder} holds a checkpoint: go on with --resume, or choose another --out')
    base = load_checkpoint(settings.checkpoint)
    dataset = TrajectoryDataset.load(settings.dataset)
    decisive = settings.model_dump(mode='json', include={'meta', 'seed', 'threads'})
    decisive['dataset'] = settings.dataset.name
    base.metadata['history'] = [
        *base.metadata.get('history', []),
        {'stage': 'post_train', **decisive, **provenance()},
    ]
    write_settings(settings.out, settings)
    first = load_training_state(folder).step if settings.resume and has_checkpoint(folder) else 0
    steps = settings.meta.outer_steps
    with (
        stop_on_signal() as stop,
        RunLog(settings.out, first) as log,
        tqdm(total=steps, initial=first, unit='task', desc=settings.meta.algorithm) as bar,
    ):
        scalars = OuterStepScalars(base)

        def on_step(outer, agent):
            bar.update()
            scalars.add(outer)
            if settings.snapshot_every and outer.step % settings.snapshot_every == 0:
                save_checkpoint(agent, settings.out / 'snapshots' / f'{outer.step:06d}')
            if outer.step % settings.log_every == 0:
                means = scalars.means(agent)
                log.write(outer.step, means)
                bar.set_postfix(train=f'{means["inner/last_train_loss"]:.3f}')

        run = TrainingRun(
            'post_train',
            decisive,
            folder,
            every=settings.checkpoint_every,
            resume=settings.resume,
            should_stop=stop.is_set,
        )
        try:
            post_train(base, dataset, settings.meta, settings.seed, run=run, on_step=on_step)
        except TrainingInterrupted as interruption:
            bar.close()
            print(f'{interruption}; go on with --resume')
            raise SystemExit(130) from interruption
    print(f'post-trained policy: {folder}')


if __name__ == '__main__':
    main()
