"""A camera whose pupil lies .6 m before the pan axis: its parallax found by the whole program, the focal not biased."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.compare import compare_run
from pipelines.config import Config
from pipelines.run import process
from tests.synth.clip import write_clip
from tests.synth.paths import BROADCAST_LENS
from tests.synth.presets import preset

pytestmark = pytest.mark.slow


def test_a_pupil_before_the_axis_is_found_and_does_not_bias_the_focal(tmp_path):
    spec = preset("reference", seed=45)
    spec = replace(
        spec, width=960, height=540, n_frames=75, player_share=0.05, max_px_per_rad=2400.0,
        lens=replace(BROADCAST_LENS, pupil_m=0.6),
    )  # fmt: skip
    clip = tmp_path / "clip.mp4"
    write_clip(clip, spec)
    record = process(clip, tmp_path / "run", Config.model_validate({"panorama": {"enabled": False}}))
    errors = compare_run(tmp_path / "run", tmp_path / "clip-truth.csv")["shots"][0]
    calibration = record.shots[0].calibration
    pupil = calibration["pupil"]
    assert pupil["accepted"], pupil["sentence"]
    # A pupil lengthens the focal; far more than what is left of it is taken out.
    assert pupil["focal_change"] < -0.02
    assert errors["focal_median"] < 0.01
    assert errors["inside_2_sigma"] > 0.9
    assert calibration["sigma_parts"]["pupil"] == pytest.approx(
        0.25 * abs(np.log1p(pupil["focal_change"])), rel=1e-6
    )
