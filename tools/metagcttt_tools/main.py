"""The command `metagcttt`: one subcommand a program, imported when it is asked for."""

from collections.abc import Callable, Mapping
from functools import reduce
from importlib import import_module
from importlib.metadata import version
from operator import or_
import re
import sys
from typing import Annotated, Any, NamedTuple

from metagcttt_core.files import in_words
from pydantic import create_model
import tyro

from metagcttt_tools.common.cli import check_sections, fail, flags_of
from metagcttt_tools.common.extras import EXTRAS, install_command

_DESCRIPTION = """Goal-conditioned policies that adapt at test time, from data to robot.

Each program teaches with --help and takes --preset NAME: metagcttt presets lists them.
metagcttt --tyro-print-completion bash (or zsh, tcsh, fish) prints a completion script."""


class Program(NamedTuple):
    """A subcommand: its module, which has a `main(argv)`, and its line in the help."""

    module: str
    summary: str


class Group(NamedTuple):
    """A subcommand with subcommands of its own."""

    programs: dict[str, Program]
    summary: str


PROGRAMS: dict[str, Program | Group] = {
    'generate': Program('generate', 'Generate an offline dataset of a maze.'),
    'download': Program('download', "Download one of OGBench's published datasets."),
    'import-recordings': Program('import_recordings', 'Turn recordings into a dataset.'),
    'import-bags': Program('import_bags', 'Turn bags of a robot into a dataset, by its contract.'),
    'import-table': Program('import_table', 'Turn CSV or parquet files into a dataset.'),
    'import-lerobot': Program('import_lerobot', 'Turn a LeRobotDataset v3 into a dataset.'),
    'export-lerobot': Program('export_lerobot', 'Write a dataset as a LeRobotDataset v3.'),
    'inspect': Program('inspect_data', 'Say what is in a dataset, and draw its coverage.'),
    'pretrain': Program('pretrain', 'Pre-train a policy on an offline dataset.'),
    'convert': Program('convert', "Convert a policy trained with OGBench's own code."),
    'meta-train': Program('meta_train', 'Meta-post-train a policy (Algorithm 1).'),
    'evaluate': Program('evaluate', 'Success of policies by test-time training budget.'),
    'evaluate-offline': Program(
        'evaluate_offline', 'Action error on held-out data, without a simulator.'
    ),
    'evaluate-ros': Program('evaluate_ros', 'The same, driven through the ROS graph.'),
    'evaluate-robot': Program('evaluate_robot', 'Success on a simulated robot, by its contract.'),
    'sweep': Program('sweep', 'Run a whole study: training, post-training, evaluation.'),
    'report': Program('report', 'Tables and figures of a study.'),
    'compare': Program('compare', 'Compare evaluations in one table and picture.'),
    'demo': Program('demo', 'Drive the point maze over ROS 2: three policies, five goals.'),
    'view': Program('view', 'Watch a running robot in a browser and send goals by a click.'),
    'doctor': Program('doctor', 'What works on this machine, and how to mend the rest.'),
    'presets': Program('show_presets', "List the presets; the paper's settings as tables."),
    'diagnostics': Program('diagnostics', 'Draw how a post-training run went.'),
    'loss-curves': Program('loss_curves', 'Draw the losses of test-time training by part.'),
    'success-curve': Program('success_curve', 'Draw success over pre-training.'),
    'draw-episodes': Program('draw_episodes', 'Draw paths and retrieved data of episodes.'),
    'draw-values': Program('draw_values', "Draw a critic's value of each place of a maze."),
    'top-view': Program('top_view', 'Draw a recording from above, or film it.'),
    'benchmark': Group(
        {
            'adapter': Program('benchmarks.adapter', 'Time of an expert where many robots ask.'),
            'cluster': Program('benchmarks.cluster', 'Overhead of Ray, and studies after kills.'),
            'inner-loop': Program(
                'benchmarks.inner_loop', 'Milliseconds per inner step, and of JAX.'
            ),
            'meta': Program('benchmarks.meta', 'Outer steps of meta-post-training a second.'),
            'restarts': Program('benchmarks.restarts', 'Time until a killed node serves again.'),
            'retrieval': Program('benchmarks.retrieval', 'Milliseconds per filter query.'),
            'ros': Program('benchmarks.ros', 'Latency and deadlines of the policy node.'),
            'sim': Program('benchmarks.sim', 'Control steps a second by maze.'),
            'training': Program('benchmarks.training', 'Milliseconds per gradient step.'),
        },
        'Measure speed against a baseline in the same run.',
    ),
    'contract': Group(
        {'check': Program('contract_check', 'Check a contract, and whether a bag satisfies it.')},
        'Contracts of robots: what is read and written on which topics.',
    ),
    'controller': Group(
        {
            'train': Program('controller_train', "Train the ant's controller (SAC)."),
            'train-humanoid': Program(
                'controller_train_humanoid', "Train the humanoid's controller (SAC)."
            ),
            'measure': Program('controller_measure', 'Measure how well it follows directions.'),
        },
        'Controllers that walk a robot along a direction, which make data.',
    ),
    'pack-assets': Program('pack_assets', 'Pack policies and data into the assets of the demo.'),
}

