"""When people fill the picture: whether a pair of neighbours can be believed, and masks of the scene, frame by frame.

A pair that does not convince is looked at once more for a scene between the people (mosaic/crowd.py). From there on
each frame has a mask of its own, made from the pair with the frame before, until little moves any more.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mosaic.crowd import WEAK_GREY, SceneFound, ScenePair, find_scene, settle_scene
from mosaic.pyramid import Pyramid, with_scene
from mosaic.records import PairFit, PairStatus
from mosaic.template import SelectionOptions, build_template
from pipelines.preparation import PreparedFrame, finest_of

# Of pairs of neighbours with players on 10 % of the picture 5 in 750 score more than .3 (at the start of a shot,
# through no lens); with 40 % and hoardings that run 109 of 125 such pairs are off by over half a pixel, 17 of 79 below.
UNSURE_SCORE = 0.3
# Share of a picture that moves from which it is masked; below it, for so many frames, no masks are made any more.
MUCH, LITTLE_FRAMES = 0.35, 12
# How much larger the errors of pairs between people are than stated: few pixels, and some of them people's (cells of
# pairs of two clips with 40 % players: at the median 1.0 and 1.1 times, at most 2.4).
LESS_SURE = 2.0
# In pictures 640 and 960 px wide grass between people says too little: pairs are off by more than .5 px, and zoom
# ratios by one per cent and more. There such shots are refused, or lost, as without this.
LEAST_WIDTH_PX = 1200
MOST_WAIT = 25  # frames after looks in vain
LOOK_EVERY = 10  # frames, while masks are made: a second of a processor each


@dataclass(slots=True, eq=False)
class CrowdWatch:
    """The state within a shot. scene: of frames, bits of a mask at a quarter of the size, while masks are made."""

    selection: SelectionOptions
    masked: bool = False
    n_looks: int = 0
    _scene: dict[int, tuple[NDArray[np.uint8], tuple[int, ...]]] = field(default_factory=dict)
    _plain: PreparedFrame | None = None  # the frame before as it came, without a mask made here
    _weak: set[int] = field(default_factory=set)  # frames of which weak pixels are used
    _quiet: int = 0
    _since: int = 0  # frames since the last look
    _wait: int = 0
    _next_wait: int = 1

    def scene_between(self, previous: PreparedFrame, look: PreparedFrame, step: PairFit) -> SceneFound | None:
        """The pair of neighbours by the scene between people; None: `step`, as it was registered, convinces.

        While masks are made each pair is settled under them. It is looked at without them, which may be wrong, where
        that does not convince, and every LOOK_EVERY frames: what leaves more of the picture to the scene is right."""
        if look.pyramid.size_px[0] < LEAST_WIDTH_PX:
            return None
        sure = step.usable and step.status == PairStatus.OK and step.score <= UNSURE_SCORE
        plain = self._as_it_came(previous).pyramid
        if not self.masked:
            return None if sure else self._find(plain, look.pyramid, step)
        followed = (
            settle_scene(plain, look.pyramid, step, self.scene(previous.frame)) if step.usable else None
        )
        self._since += 1
        if followed is not None and sure and self._since < LOOK_EVERY:
            return followed
        found = self._find(plain, look.pyramid, step)
        if found is None or (followed is not None and followed.share >= found.share):
            return followed
        return found

    def _find(self, source: Pyramid, target: Pyramid, step: PairFit) -> SceneFound | None:
        if self._wait > 0:
            self._wait -= 1
            return None
        self._since = 0
        self.n_looks += 1
        found = find_scene(source, target, step.H_dst_src if step.usable else None)
        if found is not None and not self.masked and 1 - found.share < MUCH:
            found = None  # something else is wrong with the pair than people
        if found is None:
            self._wait, self._next_wait = self._next_wait, min(2 * self._next_wait, MOST_WAIT)
        else:
            self._next_wait = 1
        return found

    def without_people(
        self, previous: PreparedFrame, look: PreparedFrame, pair: ScenePair
    ) -> tuple[PreparedFrame, PreparedFrame]:
        """Both frames masked by what a pair says of them."""
        return self._masked(self._as_it_came(previous), pair.source), self._masked(look, pair.target)

    def accept(self, look: PreparedFrame, plain: PreparedFrame) -> None:
        """The mask of this frame was used: masks go on from it. plain: the frame as it came."""
        assert look.scene is not None
        self.masked, self._plain = True, plain
        self._scene[look.frame] = np.packbits(look.scene), look.scene.shape
        self._quiet = self._quiet + 1 if 1 - look.scene.mean() < MUCH else 0
        if self._quiet >= LITTLE_FRAMES:
            self.masked, self._quiet = False, 0

    @property
    def frames(self) -> tuple[int, ...]:
        """Frames that have a mask."""
        return tuple(self._scene)

    def cut_back(self, last: int) -> None:
        """Forget frames after `last`."""
        self._scene = {k: scene for k, scene in self._scene.items() if k <= last}

    def scene(self, frame: int) -> NDArray[np.uint8] | None:
        """(h, w) at a quarter of the size, 1 = scene; None: no mask was made."""
        if frame not in self._scene:
            return None
        bits, shape = self._scene[frame]
        return np.unpackbits(bits, count=int(np.prod(shape))).reshape(shape)

    def selection_for(self, look: PreparedFrame) -> SelectionOptions:
        """Which pixels stand for a frame: weak ones too where most of the strong ones were masked here."""
        return (
            replace(self.selection, threshold_grey=WEAK_GREY) if look.frame in self._weak else self.selection
        )

    def _as_it_came(self, look: PreparedFrame) -> PreparedFrame:
        return self._plain if self._plain is not None and self._plain.frame == look.frame else look

    def _masked(self, look: PreparedFrame, scene: NDArray[np.uint8]) -> PreparedFrame:
        pyramid = with_scene(look.pyramid, scene)
        levels = tuple(range(finest_of(pyramid.size_px), len(pyramid.levels)))
        masked = replace(look, scene=scene if look.scene is None else np.minimum(scene, look.scene))
        if 1 - scene.mean() >= MUCH:
            self._weak.add(look.frame)
        options = self.selection_for(masked)
        return replace(
            masked,
            pyramid=pyramid,
            template=build_template(pyramid, look.frame, options=options, levels=levels),
        )


def doubted(fit: PairFit) -> PairFit:
    """A pair whose stated errors are LESS_SURE times as large."""
    less = LESS_SURE**-2
    return replace(fit, info=fit.info * less, flow=replace(fit.flow, info=fit.flow.info * less))
