//! The method against the truth of simulated runs: exact without noise, bounded with it.

use stria_core::motion::paper::ImageTracker;
use stria_core::recipe::Recipe;
use stria_core::source::Frame;
use stria_core::stripe::{self, Stripe};
use stria_core::synthetic::{Motion, Scene, Simulation};
use stria_core::triangulation::triangulate;

/// A share of the sorted absolute values, 0.5 for the median.
fn quantile(values: &[f64], share: f64) -> f64 {
    assert!(!values.is_empty(), "nothing was measured");
    let mut sorted: Vec<f64> = values.iter().map(|v| v.abs()).collect();
    sorted.sort_by(f64::total_cmp);
    sorted[((sorted.len() - 1) as f64 * share) as usize]
}

/// What a run's frames are off the truth.
#[derive(Default)]
struct Errors {
    stripe_px: Vec<f64>,
    depth_mm: Vec<f64>,
    dx_px: Vec<f64>,
    found: usize,
    measurable: usize,
    false_spots: usize,
}

fn measure(scene: Scene, size_px: (u32, u32), seconds: f64, seed: u64) -> Errors {
    let simulation = Simulation::new(scene, size_px, 30.0, seconds, seed).expect("a simulation");
    let recipe = Recipe::load("paper").expect("built in");
    let rig = simulation.rig().clone();
    let mut tracker = ImageTracker::new(&recipe.motion);
    let mut errors = Errors::default();
    for index in 0..simulation.frames_total() {
        let (image, truth) = simulation.render(index);
        let frame = Frame { index, time_s: f64::from(index) / simulation.fps(), image };
        let found = stripe::paper::find(&frame.image, &rig.laser, &recipe.stripe).expect("stripe").stripe;
        for (row, across_px) in found.across_px.iter().enumerate() {
            let expected_px = truth.stripe_across_px[row];
            errors.measurable += usize::from(truth.measurable[row]);
            if across_px.is_finite() && truth.measurable[row] {
                errors.found += 1;
                errors.stripe_px.push(f64::from(across_px - expected_px));
            }
            errors.false_spots += usize::from(across_px.is_finite() && !expected_px.is_finite());
        }
        let pose = simulation.pose(index);
        for point in &triangulate(&found, &rig).points {
            let world = pose * point.point_in_camera;
            if let Some(z_mm) = simulation.surface_z_mm(world.x, world.y) {
                errors.depth_mm.push(world.z - z_mm);
            }
        }
        let shift = tracker.track(&frame, &found).expect("track");
        if let Some(dx_px) = shift.dx_px {
            errors.dx_px.push(dx_px - truth.dx_px);
        }
    }
    errors
}

#[test]
fn without_noise_the_stripe_is_met_to_0_02_px() {
    for name in ["wall", "pipe-steady"] {
        let mut scene = Scene::named(name).expect("a scene").exact().without_relief();
        // In the dark the line has all 255 gray values to itself: what remains is their rounding.
        scene.ambient.level = 0.0;
        let errors = measure(scene, (1280, 720), 0.2, 3);
        assert_eq!(errors.found, errors.measurable, "{name}: every row is found");
        let (median_px, p95_px) = (quantile(&errors.stripe_px, 0.5), quantile(&errors.stripe_px, 0.95));
        let bias_mm = errors.depth_mm.iter().sum::<f64>() / errors.depth_mm.len() as f64;
        println!("{name}, exact: stripe median {median_px:.4} px, p95 {p95_px:.4} px, depth bias {bias_mm:.4} mm");
        assert!(p95_px < 0.02, "{name}: stripe p95 {p95_px} px");
        assert!(bias_mm.abs() < 0.02, "{name}: depth bias {bias_mm} mm");
    }
}

#[test]
fn the_true_stripe_gives_the_true_depth_to_0_02_mm() {
    for name in ["wall", "pipe", "step-gauge", "lens"] {
        let scene = Scene::named(name).expect("a scene").exact();
        let simulation = Simulation::new(scene, (1280, 720), 30.0, 0.2, 3).expect("a simulation");
        let mut errors_mm = Vec::new();
        for index in 0..simulation.frames_total() {
            let (_, truth) = simulation.render(index);
            let stripe = Stripe {
                line: simulation.rig().laser.line,
                confidence: vec![1.0; truth.stripe_across_px.len()],
                sigma_px: vec![f32::NAN; truth.stripe_across_px.len()],
                across_px: truth.stripe_across_px,
            };
            for point in &triangulate(&stripe, simulation.rig()).points {
                let world = simulation.pose(index) * point.point_in_camera;
                errors_mm.extend(simulation.surface_z_mm(world.x, world.y).map(|z_mm| world.z - z_mm));
            }
        }
        let p99_mm = quantile(&errors_mm, 0.99);
        println!("{name}: depth of the true stripe, p99 {p99_mm:.5} mm of {} points", errors_mm.len());
        // The columns are float32 and a step's edge is steep: one in a hundred may lie on it.
        assert!(p99_mm < 0.02, "{name}: {p99_mm} mm");
    }
}

#[test]
fn without_noise_the_shift_is_met_to_0_02_px() {
    let mut scene = Scene::named("wall").expect("a scene").exact_with_texture().without_relief();
    scene.motion = Motion::Steady;
    let errors = measure(scene, (1280, 720), 0.4, 3);
    assert_eq!(errors.dx_px.len(), 11, "every frame after the first is tracked");
    let (median_px, largest_px) = (quantile(&errors.dx_px, 0.5), quantile(&errors.dx_px, 1.0));
    println!("wall, exact: dx median {median_px:.4} px, largest {largest_px:.4} px");
    assert!(median_px < 0.02 && largest_px < 0.03, "dx median {median_px} px, largest {largest_px} px");
}

#[test]
fn with_noise_the_errors_are_bounded() {
    for (name, median_px, p95_px) in [("wall", 0.20, 0.7), ("pipe", 0.35, 1.0), ("distractor", 0.20, 0.7)] {
        let errors = measure(Scene::named(name).expect("a scene"), (1280, 720), 0.3, 11);
        let found = errors.found as f64 / errors.measurable as f64;
        let (median, p95) = (quantile(&errors.stripe_px, 0.5), quantile(&errors.stripe_px, 0.95));
        println!(
            "{name}: found {found:.4}, stripe median {median:.3} px, p95 {p95:.3} px, false {}",
            errors.false_spots
        );
        assert!(found >= 0.95, "{name}: {found} of the measurable rows found");
        assert!(median < median_px && p95 < p95_px, "{name}: median {median} px, p95 {p95} px");
        assert!(errors.false_spots * 200 <= errors.measurable, "{name}: {} false spots", errors.false_spots);
    }
}

#[test]
fn without_a_laser_nothing_is_found() {
    let simulation =
        Simulation::new(Scene::named("no-laser").expect("a scene"), (640, 360), 30.0, 0.2, 5).expect("run");
    let recipe = Recipe::load("paper").expect("built in");
    for index in 0..simulation.frames_total() {
        let (image, _) = simulation.render(index);
        let found = stripe::paper::find(&image, &simulation.rig().laser, &recipe.stripe).expect("stripe").stripe;
        assert_eq!(found.found(), 0);
    }
}
