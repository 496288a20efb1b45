//! Numbers that look random and can be repeated.

/// Throws numbers; `STRIA_CHAOS_SEED` repeats a series.
pub struct Dice(u64);

impl Dice {
    /// With a new seed, which is printed, or with the one in `STRIA_CHAOS_SEED`.
    pub fn new() -> Dice {
        let told = std::env::var("STRIA_CHAOS_SEED").ok().and_then(|text| text.parse().ok());
        let seed = told.unwrap_or_else(|| {
            let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
            now.map_or(1, |t| t.as_nanos() as u64)
        });
        println!("STRIA_CHAOS_SEED={seed}");
        Dice::with_seed(seed)
    }

    /// With a known seed.
    pub fn with_seed(seed: u64) -> Dice {
        Dice(seed | 1)
    }

    /// 0 to `below` - 1.
    pub fn throw(&mut self, below: usize) -> usize {
        // xorshift64*
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 33) as usize % below
    }

    /// Any bytes.
    pub fn bytes(&mut self, count: usize) -> Vec<u8> {
        (0..count).map(|_| self.throw(256) as u8).collect()
    }
}

impl Default for Dice {
    fn default() -> Self {
        Dice::new()
    }
}
