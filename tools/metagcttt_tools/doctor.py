"""Say what of this project works on this machine, and how to mend what does not."""

from collections.abc import Callable, Iterator
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
import os
from pathlib import Path
import platform
import shutil
import sys
import time
from typing import NamedTuple

from metagcttt_core.config import Settings
from sim_bridge.opengl import choose_opengl_library, rendering_help

from metagcttt_tools.common.cli import parse
from metagcttt_tools.common.extras import EXTRAS, install_command

_DESCRIPTION = """Say what works on this machine, and how to mend what does not.

Example: metagcttt doctor
Changes nothing but the cache of compiled kernels. Ends with status 1 if something is missing."""

_DISCOVERY_S = 5.0
_LAST_DOMAIN = 232  # its ports are the last below 65536
_SHARED_MEMORY_BYTES = 64 * 2**20


class DoctorSettings(Settings):
    """Settings of the program: none."""


class Finding(NamedTuple):
    """What a check found; `mend` is empty where nothing is missing."""

    check: str
    found: str
    mend: str = ''


def python() -> Finding:
    """The interpreter, against those that the pinned packages are for."""
    found = platform.python_version()
    supported = (3, 11) <= sys.version_info[:2] <= (3, 13)
    return Finding('Python', found, '' if supported else 'use Python 3.11, 3.12 or 3.13')


def packages() -> Iterator[Finding]:
    """The optional packages, by the extra that brings them."""
    for extra in sorted(set(EXTRAS.values())):
        names = [name for name, brought_by in EXTRAS.items() if brought_by == extra]
        missing = [name for name in names if find_spec(name) is None]
        yield Finding(
            f'extra {extra}',
            f'without {", ".join(missing)}' if missing else ', '.join(names),
            '; '.join(dict.fromkeys(install_command(name) for name in missing)),
        )


def torch() -> Finding:
    """PyTorch, and what it computes on."""
    import torch

    devices = [torch.cuda.get_device_name(n) for n in range(torch.cuda.device_count())]
    where = ', '.join(devices) or f'{os.cpu_count()} processor cores, no CUDA device'
    driver_but_no_cuda = shutil.which('nvidia-smi') and not devices
    mend = 'this PyTorch sees no GPU: install a build with CUDA' if driver_but_no_cuda else ''
    return Finding('PyTorch', f'{version("torch")}, {where}', mend)


def compiler() -> Finding:
    """The C++ compiler and CMake: `make setup` builds messages, `--compiled` kernels."""
    tools = (os.environ.get('CXX', 'c++'), 'cmake')
    missing = [tool for tool in tools if not shutil.which(tool)]
    mend = 'install g++ and cmake (Debian, Ubuntu: apt install g++ cmake)' if missing else ''
    found = f'without {", ".join(missing)}' if missing else ', '.join(tools)
    return Finding('compiler', found, mend)


def engine() -> Finding:
    """What will compute gradient steps on the processor, and whether the kernels compile."""
    from metagcttt_core import make_agent
    from metagcttt_core.training.engine import make_engine
    from metagcttt_core.training.optimizers import make_optimizer

    agent = make_agent('gcbc', obs_dim=2, act_dim=2, hidden=(8,))
    parameters = list(agent.trained_parameters())
    arguments = agent, make_optimizer('adam', parameters, 1e-3), parameters
    try:
        return Finding('engine', f'{make_engine("kernels", *arguments).name}, compiled')
    except ValueError as error:
        name = make_engine('auto', *arguments).name
        mend = 'steps are slower: install a C compiler (Debian, Ubuntu: apt install gcc)'
        return Finding('engine', f'{name}; {error}', mend)


def rendering() -> Finding:
    """Pictures of the mazes: MuJoCo with an OpenGL library that needs no display."""
    if find_spec('mujoco') is None:
        return Finding('rendering', 'without mujoco', install_command('mujoco'))
    choose_opengl_library()
    import mujoco

    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).close()
    except (mujoco.FatalError, ImportError, RuntimeError, AttributeError) as error:
        # Which of these depends on the OpenGL library that is missing.
        return Finding('rendering', str(error).splitlines()[0], rendering_help())
    return Finding('rendering', os.environ.get('MUJOCO_GL', 'the display'))


