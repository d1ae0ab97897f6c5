"""Keyframes of a shot's first pass: what is kept of one, when the next is due, which earlier ones it is linked to.

Their refinement when the shot has ended is keyframe_graph.py's business.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.records import Lens
from mosaic.records import PairFit, PairStatus
from mosaic.template import PreparedTemplate, Template, prepare
from pipelines.bridge import CameraPose, RotationZoomFamily
from pipelines.chain import Chain, centre_motion
from pipelines.config import RegistrationOptions
from pipelines.keyframe_graph import distance_in_widths

FLASH_LOG_GAIN = 0.25  # of a pair of neighbours or of a keyframe: more is a flash, or an exposure on its way
FADING_SCORE = 0.5  # of a good link to the keyframe: the next one may be doubtful (score_ok is .6)
# Of what a keyframe saw, share that is still to be seen: where people are masked, less than its distance says.
FADING_OVERLAP = 0.5
WEAK_CHAIN = 5  # frames without a direct link to the keyframe before a new keyframe is taken
SAME_VIEW = 0.6  # of registration.keyframe_shift: as near as that a known keyframe does instead of a new one
MAX_LINKS = 6  # earlier keyframes that a new one is registered to: nearest and farthest by predicted overlap


@dataclass(slots=True, eq=False)
class Keyframe:
    """A frame that others are registered to: its template, and a small picture for a rescue."""

    frame: int
    template: Template
    small: NDArray[np.uint8]
    prepared: PreparedTemplate | None = None
    prepared_for: tuple[float, Lens] | None = None

    def bind(self, log_f: float, lens: Lens) -> PreparedTemplate:
        """The template bound to the rotation + zoom family of this focal and lens; kept while they do not change."""
        if self.prepared is None or self.prepared_for is None or self.prepared_for != (log_f, lens):
            self.prepared = prepare(self.template, RotationZoomFamily(lens=lens, log_f_src=log_f))
            self.prepared_for = (log_f, lens)
        return self.prepared


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeyframePolicy:
    """When a shot takes a keyframe, and what it is linked to. size_px: of the frames."""

    size_px: tuple[int, int]
    options: RegistrationOptions

    def is_due(self, chain: Chain, direct: PairFit | None, fits: Sequence[PairFit], n_keyframes: int) -> bool:
        """Whether the newest frame is far enough from the current keyframe.

        chain: between the two; direct: their pair, if there is one; fits: the frame's usable pairs; n_keyframes: of
        the shot so far. The first few come sooner: a short pan must not end with one. A doubtful frame (flash, blur,
        a crowd of players) waits for a better one, up to twice the distance; where a link to the keyframe will soon
        be doubtful, as players cover what it saw, the last good one is taken.
        """
        fit = direct if direct is not None and direct.status == PairStatus.OK else None
        if fit is not None and (fit.score > FADING_SCORE or fit.overlap < FADING_OVERLAP):
            return True
        moved_px, zoom = centre_motion(chain.H_frame_keyframe, self.size_px)
        share = min(1.0, n_keyframes / 3.0)
        if any(f.status != PairStatus.OK or abs(np.log(f.gain)) > FLASH_LOG_GAIN for f in fits):
            share *= 2.0
        return bool(
            chain.n_composed >= WEAK_CHAIN
            or moved_px > share * self.options.keyframe_shift * self.size_px[0]
            or abs(np.log(zoom)) > share * np.log(self.options.keyframe_zoom)
        )

    def nearest(self, pose: CameraPose, others: Mapping[int, CameraPose]) -> list[tuple[float, int]]:
        """(distance_in_widths to pose, keyframe), nearest first."""
        width = self.size_px[0]
        return sorted((distance_in_widths(other, pose, width), frame) for frame, other in others.items())

    def same_view(self, near: Sequence[tuple[float, int]], current: int) -> list[int]:
        """Of the two nearest keyframes, those that could be gone back to. near: as `nearest` gives it."""
        limit = SAME_VIEW * self.options.keyframe_shift
        return [frame for distance, frame in near[:2] if frame != current and distance <= limit]

    def to_link(self, near: Iterable[tuple[float, int]], current: int) -> list[int]:
        """Keyframes that a new one is registered to beside the current: near ones hold, far ones measure the focal."""
        limit = 1 - self.options.min_overlap
        seen = [frame for distance, frame in near if distance < limit and frame != current]
        if len(seen) <= MAX_LINKS:
            return seen
        return seen[: MAX_LINKS // 2] + seen[-(MAX_LINKS - MAX_LINKS // 2) :]
