"""An adapter, or who plays one, and a robot that asks it."""

from collections.abc import Callable
import json
from typing import Any

from metagcttt.adaptation_messages import request_message
from metagcttt.adapter.node import AdapterNode
from metagcttt.goal_in_force import Goal
from metagcttt_core import TTTConfig
from metagcttt_interfaces.msg import Expert
from metagcttt_interfaces.srv import Adapt
import numpy as np

from tests.ros.graph import EVERY, Graph
from tests.ros.policy_rig import ON_THE_WAY, TASK_1_GOAL

GOAL = Goal(1, 1, np.array(TASK_1_GOAL), TASK_1_GOAL, seed=5)
CONFIG = TTTConfig(steps=3, batch_size=32)


class AdapterRig:
    """An adapter node; the test plays the robots."""

    def __init__(self, graph: Graph, files: dict[str, str], **parameters: Any) -> None:
        self.graph = graph
        self.node = graph.add(AdapterNode, **files, **parameters)
        self._experts: dict[str, list[Expert]] = {}

    def experts(self, robot: str) -> list[Expert]:
        """Everything that was sent to a robot."""
        if robot not in self._experts:
            self._experts[robot] = self.graph.collect(Expert, f'{robot}/expert', EVERY)
        return self._experts[robot]

    def request(self, robot: str = '/robot', request_id: int = 1, **fields: Any) -> Adapt.Request:
        """A request as a robot would send it, but for `fields`, also of goal and inner loop."""
        request = request_message(
            robot=robot,
            instance=7,
            request_id=request_id,
            timeout_s=60.0,
            identity=self.node._identity,
            observation=np.array(ON_THE_WAY),
            goal=GOAL,
            config=CONFIG,
        )
        for name, value in sorted(fields.items(), key=lambda each: each[0] == 'settings'):
            if name in TTTConfig.model_fields:
                request.settings = json.dumps(json.loads(request.settings) | {name: value})
            elif name == 'goal':
                request.query.goal = value
            else:
                setattr(request, name, value)
        return request

    def ask(self, robot: str = '/robot', request_id: int = 1, **fields: Any) -> Adapt.Response:
        """The answer to such a request."""
        self.experts(robot)
        return self.graph.call(Adapt, '/adapt', self.request(robot, request_id, **fields))

    def expert(self, robot: str = '/robot', request_id: int = 1) -> Expert:
        """What became of a request that was accepted."""
        return self.graph.wait(
            lambda: next((e for e in self.experts(robot) if e.request_id == request_id), None),
            f'the expert {request_id} of {robot}',
        )


class PlayedAdapter:
    """The service `/adapt` as the test plays it."""

    def __init__(
        self, graph: Graph, answer: Callable[[Adapt.Request], Expert | str | None]
    ) -> None:
        """Answer each request by what `answer` gives: an expert, a refusal, or silence."""
        self.graph = graph
        self.requests: list[Adapt.Request] = []
        self._answer = answer
        self._experts = graph.node.create_publisher(Expert, '/policy_node/expert', EVERY)
        graph.node.create_service(Adapt, '/adapt', self._on_request)

    def _on_request(self, request: Adapt.Request, response: Adapt.Response) -> Adapt.Response:
        self.requests.append(request)
        answer = None if request.cancel else self._answer(request)
        response.success = not isinstance(answer, str)
        response.message = answer if isinstance(answer, str) else ''
        if isinstance(answer, Expert):
            answer.instance, answer.request_id = request.instance, request.request_id
            self._experts.publish(answer)
        return response
