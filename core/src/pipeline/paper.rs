//! The order of the publication's stages.

use super::products::Products;
use super::reading::{self, Seen};
use super::{Cargo, Colours, Picture, Run};
use crate::depth_map::strips::TextureStrip;
use crate::error::Result;
use crate::motion::Shift;
use crate::motion::paper::ImageTracker;
use crate::rig::LineDirection;
use crate::source::{Frame, Source};
use crate::stripe::{self, Stripe, StripeSteps};
use crate::surface::Measured;
use crate::surface::paper::Placement;
use crate::triangulation::{Profile, triangulate};

/// The order of the stages, frame by frame.
pub(super) fn measure(run: &mut Run<'_, '_, '_, '_>, source: Box<dyn Source>) -> Result<()> {
    let (rig, recipe) = (&run.request.rig, &run.request.recipe);
    let mut tracker = ImageTracker::new(&recipe.motion);
    let mut placement = Placement::new(rig, &recipe.motion);
    std::thread::scope(|scope| {
        // Source ▶ Frame ▶ Stripe, in a thread of their own.
        let (frames, reading) = reading::start(scope, source, rig, recipe, move |frame| {
            stripe::paper::find(&frame.image, &rig.laser, &recipe.stripe)
        });
        let mut held: Option<HeldFrame> = None;
        let mut clear = ClearOfLine::new(recipe.motion.band_half_width_px);
        for seen in frames {
            let Seen { frame, found: steps } = seen?;
            // Stripe ▶ Profile.
            let profile = run.timings.time("triangulation", || triangulate(&steps.stripe, rig));
            // Frames ▶ motion.
            let shift = run.timings.time("motion", || tracker.track(&frame, &steps.stripe))?;
            // Profile + motion ▶ surface. A frame's strip ends where the next one begins: it waits for that.
            let step_px = shift.travel_px(rig.laser.line);
            if let Some(before) = held.take() {
                let measured = before.cut(rig.laser.line, step_px, &mut clear, run.products);
                run.add(placement.push(measured))?;
            }
            held = Some(HeldFrame { frame, steps, profile, shift });
            run.progress.frame()?;
        }
        if let Some(last) = held.take() {
            let step_px = last.shift.travel_px(rig.laser.line);
            let measured = last.cut(rig.laser.line, step_px, &mut clear, run.products);
            run.add(placement.push(measured))?;
        }
        run.add(placement.finish())?;
        let report = reading.join()?;
        run.timings.add("decoding", report.decoding);
        run.timings.add("stripe", report.stripes);
        report.warnings.into_iter().try_for_each(|warning| run.progress.warn(warning))
    })
}

/// A frame that waits for the next one's shift.
struct HeldFrame {
    frame: Frame,
    steps: StripeSteps,
    profile: Profile,
    shift: Shift,
}

impl HeldFrame {
    /// Keeps what later stages need of the image and lets the rest go.
    fn cut(
        self,
        line: LineDirection,
        step_px: f64,
        clear: &mut ClearOfLine,
        products: &Products<'_>,
    ) -> Measured<Cargo> {
        let HeldFrame { frame, steps, profile, shift } = self;
        let middle_px = steps.stripe.median_px();
        let colours = middle_px.map_or(Colours::Unknown, |px| {
            let offsets_px = clear.offsets_px(&steps.stripe, px);
            Colours::Strip(TextureStrip::cut(&frame.image, line, px, step_px, offsets_px))
        });
        let picture = products.wants_picture(frame.time_s).then_some(Picture {
            image: frame.image,
            effective_area: steps.effective_area,
            row_threshold: steps.row_threshold,
        });
        let cargo = Cargo { stripe: steps.stripe, colours, picture };
        Measured { frame: frame.index, time_s: frame.time_s, profile, shift, cargo }
    }
}

/// How far ahead of the line's middle and behind it no laser light was seen so far: on a pipe the line is bent.
struct ClearOfLine {
    margin_px: f64,
    reach_px: [f64; 2],
}

impl ClearOfLine {
    fn new(margin_px: f64) -> ClearOfLine {
        ClearOfLine { margin_px, reach_px: [0.0; 2] }
    }

    /// Never shrinks, so that the strips of the texture join.
    fn offsets_px(&mut self, stripe: &Stripe, middle_px: f64) -> [f64; 2] {
        if let Some((low, high)) = stripe.extent_px() {
            let reach_px = [f64::from(high) - middle_px, middle_px - f64::from(low)];
            self.reach_px = [self.reach_px[0].max(reach_px[0]), self.reach_px[1].max(reach_px[1])];
        }
        self.reach_px.map(|reach| reach + self.margin_px)
    }
}