_ROS = frozenset({'domain_coordinator', 'metagcttt', 'metagcttt_interfaces', 'rclpy'})


def main(argv: list[str] | None = None) -> None:
    """Run the command line: `metagcttt PROGRAM [ARGUMENT...]`."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments == ['--version']:
        print(f'metagcttt {version("metagcttt-core")}')
        return
    if arguments and arguments[0].startswith('--tyro-'):
        tyro.cli(_every_flag(PROGRAMS), args=arguments, prog='metagcttt')
    prog, description, programs = 'metagcttt', _DESCRIPTION, PROGRAMS
    while arguments and arguments[0] in programs:
        name, *arguments = arguments
        program = programs[name]
        if isinstance(program, Program):
            _run(program, arguments)
            return
        prog, description, programs = f'{prog} {name}', program.summary, dict(program.programs)
    # Help or a mistake is left, and neither takes the programs themselves.
    tyro.extras.subcommand_cli_from_dict(
        {name: _described(program.summary) for name, program in programs.items()},
        args=arguments,
        prog=prog,
        description=description,
    )


def sections() -> list[str]:
    """Of presets: a program's is its name with underscores."""
    names = []
    for name, program in PROGRAMS.items():
        inner = [''] if isinstance(program, Program) else program.programs
        names += [re.sub(r'\W', '_', f'{name} {part}'.strip()) for part in inner]
    return names


def _run(program: Program, arguments: list[str]) -> None:
    check_sections(arguments, sections())
    try:
        _main_of(program)(arguments)
    except ModuleNotFoundError as error:
        missing = (error.name or '').partition('.')[0]
        if missing in EXTRAS:
            fail(f'this takes {missing}, which is not installed: {install_command(missing)}')
        if missing in _ROS:
            fail(f'this takes ROS 2 and the workspace ({missing} is missing): make setup')
        raise
    except OSError as error:  # names the file: one that is missing, unreadable or on a full disk
        fail(in_words(error))


def _every_flag(programs: Mapping[str, Program | Group]) -> Any:
    """The type of a command line with all programs and their flags, which imports them all."""
    subcommands: list[Any] = []
    for name, program in programs.items():
        flags: Any
        if isinstance(program, Program):
            flags = flags_of(_main_of(program))
        else:
            inner: Any = Annotated[_every_flag(program.programs), tyro.conf.arg(name='')]
            flags = create_model(name, program=(inner, ...))
        described = tyro.conf.subcommand(name, description=program.summary, prefix_name=False)
        subcommands.append(Annotated[flags, described])
    return reduce(or_, subcommands)


def _main_of(program: Program) -> Callable[[list[str]], None]:
    main: Callable[[list[str]], None] = import_module(f'metagcttt_tools.{program.module}').main
    return main


def _described(summary: str) -> Callable[[], None]:
    def described() -> None:
        raise AssertionError('a program that is named was run')

    described.__doc__ = summary
    return described
