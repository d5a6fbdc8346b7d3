"""The table of the objects of a result, for CSV and pandas."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from reobj.results.upright import component_of, upright_pose
from reobj.types import Array, ReobjError

if TYPE_CHECKING:
    from reobj.results.result import Result


def object_table(result: Result) -> tuple[list[str], list[list[Any]]]:
    """Return the names of the columns, and a row for each object.

    Lengths are in world units, `_m` in metres; None where unknown. `center_m` and `yaw_deg` are in
    an upright frame (`upright_pose`).
    """
    head = ["id", "class", "status", "reason", "score", "confidence", "support"]
    vectors = ("center", "size", "size_m", "size_rel_sigma")
    head += [f"{name}_{axis}" for name in vectors for axis in "xyz"]
    head += ["qw", "qx", "qy", "qz", "views", "frames_seen", "visits", "part"]
    head += ["center_m_x", "center_m_y", "center_m_z", "yaw_deg"]
    rows = list[list[Any]]()
    for o in result.objects:
        row = [o.id, o.class_name, o.status, o.reason, o.score, o.confidence, o.support]
        for name in vectors:
            row += _numbers(getattr(o, name), 3)
        row += [*_numbers(o.quat_wxyz, 4), o.views, o.frames_seen, len(o.visits), o.part]
        pose = upright_pose(o, component_of(o, result.world))
        rows.append([*row, *(pose["center_m"] or [None] * 3), pose["yaw_deg"]])
    return head, rows


def _numbers(values: Array | None, count: int) -> list[float | None]:
    return [None] * count if values is None else values.tolist()


def to_pandas(result: Result) -> Any:
    """Return the objects as a pandas DataFrame, with the columns of `export --to csv`."""
    try:
        import pandas
    except ImportError as error:
        raise ReobjError("to_pandas needs pandas: pip install pandas") from error
    head, rows = object_table(result)
    return pandas.DataFrame(rows, columns=head).set_index("id")
