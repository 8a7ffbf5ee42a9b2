"""The paper's presets as tables: what `--preset NAME` asks the tools to do."""

from typing import Any

from metagcttt_core.config import Settings

from metagcttt_tools.common.cli import parse
from metagcttt_tools.common.paper import paper_presets, table3
from metagcttt_tools.common.presets import load_preset
from metagcttt_tools.common.results import markdown_table
from metagcttt_tools.evaluate import EvaluateSettings
from metagcttt_tools.meta_train import MetaTrainSettings
from metagcttt_tools.pretrain import PretrainSettings

_DESCRIPTION = """Print the presets of the paper's settings as Markdown tables.

Example: metagcttt presets
Any of them works with --preset NAME for generate, pretrain, meta-train and evaluate."""


class PresetsSettings(Settings):
    """The program has no settings."""


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    parse(PresetsSettings, _DESCRIPTION, 'presets', argv)
    print('Pre-training:\n' + markdown_table(pretraining_rows()))
    print('\nPost-training and test-time training (Table 3):\n' + markdown_table(table3_rows()))


def pretraining_rows() -> list[dict[str, Any]]:
    """Pre-training of each dataset, as the tools would run it."""
    rows = {}
    for name in paper_presets():
        settings = PretrainSettings.model_validate(load_preset(name)['pretrain'])
        agent = getattr(settings, settings.agent)
        rows[settings.dataset] = {
            'dataset': settings.dataset.stem,
            'agent': settings.agent,
            'alpha': f'{agent.alpha:g}' if hasattr(agent, 'alpha') else '',
            'discount': f'{agent.discount:g}',
            'random actor goals': f'{agent.goals.actor.p_randomgoal:g}',
            'hidden': ' '.join(map(str, settings.hidden)),
            'batch': settings.training.batch_size,
            'lr': f'{settings.training.lr:g}',
            'steps': settings.training.steps,
        }
    return list(rows.values())


def table3_rows() -> list[dict[str, Any]]:
    """Each row of the paper's Table 3, as the tools would run it.

    CONTINUAL-TTT has a meta learning rate in the table only.
    """
    rows = []
    for published in table3():
        preset = load_preset(published.name)
        training = MetaTrainSettings.model_validate(preset['meta_train'])
        evaluation = EvaluateSettings.model_validate(preset['evaluate'])
        meta = training.meta
        rows.append(
            {
                'preset': published.name,
                'actor loss': evaluation.actor_loss or 'bc',
                'inner lr': f'{meta.inner_lr:g}',
                'meta lr': f'{published.meta_lr:g}',
                'inner steps': meta.inner_steps,
                'ttt lr': f'{evaluation.ttt.lr:g}',
                'checkpoint': int(evaluation.checkpoints[-1].name),
                'of outer steps': meta.outer_steps,
                'early stop': 'yes' if meta.early_stopping else 'no',
                'horizon': evaluation.ttt.horizon or 'episode',
            }
        )
    return rows
