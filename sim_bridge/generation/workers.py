"""Recording of dataset chunks, in this process or in several."""

from collections.abc import Iterator
from concurrent.futures import as_completed, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import cache
import multiprocessing
import multiprocessing.connection
import os
from pathlib import Path
import signal
import threading

from sim_bridge.controllers import DirectionFollower, make_direction_follower
from sim_bridge.generation.chunks import Chunk, ChunkFolder, GenerationError
from sim_bridge.generation.episodes import episode_generator, record_episode
from sim_bridge.generation.plan import GenerationPlan
from sim_bridge.registry import make_simulator
from sim_bridge.simulator import Simulator


def record_chunks(
    plan: GenerationPlan,
    chunks: list[Chunk],
    folder: ChunkFolder,
    processes: int,
    controller: Path | None = None,
) -> Iterator[Chunk]:
    """Record chunks into the folder and yield each once it is on disk, in any order.

    `controller` is as in `make_direction_follower`.

    Raises:
        GenerationError: If a worker process died.
    """
    if processes == 1 or len(chunks) < 2:
        for chunk in chunks:
            yield _record(plan, chunk, folder, controller)
        return
    executor = ProcessPoolExecutor(
        max_workers=min(processes, len(chunks)),
        mp_context=multiprocessing.get_context('spawn'),
        initializer=_prepare_worker,
    )
    try:
        futures = [executor.submit(_record, plan, chunk, folder, controller) for chunk in chunks]
        for future in as_completed(futures):
            yield future.result()
    except BrokenProcessPool as error:
        raise GenerationError(
            'a worker process died (out of memory?): resume with fewer processes'
        ) from error
    finally:
        executor.shutdown(cancel_futures=True)


def _record(
    plan: GenerationPlan, chunk: Chunk, folder: ChunkFolder, controller: Path | None
) -> Chunk:
    simulator, follower = _workbench(plan.environment, plan.standing, controller)
    episodes = [
        record_episode(
            simulator,
            follower,
            plan.kind,
            plan.rows_per_episode,
            plan.noise,
            episode_generator(plan.seed, chunk.validation, index),
            plan.to_goal,
            plan.standing,
        )
        for index in range(chunk.start, chunk.stop)
    ]
    folder.write(chunk, episodes)
    return chunk


@cache
def _workbench(
    environment: str, standing: bool, controller: Path | None
) -> tuple[Simulator, DirectionFollower]:
    """Simulator and controller, built once per process."""
    simulator = make_simulator(environment, standing=standing)
    return simulator, make_direction_follower(simulator.spec, controller)


def _prepare_worker() -> None:
    """Leave Ctrl-C to the parent, and exit when the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()


def end_with_parent() -> None:
    """End this process when the one that started it is gone.

    Otherwise the workers of a killed parent would wait for work forever.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_exit_with, args=(parent.sentinel,), daemon=True).start()


def _exit_with(sentinel: int) -> None:
    multiprocessing.connection.wait([sentinel])
    os._exit(1)