def ros() -> Finding:
    """ROS 2 and the workspace of this project."""
    names = ('rclpy', 'geometry_msgs', 'metagcttt_interfaces', 'metagcttt')
    missing = [name for name in names if not _imports(name)]
    if missing:
        return Finding('ROS 2', f'without {", ".join(missing)}', 'make setup')
    return Finding('ROS 2', f'{os.environ.get("ROS_DISTRO", "jazzy")}, workspace built')


def discovery() -> Finding:
    """Two participants of the ROS domain that have to find each other and pass a message."""
    if not _imports('rclpy'):
        return Finding('DDS discovery', 'without rclpy', 'make setup')
    domain = os.environ.get('ROS_DOMAIN_ID') or '0'
    if not domain.isdecimal() or int(domain) > _LAST_DOMAIN:
        mend = f'set ROS_DOMAIN_ID to a number from 0 to {_LAST_DOMAIN}'
        return Finding('DDS discovery', f'ROS_DOMAIN_ID is {domain!r}', mend)
    seconds = _seconds_to_hear(int(domain))
    if seconds is None:
        return Finding(
            'DDS discovery',
            f'nothing heard on domain {domain} within {_DISCOVERY_S:g} s',
            'allow UDP multicast (ports from 7400) in the firewall, and look at ROS_DOMAIN_ID, '
            'ROS_LOCALHOST_ONLY and ROS_AUTOMATIC_DISCOVERY_RANGE',
        )
    return Finding('DDS discovery', f'domain {domain}, first message after {seconds:.1f} s')


def shared_memory() -> Finding:
    """Room in /dev/shm, through which Fast DDS passes messages on one machine."""
    folder = Path('/dev/shm')
    free = shutil.disk_usage(folder).free if folder.is_dir() else 0
    mend = 'enlarge /dev/shm (in a container: --shm-size=256m)'
    enough = free >= _SHARED_MEMORY_BYTES
    return Finding('shared memory', f'{free / 2**20:.0f} MiB free', '' if enough else mend)


def examine() -> Iterator[Finding]:
    """All findings, in the order in which a user meets what they are about."""
    yield python()
    yield torch()
    yield from packages()
    single: tuple[Callable[[], Finding], ...]
    single = (compiler, engine, rendering, ros, discovery, shared_memory)
    for check in single:
        yield check()


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    from tabulate import tabulate

    parse(DoctorSettings, _DESCRIPTION, 'doctor', argv)
    findings = list(examine())
    rows = [(finding.check, finding.found, finding.mend or 'ok') for finding in findings]
    widths = [None, 44, 60]
    print(tabulate(rows, ('check', 'found', 'to do'), maxcolwidths=widths))
    if any(finding.mend for finding in findings):
        raise SystemExit(1)


def _imports(name: str) -> bool:
    try:
        import_module(name)
    except ImportError:  # also of what a package needs in turn
        return False
    return True


def _seconds_to_hear(domain: int) -> float | None:
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from std_msgs.msg import Empty

    contexts = [rclpy.Context() for _ in range(2)]
    heard: list[Empty] = []
    began = time.monotonic()
    try:
        for context in contexts:
            rclpy.init(context=context, domain_id=domain)
        speaker, listener = (
            rclpy.create_node(f'metagcttt_doctor_{number}', context=context)
            for number, context in enumerate(contexts)
        )
        topic = f'metagcttt_doctor_{os.getpid()}'
        publisher = speaker.create_publisher(Empty, topic, 1)
        listener.create_subscription(Empty, topic, heard.append, 1)
        executor = SingleThreadedExecutor(context=contexts[1])
        executor.add_node(listener)
        while not heard and time.monotonic() - began < _DISCOVERY_S:
            publisher.publish(Empty())
            executor.spin_once(timeout_sec=0.05)
    finally:
        for context in contexts:
            context.try_shutdown()
    return time.monotonic() - began if heard else None
