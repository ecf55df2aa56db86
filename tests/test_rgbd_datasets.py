"""The published data sets, in miniatures of their official layouts with known content."""

import base64
import shutil
import zlib
from pathlib import Path

import numpy as np
import pytest
from corridor import SIZE, TrueBackbone, true_intrinsics, true_pose, view
from image_files import write_png
from layouts import FIRST_DEPTH, LAYOUTS, counts, open_layout, scanned, write_exr, write_layout
from quick_runs import leave_pictures_out
from typer.testing import CliRunner

from laser_slam.camera import rays, resize_intrinsics
from laser_slam.cli import app
from laser_slam.config import load_config
from laser_slam.datasets import DATASETS
from laser_slam.datasets.base import Dataset
from laser_slam.datasets.bonn import MARKERS_FROM_CAM, Bonn
from laser_slam.datasets.exr import read_exr
from laser_slam.datasets.kitti_depth import KittiDepth
from laser_slam.datasets.nrgbd import Nrgbd
from laser_slam.datasets.scannet import ScanNet
from laser_slam.datasets.sintel import Sintel
from laser_slam.datasets.tum_rgbd import TumRgbd
from laser_slam.datasets.waymo import Waymo
from laser_slam.dependencies import import_named
from laser_slam.errors import DatasetError
from laser_slam.pipeline import Pipeline

