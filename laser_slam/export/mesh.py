"""The surface as a mesh: signed distances of all depth maps, tile by tile."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from laser_slam.dependencies import import_open3d
from laser_slam.errors import RunFolderError
from laser_slam.export.base import DepthView, Source
from laser_slam.export.glb import write_glb
from laser_slam.store import atomic_write

Array = NDArray[np.float64]

_BLOCK = 16  # voxels along a block's edge, the unit that Open3D allocates
_FAR = 1e9  # no limit: what is too far is NaN already
_PLY_VERTEX = [
    *((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")),
    *((name, "|u1") for name in ("red", "green", "blue")),
]
_PLY_TYPES = {"<f4": "float", "|u1": "uchar"}

# Open3D truncates coordinates: its pixels begin where ours have their centre.
_TO_CORNER = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
_NEIGHBOURS = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3), axis=-1).reshape(-1, 3)

Tile = tuple[int, int, int]


class Mesh(NamedTuple):
    """Triangles in world units.

    Attributes:
        vertices: (N, 3).
        normals: (N, 3) unit, to the side that the cameras were on.
        colors: (N, 3) RGB.
        triangles: (M, 3) rows of ``vertices``, counter-clockwise seen from the cameras.
    """

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    colors: NDArray[np.uint8]
    triangles: NDArray[np.int32]


def export_mesh_ply(path: Path, source: Source) -> None:
    """Write the mesh as binary PLY, in world units, with normals and colours.

    Raises:
        RunFolderError: there is no surface, or the file cannot be written.
    """
    mesh = _the_mesh(source)
    rows = np.zeros(len(mesh.vertices), np.dtype(_PLY_VERTEX))
    names = [name for name, _ in _PLY_VERTEX]
    columns = [*mesh.vertices.T, *mesh.normals.T, *mesh.colors.T]
    for name, column in zip(names, columns, strict=True):
        rows[name] = column
    faces = np.zeros(len(mesh.triangles), np.dtype([("num", "|u1"), ("rows", "<i4", 3)]))
    faces["num"], faces["rows"] = 3, mesh.triangles
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property {_PLY_TYPES[kind]} {name}" for name, kind in _PLY_VERTEX]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    with atomic_write(path) as partial, partial.open("wb") as file:
        file.write(("\n".join(lines) + "\n").encode("ascii"))
        rows.tofile(file)
        faces.tofile(file)


def export_mesh_glb(path: Path, source: Source) -> None:
    """Write the mesh as binary glTF, turned to its axes: x right, y up, z backward.

    Raises:
        RunFolderError: there is no surface, it is too large, or the file cannot be written.
    """
    mesh = _the_mesh(source)
    write_glb(path, mesh.vertices, mesh.normals, mesh.colors, mesh.triangles)


def _the_mesh(source: Source) -> Mesh:
    """Return the mesh, which takes long and is the same for all formats."""
    if "mesh" not in source.made:
        source.made["mesh"] = build_mesh(source)
    mesh: Mesh = source.made["mesh"]
    return mesh


def build_mesh(source: Source) -> Mesh:
    """Fuse the depth of all keyframes in a truncated signed distance, and take its zero surface.

    Only one tile is in memory at a time, with a block around it, so that the cells at its border
    are those of its neighbours: the pieces fit to the last bit, and shared vertices become one.

    Raises:
        RunFolderError: there is no surface.
    """
    config = source.config
    voxel_size = config.mesh_voxel * source.some_points().voxel_size
    volume = _Volume(voxel_size, config.mesh_truncation, max(1, config.mesh_tile // _BLOCK))
    pieces = []
    for tile, frames in sorted(_frames_of_tiles(source, volume).items()):
        piece = volume.piece(tile, source.surfaces(frames), config.mesh_min_views)
        if len(piece.triangles):
            pieces.append(piece)
    if not pieces:
        raise RunFolderError(
            f"{source.name} has no surface that {config.mesh_min_views:g} frames have seen; "
            "lower export.mesh_min_views or raise export.mesh_voxel"
        )
    return _weld(pieces, volume)


def _frames_of_tiles(source: Source, volume: _Volume) -> dict[Tile, set[int]]:
    """Find the keyframes that see something of each tile."""
    out: defaultdict[Tile, set[int]] = defaultdict(set)
    beyond: defaultdict[Tile, set[int]] = defaultdict(set)
    for view in source.surfaces(None):
        blocks = volume.blocks(view)
        for shift in _NEIGHBOURS:
            found = out if not shift.any() else beyond
            for tile in np.unique(volume.tiles(blocks + shift), axis=0).tolist():
                found[(tile[0], tile[1], tile[2])].add(view.frame)
    # Who only sees the blocks around a tile shapes the cells at its border too.
    return {tile: frames | beyond[tile] for tile, frames in out.items()}


class _Volume:
    """Signed distances by Open3D, of one tile at a time; the origin is in the middle of a tile."""

    def __init__(self, voxel_size: float, truncation: float, tile_blocks: int) -> None:
        self._open3d = import_open3d()
        self._voxel_size, self._truncation = voxel_size, truncation
        self._tile_blocks = tile_blocks
        self._probe = self._grid(1)

    def tiles(self, blocks: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the (M, 3) tiles that blocks are in."""
        return np.asarray((blocks + self._tile_blocks // 2) // self._tile_blocks)

    def blocks_of(self, points: Array) -> Array:
        """Return where points are, in blocks."""
        return points / (self._voxel_size * _BLOCK)

    def is_at_border(self, points: Array) -> NDArray[np.bool_]:
        """Tell which points are within a voxel of a tile's border."""
        tiles = (self.blocks_of(points) + self._tile_blocks // 2) / self._tile_blocks
        voxels = np.abs(tiles - np.rint(tiles)) * self._tile_blocks * _BLOCK
        return np.asarray((voxels < 1).any(axis=1))

    def blocks(self, view: DepthView) -> NDArray[np.int64]:
        """Return the (M, 3) blocks that a depth map is near to."""
        if not (view.depth > 0).any():
            return np.empty((0, 3), np.int64)
        image, _, intrinsics, cam_from_world = self._inputs(view)
        found = self._probe.compute_unique_block_coordinates(
            image, intrinsics, cam_from_world, 1.0, _FAR, self._truncation
        )
        return np.asarray(found.numpy(), np.int64)

    def piece(self, tile: Tile, views: Iterator[DepthView], min_views: float) -> Mesh:
        """Return the triangles whose middle lies in a tile."""
        grid = self._grid(1000)
        low = np.array(tile, np.int32) * self._tile_blocks - self._tile_blocks // 2 - 1
        high = low + self._tile_blocks + 2
        for view in views:
            blocks = self.blocks(view)
            blocks = blocks[((blocks >= low) & (blocks < high)).all(axis=1)]
            if len(blocks):
                image, color, intrinsics, cam_from_world = self._inputs(view)
                wanted = self._open3d.core.Tensor(np.ascontiguousarray(blocks, np.int32))
                grid.integrate(
                    wanted, image, color, intrinsics, cam_from_world, 1.0, _FAR, self._truncation
                )
        return self._inside(tile, grid.extract_triangle_mesh(min_views))

    def _inside(self, tile: Tile, mesh: Any) -> Mesh:
        if "indices" not in mesh.triangle or not len(mesh.triangle.indices):
            return _EMPTY
        triangles = mesh.triangle.indices.numpy()
        vertices = mesh.vertex.positions.numpy()
        middles = vertices[triangles].astype(np.float64).mean(axis=1)
        blocks = np.floor(self.blocks_of(middles)).astype(np.int64)
        is_inside = (self.tiles(blocks) == np.array(tile)).all(axis=1)
        used, rows = np.unique(triangles[is_inside], return_inverse=True)
        colors = np.rint(mesh.vertex.colors.numpy()[used].clip(0, 1) * 255).astype(np.uint8)
        normals = mesh.vertex.normals.numpy()[used]
        return Mesh(vertices[used], normals, colors, rows.reshape(-1, 3).astype(np.int32))

    def _grid(self, num_blocks: int) -> Any:
        core = self._open3d.core
        return self._open3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"),
            (core.float32, core.float32, core.float32),
            ((1,), (1,), (3,)),
            self._voxel_size,
            _BLOCK,
            num_blocks,
        )

    def _inputs(self, view: DepthView) -> tuple[Any, Any, Any, Any]:
        """Return depth, colour, intrinsics and ``cam_from_world`` as Open3D wants them."""
        tensor, image = self._open3d.core.Tensor, self._open3d.t.geometry.Image
        depth = np.nan_to_num(view.depth, nan=0.0).astype(np.float32)
        color = view.color.astype(np.float32) / np.float32(255)
        return (
            image(tensor(np.ascontiguousarray(depth))),
            image(tensor(np.ascontiguousarray(color))),
            tensor(np.ascontiguousarray(view.intrinsics + _TO_CORNER)),
            tensor(np.linalg.inv(view.world_from_cam)),
        )


_EMPTY = Mesh(
    np.empty((0, 3), np.float32),
    np.empty((0, 3), np.float32),
    np.empty((0, 3), np.uint8),
    np.empty((0, 3), np.int32),
)


def _weld(pieces: list[Mesh], volume: _Volume) -> Mesh:
    """Join the tiles; vertices that two of them have, at their common border, become one."""
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    vertices, normals, colors = (
        np.concatenate([piece[column] for piece in pieces]) for column in range(3)
    )
    triangles = np.concatenate(
        [piece.triangles + start for piece, start in zip(pieces, starts[:-1], strict=True)]
    )
    border = np.flatnonzero(volume.is_at_border(vertices.astype(np.float64)))
    _, first, same = np.unique(vertices[border], axis=0, return_index=True, return_inverse=True)
    target = np.arange(len(vertices))
    target[border] = border[first[same.ravel()]]
    kept = np.unique(target)
    renumber = np.zeros(len(vertices), np.int32)
    renumber[kept] = np.arange(len(kept))
    return Mesh(vertices[kept], normals[kept], colors[kept], renumber[target[triangles]])
