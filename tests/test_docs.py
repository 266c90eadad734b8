"""The documents say what is there: files that they name exist, and their links lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
SOURCE = re.compile(r"`((?:estimator|daq|drivers|tests|configs)/[\w/.<>*-]*)`")
LINK = re.compile(r"\]\((?!https?:)([^)#]*)(?:#([^)]*))?\)")
DEVELOPERS = ("ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md")
NAMES_A_SOURCE_FILE = re.compile(r"`?\b(?:estimator|daq|drivers)/[\w/]+\.py\b|\([a-z_]+\.py\)")
REVISION = re.compile(r"\b(?=[0-9a-f]*[0-9])(?=[0-9a-f]*[a-f])[0-9a-f]{7}\b")
ARCHITECTURE_LINES = 120


def anchors(page: Path) -> set[str]:
    """Anchors of the headings of a page, as GitHub makes them."""
    heads = re.findall(r"^#+ (.*)$", page.read_text("utf-8"), re.M)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_files_and_links_lead_somewhere(page: Path) -> None:
    text = page.read_text("utf-8")
    missing = [name for name in SOURCE.findall(text) if not re.search(r"[<*]", name) and not (ROOT / name).exists()]
    for target, anchor in LINK.findall(re.sub(r"^ {4}.*$", "", text, flags=re.M)):
        other = (page.parent / target).resolve() if target else page
        if not other.exists() or (anchor and other.suffix == ".md" and anchor not in anchors(other)):
            missing.append(f"{target}#{anchor}")
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_manual_names_no_source_file_and_no_revision(page: Path) -> None:
    if page.name in DEVELOPERS or "decisions" in page.parts:
        return
    text = page.read_text("utf-8")
    assert not NAMES_A_SOURCE_FILE.findall(text)
    assert not REVISION.findall(text)


def test_architecture_is_one_page() -> None:
    assert len((ROOT / "ARCHITECTURE.md").read_text("utf-8").splitlines()) <= ARCHITECTURE_LINES
