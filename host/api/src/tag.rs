//! Which state an asker means: entity tags and the headers `If-Match` and `If-None-Match` (RFC 9110, §8.8 and §13).
//!
//! A tag names the part of a thing that people change: the revision of a loop, labels and note of a component, the definition of
//! an alarm. Measured values that stand beside it in the same answer do not change it; the live feed is for those.
//! Never: decides what a change may do; that is the cell's.

use axum::{
    Json as JsonAnswer,
    extract::FromRequestParts,
    http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header, request::Parts},
    response::{IntoResponse, Response},
};
use bumpless_core::Digest;
use bumpless_deploy::Expect;
use serde::Serialize;

use crate::error::{Kind, Problem};

/// Tags of one header at most: whoever has more of them asks again.
const TAGS_MAX: usize = 32;

/// A strong entity tag, without its quotes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Tag(String);

impl Tag {
    /// Of a loop: its revision. Numbers are never used twice, not even by a loop that was deleted and made again.
    pub(crate) fn revision(revision: u64) -> Self {
        Self(format!("r{revision}"))
    }

    /// Of a value: the first 16 digits of the SHA-256 of its JSON.
    pub(crate) fn of(value: &impl Serialize) -> Self {
        // Plain data always serialises; an empty text would only make all tags the same.
        let text = serde_json::to_vec(value).unwrap_or_default();
        Self::digest(&Digest::of(&text)).short()
    }

    /// Of bytes that have a digest.
    pub(crate) fn digest(digest: &Digest) -> Self {
        Self(digest.to_string())
    }

    fn short(mut self) -> Self {
        self.0.truncate(16);
        self
    }

    /// As a header.
    pub(crate) fn header(&self) -> Option<HeaderValue> {
        HeaderValue::try_from(format!("\"{}\"", self.0)).ok()
    }
}

/// What one of the two headers names.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Named {
    /// `*`: whatever there is.
    Any,
    /// These tags, without quotes; of weak ones, `W/` stays.
    Tags(Vec<String>),
}

/// The conditions of a request.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Conditions {
    matches: Option<Named>,
    matches_not: Option<Named>,
}

impl<S: Sync> FromRequestParts<S> for Conditions {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        Self::read(&parts.headers)
    }
}

impl Conditions {
    fn read(headers: &HeaderMap) -> Result<Self, Problem> {
        Ok(Self {
            matches: named(headers, &header::IF_MATCH)?,
            matches_not: named(headers, &header::IF_NONE_MATCH)?,
        })
    }

    /// Are there any?
    pub(crate) fn given(&self) -> bool {
        self.matches.is_some() || self.matches_not.is_some()
    }

    /// Does the asker of a read have this already?
    pub(crate) fn has(&self, tag: &Tag) -> bool {
        match &self.matches_not {
            None => false,
            Some(Named::Any) => true,
            // For reads, weak tags count as well (§8.8.3.2).
            Some(Named::Tags(tags)) => tags.iter().any(|one| one.strip_prefix("W/").unwrap_or(one) == tag.0),
        }
    }

    /// May a change of what stands there now be made? `tag` is none where there is nothing yet.
    pub(crate) fn check(&self, tag: Option<&Tag>) -> Result<(), Problem> {
        let is = |tags: &[String]| tag.is_some_and(|tag| tags.contains(&tag.0));
        let good = match &self.matches {
            None => true,
            Some(Named::Any) => tag.is_some(),
            Some(Named::Tags(tags)) => is(tags),
        };
        let free = match &self.matches_not {
            None => true,
            Some(Named::Any) => tag.is_none(),
            Some(Named::Tags(tags)) => !is(tags),
        };
        match (good && free, tag) {
            (true, _) => Ok(()),
            (false, Some(tag)) => Err(Problem::new(
                Kind::Precondition,
                format!("it stands at \"{}\", which is not what the request counts on", tag.0),
                "read it again, look at what changed, and send the change with the tag that it has then",
            )),
            (false, None) => Err(Problem::new(
                Kind::Precondition,
                "there is nothing of that name, and the request counts on something",
                "leave If-Match out to make it",
            )),
        }
    }

    /// What a change of a loop relies on, for its home to check at the moment of the change.
    pub(crate) fn expect(&self) -> Result<Expect, Problem> {
        match (&self.matches, &self.matches_not) {
            (None, None) => Ok(Expect::Anything),
            (None, Some(Named::Any)) => Ok(Expect::Nothing),
            (Some(Named::Any), None) => Ok(Expect::Something),
            (Some(Named::Tags(tags)), None) => {
                let revisions = tags.iter().filter_map(|tag| tag.strip_prefix('r')?.parse().ok());
                Ok(Expect::OneOf(revisions.collect()))
            }
            _ => Err(Problem::new(
                Kind::BadRequest,
                "these conditions mean nothing for a change of a loop",
                "use If-Match with the tag that the loop had, or If-None-Match: * to make a new one only",
            )),
        }
    }
}

