"""The adapter as a process of its own, which dies and comes back."""

from pathlib import Path

import pytest
from tests.ros.graph import Graph
from tests.ros.policy_rig import PolicyRig


@pytest.mark.slow
def test_killed_adapter_is_done_without_until_it_is_back(
    graph: Graph, start_process, checkpoint_folder: Path, dataset_file: Path
) -> None:
    files = {'checkpoint': str(checkpoint_folder), 'dataset': str(dataset_file)}
    adapter = start_process('adapter_node', **files)
    rig = PolicyRig(
        graph, files, adapter='/adapt', adapter_timeout_s=60.0, adapter_fallback='local'
    )
    rig.state()
    rig.goal(1)
    assert rig.report(1).adapter == '/adapt', 'it waits until the adapter is there'
    assert rig.set(adapt_steps=1000, adapt_batch_size=4096) == ''  # minutes, for any machine
    rig.goal(2)
    remote = rig.session._adapter._remote
    graph.wait(lambda: remote._response and remote._response.done(), 'the acceptance')
    assert rig.set(adapt_steps=3, adapt_batch_size=32, adapter_timeout_s=0.5) == ''
    adapter.kill()
    rig.goal(3)
    report = rig.report(3)
    assert (report.accepted, report.adapter) == (True, '')
    assert report.reason.startswith('the adapter /adapt ')
    assert rig.set(adapter_timeout_s=60.0) == ''
    rig.goal(4)
    graph.wait(lambda: remote._response, 'the request, which nobody answers')
    again = start_process('adapter_node', **files)
    assert rig.report(4).adapter == '/adapt'
    assert [report.query_id for report in rig.record.reports] == [1, 2, 3, 4]
    assert again.stop() == 0
