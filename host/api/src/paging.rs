//! Long lists in parts: `limit` and `after`, the same on every list.
//!
//! An answer names in `next` where the following part begins, and carries the whole address of it in the header `Link`
//! (RFC 8288). Parts are cut from the list as it is when each is asked for. Never: an answer without a bound.

use axum::{
    Json as JsonAnswer,
    http::{HeaderValue, Uri, header},
    response::{IntoResponse, Response},
};
use serde::Serialize;

use crate::{
    error::{Kind, Problem},
    limits::{PAGE_DEFAULT, PAGE_MAX},
};

/// Which part of a list.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Page {
    limit: usize,
    after: Option<String>,
}

/// Is the list ordered by the key that `after` names?
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Order {
    /// By the key: what `after` names need not be there any more.
    ByKey,
    /// Otherwise: what `after` names must be there.
    Otherwise,
}

impl Page {
    /// As asked for.
    pub(crate) fn of(limit: Option<usize>, after: Option<String>) -> Result<Self, Problem> {
        Self::within(limit, after, PAGE_DEFAULT, PAGE_MAX)
    }

    /// As asked for, with other bounds.
    pub(crate) fn within(
        limit: Option<usize>,
        after: Option<String>,
        default: usize,
        max: usize,
    ) -> Result<Self, Problem> {
        let limit = limit.unwrap_or(default);
        if !(1..=max).contains(&limit) {
            return Err(Problem::new(
                Kind::Invalid,
                format!("limit = {limit}"),
                format!("use 1 to {max}"),
            ));
        }
        Ok(Self {
            limit,
            after: after.filter(|after| !after.is_empty()),
        })
    }

    /// This part of the rows, and where the next one begins.
    pub(crate) fn cut<T>(
        &self,
        mut rows: Vec<T>,
        order: Order,
        key: impl Fn(&T) -> String,
    ) -> Result<(Vec<T>, Option<String>), Problem> {
        if let Some(after) = &self.after {
            let first = match order {
                Order::ByKey => Some(rows.partition_point(|row| key(row).as_str() <= after.as_str())),
                Order::Otherwise => rows.iter().position(|row| key(row) == *after).map(|at| at + 1),
            };
            let Some(first) = first else {
                let after: String = after.chars().take(120).collect();
                return Err(Problem::new(
                    Kind::Invalid,
                    format!("after = {after:?} is not in this list, or not any more"),
                    "begin again without it",
                ));
            };
            rows.drain(..first);
        }
        let more = rows.len() > self.limit;
        rows.truncate(self.limit);
        let next = rows.last().filter(|_| more).map(key);
        Ok((rows, next))
    }
}

/// A part of a list, with the mark that the next one begins after.
pub(crate) struct Listed<T>(pub(crate) T, pub(crate) Option<String>);

/// The mark, on its way to the header.
#[derive(Debug, Clone)]
struct Next(String);

impl<T: Serialize> IntoResponse for Listed<T> {
    fn into_response(self) -> Response {
        let mut response = JsonAnswer(self.0).into_response();
        if let Some(next) = self.1 {
            response.extensions_mut().insert(Next(next));
        }
        response
    }
}

/// Puts the address of the next part into the header, for the address that was asked.
pub(crate) fn link(response: &mut Response, asked: &Uri) {
    let Some(Next(after)) = response.extensions_mut().remove::<Next>() else {
        return;
    };
    let mut query: Vec<String> = asked
        .query()
        .unwrap_or_default()
        .split('&')
        .filter(|part| !part.is_empty() && *part != "after" && !part.starts_with("after="))
        .map(str::to_owned)
        .collect();
    query.push(format!("after={}", encoded(&after)));
    let link = format!("<{}?{}>; rel=\"next\"", asked.path(), query.join("&"));
    if let Ok(link) = HeaderValue::try_from(link) {
        response.headers_mut().insert(header::LINK, link);
    }
}

/// Percent-encoded but for unreserved characters (RFC 3986, §2.3).
fn encoded(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for byte in text.bytes() {
        if byte.is_ascii_alphanumeric() || b"-._~".contains(&byte) {
            out.push(char::from(byte));
        } else {
            out.push_str(&format!("%{byte:02X}"));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

    use super::*;

    fn rows(names: &[&str]) -> Vec<String> {
        names.iter().map(|&name| name.to_owned()).collect()
    }

    #[test]
    fn parts_join_to_the_whole() {
        let all = rows(&["a", "b", "d", "e", "f"]);
        for order in [Order::ByKey, Order::Otherwise] {
            for limit in 1..=6 {
                let (mut seen, mut after) = (Vec::new(), None);
                loop {
                    let page = Page::of(Some(limit), after.take()).unwrap();
                    let (part, next) = page.cut(all.clone(), order, Clone::clone).unwrap();
                    assert!(part.len() <= limit);
                    seen.extend(part);
                    match next {
                        Some(next) => after = Some(next),
                        None => break,
                    }
                }
                assert_eq!(seen, all, "{order:?} {limit}");
            }
        }
    }

    #[test]
    fn what_went_between_two_parts_is_passed_over_or_told() {
        let page = Page::of(Some(2), Some("c".to_owned())).unwrap();
        let all = rows(&["a", "b", "d", "e"]);
        assert_eq!(
            page.cut(all.clone(), Order::ByKey, Clone::clone).unwrap(),
            (rows(&["d", "e"]), None)
        );
        let problem = page.cut(all, Order::Otherwise, Clone::clone).expect_err("c is gone");
        assert!(problem.detail.contains("\"c\""), "{problem:?}");
    }

    #[test]
    fn limits_are_bounded() {
        for limit in [0, PAGE_MAX + 1] {
            assert_eq!(Page::of(Some(limit), None).expect_err("out of bounds").status, 422);
        }
    }

    #[test]
    fn the_link_keeps_the_rest_of_the_question() {
        let mut response = Listed(1, Some("a b&c".to_owned())).into_response();
        link(&mut response, &"/v1/x?limit=2&after=z&text=q".parse().unwrap());
        assert_eq!(
            response.headers()[header::LINK],
            "</v1/x?limit=2&text=q&after=a%20b%26c>; rel=\"next\""
        );
        let mut response = Listed(1, None).into_response();
        link(&mut response, &"/v1/x".parse().unwrap());
        assert!(response.headers().get(header::LINK).is_none());
    }
}
