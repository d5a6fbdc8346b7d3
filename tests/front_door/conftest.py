"""The result of README's first command, made once for all tests and all workers.

Where REOBJ_EXAMPLE names an output folder of that command, as in .ci/run, it is taken.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from front_door.room import ROOT, cli, readme_command
from reobj.files import locked


@pytest.fixture(scope="session")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output folder of README's first command. Copy it before you change it."""
    if given := os.environ.get("REOBJ_EXAMPLE"):
        return Path(given)
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "example"
    folder.mkdir(exist_ok=True)
    words = readme_command()
    assert words[-2:] == ["-o", "out"]
    with locked(folder / "lock", wait_s=600):
        if not (folder / "done").exists():
            here = Path.cwd()
            os.chdir(ROOT)
            try:
                assert cli(*words[:-1], folder / "out") == 0
            finally:
                os.chdir(here)
            (folder / "done").touch()
    return folder / "out"
