"""Simulation speed: our interface against the environment's own step and the bare physics."""

from collections.abc import Callable
from pathlib import Path
import time
from typing import Any

import numpy as np
from pydantic import Field
from sim_bridge import make_simulator
from sim_bridge.mazes.gym_maze import GymMaze
from tqdm import tqdm

from metagcttt_tools.common.cli import parse
from metagcttt_tools.common.results import Benchmark, markdown_table, write_report

Step = Callable[[np.ndarray], Any]


_DESCRIPTION = """Simulation speed: our step, the environment's own and the bare physics.

Example: metagcttt benchmark sim
Prints a table and writes JSON."""


def main(argv: list[str] | None = None) -> None:
    """Run the benchmark."""
    parse(SimBenchmark, _DESCRIPTION, 'benchmark sim', argv).run()


class SimBenchmark(Benchmark):
    """Control steps per second by maze: bare MuJoCo, the environment's own step, our step."""

    out: Path = Field(Path('out/benchmark/sim'), description='folder for results')
    environments: tuple[str, ...] = Field(
        (
            'pointmaze-medium-v0',
            'antmaze-medium-v0',
            'humanoidmaze-medium-v0',
            'PointMaze_Medium-v3',
            'AntMaze_Medium-v5',
        ),
        min_length=1,
        description='mazes to step',
    )
    steps: int = Field(400, ge=1, description='control steps per round')
    rounds: int = Field(7, ge=1, description='rounds; medians are shown')
    seed: int = Field(0, ge=0, description='of starts and actions')

    def run(self) -> None:
        """Measure, print and write."""
        rows = [self.measure(name) for name in tqdm(self.environments, unit='maze')]
        write_report(self.out / 'sim.json', self, {'steps_per_second': rows})
        print('Control steps per second on one core:\n' + markdown_table(rows))
        print(f'results: {self.out / "sim.json"}')

    def measure(self, name: str) -> dict[str, Any]:
        """Speeds of one maze; all three step through the same actions from the same start."""
        with make_simulator(name) as simulator:
            assert isinstance(simulator, GymMaze)
            rng = np.random.default_rng(self.seed)
            actions = rng.uniform(-1, 1, (self.steps, simulator.spec.act_dim))
            ways = {
                'bare MuJoCo': physics_step(simulator),
                'environment': simulator.environment.step,
                'simulator': simulator.step,
            }
            seconds: dict[str, list[float]] = {way: [] for way in ways}
            for _ in range(self.rounds):  # turns, so that all see the same load of the machine
                for way, step in ways.items():
                    simulator.reset_free(seed=self.seed, start_xy=simulator.tasks[0].start_xy)
                    seconds[way].append(_seconds(step, actions))
        median = {way: float(np.median(values)) for way, values in seconds.items()}
        return {
            'maze': name,
            **{way: self.steps / value for way, value in median.items()},
            'simulator / environment (time)': median['simulator'] / median['environment'],
            'simulator / bare MuJoCo (time)': median['simulator'] / median['bare MuJoCo'],
        }


def physics_step(simulator: GymMaze) -> Step:
    """One control step of the maze's model by MuJoCo alone."""
    import mujoco

    model, data = simulator.environment.model, simulator.environment.data
    repeats = round(simulator.spec.control_period_s / model.opt.timestep)

    def step(action: np.ndarray) -> None:
        data.ctrl[:] = action
        mujoco.mj_step(model, data, nstep=repeats)

    return step


def _seconds(step: Step, actions: np.ndarray) -> float:
    began = time.perf_counter()
    for action in actions:
        step(action)
    return time.perf_counter() - began
