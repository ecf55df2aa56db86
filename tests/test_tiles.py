"""Tiles change nothing but memory; a map is mended where something changed, and only there."""

import json
import resource
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from submaps import EVERYTHING, submap_of, wavy_depth

from laser_slam.config import FusionConfig
from laser_slam.errors import RunFolderError
from laser_slam.fusion import Part, TiledMap, Update, fuse
from laser_slam.fusion.grid import VoxelGrid
from laser_slam.sim3 import Sim3, rotation_exp
from laser_slam.store import TileFiles
from laser_slam.types import Cloud, Submap

# Coarse voxels and support: neighbours across the faces, edges and corners of tiles matter.
CONFIG = EVERYTHING.model_copy(update={"voxel_size": 0.08, "min_observations": 4, "tile_bits": 5})


@pytest.fixture(autouse=True)
def _without_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hundreds of small files: what a power cut would leave of them is not the question here."""
    monkeypatch.setattr("laser_slam.store.files.os.fsync", lambda file: None)


def street(num: int = 6, radius: float = 6.0) -> list[Submap]:
    """Make submaps one behind the other; each overlaps the next, and the last the first."""
    submaps = []
    for i in range(num):
        angle = 2 * np.pi * i / num
        move = Sim3(translation=radius * np.array([np.cos(angle), 0, np.sin(angle)]))
        submap = submap_of(wavy_depth(seed=i), index=i, seed=i)
        submaps.append(replace(submap, world_from_window=move @ submap.world_from_window))
    return submaps


def parts_of(submaps: Sequence[Submap]) -> list[Part]:
    return [Part(s.index, repr((s.world_from_window, s.is_owned.tolist()))) for s in submaps]


def update(folder: Path, submaps: Sequence[Submap], config: FusionConfig = CONFIG) -> Update:
    by_index = {submap.index: submap for submap in submaps}
    return TiledMap(TileFiles(folder), config).update(parts_of(submaps), by_index.__getitem__)


def rows_of(cloud: Cloud) -> np.ndarray:
    """Return all that a cloud has, in an order that does not depend on the tiles."""
    assert cloud.normals is not None
    table = np.hstack(
        [cloud.points, cloud.colors, cloud.weights[:, None], cloud.normals.astype(float)]
    )
    return table[np.lexsort(table.T)]


def content(folder: Path) -> dict[str, object]:
    """Return all that is in the folder, in memory."""
    index = json.loads((folder / "index.json").read_text())
    tiles = {}
    for path in folder.glob("*.npz"):
        with np.load(path) as file:
            tiles[path.name] = {name: file[name].tolist() for name in file.files}
    return {"index": index, "tiles": tiles, "names": sorted(p.name for p in folder.iterdir())}


def stamps(folder: Path) -> dict[str, tuple[int, int]]:
    """Tell of each tile's file when it was written, and which file it is."""
    stats = {path.name: path.stat() for path in folder.glob("*.npz")}
    return {name: (stat.st_mtime_ns, stat.st_ino) for name, stat in stats.items()}


@pytest.mark.parametrize(
    ("tile_bits", "active_voxels"), [(4, 700), (5, 1), (5, 10**6), (7, 1), (12, 1)]
)
def test_one_tile_or_many_and_any_coming_and_going_give_the_same_bits(
    tmp_path: Path, tile_bits: int, active_voxels: int
) -> None:
    whole = rows_of(fuse(street(), CONFIG.model_copy(update={"tile_bits": 12})))
    changes = {"tile_bits": tile_bits, "active_voxels": active_voxels}
    update(tmp_path, street(), CONFIG.model_copy(update=changes))
    files = TileFiles(tmp_path)
    assert len(whole) > 1000
    np.testing.assert_array_equal(rows_of(files.cloud(10**6)), whole)
    assert files.num_points == len(whole)
    if tile_bits == 4:
        assert len(files.index().tiles) > 50


