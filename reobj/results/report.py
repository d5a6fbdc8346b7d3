"""Report of a result for the terminal: the table of objects, counts, cameras, times and files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

import quadrics
from reobj.files import cut, texts_with_sigma, wrapped
from reobj.results.entries import Object

if TYPE_CHECKING:
    from reobj.results.result import Result


def summary(result: Result) -> str:
    """Write the report that `run` prints."""
    counted = [o for o in result.objects if o.counted]
    lines = _table(result, counted)
    lines += _reasons(counted)
    lines += _class_counts(result, counted)
    if result.changes is not None:
        lines += wrapped(result.changes.summary())
    lines += _implausible(result)
    doubtful = sum(o.status == "doubtful" for o in result.objects)
    if doubtful > 0:
        lines.append(f"low confidence: {doubtful} more, probably false positives (objects.json)")
    lines += _cameras(result)
    lines.append("seconds: " + ", ".join(_stage_time(result, s) for s in result.seconds))
    if result.out is not None:
        names = ("scene.html", "overlay.mp4", "overlay.webm", "objects.json")
        files = [result.out / name for name in names]
        lines.append("look at: " + ", ".join(str(file) for file in files if file.exists()))
    return "\n".join(lines)


def _stage_time(result: Result, stage: str) -> str:
    """Format the seconds of a stage: of its steps, or that it was taken from the cache."""
    text = f"{stage} {result.seconds[stage]:.1f}"
    steps = result.step_seconds.get(stage)
    if steps is None or list(steps) == [stage]:
        return text
    times = ", ".join(f"{step} {seconds:.1f}" for step, seconds in steps.items())
    return f"{text} ({times or 'from the cache'})"


def sides(found: Object) -> list[tuple[str, ...]]:
    """Format width, depth, height (own axes x, y, z; m or units) with sigmas, if they are known.

    Returns:
        three (value, sigma) or (value,); [] without a size.
    """
    size = found.size if found.size_m is None else found.size_m
    if size is None:
        return []
    sigma = None if found.size_rel_sigma is None else size * found.size_rel_sigma
    return texts_with_sigma(size, sigma)


def _table(result: Result, counted: Sequence[Object]) -> list[str]:
    """Format a header and a line for each object; sizes only if there are any."""
    in_metres = any(o.size_m is not None for o in result.objects)
    has_sizes = any(o.size is not None for o in counted)
    several = len(result.world.parts) > 1
    unit = "m" if in_metres else "units"
    columns = f"{'object':>6}  {'class':<14} {'frames':>6} {'visits':>6}  "
    if has_sizes:
        columns += f"{f'width x depth x height, {unit}':<26} {'sigma':>6}  "
    lines = [columns + "status"]
    for o in counted:
        name = cut(o.class_name, 40)  # for a line of 120 characters
        line = f"{o.id:>6}  {name:<14} {o.frames_seen:>6} {len(o.visits):>6}  "
        if has_sizes:
            line += _size_columns(o, in_metres)
        line += o.status
        if several:
            line += f", component {o.part}"
        lines.append(line)
    return lines


def _size_columns(found: Object, in_metres: bool) -> str:
    """Format an object's size and the largest relative sigma of its sides.

    Args:
        in_metres: the header states metres; a size in world units then names its unit.
    """
    size = " x ".join(side for side, *_ in sides(found)) or "-"
    if in_metres and found.size is not None and found.size_m is None:
        size += " units"
    sigma = "-"
    if found.size_rel_sigma is not None:
        sigma = f"{100 * found.size_rel_sigma.max():.0f} %"
    return f"{size:<26} {sigma:>6}  "


def _reasons(counted: Sequence[Object]) -> list[str]:
    """Format each reason once, with the objects that have it."""
    objects_of: dict[str, list[int]] = {}
    for o in counted:
        if o.reason:
            objects_of.setdefault(f"{o.status}: {o.reason}", []).append(o.id)
    lines = list[str]()
    for reason, ids in objects_of.items():
        lines += wrapped(f"{reason}: {', '.join(map(str, ids))}")
    return lines


def _implausible(result: Result) -> list[str]:
    """List the objects that are not counted because of their size, with the reason of each."""
    odd = [o for o in result.objects if o.status == "implausible"]
    texts = [f"{o.class_name} {o.id} ({o.reason})" for o in odd]
    return wrapped(f"implausible, not counted: {', '.join(texts)}") if texts else []


def _class_counts(result: Result, counted: Sequence[Object]) -> list[str]:
    """Format the number of objects of each class."""
    counts = sorted(Counter(o.class_name for o in counted).items())
    names = ", ".join(f"{count} {name}" for name, count in counts) or "none"
    note = " (each component counted separately)" if len(result.world.parts) > 1 else ""
    return wrapped(f"distinct objects: {names}{note}")


def _cameras(result: Result) -> list[str]:
    """Format the number of frames with a pose, and the scale, of each component."""
    world = result.world
    if result.poses is None:
        return []
    if len(world.parts) < 2:
        scale = [f"scale: {_scale_text(world.scale)}"] if world.scale else []
        return [result.poses.cameras_text, *scale]
    count = f"{len(world.parts)} components, each with its own frame and scale"
    lines = [f"{result.poses.cameras_text} in {count}"]
    for k, component in enumerate(world.parts):
        objects = sum(o.part == k for o in result.objects)
        facts = [
            component.span_text,
            f"{component.registered_frames} of {component.frames} frames",
            f"{objects} object" if objects == 1 else f"{objects} objects",
        ]
        if component.scale:
            facts.append(f"scale {_scale_text(component.scale)}")
        lines += wrapped(f"component {k}: " + "; ".join(facts))
    return lines


def _scale_text(scale: quadrics.Scale) -> str:
    sigma = f"{100 * (scale.rel_sigma or 0):.0f} %"
    return f"{scale.value} m per unit, sigma {sigma} (from {scale.source})"
