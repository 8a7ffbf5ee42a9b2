"""No setting without a proof, no proof without a setting, and no difference without a change."""

from importlib import import_module
from pathlib import Path

import pytest
from tests.tools.settings.walk import all_programs, leaves_of, settings_of, Walk

FAMILIES = ('benchmarks', 'data', 'evaluation', 'ros', 'training')
WALKS: dict[str, Walk] = {
    walk.program: walk
    for family in FAMILIES
    for walk in import_module(f'tests.tools.settings.test_{family}').WALKS
}


@pytest.mark.parametrize('program', list(all_programs()))
def test_every_setting_has_a_proof(program: str) -> None:
    proofs = WALKS[program].proofs if program in WALKS else {}
    assert sorted(leaves_of(settings_of(program))) == sorted(proofs)


@pytest.mark.parametrize('program', WALKS)
def test_without_a_change_there_is_no_difference(
    program: str, tmp_path: Path, places: Path
) -> None:
    WALKS[program].check_control(tmp_path, places)
