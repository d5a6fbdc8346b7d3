"""Progress of linking and fitting."""

from __future__ import annotations

import dataclasses

import pytest
from simulated import unlinked, walk

import reobj_track as rt
from reobj.files import Progress
from reobj.objects.fit import link_and_fit
from reobj.objects.phases import PhasesOfFit


class Line(Progress):
    """A progress line that notes the steps done after each call."""

    def __init__(self) -> None:
        super().__init__("objects", PhasesOfFit.TOTAL, counted=False)
        self.shown_steps: list[int] = []

    def step(self, n: int = 1) -> None:
        assert n >= 0
        super().step(n)
        self.shown_steps.append(self.done)


@pytest.mark.parametrize("case", ["two components", "one", "no camera", "not linked"])
def test_progress_only_grows_and_ends_before_the_gaps_are_filled(case: str) -> None:
    result = unlinked(walk()) if case == "one" else unlinked()
    if case == "no camera":
        result = dataclasses.replace(result, poses=None)
    line = Line()
    phases = PhasesOfFit(line, result.poses)
    config = rt.ObjectsConfig(link=case != "not linked")
    found = link_and_fit(result, config, phases)
    assert line.shown_steps == sorted(line.shown_steps)
    assert 300 < line.shown_steps[-1] < PhasesOfFit.TOTAL
    if case in ("one", "two components"):  # phases are visible one by one
        assert len(set(line.shown_steps)) >= 8 and line.shown_steps[-1] > 800
    plain = link_and_fit(result, config)
    assert [o.to_json() for o in found.objects] == [o.to_json() for o in plain.objects]
