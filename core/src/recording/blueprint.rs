//! How the viewer lays the recording out, and the words that explain it.

use std::sync::LazyLock;

use rerun::blueprint::{
    Blueprint, BlueprintActivation, BlueprintPanel, ContainerLike, Horizontal, SelectionPanel, Spatial2DView,
    Spatial3DView, Tabs, TextDocumentView, TextLogView, TimePanel, TimeSeriesView, Vertical, components,
};
use rerun::datatypes::{Range2D, TimeRange, TimeRangeBoundary};
use rerun::external::re_sdk_types::blueprint::archetypes::{TextLogColumns, VisibleTimeRanges, VisualBounds2D};
use rerun::external::re_sdk_types::blueprint::datatypes::{TextLogColumn, TextLogColumnKind};
use rerun::log::{Chunk, LogMsg};
use rerun::{
    AsComponents, RecordingStream, RecordingStreamBuilder, RecordingStreamResult, StoreId, TimePoint, Timeline,
};

use super::data::{FRAME, TIME, failed};
use super::surface::DepthRange;
use super::{APPLICATION, charts, entity, images};
use crate::error::Result;
use crate::rig::{LineDirection, Rig};

/// The messages that open a recording: what it is, and its layout.
pub(super) fn opening(id: &StoreId, name: &str, recorded_at: jiff::Timestamp) -> Result<Vec<LogMsg>> {
    let started = i64::try_from(recorded_at.as_nanosecond()).unwrap_or(0);
    let builder = RecordingStreamBuilder::from_store_id(id)
        .enabled(true)
        .recording_name(name)
        .recording_started(rerun::datatypes::TimeInt(started));
    let mut messages = said(builder, |_| Ok(())).map_err(failed)?;
    messages.extend(LAYOUT.as_ref().map_err(failed)?.iter().cloned());
    Ok(messages)
}

/// The layout as messages. One for all recordings of the process: the SDK keeps two threads for each that it makes.
static LAYOUT: LazyLock<std::result::Result<Vec<LogMsg>, String>> = LazyLock::new(|| {
    let (layout, extras) = layout();
    let activation = BlueprintActivation { make_active: true, make_default: true };
    let messages =
        said(RecordingStreamBuilder::new(APPLICATION).enabled(true), |stream| layout.send(stream, activation));
    let mut messages = messages.map_err(|e| e.to_string())?;
    messages.retain(|message| message.store_id().is_blueprint());
    add_to_blueprint(&mut messages, extras).map_err(|e| e.to_string())?;
    Ok(messages)
});

/// What a stream sends.
fn said(
    builder: RecordingStreamBuilder,
    say: impl FnOnce(&RecordingStream) -> RecordingStreamResult<()>,
) -> RecordingStreamResult<Vec<LogMsg>> {
    let (stream, storage) = builder.memory()?;
    say(&stream)?;
    let messages = storage.take();
    // The stream and its storage hold each other: without this its threads would run for as long as the process.
    stream.disconnect();
    Ok(messages)
}

/// What the SDK's layout types cannot say is added to the blueprint before the message that activates it.
fn add_to_blueprint(messages: &mut Vec<LogMsg>, extras: Vec<Extra>) -> Result<()> {
    let Some(end) = messages.iter().position(|m| matches!(m, LogMsg::BlueprintActivationCommand(_))) else {
        return Err(failed("the layout has no activation"));
    };
    let LogMsg::BlueprintActivationCommand(activation) = &messages[end] else { return Ok(()) };
    let blueprint = activation.blueprint_id.clone();
    for extra in extras {
        let at = TimePoint::default().with(Timeline::new_sequence("blueprint"), 0);
        let chunk =
            Chunk::builder(extra.path).with_archetype_auto_row(at, extra.what.as_ref()).build().map_err(failed)?;
        messages.insert(end, LogMsg::ArrowMsg(blueprint.clone(), chunk.to_arrow_msg().map_err(failed)?));
    }
    Ok(())
}

/// A property of a view.
struct Extra {
    path: String,
    what: Box<dyn AsComponents>,
}

