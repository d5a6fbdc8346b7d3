"""Progress of linking and fitting: phases of known order, weighted by the time that they take."""

from __future__ import annotations

from collections.abc import Callable

from reobj.cameras import Poses
from reobj.files import Progress

Reach = Callable[[str, float], None]  # phase, done fraction of it: reports progress


def ignore(phase: str, fraction: float = 1.0) -> None:
    """Report nothing."""


def _seconds(frames: int) -> dict[str, dict[str, float]]:
    """Estimate the seconds of the phases of a component from the number of its posed frames.

    Measured on videos of 100 to 18,000 frames; only the ratios count. Of more than 600 frames most
    phases use those that are informative, 600 if the camera returns. The rounds are the least
    certain: 1 to 10 are needed, in .8 to 8 s.
    """
    n = frames / 600
    used = min(n, 1.0)
    posed = float(frames > 0)  # else the tracks are only linked
    return {
        "link": {
            "first fit": 0.5 * posed + 0.8 * used + 0.2 * n,
            "hypotheses": 2.5 * used,
            "rounds": 3.0 * posed,
            "assign": 0.2 * n,
            "link": 0.1 + 0.5 * n,
        },
        "fit": {
            "occlusion": 0.2 * posed + 2 * used + 0.1 * n,
            "fit": 1.5 * posed,
            "describe": 0.4,
        },
    }


class PhasesOfFit:
    """Show the progress of linking and fitting all components of the trajectory.

    Phases that are left out, and rounds that are not needed, are passed over.

    Args:
        line: of `TOTAL` steps. poses: of the video.
    """

    TOTAL = 1000

    def __init__(self, line: Progress, poses: Poses | None) -> None:
        count = 1 if poses is None else poses.part_count
        frames = [0 if poses is None else int(poses.of_part(k).known.sum()) for k in range(count)]
        costs = [_seconds(n) for n in frames]
        phases = {
            (k, name): seconds
            for group in ("link", "fit")
            for k in range(count)
            for name, seconds in costs[k][group].items()
        }
        whole = sum(phases.values()) + 1.0  # gaps are filled at the end
        self._line = line
        self._start: dict[tuple[int, str], float] = {}
        self._share = {key: seconds / whole for key, seconds in phases.items()}
        before = 0.0
        for key, share in self._share.items():
            self._start[key] = before
            before += share

    def of(self, component: int) -> Reach:
        """Return the function that reports the progress of a component."""

        def reach(phase: str, fraction: float = 1.0) -> None:
            key = component, phase
            done = int(self.TOTAL * (self._start[key] + fraction * self._share[key]))
            self._line.step(max(done - self._line.done, 0))

        return reach
