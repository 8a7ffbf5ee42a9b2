"""Tasks of a robot, the table of its drives, and what is refused before anything starts."""

from metagcttt_tools import evaluate_robot
from metagcttt_tools.evaluate_robot import RobotTask
import pytest
from tests.tools.tables import squeezed


def goal(success: bool, seconds: float, missed: int) -> dict:
    return {
        'success': success,
        'seconds': seconds,
        'steps': 100,
        'missed_deadlines': missed,
        'adaptation_ms': 12.4,
        'transitions': 5,
    }


def test_table_has_success_over_seeds_and_all_deadlines():
    seeds = {
        0: [goal(True, 10.0, 0), goal(True, 12.0, 1)],
        1: [goal(True, 14.0, 2), goal(False, 30.0, 0)],
    }
    result = {'checkpoint': 'meta', 'budget': 10, 'seeds': seeds}
    missed = {'checkpoint': 'base', 'budget': 0, 'seeds': {0: [goal(False, 30.0, 0)]}}
    table = squeezed(evaluate_robot.format_table([result, missed])).splitlines()
    assert table[-2] == '| meta | 10 | 0.75 ± 0.18 | 12.0 | 12 | 3 of 400 |'
    assert table[-1] == '| base | 0 | 0.00 ± 0.00 | | 12 | 0 of 100 |'


def test_goal_by_values_is_no_position():
    assert RobotTask(goal=(1.0, 2.0)).position == (1.0, 2.0)
    with pytest.raises(ValueError, match='no position'):
        RobotTask(goal={'pan_joint.position': 1.0}).position  # noqa: B018


@pytest.mark.parametrize(
    ('arguments', 'complaint'),
    [
        (['--seeds', '0', '1'], 'must name the {seed}'),
        (['--contract', 'config/robots/turtlebot3.yaml'], 'is not simulated'),
        (['--tasks', 'missing.yaml'], 'missing.yaml: cannot be read'),
    ],
)
def test_what_cannot_be_driven_is_refused(arguments, complaint, capsys):
    pytest.importorskip('metagcttt')
    with pytest.raises(SystemExit, match='2'):
        evaluate_robot.main(arguments)
    assert complaint in capsys.readouterr().err
