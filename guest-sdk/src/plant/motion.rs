//! What models move by: equations over time, and noise that depends on nothing but its seed, source and moment.
//!
//! Never: a state of its own.

/// Lets a system of equations `x' = rate(x)` go on for `dt_s`, in equal steps of at most `step_max_s`, by the classical
/// Runge-Kutta method of fourth order (Kutta 1901).
pub fn runge_kutta<const N: usize>(
    state: &mut [f64; N],
    dt_s: f64,
    step_max_s: f64,
    rate: impl Fn(&[f64; N]) -> [f64; N],
) {
    if dt_s <= 0.0 {
        return;
    }
    let steps = (dt_s / step_max_s).ceil().max(1.0);
    let h = dt_s / steps;
    let moved = |from: &[f64; N], by: &[f64; N], part: f64| {
        let mut to = *from;
        for (t, b) in to.iter_mut().zip(by) {
            *t += part * b;
        }
        to
    };
    let mut left = steps;
    while left > 0.5 {
        let k1 = rate(state);
        let k2 = rate(&moved(state, &k1, 0.5 * h));
        let k3 = rate(&moved(state, &k2, 0.5 * h));
        let k4 = rate(&moved(state, &k3, h));
        for (i, x) in state.iter_mut().enumerate() {
            *x += h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
        }
        left -= 1.0;
    }
}

/// A number with mean 0 and standard deviation 1, nearly normal, within ±3.47, that depends on these three alone: so to
/// look never changes what is seen next. (`SplitMix64`'s finaliser, Steele, Lea and Flood 2014; the sum of four uniform numbers.)
#[must_use]
pub fn noise(seed: u64, source: u64, moment: u64) -> f64 {
    const GOLDEN: u64 = 0x9e37_79b9_7f4a_7c15;
    const fn mixed(x: u64) -> u64 {
        let x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        x ^ (x >> 31)
    }
    let bits = mixed(mixed(seed.wrapping_add(GOLDEN) ^ source.wrapping_mul(GOLDEN)).wrapping_add(moment));
    let mut sum = 0.0;
    let mut part = 0;
    while part < 4 {
        sum += (f64::from((bits >> (16 * part)) as u16) + 0.5) / 65_536.0;
        part += 1;
    }
    // The variance of the sum is 4/12; √3 brings it to 1.
    (sum - 2.0) * 1.732_050_807_568_877_2
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    #[test]
    fn runge_kutta_is_of_fourth_order() {
        let error = |step: f64| {
            let mut x = [1.0];
            runge_kutta(&mut x, 1.0, step, |x| [-x[0]]);
            (x[0] - (-1.0_f64).exp()).abs()
        };
        assert!((error(0.1) / error(0.05) / 16.0 - 1.0).abs() < 0.1);
        let mut still = [3.0];
        runge_kutta(&mut still, 0.0, 1.0, |x| [x[0]]);
        assert_eq!(still, [3.0]);
    }

    #[test]
    fn noise_has_mean_0_and_deviation_1() {
        let samples: Vec<f64> = (0..100_000).map(|n| noise(1, 2, n)).collect();
        let mean = samples.iter().sum::<f64>() / samples.len() as f64;
        let variance = samples.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / samples.len() as f64;
        assert!(mean.abs() < 0.02 && (variance - 1.0).abs() < 0.02, "{mean} {variance}");
    }
}
