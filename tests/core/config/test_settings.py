"""Settings: frozen, and refusing what is unknown or wrong by name."""

from metagcttt_core.config import error_lines, Settings
from pydantic import Field, ValidationError
import pytest


class Inner(Settings):
    rate: float = Field(0.1, gt=0, description='a rate')


class Outer(Settings):
    steps: int = Field(10, ge=1, description='a number of steps')
    name: str | None = None
    inner: Inner = Inner()


def error_of(**values) -> ValidationError:
    with pytest.raises(ValidationError) as caught:
        Outer(**values)
    return caught.value


def test_settings_cannot_be_changed():
    with pytest.raises(ValidationError, match='frozen'):
        Outer().steps = 3


def test_copies_and_dumps_come_back():
    settings = Outer(steps=3, inner={'rate': 2})
    assert settings.inner == Inner(rate=2.0)
    assert Outer(**settings.model_dump(mode='json')) == settings
    assert settings != Outer(steps=4, inner={'rate': 2})


@pytest.mark.parametrize(
    ('values', 'line'),
    [
        (
            {'stesp': 3},
            "Outer has no setting 'stesp'; did you mean 'steps'? (known: steps, name, inner)",
        ),
        (
            {'ratee': 3},
            "Outer has no setting 'ratee'; did you mean 'inner.rate'? (known: steps, name, inner)",
        ),
        ({'zzz': 3}, "Outer has no setting 'zzz' (known: steps, name, inner)"),
        (
            {'inner': {'raet': 3}},
            "inner: Inner has no setting 'raet'; did you mean 'rate'? (known: rate)",
        ),
    ],
)
def test_unknown_key_is_refused_with_the_nearest_known_one(values, line):
    assert error_lines(error_of(**values)) == [line]


class Several(Settings):
    rates: tuple[float, ...] | None = None
    limits: dict[str, float] = Field({}, description='bounds by name')
    fast: bool = False
    either: bool | int = 1
    inner: Inner = Inner()


@pytest.mark.parametrize(
    'values',
    [{'inner': {'rate': True}}, {'rates': [0.5, True]}, {'limits': {'x': False}}],
)
def test_true_and_false_are_no_numbers(values):
    with pytest.raises(ValidationError) as caught:
        Several(**values)
    (line,) = error_lines(caught.value)
    assert 'must be a number, not true or false' in line


def test_true_and_false_are_taken_where_they_are_meant():
    settings = Several(fast=True, either=True, rates=(1, 0.5), inner={'rate': 1})
    assert (settings.fast, settings.either, settings.rates) == (True, True, (1.0, 0.5))


def test_unknown_key_of_another_type_is_refused():
    with pytest.raises(ValidationError, match='has no setting 5'):
        Outer.model_validate({5: 3})


@pytest.mark.parametrize(
    ('values', 'lines'),
    [
        ({'steps': 0}, ['steps: Input should be greater than or equal to 1, got 0']),
        ({'inner': {'rate': -2}}, ['inner.rate: Input should be greater than 0, got -2']),
        (
            {'inner': {'rate': float('inf')}},
            ['inner.rate: Input should be a finite number, got inf'],
        ),
        (
            {'inner': {'rate': float('nan')}},
            ['inner.rate: Input should be a finite number, got nan'],
        ),
        ({'name': 3}, ['name: Input should be a valid string, got 3']),
        (
            {'steps': 0, 'inner': {'rate': 0}},
            [
                'steps: Input should be greater than or equal to 1, got 0',
                'inner.rate: Input should be greater than 0, got 0',
            ],
        ),
    ],
)
def test_error_lines_name_field_value_and_what_is_allowed(values, lines):
    assert error_lines(error_of(**values)) == lines


def test_wrong_type_says_what_was_expected():
    (line,) = error_lines(error_of(steps='many'))
    assert line.startswith('steps: Input should be a valid integer')
    assert line.endswith("got 'many'")
