"""prepare() runs the program; masks and wide lenses of scenes that are made of arrays."""

from __future__ import annotations

import json
import stat
from pathlib import Path

import numpy as np
import pytest

import semfield as sf


def program_that(folder: Path, script: str, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Stands for the program; writes its words into `words`."""
    file = folder / "semfield"
    file.write_text(f"#!/bin/sh\nfor word; do echo \"$word\"; done > {folder}/words\n{script}\n")
    file.chmod(file.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("SEMFIELD_PROGRAM", str(file))
    return folder / "words"


def test_prepare_hands_over_what_it_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = {"photographs": 12, "registered": 11, "error_px": 0.5, "points": 900, "attempts": 1,
            "missing": ["photograph 3 (c.jpg) is blurred: take it again"], "folder": "room"}
    words = program_that(tmp_path, f"echo '{json.dumps(told)}'", monkeypatch)
    found = sf.prepare(tmp_path / "photos", out="room", threads=2)
    assert words.read_text().split("\n")[:4] == ["prepare", str(tmp_path / "photos"), "--out", "room"]
    assert "--threads\n2\n" in words.read_text() and "--json" in words.read_text()
    assert (found.registered, found.photographs, found.missing) == (11, 12, (told["missing"][0],))
    assert found.config()["type"] == "colmap" and found.config()["root"].endswith("/room")


def test_prepare_says_what_the_program_says(tmp_path: Path) -> None:
    with pytest.raises(sf.CommandError) as said:
        sf.prepare(tmp_path / "nothing", out=tmp_path / "room")
    assert said.value.exit_code != 0 and "nothing" in str(said.value)
    assert not (tmp_path / "room").exists()


def test_what_a_mask_hides_changes_no_parameter(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    images = [random.integers(0, 255, (12, 16, 3), dtype=np.uint8) for _ in range(3)]
    poses = [np.eye(4) for _ in images]
    for i, pose in enumerate(poses):
        pose[0, 3] = 0.1 * i
    mask = np.ones((12, 16), dtype=bool)
    mask[:6] = False
    camera = sf.Camera(16, 12, 16 / (2 * np.pi), 12 / np.pi, lens="equirectangular")

    def trained(photographs: list[np.ndarray]) -> dict[str, np.ndarray]:
        scene = sf.Scene(photographs, poses, camera, masks=[mask, None, mask], bounds=[[-1, -1, -1], [1, 1, 1]], near=0.05, far=2)
        run = sf.open({"include": "presets/room.yaml", "scene": scene.config(), "train": {"steps": 3, "rays": 64}, "runtime": {"device": "cpu"}})
        for _ in run.train():
            pass
        assert run.frames[0].camera.lens == "equirectangular"
        return run.parameters()

    first = trained(images)
    images[0][:6] = 255
    images[2][:6] = 7
    second = trained(images)
    assert all(np.array_equal(first[name], second[name]) for name in first)
    images[1][:6] = 7  # nothing hides this one
    third = trained(images)
    assert any(not np.array_equal(first[name], third[name]) for name in first)


def test_an_unknown_lens_is_refused() -> None:
    with pytest.raises(sf.UsageError, match="lens 'fish'"):
        sf.Camera(4, 3, 5, lens="fish")
