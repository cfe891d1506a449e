"""The layout of the viewer's window: the scene and the states on the left, the curves on the right."""

import pyarrow as pa
import rerun.blueprint as rrb

from hil.pictures.viewer.plots import ShownCurves
from hil.pictures.viewer.track import timeline_of

FOLLOWED_S = 20.0  # shown by the curves of a live flight
EYE = rrb.EyeControls3D(
    position=(0.62, -0.48, 1.45), look_target=(0.0, 0.0, 1.12), tracking_entity="world/robot"
)
TRAIL_S = 4.0
WANTED_S = 15.0  # of the goal's path, before and after
# Title and origin of each plot; the first two have their own place, the rest are tabs.
VIEWS = (
    ("Position error [cm]", "position"),
    ("Attitude error [deg]", "attitude"),
    ("Flap angles, commands pale; colours of the scene [deg]", "flaps"),
    ("Thrust of the rotors, commands pale [mN]", "rotors"),
    ("Words of the motors [%]", "motors"),
    ("Inputs [deg]", "inputs"),
    ("Estimate - truth [cm, deg]", "miss"),
    ("Age of the pose, by stage [ms]", "age"),
    ("Link: rates [1/s]", "link/rate"),
    ("Link: losses", "link/loss"),
    ("Link: air", "link/air"),
    ("Battery [V]", "battery"),
    ("Queue", "queue"),
    ("Processor [%]", "processor"),
)
LEGEND = """
| drawn | what |
|---|---|
| robot with flaps or rotors 1 to 4 | the true one, of a real flight by the cameras; flaps in the colours of their curves |
| white outline | the board's estimate |
| red box, cross and outline | the goal: 20 cm around it, the robot as it should be; its line points along the wanted x |
| white line, red line | the path of the last 4 s; the goal's, of the last and the next 15 s |
| yellow arrows | drag of the plates, 15 cm per newton |
| blue arrow | the air's movement in 0.02 s; pale: its sideways part in 0.1 s |
| pink arrow | a push, 15 cm per newton, shown for half a second at least |
| grey line, grid | tether, net |
| red, green, blue axes | x, y, z of W at the exit, and of the body |
| points on the zero line | poses refused, faults, an operator's actions |
"""


def views_of(schema: pa.Schema) -> list[tuple[str, str]]:
    """Return title and origin of the plots that a flight with such a log has."""
    known = ShownCurves.of(schema).paths
    return [
        (title, origin)
        for title, origin in VIEWS
        if any(path == origin or path.startswith(f"{origin}/") for path in known)
    ]


def blueprint(schema: pa.Schema, live: bool = False) -> rrb.Blueprint:
    """Return the layout for a flight.

    A live flight is followed, with the curves of its last seconds, until the user pauses or zooms.
    """
    timeline, _ = timeline_of(schema.metadata)
    begin = rrb.TimeRangeBoundary.cursor_relative(seconds=-FOLLOWED_S)
    now = rrb.TimeRangeBoundary.cursor_relative()
    shown = [rrb.VisibleTimeRange(timeline, start=begin, end=now)] if live else None
    plots = [
        rrb.TimeSeriesView(
            name=name, origin=f"plot/{path}", plot_legend=rrb.PlotLegend(visible=path != "flaps"), time_ranges=shown
        )
        for name, path in views_of(schema)
    ]  # fmt: skip
    columns = rrb.TextLogColumns(timeline_columns=[timeline], text_log_columns=["Body"])
    texts = rrb.Tabs(
        rrb.TextLogView(name="Text", origin="text", columns=columns),
        rrb.TextDocumentView(name="Legend", origin="legend"),
    )
    states = rrb.StateTimelineView(name="States", origin="state", time_ranges=shown)
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                tunnel_view(timeline, "world", ["world"], EYE),
                rrb.Horizontal(states, texts),
                row_shares=[3, 1],
            ),
            rrb.Vertical(*plots[:2], rrb.Tabs(*plots[2:])),
            column_shares=[5, 4],
        ),
        rrb.TimePanel(timeline=timeline, play_state="following" if live else "playing", state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def tunnel_view(timeline: str, origin: str, worlds: list[str], eye: rrb.EyeControls3D) -> rrb.Spatial3DView:
    """Return the view of the scenes at the paths `worlds`, in front of an eye."""
    before = rrb.TimeRangeBoundary.cursor_relative(seconds=-TRAIL_S)
    now = rrb.TimeRangeBoundary.cursor_relative()
    begin, end = (rrb.TimeRangeBoundary.cursor_relative(seconds=seconds) for seconds in (-WANTED_S, WANTED_S))
    return rrb.Spatial3DView(
        name="Wind tunnel" if origin == "world" else "Room",
        origin=origin,
        eye_controls=eye,
        background=(14, 18, 22),  # pale lines stay visible in a light theme, too
        line_grid=False,
        overrides={
            f"{world}/{name}": [rrb.VisibleTimeRanges(rrb.VisibleTimeRange(timeline, start=start, end=stop))]
            for world in worlds
            for name, start, stop in (("trail", before, now), ("wanted", begin, end))
        },
    )
