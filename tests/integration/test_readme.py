"""What README and docs show runs as it stands there, and their links lead somewhere."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
SNIPPETS = [
    pytest.param(snippet, page, id=f"{page.stem}-{number}")
    for page in PAGES
    if "```console\n" not in page.read_text()  # tutorials run as a whole: test_tutorials
    for number, snippet in enumerate(
        re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL), start=1
    )
]


@pytest.mark.parametrize(("snippet", "page"), SNIPPETS)
@pytest.mark.filterwarnings("ignore::UserWarning")  # Lightning's advice on loggers and checkpoints
def test_snippet_runs(snippet: str, page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(snippet, str(page), "exec"), {"__name__": "documentation"})


def test_there_are_snippets() -> None:
    assert len(SNIPPETS) >= 5


@pytest.mark.parametrize(
    "page", [*PAGES, *sorted(ROOT.glob("experiments/*/README.md"))], ids=lambda p: p.parent.name
)
def test_links_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)]+)\)", page.read_text())
    paths = [link.split("#")[0] for link in links if "://" not in link]
    assert [path for path in paths if path and not (page.parent / path).exists()] == []


def test_the_site_begins_with_the_same_tasks() -> None:
    def tasks(page: Path) -> list[str]:
        return re.findall(r"^\| .*\|$", page.read_text(), flags=re.MULTILINE)[:9]

    of_site = [line.replace("](../experiments/", "](experiments/") for line in tasks(ROOT / "docs/index.md")]
    assert len(of_site) == 9
    assert of_site == [line.replace("](docs/", "](") for line in tasks(ROOT / "README.md")]
