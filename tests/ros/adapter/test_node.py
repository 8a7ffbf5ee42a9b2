"""The adapter over DDS: what it accepts, refuses and sends."""

from collections.abc import Callable
from pathlib import Path
import re
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from hypothesis import given, HealthCheck, settings, strategies
from metagcttt.adaptation_messages import to_adaptation
from metagcttt.adapter import node as adapter_node
from metagcttt.adapter.node import AdapterNode
from metagcttt.deployment import adapt_to_goal
from metagcttt_interfaces.msg import Expert
from metagcttt_interfaces.srv import Adapt
import numpy as np
import pytest
from rclpy.parameter import Parameter
from tests.ros.adapter_rig import AdapterRig, CONFIG, GOAL
from tests.ros.graph import Graph, RELIABLE
from tests.ros.policy_rig import ON_THE_WAY

MakeRig = Callable[..., AdapterRig]


@pytest.fixture
def make_rig(graph: Graph, checkpoint_folder: Path, dataset_file: Path) -> MakeRig:
    files = {'checkpoint': str(checkpoint_folder), 'dataset': str(dataset_file)}
    return lambda **parameters: AdapterRig(graph, files, **parameters)


def change(node: AdapterNode, **values: int) -> None:
    results = node.set_parameters([Parameter(name, value=each) for name, each in values.items()])
    assert all(result.successful for result in results)


def test_robot_gets_the_expert_that_it_would_adapt_itself(make_rig: MakeRig) -> None:
    rig = make_rig()
    answer = rig.ask()
    assert (answer.success, answer.error_code, answer.message) == (True, Adapt.Response.NONE, '')
    message = rig.expert()
    assert (message.instance, message.status, message.reason) == (7, Expert.DONE, '')
    deployment = rig.node._deployment
    expert = to_adaptation(message, deployment.agent, deployment.dataset, CONFIG, '/adapt')
    own = adapt_to_goal(deployment, np.array(ON_THE_WAY), GOAL, CONFIG, lambda: False)
    assert expert.agent.fingerprint() == own.agent.fingerprint()
    assert expert.agent.fingerprint() != deployment.agent.fingerprint()


@pytest.mark.parametrize(
    ('error_code', 'reason', 'fields'),
    [
        ('OTHER_CHECKPOINT', 'another checkpoint', {'checkpoint': '0' * 16}),
        ('OTHER_DATASET', 'another dataset', {'dataset': ''}),
        ('OTHER_FILTER', 'another filter', {'filter': '{}'}),
        ('MALFORMED', 'the state has 1 values, 2 are needed', {'observation': [0.0]}),
        ('MALFORMED', 'the state is not finite', {'observation': [0.0, float('nan')]}),
        ('MALFORMED', 'the goal has 3 values', {'goal': [0.0] * 3}),
        ('MALFORMED', 'the goal is not finite', {'goal': [float('inf'), 0.0]}),
        ('MALFORMED', 'timeout_s must be above 0', {'timeout_s': float('nan')}),
        ('MALFORMED', 'timeout_s must be above 0', {'timeout_s': 0.0}),
        ('MALFORMED', 'steps must be 1 to 1000', {'steps': 0}),
        ('MALFORMED', 'steps must be 1 to 1000', {'steps': 2**32 - 1}),
        ('MALFORMED', 'batch_size must be 1 to 4096', {'batch_size': 10**6}),
        ('MALFORMED', 'lr', {'lr': -1.0}),
        ('MALFORMED', 'engine', {'engine': 'steam'}),
        ('MALFORMED', 'optimi[sz]er', {'optimizer_state': 'pretrained'}),
        ('MALFORMED', 'robot must be the full name', {'robot': 'robot 1'}),
        ('MALFORMED', 'no setting .pace.', {'settings': '{"pace": 1}'}),
        ('MALFORMED', 'JSON', {'settings': ''}),
        ('MALFORMED', 'robot must be the full name', {'robot': ''}),
    ],
)
def test_request_that_cannot_be_served_is_refused_at_once_with_the_reason(
    make_rig: MakeRig, error_code: str, reason: str, fields: dict[str, Any]
) -> None:
    rig = make_rig()
    answer = rig.graph.call(Adapt, '/adapt', rig.request(**fields))
    assert not answer.success
    assert answer.error_code == getattr(Adapt.Response, error_code)
    assert re.search(reason, answer.message), answer.message
    assert rig.ask().success, 'the next one is served'
    assert rig.expert().status == Expert.DONE


def test_limits_of_requests_may_change_while_it_runs(make_rig: MakeRig) -> None:
    rig = make_rig()
    assert rig.ask(request_id=1).success
    change(rig.node, max_batch_size=31)
    assert 'batch_size must be 1 to 31 for this adapter, got 32' in rig.ask(request_id=2).message
    change(rig.node, max_batch_size=32, max_steps=2)
    assert 'steps must be 1 to 2 for this adapter, got 3' in rig.ask(request_id=3).message


def test_full_queue_refuses_and_serves_those_it_accepted(
    make_rig: MakeRig, slow_adaptation
) -> None:
    rig = make_rig(queue=1)
    robots = ('/a', '/b', '/c')
    answers = [rig.ask(robot) for robot in robots]
    assert [answer.success for answer in answers] == [True, True, False]
    assert answers[2].error_code == Adapt.Response.FULL
    assert answers[2].message == 'the queue is full: 1 requests wait, 1 are worked on'
    slow_adaptation.set()
    assert {rig.expert(robot).status for robot in robots[:2]} == {Expert.DONE}
    assert rig.ask('/c').success
    assert rig.expert('/c').status == Expert.DONE


