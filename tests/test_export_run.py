"""A finished run in the formats of other programs, read back by programs that are not ours."""

import gzip
import json
import logging
import os
import resource
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import laspy
import numpy as np
import pycolmap
import pytest
import trimesh
from corridor import DISTANCES, NORMALS, true_pose
from evo.tools import file_interface
from numpy.typing import NDArray
from photographed import (
    DISTORTION,
    LENS,
    NO_BEND,
    SIZE,
    UNIT_M,
    LensBend,
    PhotographedCorridor,
    TrueEye,
    hit,
    lens_rays,
    true_trajectory,
    world_from_metres,
)
from PIL import Image as Pillow
from plyfile import PlyData
from quick_runs import leave_pictures_out
from scipy.spatial import cKDTree
from typer.testing import CliRunner

import laser_slam.export.mesh
from laser_slam import dependencies
from laser_slam.camera import intrinsics_matrix
from laser_slam.cli import app
from laser_slam.config import load_config
from laser_slam.dependencies import import_open3d
from laser_slam.errors import (
    ConfigError,
    DatasetError,
    DependencyError,
    LaserSlamError,
    RunFolderError,
)
from laser_slam.export import FORMATS, Camera, Photo, Photos, Source, find_writer
from laser_slam.export.colmap import export_colmap
from laser_slam.export.mesh import build_mesh
from laser_slam.export.nerfstudio import export_nerfstudio
from laser_slam.exporting import ExportOptions, PhotoKind, export_run
from laser_slam.exporting.run import open_run
from laser_slam.pipeline import Pipeline
from laser_slam.sim3 import Sim3, rotation_exp
from laser_slam.store.keyframes import IMAGES_FILE, load_keyframes, save_originals

Array = NDArray[np.float64]

NUM_FRAMES = 24
CONFIG = load_config(
    assignments=[
        "windows.size=8",
        "windows.overlap=3",
        "windows.min_parallax_px=0.2",
        "fusion.voxel_size=0.02",
        "fusion.min_observations=1",
        "closures.enabled=false",
    ]
)


def run_over(
    folder: Path, photos: Path | None, eye: TrueEye, monkeypatch: pytest.MonkeyPatch
) -> Path:
    leave_pictures_out(monkeypatch)
    dataset = PhotographedCorridor(photos, NUM_FRAMES, eye.distortion)
    if photos is not None:
        dataset.write_files()
    Pipeline(dataset, CONFIG, folder, backbone=eye).run()
    calibration = eye.calibrate([], None)
    save_originals(folder, dataset.info, calibration)
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Map the corridor once, photographed by a lens that bends."""
    folder = tmp_path_factory.mktemp("corridor")
    with pytest.MonkeyPatch.context() as patch:
        return run_over(folder / "run", folder / "photos", TrueEye(), patch)


@pytest.fixture(scope="module")
def pinhole_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Map the corridor as a lens sees it that bends nothing; the images are not in files."""
    folder = tmp_path_factory.mktemp("pinhole")
    with pytest.MonkeyPatch.context() as patch:
        return run_over(folder / "run", None, TrueEye(distortion=NO_BEND), patch)


