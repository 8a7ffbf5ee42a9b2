"""Pre-train a goal-conditioned policy on an offline dataset."""

from __future__ import annotations

from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TYPE_CHECKING

from metagcttt_core import DatasetError, TrajectoryDataset
from metagcttt_core.agents import AgentName, AGENTS
from metagcttt_core.agents.config import CRLOptions, GCBCOptions, GCIQLOptions, SAWOptions
from metagcttt_core.plugins import PluginError
from metagcttt_core.training.config import Precision, PretrainConfig
from pydantic import create_model, Field, field_validator, model_validator
from sim_bridge.registry import describe_environment
import tyro

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.session import (
    history_entry,
    RunSettings,
    snapshot_folder,
    training_session,
    use_threads,
)

if TYPE_CHECKING:
    from metagcttt_core import Agent
    from torch import Tensor

_DESCRIPTION = """Pre-train a goal-conditioned policy on an offline dataset.

Example: metagcttt pretrain --preset pointmaze-medium-navigate-cpu
Writes OUT/checkpoint, OUT/metrics.jsonl and TensorBoard logs.
Ctrl-C saves and ends; --resume, with no other flag than --out, continues."""


_USUAL_ENVIRONMENT = 'pointmaze-medium-v0'
_OF_NO_MAZE = ('import-table', 'import-lerobot')


class PretrainSettings(RunSettings):
    """Settings of the program."""

    may_change = RunSettings.may_change | {'evaluate_every', 'evaluation_episodes'}
    may_grow = frozenset({'training.steps'})

    environment: str | None = Field(
        None,
        description=f'simulator the policy is for; by default {_USUAL_ENVIRONMENT}, and none for '
        "data of other widths, of a robot's contract or of an importer",
    )
    out: Path = Field(Path('out/pretrain'), description='folder of the run')
    agent: AgentName = Field('gcbc', description='kind of agent')
    hidden: tuple[int, ...] = Field((512, 512, 512), description='units of each hidden layer')
    gcbc: Annotated[GCBCOptions, tyro.conf.AvoidSubcommands] = GCBCOptions()
    gciql: Annotated[GCIQLOptions, tyro.conf.AvoidSubcommands] = GCIQLOptions()
    crl: Annotated[CRLOptions, tyro.conf.AvoidSubcommands] = CRLOptions()
    saw: Annotated[SAWOptions, tyro.conf.AvoidSubcommands] = SAWOptions()
    standardise: Literal['auto', 'yes', 'no'] = Field(
        'auto',
        description='give networks observations of mean 0 and deviation 1; auto: for the data of '
        "a robot's contract",
    )
    training: PretrainConfig = PretrainConfig()
    precision: Precision = Field(
        'float32', description='of matrix products; auto is bfloat16 where the device gains by it'
    )
    compiled: bool = Field(False, description='compile the loss: half a minute, then faster steps')
    checkpoint_every: int = Field(5000, ge=1, description='steps between checkpoints')
    log_every: int = Field(
        500, ge=1, description='steps between log lines; with DATASET-val.npz, of its losses too'
    )
    snapshot_every: int | None = Field(
        None, ge=1, description='steps between policies kept in OUT/snapshots'
    )
    evaluate_every: int | None = Field(
        None, ge=1, description='steps between evaluations of the policy in its simulator'
    )
    evaluation_episodes: int = Field(10, ge=1, description='episodes per task of an evaluation')

    @field_validator('environment')
    @classmethod
    def _known(cls, environment: str | None) -> str | None:
        if environment:
            describe_environment(environment)
        return environment

    @property
    def steps(self) -> int:
        """Steps of the whole run."""
        return self.training.steps

    @property
    def maze(self) -> str:
        """The simulator of a policy of data that say nothing of another robot."""
        return self.environment or _USUAL_ENVIRONMENT

    def environment_for(self, dataset: TrajectoryDataset) -> str | None:
        """The simulator of the policy; none for data of a robot, or of unknown origin.

        Args:
            dataset: The data.

        Raises:
            DatasetError: If the simulator that was asked for is another robot's.
        """
        if dataset.contract:
            names = ('environment', 'evaluate_every')
            if asked := [name for name in names if getattr(self, name) is not None]:
                raise DatasetError(
                    f'{self.dataset}: of the robot {dataset.contract["robot"]}, which is in no '
                    f'maze: leave out {" and ".join(asked)}'
                )
            return None
        spec = describe_environment(self.maze).spec
        found, own = (dataset.obs_dim, dataset.act_dim), (spec.obs_dim, spec.act_dim)
        if self.environment:
            if found != own:
                raise DatasetError(
                    f'{self.dataset}: has observations of {found[0]} and actions of {found[1]} '
                    f'values, the robot of {self.environment} has {own[0]} and {own[1]}'
                )
            return self.environment
        if found == own and (dataset.made_from or {}).get('program') not in _OF_NO_MAZE:
            return self.maze
        if self.evaluate_every:
            raise DatasetError(
                f'{self.dataset}: does not say of which simulator it is: evaluate_every takes an '
                'environment'
            )
        return None

    def decisive(self) -> dict[str, Any]:
        """The settings that decide the result, without those of other agents."""
        others = tuple(f'{name}.' for name in AGENTS if name != self.agent)
        return {n: v for n, v in super().decisive().items() if not n.startswith(others)}

    @property
    def agent_settings(self) -> dict[str, Any]:
        """Settings of the chosen agent other than its units."""
        return getattr(self, self.agent).model_dump(exclude={'hidden'})

    @model_validator(mode='after')
    def _settings_are_of_the_agent(self) -> Self:
        if self.agent not in type(self).model_fields:
            AGENTS.find(self.agent)  # says why it cannot be loaded
        for name in AGENTS:
            given = getattr(self, name, None)
            if given is None:  # of a package that cannot be loaded
                continue
            if name != self.agent and given != type(given)():
                raise ValueError(f'agent is {self.agent}: the settings of {name} have no effect')
            if 'hidden' in given.model_dump(exclude_defaults=True):
                raise ValueError(f'{name}.hidden has no effect here; set hidden')
        return self


