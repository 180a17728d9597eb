"""Sweeps from Python: run by the program, their results as rows."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import semfield as sf
from conftest import config_of


@pytest.fixture(scope="module")
def swept(scene: sf.Scene, tmp_path_factory: pytest.TempPathFactory) -> sf.Sweep:
    folder = tmp_path_factory.mktemp("sweep")
    (folder / "box.yaml").write_text(json.dumps({**config_of(scene, steps=6), "runtime": {"threads": 1, "device": "cpu"}}))
    (folder / "rays.yaml").write_text(json.dumps({
        "title": "Rays of a step", "base": "box.yaml", "metrics": ["miou_present", "psnr"], "seeds": [1, 2],
        "variants": {"few": {"set": {"train.rays": 32}}, "many": {"set": {"train.rays": 128}}},
    }))
    return sf.sweep(folder / "rays.yaml", out=folder / "out", jobs=2)


def test_table_has_every_value(swept: sf.Sweep) -> None:
    rows = swept.table()
    assert {(r["variant"], r["seed"]) for r in rows} == {(v, s) for v in ("few", "many") for s in (1, 2)}
    psnr = {(r["variant"], r["seed"]): r["value"] for r in rows if r["metric"] == "psnr"}
    assert len(psnr) == 4 and all(5 < value < 40 for value in psnr.values()) and len(set(psnr.values())) == 4
    assert all(type(r["seed"]) is int and type(r["value"]) is float for r in rows)


def test_values_are_those_of_the_cells(swept: sf.Sweep) -> None:
    finals = [json.loads(f.read_text())["values"] for f in Path(swept.folder).glob("cells/*/result.json")]
    assert len(finals) == 4
    known = sorted(r["value"] for r in swept.table() if r["metric"] == "psnr")
    assert sorted(f["psnr"] for f in finals) == pytest.approx(known, abs=1e-6)


def test_means_are_of_the_table(swept: sf.Sweep) -> None:
    rows = swept.table()
    means = {(m["variant"], m["metric"]): m for m in swept.means()}
    assert {v for v, _ in means} == {"few", "many"}
    for variant in ("few", "many"):
        values = [r["value"] for r in rows if r["variant"] == variant and r["metric"] == "psnr"]
        assert means[variant, "psnr"]["n"] == 2
        assert means[variant, "psnr"]["mean"] == pytest.approx(sum(values) / 2, abs=1e-4)
        assert means[variant, "psnr"]["half_width"] > 0


def test_text_and_repr(swept: sf.Sweep) -> None:
    assert "Rays of a step" in swept.markdown() and "many" in swept.markdown()
    assert swept.folder in repr(swept)


def test_again_nothing_is_trained(swept: sf.Sweep) -> None:
    before = {p: p.stat().st_mtime_ns for p in Path(swept.folder).glob("cells/**/metrics.jsonl")}
    again = sf.sweep(Path(swept.folder).parent / "rays.yaml", out=swept.folder)
    assert again.table() == swept.table()
    assert before and {p: p.stat().st_mtime_ns for p in Path(swept.folder).glob("cells/**/metrics.jsonl")} == before


def test_a_folder_of_before(swept: sf.Sweep, tmp_path: Path) -> None:
    assert sf.Sweep(swept.folder).table() == swept.table()
    with pytest.raises(sf.InputError, match="no sweep"):
        sf.Sweep(tmp_path).table()


def test_what_fails(swept: sf.Sweep, tmp_path: Path) -> None:
    folder = Path(swept.folder).parent
    bad = folder / "bad.yaml"
    bad.write_text(json.dumps({"title": "Bad", "base": "box.yaml", "metrics": ["psnr"], "variants": {"a": {"set": {"train.rayss": 3}}}}))
    with pytest.raises(sf.CommandError, match="rayss") as caught:
        sf.sweep(bad, out=tmp_path / "out")
    assert caught.value.exit_code == 78 and "rayss" in caught.value.stderr
    with pytest.raises(sf.CommandError, match="nowhere.yaml"):
        sf.sweep(tmp_path / "nowhere.yaml", out=tmp_path / "out")
    with pytest.raises(sf.CommandError, match="jobs"):
        sf.sweep(folder / "rays.yaml", out=tmp_path / "out", jobs=0)
