"""assets/sample.mp4 and its truth are what tests.synth.sample makes today."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from tests.synth.clip import SynthClip, read_truth
from tests.synth.paths import CameraPath
from tests.synth.presets import preset
from tests.synth.sample import SAMPLE_SEED

ASSETS = Path(__file__).parents[2] / "assets"
SPEC = preset("sample", seed=SAMPLE_SEED)


def test_sample_truth_is_the_presets_path() -> None:
    truth = read_truth(ASSETS / "sample-truth.csv")
    path = CameraPath(
        spec=SPEC.path,
        lens=SPEC.lens,
        width=SPEC.width,
        height=SPEC.height,
        n_frames=SPEC.n_frames,
        seed=SPEC.seed,
    )
    expected = [
        (c.f_px, *np.rad2deg((c.pan_rad, c.tilt_rad, c.roll_rad)), c.cx_px, c.cy_px, c.k1_opencv)
        for c in path.cameras()
    ]
    columns = ("f_px", "pan_deg", "tilt_deg", "roll_deg", "cx_px", "cy_px", "k1")
    assert np.allclose(np.stack([truth[c] for c in columns], -1), expected, rtol=1e-8, atol=1e-8)


def test_sample_file_is_as_described() -> None:
    assert (ASSETS / "sample.mp4").stat().st_size < 8e6
    with av.open(str(ASSETS / "sample.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height) == (1280, 720)
        assert float(stream.average_rate or 0) == 25
        assert sum(1 for _ in container.decode(stream)) == SPEC.n_frames


@pytest.mark.slow
def test_sample_pictures_are_what_the_generator_renders() -> None:
    """Luma of a decoded frame against the rendered one: the codec's error only, and not a shifted or older picture."""
    clip = SynthClip(SPEC)
    with av.open(str(ASSETS / "sample.mp4")) as container:
        for index, frame in enumerate(container.decode(video=0)):
            if index == 100:
                plane = frame.planes[0]
                luma = (
                    np.frombuffer(bytes(plane), np.uint8).reshape(-1, plane.line_size)[:, :1280].astype(float)
                )
                break
    rendered = clip.frame(100).image @ np.array([0.2126, 0.7152, 0.0722]) * 219 / 255 + 16
    error = luma - rendered
    # the lettering may differ with OpenCV's version: judge the median, not the worst
    assert np.median(np.abs(error)) < 3
    assert np.median(np.abs(np.roll(luma, 2, axis=1) - rendered)) > 1.2 * np.median(np.abs(error))
