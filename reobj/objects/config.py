"""Options of the object stage, and the fit function that they define."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Sequence
from dataclasses import dataclass

import quadrics
from reobj.cameras import Poses
from reobj.objects.frames import FrameOptions
from reobj.objects.observations import Fit, Scene, Views
from reobj.types import ReobjError, option
from reobj.words import load_size_priors, parse_known_size, parse_up


class Solver(enum.StrEnum):
    """What fits the ellipsoids: `quadrics.fit_objects`, or a published closed-form solver."""

    SOLIDS = "solids"
    LFD = "lfd"
    SFMO = "sfmo"
    PSFMO = "psfmo"


@dataclass(frozen=True, slots=True)
class ObjectsConfig:
    """Fit one shape and its ellipsoid to every object, from tracks and cameras."""

    priors: str = option("", "size priors, JSON (default: the bundled priors.json)", "--priors")
    prior: str = option(
        "",
        "usual size (width x depth x height) of objects of a word, 'mixer=.2x.3x.4m', or the "
        "category that they are like, 'red toolbox=suitcase'; may be repeated",
        "--prior",
        repeated=True,
    )
    known_size: str = option(
        "", "true heights that set the metric scale: 'chair=.82m,door=2m'", "--known-size"
    )
    support: str = option(
        "auto",
        "kind of shape: box, cylinder, ellipsoid, or auto (from the category, else model "
        "selection); old flag: --support",
        "--shape",
        "--support",
    )
    solver: str = option(
        Solver.SOLIDS.value,
        "solids (default), or a published closed-form solver: lfd, sfmo, psfmo",
        "--solver",
    )
    up: str = option("", "direction against gravity in the world, x,y,z (default: estimated)")
    link: bool = option(True, "join and split the tracks after the video")
    min_views: int = option(3, "an object seen in fewer frames with a pose gets no ellipsoid")
    moving: str = option(
        "person,bird,cat,dog,horse,sheep,cow,elephant,bear,zebra,giraffe",
        "classes that move, comma-separated: tracked, but without an ellipsoid",
    )

    @property
    def moving_classes(self) -> tuple[str, ...]:
        """Names in `moving`."""
        return tuple(filter(None, (name.strip() for name in self.moving.split(","))))

    def size_priors(self) -> quadrics.Priors:
        """Load the size priors, with those of `prior`."""
        return load_size_priors(self.priors, self.prior)


def make_fit(config: ObjectsConfig, poses: Poses, class_names: Sequence[str]) -> Fit:
    """Bind priors, known sizes, gravity and the kind of shape to `quadrics.fit_objects`.

    Raises:
        ReobjError, QuadricsError: an option is invalid, or the priors file cannot be read.
    """
    priors = config.size_priors()
    known_size = parse_known_size(config.known_size)
    if config.solver not in list(Solver):
        default, *published = Solver
        expected = f"{default} or {', '.join(published)}"
        raise ReobjError(f"--solver {config.solver}: expected {expected}")
    up = parse_up(config.up) if config.up else poses.up_in_world
    support = None if config.support == "auto" else config.support
    given = by_depth = None
    if poses.scale is not None and poses.metric and not poses.map_id:
        by_depth = quadrics.Scale(*poses.scale, "depth_maps")
    elif poses.scale is not None:
        given = quadrics.Scale(*poses.scale, "map")
    plain = quadrics.FitConfig(path_where_seen=int(poses.known.sum()) > FrameOptions().all_of)

    def fit(views: Views, classes: list[int], scene: Scene) -> quadrics.ObjectFits:
        names = [class_names[c] if c < len(class_names) else "" for c in classes]
        scale = scene.scale or given
        fits = quadrics.fit_objects(
            views.boxes, views.img_from_world, views.image_size, names, priors,
            up=scene.up if up is None else up, support=support, score=views.score,
            hidden=views.occluded, metric=poses.metric if scale is None else scale,
            known_size=known_size, floor=scene.floor, points=views.points,
            config=dataclasses.replace(plain, wrong_class=0) if scene.trusts_classes else plain,
        )  # fmt: skip
        if by_depth is not None and fits.scale.source == "poses":
            fits = dataclasses.replace(fits, scale=by_depth)
        up_is_given = up is not None or scene.up is None
        return fits if up_is_given else dataclasses.replace(fits, up_source="floor")

    return fit
