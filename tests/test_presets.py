"""Presets: shipped settings that lie under what a user gives; and the registration of one."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from laser_slam.cli import app
from laser_slam.cli.bench_command import BenchFlags
from laser_slam.config import dump_config, load_config, shipped_configs
from laser_slam.errors import ConfigError, DegenerateGeometryError
from laser_slam.registration import register
from laser_slam.registration.joint import fit_joint
from laser_slam.sim3 import Sim3, rotation_exp
from laser_slam.types import Prediction

PRESETS = sorted(path.stem for path in shipped_configs().glob("*.yaml"))
K = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
FRAMES = np.arange(4)
JOINT = load_config(assignments=["registration.rigid=joint"]).registration
PREVIOUS_FROM_CURRENT = Sim3(1.7, rotation_exp(np.array([0.1, -0.2, 0.05])), np.array([3, 1, -2.0]))


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_the_shipped_file_and_is_named(name: str) -> None:
    shipped, preset = load_config(name), load_config(assignments=[f"preset={name}"])
    assert preset.preset == name
    assert preset.model_copy(update={"preset": ""}) == shipped


def test_a_preset_lies_under_the_users_settings_and_over_the_base(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("layers:\n  tau_inter: 0.5\n")
    base = {"layers": {"tau_inter": 0.9, "tau_intra": 0.9}, "windows": {"size": 12}}
    config = load_config(None, file, ["layers.memory=3", "preset=paper"], base)
    assert (config.layers.tau_inter, config.layers.memory) == (0.5, 3)  # the user's
    assert (config.layers.tau_intra, config.registration.scale) == (0.3, "huber")  # the preset's
    assert config.windows.size == 12  # the base's


def test_resolved_settings_of_a_preset_load_to_the_same(tmp_path: Path) -> None:
    config = load_config(assignments=["preset=official", "layers.scale=median"])
    file = tmp_path / "config.yaml"
    file.write_text(dump_config(config))
    assert load_config(file=file) == config


def test_an_unknown_preset_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError) as error:
        load_config(assignments=["preset=vgt-long"])
    assert str(error.value) == f"preset: no 'vgt-long'; there is {', '.join(PRESETS)}"
    with pytest.raises(ConfigError, match="preset: input should be a valid string, got 3"):
        load_config(assignments=["preset=3"])


def test_config_prints_a_preset_resolved() -> None:
    result = CliRunner().invoke(app, ["config", "--set", "preset=vggt-long"])
    assert result.exit_code == 0
    lines = [line.partition("  #")[0] for line in result.stdout.splitlines()]
    for line in ("preset: vggt-long", "  rigid: joint", "  robust: false", "  enabled: never"):
        assert line in lines


def windows(unit: float = 1.0, lie: float = 0.0) -> tuple[Prediction, Prediction]:
    """Show one surface in two windows; ``lie``: share of pixels whose depth is three times off."""
    rng = np.random.default_rng(3)
    depth = rng.uniform(1, 3, (len(FRAMES), 48, 64)).astype(np.float32)
    previous_from_cam = np.tile(np.eye(4), (len(FRAMES), 1, 1))
    previous_from_cam[:, 0, 3] = 0.2 * FRAMES
    inverse = PREVIOUS_FROM_CURRENT.inverse()
    current_from_cam = np.array(previous_from_cam)
    current_from_cam[:, :3, :3] = inverse.rotation @ previous_from_cam[:, :3, :3]
    current_from_cam[:, :3, 3] = inverse.apply(previous_from_cam[:, :3, 3])
    wrong = rng.uniform(size=depth.shape) < lie
    seen = depth / np.float32(PREVIOUS_FROM_CURRENT.scale) * np.where(wrong, 3, 1)
    made = []
    for z, poses, unit_of_it in ((depth, previous_from_cam, unit), (seen, current_from_cam, 1.0)):
        placed = np.array(poses)
        placed[:, :3, 3] *= unit_of_it
        scaled = (z * unit_of_it).astype(np.float32)
        sure = np.full(z.shape, 0.9, np.float32)
        made.append(Prediction(FRAMES, scaled, sure, placed, np.tile(K, (len(FRAMES), 1, 1))))
    return made[0], made[1]


def test_the_joint_fit_finds_the_similarity_of_exact_points() -> None:
    found = register(*windows(), JOINT).previous_from_current
    np.testing.assert_allclose(found.matrix(), PREVIOUS_FROM_CURRENT.matrix(), atol=1e-5)


def test_wrong_points_move_the_joint_fit_less_than_least_squares() -> None:
    """Its five rounds do not get all the way from the least squares that they start with."""
    off = []
    for delta in (0.1, 1e9):
        config = JOINT.model_copy(update={"huber_delta": delta})
        found = register(*windows(lie=0.1), config).previous_from_current
        off.append(abs(found.scale / PREVIOUS_FROM_CURRENT.scale - 1))
    assert 0 < off[0] < 0.7 * off[1]


def test_the_joint_fit_knows_no_unit() -> None:
    small, large = (
        register(*windows(unit, lie=0.1), JOINT).previous_from_current for unit in (0.01, 100.0)
    )
    assert large.scale == pytest.approx(1e4 * small.scale, rel=1e-4)
    np.testing.assert_allclose(large.rotation, small.rotation, atol=1e-5)
    np.testing.assert_allclose(large.translation, 1e4 * small.translation, rtol=1e-3)


def test_the_joint_fit_refuses_what_shares_no_confident_points() -> None:
    previous, current = windows()
    blind = Prediction(
        FRAMES, current.depth, np.zeros_like(current.confidence), current.window_from_cam,
        current.intrinsics,
    )  # fmt: skip
    with pytest.raises(DegenerateGeometryError, match="share 0 confident points"):
        fit_joint(previous, blind, FRAMES, FRAMES, 0.1)


def settings_of(name: str) -> dict[str, object]:
    """Return what a shipped file says, by ``section.key``."""

    def flat(part: dict[str, object], prefix: str) -> dict[str, object]:
        found: dict[str, object] = {}
        for key, value in part.items():
            inner = flat(value, f"{prefix}{key}.") if isinstance(value, dict) else None
            found.update(inner or {prefix + key: value})
        return found

    return flat(yaml.safe_load((shipped_configs() / f"{name}.yaml").read_text()), "")


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_says_only_what_differs_from_the_defaults(name: str) -> None:
    for setting in settings_of(name):
        config: object = load_config(name)
        default: object = load_config()
        for key in setting.split("."):
            config, default = getattr(config, key), getattr(default, key)
        assert config != default, setting


@pytest.mark.parametrize(
    ("name", "published"),
    [
        (  # VGGT-Long's base configuration and code
            "vggt-long",
            "places.max_per_keyframe=5 places.max_per_window_pair=1 closures.loop_frames=20 "
            "registration.rigid=joint registration.huber_delta=0.1 pose_graph.robust=false",
        ),
        (  # LASER's paper, section 3.2 and its experiments
            "paper",
            "windows.size=20 windows.overlap=5 layers.tau_inter=0.3 layers.tau_intra=0.3 "
            "registration.scale=huber layers.scale=huber layers.intra=true layers.feed_back=false",
        ),
        (  # LASER's code
            "official",
            "windows.size=20 windows.overlap=5 layers.tau_inter=0.4 layers.tau_intra=0.3 "
            "registration.scale=l1 layers.scale=l1 layers.feed_back=true "
            "layers.segmentation.scale=300 layers.segmentation.sigma=1.1 "
            "layers.segmentation.min_size_px=500 layers.segmentation.merge=0.1",
        ),
    ],
)
def test_a_preset_has_the_numbers_of_its_source(name: str, published: str) -> None:
    """Those too that are our defaults: the file need not name them, but must not lose them."""
    given = [f"preset={name}", *published.split()]
    assert load_config(assignments=given) == load_config(assignments=given[:1])


def test_a_users_setting_lies_over_the_preset_of_a_row() -> None:
    flags = BenchFlags(set=["registration.huber_delta=0.3", "layers.enabled=always"])
    config = flags.resolve(["layers.enabled=auto"], ["preset=vggt-long"])
    assert (config.preset, config.registration.rigid) == ("vggt-long", "joint")
    assert (config.registration.huber_delta, config.layers.enabled) == (0.3, "always")
