"""Check every link of the built documentation that stays on the site: files and anchors.

Used by `make docs`. Needs no network; links to other hosts are only checked for https.
"""

from html.parser import HTMLParser
from pathlib import Path
import sys
from urllib.parse import unquote, urldefrag, urlsplit

_PLAIN_HTTP = frozenset({'localhost', '127.0.0.1', 'www.w3.org'})


class Page(HTMLParser):
    """What a page links to and what can be linked to in it."""

    def __init__(self, text: str) -> None:
        """Read the page."""
        super().__init__()
        self.links: list[str] = []
        self.anchors = {'', 'top'}
        self.faults: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect links and anchors; a picture needs a text that stands for it."""
        given = dict(attrs)
        self.anchors |= {value for name in ('id', 'name') if (value := given.get(name))}
        if tag in ('a', 'img', 'link', 'script'):
            self.links += [value for name in ('href', 'src') if (value := given.get(name))]
        if tag == 'img' and not given.get('alt'):
            self.faults.append(f'picture without alt text: {given.get("src")}')


def faults(site: Path) -> list[str]:
    """What is wrong with the links of a site, a line each."""
    pages = {path: Page(path.read_text(encoding='utf-8')) for path in site.rglob('*.html')}
    found = []
    for path, page in pages.items():
        found += [f'{path}: {fault}' for fault in page.faults]
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme == 'http' and parts.hostname not in _PLAIN_HTTP:
                found.append(f'{path}: {link} is not https')
            if parts.scheme or parts.netloc:
                continue
            name, anchor = urldefrag(link)
            target = (path.parent / unquote(urlsplit(name).path)).resolve() if name else path
            if not target.exists():
                found.append(f'{path}: {link}: no such file')
            elif target in pages and unquote(anchor) not in pages[target].anchors:
                found.append(f'{path}: {link}: no such anchor')
    return found


def main() -> None:
    """Run the program."""
    site = Path(sys.argv[1]).resolve()
    if not list(site.rglob('*.html')):
        raise SystemExit(f'{site}: no site')
    if found := faults(site):
        raise SystemExit('\n'.join(found))


if __name__ == '__main__':
    main()
