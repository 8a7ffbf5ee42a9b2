"""The check of the site's links, on small sites."""

import importlib.util
from pathlib import Path

import pytest

_PATH = Path(__file__).parents[2] / 'tools' / 'check_site.py'
_SPEC = importlib.util.spec_from_file_location('check_site', _PATH)
check_site = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(check_site)


@pytest.mark.parametrize(
    ('content', 'fault'),
    [
        ('<a href="b.html#there">', ''),
        ('<a href="b.html?v=1">', ''),
        ('<a href="#here"><b id="here">', ''),
        ('<a href="https://example.org/gone">', ''),
        ('<a href="b.html#gone">', 'b.html#gone: no such anchor'),
        ('<a href="c.html">', 'c.html: no such file'),
        ('<img src="gone.png" alt="a maze">', 'gone.png: no such file'),
        ('<img src="b.html" alt="">', 'picture without alt text: b.html'),
        ('<a href="http://example.org">', 'http://example.org is not https'),
    ],
)
def test_links(tmp_path: Path, content: str, fault: str) -> None:
    (tmp_path / 'a.html').write_text(content)
    (tmp_path / 'b.html').write_text('<h1 id="there">')
    expected = [f'{tmp_path / "a.html"}: {fault}'] if fault else []
    assert check_site.faults(tmp_path) == expected
