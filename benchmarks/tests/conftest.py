"""Tests of the scripts that make the tables: `python -m pytest benchmarks/tests`; not in CI."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

import reobj_track as rt

sys.path.append(str(Path(__file__).resolve().parents[2] / "tests"))

from simulated import finished, unlinked


@pytest.fixture(scope="session")
def parted() -> rt.Result:
    """Three simulated chairs, with a trajectory in two components."""
    return finished(unlinked())
