"""Direction followers by robot: from where the robot should go to what its motors do."""

from pathlib import Path
import re

from sim_bridge.controllers.ant import AntFollower
from sim_bridge.controllers.follower import (
    ControllerError,
    DirectionFollower,
    PointFollower,
    VelocityFollower,
)
from sim_bridge.controllers.humanoid import HumanoidFollower
from sim_bridge.controllers.learned import LearnedFollower
from sim_bridge.controllers.rising import RisingHumanoid
from sim_bridge.simulator import SimulatorSpec

BUNDLED = Path(__file__).with_name('weights')
"""Folder of the learned controllers that come with the package, one folder a robot."""

GET_UP = BUNDLED / 'humanoid-get-up'
"""Folder of the controller that makes the humanoid stand."""

_UNLEARNED: dict[str, type[DirectionFollower]] = {
    'pointmaze': PointFollower,
    'PointMaze': VelocityFollower,
}
_OWN_FOLLOWERS: dict[str, type[LearnedFollower]] = {
    'ant': AntFollower,
    'humanoid': HumanoidFollower,
}
_PROGRAMS = {'ant': 'train', 'humanoid': 'train-humanoid'}
_LEARNED = {'antmaze': 'ant', 'humanoidmaze': 'humanoid'}


def make_direction_follower(
    spec: SimulatorSpec, controller: Path | None = None
) -> DirectionFollower:
    """Find the controller that follows directions with a robot.

    Args:
        spec: The simulator whose robot it shall drive.
        controller: Folder of a learned controller, as `metagcttt controller` writes it; by
            default the one that comes with the package, if the robot needs one. A humanoid's
            walks; what makes it get up comes with the package.

    Raises:
        ControllerError: If the robot needs a learned controller and there is none, or the given
            one is not for it; says what is missing.
    """
    family = re.split('[-_]', spec.name)[0]
    if family in _LEARNED:
        follower = _learned(spec, _LEARNED[family], controller)
        if isinstance(follower, HumanoidFollower):
            return RisingHumanoid(follower, HumanoidFollower.load(GET_UP))
        return follower
    if family not in _UNLEARNED:
        raise ControllerError(
            f'{spec.name}: there is no controller for its robot; data can be generated for '
            f'{", ".join([*_UNLEARNED, *_LEARNED])}, and Minari datasets be imported'
        )
    if controller is not None:
        raise ControllerError(
            f'{spec.name}: its robot follows directions without a learned controller, '
            f'got {controller}'
        )
    return _UNLEARNED[family]()


def load_follower(folder: Path) -> LearnedFollower:
    """Read a learned controller, whichever robot it is for.

    Raises:
        ControllerError: If there is none or it is damaged.
    """
    follower = LearnedFollower.load(folder)
    own = _OWN_FOLLOWERS.get(follower.robot)
    return own.load(folder) if own else follower


def _learned(spec: SimulatorSpec, robot: str, folder: Path | None) -> LearnedFollower:
    bundled = BUNDLED / robot
    if folder is None and not bundled.exists():
        raise ControllerError(
            f'{spec.name}: walking takes a learned direction controller ({spec.obs_dim} '
            f'observation and {spec.act_dim} action dimensions), and none comes with this '
            f'package for {robot}: train one (metagcttt controller {_PROGRAMS[robot]}) '
            "and name its folder as the controller, or use OGBench's published datasets, which "
            'load as they are'
        )
    follower = load_follower(folder or bundled)
    if follower.robot != robot:
        raise ControllerError(f'{folder}: drives {follower.robot}, {spec.name} needs {robot}')
    dims, needed = (follower.obs_dim, follower.act_dim), (spec.obs_dim, spec.act_dim)
    if dims != needed:
        raise ControllerError(
            f'{folder or bundled}: is for {dims[0]} observation and {dims[1]} action dimensions, '
            f'{spec.name} has {needed[0]} and {needed[1]}'
        )
    return follower
