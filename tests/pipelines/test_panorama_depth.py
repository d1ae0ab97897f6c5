"""A clip of 10 bits through the main job: its panorama.tif has 16, and everything that reads it gets its 8."""

from __future__ import annotations

from fractions import Fraction

import av
import numpy as np
import pytest
import tifffile

from pipelines.config import Config
from pipelines.render.plate import read_plate
from pipelines.run import process
from pipelines.serve.tiles import Tiles
from tests.pipelines.end_to_end import pan_spec
from tests.synth.clip import SynthClip

N_FRAMES = 24


def write_deep_clip(path, clip):
    """The frames of a generator clip in 10 bits: a ramp of less than a grey level from left to right is added."""
    width, height = clip.spec.width, clip.spec.height
    slope = np.linspace(0, 257, width)[None, :, None]
    with av.open(str(path), "w") as container:
        stream = container.add_stream(
            "libx264", rate=Fraction(25), options={"crf": "4", "preset": "veryfast"}
        )
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv444p10le"
        for i in range(N_FRAMES):
            deep = np.clip(clip.frame(i).image * 257.0 + slope, 0, 65535).astype(np.uint16)
            frame = av.VideoFrame.from_ndarray(deep, format="rgb48le").reformat(format="yuv444p10le")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


@pytest.mark.slow
def test_ten_bits_in_sixteen_out(tmp_path):
    clip = SynthClip(pan_spec(n_frames=N_FRAMES, pan_deg=4.0, scoreboard=False, logo=False))
    write_deep_clip(tmp_path / "deep.mkv", clip)
    process(
        tmp_path / "deep.mkv", tmp_path / "out", Config.model_validate({"panorama": {"max_megapixels": 0.5}})
    )
    path = tmp_path / "out" / "shot-000" / "panorama.tif"
    rgba = tifffile.imread(path)
    assert rgba.dtype == np.uint16 and set(np.unique(rgba[..., 3])) <= {0, 65535}
    seen = rgba[rgba[..., 3] > 0][:, :3]
    # Whole grey levels would all be multiples of 257; the mean of 10-bit views is anything.
    assert len(np.unique(seen % 257)) > 200
    plate = read_plate(path)
    assert plate.levels[0].dtype == np.uint8
    assert np.abs(plate.levels[0].astype(float) - rgba / 257).max() <= 0.51
    tiles = Tiles(path)
    assert tiles.jpeg(0, 0, 0)[:2] == b"\xff\xd8"
    tiles.close()
