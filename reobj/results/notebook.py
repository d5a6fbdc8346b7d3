"""A result in a notebook: the table of its objects and its viewer as HTML."""

from __future__ import annotations

import html
import tempfile
from pathlib import Path

import numpy as np

from reobj.files import cut
from reobj.results.entries import Object
from reobj.results.result import Result, sides
from reobj.results.scene import Pictures, write_scene
from reobj.sources.video import ImagelessVideo

VIEWER_PX = 600  # height of the viewer: a notebook on a laptop shows it whole


def to_html(result: Result) -> str:
    """Return a table of the objects, and the viewer in an iframe.

    The viewer is the scene.html of the folder, else a page without pictures; without either it is
    left out. Its page is part of the HTML (.7 MB, with pictures up to 10 MB), so that it works
    where the notebook's server does not serve the folder. The iframe is sandboxed: scripts of the
    page cannot reach the notebook.
    """
    head = f"<p><code>{html.escape(repr(result))}</code></p>"
    page = viewer_page(result)
    if not page:
        return head + _table(result)
    # Within an attribute only & and " have a meaning
    text = page.replace("&", "&amp;").replace('"', "&quot;")
    frame = f'<iframe sandbox="allow-scripts allow-downloads" srcdoc="{text}" '
    frame += f'style="width:100%;height:{VIEWER_PX}px;border:0"></iframe>'
    return head + _table(result) + frame


def viewer_page(result: Result) -> str:
    """Return the page of the viewer: that of the folder, else without pictures.

    Without a folder and without cameras there is nothing to show: "".
    """
    if result.out is not None and (result.out / "scene.html").is_file():
        return (result.out / "scene.html").read_text(encoding="utf-8")
    if result.poses is None or not result.poses.known.any():
        return ""
    info = result.video
    video = ImagelessVideo(info.path, (info.width, info.height))
    video.fps = info.fps
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.html"
        write_scene(result, Pictures(result, video), path, video)
        return path.read_text(encoding="utf-8")


def _table(result: Result) -> str:
    """Return the table of the objects as HTML, those that do not count at its end."""
    objects = sorted(result.objects, key=lambda o: not o.counted)
    titles = ("object", "class", "status", "frames", "width x depth x height", "sigma")
    rows = "".join(_row("td", _cells(o)) for o in objects)
    style = "max-height:20em;overflow:auto"
    return f'<div style="{style}"><table>{_row("th", titles)}{rows}</table></div>'


def _row(tag: str, cells: tuple[str, ...]) -> str:
    """Return a row of a table; its texts are escaped."""
    return f"<tr>{''.join(f'<{tag}>{html.escape(text)}</{tag}>' for text in cells)}</tr>"


def _cells(found: Object) -> tuple[str, ...]:
    """Format the columns of an object, as in the report of `run`."""
    size = " x ".join(side for side, *_ in sides(found))
    unit = "units" if found.size_m is None else "m"
    sigma = found.size_rel_sigma
    return (
        str(found.id),
        cut(found.class_name, 40),
        found.status,
        str(found.frames_seen),
        f"{size} {unit}" if size else "-",
        "-" if sigma is None else f"{100 * np.max(sigma):.0f} %",
    )
