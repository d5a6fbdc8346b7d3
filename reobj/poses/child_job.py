"""Steps of COLMAP in a child process: aborts and log stay there, its progress is shown here."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from reobj.files import LockedError, Progress, locked
from reobj.types import ReobjError


class Child:
    """A fresh interpreter that imports a module and does the job of a folder whenever it is told.

    It starts at once, so that its imports take no time later. A context: it ends with it, and is
    killed by an exception. Where this process is killed it ends too, and no other child works in
    the folder before it has.

    Args:
        module: its main part calls `serve`. log_path: receives the child's stderr; its folder is
            made.
    Raises:
        ReobjError: the child of another process works in the folder.
    """

    def __init__(self, module: str, folder: Path, log_path: Path) -> None:
        self.log_path = log_path
        try:
            with locked(_lock_of(folder), LEFT_OVER_S):
                pass
        except LockedError:
            why = "a reconstruction still runs in this folder"
            raise ReobjError(f"{folder.parent}: {why}; wait for it, or end it") from None
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
PR_SET_PDEATHSIG = 1  # of Linux' sys/prctl.h
LEFT_OVER_S = 60.0  # for the child of a killed run to end; chosen: it does at once (watched)


def _lock_of(folder: Path) -> Path:
    """Name the file that a child holds the lock of: beside its folder, which may be removed."""
    return folder.with_name(f"{folder.name}.lock")


def serve(job: Callable[[Path], None]) -> None:
    """Do the job of the folder of the command line for each line of stdin (in the child).

    The process ends as soon as stdin does, also in the middle of a job: its parent is gone.
    """
    if sys.platform == "linux":  # at once, also in long calls of COLMAP that hold the interpreter
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    folder, told = Path(sys.argv[1]), threading.Semaphore(0)
    with locked(_lock_of(folder), LEFT_OVER_S):
        threading.Thread(target=_watch_parent, args=(told,), daemon=True).start()
        while told.acquire():
            job(folder)
            print(DONE, flush=True)


def _watch_parent(told: threading.Semaphore) -> None:
    """Count the lines of stdin; end this process at their end, whatever it does."""
    while data := os.read(0, 1):  # not sys.stdin, whose lock would hang the end of the process
        if data == b"\n":
            told.release()
    os._exit(0)


def send_progress(stage: str, done: int, total: int) -> None:
    """Print a line of progress for `Child.run`."""
    print("reobj:", stage, done, total, flush=True)
