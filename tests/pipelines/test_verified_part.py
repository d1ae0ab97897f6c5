"""Which part of a shot is solved alone: pairs of made-up status, no pictures."""

from __future__ import annotations

from itertools import pairwise
from typing import cast

import numpy as np
import pytest

from mosaic.records import PairFit, PairStatus
from pipelines.verified_part import largest_verified, part_to_solve_alone

FRAMES = list(range(100))
KEYFRAMES = [0, 20, 40, 60, 80]


class Pair:
    """What the search reads of a PairFit."""

    def __init__(self, src: int, dst: int, status: PairStatus = PairStatus.OK, route: str = "predicted"):
        self.src, self.dst, self.status, self.route = src, dst, status, route


def _keyed(broken: int, status: PairStatus, route: str = "predicted") -> list[PairFit]:
    """Every frame to its keyframe and keyframe to keyframe, verified but what joins keyframe `broken`."""
    pairs = [Pair(k, f) for k in KEYFRAMES for f in range(k + 1, k + 20)]
    for a, b in pairwise(KEYFRAMES):
        pairs.append(Pair(a, b, status, route) if b == broken else Pair(a, b))
    return cast("list[PairFit]", pairs)


@pytest.mark.parametrize(
    "status, route",
    [(PairStatus.WEAK, "predicted"), (PairStatus.FAILED, "predicted"), (PairStatus.OK, "composed")],
)
def test_the_larger_part_is_found_on_either_side_of_a_doubtful_link(status, route):
    assert largest_verified(FRAMES, _keyed(60, status, route)) == set(range(60))
    assert largest_verified(FRAMES, _keyed(40, status, route)) == set(range(40, 100))


def test_a_reference_in_the_smaller_part_gives_way():
    alone = part_to_solve_alone(FRAMES, KEYFRAMES, _keyed(60, PairStatus.WEAK), reference=80)
    assert alone == {0, 20, 40}


def test_a_shot_that_hangs_together_is_solved_whole():
    assert part_to_solve_alone(FRAMES, KEYFRAMES, _keyed(-1, PairStatus.OK), reference=80) is None
    # a tail of a fifth that hangs on a doubtful link is no reason either
    assert part_to_solve_alone(FRAMES, KEYFRAMES, _keyed(80, PairStatus.WEAK), reference=0) is None


def test_one_keyframe_alone_is_no_calibration():
    nothing = cast("list[PairFit]", [Pair(0, f) for f in range(1, 20)])
    assert part_to_solve_alone(FRAMES, KEYFRAMES, nothing, reference=80) is None


def test_frames_without_pairs_make_no_part():
    lonely = np.array(FRAMES)
    assert len(largest_verified(lonely.tolist(), [])) == 1
