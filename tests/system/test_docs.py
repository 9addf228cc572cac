"""The API pages build without a warning, and what the README links to is there."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
PAGES = ["README.md", "experiments/results/README.md"]


def test_the_pages_build(tmp_path):
    pytest.importorskip("mkdocs")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "adding_a_method" / "index.html").read_text()
    assert "update_every" in page  # from the docstring
    assert "ppl_jax.algorithms.base.Algorithm" in page


@pytest.mark.parametrize("page", PAGES)
def test_what_is_linked_is_there(page):
    text = (ROOT / page).read_text()
    links = re.findall(r"\]\(([^)#]+)\)", text)
    missing = [
        link
        for link in links
        if not link.startswith("http") and not ((ROOT / page).parent / link).exists()
    ]
    assert not missing
    if page != "README.md":
        named = re.findall(r"^\| ((?:`[^`]+`(?:, )?)+) \|", text, re.M)
        files = [name for cell in named for name in re.findall(r"`([^`]+)`", cell)]
        assert files
        assert not [name for name in files if not ((ROOT / page).parent / name).exists()]
