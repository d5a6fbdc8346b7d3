#!/usr/bin/env python3
"""Write docs/api.md: what `reobj_track` and `quadrics` offer, with signatures and docstrings.

    python examples/api_reference.py                 # the default: docs/api.md
    python examples/api_reference.py -o other.md

The page holds the names of `__all__` and nothing else, in the order of GROUPS; a name that is in
`__all__` and in no group is an error. `tests/test_docs.py` fails when the page is not what the
docstrings say.
"""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import re
import sys
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import quadrics
import reobj_track as rt
from reobj.options import every_option

PAGE = Path(__file__).resolve().parent.parent / "docs" / "api.md"
HEAD = """# API reference

Made from the docstrings by `python examples/api_reference.py`; do not edit. Where to begin: `run`
and `track`; [`examples/four_ways.py`](../examples/four_ways.py) shows the ways to call them;
[formats.md](formats.md) describes the files. `quadrics` is the geometry alone.

`Array`, `IntArray`, `BoolArray`, `Image`, `Floats` are numpy arrays of float64, int64, bool, uint8,
float32; (N, 4) is a shape; `xyxy` are pixels, the top-left one spans [0, 1]; `b_from_a` maps
coordinates in a to b. All types are known to type checkers.
"""
CONFIGS = (
    "InputConfig DetectConfig EmbedConfig TrackerConfig PosesConfig ObjectsConfig OutputConfig"
)
GROUPS: dict[str, str] = {
    "The whole chain": "run refit Result Object World Part LinkEvent evaluate export",
    "The tracker": "track Tracker Tracks Detections Embeddings Frame Video",
    "Detectors and files": "OnnxDetector DetectionSource open_detections read_detections "
    "read_tracks write_detections_npz list_models model_path COCO_NAMES",
    "Appearance": "Embedder CropEmbedder SamplingLayout",
    "Cameras": "Camera Poses estimate_poses read_poses",
    "Options": f"Config {CONFIGS}",
    "Errors, command line": "ReobjError main __version__",
}
GEOMETRY: dict[str, str] = {
    "Objects from boxes": "fit_objects ObjectFits Ellipsoids Scale FitConfig",
    "Size priors": "Priors load_priors SUPPORTS",
    "Methods as published": "fit_lfd fit_sfmo SfmoResult fit_psfmo PsfmoResult",
    "Projection and overlap": "project boxes_from_dual_conics solid_boxes clip_boxes box_iou "
    "reprojection_iou volume_overlap",
    "Rotations, errors": "rotations rotation_vectors camera_up QuadricsError",
}
ALIASES = {"Array", "IntArray", "BoolArray"}  # said in the head
CONSTANTS = {
    "COCO_NAMES": "The 80 class names of COCO, by class id.",
    "SUPPORTS": f"The shapes of solids: `{'`, `'.join(quadrics.SUPPORTS)}`.",
    "__version__": "The version, a text.",
}
BOOKKEEPING = {  # methods by which the tool keeps its files
    "to_json", "from_json", "keep_embeddings", "save_tracked", "load_tracked", "updated",
}  # fmt: skip
LONG_DEFAULT = 40  # characters; a longer one is not shown


def reference() -> str:
    """Return the whole page."""
    parts = [HEAD, *chapter(rt, GROUPS), *chapter(quadrics, GEOMETRY)]
    return "\n".join(parts).rstrip() + "\n"


def chapter(module: ModuleType, groups: dict[str, str]) -> Iterator[str]:
    """Write the public names of a module, group by group."""
    grouped = {name for names in groups.values() for name in names.split()}
    public = set(module.__all__) - ALIASES
    if grouped != public:
        raise SystemExit(f"{module.__name__}: in __all__ or in a group only: {grouped ^ public}")
    yield f"## {module.__name__}\n"
    for title, names in groups.items():
        yield f"### {title}\n"
        if title == "Options":
            yield options()
            continue
        for name in names.split():
            yield from entry(name, getattr(module, name))


def entry(name: str, thing: Any) -> Iterator[str]:
    """Write a function, a class with its methods, or a constant."""
    if inspect.isclass(thing):
        yield from class_entry(name, thing)
    elif callable(thing):
        yield f"#### {name}\n`{signature(name, thing)}`\\\n{prose(thing)}\n"
    else:
        yield f"#### {name}\n{CONSTANTS[name]}\n"


def class_entry(name: str, thing: type) -> Iterator[str]:
    """Write a class: how it is made, its fields as options if it has help, its own methods."""
    made = name
    if dataclasses.is_dataclass(thing) or "__init__" in vars(thing) or hasattr(thing, "_fields"):
        made = signature(name, thing)
    yield f"#### {name}\nclass `{made}`\\\n{prose(thing)}\n"
    if dataclasses.is_dataclass(thing) and any("help" in f.metadata for f in fields(thing)):
        yield option_table({f.name: f for f in fields(thing)})
    methods = [f"* {text}" for name in vars(thing) if (text := method_entry(thing, name))]
    yield from methods
    if methods:
        yield ""


