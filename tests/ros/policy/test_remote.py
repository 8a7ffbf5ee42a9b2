"""A policy node that asks an adapter, and what it does without one."""

from array import array
from collections.abc import Callable
from pathlib import Path
import re
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from metagcttt.adaptation_messages import expert_message
from metagcttt.adapter.node import AdapterNode
from metagcttt.deployment import adapt_to_goal
from metagcttt.goal_in_force import Goal
from metagcttt_core import make_agent, save_checkpoint, TTTConfig
from metagcttt_interfaces.msg import Expert
import numpy as np
import pytest
from tests.ros.adapter_rig import PlayedAdapter
from tests.ros.graph import Graph, RELIABLE
from tests.ros.policy_rig import ON_THE_WAY, PolicyRig, TASK_1_GOAL

MakeRig = Callable[..., PolicyRig]
LONG_S = 60.0


@pytest.fixture
def files(checkpoint_folder: Path, dataset_file: Path) -> dict[str, str]:
    return {'checkpoint': str(checkpoint_folder), 'dataset': str(dataset_file)}


@pytest.fixture
def make_rig(graph: Graph, files: dict[str, str]) -> MakeRig:
    def make(**parameters: Any) -> PolicyRig:
        defaults = {'adapter': '/adapt', 'adapter_timeout_s': LONG_S, 'adaptation': 'hold'}
        return PolicyRig(graph, files, **{**defaults, **parameters})

    return make


def own_expert(rig: PolicyRig, **settings: Any):
    """What adapting in the node itself comes to."""
    goal = Goal(1, 1, np.array(TASK_1_GOAL), TASK_1_GOAL, seed=5)
    config = TTTConfig(steps=3, batch_size=32, **settings)
    return adapt_to_goal(rig.session.deployment, np.array(ON_THE_WAY), goal, config, lambda: False)


def expert_of(rig: PolicyRig) -> Expert:
    adaptation = own_expert(rig)
    goal = Goal(1, 1, np.array(TASK_1_GOAL), TASK_1_GOAL, seed=5)
    message = expert_message(rig.base, goal, adaptation)
    message.checkpoint = rig.session.deployment.identity.checkpoint
    return message


@pytest.mark.parametrize('agent', ['crl', 'gcbc', 'gciql'])
def test_expert_of_the_adapter_is_the_node_s_own_bit_for_bit(
    make_rig: MakeRig, graph: Graph, files: dict[str, str], agent: str, tmp_path: Path
) -> None:
    files['checkpoint'] = str(tmp_path / 'policy')
    policy = make_agent(agent, obs_dim=2, act_dim=2, hidden=(32, 32))
    save_checkpoint(policy, files['checkpoint'])
    graph.add(AdapterNode, **files, workers=2)
    rig = make_rig(early_stopping=True)
    rig.state()
    rig.goal(seed=5)
    report = rig.report()
    assert (report.accepted, report.adapter, report.reason) == (True, '/adapt', '')
    own = own_expert(rig, early_stopping=True)
    got = rig.session._pursuit.adaptation
    assert got.agent.fingerprint() == own.agent.fingerprint() != rig.base.fingerprint()
    assert (list(report.train_losses), got.support) == (own.train_losses, own.support)
    np.testing.assert_array_equal(rig.action().values, own.agent.act(ON_THE_WAY, TASK_1_GOAL))


def test_policy_acts_while_it_waits_then_takes_the_expert(make_rig: MakeRig, graph: Graph) -> None:
    adapter = PlayedAdapter(graph, lambda request: None)
    rig = make_rig(adaptation='async')
    rig.state()
    rig.goal(seed=5)
    graph.wait(lambda: adapter.requests, 'the request')
    for step in range(1, 4):
        rig.state(step=step)
        np.testing.assert_array_equal(
            rig.action_for(step).values, rig.base.act(ON_THE_WAY, TASK_1_GOAL)
        )
    (request,) = adapter.requests
    message = expert_of(rig)
    message.instance, message.request_id = request.instance, request.request_id
    adapter._experts.publish(message)
    assert rig.report().adapter == '/adapt'
    rig.state(step=4)
    assert rig.action_for(4).adapted


@pytest.mark.parametrize('fallback', ['local', 'base'])
@pytest.mark.parametrize('trouble', ['absent', 'silent', 'full'])
def test_without_an_answer_the_policy_falls_back(
    make_rig: MakeRig, graph: Graph, trouble: str, fallback: str
) -> None:
    if trouble != 'absent':
        PlayedAdapter(graph, lambda request: 'the queue is full' if trouble == 'full' else None)
    rig = make_rig(
        adapter_fallback=fallback,
        adapter_timeout_s=LONG_S if trouble == 'full' else 0.2,
        diagnostics_period_s=0.05,
        warn_latency_ms=1e6,
    )
    if trouble != 'absent':
        graph.wait(rig.session._adapter._remote._client.service_is_ready, 'the adapter')
    diagnostics = graph.collect(DiagnosticArray, '/diagnostics', RELIABLE)
    rig.state()
    rig.goal(seed=5)
    report = rig.report()
    assert (
        report.reason
        == 'the adapter /adapt '
        + {
            'absent': 'was not there within 0.2 s',
            'silent': 'did not answer within 0.2 s',
            'full': 'refused: the queue is full',
        }[trouble]
    )
    assert (report.accepted, report.adapter) == (fallback == 'local', '')
    policy = own_expert(rig).agent if fallback == 'local' else rig.base
    np.testing.assert_array_equal(rig.action().values, policy.act(ON_THE_WAY, TASK_1_GOAL))
    graph.wait(
        lambda: any(
            report.reason in status.message for array in diagnostics for status in array.status
        ),
        'the reason on diagnostics',
    )


