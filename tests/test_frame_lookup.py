"""Names of images are matched by the fewest folders that make them unique."""

from __future__ import annotations

import pytest

from reobj.formats import frames_by_name
from reobj.types import ReobjError

IMAGES = ["/data/walk/left/0001.jpg", "/data/walk/left/0002.jpg", "/data/walk/left/0003.jpg"]


@pytest.mark.parametrize(
    ("given", "frames", "rule"),
    [
        (["0003.jpg", "0001.jpg"], [2, 0], "file names"),
        (["images/0002.jpg", "other/0009.jpg"], [1, -1], "file names"),
        ([r"images\0002.jpg"], [1], "file names"),  # written on Windows
        (["right/0001.jpg", "left/0001.jpg"], [-1, 0], "file names with 1 folders"),
        (["0002.png"], [1], "file names, without suffixes"),
        (["right/0001", "left/0001"], [-1, 0], "file names with 1 folders, without suffixes"),
        (["0009.jpg"], [-1], ""),
        ([], [], ""),
    ],
)
def test_names_are_matched(given: list[str], frames: list[int], rule: str) -> None:
    found, by = frames_by_name(given, IMAGES)
    assert found.tolist() == frames
    assert by == rule


def test_a_name_in_two_unknown_folders_is_refused() -> None:
    with pytest.raises(ReobjError, match=r"0001.jpg is the name of several images"):
        frames_by_name(["a/0001.jpg", "b/0001.jpg"], IMAGES)


def test_folders_are_compared_up_to_the_first() -> None:
    names = ["walk/right/images/1.jpg", "walk/left/images/1.jpg"]
    found, rule = frames_by_name(names, ["left/images/1.jpg", "right/images/1.jpg"])
    assert found.tolist() == [1, 0] and rule == "file names with 2 folders"
