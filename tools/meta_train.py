"""Meta-post-train a policy so that a few steps of test-time training make it an expert."""

from pathlib import Path

from metagcttt_core import (
    Agent,
    CheckpointError,
    DatasetError,
    load_checkpoint,
    MetaConfig,
    post_train,
    save_checkpoint,
    TrajectoryDataset,
)
from metagcttt_core.meta import OuterStep
from metagcttt_core.meta.diagnostics import OuterStepScalars
from pydantic import Field

from tools.cli import fail, parse
from tools.runs import provenance, RunSettings, training_session, use_threads

_DESCRIPTION = """Meta-post-train a pre-trained policy (Algorithm 1).

Example: python -m tools.meta_train --preset pointmaze-medium-navigate-cpu --meta.algorithm fomaml
Writes OUT/checkpoint, OUT/metrics.jsonl and TensorBoard logs.
Ctrl-C saves and ends; --resume goes on."""


class MetaTrainSettings(RunSettings):
    """Settings of the tool."""

    checkpoint: Path = Field(Path('out/pretrain/checkpoint'), description='pre-trained policy')
    out: Path = Field(Path('out/meta'), description='folder of the run')
    meta: MetaConfig = MetaConfig()
    checkpoint_every: int = Field(100, ge=1, description='outer steps between checkpoints')
    snapshot_every: int | None = Field(
        None, ge=1, description='outer steps between policies kept in OUT/snapshots'
    )
    log_every: int = Field(10, ge=1, description='outer steps between log lines (means over them)')


def main(argv: list[str] | None = None) -> None:
    """Run the tool."""
    settings = parse(MetaTrainSettings, _DESCRIPTION, 'meta_train', argv)
    use_threads(settings.threads)
    try:
        _run(settings)
    except (DatasetError, CheckpointError) as error:
        fail(str(error))


def _run(settings: MetaTrainSettings) -> None:
    base = load_checkpoint(settings.checkpoint)
    dataset = TrajectoryDataset.load(settings.dataset)
    decisive = settings.model_dump(mode='json', include={'meta', 'seed', 'threads'})
    decisive['dataset'] = settings.dataset.name
    base.metadata['history'] = [
        *base.metadata.get('history', []),
        {'stage': 'post_train', **decisive, **provenance()},
    ]
    steps = settings.meta.outer_steps
    with training_session(settings, 'post_train', decisive, steps) as session:
        scalars = OuterStepScalars(base)

        def on_step(outer: OuterStep, agent: Agent) -> None:
            session.bar.update()
            scalars.add(outer)
            if settings.snapshot_every and outer.step % settings.snapshot_every == 0:
                save_checkpoint(agent, settings.out / 'snapshots' / f'{outer.step:06d}')
            if outer.step % settings.log_every == 0:
                means = scalars.means(agent)
                session.log.write(outer.step, means)
                session.bar.set_postfix(train=f'{means["inner/last_train_loss"]:.3f}')

        post_train(base, dataset, settings.meta, settings.seed, run=session.run, on_step=on_step)


if __name__ == '__main__':
    main()
