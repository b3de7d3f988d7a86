"""The documentation site builds strictly, holds every setting and public name, fetches nothing from elsewhere."""

import doctest
import html.parser
import importlib
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote, urlsplit

import pytest
from running import Outcome

ROOT = Path(__file__).parents[2]
GROUPS = sorted({path.parent.relative_to(ROOT / "conf") for path in (ROOT / "conf").glob("*/**/*.yaml")})
PACKAGES = sorted(
    path.parent.name
    for path in (ROOT / "memcomp_lightning").glob("*/__init__.py")
    if path.parent.name not in ("cli", "conf")
)
FAQ = re.findall(r"```text\n\$ (memcomp-\w+)([^\n]*)\n([^`]*)```", (ROOT / "docs/faq.md").read_text())

pytestmark = pytest.mark.xdist_group("docs")  # one worker, one build

LOADS = {"img": "src", "script": "src", "iframe": "src", "source": "src", "video": "src", "object": "data"}
LOADING_LINKS = {"stylesheet", "icon", "preload", "prefetch", "preconnect", "dns-prefetch", "modulepreload"}


class Contents(NamedTuple):
    """What a page has, leads to and loads."""

    ids: set[str]
    links: list[str]
    loaded: list[str]
    text: str


class Reader(html.parser.HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.contents = Contents(set(), [], [], "")
        self.words: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        if "id" in values:
            self.contents.ids.add(values["id"])
        if tag == "a" and "href" in values:
            self.contents.links.append(values["href"])
        if tag == "link" and LOADING_LINKS & set(values.get("rel", "").split()):
            self.contents.loaded.append(values["href"])
        if (source := values.get(LOADS.get(tag, ""))) is not None and not source.startswith("data:"):
            self.contents.loaded.append(source)
        self.contents.loaded.extend(loaded_by_css(values.get("style", "")))

    def handle_data(self, data: str) -> None:
        self.words.append(data)
        if self.cdata_elem == "style":
            self.contents.loaded.extend(loaded_by_css(data))


def loaded_by_css(text: str) -> Iterator[str]:
    for address in re.findall(r"url\(\s*['\"]?([^'\")]+)|@import\s+['\"]([^'\"]+)", text):
        yield from (part for part in address if part and not part.startswith(("data:", "#")))


def read(page: Path) -> Contents:
    reader = Reader()
    reader.feed(page.read_text())
    return reader.contents._replace(text=" ".join(" ".join(reader.words).split()))


def broken(pages: dict[Path, Contents], folder: Path) -> list[str]:
    """Return what leads nowhere: links, anchors, pictures, scripts, style sheets of the site itself."""
    found = []
    for page, contents in pages.items():
        for address in [*contents.links, *contents.loaded]:
            parts = urlsplit(address)
            if parts.scheme or parts.netloc:
                continue
            # The page for unknown addresses is served from any depth and therefore counts from the root.
            start = folder if parts.path.startswith("/") else page.parent
            target = (start / unquote(parts.path).lstrip("/")).resolve() if parts.path else page
            target = target / "index.html" if target.is_dir() else target
            anchor = unquote(parts.fragment)
            if not target.is_file():
                found.append(f"{page.relative_to(folder)}: {address}")
            elif anchor and target in pages and anchor not in pages[target].ids:
                found.append(f"{page.relative_to(folder)}: {address} (no such anchor)")
    return found


def foreign(addresses: list[str]) -> list[str]:
    return [address for address in addresses if urlsplit(address).netloc]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site").resolve()
    done = subprocess.run(  # not --quiet: warnings that are not printed do not count
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1", "OMP_NUM_THREADS": "1", "MEMCOMP_SITE_SEARCH": "false"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Contents]:
    return {path: read(path) for path in site.rglob("*.html")}


def test_every_option_of_every_group_has_its_place(site: Path, pages: dict[Path, Contents]) -> None:
    assert len(GROUPS) >= 17
    for group in GROUPS:
        page = pages[site / "config" / "-".join(group.parts) / "index.html"]
        for path in (ROOT / "conf" / group).glob("*.yaml"):
            assert path.stem in page.ids, path
            # An experiment or a preset sets these.
            set_by = ("figure", "worth", "density", "few_labels", "preset/figure", "preset/study", "data/training")
            refused = group.as_posix() in set_by
            assert (f"{group.as_posix()}={path.stem}" in page.text) != refused, path
            lines = [line for line in path.read_text().splitlines() if not line.startswith("# @package")]
            assert lines[0].startswith("# "), f"{path} does not say what it is"
            assert page.text.count(" ".join(lines[0][2:].split()[:4])) >= 2, f"{path}: not in table and section"


def test_defaults_are_marked(site: Path, pages: dict[Path, Contents]) -> None:
    for group, default in (("sampler", "dmm_qubo"), ("data", "digits"), ("solver-field", "clause")):
        assert f"{default} (default)" in pages[site / "config" / group / "index.html"].text
    assert "(default)" not in pages[site / "config/hparams/index.html"].text


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_documented(site: Path, pages: dict[Path, Contents], package: str) -> None:
    module = importlib.import_module(f"memcomp_lightning.{package}")
    ids = pages[site / "api" / package / "index.html"].ids
    for name in module.__all__:
        made_in = getattr(getattr(module, name), "__module__", "")
        assert ids & {f"memcomp_lightning.{package}.{name}", f"{made_in}.{name}"}, name


def test_docstrings_are_shown_as_text(site: Path, pages: dict[Path, Contents]) -> None:
    for page in pages:
        if page.is_relative_to(site / "api"):
            prose = re.sub(r"<pre.*?</pre>", "", page.read_text(), flags=re.DOTALL)  # less the source code
            assert not re.search(r":(class|func|meth|attr|data|mod|math):|\.\. math|&gt;&gt;&gt;", prose), page


@pytest.mark.parametrize("experiment", sorted(path.parent.name for path in ROOT.glob("experiments/*/README.md")))
def test_results_have_their_pages_and_figures(site: Path, pages: dict[Path, Contents], experiment: str) -> None:
    page = pages[site / "experiments" / experiment / "index.html"]
    shown = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", (ROOT / "experiments" / experiment / "README.md").read_text())
    assert set(shown) <= set(page.loaded)


def test_nothing_leads_nowhere(site: Path, pages: dict[Path, Contents]) -> None:
    assert len(pages) > 50
    assert broken(pages, site) == []


def test_nothing_is_fetched_from_elsewhere(site: Path, pages: dict[Path, Contents]) -> None:
    for page, contents in pages.items():
        assert foreign(contents.loaded) == [], page
        assert 'class="mermaid"' not in page.read_text(), "the theme would fetch a script for it"
    for path in [*site.rglob("*.css"), *site.rglob("*.svg")]:
        assert foreign(list(loaded_by_css(path.read_text()))) == [], path


def test_the_checks_see_what_they_look_for(tmp_path: Path) -> None:
    (tmp_path / "there.png").touch()
    page = tmp_path / "index.html"
    page.write_text(
        '<h1 id="top"></h1><a href="#top"></a><a href="#bottom"></a><a href="none/">x</a><img src="there.png">'
        '<img src="gone.png"><a href="https://example.org">x</a><link rel="stylesheet" href="https://example.org/a.css">'
        "<style>p { background: url(//example.org/b.png) }</style>"
    )
    pages = {page: read(page)}
    assert broken(pages, tmp_path) == [
        "index.html: #bottom (no such anchor)",
        "index.html: none/",
        "index.html: gone.png",
    ]
    assert foreign(pages[page].loaded) == ["https://example.org/a.css", "//example.org/b.png"]


@pytest.mark.parametrize(("command", "arguments", "message"), FAQ, ids=lambda text: text.strip()[:30])
def test_messages_of_the_faq_are_the_real_ones(
    memcomp_train: Callable[..., Outcome],
    memcomp_solve: Callable[..., Outcome],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    command: str,
    arguments: str,
    message: str,
) -> None:
    monkeypatch.setenv("MEMCOMP_DATA_DIR", str(tmp_path))
    run = {"memcomp-train": memcomp_train, "memcomp-solve": memcomp_solve}[command]
    outcome = run(*shlex.split(arguments))
    assert outcome.status == 2
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    assert doctest.OutputChecker().check_output(message, outcome.err, flags), outcome.err
