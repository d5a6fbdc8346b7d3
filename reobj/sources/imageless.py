"""Frames without images: the substitute for a video where only detections and poses are given."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from reobj.sources.image_files import IMAGE_FPS, times_of_names
from reobj.sources.video import InputConfig, Video, source_fingerprint
from reobj.types import Frame, ReobjError


class ImagelessVideo(Video):
    """Iterate over frames with a number, a time and perhaps a name, but without an image.

    Supports tracking by motion and given cameras, 3D objects and all files; not detectors,
    appearance, reconstruction, overlay video and pictures in the viewer.

    Args:
        source: file or folder of poses that defines the frames.
        size: (w, h) of the images of the detections, px.
        times_s: (F,) of the frames by number. None: from their names, else 30 Hz.
        names: (F,) of the images by number, "" where unknown, or [].
        count: F, if there are neither times nor names.
    """

    has_images = False

    def __init__(
        self,
        source: str | Path,
        size: Sequence[int],
        config: InputConfig | None = None,
        *,
        times_s: npt.ArrayLike | None = None,
        names: Sequence[str] = (),
        count: int = 0,
    ) -> None:
        self.source = str(source)
        self.config = config or InputConfig()
        self.fingerprint = source_fingerprint(source)
        if self.config.every < 1 or min(dataclasses.astuple(self.config)) < 0:
            raise ReobjError("--every must be at least 1; --start, --stop, --max-size at least 0")
        self.size = self.working_size = (int(size[0]), int(size[1]))
        self.scale = self.pixel_aspect = 1.0
        self.names = list(names)
        self.files = []
        given = times_of_names(self.names) if times_s is None else np.asarray(times_s, np.float64)
        self.times_s = given
        self.times_are_known = given is not None
        self.frame_count = max(len(self.names), count, 0 if given is None else len(given))
        if given is not None and len(given) < self.frame_count:
            counts = f"{len(given)} times of {self.frame_count} frames"
            raise ReobjError(f"{self.source}: {counts}; expected one each")
        self._clock = None
        self._announced = self.frame_count
        self.fps = IMAGE_FPS
        if given is not None and len(given) > 1:
            self.fps = 1 / max(float(np.median(np.diff(given))), 1e-3)
        self.is_live = False
        self.read = 0
        self.dropped = 0
        self.skipped = []
        self.messages = []

    def facts(self) -> dict[str, Any]:
        """Return the arguments to make the same frames again, as JSON values."""
        times_s = None if self.times_s is None else self.times_s.tolist()
        return {"size": self.size, "times_s": times_s, "names": self.names,
                "count": self.frame_count}  # fmt: skip

    def __iter__(self) -> Iterator[Frame]:
        stop = min(self.config.stop or self.frame_count, self.frame_count)
        times_s = self.times_s
        no_image: Any = None
        for index in range(self.config.start, stop, self.config.every):
            time_s = index / IMAGE_FPS if times_s is None else float(times_s[index])
            if index > self._after:
                yield Frame(index, time_s, no_image)
