from collections import namedtuple
import importlib.util
import shutil
import sys

from metagcttt_core import kernels
from metagcttt_tools import doctor
from metagcttt_tools.doctor import Finding
import pytest


def test_all_is_well_where_the_tests_run(capsys, monkeypatch) -> None:
    monkeypatch.setattr(doctor, '_seconds_to_hear', lambda domain: 0.1)
    doctor.main([])
    printed = capsys.readouterr().out
    for check in (
        'Python',
        'PyTorch',
        'extra mazes',
        'compiler',
        'engine',
        'rendering',
        'ROS 2',
        'DDS',
    ):
        assert check in printed


def test_what_is_missing_ends_with_status_1_and_its_remedy(capsys, monkeypatch) -> None:
    monkeypatch.setattr(
        doctor, 'examine', lambda: iter([Finding('a', 'b'), Finding('c', 'd', 'e')])
    )
    with pytest.raises(SystemExit) as ended:
        doctor.main([])
    assert ended.value.code == 1
    assert [line.split() for line in capsys.readouterr().out.splitlines()[2:]] == [
        ['a', 'b', 'ok'],
        ['c', 'd', 'e'],
    ]


def test_missing_packages_are_named_with_what_installs_them(monkeypatch) -> None:
    found = importlib.util.find_spec
    gone = {'matplotlib'}
    monkeypatch.setattr(doctor, 'find_spec', lambda name: None if name in gone else found(name))
    plots = {finding.check: finding for finding in doctor.packages()}['extra plots']
    assert plots == ('extra plots', 'without matplotlib', 'pip install "metagcttt-core[plots]"')


@pytest.mark.parametrize(
    ('version', 'right'), [((3, 10), False), ((3, 11), True), ((3, 13), True), ((3, 14), False)]
)
def test_python_of_another_version_is_refused(monkeypatch, version, right) -> None:
    monkeypatch.setattr(sys, 'version_info', (*version, 1))
    assert (doctor.python().mend == '') == right


def test_compiler_is_the_one_that_cxx_names(monkeypatch) -> None:
    monkeypatch.setenv('CXX', 'nosuch++')
    assert doctor.compiler().found == 'without nosuch++'
    assert 'apt install g++' in doctor.compiler().mend


@pytest.fixture
def nothing_compiled(tmp_path, monkeypatch):
    """A machine whose kernels nothing has looked for yet."""
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path))
    kernels._find.cache_clear()
    yield
    kernels._find.cache_clear()


def test_engine_is_told_with_the_reason_of_a_slower_one(nothing_compiled, monkeypatch) -> None:
    monkeypatch.setenv('CC', 'no-such-compiler')
    finding = doctor.engine()
    assert finding.found.startswith('analytic; engine kernels: no-such-compiler: ')
    assert 'apt install gcc' in finding.mend
    monkeypatch.delenv('CC')
    kernels._find.cache_clear()
    assert doctor.engine() == ('engine', 'kernels, compiled', '')


@pytest.mark.mujoco
def test_rendering_that_fails_says_what_to_install(monkeypatch) -> None:
    import mujoco

    def fails(*_: object) -> None:
        raise mujoco.FatalError('no OpenGL\nplatform')

    monkeypatch.setattr(mujoco, 'Renderer', fails)
    finding = doctor.rendering()
    assert finding.found == 'no OpenGL'
    assert 'libegl1' in finding.mend


def test_little_shared_memory_is_told(monkeypatch) -> None:
    usage = namedtuple('usage', 'free')
    monkeypatch.setattr(shutil, 'disk_usage', lambda _: usage(63 * 2**20))
    assert doctor.shared_memory().mend.startswith('enlarge /dev/shm')
    monkeypatch.setattr(shutil, 'disk_usage', lambda _: usage(64 * 2**20))
    assert doctor.shared_memory().mend == ''


@pytest.mark.ros
def test_participants_of_a_domain_find_each_other(monkeypatch) -> None:
    with pytest.importorskip('domain_coordinator').domain_id() as domain:
        monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
        finding = doctor.discovery()
    assert finding.mend == ''
    assert finding.found.startswith(f'domain {domain}, first message after ')


@pytest.mark.ros
def test_silence_on_the_domain_is_told(monkeypatch) -> None:
    monkeypatch.setenv('ROS_DOMAIN_ID', '7')
    monkeypatch.setattr(doctor, '_seconds_to_hear', lambda domain: None)
    finding = doctor.discovery()
    assert finding.found == 'nothing heard on domain 7 within 5 s'
    assert 'multicast' in finding.mend


@pytest.mark.ros
@pytest.mark.parametrize('domain', ['one', '-1', '233', '1.5'])
def test_domain_that_is_none_is_named(monkeypatch, domain: str) -> None:
    monkeypatch.setenv('ROS_DOMAIN_ID', domain)
    assert doctor.discovery().found == f'ROS_DOMAIN_ID is {domain!r}'


def test_ros_without_the_workspace_is_told(monkeypatch) -> None:
    monkeypatch.setattr(doctor, '_imports', lambda name: not name.startswith('metagcttt'))
    assert doctor.ros() == ('ROS 2', 'without metagcttt_interfaces, metagcttt', 'make setup')
    monkeypatch.setattr(doctor, '_imports', lambda name: False)
    assert doctor.discovery() == ('DDS discovery', 'without rclpy', 'make setup')


def test_gpu_that_pytorch_does_not_see_is_told(monkeypatch) -> None:
    monkeypatch.setattr('torch.cuda.device_count', lambda: 0)
    monkeypatch.setattr(shutil, 'which', lambda tool: f'/usr/bin/{tool}')
    assert doctor.torch().mend.startswith('this PyTorch sees no GPU')
    monkeypatch.setattr(shutil, 'which', lambda tool: None)
    assert doctor.torch().mend == ''


@pytest.mark.mujoco
def test_machine_without_mujoco_is_told_what_to_install(monkeypatch) -> None:
    monkeypatch.setattr(doctor, 'find_spec', lambda name: None)
    assert doctor.rendering().mend == 'pip install "metagcttt-core[mazes]"'
