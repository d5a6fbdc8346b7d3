"""Steps of COLMAP in a child process: aborts and log stay there, its progress is shown here."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from reobj.files import Progress


def run_child(
    module: str, folder: Path, log_path: Path, progress: Callable[[str, int], Progress]
) -> str:
    """Run `python -m MODULE FOLDER` in a fresh interpreter and show its progress.

    Args:
        log_path: receives its stderr. progress: makes the line of a stage from its name and total.
    Returns:
        "" if it ended well, else why it stopped and where its log is.
    """
    # -P: not the modules of the working directory; the package's own folder comes first
    command = [sys.executable, "-P", "-m", module, str(folder)]
    paths = [str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    line: Progress | None = None
    with (
        open(log_path, "wb") as errors,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, env=environment) as child,
    ):
        try:
            for text in child.stdout or ():
                words = text.decode(errors="replace").split()
                if len(words) != 4 or words[0] != "reobj:":
                    continue
                stage, done, total = words[1], int(words[2]), int(words[3])
                if line is None or line.stage != stage:
                    if line is not None:
                        line.close()
                    line = progress(stage, total)
                line.step(done - line.done)
        except BaseException:
            child.kill()
            raise
    if line is not None:
        line.close()
    if child.returncode == 0:
        return ""
    why = f"signal {-child.returncode}" if child.returncode < 0 else f"exit code {child.returncode}"
    return f"stopped ({why}), see {log_path}"


def send_progress(stage: str, done: int, total: int) -> None:
    """Print a line of progress for `run_child`."""
    print("reobj:", stage, done, total, flush=True)
