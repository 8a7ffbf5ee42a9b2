"""Contracts are read as a whole; every mistake has its line and says what is accepted."""

import json
from pathlib import Path

from metagcttt_core.robot import Contract, ContractError, identity_fault, load_contract
import pytest

from tests.core.robot.messages import ARM, contract, DRIVE, ROBOTS

FILES = sorted(ROBOTS.glob('*.yaml'))


def test_starting_contracts_load():
    dims = {file.stem: load_contract(file) for file in FILES}
    assert {name: (c.obs_dim, c.act_dim) for name, c in dims.items()} == {
        'arm4': (4, 4),
        'arm6': (12, 6),
        'diffbot': (4, 2),
        'diffdrive': (6, 2),
        'quadruped': (37, 12),
        'turtlebot3': (6, 2),
        'turtlebot3-humble': (6, 2),
    }


@pytest.mark.parametrize('file', FILES, ids=lambda file: file.stem)
def test_starting_contracts_point_editors_to_the_schema(file):
    first = file.read_text().splitlines()[0]
    assert first == '# yaml-language-server: $schema=contract.schema.json'


def test_committed_schema_is_that_of_the_settings():
    committed = json.loads((ROBOTS / 'contract.schema.json').read_text())
    assert committed == Contract.model_json_schema()


def test_columns_are_named_in_order():
    assert contract().columns == ['x', 'y', 'yaw.cos', 'yaw.sin']
    assert contract(ARM).columns == ['a.position', 'b.position']
    assert contract(ARM).act_dim == 2


@pytest.mark.parametrize(
    ('old', 'new', 'line', 'message'),
    [
        ('rate_hz: 10', 'rate_hz: fast', 3, 'rate_hz: Input should be a valid number'),
        ('rate_hz: 10', 'rate_hz: yes', 3, 'rate_hz: must be a number, not true or false'),
        ('rate_hz: 10', 'rate_hz: 0', 3, 'rate_hz: Input should be greater than 0, got 0'),
        ('stamp: header', 'stamp: heder', 9, "stamp: Input should be 'header' or 'receive'"),
        ('stamp: header', 'stmp: header', 9, "no setting 'stmp'; did you mean 'stamp'?"),
        ('frame_id: odom', 'topic: odom', 8, 'topic is given twice'),
        ('name: x', 'name: y', 2, 'several observed values are named y'),
        ('[x, y]', '[x, z]', 2, 'no observed value is named z (there are: x, y, yaw.cos'),
        ('low: -2,', 'low: 2,', 19, 'low must be below high'),
        ('low: -2,', 'low: 1,', 15, 'zeros is outside the limits of angular.z; use hold'),
        ('low: -2,', 'low: [-2, 1],', 19, 'low needs 1 or 1 numbers, got 2'),
        ('low: -2,', 'low: .nan,', 19, 'finite number'),
        ('fallback: zeros', 'fallback: stop', 20, "Input should be 'zeros', 'hold' or 'nothing'"),
        ('field: linear.x', 'field: Linear-x', 18, 'String should match pattern'),
        ('/msg/Twist', '/Twist', 16, 'String should match pattern'),
        ('topic: odom', 'topic: [odom', 7, 'not valid YAML'),
        ('max_rate: 1.0', 'max_rate: 0', 18, 'max_rate must be positive'),
        ('stamp: header', 'stamp: header\n    timeout_s: -1', 10, 'timeout_s: Input should be gr'),
        ('fallback: zeros', 'fallback: zeros\n    timeout_s: 0.05', 2, 'shorter than a period'),
        ('transform: heading', 'transform: heading, size: 3', 13, 'takes no joints'),
    ],
)
def test_mistakes_are_named_with_their_line(tmp_path: Path, old, new, line, message):
    assert old in DRIVE
    file = tmp_path / 'robot.yaml'
    file.write_text(DRIVE.replace(old, new, 1))
    with pytest.raises(ContractError) as caught:
        load_contract(file)
    found = str(caught.value).splitlines()
    assert any(each.startswith(f'{file}:{line}: ') and message in each for each in found), found


def test_every_mistake_is_named_at_once(tmp_path: Path):
    file = tmp_path / 'robot.yaml'
    file.write_text(
        DRIVE.replace('rate_hz: 10', 'rate_hz: 0').replace('stamp: header', 'stamp: 1')
    )
    with pytest.raises(ContractError) as caught:
        load_contract(file)
    assert [line.split(':')[1] for line in str(caught.value).splitlines()] == ['3', '9']


def test_contract_about_nothing_is_refused(tmp_path: Path):
    file = tmp_path / 'robot.yaml'
    file.write_text('robot: a\nrate_hz: 1\nobserve: []\nact: []\n')
    with pytest.raises(ContractError) as caught:
        load_contract(file)
    assert [line.split(':')[1] for line in str(caught.value).splitlines()] == ['3', '4']


