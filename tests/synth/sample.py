"""Remakes assets/sample.mp4 and assets/sample-truth.csv: `python -m tests.synth.sample [folder]`."""

from __future__ import annotations

import sys
from pathlib import Path

from tests.synth.clip import write_clip
from tests.synth.presets import preset

SAMPLE_SEED = 7


def main() -> None:
    """Write the sample into the folder given, or into assets/."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[2] / "assets"
    video = folder / "sample.mp4"
    write_clip(video, preset("sample", seed=SAMPLE_SEED))
    print(f"{video}: {video.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
