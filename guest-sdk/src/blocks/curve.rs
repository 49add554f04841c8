//! Straight lines between points, level beyond the ends.
//!
//! Never: memory; the points are the caller's.

/// The value of the curve at `x`. The points are in rising order of their first number; of two with the same, the later one
/// counts. NaN for a curve without points, and for an `x` that is none.
#[must_use]
pub fn curve(points: &[(f64, f64)], x: f64) -> f64 {
    let (part, at) = place(points, x);
    let y = |i: usize| points.get(i).map_or(f64::NAN, |p| p.1);
    if part > 0.0 {
        y(at) + part * (y(at + 1) - y(at))
    } else {
        y(at)
    }
}

/// Where `x` stands among the points: the part of the way, 0 to 1, from a point to the next one, and that point's place.
/// At and beyond the last point the part is 0; before the first one it is that point. A NaN has no part.
#[must_use]
pub fn place(points: &[(f64, f64)], x: f64) -> (f64, usize) {
    if x.is_nan() {
        return (0.0, usize::MAX);
    }
    let after = points.iter().take_while(|p| p.0 <= x).count();
    let Some(at) = after.checked_sub(1) else {
        return (0.0, 0);
    };
    match (points.get(at), points.get(after)) {
        (Some(from), Some(to)) => ((x - from.0) / (to.0 - from.0), at),
        _ => (0.0, at),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn between_points_it_is_straight_and_beyond_them_level() {
        let points = [(0.0, 10.0), (2.0, 20.0), (2.0, 30.0), (6.0, 10.0)];
        for (x, y) in [
            (-1.0, 10.0),
            (0.0, 10.0),
            (1.0, 15.0),
            (2.0, 30.0),
            (4.0, 20.0),
            (6.0, 10.0),
            (9.0, 10.0),
        ] {
            assert_eq!(curve(&points, x), y, "{x}");
        }
        assert!(curve(&points, f64::NAN).is_nan() && curve(&[], 1.0).is_nan());
        assert_eq!(curve(&[(1.0, 5.0)], 0.0), 5.0);
        assert_eq!(place(&points, 4.0), (0.5, 2));
    }
}
