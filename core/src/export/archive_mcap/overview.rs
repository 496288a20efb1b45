//! The whole surface in one message: every n-th point, few enough for any viewer.

use crate::surface::SurfacePoint;

/// Points, at most.
const POINTS_MAX: usize = 131_072;

/// Every n-th point of a surface of any size: when full, every second goes and from then on half as many come.
pub(super) struct SurfaceOverview {
    points: Vec<SurfacePoint>,
    step: usize,
    /// Points since the last one that was taken.
    since: usize,
}

impl SurfaceOverview {
    pub(super) fn new() -> SurfaceOverview {
        SurfaceOverview { points: Vec::new(), step: 1, since: 0 }
    }

    pub(super) fn add(&mut self, points: &[SurfacePoint]) {
        for point in points {
            if self.since == 0 {
                if self.points.len() == POINTS_MAX {
                    let mut index = 0_usize;
                    self.points.retain(|_| {
                        index += 1;
                        index % 2 == 1
                    });
                    self.step *= 2;
                }
                self.points.push(*point);
            }
            self.since = (self.since + 1) % self.step;
        }
    }

    pub(super) fn points(&self) -> &[SurfacePoint] {
        &self.points
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    #[test]
    fn it_stays_small_and_shows_all_of_the_way() {
        let mut overview = SurfaceOverview::new();
        for frame in 0..1_000_u32 {
            let point = |row: u32| SurfacePoint {
                point_in_world: Point3::new(f64::from(frame), f64::from(row), 850.0),
                rgb: [0; 3],
                confidence: 1.0,
                frame,
            };
            overview.add(&(0..1_001).map(point).collect::<Vec<_>>());
        }
        let points = overview.points();
        assert!((POINTS_MAX / 2..=POINTS_MAX).contains(&points.len()), "{} points", points.len());
        let mut of_frame = vec![0; 1_000];
        points.iter().for_each(|point| of_frame[point.frame as usize] += 1);
        let (least, most) = (of_frame.iter().min(), of_frame.iter().max());
        assert!(least >= Some(&100) && most <= Some(&140), "{least:?} to {most:?} of a frame");
    }
}
