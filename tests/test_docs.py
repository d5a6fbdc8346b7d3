"""docs/: tutorials run, the site builds, the reference is complete, links and tables are sound."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import quadrics
import reobj_track as rt

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "docs"))

import make_api  # noqa: E402
import make_formats  # noqa: E402

PAGES_OF_TEXT = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "benchmarks").glob("*.md")),
]


@pytest.mark.parametrize("page", PAGES_OF_TEXT, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_links_have_targets(page: Path) -> None:
    targets = re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text())
    local = [t for t in targets if "://" not in t]
    assert [t for t in local if not (page.parent / t).exists()] == []


def test_the_reference_has_all_public_names_and_is_up_to_date() -> None:
    """If this fails: python docs/make_api.py"""
    explained = {"Array", "IntArray", "BoolArray", "__version__"}
    for module in (rt, quadrics):
        names = [n for m, _, group in make_api.groups() if m == module.__name__ for n in group]
        assert sorted(names) == sorted(set(module.__all__) - explained)
    assert make_api.PAGE.read_text() == make_api.repository_page()


def test_the_tables_of_formats_are_those_of_the_registries() -> None:
    """If this fails: python docs/make_formats.py"""
    text = make_formats.PAGE.read_text()
    assert make_formats.filled(text) == text
    assert all(table in text for table in make_formats.TABLES.values())


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    """Links and anchors lead somewhere, every name of the reference is found.

    Without -q: it hides warnings from --strict too.
    """
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(tmp_path)]
    env = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    page = (tmp_path / "api/index.html").read_text()
    for text in ('id="reobj_track.Tracker.update"', "Returns:", "Raises:", "BGR image"):
        assert text in page
    assert 'id="reobj_track.Tracker._predict"' not in page