def method_entry(thing: type, name: str) -> str:
    """Write a public method or property that has a docstring, "" for anything else."""
    member = vars(thing)[name]
    plain = member.__func__ if isinstance(member, staticmethod | classmethod) else member
    hidden = (name[0] == "_" and name != "__call__") or name in BOOKKEEPING
    if hidden or not getattr(plain, "__doc__", None):
        return ""
    if isinstance(plain, property):
        return f"**`.{name}`** {indented(prose(plain), 2)}"
    if not inspect.isfunction(plain):
        return ""
    call = signature("" if name == "__call__" else f".{name}", plain)
    return f"**`{call}`** {indented(prose(plain), 2)}"


def fields(thing: Any) -> tuple[dataclasses.Field[Any], ...]:
    """Return the fields of a dataclass."""
    return dataclasses.fields(thing)


class Written:
    """A type or a default as the source writes it."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __repr__(self) -> str:
        return self.text


def signature(name: str, thing: Any) -> str:
    """Return the call as the source writes it, without `self`; types without their module."""
    call = inspect.signature(thing)
    shown = []
    for parameter in call.parameters.values():
        if parameter.name in ("self", "cls"):
            continue
        text = repr(parameter.default)
        if text.startswith(("<factory", "<function")) or len(text) > LONG_DEFAULT:
            parameter = parameter.replace(default=Written("..."))
        if parameter.annotation is not parameter.empty:
            parameter = parameter.replace(annotation=type_text(parameter.annotation))
        shown.append(parameter)
    returns = type_text(call.return_annotation)
    if returns.text in ("None", "_empty"):
        return name + str(call.replace(parameters=shown, return_annotation=call.empty))
    return name + str(call.replace(parameters=shown, return_annotation=returns))


def type_text(annotation: Any) -> Written:
    """Return a type as text: `np.floating[Any]` stays, `npt.ArrayLike` becomes `ArrayLike`."""
    text = getattr(annotation, "__forward_arg__", None) or getattr(annotation, "__name__", None)
    return Written(re.sub(r"\b(?:npt|quadrics)\.(?=[A-Z])", "", text or str(annotation)))


SECTION = re.compile(r"(Args|Attributes|Returns|Yields|Raises):\n")


def prose(thing: Any) -> str:
    """Return the docstring as Markdown: paragraphs on a line each, sections as a list, code.

    In Args, Attributes and Raises a line that starts with names and a colon begins an item.
    """
    parts: list[str] = []
    for block in (inspect.getdoc(thing) or "").split("\n\n"):
        if block.startswith((">>> ", "    ")):
            parts.append(f"```python\n{textwrap.dedent(block)}\n```")
            continue
        text, *sections = SECTION.split(block)  # text, then name and body of each section
        if text.strip():
            parts.append(joined(text))
        items: list[str] = []
        for name, body in zip(sections[::2], sections[1::2], strict=True):
            body, ref, rest = body.partition("\nRef: ")
            if name == "Attributes" and items:
                items.append("\nAttributes:")
            items += section_items(name, body)
            items += ["\n" + joined(ref + rest)] if ref else []
        parts += ["\n".join(items)] if items else []
    return "\n\n".join(parts)


def section_items(name: str, body: str) -> list[str]:
    """Return the items of a section of a docstring."""
    if name in ("Returns", "Yields"):
        return [f"- **{name.lower()}** {joined(body)}"]
    before = "**raises** " if name == "Raises" else ""
    items = re.split(r"^    (?=\w[\w, ]*: )", body, flags=re.M)
    named = [joined(item).partition(": ") for item in items if item.strip()]
    return [f"- {before}`{names}`: {text}" for names, _, text in named]


def joined(text: str) -> str:
    """Join the lines of a paragraph."""
    return " ".join(text.split())


def indented(text: str, by: int) -> str:
    """Indent all lines but the first."""
    return re.sub(r"\n(?=.)", "\n" + " " * by, text)


def options() -> str:
    """Return the table of all options of `Config`, and what its sections are called."""
    lines = [
        "`Config` holds a section for each stage, all frozen dataclasses: "
        f"`{'`, `'.join(CONFIGS.split())}`. On the command line every option is set by `--set "
        "section.field=value`, the common ones by a flag too; in Python "
        '`rt.Config(tracker=rt.TrackerConfig(coast_frames=60), poses=rt.PosesConfig(mode="none"))`.'
        "\n",
        option_table(every_option(rt.Config())),
    ]
    return "\n".join(lines)


def option_table(named: dict[str, dataclasses.Field[Any]]) -> str:
    """Return a table of options: name, flag, default, help."""
    flags = any(f.metadata.get("flag") for f in named.values())
    lines = ["| option | default | |", "|---|---|---|"]
    for name, f in named.items():
        flag = f.metadata.get("flag", "") if flags else ""
        called = f"`{name}`" + (f", `{flag}`" if flag else "")
        default = f"`{f.default}`" if str(f.default) else ""
        lines.append(f"| {called} | {default} | {f.metadata['help']} |".replace("\\|", "\\\\|"))
    return "\n".join(lines) + "\n"


def main(argv: Sequence[str] | None = None) -> int:
    """Write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=PAGE)
    args = parser.parse_args(argv)
    args.out.write_text(reference())
    print(args.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
