"""Size priors of categories, in units of the world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

import quadrics
from reobj.objects.likelihood import Shapes
from reobj.types import Array, BoolArray, IntArray

SIZE_SIGMAS = 6.0  # limit on the deviation of a size (chosen: a class may be wrong)


def name_of(class_names: Sequence[str], class_id: int) -> str:
    """Return the name of a class, "object" if it has none."""
    return class_names[class_id] if 0 <= class_id < len(class_names) else "object"


def on_floor(priors: quadrics.Priors, names: list[str]) -> BoolArray:
    """Mark the categories (G,) that stand on the floor."""
    return np.asarray(_with_unknown(priors.on_floor, False)[priors.index(names)], bool)


@dataclass(frozen=True, slots=True)
class Categories:
    """Size priors of the classes of a detector, in units of the world.

    Attributes:
        names: of the classes, and "" at the end. scale: metres per unit.
    """

    priors: quadrics.Priors
    names: npt.NDArray[np.str_]
    scale: quadrics.Scale

    def rows(self, classes: IntArray) -> IntArray:
        """Return the rows (G,) of classes in the priors, -1 unknown."""
        return self.priors.index(self._names_of(classes))

    def usual_size(self, classes: IntArray) -> Array:
        """Return width, depth and height (G, 3)."""
        unknown = np.log(quadrics.UNKNOWN_SIZE.mean_m)
        log_size = _with_unknown(self.priors.log_mean, unknown)[self.rows(classes)]
        return np.asarray(np.exp(log_size) / self.scale.value)

    def on_floor(self, classes: IntArray) -> BoolArray:
        """Mark the classes (G,) that stand on the floor."""
        return on_floor(self.priors, self._names_of(classes))

    def size_log_odds(self, shapes: Shapes) -> Array:
        """Return the log odds (O,) of the sizes, 0 at the usual size, rotated by 90 deg or not."""
        rows = self.rows(shapes.class_id)
        no_scale = quadrics.UNKNOWN_SCALE_LOG
        sigma = no_scale if self.scale.source == "none" else self.scale.rel_sigma
        unknown = no_scale**2 * np.eye(3)
        cov = _with_unknown(self.priors.log_cov, unknown)[rows] + sigma**2
        size = np.log(2 * shapes.ellipsoids.half_axes)
        off = size[:, [[0, 1, 2], [1, 0, 2]]] - np.log(self.usual_size(shapes.class_id))[:, None]
        square = np.einsum("ski,sij,skj->sk", off, np.linalg.inv(cov), off).min(1)  # (O,)
        return np.asarray(-0.5 * np.nan_to_num(square, nan=np.inf).clip(max=SIZE_SIGMAS**2))

    def _names_of(self, classes: IntArray) -> list[str]:
        names: list[str] = self.names[classes.clip(-1, len(self.names) - 1)].tolist()
        return names


def _with_unknown(column: npt.NDArray[Any], unknown: Any) -> npt.NDArray[Any]:
    """Append the row of categories without priors (index -1) to a column of the priors."""
    return np.concatenate([column, np.broadcast_to(unknown, (1, *column.shape[1:]))])
