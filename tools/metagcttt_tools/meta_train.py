"""Meta-post-train a policy so that a few steps of test-time training make it an expert."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TYPE_CHECKING

from metagcttt_core import MetaConfig, TrajectoryDataset
from metagcttt_core.agents.config import ActorLoss
from pydantic import Field

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.session import (
    history_entry,
    left_behind,
    process_group,
    RunSettings,
    snapshot_folder,
    training_session,
    use_threads,
)

if TYPE_CHECKING:
    from metagcttt_core import Agent
    from metagcttt_core.meta import OuterStep

_DESCRIPTION = """Meta-post-train a pre-trained policy (Algorithm 1).

Example: metagcttt meta-train --preset pointmaze-medium-navigate-cpu --meta.algorithm fomaml
Writes OUT/checkpoint, OUT/metrics.jsonl and TensorBoard logs.
Ctrl-C saves and ends; --resume, with no other flag than --out, continues."""


class MetaTrainSettings(RunSettings):
    """Settings of the program."""

    may_change = RunSettings.may_change | {'checkpoint', 'cuda_graphs'}
    may_grow = frozenset({'meta.outer_steps'})

    checkpoint: Path = Field(Path('out/pretrain/checkpoint'), description='pre-trained policy')
    out: Path = Field(Path('out/meta'), description='folder of the run')
    actor_loss: ActorLoss | None = Field(
        None, description='actor loss of a GCIQL or CRL policy from here on; its own by default'
    )
    meta: MetaConfig = MetaConfig()
    checkpoint_every: int = Field(100, ge=1, description='outer steps between checkpoints')
    snapshot_every: int | None = Field(
        None, ge=1, description='outer steps between policies kept in OUT/snapshots'
    )
    cuda_graphs: bool = Field(True, description='on a GPU, replay captured inner steps')
    log_every: int = Field(10, ge=1, description='outer steps between log lines (means over them)')

    @property
    def steps(self) -> int:
        """Steps of the whole run."""
        return self.meta.outer_steps

    def decisive(self) -> dict[str, Any]:
        """The settings that decide the result, with the outer rate that the algorithm takes."""
        return super().decisive() | {'meta.meta_lr': self.meta.outer_lr}


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(MetaTrainSettings, _DESCRIPTION, 'meta-train', argv)
    from metagcttt_core.meta import DivergedError

    use_threads(settings.threads)
    try:
        with process_group(settings.device):
            _run(settings)
    except ValueError as error:
        fail(str(error))
    except DivergedError as error:
        fail(f'{error}; {left_behind(settings)}')


def _run(settings: MetaTrainSettings) -> None:
    from metagcttt_core import load_checkpoint, post_train, save_checkpoint
    from metagcttt_core.meta import DivergedError
    from metagcttt_core.meta.diagnostics import Diagnostics
    from metagcttt_core.meta.health import HealthWatch

    changes = settings.model_dump(include={'actor_loss'}, exclude_none=True)
    base = load_checkpoint(settings.checkpoint, changes=changes).to(settings.device)
    dataset = TrajectoryDataset.load(settings.dataset)
    base.check(dataset)
    decisive = settings.decisive()
    in_force = settings.meta.filter.on(dataset.contract).model_dump(mode='json')
    decisive |= {f'meta.filter.{name}': value for name, value in in_force.items()}
    decisive |= {'dataset': dataset.fingerprint, 'checkpoint': base.fingerprint()}
    base.metadata['history'] = [
        *base.metadata.get('history', []),
        history_entry('post_train', settings, decisive, dataset.made_from),
    ]
    steps = settings.meta.outer_steps
    with training_session(settings, 'post_train', decisive, steps) as session:
        diagnostics = Diagnostics(base)
        watch = HealthWatch(session.log.records)

        def on_step(outer: OuterStep, agent: Agent) -> None:
            session.bar.update()
            diagnostics.add(outer)
            if settings.snapshot_every and outer.step % settings.snapshot_every == 0:
                save_checkpoint(agent, snapshot_folder(settings.out, outer.step))
            if outer.step % settings.log_every == 0:
                record = diagnostics.record(agent)
                warnings = watch.add(record.means)
                session.log.write(
                    outer.step,
                    record.means,
                    samples=record.samples,
                    curves=record.curves,
                    warnings=warnings,
                )
                session.warn(outer.step, warnings)
                session.bar.set_postfix(train=f'{record.means["inner/last_train_loss"]:.3f}')

        try:
            post_train(
                base,
                dataset,
                settings.meta,
                settings.seed,
                run=session.run,
                on_step=on_step,
                cuda_graphs=settings.cuda_graphs,
            )
        except DivergedError as error:
            session.log.write(error.step, {}, warnings=[str(error)])
            raise
