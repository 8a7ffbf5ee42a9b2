"""Measure speed against a baseline in the same run; prints a table, writes JSON."""

from collections.abc import Callable

import tyro

from tools.benchmarks.meta import MetaBenchmark
from tools.benchmarks.report import Benchmark
from tools.benchmarks.restarts import RestartsBenchmark
from tools.benchmarks.retrieval import RetrievalBenchmark
from tools.benchmarks.ros import RosBenchmark
from tools.benchmarks.sim import SimBenchmark
from tools.benchmarks.training import TrainingBenchmark

_DESCRIPTION = """Measure speed against a baseline in the same run.

Examples: python -m tools.benchmark retrieval, python -m tools.benchmark training"""

BENCHMARKS: dict[str, Callable[..., Benchmark]] = {
    'meta': MetaBenchmark,
    'restarts': RestartsBenchmark,
    'retrieval': RetrievalBenchmark,
    'ros': RosBenchmark,
    'sim': SimBenchmark,
    'training': TrainingBenchmark,
}


def main(argv: list[str] | None = None) -> None:
    """Run the tool."""
    tyro.extras.subcommand_cli_from_dict(BENCHMARKS, args=argv, description=_DESCRIPTION).run()


if __name__ == '__main__':
    main()
