//! Randomness that depends on nothing but a seed and a place, so that any frame can be made alone.

/// Mixes a seed and a place into 64 well-spread bits (the finaliser of SplitMix64).
pub(super) fn hash(seed: u64, a: i64, b: i64) -> u64 {
    let mut h = seed
        ^ (a as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15)
        ^ (b as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f).rotate_left(31);
    h = (h ^ (h >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    h = (h ^ (h >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    h ^ (h >> 31)
}

/// A stream of random numbers from one seed (SplitMix64).
pub(super) struct Stream(u64);

impl Stream {
    /// The stream that belongs to a seed and a place.
    pub(super) fn at(seed: u64, a: i64, b: i64) -> Stream {
        Stream(hash(seed, a, b))
    }

    /// The next 64 bits.
    pub(super) fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut h = self.0;
        h = (h ^ (h >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        h = (h ^ (h >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        h ^ (h >> 31)
    }

    /// From 0 up to, never reaching, 1.
    pub(super) fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// From `low` to `high`.
    pub(super) fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }
}

/// Smooth noise from −1 to 1 that has one random value at every whole (x, y).
pub(super) fn value_noise(seed: u64, x: f64, y: f64) -> f32 {
    let (x_floor, y_floor) = (x.floor(), y.floor());
    let (column, row) = (x_floor as i64, y_floor as i64);
    let corner = |dx, dy| (hash(seed, column + dx, row + dy) >> 40) as f32 * (2.0 / 16_777_216.0) - 1.0;
    let ease = |t: f32| t * t * (3.0 - 2.0 * t);
    let (fx, fy) = (ease((x - x_floor) as f32), ease((y - y_floor) as f32));
    let top = corner(0, 0) + (corner(1, 0) - corner(0, 0)) * fx;
    let bottom = corner(0, 1) + (corner(1, 1) - corner(0, 1)) * fx;
    top + (bottom - top) * fy
}

/// 4096 normally distributed numbers of mean 0 and variance 1, drawn by index: a sensor needs three for every pixel.
pub(super) struct Normals(Vec<f32>);

impl Normals {
    const COUNT: usize = 4096;

    pub(super) fn new() -> Normals {
        let mut stream = Stream(1);
        let mut values = Vec::with_capacity(Self::COUNT);
        while values.len() < Self::COUNT {
            // Box and Muller: a pair from two uniform numbers; its opposite keeps the mean at zero.
            let radius = (-2.0 * (1.0 - stream.unit()).ln()).sqrt();
            let (sine, cosine) = (std::f64::consts::TAU * stream.unit()).sin_cos();
            values.extend([radius * sine, -radius * sine, radius * cosine, -radius * cosine]);
        }
        let variance = values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64;
        Normals(values.iter().map(|v| (v / variance.sqrt()) as f32).collect())
    }

    /// The number that the low 12 bits choose.
    pub(super) fn pick(&self, bits: u64) -> f32 {
        self.0[bits as usize % Self::COUNT]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normals_are_normal() {
        let normals = Normals::new();
        let mut stream = Stream::at(7, 0, 0);
        let values: Vec<f64> = (0..200_000).map(|_| f64::from(normals.pick(stream.bits()))).collect();
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let variance = values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64;
        let beyond_two = values.iter().filter(|v| v.abs() > 2.0).count() as f64 / values.len() as f64;
        assert!(mean.abs() < 0.01 && (variance - 1.0).abs() < 0.02, "mean {mean}, variance {variance}");
        assert!((beyond_two - 0.0455).abs() < 0.01, "{beyond_two} beyond two sigma");
    }

    #[test]
    fn value_noise_is_continuous_and_bounded() {
        let mut last = value_noise(3, 0.0, 0.37);
        for i in 1..4000 {
            let here = value_noise(3, f64::from(i) * 0.01, 0.37);
            assert!(here.abs() <= 1.0 && (here - last).abs() < 0.05, "a jump of {} at {i}", here - last);
            last = here;
        }
    }
}