fn layout() -> (Blueprint, Vec<Extra>) {
    let mut extras = Vec::new();

    let wall = Spatial3DView::new("The wall as measured so far").with_origin("/world").with_contents([
        "$origin/**".to_string(),
        format!("- /{}", entity::SPOTS),
        format!("- /{}", entity::CORNERS),
    ]);
    let wall = ContainerLike::from(wall);
    for grown in [entity::SURFACE, entity::TRAJECTORY] {
        let path = format!("{}/ViewContents/overrides/{grown}/visualizers", view_path(&wall));
        extras.push(Extra { path, what: Box::new(everything_so_far()) });
    }

    let frame = Spatial2DView::new("Camera frame: spots (red), corners and their flow (blue)")
        .with_origin(format!("/{}", entity::IMAGE));
    let area = Spatial2DView::new("Effective area: where the line may be").with_origin(format!("/{}", entity::AREA));
    let one_row = sheet(
        Spatial2DView::new("One row: gray, threshold, spot").with_origin(format!("/{}", entity::ONE_ROW)),
        &mut extras,
    );
    let all_rows = sheet(Spatial2DView::new("All rows").with_origin(format!("/{}", entity::ALL_ROWS)), &mut extras);
    let plot =
        |name: &str, entity: &str| ContainerLike::from(TimeSeriesView::new(name).with_origin(format!("/{entity}")));

    let warnings = ContainerLike::from(TextLogView::new("Warnings").with_origin(format!("/{}", entity::MESSAGES)));
    let body = TextLogColumn { kind: TextLogColumnKind::Body, visible: true.into() };
    extras.push(Extra {
        path: format!("{}/TextLogColumns", view_path(&warnings)),
        what: Box::new(TextLogColumns::update_fields().with_text_log_columns([body])),
    });

    let left = Vertical::new([
        wall,
        Horizontal::new([
            TextDocumentView::new("How to read this").with_origin(format!("/{}", entity::GUIDE)).into(),
            Vertical::new([
                Spatial2DView::new("Depth image (at the end)").with_origin(format!("/{}", entity::DEPTH_IMAGE)).into(),
                warnings,
            ])
            .with_row_shares(vec![3.0, 1.0])
            .into(),
        ])
        .into(),
    ])
    .with_row_shares(vec![3.0, 2.0]);
    let right = Vertical::new([
        frame.into(),
        Horizontal::new([area.into(), Tabs::new([one_row, all_rows]).into()]).into(),
        plot("Image shift since the previous frame, px", entity::SHIFT),
        Horizontal::new([plot("Image scale", entity::SCALE), plot("Rows with a spot", entity::ROWS_FOUND)]).into(),
    ])
    .with_row_shares(vec![4.0, 3.0, 2.0, 2.0]);

    let root = Horizontal::new([left.into(), right.into()]).with_column_shares(vec![5.0, 4.0]);
    let layout = Blueprint::new(root)
        .with_auto_views(false)
        .with_auto_layout(false)
        .with_blueprint_panel(BlueprintPanel::from_state(components::PanelState::Hidden))
        .with_selection_panel(SelectionPanel::from_state(components::PanelState::Hidden))
        .with_time_panel(
            TimePanel::new()
                .with_state(components::PanelState::Collapsed)
                .with_timeline(TIME)
                .with_play_state(components::PlayState::Following),
        );
    (layout, extras)
}

/// The blueprint's path of a view, where its properties go.
fn view_path(view: &ContainerLike) -> String {
    match view {
        ContainerLike::View(view) => view.blueprint_path().to_string(),
        _ => unreachable!("made from a view"),
    }
}

/// A view of one of the charts' sheets, with the sheet in sight.
fn sheet(view: Spatial2DView, extras: &mut Vec<Extra>) -> ContainerLike {
    let view = ContainerLike::from(view);
    let (margin, width, height) = (15.0, f64::from(charts::SHEET_WIDTH), f64::from(charts::SHEET_HEIGHT));
    let bounds = Range2D { x_range: [-margin, width + margin].into(), y_range: [-margin, height + margin].into() };
    extras.push(Extra {
        path: format!("{}/VisualBounds2D", view_path(&view)),
        what: Box::new(VisualBounds2D::new(components::VisualBounds2D(bounds))),
    });
    view
}

/// All that was recorded up to the time shown, instead of the latest alone.
fn everything_so_far() -> VisibleTimeRanges {
    VisibleTimeRanges::new([FRAME, TIME].map(|timeline| {
        components::VisibleTimeRange(rerun::datatypes::VisibleTimeRange {
            timeline: timeline.into(),
            range: TimeRange {
                start: TimeRangeBoundary::Infinite,
                end: TimeRangeBoundary::CursorRelative(rerun::datatypes::TimeInt(0)),
            },
        })
    }))
}

/// The words beside the pictures.
pub(super) fn guide(rig: &Rig, run_name: &str, range: Option<DepthRange>) -> String {
    let colours = match range {
        Some(r) => format!("from **red** (near, {:.0} mm) to **blue** (far, {:.0} mm)", r.near_mm, r.far_mm),
        None => "from **red** (near) to **blue** (far)".to_string(),
    };
    let (line, row, sideways) = match rig.laser.line {
        LineDirection::Vertical => ("an upright", "row", "sideways"),
        LineDirection::Horizontal => ("a level", "column", "up or down"),
    };
    let colour = serde_json::to_value(rig.laser.colour).ok().and_then(|v| v.as_str().map(str::to_string));
    let colour = colour.unwrap_or_default();
    format!(
        "# {run_name}\n\n\
A camera and a {colour} laser move along a wall. The laser draws {line} line on it; where the wall is nearer or \
farther, the line moves {sideways} in the image. That shift, {row} by {row}, is the measurement.\n\n\
**1. Camera frame.** Red dots: the laser line as found, one spot a {row}. Blue arrows: corners of the wall's own \
pattern and where they went since the previous frame (drawn {flow:.0} times longer).\n\n\
**2. Effective area.** Only the {colour} part of the image is searched, so that other lights do not count.\n\n\
**3. One {row}.** Its brightness, the threshold, and the spot: the middle between the two crossings. The second tab \
shows the threshold of all {row}s.\n\n\
**4. Shift.** The mean of the corners' flow says how far the image moved: *dx* along the travel, *dy* across it. \
*Scale* above 1: the camera came closer. *Residual*: how well the corners agree. A gap means that the motion could \
not be found.\n\n\
**5. The wall.** Each frame gives one profile; placed by the camera's motion, they add up to the surface. Colours go \
{colours}; bright and dark are the wall's own. The thin line is the camera's path, the pyramid is the camera.\n\n\
**6. Depth image.** The finished surface as a map, once the run has ended.\n\n\
The 3D view is in metres (x along the travel, y down, z into the wall); plots and images are in pixels. Points and \
images are thinned out to keep this recording small; the full cloud and the map are separate products. Drag to turn, \
scroll to zoom, move the time bar to go back.\n",
        flow = images::FLOW_MAGNIFIED,
    )
}
