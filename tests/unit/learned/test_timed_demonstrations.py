"""Timed demonstrations: what is in them, that runs go on, and that damaged shards are named."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("casadi", reason="CasADi comes with the extra 'trajectory'")

from flockopt import SettingsError
from learned.demonstrations import timed
from learned.demonstrations.array_files import shard_path
from learned.demonstrations.scenes import SceneMix
from learned.demonstrations.timed import TimedSettings, main, make_shard, timed_shards
from learned.demonstrations.timed_shards import NO_PHASE, load_stages, read_shard, write_shard

SETTINGS = TimedSettings(SceneMix("forest", hard_share=0.0, usual_share=1.0, margin=0.0), seed=3)


@pytest.fixture(scope="module")
def arrays():
    return make_shard(SETTINGS, range(3, 5))


def test_stages_are_smoothed_between_the_same_ends_and_past_the_same_tasks(arrays, tmp_path):
    write_shard(shard_path(tmp_path, 0), arrays)
    stages = load_stages(tmp_path)
    assert arrays["certified"].all()
    assert len(stages) > 10
    for stage in stages:
        np.testing.assert_allclose(stage.teacher_states[[0, -1]], stage.states[[0, -1]], atol=1e-5)
        np.testing.assert_allclose(stage.teacher_states[stage.anchored, 0], stage.states[stage.anchored, 0], atol=1e-4)
        assert stage.teacher_durations.sum() <= stage.durations.sum() + 1e-4
        assert ((stage.phases == NO_PHASE) | ((stage.phases > 0.0) & (stage.phases < 1.0))).all()


def test_a_run_goes_on_and_gives_the_same_bytes(monkeypatch, tmp_path):
    monkeypatch.setattr(timed, "SHARD_SCENES", 1)
    timed_shards(tmp_path / "clean", SETTINGS).go(2)
    clean = [path.read_bytes() for path in sorted((tmp_path / "clean").glob("shard-*.npz"))]
    timed_shards(tmp_path / "more", SETTINGS).go(1)
    timed_shards(tmp_path / "more", SETTINGS).go(2)
    assert [path.read_bytes() for path in sorted((tmp_path / "more").glob("shard-*.npz"))] == clean
    assert len(clean) == 2


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda arrays: arrays.pop("limits"), "holds"),
        (lambda arrays: arrays["states"].__setitem__((0, 0, 0), np.nan), "states.*is not finite"),
        (lambda arrays: arrays["durations"].__setitem__(0, 0.0), "durations.*is not above 0"),
        (lambda arrays: arrays["stage_scene"].__setitem__(0, 7), "stage_scene.*not there"),
        (lambda arrays: arrays["joint_offsets"].__setitem__(1, 1), "joint_offsets.*fewer than 2"),
        (lambda arrays: arrays.update(radii=arrays["radii"].astype(np.float32)), "radii.*float32"),
    ],
)
def test_damaged_shards_are_named(arrays, tmp_path, damage, words):
    broken = {name: values.copy() for name, values in arrays.items()}
    damage(broken)
    write_shard(tmp_path / "shard-00000.npz", broken)
    with pytest.raises(SettingsError, match=words) as caught:
        read_shard(tmp_path / "shard-00000.npz")
    assert "learned.demonstrations.timed" in str(caught.value)


def test_bad_input_is_named(tmp_path, capsys):
    assert main(["--margin", "0.5", "--out", str(tmp_path)]) == 2
    assert "margin is 0.5" in capsys.readouterr().err
    assert main(["--scenes", "0", "--out", str(tmp_path)]) == 2
    assert "scenes is 0" in capsys.readouterr().err
    with pytest.raises(SettingsError, match="must be a folder with shards"):
        load_stages(tmp_path / "nowhere")
