"""Write docs/api.md: signatures and first docstring lines of all public names.

    python docs/make_api.py

The site shows the same names with their full docstrings (`site_page`, used by docs/site_hooks.py).
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parent / "api.md"
DEFAULT = 24  # characters of a default value that is shown
FIELDS = 14  # an options class with more has its fields in its docstring only
INTERNAL = set(
    "cached cameras_text cells cut fault flush frozen keep_embeddings selects "
    "look maps masked of put run_conv_block span_text to_json trained updated".split()
)  # methods for the tool itself

HEAD = """# Python reference

Start with `run` and `track` (`import reobj_track as rt`). Types, shapes and units are in the
docstrings (`help(rt.run)`); the documentation site shows them in full. Options:
`python reobj_track.py --options`. Other names are not public.

`Array`, `IntArray`, `BoolArray` are numpy arrays of float64, int64, bool; (N, 4) is a shape; images
are BGR, (H, W, 3) uint8; `xyxy` are pixels, the top-left one spans [0, 1]; `b_from_a` maps
coordinates in a to b.
"""
MIDDLE = """## quadrics

The module `quadrics.py` needs numpy alone. [How it works](quadrics.md).
"""

GROUPS = {
    "reobj_track": {
        "The whole chain": "run refit Result Object World Part LinkEvent evaluate export",
        "Map of a room": "RoomMap Changes Change",
        "Tracker": "track Tracker Tracks Detections Embeddings Frame Video",
        "Detectors and files": "OnnxDetector DetectionSource open_detections read_detections "
        "read_tracks write_detections_npz list_models model_path COCO_NAMES",
        "Appearance": "Embedder CropEmbedder SamplingLayout",
        "Cameras": "Camera Poses estimate_poses read_poses",
        "Options": "Config InputConfig DetectConfig EmbedConfig TrackerConfig MatchingOptions "
        "PosesConfig ObjectsConfig OutputConfig MapConfig",
        "Errors, command line": "ReobjError main",
    },
    "quadrics": {
        "Objects from boxes": "fit_objects ObjectFits Ellipsoids Scale FitConfig",
        "Size priors": "Priors load_priors SUPPORTS",
        "Published methods": "fit_lfd fit_sfmo SfmoResult fit_psfmo PsfmoResult",
        "Projection and overlap": "project boxes_from_dual_conics solid_boxes clip_boxes box_iou "
        "reprojection_iou volume_overlap",
        "Rotations, errors": "rotations rotation_vectors camera_up QuadricsError",
    },
}
CONSTANTS = {
    "COCO_NAMES": ("COCO_NAMES: tuple[str, ...]", "The 80 class names of COCO, in order."),
    "SUPPORTS": ("SUPPORTS: tuple[str, ...]", "Shapes of objects: ellipsoid, box, cylinder."),
}


def groups() -> Iterator[tuple[str, str, list[str]]]:
    """Yield module, heading and names of every group."""
    for module, headings in GROUPS.items():
        for heading, names in headings.items():
            yield module, heading, names.split()


def site_page() -> str:
    """Return the page with directives of mkdocstrings in place of signatures."""
    parts = [HEAD]
    for module, heading, names in groups():
        level = "##"
        if module == "quadrics":
            level = "###"
            if heading == next(iter(GROUPS[module])):
                parts.append(MIDDLE)
        parts.append(f"{level} {heading}\n")
        parts += [f"::: {module}.{name}\n" for name in names]
    return "\n".join(parts)


def repository_page() -> str:
    """Return the page with signatures and summaries, readable without a site."""
    sys.path.insert(0, str(PAGE.parent.parent))
    parts = [HEAD]
    for module, heading, names in groups():
        if heading == next(iter(GROUPS["quadrics"])):
            parts.append(MIDDLE)
        parts.append(f"### {heading}\n" if module == "quadrics" else f"## {heading}\n")
        parts += [entry(name, getattr(__import__(module), name)) for name in names]
    return "\n".join(parts)


def entry(name: str, value: Any) -> str:
    """Return signature, summary and methods of a public name."""
    if name in CONSTANTS:
        head, summary = CONSTANTS[name]
    elif not inspect.isclass(value):
        head = signature(name, value, result=True)
        summary = first_line(value)
    elif issubclass(value, Exception):
        head = f"class {name}({value.__bases__[0].__name__})"
        summary = first_line(value)
    else:
        many = len(inspect.signature(value).parameters) >= FIELDS
        options = name.endswith(("Options", "Layout", "Config"))
        head = f"class {name}(...)" if many and options else f"class {signature(name, value)}"
        summary = first_line(value)
    members = list(methods(value)) if inspect.isclass(value) else []
    lines = [f"**`{head}`**\n", summary, *([""] if members else []), *members]
    return "\n".join(lines) + "\n"


def methods(cls: type) -> Iterator[str]:
    """Yield a list item for every public method and property of a class."""
    for name, member in vars(cls).items():
        if name.startswith("_") or name in INTERNAL:
            continue
        if isinstance(member, property):
            yield f"- `{name}`: {first_line(member.fget)}"
        elif isinstance(member, classmethod | staticmethod):
            call = signature(name, getattr(cls, name))
            yield f"- `{cls.__name__}.{call}`: {first_line(member.__func__)}"
        elif inspect.isfunction(member):
            yield f"- `{signature(name, member)}`: {first_line(member)}"


def signature(name: str, value: Any, result: bool = False) -> str:
    """Return `name(parameters)`, with the type of the result where wanted."""
    call = inspect.signature(value)
    parameters = [p for p in call.parameters.values() if p.name != "self" and p.name[0] != "_"]
    texts: list[str] = []
    for parameter in parameters:
        if parameter.kind is inspect.Parameter.KEYWORD_ONLY and "*" not in texts:
            texts.append("*")
        texts.append(parameter_text(parameter))
    returned = f" -> {type_text(call.return_annotation)}" if result else ""
    return f"{name}({', '.join(texts)}){returned}"


def parameter_text(parameter: inspect.Parameter) -> str:
    """Return a parameter with its default."""
    star = {"VAR_POSITIONAL": "*", "VAR_KEYWORD": "**"}.get(parameter.kind.name, "")
    text = star + parameter.name
    if parameter.default is not inspect.Parameter.empty:
        default = repr(parameter.default)
        default = "..." if len(default) > DEFAULT or "<" in default else default
        text += f"={default}"
    return text


def type_text(annotation: Any) -> str:
    """Return a type as it is written in the source."""
    return annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)


def first_line(value: Any) -> str:
    """Return the first line of a docstring."""
    return (inspect.getdoc(value) or "").partition("\n")[0]


if __name__ == "__main__":
    PAGE.write_text(repository_page())