@pytest.mark.parametrize(
    ('content', 'message'),
    [
        (None, 'cannot be read'),
        ('- 1', 'a mapping'),
        ('', 'a mapping'),
        ('a: !x 1', 'not valid'),
        (f'a: [{"1," * 70000}]', 'is no file of settings, it has over 131072 bytes'),
        (f'rate_hz: {"59:" * 3000}1', 'rate_hz: .*, got a number of thousands of digits'),
        (f'rate_hz: {"x" * 1000}', r'rate_hz: .*, got .x{199}\.{3}\n'),
    ],
)
def test_files_that_hold_no_contract_are_refused(tmp_path: Path, content, message):
    file = tmp_path / 'robot.yaml'
    if content is not None:
        file.write_text(content)
    with pytest.raises(ContractError, match=message):
        load_contract(file)


@pytest.mark.parametrize(
    ('old', 'new', 'message'),
    [
        ('joints: [a, b]', 'joints: [a, a]', 'joints names a more than once'),
        ('joints: [a, b]', 'joints: [a, b], size: 2', 'joints or size, not both'),
        ('joints: [a, b]', 'joints: [a, b], origin: 1', 'have no origin'),
        ('measured: position', 'measured: effort', 'no observed value is named b.effort'),
        ('joints: [b, a]', 'size: 2', 'measured takes joints'),
        ('high: [3, 2]', 'high: [3, 2, 1]', 'high needs 1 or 2 numbers, got 3'),
        ('measured: position', 'reach: 0.3', 'reach needs measured'),
        ('max_rate: 1', 'reach: 0', 'reach must be positive'),
        ('max_rate: 1', 'reach: [1, 2, 3]', 'reach needs 1 or 2 numbers, got 3'),
        ('[a, b]}', '[a, b], scale: 2}', 'a.position is measured for commands: it takes no scale'),
        ('fault: hold', 'fault: zeros', 'fallback fault: zeros would drive the positions of data'),
        ('[a, b]}', '[a, b], clamp: [1, 0]}', 'clamp takes a lower and a higher bound'),
        ('[a, b]}', '[a, b], scale: 0}', 'scale must be 1e-12 to 1e12'),
        ('[a, b]}', '[a, b], scale: -1.0e+300}', 'scale must be 1e-12 to 1e12'),
    ],
)
def test_joints_that_do_not_fit_are_refused(old, new, message):
    assert old in ARM
    with pytest.raises(ValueError, match=message):
        contract(ARM.replace(old, new, 1))


@pytest.mark.parametrize(
    ('text', 'section', 'message'),
    [
        (DRIVE, 'goal: {tolerance: {z: 1}}', r'no value z to tolerate .*distance, x, y, yaw'),
        (DRIVE, 'goal: {tolerance: {distance: 0}}', 'greater than 0'),
        (DRIVE, 'goal: {tolerance: {}}', 'at least 1'),
        (DRIVE, 'goal: {tolerance: {x: 1}, yaw: x}', r'yaw x is no observed heading .*yaw'),
        (DRIVE, 'goal: {tolerance: {x: 1}, yaw: yaw}', 'yaw needs a tolerance'),
        (ARM, 'goal: {tolerance: {distance: 1}}', 'no value distance'),
        (ARM, 'goal: {tolerance: {position: 1}, map: {}}', 'a map takes a contract with a pos'),
        (ARM, 'retrieval: {epsilon: 1}', 'retrieval needs values'),
        (ARM, 'retrieval: {values: [c], epsilon: 1}', 'no observed value is named c'),
    ],
)
def test_goals_and_distances_are_about_observed_values(text, section, message):
    with pytest.raises(ValueError, match=message):
        contract(f'{text}{section}\n')


def test_zeros_go_to_positions_only_when_that_is_said():
    said = 'fallback: zeros\n    zero_is_a_safe_position: true\n'
    assert contract(ARM.partition('fallback')[0] + said).act[0].fallback.fault == 'zeros'


def test_identity_is_what_the_numbers_mean():
    fingerprint = contract().identity['fingerprint']
    for old, new in (('robot: cart', 'robot: car'), ('topic: odom', 'topic: /a/odom')):
        other = contract(DRIVE.replace(old, new)).identity
        assert identity_fault('it', other, contract().identity) == ''
    for old, new, difference in (
        ('rate_hz: 10', 'rate_hz: 20', 'rate_hz 20.0, not 10.0'),
        ('high: 2', 'high: 3', 'actions 1 is name angular.z low -2.0 high 3.0, not name'),
        ('origin: 5000000', 'origin: 0', 'observations 1 is name y'),
        ('      - {field: angular.z, low: -2, high: 2}\n', '', '1 actions, not 2'),
    ):
        other = contract(DRIVE.replace(old, new).replace('robot: cart', 'robot: car')).identity
        fault = identity_fault('the data d.npz', other, contract().identity)
        assert fault.startswith(
            f'the data d.npz was made for car (contract {other["fingerprint"]}'
        )
        assert f'not for cart (contract {fingerprint})' in fault
        assert difference in fault
    assert identity_fault('it', None, contract().identity) == ''


def test_distances_use_the_position_unless_values_are_named():
    assert contract().position_dims == (0, 1)
    assert contract(ARM).position_dims == ()
    named = 'retrieval: {values: [b.position], epsilon: 1}\n'
    assert contract(ARM + named).position_dims == (1,)
