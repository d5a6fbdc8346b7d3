"""The wheel: built, installed into a fresh environment, and used from there."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import venv
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parent.parent
BESIDE = ("priors.json", "quadrics.py", "reobj_track.py")  # in site-packages, as in the repository
DATA = (
    "*.onnx",
    "*.html",
    "*.css",
    "*.js",
    "*.txt",
    "*.json",
    "py.typed",
)  # of the package, besides its modules


def call(*command: str | Path, cwd: Path) -> str:
    """Run a command away from the source tree, with no weights but those of the wheel."""
    nowhere = str(cwd / "empty")
    env = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "MYPYPATH")}
    env |= {"REOBJ_MODELS": nowhere, "XDG_CACHE_HOME": nowhere, "LOCALAPPDATA": nowhere}
    done = subprocess.run(list(map(str, command)), cwd=cwd, env=env, capture_output=True, text=True)
    assert done.returncode in (0, 1 if "mypy" in command else 0), done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh environment with the wheel; what the wheel needs comes from the present one."""
    pytest.importorskip("hatchling", reason="the wheel cannot be built without hatchling")
    pytest.importorskip("pip", reason="the wheel cannot be installed without pip")
    work = tmp_path_factory.mktemp("wheel")
    call(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", work, cwd=ROOT)
    (wheel,) = work.glob("*.whl")
    folder = work / "venv"
    venv.create(folder, symlinks=os.name != "nt")
    python = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    pip = (sys.executable, "-m", "pip", "--python", python, "install", "-q")
    call(*pip, "--no-deps", "--no-index", "--disable-pip-version-check", wheel, cwd=work)
    present = [p for p in sys.path if p.endswith("-packages")]
    (site_packages(folder) / "present.pth").write_text("\n".join(present) + "\n")
    return folder


def site_packages(folder: Path) -> Path:
    """Where the environment keeps what is installed."""
    return next(p for p in folder.rglob("site-packages") if p.is_dir())


def program(folder: Path, name: str) -> Path:
    """A program of the environment."""
    return next(p for p in folder.glob("[Sb]*in*/*") if p.stem == name)


def test_the_wheel_is_used_and_complete(installed: Path, tmp_path: Path) -> None:
    here = site_packages(installed)
    text = "import quadrics, reobj, reobj_track, sys; print(*sys.path, sep='\\n'); " + (
        "print(*(m.__file__ for m in (quadrics, reobj, reobj_track)), sep='\\n'); "
        "print(len(quadrics.load_priors().names))"
    )
    *path, geometry, package, tool, categories = call(
        program(installed, "python"), "-c", text, cwd=tmp_path
    ).splitlines()
    assert str(ROOT) not in path
    assert {Path(geometry), Path(tool), Path(package).parent.parent / "priors.json"} <= {
        here / name for name in BESIDE
    }
    assert int(categories) > 90
    wanted = {p.relative_to(ROOT) for p in (ROOT / "reobj").rglob("*.py")}
    wanted |= {p.relative_to(ROOT) for kind in DATA for p in (ROOT / "reobj").rglob(kind)}
    stubs = {p for p in wanted if "stubs" in p.parts}
    assert len(stubs) == 2 and Path("reobj/py.typed") in wanted
    wanted = wanted - stubs | {Path(*p.parts[2:]) for p in stubs} | set(map(Path, BESIDE))
    assert {str(p) for p in wanted if not (here / p).is_file()} == set()
    others = {p.name for p in here.iterdir()} - {p.parts[0] for p in wanted}
    assert {
        p for p in others if not re.match(r"reobj_track-.*\.dist-info|present|__py", p)
    } == set()
