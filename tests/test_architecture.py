"""Imports point upwards: a module uses only rows above its own, and stages never meet."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "laser_slam"
ROOTS = ["errors", "dependencies", "sim3", "camera", "types", "config", "store", "networks"]
STAGES = [
    "datasets",
    "windows",
    "rectification",
    "backbones",
    "registration",
    "fusion",
    "export",
    "evaluation",
]
STAGES += ["viewer", "report", "layers", "places", "pose_graph", "lidar_odometry"]
COMPOSITION = ["closures", "slam", "bookkeeping", "results", "rescoring", "predicting", "pipeline"]
COMPOSITION += ["exporting", "viewing", "lidar", "benchmarks"]
COMPOSITION += ["console", "cli"]
TORCH = {"torch", "safetensors"}  # no dependencies of a plain installation
HEAVY = {"open3d", *TORCH, "gtsam", "numba", "cv2", "matplotlib", "scipy"}
MODULES = sorted(PACKAGE.rglob("*.py"))


def part_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_modules(path: Path, *, top_level_only: bool = False) -> list[str]:
    tree = ast.parse(path.read_text())
    nodes = tree.body if top_level_only else list(ast.walk(tree))
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    return names + [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]


def may_import(part: str) -> set[str]:
    if part in ROOTS:
        return {*ROOTS[: ROOTS.index(part)], part}
    if part in STAGES:
        return {*ROOTS, part}
    return {*ROOTS, *STAGES, *COMPOSITION[: COMPOSITION.index(part)], part}


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_up_and_stages_do_not_meet(path: Path) -> None:
    part = part_of(path)
    if part == "__init__":
        return
    assert part in ROOTS + STAGES + COMPOSITION, f"{part} has no row in the design"
    used = {name.split(".")[1] for name in imported_modules(path) if name.startswith("laser_slam.")}
    assert used <= may_import(part)


@pytest.mark.parametrize("name", [*ROOTS[:-1], "cli"])
def test_the_command_line_starts_without_heavy_packages(name: str) -> None:
    single, package = PACKAGE / f"{name}.py", sorted((PACKAGE / name).glob("*.py"))
    paths = [single] if single.exists() else package
    assert paths
    names = {
        module.split(".")[0]
        for path in paths
        for module in imported_modules(path, top_level_only=True)
    }
    assert not names & HEAVY


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_networks_and_torch_are_imported_on_use(path: Path) -> None:
    if part_of(path) == "networks":
        return
    names = imported_modules(path, top_level_only=True)
    assert not {name.split(".")[0] for name in names} & TORCH
    assert not [name for name in names if name.startswith("laser_slam.networks")]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_files_stay_small(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 300


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_kernel_rounds_as_it_is_inlined(path: Path) -> None:
    """Sums that fastmath reorders differ between code just compiled and the same from the cache."""
    if part_of(path) != "datasets":  # a rendered image is whole numbers
        assert "fastmath=True" not in path.read_text()