/// The tags of a header, which may be given more than once.
fn named(headers: &HeaderMap, name: &HeaderName) -> Result<Option<Named>, Problem> {
    let mut tags = Vec::new();
    for value in headers.get_all(name) {
        let bad = || {
            Problem::new(
                Kind::BadRequest,
                format!("the header {name} has no entity tag"),
                "use the value of ETag as it came, with its quotes, or *",
            )
        };
        let text = value.to_str().map_err(|_| bad())?;
        if text.trim() == "*" {
            return Ok(Some(Named::Any));
        }
        for part in text.split(',') {
            let part = part.trim();
            let (weak, quoted) = part.strip_prefix("W/").map_or(("", part), |rest| ("W/", rest));
            let tag = quoted.strip_prefix('"').and_then(|rest| rest.strip_suffix('"'));
            let tag = tag.filter(|tag| !tag.contains('"')).ok_or_else(bad)?;
            if tags.len() == TAGS_MAX {
                return Err(Problem::new(
                    Kind::BadRequest,
                    format!("the header {name} has more than {TAGS_MAX} tags"),
                    "name the one that counts",
                ));
            }
            tags.push(format!("{weak}{tag}"));
        }
    }
    Ok((!tags.is_empty()).then_some(Named::Tags(tags)))
}

/// An answer with its tag: 304 without a body where the asker has it.
pub(crate) struct Tagged<T> {
    status: StatusCode,
    tag: Tag,
    /// None where the asker has it.
    body: Option<T>,
}

impl<T> Tagged<T> {
    /// The answer to a read.
    pub(crate) fn read(conditions: &Conditions, tag: Tag, body: T) -> Self {
        let has = conditions.has(&tag);
        Self {
            status: if has { StatusCode::NOT_MODIFIED } else { StatusCode::OK },
            tag,
            body: (!has).then_some(body),
        }
    }

    /// The answer to a change.
    pub(crate) fn changed(status: StatusCode, tag: Tag, body: T) -> Self {
        Self {
            status,
            tag,
            body: Some(body),
        }
    }
}

impl<T: Serialize> IntoResponse for Tagged<T> {
    fn into_response(self) -> Response {
        let mut response = match self.body {
            Some(body) => (self.status, JsonAnswer(body)).into_response(),
            None => self.status.into_response(),
        };
        if let Some(tag) = self.tag.header() {
            response.headers_mut().insert(header::ETAG, tag);
        }
        response
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

    use super::*;

    fn conditions(rows: &[(HeaderName, &str)]) -> Result<Conditions, Problem> {
        let mut headers = HeaderMap::new();
        for (name, value) in rows {
            headers.append(name.clone(), HeaderValue::from_str(value).unwrap());
        }
        Conditions::read(&headers)
    }

    #[test]
    fn conditions_mean_what_the_standard_says() {
        let (yes, no) = (header::IF_MATCH, header::IF_NONE_MATCH);
        let tag = Tag::revision(7);
        /// The header, does the reader have r7, may r7 be changed, may nothing be made.
        type Row<'a> = (&'a [(HeaderName, &'a str)], bool, bool, bool);
        let table: [Row<'_>; 9] = [
            (&[], false, true, true),
            (&[(yes.clone(), "\"r7\"")], false, true, false),
            (&[(yes.clone(), "\"r6\", \"r7\"")], false, true, false),
            (&[(yes.clone(), "\"r6\"")], false, false, false),
            (&[(yes.clone(), "W/\"r7\"")], false, false, false),
            (&[(yes, "*")], false, true, false),
            (&[(no.clone(), "*")], true, false, true),
            (&[(no.clone(), "W/\"r7\"")], true, true, true),
            (&[(no.clone(), "\"x\""), (no, "\"r7\"")], true, false, true),
        ];
        for (rows, has, may_change, may_make) in table {
            let given = conditions(rows).unwrap();
            assert_eq!(given.given(), !rows.is_empty(), "{rows:?}");
            assert_eq!(given.has(&tag), has, "{rows:?}");
            assert_eq!(given.check(Some(&tag)).is_ok(), may_change, "{rows:?}");
            assert_eq!(given.check(None).is_ok(), may_make, "{rows:?}");
        }
    }

    #[test]
    fn a_loops_home_is_told_what_is_relied_on() {
        let (yes, no) = (header::IF_MATCH, header::IF_NONE_MATCH);
        let expect = |rows: &[(HeaderName, &str)]| conditions(rows).unwrap().expect();
        assert_eq!(expect(&[]), Ok(Expect::Anything));
        assert_eq!(expect(&[(no.clone(), "*")]), Ok(Expect::Nothing));
        assert_eq!(expect(&[(yes.clone(), "*")]), Ok(Expect::Something));
        assert_eq!(
            expect(&[(yes.clone(), "\"r3\", \"r4\"")]),
            Ok(Expect::OneOf(vec![3, 4]))
        );
        // A tag that no loop ever had fits none.
        assert_eq!(expect(&[(yes.clone(), "\"x\"")]), Ok(Expect::OneOf(vec![])));
        assert!(expect(&[(no, "\"r3\"")]).is_err());
    }

    #[test]
    fn what_is_no_tag_is_said_to_be_none() {
        let many = vec!["\"r1\""; TAGS_MAX + 1].join(",");
        for (text, part) in [
            ("r7", "no entity tag"),
            ("\"a\"b\"", "no entity tag"),
            ("", "no entity tag"),
            (many.as_str(), "more than 32"),
        ] {
            let problem = conditions(&[(header::IF_MATCH, text)]).expect_err(text);
            assert_eq!(problem.status, 400, "{text}");
            assert!(problem.detail.contains(part), "{text}: {problem:?}");
        }
    }

    #[test]
    fn tags_tell_values_apart() {
        assert_eq!(Tag::of(&("a", 1)), Tag::of(&("a", 1)));
        assert_ne!(Tag::of(&("a", 1)), Tag::of(&("a", 2)));
        assert_eq!(Tag::of(&1).0.len(), 16);
    }
}
