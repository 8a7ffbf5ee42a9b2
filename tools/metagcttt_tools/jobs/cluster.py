"""Jobs on a Ray cluster whose machines share the folder of the study."""

from concurrent.futures import Future
from functools import partial
import logging
import os
import socket
import time
from typing import Any

import ray
from ray.exceptions import RayTaskError, TaskCancelledError

from metagcttt_tools.jobs.program import JobError, JobLostError, JobStoppedError, run_program
from metagcttt_tools.jobs.scheduler import Job, Resources

_ANSWER_S = 10.0
_ASK_AGAIN_S = 5.0


class RayScheduler:
    """Runs each job as a Ray task, which runs the program on the machine that Ray chooses.

    A task whose program, worker or machine is killed begins again where there is room, up to
    `Resources.retries` times; the program goes on from its checkpoint.
    """

    def __init__(self, resources: Resources) -> None:
        """Connect to the cluster that RAY_ADDRESS names, or that runs on this machine.

        Raises:
            ValueError: If there is none.
        """
        _check_address()
        self._resources = resources
        try:
            context = ray.init('auto', log_to_driver=False, logging_level=logging.WARNING)
        except ConnectionError as error:
            raise ValueError(
                'no Ray cluster found: ray start --head starts one here, '
                'RAY_ADDRESS=HOST:PORT names another'
            ) from error
        total = ray.cluster_resources()
        machines = [node for node in ray.nodes() if node['Alive']]
        print(
            f'cluster: {len(machines)} machines, {total.get("CPU", 0):g} cores, '
            f'{total.get("GPU", 0):g} GPUs; dashboard: '
            f'{"http://" + context.dashboard_url if context.dashboard_url else "not started"}'
        )
        self._largest = {
            kind: max(node['Resources'].get(kind, 0.0) for node in machines)
            for kind in ('CPU', 'GPU', 'memory')
        }
        self._tasks: list[ray.ObjectRef[None]] = []
        self._asks_again_at = 0.0

    def submit(self, job: Job) -> Future[None]:
        """Queue a job.

        Raises:
            JobError: If no machine is large enough for it.
        """
        needs = {
            'CPU': job.cpus,
            'GPU': self._resources.gpus if job.gpu else 0,
            'memory': self._resources.memory_gib * 2**30,
        }
        for kind, amount in needs.items():
            if amount > self._largest[kind]:
                raise JobError(
                    f'{job.invocation.program} asks for {amount:g} of {kind} on one machine, '
                    f'the largest has {self._largest[kind]:g}'
                )
        task = _run.options(
            num_cpus=needs['CPU'],
            num_gpus=needs['GPU'],
            memory=needs['memory'] or None,
            max_retries=self._resources.retries,
            retry_exceptions=[JobLostError],
            name=f'{job.invocation.program} {job.invocation.out.name}',
        ).remote(job.invocation)
        self._tasks.append(task)
        future: Future[None] = Future()
        task.future().add_done_callback(partial(_hand_on, future))
        return future

    def stop(self) -> None:
        """Make running jobs save and end, and start no more.

        Called again, it asks again, should a request have been lost.
        """
        if time.monotonic() < self._asks_again_at:
            return
        self._asks_again_at = time.monotonic() + _ASK_AGAIN_S
        for task in self._tasks:
            ray.cancel(task)


def _check_address() -> None:
    """Refuse an address where nothing listens, which Ray tries for minutes, deaf to signals."""
    address = os.environ.get('RAY_ADDRESS', 'auto')
    if address in ('auto', 'local'):
        return
    host, _, port = address.removeprefix('ray://').rpartition(':')
    if not host or not port.isdecimal() or not 0 < int(port) < 1 << 16:
        raise ValueError(f'RAY_ADDRESS must be HOST:PORT or auto, got {address!r}')
    try:
        socket.create_connection((host.strip('[]'), int(port)), _ANSWER_S).close()
    except OSError as error:
        raise ValueError(
            f'RAY_ADDRESS {address}: no Ray cluster answers there: {error}'
        ) from error


@ray.remote
def _run(invocation: Any) -> None:
    run_program(invocation)


def _hand_on(future: Future[None], ended: Future[None]) -> None:
    """The outcome of a task, in the words of a scheduler."""
    error = ended.exception()
    if error is None:
        future.set_result(None)
    elif isinstance(error, TaskCancelledError | JobStoppedError):
        future.set_exception(JobStoppedError(str(error)))
    else:
        cause = error.cause if isinstance(error, RayTaskError) else error
        future.set_exception(JobError(str(cause)))
