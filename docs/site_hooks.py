"""Hooks of the documentation site: pages of benchmarks/, full docstrings in the reference."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS))

import make_api  # noqa: E402


def on_files(files: Files, config: Any) -> Files:
    """Add results, log and their pictures."""
    root = DOCS.parent
    for path in [*(root / "benchmarks").glob("[A-Z]*.md"), *(root / "benchmarks/img").iterdir()]:
        if path.name == "README.md":
            continue
        uri = path.relative_to(root).as_posix()
        files.append(File.generated(config, uri, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Show full docstrings in the reference; make links between docs/ and benchmarks/ fit."""
    if page.file.src_uri == "api.md":
        return make_api.site_page()
    if page.file.src_uri.startswith("benchmarks/"):
        return markdown.replace("](../docs/", "](../")
    return markdown.replace("../benchmarks/", "benchmarks/")
