"""Report of a result for the terminal: the table of objects, counts, cameras, times and files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

import quadrics
from reobj.files import cut, texts_with_sigma, wrapped
from reobj.results.entries import Object, found_text

if TYPE_CHECKING:
    from reobj.results.result import Result

COLUMNS = 80  # of the terminal
LEAST_NAME = 14  # characters of a class
MOST_NAME = 20
SIZE_WORDS = {"ok": "measured", "prior_dominated": "guessed", "rejected": "none"}


def summary(result: Result) -> str:
    """Write the report that `run` prints: what was found, where to look, and the table."""
    counted = [o for o in result.objects if o.counted]
    lines = _counts(result, counted)
    lines += _implausible(result)
    if result.links is not None and (changed := result.links.changed):
        total = len(result.links.before)
        text = f"linked again: {changed} of {total} identities have other boxes than before"
        lines += _wrapped(text)
    if result.changes is not None:
        lines += _wrapped(result.changes.summary())
    if result.out is not None:
        names = ("scene.html", "overlay.mp4", "objects.json")
        files = [result.out / name for name in names]
        lines.append("look at: " + ", ".join(str(file) for file in files if file.exists()))
    if counted:
        lines += ["", *_table(result, counted), *_reasons(counted)]
    if any(o.size_rel_sigma is not None for o in counted):
        lines.append("sigma: standard deviation of the least certain side")
    lines += ["", *_cameras(result)]
    lines.append("seconds: " + ", ".join(_stage_time(result, s) for s in result.seconds))
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
    """Format a header and a line for each object; sizes only if there are any.

    Objects of several components are grouped by component, each below a line with its name. Those
    without a shape come last.
    """
    in_metres = any(o.size_m is not None for o in result.objects)
    has_sizes = any(o.size is not None for o in counted)
    several = len(result.world.parts) > 1
    unit = "m" if in_metres else "units"
    width = max([LEAST_NAME, *(min(len(o.class_name), MOST_NAME) for o in counted)])
    columns = f"{'object':>6}  {'class':<{width}} {'frames':>6}"
    if has_sizes:
        columns += f"  {f'width x depth x height, {unit}':<26} {'sigma':>6}  size"
    lines = [columns]
    component = None
    for o in sorted(counted, key=lambda o: (o.part, not o.located)):
        if several and o.part != component:
            component = o.part
            lines.append(f"component {component}")
        line = f"{o.id:>6}  {cut(o.class_name, MOST_NAME):<{width}} {o.frames_seen:>6}"
        if has_sizes:
            line += _size_columns(o, in_metres) + SIZE_WORDS.get(o.status, o.status)
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
    return f"  {size:<26} {sigma:>6}  "


def _reasons(counted: Sequence[Object]) -> list[str]:
    """Format each reason once, with the objects that have it."""
    objects_of: dict[str, list[int]] = {}
    for o in counted:
        for reason in filter(None, o.reason.split("; ")):
            objects_of.setdefault(reason, []).append(o.id)
    lines = list[str]()
    for reason, ids in objects_of.items():
        noun = "object" if len(ids) == 1 else "objects"
        lines += _wrapped(f"{reason}: {noun} {', '.join(map(str, ids))}")
    return lines


def _implausible(result: Result) -> list[str]:
    """List the objects that are not counted because of their size, with the reason of each."""
    odd = [o for o in result.objects if o.status == "implausible"]
    texts = [f"{o.class_name} {o.id} ({o.reason})" for o in odd]
    return _wrapped(f"implausible, not counted: {', '.join(texts)}") if texts else []


def _counts(result: Result, counted: Sequence[Object]) -> list[str]:
    """Format the number of objects with and without a shape, in all and of each class."""
    text = found_text(result.objects, names=True) if counted else "objects: none"
    if len(result.world.parts) > 1:
        text += " (each component counted separately)"
    if doubtful := sum(o.status == "doubtful" for o in result.objects):
        text += f"; {doubtful} more of low confidence, probably false positives (objects.json)"
    return _wrapped(text)


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
        facts = [
            component.span_text,
            f"{component.registered_frames} of {component.frames} frames",
            found_text(o for o in result.objects if o.part == k),
        ]
        if component.scale:
            facts.append(f"scale {_scale_text(component.scale)}")
        lines += _wrapped(f"component {k}: " + "; ".join(facts))
    return lines


def _scale_text(scale: quadrics.Scale) -> str:
    sigma = scale.rel_sigma or 0.0
    ((value, *_),) = texts_with_sigma(np.array([scale.value]), np.array([sigma * scale.value]))
    return f"{value} m per unit, sigma {100 * sigma:.0f} % (from {scale.source.replace('_', ' ')})"


def _wrapped(text: str) -> list[str]:
    return wrapped(text, COLUMNS)
