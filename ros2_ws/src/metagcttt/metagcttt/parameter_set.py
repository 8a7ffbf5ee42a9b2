"""Declaration and checks of node parameters; the tables are in `parameters`."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
import math
from typing import Any, Literal

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

Value = bool | int | float | str


@dataclass(frozen=True)
class Parameter:
    """One parameter of a node.

    Attributes:
        name: Its name; carries the unit when that is not obvious.
        default: Its default; decides the type.
        description: What it does, with its unit and what special values mean.
        limits: Inclusive range of a number.
        choices: Accepted strings; any when empty.
        changes: When a change takes effect. `start`: never after the start, the parameter is
            read-only; `configure`: at the next configuration, so only an unconfigured node
            accepts one; `now`: at once, or for a policy's adaptation with the next one.
    """

    name: str
    default: Value
    description: str
    limits: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()
    changes: Literal['start', 'configure', 'now'] = 'start'

    def descriptor(self) -> ParameterDescriptor:
        """The descriptor that `ros2 param describe` shows; rclpy enforces range and read-only."""
        descriptor = ParameterDescriptor(
            name=self.name,
            description=self.description,
            additional_constraints=self.accepted() if self.choices else '',
            read_only=self.changes == 'start',
        )
        if self.limits is not None:
            low, high = self.limits
            if isinstance(self.default, int):
                descriptor.integer_range = [
                    IntegerRange(from_value=int(low), to_value=int(high), step=1)
                ]
            else:
                descriptor.floating_point_range = [
                    FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)
                ]
        return descriptor

    def accepted(self) -> str:
        """The accepted values, in words."""
        if self.choices:
            return 'one of ' + ', '.join(self.choices)
        if self.limits is not None:
            form = 'd' if isinstance(self.default, int) else 'g'
            low, high = self.limits
            return f'{low:{form}} to {high:{form}}'
        return {bool: 'true, false', str: 'any text'}[type(self.default)]

    def refusal(self, value: Any) -> str:
        """The reason to reject `value`, beyond the descriptor's; empty to accept it."""
        if self.choices and value not in self.choices:
            return f'{self.name} must be {self.accepted()}, got {value!r}'
        if isinstance(value, float) and math.isnan(value):  # which no range excludes
            return f'{self.name} must be {self.accepted()}, got nan'
        return ''


class ParameterSet:
    """The parameters of a node, declared from a table and checked against it."""

    def __init__(
        self, node: Node, table: Iterable[Parameter], is_configured: Callable[[], bool]
    ) -> None:
        """Declare `table` on `node`; overrides from the command line are checked too.

        Args:
            node: The node.
            table: Its parameters.
            is_configured: Whether the node is configured now.

        Raises:
            rclpy.exceptions.InvalidParameterValueException: For an override that is rejected.
        """
        self._node = node
        self._table = {parameter.name: parameter for parameter in table}
        self._is_configured = is_configured
        # First, so that it checks the declarations too.
        node.add_on_set_parameters_callback(self._check)
        for parameter in self._table.values():
            node.declare_parameter(parameter.name, parameter.default, parameter.descriptor())

    def __getitem__(self, name: str) -> Any:
        """The current value of a parameter."""
        return self._node.get_parameter(name).value

    def _check(self, changes: list[RosParameter]) -> SetParametersResult:
        for change in changes:
            parameter = self._table.get(change.name)
            if parameter is None:  # one of rclpy's own, such as use_sim_time
                continue
            reason = parameter.refusal(change.value)
            if not reason and parameter.changes == 'configure' and self._is_configured():
                reason = f'{change.name} is read at configuration: clean the node up first'
            if reason:
                return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)