def test_adapter_with_another_checkpoint_is_not_used(
    make_rig: MakeRig, graph: Graph, files: dict[str, str], tmp_path: Path
) -> None:
    other = make_agent('gcbc', obs_dim=2, act_dim=2, hidden=(32, 32), seed=9)
    save_checkpoint(other, tmp_path / 'other')
    graph.add(AdapterNode, **{**files, 'checkpoint': str(tmp_path / 'other')})
    rig = make_rig()
    rig.state()
    rig.goal(seed=5)
    report = rig.report()
    assert report.accepted
    assert 'refused: another checkpoint: the adapter has' in report.reason


def spoilt(message: Expert, trouble: str) -> Expert:
    if trouble == 'weights':
        message.weights = array('B', bytes(message.weights[:-4]) + b'\xff\xff\xff\x7f')
    elif trouble == 'no weights at all':
        message.weights = array('B', b'robots')
    elif trouble == 'report':
        message.report.segment_stops[-1] = 10**9
    elif trouble == 'status':
        message.status, message.reason = Expert.FAILED, 'out of memory'
    else:
        message.checkpoint = '0' * 16
    return message


@pytest.mark.parametrize(
    ('trouble', 'reason'),
    [
        ('weights', 'sent a false expert: weight .* holds a non-finite value'),
        ('no weights at all', 'sent a false expert: the weights are no safetensors file'),
        ('report', 'sent a false expert: the report has sub-trajectories'),
        ('status', 'has no expert: out of memory'),
        ('checkpoint', "adapted another checkpoint, '0000000000000000'"),
    ],
)
def test_false_expert_never_acts(
    make_rig: MakeRig, graph: Graph, trouble: str, reason: str
) -> None:
    rig = make_rig()
    assert rig.set(adapter_fallback='base') == ''
    PlayedAdapter(graph, lambda request: spoilt(expert_of(rig), trouble))
    rig.state()
    rig.goal(seed=5)
    report = rig.report()
    assert not report.accepted
    assert re.search(reason, report.reason), report.reason
    np.testing.assert_array_equal(rig.action().values, rig.base.act(ON_THE_WAY, TASK_1_GOAL))


def test_newer_goal_is_asked_for_instead_and_late_experts_are_ignored(
    make_rig: MakeRig, graph: Graph
) -> None:
    rig = make_rig()
    adapter = PlayedAdapter(graph, lambda request: None)
    rig.state()
    rig.goal(1, seed=5)
    first = graph.wait(lambda: adapter.requests, 'the request')[0]
    rig.goal(2, goal=(0.0, 20.0))
    assert rig.report(1).reason == 'cancelled by a newer goal, a newer episode or a stop'
    graph.wait(lambda: len(adapter.requests) == 3, 'the cancellation and the next request')
    cancellation, second = adapter.requests[1:]
    assert (cancellation.cancel, cancellation.request_id) == (True, first.request_id)
    assert (second.cancel, second.request_id) == (False, first.request_id + 1)
    late = expert_of(rig)
    late.instance, late.request_id = first.instance, first.request_id
    adapter._experts.publish(late)
    graph.wait_for(0.2)
    assert rig.session._pursuit.adapting
    assert rig.record.actions == []


def test_request_is_repeated_until_the_expert_comes(make_rig: MakeRig, graph: Graph) -> None:
    rig = make_rig()
    adapter = PlayedAdapter(
        graph, lambda request: expert_of(rig) if len(adapter.requests) == 3 else None
    )
    rig.state()
    rig.goal(seed=5)
    assert rig.report().adapter == '/adapt'
    assert [request.request_id for request in adapter.requests] == [1, 1, 1]
    waits = [request.timeout_s for request in adapter.requests]
    assert LONG_S >= waits[0] > waits[1] > waits[2]


def test_policy_adapts_again_by_the_adapter_after_its_horizon(
    make_rig: MakeRig, graph: Graph, files: dict[str, str]
) -> None:
    graph.add(AdapterNode, **files)
    rig = make_rig(horizon=1)
    for step in range(2):
        rig.state(step=step)
        if step == 0:
            rig.goal()
        graph.wait(lambda wanted=step + 1: len(rig.record.reports) == wanted, 'a report')
    assert {report.adapter for report in rig.record.reports} == {'/adapt'}
    assert rig.session._monitor._adapter_values()['adapter_experts'] == '2'


def test_service_that_has_no_valid_name_is_refused_at_configuration(
    make_rig: MakeRig,
) -> None:
    rig = make_rig(adapter='no name/')
    assert rig.session is None
    assert 'cannot configure' in rig.node._failure
