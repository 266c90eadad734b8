"""The documents say what is there: files that they name exist, and their links lead somewhere."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from promises import PATIENCE_S

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
SOURCE = re.compile(r"`((?:estimator|daq|drivers|tests|configs)/[\w/.<>*-]*)`")
LINK = re.compile(r"\]\((?!https?:)([^)#]*)(?:#([^)]*))?\)")
DEVELOPERS = ("ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md")
NAMES_A_SOURCE_FILE = re.compile(r"`?\b(?:estimator|daq|drivers)/[\w/]+\.py\b|(?<!\])\([a-z_]+\.py\)")
REVISION_PATTERN = re.compile(r"\b(?=[0-9a-f]*[0-9])(?=[0-9a-f]*[a-f])[0-9a-f]{7,8}\b")
ARCHITECTURE_LINES = 120
RIG = ROOT / "tests" / "data" / "one_cap.toml"


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
    assert not REVISION_PATTERN.findall(text)


def test_the_reference_pages_are_those_of_the_code() -> None:
    script = (
        "import json, sys; sys.path.insert(0, 'docs'); from make_reference import pages; print(json.dumps(pages()))"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    for name, text in json.loads(done.stdout).items():
        assert (ROOT / "docs" / name).read_text("utf-8") == text, "write it anew: python docs/make_reference.py"


def test_the_site_shows_code_as_it_is_typed() -> None:
    script = (
        "import sys; sys.path.insert(0, 'docs'); from site_hooks import on_page_content; "
        r"print(on_page_content(r'<td><code>k \|x\| --gaps</code></td><pre><span></span><code>a \|</code></pre>'))"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    words = '<span class="word">|x|</span> <span class="word">--gaps</span>'
    shown = f"<td><code>k {words}</code></td><pre><span></span><code>a \\|</code></pre>"
    assert done.stdout.strip() == shown


def test_the_site_has_every_page() -> None:
    listed = set(re.findall(r"- (?:Start: )?([\w/.-]+\.md)$", (ROOT / "mkdocs.yml").read_text("utf-8"), re.M))
    assert listed == {str(page.relative_to(ROOT / "docs")) for page in PAGES if "docs" in page.relative_to(ROOT).parts}


@pytest.mark.slow
def test_the_tutorials_run_as_they_are_printed_and_the_error_falls(tmp_path: Path) -> None:
    said: list[str] = []
    for page in ("tutorial.md", "model-is-wrong.md"):
        for line in re.findall(r"^    (rotorscope .*)$", (ROOT / "docs" / page).read_text("utf-8"), re.M):
            command = [sys.executable, "-m", "daq", *line.split()[1:]]
            done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
            assert done.returncode == 0, (line, done.stderr)
            said.append(done.stdout)
    missing = [float(text) for out in said for text in re.findall(r"^missing force: ([\d.]+) %", out, re.M)]
    assert missing[0] > 0.5
    assert missing[-1] < 0.1
    assert any("verdict: clearance" in out for out in said)


@pytest.mark.slow
def test_the_rotor_of_the_manual_is_fitted_compared_and_diagnosed(tmp_path: Path) -> None:
    said = ""
    for line in re.findall(r"^    (rotorscope .*)$", (ROOT / "docs" / "rotor-models.md").read_text("utf-8"), re.M):
        if not line.startswith("rotorscope rotor "):  # needs ROSS: tests/daq/commands/test_ross_model.py
            command = [sys.executable, "-m", "daq", *line.split()[1:]]
            done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
            assert done.returncode == 0, (line, done.stderr)
            said += done.stdout
    assert "verdict: cubic" in said
    assert "the model is adequate" in said


def test_architecture_is_one_page() -> None:
    assert len((ROOT / "ARCHITECTURE.md").read_text("utf-8").splitlines()) <= ARCHITECTURE_LINES


def test_the_library_page_shows_the_script_that_is_run() -> None:
    script = (ROOT / "docs" / "notebook.py").read_text("utf-8")
    shown = script.replace("sys.argv[1]", '"rig.toml"').replace("sys.argv[2]", '"day1.mcap"')
    page = (ROOT / "docs" / "library.md").read_text("utf-8")
    for line in shown.split("import sys\n")[1].splitlines():
        assert f"    {line}".rstrip() in page
    assert len([line for line in script.splitlines() if line.strip()]) <= 20


def test_the_script_goes_from_a_log_to_a_named_effect(tmp_path: Path) -> None:
    """One bearing of the paper's rig; friction is hidden in the record."""
    known = RIG.read_text("utf-8")
    (tmp_path / "known.toml").write_text(known)
    hidden = known.replace('effects = ["cubic"]', 'effects = ["cubic", "coulomb"]')
    (tmp_path / "hidden.toml").write_text(hidden + "\n[model.coulomb]\nfc = 0.07\n")
    simulate = ["-m", "daq", "simulate", "hidden.toml", "--out", "day1.mcap", "--seconds", "4", "--speed", "max"]
    script = [str(ROOT / "docs" / "notebook.py"), "known.toml", "day1.mcap"]
    said = ""
    for arguments in (simulate, script):
        done = subprocess.run(
            [sys.executable, *arguments], cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S, check=False
        )
        assert (done.returncode, done.stderr) == (0, "")
        said = done.stdout
    assert "verdict: coulomb" in said
    assert said.splitlines()[-1] == "cubic, coulomb: 0.00 % missing"
