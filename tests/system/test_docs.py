"""README and documentation: what they link to is there, and the commands they show are commands."""

import html
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.cli import parse
from experiments.engine.runtime import UserError
from ppl_jax import __version__

ROOT = Path(__file__).parent.parent.parent
DOCS = ROOT / "docs" / "pages"
OUTSIDE = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "experiments/results/README.md"]
PAGES = OUTSIDE + sorted(str(page.relative_to(ROOT)) for page in DOCS.rglob("*.md"))
NEEDS_A_FOLDER = ("--resume", "recorded")  # such a line is read up to the folder it names
FENCE = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```", re.M | re.S)


def fenced(page, language):
    """The blocks of a language in a page."""
    return [text for name, text in FENCE.findall((ROOT / page).read_text()) if name == language]


def commands(page):
    """The words of every shell line in a page, without comments and redirections."""
    lines = "\n".join(fenced(page, "sh")).replace("\\\n", " ").splitlines()
    words = [shlex.split(line, comments=True) for line in lines]
    return [line[: line.index(">")] if ">" in line else line for line in words if line]


def headings(page):
    """The anchors of a page's headings."""
    titles = re.findall(r"^#+ (.*)$", FENCE.sub("", page.read_text()), re.M)
    words = [re.sub(r"[^\w\s-]", "", title).strip().lower() for title in titles]
    return {re.sub(r"[\s-]+", "-", title) for title in words}


def refusal(words):
    """Why the command line refuses these words, or None."""
    try:
        parse(words)
    except UserError as error:
        return str(error)
    except SystemExit:
        return "not a command"
    return None


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings")
    out = tmp_path_factory.mktemp("site")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(out)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    return out


def read(site, page):
    return html.unescape((site / page / "index.html").read_text())


def test_pages_show_docstrings_examples_and_tables_of_the_readme(site):
    extending = read(site, "extending") + read(site, "bring_your_own_scene")
    assert "ppl_jax.algorithms.base.Algorithm" in extending
    assert "update_every" in extending  # from the docstring
    for example in (ROOT / "experiments" / "examples").rglob("*.py"):
        title = example.read_text().splitlines()[0].strip('"#: ')
        if example.name != "__init__.py":
            assert title.split(" (")[0].split(", ")[0] in extending, example
    assert "HG-DAgger" in read(site, "results_driving")
    assert __version__ in read(site, "changelog")


def test_every_setting_is_on_the_page_of_settings(site):
    from ppl_jax import algorithms
    from ppl_jax.config import HParams, TrainConfig, settings_fields
    from ppl_jax.gates import gate, registered_gates

    page = read(site, "settings")
    classes = {TrainConfig, HParams}
    for name in algorithms.registered():
        spec = algorithms.method(name)
        classes |= {spec.config, spec.hparams}
    classes |= {gate(name).hparams for name in registered_gates()}
    missing = [
        n for cls in classes for n in settings_fields(cls) if f"<code>{n}</code>" not in page
    ]
    assert not missing


def test_figures_are_shown_and_none_is_left_over(site):
    pages = "".join(page.read_text() for page in site.rglob("*.html"))
    readme = (ROOT / "README.md").read_text()
    for figure in (DOCS / "figures").iterdir():
        assert (site / "figures" / figure.name).is_file()
        assert f"figures/{figure.name}" in pages + readme, figure.name


def test_readme_is_one_page():
    assert 120 <= len((ROOT / "README.md").read_text().splitlines()) <= 170


@pytest.mark.parametrize("page", PAGES)
def test_commands_shown_are_commands(page):
    targets = re.findall(r"^([\w -]+):", (ROOT / "Makefile").read_text(), re.M)
    targets = {name for line in targets for name in line.split()}
    for line in commands(page):
        if line[0] == "make":
            assert line[1] in targets, line
        elif line[0] == "ppl" and line[1] not in ("--version", "--tyro-print-completion"):
            reason = refusal(line[1:])
            needs_a_folder = any(word in line for word in NEEDS_A_FOLDER)
            assert reason is None or (needs_a_folder and "runs/" in reason), line


@pytest.mark.parametrize("page", PAGES)
def test_commands_named_in_the_text_are_commands(page):
    from experiments.cli import _ACTIONS

    known = {name.lower() for name in _ACTIONS} | {"train"}
    text = FENCE.sub("", (ROOT / page).read_text())
    named = re.findall(r"`ppl ([a-z]+)", text)
    assert not [name for name in named if name not in known]


@pytest.mark.parametrize("page", OUTSIDE)
def test_what_is_linked_is_there(page):
    folder, text = (ROOT / page).parent, (ROOT / page).read_text()
    missing = []
    for link in re.findall(r"\]\(([^)]+)\)", text):
        if link.startswith("http"):
            continue
        path, _, anchor = link.partition("#")
        target = folder / path
        if not target.exists() or (anchor and anchor not in headings(target)):
            missing.append(link)
    assert not missing


def test_committed_results_are_listed_and_there():
    folder = ROOT / "experiments" / "results"
    text = (folder / "README.md").read_text()
    named = re.findall(r"^\| ((?:`[^`]+`(?:, )?)+) \|", text, re.M)
    files = {name for cell in named for name in re.findall(r"`([^`]+)`", cell)}
    assert files == {
        path.name for path in folder.iterdir() if path.suffix in (".csv", ".gz", ".json")
    }


def test_python_shown_is_python():
    for page in PAGES:
        for block in fenced(page, "python"):
            if "--8<--" not in block:
                compile(block, page, "exec")


def test_version_is_the_same_everywhere():
    yaml = pytest.importorskip("yaml")
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == __version__
    first = re.search(
        r"^## (\S+) \((\d{4}-\d\d-\d\d)\)$", (ROOT / "CHANGELOG.md").read_text(), re.M
    )
    assert first is not None
    assert first[1] == __version__
    assert first[2] == str(citation["date-released"])


def test_hooks_and_hosted_ci_run_what_the_makefile_runs():
    yaml = pytest.importorskip("yaml")
    jobs = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())["jobs"]
    steps = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    assert {"make check", "make docs", "make test"} <= set(steps)
    repos = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    assert [repo["repo"] for repo in repos] == ["local"]  # works without a network


def test_every_test_that_the_pages_name_is_there():
    for page in (ROOT / "docs" / "pages").glob("*.md"):
        for file, name in re.findall(r"`?(test_\w+\.py)(?:::(\w+))?", page.read_text()):
            found = list((ROOT / "tests").rglob(file))
            assert len(found) == 1, f"{page.name} names {file}"
            assert not name or f"def {name}(" in found[0].read_text(), f"{page.name} names {name}"
