"""Progressive or interlaced, and which field comes first, judged by the pictures: flags of files are often wrong.

A line of one field is compared with the two lines of the other field around it (FFmpeg's idet does so): fields that are
neighbours in time fit better than fields three apart. A scene at rest tells nothing, and then nothing is claimed.
Film in 60i (3:2 pull-down) shows as one or two interlaced frames in every five, always at the same places.
A clip may open with a title that is progressive or at rest: then it is looked at further on.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import islice

import numpy as np
from numpy.typing import NDArray

LOOK = 24  # pictures: a second; the camera of a match hardly rests for longer
STEP = 2  # every second column is enough
ORDER_RATIO = (
    1.2  # misfit three fields apart over misfit one apart; 1.5 to 3 on slow pans, 1.00 to 1.05 at rest
)
COMB_RATIO = (
    0.75  # misfit inside a frame over misfit to the neighbour frame: about 1 interlaced, below .5 progressive
)
MIN_MISFIT = 1.0  # grey levels between neighbour pictures, below it the scene rests
MIN_VOTES = 4
LOOKS = 10  # at consecutive seconds, before other places of the clip are tried
CYCLE = 5  # frames of a pull-down cycle
PULLDOWNS = ((0, 1), (0,))  # interlaced frames of a cycle, from the first: 2:3, and 2:3:3:2 ("advanced")


def judge_scan(lumas: Iterable[NDArray[np.float32]]) -> str:
    """'tff', 'bff' or 'progressive' if at least four pictures say so and hardly any other; 'telecine_tff' or
    'telecine_bff' if interlaced and progressive ones alternate as pull-down has them; else 'unknown'.

    lumas: (h, w // STEP) grey 0..255 of consecutive frames, at most LOOK of them are used.
    """
    told: list[str] = []
    before: NDArray[np.float32] | None = None
    here: NDArray[np.float32] | None = None
    for following in islice(lumas, LOOK):
        if before is not None and here is not None:
            told.append(_vote(before, here, following))
        before, here = here, following
    if pulled := _pulldown(told):
        return pulled
    votes = Counter(told)
    del votes["unknown"]
    if not votes:
        return "unknown"
    winner, n = votes.most_common(1)[0]
    return winner if n >= MIN_VOTES and n >= 0.8 * votes.total() else "unknown"


def judge_opening(lumas: Iterator[NDArray[np.float32]]) -> str:
    """judge_scan of the first of LOOKS consecutive looks that shows fields, else 'unknown'."""
    return next((seen for _ in range(LOOKS) if shows_fields(seen := judge_scan(lumas))), "unknown")


def shows_fields(seen: str) -> bool:
    """Whether a judgement is of interlaced frames, with or without pull-down."""
    return seen not in ("unknown", "progressive")


def _pulldown(told: list[str]) -> str:
    """'telecine_tff' or 'telecine_bff' where the votes of consecutive frames repeat every five as pull-down does."""
    for order in ("tff", "bff"):
        for places in PULLDOWNS:
            for phase in range(CYCLE):
                combed = [vote for i, vote in enumerate(told) if (i - phase) % CYCLE in places]
                whole = [vote for i, vote in enumerate(told) if (i - phase) % CYCLE not in places]
                yes = combed.count(order), whole.count("progressive")
                known = sum(vote != "unknown" for vote in told)
                if yes[0] >= MIN_VOTES - 1 and yes[1] >= MIN_VOTES and sum(yes) >= 0.9 * known:
                    return f"telecine_{order}"
    return ""


def _vote(before: NDArray[np.float32], here: NDArray[np.float32], following: NDArray[np.float32]) -> str:
    if (
        before.shape != here.shape
        or here.shape != following.shape
        or min(here.shape[0] - 3, here.shape[1]) < 1
    ):
        return "unknown"  # a line of each field needs one above and one below it
    around = here[:-2] + here[2:]

    def misfit(other: NDArray[np.float32], first_row: int) -> float:
        return float(np.abs(around[first_row::2] - 2 * other[1:-1][first_row::2]).mean()) / 2

    # Row 0 of `around` belongs to line 1: its even rows are lines of the bottom field.
    if_top_first = misfit(before, 0) + misfit(following, 1)
    if_bottom_first = misfit(before, 1) + misfit(following, 0)
    inside = misfit(here, 0) + misfit(here, 1)
    near = min(if_top_first, if_bottom_first)
    if near - inside > COMB_RATIO * MIN_MISFIT and inside < COMB_RATIO * near:
        return "progressive"
    if max(if_top_first, if_bottom_first) - near < MIN_MISFIT or inside < COMB_RATIO * near:
        return "unknown"
    if if_top_first * ORDER_RATIO < if_bottom_first:
        return "tff"
    return "bff" if if_bottom_first * ORDER_RATIO < if_top_first else "unknown"
