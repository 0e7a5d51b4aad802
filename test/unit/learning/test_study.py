"""geoorbit train and evaluate on three short cameras, and what training promises."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tasks import made_task

from geoorbit_ros.cli.main import EXIT_BAD_INPUT, main
from geoorbit_ros.learning.camera_task import load_task, save_task
from geoorbit_ros.learning.evaluation import count_is_right
from geoorbit_ros.learning.local_training import Examples
from geoorbit_ros.learning.meta_learner import MetaLearner, load_model
from geoorbit_ros.learning.parameter_space import PARAMETER_NAMES
from geoorbit_ros.learning.population import Cameras, MapErrors, Population, scene_task
from geoorbit_ros.learning.population_cameras import count_vehicles
from geoorbit_ros.learning.training import RunSettings, TrainedModel, load_history, train

FLEET = """
name: tiny
duration_s: 10
seen: {first: 3, count: 2}
unseen: {first: 20003, count: 1}
"""


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("study")
    (folder / "population.yaml").write_text(FLEET)
    words = ["--rounds", "3", "--estimator", "curvilinear", "--workers", "1"]
    assert (
        main(["train", str(folder / "population.yaml"), "--out", str(folder / "out"), *words]) == 0
    )
    return folder / "out"


def test_train_writes_models_histories_and_cameras(study: Path) -> None:
    assert len(list((study / "cameras").glob("camera_*.npz"))) == 3
    for mode in ("central", "federated"):
        learner = load_model(study / "curvilinear" / f"{mode}-0.npz")
        assert learner.predict_unit(np.zeros(len(learner.feature_names))).shape == (3,)
        rounds = load_history(study / "curvilinear" / f"{mode}-0.csv")
        assert [entry.number for entry in rounds] == [1, 2, 3, 4]
        assert rounds[-1].parameter_loss <= rounds[0].parameter_loss


def test_evaluate_writes_tables_and_figures(study: Path) -> None:
    assert main(["evaluate", "--out", str(study), "--workers", "1"]) == 0
    text = (study / "evaluation" / "tables.md").read_text()
    for words in ("| unseen | FedMeta |", "| seen | Searched |", "lane count right", "BPS"):
        assert words in text
    for mode in ("central", "federated"):
        figure = study / "evaluation" / f"loss-{mode}-curvilinear.png"
        assert figure.read_bytes()[:4] == b"\x89PNG"


def test_a_plugin_has_a_folder_of_its_class_name_and_is_evaluated(
    study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, home = tmp_path / "out", tmp_path / "mine"
    shutil.copytree(study, out)
    home.mkdir()
    base = "from geoorbit_ros.lanes.estimators.geolane import GeoLaneEstimator\n"
    for name in ("one.py", "two.py"):
        (home / name).write_text(base + "class Wide(GeoLaneEstimator): ...\n")
    words = ["train", str(out / "population.yaml"), "--out", str(out), "--rounds", "1"]
    words += ["--mode", "central", "--workers", "1", "--estimator"]
    assert main([*words, f"{home}/one.py:Wide"]) == 0
    assert load_model(out / "Wide" / "central-0.npz")
    assert {path.name for path in home.iterdir()} <= {"one.py", "two.py", "__pycache__"}
    assert main(["evaluate", "--out", str(out), "--workers", "1"]) == 0
    assert (out / "evaluation" / "losses-Wide.csv").exists()
    capsys.readouterr()
    assert main([*words, f"{home}/two.py:Wide"]) == EXIT_BAD_INPUT
    assert "one.py:Wide" in capsys.readouterr().err
    (home / "two.py").write_text("class Wide: ...\n")
    assert main([*words, f"{home}/two.py:Wide"]) == EXIT_BAD_INPUT
    assert "Wide without add, lanes" in capsys.readouterr().err


def test_bad_input_is_one_sentence_and_exit_code_two(
    study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.yaml"
    other.write_text(FLEET.replace("count: 2", "count: 4"))
    broken = tmp_path / "broken.yaml"
    broken.write_text(FLEET.replace("count: 2", "count: two"))
    for words, told in (
        (["train", str(other), "--out", str(study)], "another population"),
        (["train", str(broken), "--out", str(tmp_path / "new")], "count"),
        (["evaluate", "--out", str(tmp_path / "nowhere")], "geoorbit train"),
    ):
        assert main(words) == EXIT_BAD_INPUT
        complaint = capsys.readouterr().err
        assert told in complaint
        assert complaint.count("\n") == 1
    assert not (tmp_path / "new").exists()


def test_a_camera_of_a_fleet_is_the_same_every_time_and_survives_the_file(tmp_path: Path) -> None:
    population = Population(
        name="one",
        duration_s=10.0,
        seen=Cameras(first=3, count=1),
        unseen=Cameras(first=4, count=0),
        tilt_deg=2.0,
    )
    first, second = (scene_task(population, "a", 3) for _ in range(2))
    assert first.tracks.rows.tobytes() == second.tracks.rows.tobytes()
    save_task(first, tmp_path / "a.npz")
    loaded = load_task(tmp_path / "a.npz")
    assert loaded.tracks.rows.tobytes() == first.tracks.rows.tobytes()
    np.testing.assert_array_equal(loaded.features, first.features)
    for name in ("truth", "supervision"):
        for a, b in zip(getattr(loaded, name), getattr(first, name), strict=True):
            np.testing.assert_array_equal(a.centerline_m, b.centerline_m)
            assert (a.width_m, a.vehicles) == (b.width_m, b.vehicles)
    # tilt_deg: the first lane runs east or west, give or take.
    assert abs(np.cos(np.radians(first.truth[0].heading_deg))) <= np.sin(np.radians(2.01))


def test_the_map_that_is_learned_from_is_off_as_the_fleet_says() -> None:
    population = Population(
        name="one",
        duration_s=10.0,
        seen=Cameras(first=3, count=1),
        unseen=Cameras(first=4, count=0),
        map=MapErrors(offset_sigma_m=1.0, width_step_m=0.5),
    )
    task = scene_task(population, "a", 3)
    shift = task.supervision[0].centerline_m - task.truth[0].centerline_m
    np.testing.assert_allclose(shift, np.broadcast_to(shift[0], shift.shape), atol=1e-9)
    assert 0.01 < np.hypot(*shift[0]) < 5.0
    for mapped, true in zip(task.supervision, task.truth, strict=True):
        assert mapped.width_m % 0.5 == 0.0
        assert abs(mapped.width_m - true.width_m) <= 0.25


def test_vehicles_are_counted_on_the_lane_they_drive_along() -> None:
    task = made_task()
    assert [lane.vehicles for lane in count_vehicles(task.truth, task.tracks)] == [12.0, 12.0]


def examples_of_many(count: int = 8) -> dict[str, Examples]:
    random = np.random.default_rng(5)
    features = random.uniform(-1, 1, (count, 18))
    targets = 1 / (1 + np.exp(-2 * features[:, : len(PARAMETER_NAMES)]))
    return {f"c{k}": Examples(features[[k]], targets[[k]]) for k in range(count)}


def trained(mode: str, seed: int = 0, stop_below: float = float("nan")) -> TrainedModel:
    def composite(_learner: MetaLearner, names: Sequence[str]) -> NDArray[np.float64]:
        return np.full(len(names), 7.0)

    settings = RunSettings(rounds=6, seed=seed, stop_below=stop_below)
    return train(mode, examples_of_many(), composite, settings)  # type: ignore[arg-type]


@pytest.mark.parametrize("mode", ["central", "federated"])
def test_training_lowers_the_parameter_loss_and_repeats_itself(mode: str) -> None:
    model, again = trained(mode), trained(mode)
    assert model.rounds[-1].parameter_loss < 0.9 * model.rounds[0].parameter_loss
    for name, value in model.learner.weights.items():
        assert value.tobytes() == again.learner.weights[name].tobytes()
    assert (model.traffic.total_bytes > 0) is (mode == "federated")


@pytest.mark.parametrize("mode", ["central", "federated"])
def test_training_ends_when_the_total_loss_is_below_lambda(mode: str) -> None:
    assert len(trained(mode, stop_below=7.5).rounds) <= 3
    assert len(trained(mode, stop_below=6.5).rounds) == 7


def test_federated_and_central_training_end_near_each_other() -> None:
    features = np.random.default_rng(1).uniform(-1, 1, (50, 18))
    central, federated = (
        trained(mode).learner.predict_unit(features) for mode in ("central", "federated")
    )
    moved = np.abs(central - MetaLearner.untrained(0).predict_unit(features)).mean()
    assert np.abs(central - federated).mean() < 0.25 * moved


def test_each_draw_has_cameras_of_its_own() -> None:
    population = Population(
        name="many", draws=3, seen=Cameras(first=5, count=4), unseen=Cameras(first=900, count=2)
    )
    drawn = [set(population.of_draw(draw).scenes) for draw in range(3)]
    assert [len(cameras) for cameras in drawn] == [6, 6, 6]
    assert len(set.union(*drawn)) == 18
    assert set(population.of_draw(3).scenes) == drawn[0]
    assert population.of_draw(1).of_draw(7) == population.of_draw(1)


@pytest.mark.parametrize(
    ("confirmed", "tentative", "right"),
    [(1, 3, False), (2, 0, True), (3, 5, True), (4, 0, False)],
)
def test_the_lane_count_is_that_of_confirmed_lanes(
    confirmed: int, tentative: int, right: bool
) -> None:
    lane = made_task().truth[0]
    truth = [replace(lane, vehicles=n) for n in (8.0, 30.0, 7.0, 2.0)]
    found = [replace(lane, status="confirmed")] * confirmed
    found += [replace(lane, status="tentative")] * tentative
    assert count_is_right(found, truth) is right
