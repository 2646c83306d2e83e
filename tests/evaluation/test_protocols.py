import csv
import io

import pytest

from dnerf.evaluation import protocols


def row(scene: str, psnr: float, **others: object) -> dict:
    return {"method": "fast", "protocol": "dnerf", "scene": scene, "split": "test", "psnr": psnr, "ssim": 0.9, **others}


# T-NeRF with occupancy as nerfacc published it, whose eight-scene mean is 32.22.
PUBLISHED = dict(zip(protocols.DNERF_SCENES, (39.49, 25.58, 31.86, 32.73, 24.32, 35.55, 35.90, 32.33)))


def test_protocols_are_those_that_papers_use() -> None:
    found = {name: (each.resolution, each.background, each.split) for name, each in protocols.PROTOCOLS.items()}
    assert found == {"dnerf": (400, "white", "test"), "gs": (800, "black", "test")}
    with pytest.raises(ValueError, match="protocol must be one of dnerf, gs; got 'nerf'"):
        protocols.find_protocol("nerf")


def test_means_of_a_published_table_come_out_also_as_json() -> None:
    means = {mean["scene"]: mean for mean in protocols.scene_means([row(s, p) for s, p in PUBLISHED.items()])}
    assert means.keys() == {"mean of 8 (lego: test)", "mean of 7 (without lego)"}
    assert means["mean of 8 (lego: test)"]["psnr"] == pytest.approx(32.22, abs=0.005)
    without = sum(p for s, p in PUBLISHED.items() if s != "lego") / 7
    assert means["mean of 7 (without lego)"]["psnr"] == pytest.approx(without)
    table = protocols.table_json([row(s, p) for s, p in PUBLISHED.items() if s != "lego"])
    assert len(table["rows"]) == 7
    assert [mean["scene"] for mean in table["means"]] == ["mean of 7 (without lego)"]
    assert table["missing"] == ["lego"]


def test_the_mean_says_which_split_lego_used() -> None:
    rows = [row(s, p, **({"split": "val"} if s == "lego" else {})) for s, p in PUBLISHED.items()]
    assert protocols.scene_means(rows)[0]["scene"] == "mean of 8 (lego: val)"
    rows = [row("mutant", 30.0), row("lego", 22.0, split="val"), row("trex", 32.0)]
    assert [mean["scene"] for mean in protocols.scene_means(rows)] == ["mean of 3 (lego: val, mutant, trex)"]


def test_seven_scenes_have_their_mean_and_other_sets_are_named() -> None:
    seven = [row(s, p) for s, p in PUBLISHED.items() if s != "lego"]
    assert [mean["scene"] for mean in protocols.scene_means(seven)] == ["mean of 7 (without lego)"]
    two = [row("mutant", 30.0), row("trex", 32.0)]
    (mean,) = protocols.scene_means(two)
    assert mean["scene"] == "mean of 2 (mutant, trex)"
    assert mean["psnr"] == 31
    assert protocols.scene_means([row("mutant", 30.0)]) == []
    assert "lego" in protocols.missing_scenes(two)
    assert protocols.missing_scenes([row(s, 1.0) for s in protocols.DNERF_SCENES]) == []


def test_images_of_other_sizes_backgrounds_and_backbones_are_never_averaged() -> None:
    for name, values in (("resolution", (400, 800)), ("background", ("white", "black")),
                         ("lpips_backbone", ("alex", "vgg"))):  # fmt: skip
        rows = [row(scene, 30.0, **{name: value}) for value in values for scene in ("mutant", "trex")]
        assert [mean[name] for mean in protocols.scene_means(rows)] == list(values)
        assert (
            protocols.scene_means([row("mutant", 30.0, **{name: values[0]}), row("trex", 32.0, **{name: values[1]})])
            == []
        )


def test_means_say_what_their_rows_share_and_not_what_some_lack() -> None:
    rows = [row("mutant", 30.0, seed=0, hardware="A", commit="1"), row("trex", 32.0, seed=0, hardware="A", commit="2")]
    (mean,) = protocols.scene_means(rows)
    assert (mean["split"], mean["seed"], mean["hardware"]) == ("test", 0, "A")
    assert "commit" not in mean
    mean = protocols.scene_means([row("mutant", 30.0, lpips=0.1), row("trex", 32.0)])[0]
    assert "lpips" not in mean
    assert "lpips" in protocols.scene_means([row("mutant", 30.0, lpips=0.1), row("trex", 32.0, lpips=0.3)])[0]


def test_notes_say_the_protocol_and_which_scenes_a_mean_lacks() -> None:
    first, second = protocols.table_notes([row("mutant", 30.0), row("lego", 22.0)])
    assert first.startswith("Protocol dnerf: 400 pixels wide, on white")
    assert (
        second == "No mean over eight scenes: bouncingballs, hellwarrior, hook, jumpingjacks, standup, trex not scored."
    )
    (own,) = protocols.table_notes([row("walker", 30.0, protocol="own")])
    assert own.startswith("Protocol own: each run's own")
    assert len(protocols.table_notes([row(scene, 30.0) for scene in protocols.DNERF_SCENES])) == 1
    part = protocols.table_notes([row("mutant", 30.0, num_frames=2, frames_of_split=20)])[1]
    assert part == "Not all frames were scored, so these rows are not by the protocol: mutant 2 of 20."
    assert len(protocols.table_notes([row("walker", 30.0, num_frames=20, frames_of_split=20)])) == 1


def test_seeds_are_averaged_within_a_scene_first_methods_and_protocols_never() -> None:
    rows = [row("mutant", 30.0, seed=0), row("mutant", 32.0, seed=1), row("trex", 40.0)]
    assert protocols.scene_means(rows)[0]["psnr"] == pytest.approx((31 + 40) / 2)
    rows = [row("mutant", 30.0), row("trex", 32.0), {**row("mutant", 50.0), "protocol": "gs"},
            {**row("trex", 52.0), "protocol": "gs"}, {**row("mutant", 10.0), "method": "slow"}]  # fmt: skip
    means = {(mean["method"], mean["protocol"]): mean["psnr"] for mean in protocols.scene_means(rows)}
    assert means == {("fast", "dnerf"): 31, ("fast", "gs"): 51}


def test_tables_hold_every_row_and_column() -> None:
    rows = [row("mutant", 30.123456, seed=3, train_seconds=60.4, hardware="2 x A | B"), row("trex", 32.0, seed=3)]
    lines = protocols.markdown_table(rows).splitlines()
    assert len(lines) == 5
    assert lines[0] == "| method | scene | split | PSNR | SSIM | protocol | seed | train s | scored on |"
    assert lines[2] == "| fast | mutant | test | 30.12 | 0.9000 | dnerf | 3 | 60 | 2 x A \\| B |"
    assert "mean of 2 (mutant, trex)" in lines[4]
    table = list(csv.DictReader(io.StringIO(protocols.csv_table(rows))))
    assert [float(line["psnr"]) for line in table] == pytest.approx([30.123456, 32.0, 31.061728])
    assert table[0]["hardware"] == "2 x A | B"
