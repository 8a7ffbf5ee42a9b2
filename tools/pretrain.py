"""Pre-train a goal-conditioned policy on an offline dataset."""

from pathlib import Path

from metagcttt_core import CheckpointError, DatasetError, make_agent, TrajectoryDataset
from metagcttt_core.agents import AgentName
from metagcttt_core.training.pretrain import pretrain, PretrainConfig
from pydantic import Field
from torch import Tensor

from tools.cli import fail, parse
from tools.runs import provenance, RunSettings, training_session, use_threads

_DESCRIPTION = """Pre-train a goal-conditioned policy on an offline dataset.

Example: python -m tools.pretrain --preset pointmaze-medium-navigate-cpu
Writes OUT/checkpoint, OUT/metrics.jsonl and TensorBoard logs.
Ctrl-C saves and ends; --resume goes on."""


class PretrainSettings(RunSettings):
    """Settings of the tool."""

    environment: str = Field('pointmaze-medium-v0', description='simulator the policy is for')
    out: Path = Field(Path('out/pretrain'), description='folder of the run')
    agent: AgentName = Field('gcbc', description='kind of agent')
    hidden: tuple[int, ...] = Field((512, 512, 512), description='units of each hidden layer')
    training: PretrainConfig = PretrainConfig()
    checkpoint_every: int = Field(5000, ge=1, description='steps between checkpoints')
    log_every: int = Field(500, ge=1, description='steps between log lines')


def main(argv: list[str] | None = None) -> None:
    """Run the tool."""
    settings = parse(PretrainSettings, _DESCRIPTION, 'pretrain', argv)
    use_threads(settings.threads)
    try:
        _run(settings)
    except (DatasetError, CheckpointError) as error:
        fail(str(error))


def _run(settings: PretrainSettings) -> None:
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
    with training_session(settings, 'pretrain', decisive, settings.training.steps) as session:

        def on_step(step: int, losses: dict[str, Tensor]) -> None:
            session.bar.update()
            if step % settings.log_every == 0:
                scalars = {f'train/{name}': float(value) for name, value in losses.items()}
                session.log.write(step, scalars)
                session.bar.set_postfix(loss=f'{scalars["train/loss"]:.4f}')

        pretrain(
            agent, dataset, settings.training, settings.seed, run=session.run, on_step=on_step
        )


if __name__ == '__main__':
    main()
