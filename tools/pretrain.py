"""Pre-train a goal-conditioned policy on an offline dataset."""

from pathlib import Path

from metagcttt_core import CheckpointError, DatasetError, make_agent, TrajectoryDataset
from metagcttt_core.agents import AgentName
from metagcttt_core.config import Settings
from metagcttt_core.training.checkpoint import has_checkpoint, load_training_state
from metagcttt_core.training.pretrain import pretrain, PretrainConfig
from metagcttt_core.training.run import TrainingInterrupted, TrainingRun
from pydantic import Field
from tqdm import tqdm

from tools.cli import fail, parse
from tools.runs import provenance, RunLog, stop_on_signal, use_threads, write_settings

_DESCRIPTION = """Pre-train a goal-conditioned policy on an offline dataset.

Example: python -m tools.pretrain --preset pointmaze-medium-navigate-cpu
Writes OUT/checkpoint, OUT/metrics.jsonl and TensorBoard logs.
Ctrl-C saves and ends; --resume goes on."""


class PretrainSettings(Settings):
    """Settings of the tool."""

    environment: str = Field('pointmaze-medium-v0', description='simulator the policy is for')
    dataset: Path = Field(
        Path('data/pointmaze-medium-navigate-v0.npz'), description='offline dataset (npz)'
    )
    out: Path = Field(Path('out/pretrain'), description='folder of the run')
    agent: AgentName = Field('gcbc', description='kind of agent')
    hidden: tuple[int, ...] = Field((512, 512, 512), description='units of each hidden layer')
    training: PretrainConfig = PretrainConfig()
    seed: int = Field(0, ge=0, description='of initial weights and batches')
    checkpoint_every: int = Field(5000, ge=1, description='steps between checkpoints')
    log_every: int = Field(500, ge=1, description='steps between log lines')
    threads: int = Field(1, ge=1, description='threads for tensor operations')
    resume: bool = Field(False, description='go on from the checkpoint in OUT, if there is one')


def main(argv: list[str] | None = None) -> None:
    """Run the tool."""
    settings = parse(PretrainSettings, _DESCRIPTION, 'pretrain', argv)
    use_threads(settings.threads)
    try:
        _run(settings)
    except (DatasetError, CheckpointError) as error:
        fail(str(error))


def _run(settings: PretrainSettings) -> None:
    folder = settings.out / 'checkpoint'
    if not settings.resume and has_checkpoint(folder):
        fail(f'{folder} holds a checkpoint: go on with --resume, or choose another --out')
    dataset = TrajectoryDataset.load(settings.dataset)
    agent = make_agent(
        settings.agent,
        obs_dim=dataset.obs_dim,
        act_dim=dataset.act_dim,
        hidden=settings.hidden,
        seed=settings.seed,
    )
    decisive = settings.model_dump(
        mode='json', include={'agent', 'hidden', 'training', 'seed', 'threads'}
    )
    decisive['dataset'] = settings.dataset.name
    agent.metadata = {
        'environment': settings.environment,
        'history': [{'stage': 'pretrain', **decisive, **provenance()}],
    }
    write_settings(settings.out, settings)
    first = load_training_state(folder).step if settings.resume and has_checkpoint(folder) else 0
    steps = settings.training.steps
    with (
        stop_on_signal() as stop,
        RunLog(settings.out, first) as log,
        tqdm(total=steps, initial=first, unit='step', desc='pretrain') as bar,
    ):

        def on_step(step, losses):
            bar.update()
            if step % settings.log_every == 0:
                scalars = {f'train/{name}': float(value) for name, value in losses.items()}
                log.write(step, scalars)
                bar.set_postfix(loss=f'{scalars["train/loss"]:.4f}')

        run = TrainingRun(
            'pretrain',
            decisive,
            folder,
            every=settings.checkpoint_every,
            resume=settings.resume,
            should_stop=stop.is_set,
        )
        try:
            pretrain(agent, dataset, settings.training, settings.seed, run=run, on_step=on_step)
        except TrainingInterrupted as interruption:
            bar.close()
            print(f'{interruption}; go on with --resume')
            raise SystemExit(130) from interruption
    print(f'pre-trained policy: {folder}')


if __name__ == '__main__':
    main()
