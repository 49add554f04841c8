//! Noise as a function: the same seed, source and moment give the same number, whoever asks and however often.
//!
//! So reading a point never changes what the next reader sees.

/// Mixes 64 bits so that neighbours share nothing (`SplitMix64`'s finaliser, Steele, Lea and Flood 2014).
pub(crate) const fn mixed(x: u64) -> u64 {
    let x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// A number with mean 0 and standard deviation 1, nearly normal, within ±3.47: the sum of four uniform numbers.
#[must_use]
pub fn normal(seed: u64, source: u64, moment: u64) -> f64 {
    const GOLDEN: u64 = 0x9e37_79b9_7f4a_7c15;
    let bits = mixed(mixed(seed.wrapping_add(GOLDEN) ^ source.wrapping_mul(GOLDEN)).wrapping_add(moment));
    let sum = (0..4).map(|n| f64::from((bits >> (16 * n)) as u16) + 0.5).sum::<f64>() / 65_536.0;
    // The variance of the sum is 4/12.
    (sum - 2.0) * 3.0_f64.sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn has_mean_0_deviation_1_and_no_memory() {
        let count = 100_000;
        let samples: Vec<f64> = (0..count).map(|n| normal(42, 3, n)).collect();
        let mean = samples.iter().sum::<f64>() / count as f64;
        let variance = samples.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / count as f64;
        let next = samples.windows(2).map(|w| w[0] * w[1]).sum::<f64>() / count as f64;
        assert!(mean.abs() < 0.02, "mean {mean}");
        assert!((variance - 1.0).abs() < 0.02, "variance {variance}");
        assert!(next.abs() < 0.02, "correlation {next}");
        assert!(samples.iter().all(|x| x.abs() < 3.47));
    }

    #[test]
    fn depends_on_all_three() {
        let all = [
            normal(1, 2, 3),
            normal(2, 2, 3),
            normal(1, 3, 3),
            normal(1, 2, 4),
            normal(2, 1, 3),
        ];
        for (n, a) in all.iter().enumerate() {
            assert!(all.iter().skip(n + 1).all(|b| (a - b).abs() > 1e-9), "{all:?}");
        }
        assert_eq!(normal(1, 2, 3).to_bits(), normal(1, 2, 3).to_bits());
    }
}