def test_newer_request_supersedes_and_a_canceled_one_stops(
    make_rig: MakeRig, slow_adaptation
) -> None:
    rig = make_rig()
    rig.ask(request_id=1)
    rig.ask(request_id=2)
    assert rig.expert(request_id=1).status == Expert.SUPERSEDED
    assert rig.ask(request_id=2, cancel=True).success
    message = rig.expert(request_id=2)
    assert (message.status, len(message.weights)) == (Expert.CANCELED, 0)
    unknown = rig.ask(request_id=2, cancel=True)
    assert (unknown.success, unknown.error_code) == (False, Adapt.Response.UNKNOWN)


def test_repeated_request_is_done_once(make_rig: MakeRig, slow_adaptation) -> None:
    rig = make_rig()
    assert [rig.ask().success for _ in range(2)] == [True, True]
    slow_adaptation.set()
    rig.expert()
    assert rig.ask().success, 'also when it is done'
    assert rig.ask(request_id=2).success
    rig.expert(request_id=2)
    assert [expert.request_id for expert in rig.experts('/robot')] == [1, 2]
    assert rig.node._queue.robots() == set()


def test_request_whose_robot_waits_no_longer_ends(make_rig: MakeRig, slow_adaptation) -> None:
    rig = make_rig()
    assert rig.ask(timeout_s=0.05).success
    assert rig.expert().status == Expert.TIMED_OUT


def test_adaptation_that_fails_is_answered(make_rig: MakeRig, monkeypatch) -> None:
    def fail(*_):
        raise MemoryError('not that much')

    rig = make_rig()
    monkeypatch.setattr(adapter_node, 'adapt_to_goal', fail)
    assert rig.ask().success
    message = rig.expert()
    assert (message.status, message.reason) == (Expert.FAILED, 'MemoryError: not that much')


def test_ending_adapter_tells_those_who_wait(make_rig: MakeRig, slow_adaptation) -> None:
    rig = make_rig()
    rig.ask('/a')
    rig.ask('/b')
    rig.node.end_service()
    for robot in ('/a', '/b'):
        assert rig.expert(robot).status == Expert.SHUTDOWN
    assert rig.ask('/c').error_code == Adapt.Response.ENDING


def test_gone_robots_leave_their_places(make_rig: MakeRig, monkeypatch) -> None:
    rig = make_rig(robots=1)
    request = rig.request('/a')
    assert rig.graph.call(Adapt, '/adapt', request).success
    refused = rig.graph.call(Adapt, '/adapt', rig.request('/b'))
    assert (refused.success, refused.message) == (False, '1 robots are served already')
    monkeypatch.setattr(adapter_node, 'PLACE_KEPT_S', -1.0)
    rig.graph.wait(lambda: not rig.node._queue.robots(), 'the end of the request')
    assert rig.ask('/b').success
    assert rig.expert('/b').status == Expert.DONE


def test_load_and_refusals_are_on_diagnostics(make_rig: MakeRig, slow_adaptation) -> None:
    rig = make_rig(queue=0, diagnostics_period_s=0.05)
    arrays = rig.graph.collect(DiagnosticArray, '/diagnostics', RELIABLE)

    def status(message: str) -> DiagnosticStatus:
        return rig.graph.wait(
            lambda: next(
                (
                    each
                    for array in arrays
                    for each in array.status
                    if each.name == '/adapter_node' and message in each.message
                ),
                None,
            ),
            message,
        )

    rig.ask('/a')
    assert status('1 of 1 workers busy, 0 requests wait').level == DiagnosticStatus.OK
    rig.ask('/b')
    refused = status('refused just now: FULL, the queue is full')
    values = {pair.key: pair.value for pair in refused.values}
    assert refused.level == DiagnosticStatus.WARN
    assert (values['accepted'], values['refused_full'], values['robots']) == ('1', '1', '2')


NUMBERS = strategies.integers(0, 2**32 - 1)
FLOATS = strategies.floats(allow_nan=True, allow_infinity=True, width=32)
TEXTS = strategies.text(strategies.characters(codec='utf-8', exclude_characters='\0'), max_size=20)


@settings(
    max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    fields=strategies.fixed_dictionaries(
        {},
        optional={
            **{name: TEXTS for name in ('robot', 'checkpoint', 'precision')},
            **{name: TEXTS for name in ('engine', 'optimizer_state')},
            **{name: NUMBERS for name in ('steps', 'batch_size')},
            **{name: FLOATS for name in ('timeout_s', 'lr', 'test_fraction')},
            'observation': strategies.lists(FLOATS, max_size=3),
            'goal': strategies.lists(FLOATS, max_size=3),
            'settings': TEXTS,
            'cancel': strategies.booleans(),
        },
    )
)
def test_no_request_ends_the_adapter(served: AdapterRig, fields: dict[str, Any]) -> None:
    response = served.node._on_request(served.request(**fields), Adapt.Response())
    assert response.success or response.message


@pytest.fixture
def served(make_rig: MakeRig) -> AdapterRig:
    rig = make_rig(max_batch_size=64, max_steps=3)
    yield rig
    assert rig.ask('/last').success
    assert rig.expert('/last').status == Expert.DONE