NUM = 4
KEYS = list(LAYOUTS)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every layout, written once; copy it before changing anything."""
    root = tmp_path_factory.mktemp("data")
    for key in KEYS:
        write_layout(key, root / key, NUM)
    return root


def opened(key: str, root: Path) -> Dataset:
    return LAYOUTS[key].open(root / key / LAYOUTS[key].place)


@pytest.mark.parametrize("key", KEYS)
def test_the_images_come_in_order_with_rising_times(key: str, root: Path) -> None:
    layout, dataset = LAYOUTS[key], opened(key, root)
    frames = list(dataset.frames())
    assert (dataset.info.name, dataset.info.size) == (layout.name, SIZE)
    assert dataset.info.num_frames == len(frames) == len(dataset.info.files) == NUM
    steps_s = np.diff([frame.time_s for frame in frames])
    np.testing.assert_allclose(steps_s, 1 / layout.fps, atol=2e-6)
    for index, frame in enumerate(frames):
        assert frame.index == index
        assert frame.image is not None
        error = np.abs(frame.image.astype(int) - view(index)[0])
        assert error.mean() < (2 if layout.is_lossy else 1e-9)
        wrong = np.abs(frame.image.astype(int) - view(index + 1)[0])
        assert error.mean() < 0.5 * wrong.mean()


@pytest.mark.parametrize("key", KEYS)
def test_the_true_poses_are_those_of_the_camera_in_our_axes(key: str, root: Path) -> None:
    truth = opened(key, root).info.truth
    if not LAYOUTS[key].has_poses:
        assert truth is None
        return
    assert truth is not None
    assert list(truth.frames) == list(range(NUM))
    for frame, world_from_cam in zip(truth.frames, truth.world_from_cam, strict=True):
        np.testing.assert_allclose(world_from_cam, true_pose(int(frame)), atol=1e-7)


@pytest.mark.parametrize("key", KEYS)
def test_depth_is_in_metres_and_unknown_where_the_file_says_nothing(key: str, root: Path) -> None:
    layout, dataset = LAYOUTS[key], opened(key, root)
    for frame in range(NUM):
        depth = dataset.true_depth(frame)
        assert depth is not None
        assert depth.dtype == np.float32
        assert depth.shape == SIZE
        pixels = (slice(1, None, 2),) * 2 if key == "scannet" else (slice(None),) * 2
        true = (scanned(frame) if key == "waymo" else view(frame)[1])[pixels]
        known = (true > 0) & (true < layout.reach_m)
        assert 0.1 < known.mean()
        np.testing.assert_array_equal(np.isfinite(depth[pixels]), known)
        error = np.abs(depth[pixels] - true)[known]
        assert error.max() <= 0.51 * layout.unit_m + 1e-5


@pytest.mark.parametrize("key", KEYS)
def test_intrinsics_are_those_of_the_files_or_published(key: str, root: Path) -> None:
    info = opened(key, root).info
    assert info.intrinsics is not None
    expected = true_intrinsics()
    if key == "nrgbd":
        expected[:2, 2] = SIZE[1] / 2, SIZE[0] / 2
    if LAYOUTS[key].has_own_lens:
        np.testing.assert_allclose(info.intrinsics, expected, atol=1e-6)
    assert info.intrinsics_source


@pytest.mark.parametrize("key", KEYS)
def test_a_data_set_is_in_the_table_and_has_a_command(key: str, root: Path) -> None:
    reader = import_named(DATASETS, key, "reader")
    assert reader(root / key / LAYOUTS[key].place).info.name == LAYOUTS[key].name
    result = CliRunner().invoke(app, [key, str(root / "none" / "here")])
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert line.startswith("laser-slam: no ")
    assert "give " in line or "pass " in line


def test_the_page_on_data_sets_has_a_row_for_each() -> None:
    page = (Path(__file__).parents[1] / "docs" / "datasets.md").read_text()
    own_material = {"images", "video", "synthetic"}
    for name in set(DATASETS) - own_material:
        assert f"\n| `{name} " in page


@pytest.mark.parametrize("key", ["tum-rgbd", "sintel", "waymo"])
def test_a_run_with_a_backbone_that_knows_scores_next_to_nothing(
    key: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_pictures_out(monkeypatch)
    config = load_config(
        assignments=["windows.size=8", "windows.overlap=3", "windows.min_parallax_px=0.2"]
    )
    dataset = open_layout(key, tmp_path / "data", 16)
    results = Pipeline(dataset, config, tmp_path / "run", backbone=TrueBackbone()).run()
    report = results.report
    assert report["trajectory"]["ate_sim3_m"]["rmse"] < 1e-3
    assert report["depth"]["by_trajectory_scale"]["abs_rel"] < 2e-3
    assert report["depth"]["by_trajectory_scale"]["coverage"] == 1


def test_tum_depth_and_poses_beyond_20_ms_belong_to_no_image(tmp_path: Path) -> None:
    folder = write_layout("tum-rgbd", tmp_path, NUM)
    for name, rows in {"depth": slice(3, 4), "groundtruth": slice(3, 6)}.items():
        lines = (folder / f"{name}.txt").read_text().splitlines()
        del lines[rows]  # near image 1
        (folder / f"{name}.txt").write_text("\n".join(lines))
    dataset = TumRgbd(folder)
    assert dataset.info.num_frames == NUM
    assert dataset.info.truth is not None
    assert list(dataset.info.truth.frames) == [0, 2, 3]
    assert dataset.true_depth(1) is None
    assert dataset.true_depth(2) is not None
    assert TumRgbd(folder, posed_only=True).info.num_frames == NUM - 1


def test_lines_of_tum_may_come_twice_and_in_any_order_as_its_own_tool_allows(
    tmp_path: Path,
) -> None:
    folder = write_layout("tum-rgbd", tmp_path, NUM)
    for name in ("depth", "groundtruth"):
        lines = (folder / f"{name}.txt").read_text().splitlines()[2:]
        (folder / f"{name}.txt").write_text("\n".join([*reversed(lines), *lines]))
    dataset = TumRgbd(folder)
    assert dataset.info.truth is not None
    for frame in range(NUM):
        np.testing.assert_allclose(
            dataset.info.truth.world_from_cam[frame], true_pose(frame), atol=1e-7
        )
        depth = dataset.true_depth(frame)
        assert depth is not None
        np.testing.assert_allclose(np.nan_to_num(depth) * 5000, counts(frame, 5000), rtol=1e-6)


def test_tum_knows_its_three_cameras_by_the_name_of_the_folder(tmp_path: Path) -> None:
    folder = write_layout("tum-rgbd", tmp_path, 2)
    focal = {"freiburg1_desk": 517.3, "freiburg2_xyz": 520.9, "freiburg3_office": 535.4}
    for name, expected in focal.items():
        info = TumRgbd(shutil.copytree(folder, tmp_path / name)).info
        assert info.intrinsics is not None
        assert info.intrinsics[0, 0] == pytest.approx(expected * SIZE[1] / 640)
        assert ("distortion" in info.intrinsics_source) == ("freiburg3" not in name)
    info = TumRgbd(shutil.copytree(folder, tmp_path / "corridor")).info
    assert info.intrinsics is None
    assert "no freiburg1, 2 or 3" in info.intrinsics_source


def test_the_published_calibration_of_bonn_is_a_similarity() -> None:
    columns = np.linalg.norm(MARKERS_FROM_CAM[:3, :3], axis=0)
    np.testing.assert_allclose(columns, 1.0593, atol=2e-4)
    rotation = MARKERS_FROM_CAM[:3, :3] / columns
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=2e-4)


def test_a_scannet_frame_whose_tracking_was_lost_has_no_pose(tmp_path: Path) -> None:
    folder = write_layout("scannet", tmp_path, NUM)
    np.savetxt(folder / "pose" / "1.txt", np.full((4, 4), -np.inf))
    (folder / "pose" / "2.txt").unlink()
    nowhere = np.eye(4)
    nowhere[0, 3] = np.inf
    np.savetxt(folder / "pose" / "3.txt", nowhere)
    (folder / "depth" / "2.png").unlink()
    dataset = ScanNet(folder)
    assert dataset.info.truth is not None
    assert list(dataset.info.truth.frames) == [0]
    assert dataset.true_depth(2) is None
    assert dataset.true_depth(3) is not None


def test_the_numbers_of_scannet_order_it_and_time_it(tmp_path: Path) -> None:
    folder = write_layout("scannet", tmp_path, 12)
    for number in (0, 1, 3, 4, 5, 6, 7, 8):
        (folder / "color" / f"{number}.jpg").unlink()
    dataset = ScanNet(folder)
    assert [file.stem for file in dataset.info.files] == ["2", "9", "10", "11"]
    assert [round(frame.time_s * 30) for frame in dataset.frames()] == [2, 9, 10, 11]
    assert dataset.info.truth is not None
    np.testing.assert_allclose(dataset.info.truth.world_from_cam[1], true_pose(9), atol=1e-9)
    depth = dataset.true_depth(1)
    assert depth is not None
    np.testing.assert_allclose(depth[1::2, 1::2], counts(9, 1000)[1::2, 1::2] / 1000, rtol=1e-6)


def test_depth_of_scannet_is_looked_up_where_its_own_camera_saw_it(tmp_path: Path) -> None:
    """Its camera may be wider than the images, which a change of size would not know."""
    folder = write_layout("scannet", tmp_path, 1)
    wider = np.eye(4)
    wider[:3, :3] = resize_intrinsics(true_intrinsics(), SIZE, (36, 64))
    wider[:2, :2] *= 0.8
    np.savetxt(folder / "intrinsic" / "intrinsic_depth.txt", wider)
    directions = rays(wider[:3, :3], 36, 64)
    stored = np.rint(1000 * (3 + directions[..., 0] + 0.5 * directions[..., 1])).astype(np.uint16)
    write_png(folder / "depth" / "0.png", stored)
    depth = ScanNet(folder).true_depth(0)
    assert depth is not None
    seen = rays(true_intrinsics(), *SIZE)
    half_a_pixel = 0.5 / wider[0, 0] + 0.25 / wider[1, 1] + 1e-3
    np.testing.assert_allclose(depth, 3 + seen[..., 0] + 0.5 * seen[..., 1], atol=half_a_pixel)
    wider[:2, :2] *= 2  # now it is narrower
    np.savetxt(folder / "intrinsic" / "intrinsic_depth.txt", wider)
    depth = ScanNet(folder).true_depth(0)
    assert depth is not None
    assert np.isnan(depth[:, 0]).all()
    assert np.isfinite(depth[20:50, 40:90]).all()
    (folder / "intrinsic" / "intrinsic_depth.txt").unlink()
    taken = ScanNet(folder).true_depth(0)
    assert taken is not None
    np.testing.assert_allclose(taken[1::2, 1::2], stored / 1000, rtol=1e-6)


def test_rows_of_nan_are_no_poses_in_nrgbd(tmp_path: Path) -> None:
    folder = write_layout("nrgbd", tmp_path, NUM)
    rows = np.loadtxt(folder / "poses.txt")
    rows[4:8] = np.nan
    np.savetxt(folder / "poses.txt", rows)
    truth = Nrgbd(folder).info.truth
    assert truth is not None
    assert list(truth.frames) == [0, 2, 3]


def test_a_camera_of_sintel_that_zooms_is_told(tmp_path: Path) -> None:
    folder = write_layout("sintel", tmp_path, NUM)
    assert "zoom" not in Sintel(folder).info.intrinsics_source
    path = tmp_path / "training" / "camdata_left" / "alley_2" / "frame_0002.cam"
    data = bytearray(path.read_bytes())
    data[4:12] = np.float64(1.1 * true_intrinsics()[0, 0]).tobytes()
    path.write_bytes(bytes(data))
    assert "zooms by 10.0 %" in Sintel(folder).info.intrinsics_source


def test_the_background_of_sintel_has_no_depth(tmp_path: Path) -> None:
    folder = write_layout("sintel", tmp_path, 2)
    path = tmp_path / "training" / "depth" / "alley_2" / "frame_0001.dpt"
    data = bytearray(path.read_bytes())
    data[12:20] = np.array([1e10, 0], "<f4").tobytes()
    path.write_bytes(bytes(data))
    depth = Sintel(folder).true_depth(0)
    assert depth is not None
    assert np.isnan(depth[0, :2]).all()
    assert np.isfinite(depth[0, 2:]).all()


def test_waymo_has_five_cameras_of_which_one_is_read(tmp_path: Path) -> None:
    folder = write_layout("waymo", tmp_path, NUM)
    for frame in range(NUM):
        shutil.copy(folder / f"{frame:05d}_1.npz", folder / f"{frame:05d}_2.npz")
    left = Waymo(folder, camera=2)
    assert left.info.name.endswith("-front-left")
    assert left.true_depth(0) is None
    image = next(left.frames()).image
    assert image is not None
    assert np.abs(image[:, ::-1].astype(int) - view(0)[0]).mean() < 2


def test_kitti_depth_uses_the_images_that_have_depth(root: Path) -> None:
    dataset = opened("kitti-depth", root)
    assert dataset.info.files[0].stem == f"{FIRST_DEPTH:010d}"
    assert next(dataset.frames()).time_s == pytest.approx(FIRST_DEPTH / 10)


def test_a_folder_that_is_no_drive_of_kitti_depth_is_told_so_before_its_images_are_missed(
    tmp_path: Path,
) -> None:
    folder = write_layout("kitti-depth", tmp_path, NUM)
    with pytest.raises(DatasetError, match=r"no depth maps in .*val/proj_depth.*; give a drive"):
        KittiDepth(folder.parent)


def test_kitti_depth_finds_the_raw_images_where_people_keep_them(tmp_path: Path) -> None:
    folder = write_layout("kitti-depth", tmp_path, NUM)
    day = tmp_path / "raw" / folder.name[:10]
    images = Path("image_02") / "data"
    elsewhere = shutil.copytree(day, tmp_path / "elsewhere" / day.name).parent
    shutil.move(day / folder.name, tmp_path / "raw" / folder.name)  # without the day
    assert KittiDepth(folder).info.intrinsics is None
    assert KittiDepth(folder, raw=elsewhere).info.intrinsics is not None
    shutil.move(tmp_path / "raw" / folder.name / images, folder / images)  # in the same tree
    assert KittiDepth(folder).info.files[0].parent == folder / images
    gathered = tmp_path / "val_selection_cropped"
    name = f"{folder.name}_02"
    depth = folder / "proj_depth" / "groundtruth" / "image_02"
    shutil.copytree(depth, gathered / "groundtruth_depth_gathered" / name)
    shutil.copytree(folder / images, gathered / "image_gathered" / name)
    for twin in ("groundtruth_depth_gathered", "image_gathered"):
        dataset = KittiDepth(gathered / twin / name)
        assert dataset.info.num_frames == NUM
        assert dataset.true_depth(0) is not None


# By OpenEXR's own library, deflated: 18 x 5 pixels, 0 but for (0, 1): 1.5 and (17, 4): -70.25.
OFFICIAL = {
    "zip, single": (
        "c-n<eyGlbr5Iw5~ETX6>^dkggDhok0g{5E<(kPp~liY#L?y|eYn?`(ohpm5LtAF4pxqB1H)y9DXhdF1?"
        "%*>9C#To!rN@GZeL^OwpPU;Pjm0V&8C_8nYLSSot@hq+vGRgs)!rozIs~%$qtJ+A|O(-}xE$9FGG#k3|"
        "1^EW6PjFn3J`avmyq1wI#@fnQ&jAl-L3tvxi0_k$X>8UTW3#cMX&G=4%Rdou?g$}zHWO^serfU%Je3o|"
        "g;=CWu}a)esBTnQx|8qj``7*D;nQ;q_-Ma9=HK>~@+VGjyDtaZ0<W!3{|Bx{Sv>"
    ),
    "zips, half": (
        "c-n=LJ5Iwu5J1N!KrjRn(Q*b5IRGDV0Hib#<>H+rBW-pq@5&?{C1>CaoPmN9P~-#@oFD}yjy;l1reLJe"
        "8@-+V7Z;aN3;^j&S&PP(g&`l{v~&*;K^+k%q;8(&=sh|6r``<4S_L&GtKAbky2X&74^4E+9F(caXGSgm"
        "?K5QYKG&GHs_F<CEzsQh4AU@DfgDVXQ=ys%@O<sl9MRUx-=PiVv|>1cZflEn%b0YSZ7mU&8G;Wv*(vm@"
        "eq}d@pt+hNeDI^JnBUAFW)jytW1cf_m?NfU7R(psEAx%{&irJ4G1qZ(qol@F^IHkDBNk>yn2s>J!t4pN"
        "FHBdM17Q+j4uv@qrYFp?Fek$Fg&Axaz4`@jl2`W"
    ),
    "plain": (
        "c-n=Ky-ve05P&aDf$~#mq2e(><OM3k#sCsa#b}aCYvkHdY?XGa7?^kl1|FnBeGCR3gMo>}InjXNILZ1>"
        "{_f5{ljD=10RZtxXpPDiiIUdAL9urYr70tz1+f`tIa(`?{+4^02qy+oC*}@r%ruhFfmJk%)h&yp&6Jq^"
        "Tc@PP%RIrnmibdMIYo79GmPDpaMD1kjBvgWVBWWJj;O2gXQ*A#Hi=Sb)sCo_3}oU)KSsD&hG1PT^$^;="
        "Ug+`?ax8`j%b=R_M*JWi(q~1)3*s&Df%r^Z5MPP!#Qm`15%HXu67Pvm;p#=buk58?d#L}g9{e5+#)XV)"
        "GH#7=>x|oAT#Ip=jN4+|Hsf{}*Jj)<<MtTWVO;kwH-B7y0x<bm0s"
    ),
    "piz": (
        "c-rkwF^U2~5Udpg6T#yiA{v^A+yf3S5yNq(bsNT>VW#mk^8r3ee3`TBajqstW)>6_UDegS9gd0)fU+_o"
        "<Wd%nlj1Ya7O0&X#UD}nO^B2dd%4rK*|kQ^oW=TIEd6fG7~qC(=0~RG6r9;V%{dnOj+SCeH7^9-k(;GJ"
        "rT!RYkCpRAn?2w#O=TpKYyB6A=C$p3g<k7KJ2Gdh)kB5u10iW-S)<?Njnq%@#;ggG;?`9C>(dl(ybg!s"
        "`2wc7P9g"
    ),
}


def official(name: str, folder: Path) -> Path:
    path = folder / "depth.exr"
    path.write_bytes(zlib.decompress(base64.b85decode(OFFICIAL[name])))
    return path


@pytest.mark.parametrize(("key", "reader"), [("bonn", TumRgbd), ("tum-rgbd", Bonn)])
def test_a_sequence_of_bonn_is_none_of_tum_and_none_the_other_way(
    key: str, reader: type[TumRgbd | Bonn], tmp_path: Path
) -> None:
    """They have the same files, but another camera and poses of another place on it."""
    folder = write_layout(key, tmp_path, NUM)
    with pytest.raises(DatasetError, match=f"by its name; read it with 'laser-slam {key}'"):
        reader(folder)
    assert reader(folder.rename(tmp_path / "mine")).info.num_frames == NUM


@pytest.mark.parametrize("name", [name for name in OFFICIAL if name != "piz"])
def test_exr_files_of_the_official_library_are_read(name: str, tmp_path: Path) -> None:
    expected = np.zeros((18, 5), np.float32)
    expected[0, 1], expected[17, 4] = 1.5, -70.25
    np.testing.assert_array_equal(read_exr(official(name, tmp_path), ""), expected)


def test_another_compression_of_exr_is_refused_by_its_number(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"depth.exr is no OpenEXR .*compression is number 4"):
        read_exr(official("piz", tmp_path), "mend it")


@pytest.mark.parametrize("height", [1, 15, 16, 40])
def test_what_is_written_as_exr_is_read(height: int, tmp_path: Path) -> None:
    noise = np.random.default_rng(height).normal(size=(height, 7)).astype(np.float32)
    for name, pixels in {"noise": noise, "zeros": np.zeros_like(noise)}.items():
        write_exr(tmp_path / f"{name}.exr", pixels, top=height - 16)
        np.testing.assert_array_equal(read_exr(tmp_path / f"{name}.exr", ""), pixels)
