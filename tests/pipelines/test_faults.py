"""Damaged files: refused in one line or decoded as far as they go, losses said. Many more: benchmarks.faults."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.faults import BASES, FINE, mutate, read_clip
from tests.pipelines.zoo import CASES, N, make

PER_BASE = 8


@pytest.mark.parametrize("name", BASES)
def test_damaged_files_end_in_a_word_of_their_own(name: str, tmp_path: Path) -> None:
    [case] = [case for case in CASES if case.name == name]
    if case.missing():
        pytest.skip(case.missing())
    whole = make(case, tmp_path).read_bytes()
    path = tmp_path / f"damaged.{case.suffix}"
    rng = np.random.default_rng(3)
    found = {}
    for number in range(PER_BASE):
        kind, data = mutate(whole, rng)
        path.write_bytes(data)
        found[number, kind] = read_clip(path, N)
    assert {key: word for key, word in found.items() if word not in FINE} == {}


def test_the_campaign_sees_a_loss_that_nobody_mentions(tmp_path: Path) -> None:
    [case] = [case for case in CASES if case.name == BASES[0]]
    path = make(case, tmp_path)
    assert read_clip(path, N) == "decoded whole"
    assert read_clip(path, N + 1) == "silent loss"


def test_a_transport_stream_that_ends_in_zeros_is_said_to_be_cut(tmp_path: Path) -> None:
    [case] = [case for case in CASES if case.name == "mpeg2video yuv420p ts"]
    path = make(case, tmp_path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3] + bytes(len(data) - len(data) * 2 // 3))
    assert read_clip(path, N) == "decoded in part, said so"
