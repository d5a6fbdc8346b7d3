"""The map of an output folder for `serve`: its recordings, and undo of saved corrections."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from reobj.files import atomic
from reobj.maps.corrections import forget, with_edits
from reobj.maps.earlier import earlier_sessions
from reobj.maps.room_map import MapPoints, RoomMap, map_lock
from reobj.results.changes import EarlierSession
from reobj.results.edits import Edits
from reobj.types import ReobjError


class FolderMap:
    """The map of an output folder, and copies of it from before corrections were saved.

    Beside a copy lies a file of digests (`_digest`): of the map when it was copied, and with the
    corrections. Undo restores the copy if the map still has one of them: then no other run, and no
    `map` command, has written it. The recording itself may have been fitted again since.

    Args:
        path: of the map. recording: key of the recording, as `session_key` returns it.
        frozen: fits of the folder do not change the map.
    """

    def __init__(self, path: Path, recording: str, frozen: bool) -> None:
        self.path = path
        self.recording = recording
        self.frozen = frozen

    def others(self) -> Sequence[EarlierSession]:
        """Return the other recordings that the map has now.

        Raises:
            ReobjError: the map is missing or damaged.
        """
        return earlier_sessions(RoomMap.load(self.path), self.path, self.recording)

    def keep(self, copy: Path, edits: Edits) -> None:
        """Copy the map before corrections are applied.

        Args:
            copy: file to write. edits: the corrections; their digest is stored in advance, for a
                program that is killed after it applied them.
        Raises:
            ReobjError: the map is missing or damaged.
        """
        before = RoomMap.load(self.path)
        _write(copy, self.path.read_bytes())
        self._add(copy, before, with_edits(before, edits))

    def applied(self, copy: Path) -> None:
        """Store the digest of the map with the corrections that were applied after `copy`."""
        self._add(copy, RoomMap.load(self.path))

    def restore(self, copy: Path) -> Callable[[], None]:
        """Replace the map by a copy.

        Returns:
            a function that undoes it, unless another run has written the map since.
        Raises:
            ReobjError: another run writes the map, or has changed it since; it stays as it is.
        """
        with map_lock(self.path):
            after = self.path.read_bytes()
            if self._digest(RoomMap.load(self.path)) not in _digests(copy):
                raise ReobjError(
                    f"{self.path}: another command has changed the map since this save, and undo "
                    "would lose it; nothing was undone. `map MAP --rename`, `--undelete` correct it"
                )
            _write(self.path, copy.read_bytes())

        def put_back() -> None:
            with map_lock(self.path):
                if self._digest(RoomMap.load(self.path)) == self._digest(RoomMap.load(copy)):
                    _write(self.path, after)

        return put_back

    def _add(self, copy: Path, *rooms: RoomMap) -> None:
        """Add digests of maps to those of a copy."""
        found = dict.fromkeys([*_digests(copy), *map(self._digest, rooms)])
        _write(_digests_path(copy), "\n".join(found).encode())

    def _digest(self, room: RoomMap) -> str:
        """Hash the corrections of a map, and all that its other recordings added, except points.

        A refit of the recording itself does not change it.
        """
        corrections = [[o.id, o.name, o.deleted] for o in room.objects if o.name or o.deleted]
        merged = sorted(room.merged.items())
        own = room.session_of(self.recording)
        others = room if own is None else forget(room, own.number)
        largest = 1 << 30  # free numbers grow with each refit
        others = dataclasses.replace(
            others, points=MapPoints.empty(), next_id=largest, next_session=largest, merged={}
        )
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "others.map"
            others.save(file)  # the same map gives the same bytes
            content = file.read_bytes()
        return hashlib.sha256(content + json.dumps([corrections, merged]).encode()).hexdigest()


def _digests_path(copy: Path) -> Path:
    return copy.with_suffix(".digests")


def _digests(copy: Path) -> list[str]:
    """Read the digests of a copy."""
    path = _digests_path(copy)
    return path.read_text(encoding="utf-8").split() if path.is_file() else []


def _write(path: Path, content: bytes) -> None:
    with atomic(path) as part:
        part.write_bytes(content)