def test_support_from_across_a_border_decides() -> None:
    """Without what lies in the next tile, other points would stay."""
    alone = CONFIG.model_copy(update={"min_observations": 1, "tile_bits": 4})
    supported = CONFIG.model_copy(update={"tile_bits": 4})
    clouds = [fuse(street(), config) for config in (alone, supported)]
    assert 100 < len(clouds[1].points) < 0.95 * len(clouds[0].points)


def test_moving_a_window_gives_what_a_map_from_scratch_is(tmp_path: Path) -> None:
    submaps = street()
    update(tmp_path / "mended", submaps)
    before = stamps(tmp_path / "mended")
    turn = Sim3(1.1, rotation_exp(np.array([0.0, 0.2, 0.05])), np.array([0.3, 0.0, -0.2]))
    submaps[2] = replace(submaps[2], world_from_window=submaps[2].world_from_window @ turn)
    done = update(tmp_path / "mended", submaps)
    scratch = update(tmp_path / "scratch", submaps)
    assert content(tmp_path / "mended") == content(tmp_path / "scratch")
    assert 2 in done.loaded
    assert len(done.loaded) < len(scratch.loaded) == 6
    untouched = set(before) - {"_".join(map(str, place)) + ".npz" for place in done.made}
    after = stamps(tmp_path / "mended")
    same = {name for name in untouched if name in after and before[name] == after[name]}
    assert len(same) > len(before) // 3
    assert len(untouched - same) < len(done.made)  # judged anew, because a neighbour changed


@pytest.mark.parametrize("seed", range(5))
def test_any_change_gives_what_a_map_from_scratch_is(tmp_path: Path, seed: int) -> None:
    """Windows come, go and move, a little or far away, with tiles small and few in memory."""
    rng = np.random.default_rng(seed)
    changes = {"tile_bits": int(rng.integers(4, 7)), "active_voxels": int(rng.integers(1, 3000))}
    config = CONFIG.model_copy(update=changes)
    submaps = street()
    update(tmp_path / "mended", [s for s in submaps if rng.random() < 0.7], config)
    for i in range(6):
        if rng.random() < 0.4:
            move = Sim3(translation=rng.normal(size=3) * rng.choice([1e-4, 0.2, 20.0]))
            moved = move @ submaps[i].world_from_window
            submaps[i] = replace(submaps[i], world_from_window=moved)
    chosen = [s for s in submaps if rng.random() < 0.8]
    update(tmp_path / "mended", chosen, config)
    update(tmp_path / "scratch", chosen, config)
    assert content(tmp_path / "mended") == content(tmp_path / "scratch")


def test_nothing_changed_is_nothing_done(tmp_path: Path) -> None:
    update(tmp_path, street())
    before = stamps(tmp_path)
    assert update(tmp_path, street()) == Update()
    assert stamps(tmp_path) == before


def test_other_settings_make_the_map_anew_but_not_those_of_memory(tmp_path: Path) -> None:
    update(tmp_path / "map", street())
    more_memory = CONFIG.model_copy(update={"active_voxels": 123})
    assert update(tmp_path / "map", street(), more_memory) == Update()
    strict = CONFIG.model_copy(update={"min_confidence": 0.5})
    assert len(update(tmp_path / "map", street(), strict).loaded) == 6
    update(tmp_path / "scratch", street(), strict)
    assert content(tmp_path / "map") == content(tmp_path / "scratch")


def test_a_map_whose_making_was_broken_off_is_none_and_is_made_anew(tmp_path: Path) -> None:
    submaps = street()
    update(tmp_path / "map", submaps)
    submaps[1] = replace(submaps[1], world_from_window=Sim3())

    def breaks(index: int) -> Submap:
        raise RunFolderError(f"window {index} is gone")

    with pytest.raises(RunFolderError, match="is gone"):
        TiledMap(TileFiles(tmp_path / "map"), CONFIG).update(parts_of(submaps), breaks)
    assert TileFiles(tmp_path / "map").num_points  # nothing was touched so far

    def breaks_later(index: int) -> Submap:
        if index == 2:
            raise RunFolderError(f"window {index} is gone")
        return submaps[index]

    with pytest.raises(RunFolderError, match="is gone"):
        TiledMap(TileFiles(tmp_path / "map"), CONFIG).update(parts_of(submaps), breaks_later)
    with pytest.raises(RunFolderError, match="no finished map"):
        _ = TileFiles(tmp_path / "map").num_points
    update(tmp_path / "map", submaps)
    update(tmp_path / "scratch", submaps)
    assert content(tmp_path / "map") == content(tmp_path / "scratch")


