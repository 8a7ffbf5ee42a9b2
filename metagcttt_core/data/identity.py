"""Whether data, a policy and a robot are of the same contract."""

from collections.abc import Mapping
from typing import Any

_PARTS = ('rate_hz', 'observations', 'actions')


def identity_fault(
    what: str, made_for: Mapping[str, Any] | None, used_on: Mapping[str, Any] | None
) -> str:
    """Why something made for one contract cannot be used on another; empty when it can.

    What was made without a contract is not refused here: its sizes are compared elsewhere.

    Args:
        what: Its name, such as `the policy out/robot`.
        made_for: `Contract.identity` as it travelled with it.
        used_on: The identity of the contract that it meets.
    """
    if not made_for or not used_on:
        return ''
    if made_for.get('fingerprint') == used_on.get('fingerprint'):
        return ''
    return f'{what} was made for {_name(made_for)}, not for {_name(used_on)}' + _first_difference(
        made_for, used_on
    )


def _name(identity: Mapping[str, Any]) -> str:
    return f'{identity.get("robot")} (contract {identity.get("fingerprint")})'


def _first_difference(made_for: Mapping[str, Any], used_on: Mapping[str, Any]) -> str:
    for part in _PARTS:
        one, other = made_for.get(part), used_on.get(part)
        if one == other:
            continue
        if not (isinstance(one, list) and isinstance(other, list)):
            return '' if other is None else f': {part} {one}, not {other}'
        if len(one) != len(other):
            return f': {len(one)} {part}, not {len(other)}'
        number = next(
            i for i, pair in enumerate(zip(one, other, strict=True)) if pair[0] != pair[1]
        )
        return f': {part} {number} is {_in_words(one[number])}, not {_in_words(other[number])}'
    return ''


def _in_words(value: Any) -> str:
    if not isinstance(value, dict):
        return str(value)
    return ' '.join(f'{key} {each}' for key, each in value.items() if each not in (None, 'none'))