@cache
def settings_type() -> type[PretrainSettings]:
    """The settings with those of agents from other packages, under the names of the agents."""
    fields: dict[str, Any] = {}
    for name in AGENTS.plugins:
        with suppress(PluginError):  # raised by the settings where that agent is asked for
            settings = AGENTS[name].settings_type
            fields[name] = (Annotated[settings, tyro.conf.AvoidSubcommands], settings())
    return create_model('PretrainSettings', __base__=PretrainSettings, **fields)


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(settings_type(), _DESCRIPTION, 'pretrain', argv)
    from metagcttt_core import CheckpointError

    use_threads(settings.threads)
    try:
        _run(settings)
    except (DatasetError, CheckpointError) as error:
        fail(str(error))


def _run(settings: PretrainSettings) -> None:
    from metagcttt_core import make_agent, save_checkpoint
    from metagcttt_core.data import Scaling
    from metagcttt_core.training.numerics import resolve_precision
    from metagcttt_core.training.pretrain import pretrain

    from metagcttt_tools.common.pretraining_metrics import (
        as_scalars,
        success_rates,
        Throughput,
        Validation,
        validation_data,
    )

    dataset = TrajectoryDataset.load(settings.dataset)
    agent = make_agent(
        settings.agent,
        obs_dim=dataset.obs_dim,
        act_dim=dataset.act_dim,
        hidden=settings.hidden,
        seed=settings.seed,
        **settings.agent_settings,
    ).to(settings.device)
    standardise = {'auto': dataset.contract is not None, 'yes': True, 'no': False}
    agent.scaling = Scaling.of(dataset, standardise=standardise[settings.standardise])
    precision = resolve_precision(settings.precision, agent)
    environment = settings.environment_for(dataset)
    decisive = settings.decisive() | {
        'environment': environment,
        'dataset': dataset.fingerprint,
        'precision': precision,
    }
    agent.metadata = {
        **({'environment': environment} if environment else {}),
        **({'contract': dataset.contract} if dataset.contract else {}),
        'history': [history_entry('pretrain', settings, decisive, dataset.made_from)],
    }
    held_out = validation_data(settings.dataset, dataset)
    validation = Validation(held_out, settings.training.batch_size, precision)
    with training_session(settings, 'pretrain', decisive, settings.training.steps) as session:
        throughput = Throughput()

        def on_step(step: int, losses: dict[str, Tensor], agent: Agent) -> None:
            session.bar.update()
            throughput.count()
            due = partial(_is_due, step)
            scalars: dict[str, float] = {}
            if due(settings.log_every):
                scalars = as_scalars(losses) | {'speed/updates_per_s': throughput.rate()}
                session.bar.set_postfix(loss=f'{scalars["train/loss"]:.4f}')
                scalars |= validation.losses(agent, settings.seed, step)
            if environment and due(settings.evaluate_every):
                scalars |= success_rates(
                    agent, environment, settings.evaluation_episodes, settings.seed
                )
            if due(settings.snapshot_every):
                save_checkpoint(agent, snapshot_folder(settings.out, step))
            if scalars:
                session.log.write(step, scalars)
                throughput.restart()

        pretrain(
            agent,
            dataset,
            settings.training,
            settings.seed,
            precision=precision,
            compiled=settings.compiled,
            run=session.run,
            on_step=on_step,
        )


def _is_due(step: int, every: int | None) -> bool:
    return every is not None and step % every == 0