def test_memory_is_bounded_by_the_active_voxels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held: list[int] = []
    add = VoxelGrid.add

    def watch(grid: VoxelGrid, *args: object) -> None:
        add(grid, *args)  # type: ignore[arg-type]
        held.append(grid.num_voxels)

    monkeypatch.setattr(VoxelGrid, "add", watch)
    many = street(12, radius=60.0)
    update(tmp_path / "free", many)
    free, held[:] = max(held), []
    update(tmp_path / "bounded", many, CONFIG.model_copy(update={"active_voxels": 4000}))
    assert free > 20_000
    assert max(held) < 4000 + 24 * 40  # what one frame adds before tiles go


def test_an_even_part_of_a_large_map_is_a_part_of_it(tmp_path: Path) -> None:
    update(tmp_path, street())
    files = TileFiles(tmp_path)
    whole, part = files.cloud(10**6), files.cloud(files.num_points // 5)
    assert (
        files.num_points / 7 < len(part.points) <= files.num_points / 5 + len(files.index().tiles)
    )
    assert {tuple(point) for point in part.points} < {tuple(point) for point in whole.points}
    assert sum(len(cloud.points) for cloud in files.clouds()) == files.num_points
    assert whole.voxel_size == files.voxel_size == CONFIG.voxel_size


def test_nothing_seen_is_a_finished_map_without_points(tmp_path: Path) -> None:
    blank = submap_of(np.full((2, 24, 40), np.nan, np.float32))
    update(tmp_path, [blank], CONFIG.model_copy(update={"voxel_size": 0.0}))
    files = TileFiles(tmp_path)
    assert files.num_points == 0
    assert list(files.clouds()) == []
    assert len(files.cloud(10).points) == 0


def test_what_is_wrong_with_the_tiles_is_said_in_a_line(tmp_path: Path) -> None:
    files = TileFiles(tmp_path / "tiles")
    with pytest.raises(RunFolderError, match=r"no finished map in .*tiles"):
        files.index()
    update(tmp_path / "tiles", street())
    path = next((tmp_path / "tiles").glob("*.npz"))
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(RunFolderError, match=f"cannot read map tile .*{path.name}.*run again"):
        files.cloud(10**6)
    index = tmp_path / "tiles" / "index.json"
    index.write_text(index.read_text().replace('"version": 1', '"version": 9'))
    with pytest.raises(RunFolderError, match="format 9, this laser-slam reads 1"):
        files.index()
    for damage in ("{", "[]", "{}", '{"version": 1}'):
        index.write_text(damage)
        with pytest.raises(RunFolderError, match=r"index\.json is damaged"):
            files.index()


def test_a_folder_that_cannot_be_written_is_said_in_a_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RunFolderError, match=r"cannot keep map tiles in .*choose another folder"):
        update(tmp_path / "file", street(1))


@pytest.mark.parametrize("active_voxels", [1000, 10**6])
def test_a_full_disk_is_said_in_a_line_and_leaves_no_half_map(
    tmp_path: Path, active_voxels: int
) -> None:
    """It fills up while the drive goes on, or at its end."""
    config = CONFIG.model_copy(update={"tile_bits": 12, "active_voxels": active_voxels})
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises(RunFolderError, match=r"cannot write .*; .*choose another folder"):
            update(tmp_path, street(3), config)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    with pytest.raises(RunFolderError, match="no finished map"):
        TileFiles(tmp_path).index()
    update(tmp_path, street(3), config)
    assert TileFiles(tmp_path).num_points > 500
    assert not list(tmp_path.rglob("*.partial*"))
