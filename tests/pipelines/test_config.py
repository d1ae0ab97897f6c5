"""Settings: every one documented, every way in typed, every mistake named."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest
from pydantic import ValidationError

from pipelines.config import Config, config_help, load_config, option_names, parse_overrides
from pipelines.errors import ConfigError

UNUSUAL = """
[decode]
deinterlace = "frame"
[calibration]
focal_px = 2755.1
focal_frame = 380
distortion = false
[panorama]
max_megapixels = 0.1
[run]
max_frames = 100
"""


def test_toml_to_config_to_run_json_to_config_is_the_identity(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(UNUSUAL)
    config = load_config(tmp_path / "a.toml")
    assert config.calibration.focal_px == 2755.1 and config.calibration.distortion is False
    (tmp_path / "run.json").write_text(json.dumps({"config": config.as_dict()}, allow_nan=False))
    assert load_config(tmp_path / "run.json") == config != Config()
    assert Config.model_validate(tomllib.loads(config.as_toml())) == config


def test_every_setting_has_a_reason_and_is_in_the_help() -> None:
    text = config_help()
    for name in option_names():
        assert f"--{name} " in text
    for section in Config.model_fields:
        for key, field in type(getattr(Config(), section)).model_fields.items():
            assert field.description and len(field.description) > 20, f"{section}.{key}"


def test_a_byte_order_mark_before_the_settings_does_no_harm(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("\ufeff[shots]\nmin_frames = 5\n", encoding="utf-8")
    assert load_config(tmp_path / "a.toml").shots.min_frames == 5


def test_config_is_frozen() -> None:
    with pytest.raises(ValidationError):
        Config().shots.min_frames = 3  # type: ignore[misc]


def test_command_line_wins_over_the_file_and_is_typed(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(UNUSUAL)
    args = [
        "--panorama.enabled=false",
        "--run.max-frames",
        "50",
        "--calibration.focal_px",
        "3000",
        "--decode.threads",
        "2",
    ]
    config = load_config(tmp_path / "a.toml", parse_overrides(args))
    assert config.panorama.enabled is False and config.run.max_frames == 50
    assert config.calibration.focal_px == 3000.0 and config.calibration.focal_frame == 380
    assert load_config(None, {"run.max_frames": "none"}).run.max_frames is None


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["--shot.min_frame", "5"], "did you mean --shots.min_frames?"),
        (["--min_frames", "5"], "did you mean --shots.min_frames?"),
        (["--zzz.qqq", "5"], "--help-config"),
        (["--shots.min_frames"], "has no value"),
        (["--shots.min_frames", "--run.threads", "1"], "has no value"),
        (["--run.threads", "1", "--run.threads=2"], "given twice"),
        (["stray"], "not an option"),
        (["--shots.min_frames", "many"], "--shots.min_frames: .*integer.*'many'"),
        (["--shots.min_frames", "1"], "greater than or equal to 2"),
        (["--registration.kernel", "cuda"], "'numba' or 'torch'"),
        (["--decode.image_fps", "nan"], "--decode.image_fps"),
        (["--calibration.focal_std_px", "5"], "without focal_px"),
        (["--calibration.focal_px", "350", "--calibration.focal_std_px", "1e-300"], "greater than or equal"),
        (["--calibration.focal_px", "1e300"], "less than or equal"),
        (["--run.max_frames", "9" * 25], "less than or equal"),
        (["--run.start_frame", "9" * 25], "less than or equal"),
    ],
)
def test_a_wrong_option_is_named_with_its_cure(args: list[str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        load_config(None, parse_overrides(args))


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.toml", "[shots]\nmin_frame = 5\n", "shots.min_frame: unknown key; did you mean shots.min_frames"),
        ("a.toml", "[shotz]\nmin_frames = 5\n", "shotz: unknown key; did you mean shots"),
        ("a.toml", "shots = 3\n", "shots"),
        ("a.toml", "[shots\n", "not valid"),
        ("run.json", "{}", "no configuration"),
        ("run.json", "{", "not valid"),
        ("missing.toml", None, "no such file"),
        ("digits.toml", f"[run]\nmax_frames = {'1' * 5000}\n", "not valid"),
        ("digits.json", f'{{"config": {{"run": {{"max_frames": {"1" * 5000}}}}}}}', "not valid"),
        ("deep.toml", "a = " + "[" * 5000, "not valid"),
        ("deep.json", "[" * 100000, "not valid"),
    ],
)
def test_a_wrong_file_is_named_with_its_cure(tmp_path: Path, name: str, text: str | None, said: str) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(ConfigError, match=said) as caught:
        load_config(tmp_path / name)
    assert name in str(caught.value) and "\n" not in str(caught.value)
