"""Jobs of COLMAP in a child process: its aborts and its log stay there, progress is shown here.

A job is a folder with `job.json`, which names the file of the keyframes; the child leaves its
results in the folder.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import math
import os
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np

from reobj.files import LockedError, Progress, atomic, locked, writing
from reobj.types import Image, ReobjError

# ---- The files of a job --------------------------------------------------------------------------


class ImageFile:
    """Images (h, w, 3) of one size in a file, of which one at a time is in memory.

    Attributes:
        path: of the file, which holds the pixels of one image after the other.
        shape: (h, w, 3); () before the first image.
        slots: number in the file of each image of this sequence.
    """

    def __init__(
        self, path: Path, shape: Sequence[int] = (), slots: Sequence[int] | None = None
    ) -> None:
        self.path = path
        self.shape = tuple(shape)
        self.slots = [] if slots is None else list(slots)

    def __len__(self) -> int:
        return len(self.slots)

    def __getitem__(self, k: int) -> Image:
        size = math.prod(self.shape)
        pixels = np.fromfile(self.path, np.uint8, size, offset=self.slots[k] * size)
        return pixels.reshape(self.shape)

    def __iter__(self) -> Iterator[Image]:
        return (self[k] for k in range(len(self)))

    def append(self, image: Image) -> None:
        """Write an image at the end of the file."""
        if not self.slots:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.path.unlink(missing_ok=True)
        self.shape = image.shape
        with writing(self.path), open(self.path, "ab") as file:
            file.write(np.ascontiguousarray(image).data)
        self.slots.append(len(self.slots))

    def select(self, rows: Sequence[int]) -> ImageFile:
        """Return some of the images as a sequence of their own, of the same file."""
        return ImageFile(self.path, self.shape, [self.slots[k] for k in rows])


def write_job(folder: Path, job: dict[str, Any], images: ImageFile) -> None:
    """Write a job for the child into a folder, which is made; the images stay in their file."""
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    file = {"path": str(images.path), "shape": images.shape, "slots": images.slots}
    with atomic(folder / "job.json") as part:
        part.write_text(json.dumps(job | {"image_file": file}), encoding="utf-8")


def read_job(folder: Path) -> tuple[dict[str, Any], ImageFile]:
    """Read a job and its keyframes (BGR)."""
    job = json.loads((folder / "job.json").read_text(encoding="utf-8"))
    return job, ImageFile(**job["image_file"] | {"path": Path(job["image_file"]["path"])})


# ---- The process ---------------------------------------------------------------------------------


LEFT_OVER_S = 60.0  # for the child of a killed run to end, which it does at once (observed)


class Child:
    """A worker process that imports a module and does the job of a folder on request.

    It starts at once, so that its imports take no time later. As a context manager it ends with the
    block, and is killed by an exception. It also ends when this process is killed, and no other
    child works in the folder before it has ended.

    Args:
        module: its main part calls `serve`. log_path: receives the child's stderr; its folder is
            made. wait_s: for the child of a killed run to end.
    Raises:
        ReobjError: the child of another process works in the folder.
    """

    def __init__(
        self, module: str, folder: Path, log_path: Path, wait_s: float = LEFT_OVER_S
    ) -> None:
        self.log_path = log_path
        try:
            with locked(_lock_of(folder), wait_s):
                pass
        except LockedError:
            raise ReobjError(
                f"{folder.parent}: a reconstruction is still running in this folder; wait for it, "
                "or end it"
            ) from None
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
        traceback: TracebackType | None,
    ) -> None:
        if kind is not None:
            self.process.kill()
        with contextlib.suppress(BrokenPipeError):
            self.process.__exit__(kind, error, traceback)  # closes its pipes, waits

    def run(self, progress: Callable[[str, int], Progress]) -> str:
        """Request the job and show its progress.

        Args:
            progress: makes the line of a stage from its name and total.
        Returns:
            "" if it succeeded, else why the child stopped and where its log is.
        """
        assert self.process.stdin is not None and self.process.stdout is not None
        with contextlib.suppress(BrokenPipeError):  # why it ended is reported below
            self.process.stdin.write(b"go\n")
            self.process.stdin.flush()
        line: Progress | None = None
        for words in _messages(self.process.stdout):
            if words == DONE:
                break
            if not words and line is not None:
                line.step(0)
            if len(words) < 4 or words[0] != "reobj:":
                continue
            stage = " ".join(words[1:-2])
            done, total = map(int, words[-2:])
            if line is None or line.stage != stage:
                if line is not None:
                    line.close()
                line = progress(stage, total)
            line.step(done - line.done)
        else:
            code = self.process.wait()
            reason = f"signal {-code}" if code < 0 else f"exit code {code}"
            return f"stopped ({reason}), see {self.log_path}"
        if line is not None:
            line.close()
        return ""


DONE = ["reobj:", "done"]
ALIVE_S = 0.5  # of silence of the child, after which its progress line is drawn again


def _messages(stream: IO[bytes]) -> Iterator[list[str]]:
    """Yield the words of each line of a child, up to DONE or the end; [] after ALIVE_S without one.

    One call of COLMAP takes minutes, in which the child can send nothing.
    """
    found = queue.SimpleQueue[list[str] | None]()

    def read() -> None:
        words: list[str] = []
        while words != DONE and (text := stream.readline()):
            words = text.decode(errors="replace").split()
            found.put(words)
        found.put(None)

    threading.Thread(target=read, daemon=True).start()
    while True:
        try:
            words = found.get(timeout=ALIVE_S)
        except queue.Empty:
            yield []
            continue
        if words is None:
            return
        yield words


def _lock_of(folder: Path) -> Path:
    """Return the lock file that a child holds: beside its folder, which may be removed."""
    return folder.with_name(f"{folder.name}.lock")


def serve(job: Callable[[Path], None]) -> None:
    """Do the job of the folder on the command line for each line of stdin (in the child).

    The process ends as soon as stdin does, also in the middle of a job: its parent is gone.
    """
    if sys.platform == "linux":  # at once, also in long calls of COLMAP that hold the interpreter
        pr_set_pdeathsig = 1  # of sys/prctl.h
        ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGKILL)
    folder = Path(sys.argv[1])
    requests = threading.Semaphore(0)
    with locked(_lock_of(folder), LEFT_OVER_S):
        threading.Thread(target=_watch_parent, args=(requests,), daemon=True).start()
        while requests.acquire():
            job(folder)
            print(*DONE, flush=True)


def _watch_parent(requests: threading.Semaphore) -> None:
    """Count the lines of stdin; end this process at their end, even during a job."""
    while data := os.read(0, 1):  # not sys.stdin, whose lock would block the end of the process
        if data == b"\n":
            requests.release()
    os._exit(0)


def send_progress(stage: str, done: int, total: int) -> None:
    """Print a line of progress for `Child.run`; total 0: the stage has no steps."""
    print("reobj:", stage, done, total, flush=True)
