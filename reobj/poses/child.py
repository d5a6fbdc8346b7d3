"""Steps of COLMAP in a child process: aborts and log stay there, its progress is shown here."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from reobj.files import Progress


class Child:
    """A fresh interpreter that imports a module and does the job of a folder whenever it is told.

    It starts at once, so that its imports take no time later. A context: it ends with it, and is
    killed by an exception.

    Args:
        module: its main part calls `serve`. log_path: receives the child's stderr; its folder is
            made.
    """

    def __init__(self, module: str, folder: Path, log_path: Path) -> None:
        self.log_path = log_path
        log_path.parent.mkdir(parents=True, exist_ok=True)
        # -P: not the modules of the working directory; the package's own folder comes first
        command = [sys.executable, "-P", "-m", module, str(folder)]
        paths = [str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")]
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
            "OPENBLAS_NUM_THREADS": "1",  # pairs of images are matched side by side
        }
        pipe = subprocess.PIPE
        with open(log_path, "wb") as errors:
            self.process = subprocess.Popen(
                command, stdin=pipe, stdout=pipe, stderr=errors, env=environment
            )

    def __enter__(self) -> Child:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        if kind is not None:
            self.process.kill()
        with contextlib.suppress(BrokenPipeError):
            self.process.__exit__(kind, error, at)  # closes its pipes, waits

    def run(self, progress: Callable[[str, int], Progress]) -> str:
        """Have the job done and show its progress.

        Args:
            progress: makes the line of a stage from its name and total.
        Returns:
            "" if it ended well, else why the child stopped and where its log is.
        """
        assert self.process.stdin is not None and self.process.stdout is not None
        with contextlib.suppress(BrokenPipeError):  # what it printed last, and why, is read below
            self.process.stdin.write(b"go\n")
            self.process.stdin.flush()
        line: Progress | None = None
        for text in self.process.stdout:
            words = text.decode(errors="replace").split()
            if words == DONE.split():
                break
            if len(words) != 4 or words[0] != "reobj:":
                continue
            stage, done, total = words[1], int(words[2]), int(words[3])
            if line is None or line.stage != stage:
                if line is not None:
                    line.close()
                line = progress(stage, total)
            line.step(done - line.done)
        else:
            code = self.process.wait()
            why = f"signal {-code}" if code < 0 else f"exit code {code}"
            return f"stopped ({why}), see {self.log_path}"
        if line is not None:
            line.close()
        return ""


DONE = "reobj: done"


def serve(job: Callable[[Path], None]) -> None:
    """Do the job of the folder of the command line for each line of stdin (in the child)."""
    for _ in sys.stdin:
        job(Path(sys.argv[1]))
        print(DONE, flush=True)


def send_progress(stage: str, done: int, total: int) -> None:
    """Print a line of progress for `Child.run`."""
    print("reobj:", stage, done, total, flush=True)