@pytest.fixture(scope="module")
def blind_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Map with a backbone that trusts none of what it sees: the map is empty."""
    folder = tmp_path_factory.mktemp("blind")
    with pytest.MonkeyPatch.context() as patch:
        return run_over(folder / "run", None, TrueEye(confidence=0.1), patch)


def export(run: Path, name: str, out: Path, **options: object) -> Path:
    (path,) = export_run(run, [name], out / name, ExportOptions(**options))  # type: ignore[arg-type]
    return path


def the_map(run: Path) -> tuple[Array, NDArray[np.uint8]]:
    cloud = import_open3d().t.io.read_point_cloud(str(run / "map.ply")).point
    order = np.lexsort(cloud["positions"].numpy().T)
    return cloud["positions"].numpy()[order], cloud["colors"].numpy()[order]


def assert_same_points(
    las: laspy.LasData, points: Array, colors: NDArray[np.uint8], off: float
) -> None:
    """Hold each point, with its colour, to the one of a map that it is; in whatever order."""
    distance, rows = cKDTree(las.xyz).query(points)
    assert sorted(rows) == list(range(len(las.xyz)))  # each is one of the map, and all are there
    assert distance.max() < np.sqrt(3) * off
    found = np.stack([las.red, las.green, las.blue], axis=1)
    np.testing.assert_array_equal(found[rows], colors.astype(np.uint16) * 257)


def off_the_walls(points: Array) -> Array:
    """Return how far points of the world are from the corridor, in metres."""
    metres = world_from_metres().inverse().apply(points)
    return np.asarray(np.abs(metres @ NORMALS.T - DISTANCES).min(axis=1))


def some_pixels(distortion: LensBend, frame: int) -> tuple[Array, Array]:
    """Return some pixels (x, y) of a photograph, and the points of the world that they show."""
    points, _ = hit(lens_rays(distortion), true_pose(frame))
    v, u = np.meshgrid(np.arange(3, SIZE[0], 13), np.arange(5, SIZE[1], 17), indexing="ij")
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
    return pixels, world_from_metres().apply(points[v.ravel(), u.ravel()])


# --- clouds -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["ply", "pcd"])
def test_open3d_reads_the_map_back(run: Path, tmp_path: Path, name: str) -> None:
    path = export(run, name, tmp_path)
    path = path.rename(path.with_suffix(f".{name}"))
    cloud = import_open3d().t.io.read_point_cloud(str(path)).point
    points, colors = the_map(run)
    order = np.lexsort(cloud["positions"].numpy().T)
    np.testing.assert_array_equal(cloud["positions"].numpy()[order], points)
    np.testing.assert_array_equal(cloud["colors"].numpy()[order], colors)
    normals = cloud["normals"].numpy()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-2)
    assert (cloud["weight"].numpy() > 0).all()


def test_plyfile_reads_the_map_back(run: Path, tmp_path: Path) -> None:
    vertex = PlyData.read(str(export(run, "ply", tmp_path)))["vertex"]
    points = np.stack([vertex["x"], vertex["y"], vertex["z"]], axis=1)
    assert np.median(off_the_walls(points)) < 0.01
    assert {"red", "green", "blue", "nx", "ny", "nz", "weight"} <= set(vertex.data.dtype.names)


def test_text_holds_positions_colours_and_normals(run: Path, tmp_path: Path) -> None:
    plain = export(run, "xyz", tmp_path)
    packed = export(run, "xyz.gz", tmp_path)
    assert gzip.decompress(packed.read_bytes()) == plain.read_bytes()
    table = np.loadtxt(plain)
    vertex = PlyData.read(str(export(run, "ply", tmp_path)))["vertex"]
    names = ["x", "y", "z", "red", "green", "blue", "nx", "ny", "nz"]
    expected = np.stack([vertex[name] for name in names], axis=1)
    np.testing.assert_allclose(table, expected, atol=6e-5)
    cloud = import_open3d().io.read_point_cloud(str(plain), format="xyz")
    assert len(cloud.points) == len(table)


@pytest.mark.parametrize("name", ["las", "laz"])
def test_laspy_reads_the_map_back(run: Path, tmp_path: Path, name: str) -> None:
    las = laspy.read(export(run, name, tmp_path))
    assert las.header.scales.max() <= 1e-3
    assert_same_points(las, *the_map(run), off=las.header.scales[0])
    assert las.header.are_points_compressed == (name == "laz")
    assert las.header.parse_crs() is None


def test_a_georeferenced_map_keeps_millimetres_far_from_the_origin(
    run: Path, tmp_path: Path
) -> None:
    world_to_utm = Sim3(
        UNIT_M, rotation_exp(np.array([np.pi / 2, 0, 0])), np.array([691e3, 5.334e6, 520.0])
    )
    matrix = tmp_path / "utm.txt"
    np.savetxt(matrix, world_to_utm.matrix())
    las = laspy.read(export(run, "laz", tmp_path, georeference=matrix, crs="EPSG:32632"))
    points, colors = the_map(run)
    assert_same_points(las, world_to_utm.apply(points.astype(np.float64)), colors, off=1e-3)
    crs = las.header.parse_crs()
    assert crs is not None
    assert crs.to_epsg() == 32632


def test_positions_by_time_georeference_a_map(run: Path, tmp_path: Path) -> None:
    world_to_utm = Sim3(3.0, rotation_exp(np.array([1.6, 0.2, 0])), np.array([4e5, 5e6, 100.0]))
    truth = true_trajectory(NUM_FRAMES)
    positions = world_to_utm.apply(truth.world_from_cam[:, :3, 3])
    table = tmp_path / "gps.txt"
    np.savetxt(table, np.column_stack([truth.times_s, positions])[::2], fmt="%.6f")
    las = laspy.read(export(run, "las", tmp_path, georeference=table))
    expected = world_to_utm.apply(the_map(run)[0].astype(np.float64))
    np.testing.assert_allclose(las.xyz.mean(axis=0), expected.mean(axis=0), atol=0.02)
    assert las.header.parse_crs() is None


# --- trajectories -------------------------------------------------------------------------------


def test_evo_reads_the_trajectories(run: Path, tmp_path: Path) -> None:
    truth = true_trajectory(NUM_FRAMES)
    tum = file_interface.read_tum_trajectory_file(export(run, "tum", tmp_path))
    euroc = file_interface.read_euroc_csv_trajectory(export(run, "euroc", tmp_path))
    kitti = file_interface.read_kitti_poses_file(export(run, "kitti", tmp_path))
    for read in (tum, euroc, kitti):
        np.testing.assert_allclose(read.poses_se3, truth.world_from_cam, atol=2e-3)
    np.testing.assert_allclose(euroc.timestamps, truth.times_s, atol=1e-9)


def test_a_run_without_closures_has_no_graph_to_export(run: Path, tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match=r"no pose graph: .*closures.enabled=false"):
        export(run, "g2o", tmp_path)
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    (copy / "graph.g2o").write_text("VERTEX_SIM3:EXPMAP 0\n")
    assert export(copy, "g2o", tmp_path).read_text() == "VERTEX_SIM3:EXPMAP 0\n"


# --- Gaussian splatting -------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["colmap", "colmap-text"])
def test_pycolmap_projects_what_the_photographs_show(run: Path, tmp_path: Path, name: str) -> None:
    folder = export(run, name, tmp_path)
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    keyframes = load_keyframes(run).frames
    assert len(model.images) == len(keyframes)
    (camera,) = model.cameras.values()
    assert camera.model == pycolmap.CameraModelId.OPENCV
    assert (camera.height, camera.width) == SIZE
    names = {image.name: image for image in model.images.values()}
    assert set(names) == {f"shot-{frame}.png" for frame in keyframes}
    for frame in (int(keyframes[0]), int(keyframes[-1])):
        pixels, points = some_pixels(DISTORTION, frame)
        image = names[f"shot-{frame}.png"]
        cam_from_world = image.cam_from_world().matrix()
        found = camera.img_from_cam(points @ cam_from_world[:, :3].T + cam_from_world[:, 3])
        np.testing.assert_allclose(found, pixels + 0.5, atol=0.1)
        original = run.parent / "photos" / image.name
        assert (folder / "images" / image.name).read_bytes() == original.read_bytes()


def test_the_points_of_a_colmap_model_lie_where_the_photographs_have_their_colour(
    run: Path, tmp_path: Path
) -> None:
    folder = export(run, "colmap", tmp_path, assignments=("export.max_points=2000",))
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    points = np.stack([point.xyz for point in model.points3D.values()])
    colors = np.stack([point.color for point in model.points3D.values()]).astype(int)
    assert 1000 <= len(points) <= 2000
    (camera,) = model.cameras.values()
    frame = int(load_keyframes(run).frames[3])
    (image,) = (one for one in model.images.values() if one.name == f"shot-{frame}.png")
    cam_from_world = image.cam_from_world().matrix()
    in_cam = points @ cam_from_world[:, :3].T + cam_from_world[:, 3]
    shown = np.asarray(Pillow.open(folder / "images" / image.name)).astype(int)
    is_ahead = in_cam[:, 2] > 0.1
    pixels = np.floor(camera.img_from_cam(in_cam[is_ahead])).astype(int)
    is_in = ((pixels >= 0) & (pixels < SIZE[::-1])).all(axis=1)
    seen = shown[pixels[is_in, 1], pixels[is_in, 0]]
    assert is_in.sum() > 300
    assert np.median(np.abs(seen - colors[is_ahead][is_in])) < 8
    depth = hit(lens_rays(DISTORTION), true_pose(frame))[1] / UNIT_M
    there = depth[pixels[is_in, 1], pixels[is_in, 0]]
    ratio = in_cam[is_ahead][is_in][:, 2] / there
    assert np.median(np.abs(ratio - 1)) < 0.02


@pytest.mark.parametrize("kind", [PhotoKind.ORIGINAL, PhotoKind.UNDISTORTED, PhotoKind.STORED])
def test_transforms_project_what_the_images_show(
    run: Path, tmp_path: Path, kind: PhotoKind
) -> None:
    folder = export(run, "nerfstudio", tmp_path, photos=kind)
    content = json.loads((folder / "transforms.json").read_text())
    K = np.array(
        [[content["fl_x"], 0, content["cx"]], [0, content["fl_y"], content["cy"]], [0, 0, 1]]
    )
    lens = np.array([content[name] for name in ("k1", "k2", "p1", "p2")])
    assert lens.any() == (kind is PhotoKind.ORIGINAL)
    frame = int(load_keyframes(run).frames[-1])
    entry = content["frames"][-1]
    shown = np.asarray(Pillow.open(folder / entry["file_path"])).astype(int)
    assert shown.shape[:2] == (content["h"], content["w"])
    world_from_gl = np.array(entry["transform_matrix"])
    pixels, points = some_pixels(DISTORTION, frame)
    in_gl = np.linalg.inv(world_from_gl) @ np.column_stack([points, np.ones(len(points))]).T
    assert (in_gl[2] < 0).all()  # OpenGL looks along -z
    in_cv = in_gl[:3].T * [1, -1, -1]
    found = cv2.projectPoints(in_cv, np.zeros(3), np.zeros(3), K, lens)[0][:, 0]
    if kind is PhotoKind.ORIGINAL:
        np.testing.assert_allclose(found, pixels + 0.5, atol=0.1)
    is_in = ((found > 2) & (found < np.array(shown.shape[1::-1]) - 2)).all(axis=1)
    rows = np.floor(found[is_in]).astype(int)
    photo = np.asarray(Pillow.open(run.parent / "photos" / f"shot-{frame}.png")).astype(int)
    truth = photo[pixels[is_in, 1].astype(int), pixels[is_in, 0].astype(int)]
    assert is_in.sum() > 40
    assert np.median(np.abs(shown[rows[:, 1], rows[:, 0]] - truth)) < 8
    cloud = import_open3d().io.read_point_cloud(str(folder / content["ply_file_path"]))
    assert cloud.has_colors()
    assert np.median(off_the_walls(np.asarray(cloud.points))) < 0.01


def test_a_lens_that_bends_nothing_is_a_pinhole(pinhole_run: Path, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    PhotographedCorridor(photos, NUM_FRAMES, NO_BEND).write_files()
    folder = export(pinhole_run, "colmap", tmp_path, photos_from=photos)
    (camera,) = pycolmap.Reconstruction(str(folder / "sparse" / "0")).cameras.values()
    assert camera.model == pycolmap.CameraModelId.PINHOLE
    K = [LENS[0, 0], LENS[1, 1], LENS[0, 2] + 0.5, LENS[1, 2] + 0.5]
    np.testing.assert_allclose(camera.params, K, atol=1e-6)


def test_a_run_that_knows_no_files_exports_what_it_keeps_and_says_so(
    pinhole_run: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        folder = export(pinhole_run, "nerfstudio", tmp_path)
    assert "the small ones that it keeps" in caplog.text
    content = json.loads((folder / "transforms.json").read_text())
    assert (content["h"], content["w"]) == (72, 128)
    assert len(list((folder / "images").iterdir())) == len(content["frames"])


def test_linked_images_are_links_to_the_originals(run: Path, tmp_path: Path) -> None:
    folder = export(run, "nerfstudio", tmp_path, photos=PhotoKind.LINKED)
    first = folder / "images" / "shot-0.png"
    assert first.is_symlink()
    assert first.resolve() == (run.parent / "photos" / "shot-0.png").resolve()


def test_a_video_gives_its_keyframes(run: Path, tmp_path: Path) -> None:
    video = tmp_path / "drive.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 10, SIZE[::-1])
    frames = [frame.image for frame in PhotographedCorridor(None, NUM_FRAMES).frames()]
    for image in frames:
        assert image is not None
        writer.write(image[..., ::-1])
    writer.release()
    folder = export(run, "nerfstudio", tmp_path, photos_from=video)
    frame = int(load_keyframes(run).frames[5])
    shown = np.asarray(Pillow.open(folder / "images" / f"{frame:06d}.jpg")).astype(int)
    assert np.median(np.abs(shown - frames[frame])) < 6


def test_images_that_exif_data_turns_come_out_upright(pinhole_run: Path, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    exif = Pillow.Exif()
    exif[0x0112] = 6  # stored a quarter turn to the left
    upright = [frame.image for frame in PhotographedCorridor(None, NUM_FRAMES, NO_BEND).frames()]
    for index, image in enumerate(upright):
        assert image is not None
        stored = Pillow.fromarray(np.ascontiguousarray(np.rot90(image)))
        stored.save(photos / f"{index}.jpg", exif=exif, quality=95)
    folder = export(pinhole_run, "nerfstudio", tmp_path, photos_from=photos)
    content = json.loads((folder / "transforms.json").read_text())
    frame = int(load_keyframes(pinhole_run).frames[-1])
    shown = np.asarray(Pillow.open(folder / content["frames"][-1]["file_path"])).astype(int)
    assert shown.shape[:2] == (content["h"], content["w"]) == SIZE
    assert np.median(np.abs(shown - upright[frame])) < 5


def test_each_image_names_its_camera_where_there_are_several(run: Path, tmp_path: Path) -> None:
    cameras = [Camera((40, 60), intrinsics_matrix(f, f, 30, 20), np.zeros(4)) for f in (50, 60)]
    shots = [Photo(f"{i}.png", i, i % 2, np.eye(4)) for i in range(4)]
    source = replace(
        open_run(run, ExportOptions()),
        photos=lambda: Photos(cameras, shots, lambda folder: (folder / "0.png").touch()),
    )
    export_colmap(tmp_path / "colmap", source)
    model = pycolmap.Reconstruction(str(tmp_path / "colmap" / "sparse" / "0"))
    focals = {image.name: image.camera.params[0] for image in model.images.values()}
    assert focals == {"0.png": 50, "1.png": 60, "2.png": 50, "3.png": 60}
    export_nerfstudio(tmp_path / "nerfstudio", source)
    content = json.loads((tmp_path / "nerfstudio" / "transforms.json").read_text())
    assert [frame["fl_x"] for frame in content["frames"]] == [50, 60, 50, 60]
    assert "fl_x" not in content


@pytest.mark.parametrize("name", ["colmap", "colmap-text"])
def test_colmap_finds_images_whose_names_it_cannot_say(
    run: Path, tmp_path: Path, name: str
) -> None:
    cameras = [Camera((40, 60), intrinsics_matrix(50, 50, 30, 20), np.zeros(4))]
    names = ["my drive 1.jpg", "my_drive_1.jpg", "\tb.jpg", os.fsdecode(b"caf\xe9.jpg"), "Ü.jpg"]
    shots = [Photo(name, i, 0, np.eye(4)) for i, name in enumerate(names)]

    def save(folder: Path) -> None:
        for shot in shots:
            (folder / shot.name).write_text(str(shot.frame))

    source = replace(open_run(run, ExportOptions()), photos=lambda: Photos(cameras, shots, save))
    find_writer(name)(tmp_path / "out", source)
    model = pycolmap.Reconstruction(str(tmp_path / "out" / "sparse" / "0"))
    images = tmp_path / "out" / "images"
    found = {number: (images / one.name).read_text() for number, one in model.images.items()}
    assert found == {1: "0", 2: "1", 3: "2", 4: "3", 5: "4"}
    assert len(list(images.iterdir())) == len(names)
    assert (images / "Ü.jpg").exists()


# --- depth --------------------------------------------------------------------------------------


def test_depth_images_are_the_depth_of_the_corridor(run: Path, tmp_path: Path) -> None:
    folder = export(run, "depth", tmp_path)
    content = json.loads((folder / "frames.json").read_text())
    per_unit = content["counts_per_unit"]
    assert per_unit == 1000.0
    entry = content["frames"][-1]
    counts = np.asarray(Pillow.open(folder / entry["depth"]))
    assert counts.dtype == np.uint16
    v, u = np.nonzero(counts)
    z = counts[v, u] / per_unit
    x = (u - entry["cx"]) / entry["fx"] * z
    y = (v - entry["cy"]) / entry["fy"] * z
    world_from_cam = np.array(entry["world_from_cam"])
    points = np.stack([x, y, z], axis=1) @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
    assert len(points) == counts.size
    assert np.quantile(off_the_walls(points), 0.9) < 0.02
    confidence = np.asarray(Pillow.open(folder / entry["confidence"]))
    assert confidence.shape == counts.shape
    assert np.unique(confidence).tolist() == [230]
    assert Pillow.open(folder / entry["image"]).size == counts.shape[::-1]


def test_depth_arrays_are_the_depth_of_the_corridor(run: Path, tmp_path: Path) -> None:
    folder = export(run, "depth-npz", tmp_path)
    keyframes = load_keyframes(run).frames
    assert len(list(folder.glob("*.npz"))) == len(keyframes)
    with np.load(folder / f"{keyframes[-1]:06d}.npz") as view:
        K, depth = view["intrinsics"], view["depth"]
        v, u = np.nonzero(np.isfinite(depth))
        pixels = np.stack([u, v, np.ones(len(u))])
        in_cam = (np.linalg.inv(K) @ pixels) * depth[v, u]
        points = (view["world_from_cam"] @ np.vstack([in_cam, np.ones(len(u))]))[:3].T
    assert np.quantile(off_the_walls(points), 0.9) < 0.02


# --- meshes -------------------------------------------------------------------------------------


def test_the_mesh_is_the_surface_of_the_corridor(run: Path, tmp_path: Path) -> None:
    mesh = trimesh.load(export(run, "mesh-ply", tmp_path), file_type="ply", process=False)
    assert len(mesh.faces) > 5000
    assert np.quantile(off_the_walls(mesh.vertices), 0.9) < 0.02 * UNIT_M
    metres_from_world = world_from_metres().inverse()
    wall = np.abs(metres_from_world.apply(mesh.triangles_center) @ NORMALS.T - DISTANCES)
    inwards = -NORMALS[wall.argmin(axis=1)] @ metres_from_world.rotation
    assert (np.einsum("ij,ij->i", mesh.face_normals, inwards) > 0).mean() > 0.98
    assert mesh.visual.vertex_colors[:, :3].std(axis=0).min() > 10


def test_a_mesh_of_many_tiles_is_the_mesh_of_one(run: Path, tmp_path: Path) -> None:
    meshes = []
    for size in (32, 4096):
        path = tmp_path / f"{size}.ply"
        settings = ("export.mesh_voxel=4", f"export.mesh_tile={size}")
        options = ExportOptions(assignments=settings)
        export_run(run, ["mesh-ply"], path, options)
        meshes.append(trimesh.load(path, process=False))
    many, few = meshes
    assert len(few.vertices) == len(many.vertices)
    assert len(few.faces) == len(many.faces)

    def sorted_triangles(mesh: trimesh.Trimesh) -> Array:
        corners = np.asarray(mesh.triangles).reshape(-1, 9)
        return corners[np.lexsort(corners.T)]

    np.testing.assert_array_equal(sorted_triangles(few), sorted_triangles(many))


def test_trimesh_reads_the_glb_upright_and_coloured(run: Path, tmp_path: Path) -> None:
    options = ExportOptions(assignments=("export.mesh_voxel=4",))
    first, second = export_run(run, ["mesh-ply", "mesh-glb"], tmp_path / "out", options)
    ply = trimesh.load(first, process=False)
    (glb,) = trimesh.load(second, process=False).geometry.values()
    np.testing.assert_allclose(glb.vertices * [1, -1, -1], ply.vertices, atol=1e-6)
    np.testing.assert_array_equal(glb.faces, ply.faces)
    linear = np.asarray(glb.visual.vertex_attributes["color"], np.float64) / 65535
    curved = 1.055 * linear[:, :3] ** (1 / 2.4) - 0.055
    srgb = 255 * np.where(linear[:, :3] <= 0.0031308, 12.92 * linear[:, :3], curved)
    np.testing.assert_allclose(srgb, ply.visual.vertex_colors[:, :3], atol=0.1)
    assert (linear[:, 3] == 1).all()


def test_meshes_of_two_formats_are_built_once(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    built = []

    def count(source: Source) -> laser_slam.export.mesh.Mesh:
        built.append(source.name)
        return build_mesh(source)

    monkeypatch.setattr(laser_slam.export.mesh, "build_mesh", count)
    options = ExportOptions(assignments=("export.mesh_voxel=8",))
    export_run(run, ["mesh-glb", "mesh-ply"], tmp_path / "out", options)
    assert built == [str(run)]


# --- bad input ----------------------------------------------------------------------------------


def test_the_command_exports_several_formats_into_one_folder(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = ["export", str(run), "--to", "las", "--to", "tum", "--out", str(out)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in out.iterdir()) == ["map.las", "trajectory_tum.txt"]
    again = CliRunner().invoke(app, arguments)
    assert again.exit_code == 1
    assert "map.las is there already; replace it with --force" in again.output
    assert len(again.output.splitlines()) == 1
    assert CliRunner().invoke(app, [*arguments, "--force"]).exit_code == 0


def test_an_unknown_format_lists_the_known_ones(run: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no 'obj'; there is ply, .*depth-npz"):
        export_run(run, ["tum", "obj"], tmp_path)
    with pytest.raises(ConfigError, match="name a format"):
        export_run(run, [], tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["ply", "las", "xyz.gz", "mesh-glb"])
def test_an_empty_map_is_no_cloud(blind_run: Path, tmp_path: Path, name: str) -> None:
    with pytest.raises(RunFolderError, match="is empty: nothing was seen with confidence"):
        export(blind_run, name, tmp_path)
    assert not list(tmp_path.iterdir())


def test_an_empty_map_still_has_cameras(blind_run: Path, tmp_path: Path) -> None:
    folder = export(blind_run, "colmap", tmp_path)
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    assert len(model.points3D) == 0
    assert len(model.images) == len(load_keyframes(blind_run).frames)


def test_a_map_without_colours_becomes_grey_with_a_warning(
    run: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(run, copy, ignore=shutil.ignore_patterns("tiles"))
    open3d = import_open3d()
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.eye(3)))
    open3d.io.write_point_cloud(str(copy / "map.ply"), cloud)
    with caplog.at_level(logging.WARNING):
        las = laspy.read(export(copy, "las", tmp_path))
    assert "has no colours" in caplog.text
    assert set(np.asarray(las.green)) == {128 * 257}


@pytest.mark.parametrize("kept", [0, 30, 100_000])
def test_a_map_that_is_cut_short_is_damaged_not_smaller(
    run: Path, tmp_path: Path, kept: int
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(run, copy, ignore=shutil.ignore_patterns("tiles"))
    whole = laspy.read(export(copy, "las", tmp_path))
    assert len(whole.points) == len(the_map(run)[0])
    (copy / "map.ply").write_bytes((run / "map.ply").read_bytes()[:kept])
    with pytest.raises(RunFolderError, match=r"map.ply is damaged; run again"):
        export(copy, "ply", tmp_path)
    (copy / "map.ply").unlink()
    with pytest.raises(RunFolderError, match=r"map.ply is missing; run again"):
        export(copy, "ply", tmp_path)


@pytest.mark.parametrize("name", sorted(set(FORMATS) - {"g2o"}))
def test_no_space_leaves_nothing_behind(run: Path, tmp_path: Path, name: str) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    import_open3d()
    resource.setrlimit(resource.RLIMIT_FSIZE, (200, hard))
    try:
        with pytest.raises(RunFolderError, match=r"cannot write .*choose another folder"):
            export(run, name, tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["depth-npz", "tum"])
def test_a_failed_replacement_keeps_the_old_export(run: Path, tmp_path: Path, name: str) -> None:
    path = export(run, name, tmp_path)
    before = {p: p.read_bytes() for p in [path, *path.rglob("*")] if p.is_file()}
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200, hard))
    try:
        with pytest.raises(RunFolderError):
            export(run, name, tmp_path, force=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert {p: p.read_bytes() for p in [path, *path.rglob("*")] if p.is_file()} == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_is_no_export_is_never_replaced(run: Path, tmp_path: Path) -> None:
    (tmp_path / "depth").mkdir()
    (tmp_path / "depth" / "thesis.tex").write_text("years")
    for force, text in ((False, "is there already"), (True, "not made by an export")):
        with pytest.raises(RunFolderError, match=text):
            export(run, "depth", tmp_path, force=force)
    assert (tmp_path / "depth" / "thesis.tex").read_text() == "years"


def test_force_replaces_a_whole_folder(run: Path, tmp_path: Path) -> None:
    folder = export(run, "depth-npz", tmp_path)
    (folder / "left.txt").write_text("from before")
    export(run, "depth-npz", tmp_path, force=True)
    assert not (folder / "left.txt").exists()
    assert list(tmp_path.iterdir()) == [folder]


def test_a_file_in_the_place_of_a_folder_is_refused(run: Path, tmp_path: Path) -> None:
    (tmp_path / "colmap").write_text("mine")
    with pytest.raises(RunFolderError, match="is a file"):
        export(run, "colmap", tmp_path, force=True)


def test_the_empty_folder_that_one_is_in_becomes_the_export(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    export_run(run, ["depth-npz"], Path())
    assert len(list(Path().glob("*.npz"))) == len(load_keyframes(run).frames)
    assert list(tmp_path.iterdir()) == [here]
    export_run(run, ["depth-npz"], here, ExportOptions(force=True))


def test_an_unfinished_run_says_how_to_go_on(run: Path, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    (copy / "report.json").unlink()
    with pytest.raises(RunFolderError, match=r"not finished; its command with --out .* goes on"):
        export(copy, "las", tmp_path)
    with pytest.raises(RunFolderError, match="no run in"):
        export(tmp_path, "las", tmp_path)


@pytest.mark.parametrize("file", ["keyframes.npz", IMAGES_FILE])
def test_a_run_of_an_older_version_says_what_is_missing(
    run: Path, tmp_path: Path, file: str
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    (copy / file).write_bytes(b"")
    with pytest.raises(RunFolderError, match=rf"{file} is damaged: run again"):
        export(copy, "nerfstudio", tmp_path)
    (copy / file).unlink()
    with pytest.raises(RunFolderError, match=rf"no {file}: an older laser-slam made it"):
        export(copy, "nerfstudio", tmp_path)


def test_a_run_of_an_older_version_still_gives_its_map_and_path(run: Path, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(run, copy, ignore=shutil.ignore_patterns("tiles", "images.json"))
    (copy / "keyframes.npz").unlink()
    out = tmp_path / "out"
    names = ["tum", "kitti", "ply"]
    for path, same in zip(
        export_run(copy, names, out), export_run(run, names, tmp_path / "new"), strict=True
    ):
        assert len(path.read_bytes()) == len(same.read_bytes()) > 0
    for name in ("depth", "depth-npz", "mesh-ply"):
        with pytest.raises(RunFolderError, match=r"no keyframes.npz: an older laser-slam made it"):
            export_run(copy, ["tum", name], tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_missing_originals_are_named_before_anything_is_written(run: Path, tmp_path: Path) -> None:
    options = ExportOptions(photos_from=tmp_path)
    with pytest.raises(DatasetError, match=r"no original image .*shot-0.png and \d+ more; pass"):
        export_run(run, ["tum", "las", "nerfstudio"], tmp_path / "out", options)
    assert not list(tmp_path.iterdir())


def test_a_missing_extra_says_how_to_get_it(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dependencies.import_laspy.cache_clear()
    monkeypatch.setitem(sys.modules, "lazrs", None)
    with pytest.raises(DependencyError, match=r"pip install 'laser-slam\[las\]'"):
        export_run(run, ["tum", "laz"], tmp_path)
    assert not list(tmp_path.iterdir())
    dependencies.import_laspy.cache_clear()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("1 2 3\n", "must hold a 4x4 matrix"),
        ("hello\n", "is no table of numbers"),
        ("2 0 0 1\n0 3 0 1\n0 0 2 1\n0 0 0 1\n", "places no map"),
        ("100 0 0 0\n101 1 0 0\n102 2 0 1\n", "0 positions in the time of the run"),
    ],
)
def test_a_bad_georeference_is_refused(run: Path, tmp_path: Path, text: str, reason: str) -> None:
    file = tmp_path / "geo.txt"
    file.write_text(text)
    with pytest.raises(DatasetError, match=reason):
        export(run, "las", tmp_path, georeference=file)


def test_a_coordinate_system_needs_a_place(run: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="add --georeference"):
        export(run, "las", tmp_path, crs="EPSG:32632")
    np.savetxt(tmp_path / "geo.txt", np.eye(4))
    with pytest.raises(ConfigError, match="no coordinate system 'EPSG:1'"):
        export(run, "las", tmp_path, georeference=tmp_path / "geo.txt", crs="EPSG:1")
    with pytest.raises(ConfigError, match="places clouds only"):
        export(run, "colmap", tmp_path, georeference=tmp_path / "geo.txt")


@pytest.mark.parametrize("name", ["las", "ply"])
@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:4978"])
def test_degrees_and_geocentric_coordinates_are_no_place_for_a_map(
    run: Path, tmp_path: Path, name: str, crs: str
) -> None:
    np.savetxt(tmp_path / "geo.txt", np.eye(4))
    with pytest.raises(ConfigError, match=rf"'{crs}' \(WGS 84\) is not projected"):
        export(run, name, tmp_path, georeference=tmp_path / "geo.txt", crs=crs)
    assert [path.name for path in tmp_path.iterdir()] == ["geo.txt"]


def test_every_format_has_a_writer_that_is_there() -> None:
    for name in FORMATS:
        assert callable(find_writer(name))
    assert len({item.target for item in FORMATS.values()}) == len(FORMATS)
    assert issubclass(ConfigError, LaserSlamError)
