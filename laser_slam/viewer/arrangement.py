"""How rerun's window is arranged, and the entities that it shows."""

from __future__ import annotations

from typing import Any

from laser_slam.dependencies import import_rerun

WORLD = "world"
WINDOWS = "world/windows"  # one entity per window: its points, its piece of the path, its start
PLACES = "world/places"  # of all windows, over time: one entity, for an entity's row is dear
CAMERA = "world/camera"
FRAME_CLOUD = "world/frame"
ACCEPTED = "world/closures/accepted"
REJECTED = "world/closures/rejected"
DEPTH = "frame/depth"
CONFIDENCE = "frame/confidence"
LAYERS = "frame/layers"
SCALE = "plots/scale/to_previous"
WORLD_SCALE = "plots/scale/in_world"
RESIDUAL = "plots/residual"
EVENTS = "events"
MAP = "results/map"
PATH = "results/path"
PATH_WITHOUT_LOOPS = "results/path_without_loops"

FRAME, TIME = "frame", "time"  # timelines: index in the sequence, seconds


def arrangement() -> Any:
    """Return the blueprint: the drive and the finished map, beside them images and plots."""
    import_rerun()
    import rerun.blueprint as rrb  # noqa: PLC0415  (on use)

    scenes = rrb.Tabs(
        rrb.Spatial3DView(origin=f"/{WORLD}", name="Drive"),
        rrb.Spatial3DView(origin="/results", name="Finished map"),
        active_tab=0,
    )
    pictures = rrb.Vertical(
        rrb.Spatial2DView(origin=f"/{CAMERA}", name="Image"),
        rrb.Spatial2DView(origin=f"/{DEPTH}", name="Depth"),
        rrb.Tabs(
            rrb.Spatial2DView(origin=f"/{LAYERS}", name="Layers: blue x 0.8, red x 1.25"),
            rrb.Spatial2DView(origin=f"/{CONFIDENCE}", name="Confidence"),
            active_tab=0,
        ),
        rrb.Tabs(
            rrb.TimeSeriesView(origin="/plots/scale", name="Scale of windows"),
            rrb.TimeSeriesView(origin=f"/{RESIDUAL}", name="Registration residual"),
            rrb.TextLogView(origin=f"/{EVENTS}", name="Events"),
            active_tab=0,
        ),
    )
    return rrb.Blueprint(
        rrb.Horizontal(scenes, pictures, column_shares=[2.2, 1]),
        rrb.TimePanel(state="collapsed", timeline=FRAME),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )
